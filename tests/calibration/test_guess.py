"""Which reading of the poses is right: planted mistakes are named, sound poses are not accused."""

import shlex
import tracemalloc
from dataclasses import replace
from functools import lru_cache, reduce
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import known_of
from support.commands import visioncal as visioncal_command
from support.fuzz.mistakes import (
    HALF_TURNS,
    MISTAKES,
    OTHER,
    Poses,
    numbers,
    sound,
)
from support.marks import slow

import visioncal
from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.guess.readings import changes
from visioncal.calibration.pipeline.guess_inputs import chain_poses
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose, exp, invert, nearest_rotation
from visioncal.core.types import MOUNTS
from visioncal.estimation.closed_form import SOLVERS
from visioncal.interchange.formats import DoubtfulSession
from visioncal.results import Calibration
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, SimulatedCell, project, simulate, wide_camera
from visioncal.vision.targets import corner_positions, load_target


def measured(cell: SimulatedCell) -> RunState:
    """What is known of a cell once the target's poses are."""
    known = known_of(cell)
    for stage in STAGES:
        if stage.name in ("intrinsics", "pnp"):
            known = stage.run(known)
    return known


def seen_in(cell: SimulatedCell) -> Poses:
    """The poses of a simulated cell: the camera's are measured from corners, lens included."""
    known = measured(cell)
    views = sorted(known.poses)
    camera = np.array([known.poses[view].cam_from_target[0] for view in views])
    return sound(cell.robot.base_from_flange[views], camera, cell.options.mount)


def guessed(poses: Poses) -> Guess:
    """What the guess makes of the poses."""
    return guess_reading(
        poses.robot,
        poses.camera,
        poses.mount,
        chain=poses.chain,
        is_measured=poses.is_measured,
    )


def is_named(guess: Guess, poses: Poses) -> bool:
    """Whether the right reading is named: it stands out and gives the true poses back.

    They may differ by half turns of both frames where an axis was mirrored: no view tells which.
    """
    best = guess.best
    if not guess.stands_out or best.hypothesis.mount != poses.true_mount:
        return False
    if not np.isclose(best.board_scale, poses.true_scale):
        return False
    found, true = best.hypothesis.robot_numbers(poses.robot).poses(), poses.true_robot
    there = np.isfinite(true).all(axis=(1, 2))
    turns = HALF_TURNS if best.hypothesis.robot.mirrored else HALF_TURNS[:1]
    # Numbers are rewritten without loss, but for the rounding of a few conversions.
    return any(
        np.allclose(a @ found[there] @ b, true[there], atol=1e-7) for a in turns for b in turns
    )


@lru_cache(maxsize=2)
def cell_poses(mount, views=14):
    """The poses of a cell with the noise of a fair robot, its lens estimated."""
    return seen_in(
        simulate(
            CellOptions(
                mount=mount,
                views=views,
                state_intrinsics=False,
                pixel_sigma_px=0.1,
                robot_sigma_m=3e-4,
                robot_sigma_rad=5e-4,
                seed=4,
            )
        )
    )


# Calibrating names exchanged rows by themselves.
READINGS = [name for name in MISTAKES if name != "two rows exchanged"]
# The seed draws which of a mistake's forms it is: both of those that have two.
FORMS = ("quaternion w, x, y, z", "Euler ZYX taken for XYZ", "degrees and radians")


@pytest.mark.parametrize(
    ("name", "mount"),
    [*zip(READINGS, cycle(MOUNTS)), *zip(FORMS, cycle(MOUNTS[::-1]))],
)
def test_a_planted_mistake_is_named(name, mount):
    poses = MISTAKES[name](cell_poses(mount), np.random.default_rng(MOUNTS.index(mount)))
    guess = guessed(poses)
    assert is_named(guess, poses), guess.sentence
    assert guess.best.words in guess.sentence
    assert guess.declared in guess.candidates


def test_rows_in_reverse_or_sorted_as_text_are_named():
    poses, named = cell_poses("eye-in-hand"), set()
    # The first seeds of each of five orders.
    for seed in (0, 1, 2, 11, 12):
        planted = MISTAKES["rows in another order"](poses, np.random.default_rng(seed))
        guess = guessed(planted)
        assert is_named(guess, planted), guess.sentence
        named.add(guess.best.hypothesis.changes)
    assert len(named) == 5


@pytest.mark.parametrize(
    ("name", "is_measured", "mount"),
    [
        ("", True, "eye-in-hand"),
        ("inverse poses", True, "eye-to-hand"),
        ("another unit", False, "eye-in-hand"),
    ],
)
def test_a_mount_that_is_not_given_is_that_of_the_likelier_cell(name, is_measured, mount):
    poses = cell_poses(mount)
    if name:
        poses = MISTAKES[name](poses, np.random.default_rng(0))
    guess = guessed(replace(poses, mount=None, is_measured=is_measured))
    assert is_named(guess, poses) if name else guess.best is guess.declared, guess.sentence
    assert guess.best.hypothesis.mount == mount
    assert guess.notes[0].startswith(f"The mount was not given and is taken for {mount}")


def test_a_mount_that_nothing_tells_is_asked_for():
    poses = cell_poses("eye-in-hand")
    edges = SOLVERS["park"](poses.true_robot, poses.camera.poses())
    # A tool on which the camera is as far from the flange as the board is from the base.
    tool, far = np.eye(4), np.linalg.norm(edges.z[:3, 3]) / np.linalg.norm(edges.x[:3, 3])
    tool[:3, 3] = (far - 1.0) * edges.x[:3, 3]
    robot = poses.true_robot @ invert(tool)
    with pytest.raises(DataError, match=r"eye-in-hand \(as declared\).*--mount"):
        guess_reading(numbers(robot), poses.camera, None)
    guess = guess_reading(numbers(robot), poses.camera, None, chain=poses.true_robot)
    assert guess.best is guess.declared
    assert guess.best.hypothesis.mount == "eye-in-hand"


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_wrong_mount_is_named_though_poses_are_poor(mount):
    # As of a hobby arm: 5 degrees and 10 mm.
    poses, rng = cell_poses(mount), np.random.default_rng(2)
    noise = exp(rng.normal(0.0, [0.05] * 3 + [6e-3] * 3, (len(poses.robot), 6)))
    poor = numbers(poses.camera.poses() @ noise)
    guess = guess_reading(poses.robot, poor, OTHER[mount], is_measured=True)
    assert guess.best.words == f"the camera mounted {mount}", guess.sentence
    assert guess_reading(poses.robot, poor, mount, is_measured=True).stands_out is False


TAG = replace(load_target("apriltag_36h11_id0_120mm"), square_m=0.04)


def hobby_arm(seed):
    """24 flange poses of an arm of five axes, off by 2 deg a joint, and what it sees of a tag."""
    rng = np.random.default_rng(seed)
    twists = np.zeros((5, 6))
    # The axes of base, shoulder, elbow, wrist and hand at rest, and a point on each [m].
    twists[:, :3] = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0]]
    places = [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.22], [0.13, 0, 0.22], [0.23, 0, 0.22]]
    twists[:, 3:] = np.cross(places, twists[:, :3])

    def poses(joints):
        return reduce(
            np.matmul, [exp(q[:, None] * twist) for q, twist in zip(joints.T, twists, strict=True)]
        )

    joints = rng.uniform([-0.6, -0.5, -0.4, -0.2, -1.0], [0.6, 0.5, 0.6, 1.2, 1.0], (4000, 5))
    on_flange = exp(np.array([0.2, 1.4, 0.1, 0.03, 0.0, 0.06]))
    at_base = exp(np.array([0.1, 2.9, 0.3, 0.35, 0.05, 0.0]))
    cam_from_tag = invert(poses(joints) @ on_flange) @ at_base
    corners = cam_from_tag[:, None, :3, :3] @ corner_positions(TAG)[..., None]
    corners = corners[..., 0] + cam_from_tag[:, None, :3, 3]
    lens = wide_camera()
    px = project(lens, corners.reshape(-1, 3)).reshape(-1, 4, 2)
    seen = (corners[..., 2] > 0.05).all(axis=1)
    seen &= ((px > 5.0) & (px < np.subtract(lens.resolution, 5.0))).all(axis=(1, 2))
    at = np.flatnonzero(seen)[:24]
    told = poses(joints[at] + rng.normal(0.0, np.deg2rad(2.0), (len(at), 5)))
    return told, px[at] + rng.normal(0.0, 0.3, (len(at), 4, 2))


def of_tag(told, px):
    """The session of flange poses and of a tag's corners."""
    lens = wide_camera()
    found = [(np.arange(4), corners) for corners in px]
    return Session.from_corners(
        found, told, TAG, lens.resolution, mount="eye-in-hand", camera=lens
    ).needing(20.0, None)


@pytest.mark.parametrize("seed", [0, *map(slow, range(1, 4))])
def test_inverse_poses_of_a_hobby_arm_are_the_first_cause_and_undone(seed, tmp_path):
    told, px = hobby_arm(seed)
    inverse = of_tag(invert(told), px)
    verdict = visioncal.calibrate(inverse).verdict
    first = verdict.causes[0]
    assert first is verdict.findings[0]
    assert first.kind == "misread_poses"
    assert "the robot's poses inverse" in first.words
    sound = visioncal.calibrate(of_tag(told, px)).verdict
    assert "misread_poses" not in {cause.kind for cause in sound.causes}
    for finding in (*verdict.findings, *sound.findings):
        assert "within 0 " not in f"{finding.reason} {finding.without_it}"
    if seed == 0:
        inverse.save(tmp_path / "cell")
        argv = ("convert", tmp_path / "cell", tmp_path / "fixed", "--guess", "--yes")
        done = visioncal_command(*argv)
        assert done.status == 0, done.err
        fixed = Session.load(tmp_path / "fixed").views
        poses = [view.base_from_flange().as_matrix() for view in fixed]
        np.testing.assert_allclose(poses, told, atol=1e-9)


@pytest.mark.parametrize(("written", "read"), [("ZYX", "xyz"), ("xyz", "ZYX")])
def test_readings_with_the_same_poses_leave_nothing_open(written, read):
    # Angles of a KUKA read as those of a FANUC: several orders of turns undo that.
    poses = cell_poses("eye-in-hand")
    angles = Rotation.from_matrix(poses.true_robot[:, :3, :3]).as_euler(written)
    wrong = compose(Rotation.from_euler(read, angles).as_matrix(), poses.true_robot[:, :3, 3])
    guess = guess_reading(numbers(wrong), poses.camera, "eye-in-hand", is_measured=True)
    assert guess.stands_out, guess.sentence
    found = guess.best.hypothesis.robot_numbers(numbers(wrong))
    np.testing.assert_allclose(found.poses(), poses.true_robot, atol=1e-9)


def test_a_long_recording_takes_no_more_memory_than_what_is_looked_at():
    rng, edge = np.random.default_rng(1), np.eye(4)
    edge[:3, 3] = [0.0, 0.1, 0.2]
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.6, (5000, 3))).as_matrix()
    robot = compose(turns, rng.normal([0.4, 0.0, 0.6], 0.3, (5000, 3)))
    far = np.array([0.0, 0.0, 2.0])
    poses = sound(robot, invert(robot @ edge) @ compose(np.eye(3), far), "eye-in-hand")
    planted = MISTAKES["rows shifted by one"](poses, rng)
    tracemalloc.start()
    guess = guessed(planted)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert is_named(guess, planted), guess.sentence
    # One form of all rows takes 0.4 MB, and there are some three hundred of them.
    assert peak < 40e6


@pytest.mark.parametrize(("side", "rows"), [("robot", 5), ("camera", 14)])
def test_rotations_that_are_none_are_called_so(side, rows):
    poses = cell_poses("eye-in-hand")
    few = sound(poses.true_robot[:rows], poses.camera.poses()[:rows], poses.mount)
    wrong = getattr(few, side)
    wrong = replace(wrong, rotations=3.0 * wrong.rotations)
    guess = guessed(replace(few, **{side: wrong}, is_measured=False))
    assert not guess.stands_out
    assert not guess.declared.fit.is_readable
    assert "are none" in guess.sentence


SOUND = {
    "fair": {},
    "four views": {"views": 4},
    "eight views, coarse robot": {
        "views": 8,
        "robot_sigma_m": 2e-3,
        "robot_sigma_rad": 5e-3,
    },
    "small turns": {"tilt_rad": (0.0, 0.12), "roll_rad": 0.1, "robot_sigma_rad": 1e-3},
    "wrong views": {"wrong_views": 4, "views": 16},
    "another board": {"board_scale": 1.15, "board_bow_m": 1e-3},
    "worn arm": {"dh_sigma_m": 2e-3, "dh_sigma_rad": 5e-3},
    "one axis": {"motion": "one_axis", "robot_sigma_rad": 1e-3},
    "six views about one axis": {"motion": "one_axis", "views": 6, "robot_sigma_rad": 1e-3},
    "no turns": {"motion": "translation", "robot_sigma_rad": 1e-3},
}


@pytest.mark.parametrize(("world", "mount"), list(zip(SOUND, cycle(MOUNTS), strict=False)))
def test_sound_poses_are_not_accused(world, mount):
    poses = seen_in(simulate(replace(CellOptions(mount=mount, views=12), **SOUND[world])))
    guess = guessed(replace(poses, is_measured=mount == MOUNTS[0]))
    assert not guess.stands_out, guess.sentence
    assert guess.best is guess.declared


def test_motion_about_one_axis_is_said_to_tell_nothing():
    poses = seen_in(simulate(CellOptions(motion="one_axis", seed=2)))
    guess = guessed(MISTAKES["inverse poses"](poses, np.random.default_rng(0)))
    assert not guess.stands_out
    assert "cannot distinguish readings" in guess.sentence


def test_two_mistakes_at_once_are_named():
    poses = cell_poses("eye-in-hand")
    told = numbers(poses.true_robot, "euler-ZYX-deg", "mm").read_as(Reading("euler-xyz-rad"))
    poses = replace(poses, robot=told)
    guess = guessed(poses)
    assert is_named(guess, poses), guess.sentence
    assert len(guess.best.hypothesis.changes) == 2
    assert guess.best.hypothesis.robot.reading == Reading("euler-ZYX-deg", "mm")


@pytest.mark.parametrize("unit", ["mm", "inch"])
def test_two_mistakes_are_named_in_few_views(unit):
    """Fewer than eleven rows are alike in several orders, which are no readings of their own."""
    poses = cell_poses("eye-in-hand", 8)
    told = numbers(poses.true_robot, "quaternion-wxyz", unit).read_as(Reading("quaternion-xyzw"))
    poses = replace(poses, robot=told)
    guess = guessed(poses)
    assert is_named(guess, poses)
    tried = changes(guess.declared.hypothesis, is_measured=True, count=8)
    assert not any("sorted as text" in change.words for change in tried)


def test_both_sides_in_millimetres_show_by_where_cameras_can_be():
    poses = cell_poses("eye-in-hand")
    camera = numbers(poses.camera.poses(), unit="mm").read_as(Reading())
    told = numbers(poses.true_robot, unit="mm").read_as(Reading())
    guess = guess_reading(told, camera, poses.mount)
    assert guess.stands_out
    assert (
        guess.best.hypothesis.robot.reading.unit,
        guess.best.hypothesis.camera.reading.unit,
    ) == ("mm", "mm")


def test_the_cameras_own_poses_may_be_inverse():
    poses = cell_poses("eye-in-hand")
    camera = poses.camera.poses()
    guess = guess_reading(poses.robot, numbers(invert(camera)), poses.mount)
    assert guess.stands_out
    # Another mount closes the chain as well: the note says so whichever is chosen.
    assert any("camera's poses inverse" in name for name in (guess.best.words, *guess.notes))
    assert any("mounted" in name for name in (guess.best.words, *guess.notes))


def test_rows_that_are_shifted_are_found_among_four():
    poses = cell_poses("eye-in-hand")
    few = sound(poses.true_robot[:4], poses.camera.poses()[:4], poses.mount)
    planted = MISTAKES["rows shifted by one"](few, np.random.default_rng(0))
    guess = guessed(planted)
    assert is_named(guess, planted), guess.sentence


def test_only_the_joints_tell_the_inverse_where_the_camera_is_far_from_the_flange():
    poses = cell_poses("eye-in-hand")
    # A tool of two metres, and a board beside the base.
    tool, base = np.eye(4), np.eye(4)
    tool[2, 3], base[:3, 3] = 2.0, [-0.6, 0.2, 0.4]
    robot = base @ poses.true_robot @ invert(tool)
    told = numbers(invert(robot))
    alone = guess_reading(told, poses.camera, poses.mount, is_measured=True)
    assert alone.best.hypothesis.mount == OTHER[poses.mount]
    with_joints = guess_reading(
        told, poses.camera, poses.mount, chain=poses.true_robot, is_measured=True
    )
    assert with_joints.best.hypothesis.mount == poses.mount
    assert with_joints.best.hypothesis.robot.reading.inverse


def test_rows_without_a_pose_are_left_out():
    poses = cell_poses("eye-in-hand")
    camera = replace(poses.camera, positions=poses.camera.positions.copy())
    camera.positions[[1, 5]] = np.nan
    planted = MISTAKES["rows shifted by one"](
        replace(poses, camera=camera), np.random.default_rng(0)
    )
    guess = guessed(planted)
    assert is_named(guess, planted), guess.sentence
    assert len(guess.declared.of_rows) == len(poses.robot) - 2


def test_too_few_rows_are_refused():
    poses = cell_poses("eye-in-hand")
    with pytest.raises(DegenerateError, match="3 rows have"):
        guess_reading(numbers(poses.true_robot[:3]), numbers(poses.camera.poses()[:3]), poses.mount)


def text_of(pose):
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [repr(float(value)) for value in (*pose[:3, 3], *quaternion)]


def pairs_session(poses):
    """A session of the poses as they are told."""
    columns = ("view", *POSE, *(f"cft_{name}" for name in POSE))
    pairs = zip(poses.robot.poses(), poses.camera.poses(), strict=True)
    rows = [
        [str(at), *text_of(robot), *text_of(camera)] for at, (robot, camera) in enumerate(pairs)
    ]
    document = {"schema": 1, "name": "pairs", "mount": poses.mount}
    return Session.assemble(document, columns, rows, MemoryImages({}))


@pytest.mark.parametrize(
    "name",
    [slow("board's size in mm"), "the other mount"],
)
def test_what_is_advised_runs_as_it_is_printed_and_mends_it(name, tmp_path, monkeypatch):
    planted = MISTAKES[name](cell_poses("eye-in-hand"), np.random.default_rng(0))
    monkeypatch.chdir(tmp_path)
    pairs_session(planted).save(Path("my cell"))
    done = visioncal_command("calibrate", "my cell", "-o", "out")
    assert done.status == 3, done.err
    first = done.said.split("What to do next:")[1].splitlines()[2].strip()
    assert first == (
        "visioncal convert 'my cell' 'my cell-fixed' --guess --yes"
        " && visioncal calibrate 'my cell-fixed' -o out"
    )
    for command in first.split(" && "):
        again = visioncal_command(*shlex.split(command)[1:])
        assert again.status == 0, again.err
    assert Calibration.load(Path("out/calibration.json")).verdict.status == "good"


@pytest.mark.parametrize("whole", [False, True], ids=["rotations", "poses"])
def test_rotations_that_were_never_recorded_are_named(whole):
    poses = cell_poses("eye-in-hand")
    told = poses.robot.poses()
    told[:, :3, :3] = np.eye(3)
    if whole:
        told[:] = told[0]
    with pytest.raises(DegenerateError, match="are not those of the images") as caught:
        visioncal.calibrate(pairs_session(replace(poses, robot=numbers(told))))
    assert ("all rows have one position of the robot" in caught.value.message) is whole
    assert "how the poses were recorded" in caught.value.next_step


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand")])
def test_positions_that_were_never_recorded_are_named(mount):
    poses = cell_poses(mount)
    told = poses.robot.poses()
    told[:, :3, 3] = 0.0
    verdict = visioncal.calibrate(pairs_session(replace(poses, robot=numbers(told)))).verdict
    assert verdict.status == "bad"
    assert "all rows have one position of the robot" in verdict.reasons[0]
    assert "how the poses were recorded" in verdict.reasons[0]


def test_a_session_of_images_is_read_by_its_joints_as_well(rendered):
    session = Session.load(rendered)
    chain = chain_poses(session)
    assert np.isfinite(chain).all()
    told = numbers(chain, unit="mm").read_as(Reading())
    guess = DoubtfulSession(session, told).guess()
    assert guess.stands_out
    # The simulated robot reports the model's poses: what is given back is the chain.
    np.testing.assert_allclose(guess.best.hypothesis.robot_numbers(told).poses(), chain, atol=1e-6)
    assert not DoubtfulSession(session).guess().stands_out


def whole(poses):
    """Poses whose rotations, written with few digits, are rotations again."""
    return compose(nearest_rotation(poses[:, :3, :3]), poses[:, :3, 3])


def from_rvec(rvec, tvec):
    return compose(cv2.Rodrigues(np.array(rvec))[0], np.ravel(tvec))


def doosan(data):
    folder = data / "doosan_a0509_charuco/poses"
    robot = np.array([np.loadtxt(folder / f"pose_{at:03d}.txt") for at in range(31)])
    boards = [np.load(folder / f"boardpose_{at:03d}.npz") for at in range(31)]
    return robot, np.array([from_rvec(board["rvec"], board["tvec"]) for board in boards])


def test_real_poses_in_two_units_are_read_right(real_data):
    robot, camera = doosan(real_data)
    told = PoseNumbers(
        robot[:, :3, 3],
        robot[:, :3, :3].reshape(-1, 9),
        Reading("matrix"),
        tuple(f"pose_{at:03d}.txt" for at in range(len(robot))),
    )
    guess = guess_reading(told, numbers(camera), "eye-in-hand")
    assert guess.stands_out
    assert guess.best.hypothesis.robot.reading == Reading("matrix", "mm")
    assert len(guess.best.hypothesis.changes) == 1
    # Park's solution of all views leaves 1.6 mm; these are the 70 % that agree best.
    assert 1e3 * guess.best.fit.rms[0] < 1.6


def test_a_real_session_of_images_is_not_accused(real_data):
    name = "ric_charuco_eye_to_hand"
    guess = DoubtfulSession(Session.load(real_data / "sessions" / name)).guess()
    assert not guess.stands_out, guess.sentence
    assert "fit as declared" in guess.sentence


def test_a_real_board_that_looks_the_same_turned_is_not_accused(real_data):
    """Of each image one of two poses is taken, so that no reading explains half of them."""
    session = Session.load(real_data / "sessions" / "ur3e_checkerboard_to_hand_cam1")
    guess = DoubtfulSession(session.only([view.number for view in session.views][:20])).guess()
    assert not guess.stands_out, guess.sentence
