"""Poses, joints and rows that are misread: named, and sound ones left alone; `convert --guess`."""

import json
import tracemalloc
from dataclasses import replace
from functools import lru_cache, partial
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import known_of, pairs_session
from support.commands import visioncal as typed
from support.depth_cells import SMALL
from support.edited import rewritten
from support.following import follow, printed_commands
from support.fuzz.mistakes import HALF_TURNS, MISTAKES, Poses, numbers, sound
from support.marks import slow
from support.refusals import raised

import visioncal
from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.guess.fit import STARTS, robust_fits
from visioncal.calibration.guess.joints import guess_joints
from visioncal.calibration.guess.readings import changes
from visioncal.calibration.guess.search import in_one_turn
from visioncal.calibration.guess.unwrapping import in_one_place
from visioncal.calibration.run import STAGES
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import MOUNTS
from visioncal.estimation.closed_form import SOLVERS
from visioncal.interchange.formats import (
    DoubtfulSession,
    ImportOptions,
    assemble,
    read_foreign,
    reread,
)
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.robot.conversion import with_base
from visioncal.session import Session, View
from visioncal.session.columns import POSE
from visioncal.simulation import CAMERAS, CellOptions, SimulatedCell, simulate, write_session


def seen_in(cell: SimulatedCell) -> Poses:
    """The poses of a simulated cell: the camera's are measured from corners, lens included."""
    known = known_of(cell)
    for stage in STAGES:
        if stage.name in ("intrinsics", "pnp"):
            known = stage.run(known)
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
    is_known = np.isfinite(true).all(axis=(1, 2))
    turns = HALF_TURNS if best.hypothesis.robot.mirrored else HALF_TURNS[:1]
    # Numbers are rewritten without loss, but for the rounding of a few conversions.
    return any(
        np.allclose(a @ found[is_known] @ b, true[is_known], atol=1e-7)
        for a in turns
        for b in turns
    )


FAIR = CellOptions(
    state_intrinsics=False, pixel_sigma_px=0.1, robot_sigma_m=3e-4, robot_sigma_rad=5e-4, seed=4
)
TURNED_ONCE = {"motion": "one_axis", "robot_sigma_rad": 1e-3}


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


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(
    ("unit", "written", "is_inverse"),
    [("mm", "quaternion-wxyz", True), slow("inch", "quaternion-wxyz", False)],
)
def test_another_unit_goes_with_two_other_mistakes(mount, unit, written, is_inverse):
    """No robot reaches so far in metres; the third is the mount where poses are not inverse."""
    poses = cell_poses(mount)
    recorded = invert(poses.true_robot) if is_inverse else poses.true_robot
    poses = replace(poses, robot=numbers(recorded, written, unit).read_as(Reading()))
    other = mount if is_inverse else next(each for each in MOUNTS if each != mount)
    guess = guessed(replace(poses, mount=other))
    assert is_named(guess, poses), guess.sentence


def test_a_mount_that_nothing_determines_is_asked_for():
    poses = cell_poses()
    edges = SOLVERS["park"](poses.true_robot, poses.camera.poses())
    # A tool on which the camera is as far from the flange as the board is from the base.
    tool, far = np.eye(4), np.linalg.norm(edges.z[:3, 3]) / np.linalg.norm(edges.x[:3, 3])
    tool[:3, 3] = (far - 1.0) * edges.x[:3, 3]
    robot = poses.true_robot @ invert(tool)
    with pytest.raises(DataError, match=r"eye-in-hand \(as first read\).*--mount"):
        guess_reading(numbers(robot), poses.camera, None)
    guess = guess_reading(numbers(robot), poses.camera, None, chain=poses.true_robot)
    assert guess.best is guess.declared
    assert guess.best.hypothesis.mount == "eye-in-hand"


def test_three_tenths_of_the_views_may_be_wrong_and_are_not_fitted():
    poses, wrong = cell_poses(views=20), np.arange(3, 20, 3)
    robot = poses.true_robot.copy()
    robot[wrong] = robot[np.roll(wrong, 1)]
    (fit,) = robust_fits(robot[None], poses.camera.poses()[None], STARTS)
    assert len(wrong) == 6
    assert sorted(fit.kept) == [at for at in range(20) if at not in wrong]


@pytest.mark.slow
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
def test_impossible_rotations_are_named(side, rows):
    poses = cell_poses()
    few = sound(poses.true_robot[:rows], poses.camera.poses()[:rows], poses.mount)
    wrong = getattr(few, side)
    wrong = replace(wrong, rotations=3.0 * wrong.rotations)
    guess = guessed(replace(few, **{side: wrong}, is_measured=False))
    assert not guess.stands_out
    assert not guess.declared.fit.is_readable
    assert "are none" in guess.sentence


@lru_cache(maxsize=3)
def cell_poses(mount="eye-in-hand", views=14):
    """The poses of a cell with the noise of a fair robot, its lens estimated."""
    return seen_in(simulate(replace(FAIR, mount=mount, views=views)))


def plant(name, poses, seed=0):
    return MISTAKES[name](poses, np.random.default_rng(seed))


def misread(rotation, unit, declared):
    """The robot's poses written in one form, and read as another."""

    def make(poses):
        return replace(poses, robot=numbers(poses.true_robot, rotation, unit).read_as(declared))

    return make


def stored(rotation, taken):
    """The same, and kept as the quaternions of what was read."""

    def make(poses):
        read = numbers(poses.true_robot, rotation, "m").read_as(Reading(taken))
        return replace(poses, robot=PoseNumbers.of_poses(read.poses(), read.places))

    return make


def few(poses):
    return sound(poses.true_robot[:4], poses.camera.poses()[:4], poses.mount)


def two_unseen(poses):
    camera = replace(poses.camera, positions=poses.camera.positions.copy())
    camera.positions[[1, 5]] = np.nan
    return replace(poses, camera=camera)


# Calibrating names exchanged rows by themselves. The seed draws which of a mistake's forms it is.
READINGS = [name for name in MISTAKES if name != "two rows exchanged"]
FORMS = ("quaternion w, x, y, z", "Euler ZYX taken for XYZ", "degrees and radians")
PLANTED = [
    *(
        (partial(plant, name, seed=MOUNTS.index(mount)), mount, 14)
        for name, mount in [*zip(READINGS, cycle(MOUNTS)), *zip(FORMS, cycle(MOUNTS[::-1]))]
    ),
    # The first seeds of each of five orders.
    *(
        (partial(plant, "rows in another order", seed=seed), MOUNTS[0], 14)
        for seed in (0, 1, 2, 11, 12)
    ),
    *((partial(plant, "numbers of rotations", seed=seed), MOUNTS[0], 14) for seed in range(6)),
    (misread("euler-ZYX-deg", "mm", Reading("euler-xyz-rad")), MOUNTS[0], 14),
    # KUKA's angles taken for FANUC's turn as the right ones do.
    *((stored("euler-ZYX-deg", "euler-xyz-deg"), mount, 14) for mount in MOUNTS),
    # Fewer than eleven rows are alike in several orders, which are no readings of their own.
    *(
        (misread("quaternion-wxyz", unit, Reading("quaternion-xyzw")), MOUNTS[0], 8)
        for unit in ("mm", "inch")
    ),
    (lambda poses: plant("rows shifted by one", few(poses)), MOUNTS[0], 14),
    (lambda poses: plant("rows shifted by one", two_unseen(poses)), MOUNTS[0], 14),
]


@pytest.mark.parametrize(("make", "mount", "views"), PLANTED)
def test_a_planted_mistake_is_named(make, mount, views):
    poses = make(cell_poses(mount, views))
    guess = guessed(poses)
    assert is_named(guess, poses), guess.sentence
    assert guess.best.words in guess.sentence
    assert guess.declared in guess.candidates
    seen = np.isfinite(poses.camera.positions).all(axis=1)
    assert len(guess.declared.of_rows) == seen.sum()
    if views == 8:
        tried = changes(guess.declared.hypothesis, is_measured=True, count=8)
        assert not any("sorted as text" in change.words for change in tried)


@pytest.mark.slow
@pytest.mark.parametrize(("order", "mount"), [("xyz", MOUNTS[0]), ("ZYZ", MOUNTS[1])])
def test_angles_in_degrees_that_lost_turns_are_named_and_not_made_up(tmp_path, mount, order):
    poses = cell_poses(mount)
    mistaken = misread(f"euler-{order}-deg", "m", Reading(f"euler-{order}-rad"))(poses)
    robot = mistaken.robot.poses()
    guess = guessed(replace(poses, robot=numbers(robot)))
    assert guess.stands_out
    # Angles about fixed axes are those about moving ones in reverse order.
    assert f"{'ZYX' if order == 'xyz' else order} about moving axes in degrees" in guess.sentence
    assert "taken for radians" in guess.sentence
    session = pairs_session(mount, robot, poses.camera.poses())
    session.save(tmp_path / "cell")
    (cause, *_) = visioncal.calibrate(session).verdict.causes
    assert "degrees=True" in cause.do.words
    assert not cause.do.command
    done = typed("convert", tmp_path / "cell", tmp_path / "fixed", "--guess", "--yes")
    assert done.status == 2
    assert "lost whole turns" in done.said


def test_both_sides_in_millimetres_and_inverse_poses_of_the_camera_are_read_right():
    poses = cell_poses()
    camera, reported = (
        numbers(side, unit="mm").read_as(Reading())
        for side in (poses.camera.poses(), poses.true_robot)
    )
    guess = guess_reading(reported, camera, poses.mount)
    best = guess.best.hypothesis
    assert guess.stands_out
    # It shows by where cameras can be.
    assert (best.robot.reading.unit, best.camera.reading.unit) == ("mm", "mm")
    guess = guess_reading(poses.robot, numbers(invert(poses.camera.poses())), poses.mount)
    assert guess.stands_out
    # Another mount closes the chain as well: the note says so whichever is chosen.
    for words in ("camera's poses inverse", "mounted"):
        assert any(words in name for name in (guess.best.words, *guess.notes))
    with pytest.raises(DegenerateError, match="3 rows have"):
        guess_reading(numbers(poses.true_robot[:3]), numbers(poses.camera.poses()[:3]), "")


@pytest.mark.slow
def test_two_readings_that_close_alike_are_both_named_and_none_is_taken(tmp_path):
    poses = cell_poses(views=14)
    turned = np.linalg.inv(poses.true_robot[:, :3, :3])
    x, y, z, w = Rotation.from_matrix(turned).as_quat().T
    # Inverse rotations, whose numbers x, y, z, w stand under the names w, x, y, z.
    wrong = compose(
        Rotation.from_quat(np.stack([y, z, w, x], axis=1)).as_matrix(), poses.true_robot[:, :3, 3]
    )
    guess = guessed(replace(poses, robot=numbers(wrong)))
    assert guess.is_open
    assert not guess.stands_out
    assert "Nothing decides between these" in guess.sentence
    assert "y, z, w, x" in guess.sentence
    assert "positions taken as" in guess.sentence
    session = pairs_session(poses.mount, wrong, poses.camera.poses())
    (cause, *_) = visioncal.calibrate(session).verdict.causes
    assert cause.kind == "misread_poses"
    assert "--robot-form" in cause.do.words
    session.save(tmp_path / "cell")
    done = typed("convert", tmp_path / "cell", tmp_path / "fixed", "--guess", "--yes")
    assert "Look how the program wrote the poses" in done.refused("close as first read").err
    assert not guessed(poses).is_open


@pytest.mark.slow
def test_turns_that_agree_beside_places_that_do_not_are_those_of_a_wrong_arm():
    poses = cell_poses(views=20)
    robot = poses.true_robot.copy()
    # A table of the arm with a wrong length: places are off along a link that turns with the arm.
    robot[:, :3, 3] += Rotation.from_rotvec(
        np.stack([np.zeros(20), *(2.0 * robot[:, at, 3] for at in (0, 1))], axis=1) * 3.0
    ).apply([0.25, 0.0, 0.0])
    session = pairs_session(poses.mount, robot, poses.camera.poses())
    verdict = visioncal.calibrate(session).verdict
    assert verdict.status == "bad"
    assert "wrong length or sign in the model or table" in verdict.causes[0].do.words


SOUND = {
    "fair": {},
    "four views": {"views": 4},
    "eight views, coarse robot": {"views": 8, "robot_sigma_m": 2e-3, "robot_sigma_rad": 5e-3},
    "small turns": {"tilt_rad": (0.0, 0.12), "roll_rad": 0.1, "robot_sigma_rad": 1e-3},
    "wrong views": {"wrong_views": 4, "views": 16},
    "another board": {"board_scale": 1.15, "board_bow_m": 1e-3},
    "worn arm": {"dh_sigma_m": 2e-3, "dh_sigma_rad": 5e-3},
    "one axis": TURNED_ONCE,
    "six views about one axis": TURNED_ONCE | {"views": 6},
    "no turns": {"motion": "translation", "robot_sigma_rad": 1e-3},
}


@pytest.mark.parametrize(
    ("world", "mount"),
    [
        slow(*pair) if pair[0] == "one axis" else pair
        for pair in zip(SOUND, cycle(MOUNTS), strict=False)
    ],
)
def test_sound_poses_are_not_accused(world, mount):
    poses = seen_in(simulate(replace(CellOptions(mount=mount, views=12), **SOUND[world])))
    guess = guessed(replace(poses, is_measured=mount == MOUNTS[0]))
    assert not guess.stands_out, guess.sentence
    assert guess.best is guess.declared
    if world == "one axis":
        guess = guessed(plant("inverse poses", poses))
        assert not guess.stands_out
        assert "cannot distinguish readings" in guess.sentence


@pytest.mark.slow
def test_the_advised_command_runs_as_printed_and_mends_the_session(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    planted = plant("the other mount", cell_poses())
    reported, seen = planted.robot.poses(), planted.camera.poses()
    pairs_session(planted.mount, reported, seen).save(Path("my cell"))
    followed = follow("calibrate", "my cell", "-o", "out")
    assert [run.status for run in followed.runs] == [3, 0]
    assert printed_commands(followed.runs[0].said)[0] == (
        "visioncal convert 'my cell' 'my cell-fixed' --guess --yes"
        " && visioncal calibrate 'my cell-fixed' -o out"
    )
    assert Calibration.load(Path("out/calibration.json")).verdict.status == "good"


@pytest.mark.parametrize("mount", MOUNTS)
def test_another_sign_of_an_axis_of_the_targets_places_is_named_and_mended(
    tmp_path, monkeypatch, mount
):
    """As of pictures that were turned over, or of y upwards, beside turns that are right."""
    monkeypatch.chdir(tmp_path)
    poses = cell_poses(mount)
    seen = poses.camera.poses()
    seen[:, 1, 3] *= -1.0
    pairs_session(mount, poses.true_robot, seen).save(Path("cell"))
    followed = follow("calibrate", "cell", "-o", "out")
    assert [run.status for run in followed.runs] == [3, 0]
    assert "With another sign of y in the camera's positions" in followed.runs[0].said


@pytest.mark.slow
def test_positions_and_rotations_that_two_signs_may_belong_to_are_both_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    poses = cell_poses()
    wrong = poses.true_robot * np.array([[1, 1, 1, -1], [1, 1, 1, -1], [1, 1, 1, 1], [0, 0, 0, 1]])
    pairs_session(poses.mount, wrong, poses.camera.poses()).save(Path("cell"))
    followed = follow("calibrate", "cell", "-o", "out")
    assert [run.status for run in followed.runs] == [3, 0]
    assert "--positions 0-13:-x,-y,z" in followed.runs[0].said
    assert "another sign of x and y in the robot's rotations" in followed.runs[0].said
    done = typed("convert", "cell", "other", "--guess", "--yes")
    assert "--positions" in done.refused("close as first read").err


@pytest.mark.slow
def test_of_readings_that_close_half_of_the_rows_the_likelier_cell_is_taken():
    """A wrong mount looks as inverse poses do; the last rows are those of one row before."""
    cell = simulate(CellOptions(views=14, mount="eye-to-hand"))
    robot, seen = cell.robot.base_from_flange, cell.cam_from_target
    late = np.concatenate([robot[:8], np.roll(robot[8:], 1, axis=0)])
    best = guessed_of(late, seen).best
    assert best.hypothesis.changes == ("the camera mounted eye-to-hand",)
    assert best.fit.agreeing == 8


def guessed_of(robot, seen) -> Guess:
    """The guess of poses that images show, of a camera that is said to be on the flange."""
    places = (*map(str, range(len(robot))),)
    numbers = [PoseNumbers.of_poses(side, places) for side in (robot, seen)]
    return guess_reading(*numbers, "eye-in-hand", is_measured=True)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3, 4])
def test_another_size_that_leaves_most_of_a_misfit_is_no_cause(seed):
    """A tool longer by 150 mm in the later rows, from farther away, looks as a larger board."""
    rng, count = np.random.default_rng(seed), 22
    turns = np.column_stack([rng.normal(0.0, [0.25, 0.25, 0.6], (count, 3)), np.zeros((count, 3))])
    seen = exp(turns) @ compose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    far = np.where(np.arange(count) < 8, 0.7 + 0.1 * (seed == 0), 0.9)
    seen[:, :3, 3] = rng.normal(0.0, 0.03, (count, 3)) + far[:, None] * [0.0, 0.0, 1.0]
    base_from_target = exp(np.array([0.1, 0.2, 0.3, 0.5, 0.1, 0.0]))
    robot = base_from_target @ invert(compose(np.eye(3), np.array([0.02, 0.03, 0.09])) @ seen)
    robot = robot @ exp(rng.normal(0.0, 1e-4, (count, 6)))
    robot[8:] = robot[8:] @ compose(np.eye(3), np.array([0.0, 0.0, 0.15]))
    robot[3, 1, 3] += 0.02
    guess = guessed_of(robot, seen)
    assert not guess.stands_out
    assert not guess.is_open


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["rotations", "poses", "positions"])
def test_poses_that_were_never_recorded_are_named(lost):
    poses = cell_poses()
    reported = poses.robot.poses()
    if lost == "positions":
        reported[:, :3, 3] = 0.0
    else:
        reported[:, :3, :3] = np.eye(3)
    if lost == "poses":
        reported[:] = reported[0]
    session = pairs_session(poses.mount, reported, poses.camera.poses())
    one_place = "all rows have one position of the robot"
    if lost == "positions":
        verdict = visioncal.calibrate(session).verdict
        assert verdict.status == "bad"
        assert one_place in verdict.reasons[0]
        assert "how the poses were recorded" in verdict.reasons[0]
        return
    caught = raised(DegenerateError, "are not those of the images", visioncal.calibrate, session)
    assert (one_place in caught.message) is (lost == "poses")
    assert "how the poses were recorded" in caught.next_step


ROBOT = load_robot("ur5e")
CELL = simulate(
    CellOptions(
        camera=CAMERAS["fine"],
        pixel_sigma_px=0.1,
        robot="ur5e",
        views=16,
        dh_sigma_m=5e-4,
        dh_sigma_rad=1e-3,
        seed=4,
    )
)
Q, POSES = CELL.robot.joints, CELL.robot.base_from_flange
# An encoder that lost ten degrees.
LOST = np.deg2rad([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])


def session_with(joints=Q, poses=POSES, robot=ROBOT.document, *, with_poses=True) -> Session:
    """The session of the cell with these joints, poses and model of its robot."""
    session = Session.from_corners(
        [(seen.ids, seen.px) for seen in CELL.corners],
        poses,
        CELL.options.target,
        CELL.options.camera.resolution,
        camera=CELL.options.camera,
        robot="ur5e",
        q=joints,
    )
    views = session.views if with_poses else [without_pose(view) for view in session.views]
    return replace(session, robot_document=robot, views=tuple(views))


def without_pose(view):
    return replace(view, numbers={f"q{at}_rad": view.numbers[f"q{at}_rad"] for at in range(1, 7)})


# Beside poses, and where joints are all that there is.
SLIPS = {
    "joints in degrees": ({"joints": np.rad2deg(Q)}, "the angles in degrees"),
    "two columns exchanged": (
        {"joints": Q[:, [0, 1, 4, 3, 2, 5]], "with_poses": False},
        "q3_rad and q5_rad exchanged",
    ),
    "a joint's sign": ({"joints": Q * [1, 1, -1, 1, 1, 1]}, "q3_rad of the opposite sign"),
    "a joint's angle with another's in it": (
        {"joints": Q + np.outer(Q[:, 1], np.eye(6)[2])},
        "q3_rad less q2_rad for the third joint",
    ),
    "two joints from another zero": (
        {"joints": Q - np.pi / 2 * np.array([0, 1, 0, -1, 0, 0])},
        "+90 deg added to q2_rad and -90 deg added to q4_rad",
    ),
    "base_link for base": (
        {"poses": np.diag([-1.0, -1.0, 1.0, 1.0]) @ POSES},
        "base_link was taken for base",
    ),
    "poses of a tool": (
        {"poses": POSES @ exp(np.array([0.2, 0.4, -0.3, 0.0, 0.05, 0.12]))},
        "The reported poses are of a tool frame",
    ),
    "the other convention": (
        {"robot": {**ROBOT.document, "convention": "modified"}},
        "read as standard",
    ),
    "the arm before this one": (
        {"robot": load_robot("ur5").document, "with_poses": False},
        "the arm a ur5e and not a ur5",
    ),
    "an encoder's zero": ({"joints": Q - LOST}, "moved by 10.00 deg"),
    "an encoder's zero in both": (
        {"joints": Q - LOST, "poses": ROBOT.base_from_flange(Q - LOST)},
        "zero of elbow_joint",
    ),
    "two rows exchanged": (
        {"joints": Q[[0, 1, 7, 3, 4, 5, 6, 2, *range(8, 16)]]},
        "disagree in view 2, view 7",
    ),
}


@pytest.mark.parametrize(
    "name", [slow(name) if name == "an encoder's zero in both" else name for name in SLIPS]
)
def test_slips_are_named(name):
    changes, words = SLIPS[name]
    assert words in str(visioncal.doctor(session_with(**changes)))


# A model of an earlier calibration, where the controller computes with the nominal one.
IDENTIFIED = ROBOT.corrected(
    np.random.default_rng(0).normal(0.0, np.repeat([5e-4, 3e-4], 3), (7, 6))
)


@pytest.mark.parametrize(
    "changes",
    [
        {"poses": exp(np.array([0.0, 0.0, 1.2, 0.4, -0.7, 0.3])) @ POSES},
        {"robot": {**IDENTIFIED.document, "name": "mine"}},
        {"poses": CELL.robot.true_base_from_flange},
    ],
    ids=["in the world", "identified", "as built"],
)
def test_sound_sessions_raise_no_alarm(changes):
    found = visioncal.doctor(session_with(**changes))
    assert found.is_sound, str(found)


def test_joints_alone_that_are_misread_are_refused_with_the_fix():
    session = session_with(Q * [1, 1, -1, 1, 1, 1], with_poses=False)
    error = raised(DataError, "opposite sign, they fit", visioncal.calibrate, session)
    assert "not those of ur5e" in error.message
    assert error.culprits == ("views.csv: q3_rad",)
    assert error.next_step.startswith("Negate q3_rad")


@pytest.mark.slow
def test_with_poses_the_hand_eye_goes_on_without_misread_joints():
    session = session_with(np.rad2deg(Q))
    views = list(session.views)
    views[3] = without_pose(views[3])
    session = replace(session, views=tuple(views))
    found = visioncal.calibrate(session)
    assert found.arm is None
    assert found.verdict.status != "good"
    assert any("pi / 180" in reason for reason in found.verdict.reasons)
    assert "joint angles are misread" in found.views[3].reason
    poses_only = visioncal.calibrate(replace(session, robot_document=None))
    # What is done with the poses is what would be done if there were no joints.
    for name, edge in found.edges.items():
        np.testing.assert_array_equal(edge.matrix, poses_only.edges[name].matrix)
    words = "needs the joint angles"
    error = raised(DataError, words, visioncal.calibrate, session, level="kinematics")
    assert "multiply q1_rad to q6_rad by pi / 180" in error.next_step


def test_a_zero_that_is_a_quarter_turn_off_is_no_other_mistake_of_the_poses():
    joints = Q - [0, np.pi / 2, 0, 0, 0, 0]
    first, *others = visioncal.calibrate(session_with(joints, with_poses=False)).verdict.causes
    # Errors of the links are in it, too.
    words = "zero of shoulder_lift_joint (q2_rad) moved by "
    assert f"{words}89" in first.words or f"{words}90" in first.words
    assert not any("not those of the images" in cause.words for cause in others)


@pytest.mark.slow
def test_a_lost_encoder_is_named_and_estimated_with_the_arm():
    joints = Q - LOST
    result = visioncal.calibrate(session_with(joints, ROBOT.base_from_flange(joints)))
    nominal, found = result.arm.levels
    assert nominal.held_out_mm > 10.0
    assert found.held_out_mm < 0.5
    assert result.verdict.status == "check"
    assert result.verdict.causes[0].kind == "misread_joints"
    assert result.verdict.causes[0].do.words.startswith("Home elbow_joint anew")
    # What is seen of the target hardly depends on whose errors the last tenths of a degree are.
    found, true = result.base_from_flange(joints).as_matrix(), CELL.robot.true_base_from_flange
    moved, moves = invert(found[:-1]) @ found[1:], invert(true[:-1]) @ true[1:]
    away = np.linalg.norm((moved - moves)[:, :3, 3], axis=1)
    assert np.median(away) < 1e-3


@pytest.mark.slow
def test_one_row_of_wrong_joints_costs_its_view_alone():
    joints = Q.copy()
    joints[5, 1] += 0.3
    result = visioncal.calibrate(session_with(joints))
    assert [view.view for view in result.arm.left_out] == [at for at in range(16) if at != 5]
    assert result.arm.level == "geometry"
    assert result.views[5].reason.endswith("with which the camera agrees")


def test_joints_are_judged_by_their_fit():
    robot, joints = ROBOT, Q

    def guess(angles, q=joints, arm=robot):
        return guess_joints(arm, angles, arm.base_from_flange(q))

    # Joints of many arms turn by two turns either way: these are no degrees.
    assert not guess(joints + 2.0 * np.pi * np.where(joints > 0.0, -1.0, 1.0)).stands_out
    # Poses that turn about one axis accuse nobody.
    q = np.tile(joints[0], (12, 1))
    q[:, 5] += np.linspace(-1.0, 1.0, 12)
    assert not guess(q * [1, 1, -1, 1, 1, -1], q).stands_out
    # Two that never move, and stand alike: exchanged with a third they are the same.
    q = joints.copy()
    q[:, 1] = q[:, 4] = -1.2
    found = guess(q[:, [0, 2, 1, 3, 4, 5]], q)
    assert found.stands_out
    assert "q2_rad and q3_rad exchanged" in found.sentence("the reported poses")
    # A table whose zeros are where the arm works: all angles are within a few degrees.
    middle = joints.mean(axis=0)
    arm = robot.corrected(functions=np.pad(middle[:, None], ((0, 0), (0, 3))))
    near = 0.1 * (joints - middle)
    assert np.abs(np.rad2deg(near)).max() < 13.0
    assert not guess(near, near, arm).stands_out
    assert guess(np.rad2deg(near), near, arm).best.reading.words == "the angles in degrees"
    # One share of all angles is of their unit, and of one joint of its gear.
    found = guess(joints * 1.01)
    assert found.sentence("the poses").startswith("With all angles 0.99 % smaller, they fit")
    found = guess(joints * [1, 1, 1, 1.02, 1, 1])
    assert found.sentence("the poses").startswith("With q4_rad 1.96 % smaller, they fit")
    assert "by 0.98039 in all rows" in found.fix
    # Arms move with their base.
    base = exp(np.array([0.2, -0.1, 0.4, 0.3, 0.1, -0.2]))
    for arm in (robot, robot.corrected()):
        moved = with_base(arm, base).base_from_flange(joints)
        assert moved == pytest.approx(base @ arm.base_from_flange(joints), abs=1e-12)


@pytest.mark.parametrize(("factor", "arm"), [(0.75, "ur5e"), (1.25, "ur20")])
def test_a_board_of_another_size_makes_no_other_arm(factor, arm):
    rng, declared = np.random.default_rng(5), load_robot("ur10e")
    x, z = exp(np.array([0.3, 0.1, -0.2, 0.05, 0.1, 0.9])), exp(np.array([0, 0.2, 0, 0.1, 0, 0.1]))
    q = np.array([0.2, -1.4, 1.8, -1.9, -1.5, 0.3]) + rng.uniform(-0.4, 0.4, (16, 6))
    seen = x @ declared.base_from_flange(q) @ z @ exp(rng.normal(0, 1e-4, (16, 6)))
    seen[:, :3, 3] *= factor
    assert not guess_joints(declared, q, seen).stands_out
    # Another arm is one, still.
    found = guess_joints(declared, q, x @ load_robot(arm).base_from_flange(q) @ z)
    assert found.best.reading.words == f"the arm a {arm} and not a ur10e"


JOINTS = tuple(f"q{at}_rad" for at in range(1, 7))


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return write_session(simulate(CellOptions(views=12, seed=4)), tmp_path / "cell", images=False)


def converted(source, dest, *more):
    return typed("convert", source, dest, "--guess", *more)


def save_corners(cell, corners, folder):
    """Saves a session of the poses of a cell, a camera in hand, beside other corners."""
    Session.from_corners(
        corners,
        cell.robot.base_from_flange,
        replace(cell.options.target, square_sigma_m=1e-7),
        cell.stated[""].resolution,
        mount="eye-in-hand",
    ).save(folder)


@pytest.mark.slow
def test_poses_are_mirrored_only_when_that_is_asked_for(tmp_path):
    cell = simulate(CellOptions(views=18, seed=3))
    width = cell.stated[""].resolution[0]
    mirrored = [(seen.ids, seen.px * [-1, 1] + [width - 1, 0]) for seen in cell.corners]
    save_corners(cell, mirrored, tmp_path / "cell")
    done = typed("calibrate", tmp_path / "cell", "-o", tmp_path / "out")
    # Mirrored images fit as well, and no reading of the poses helps these.
    assert "Look at an image first: where it is mirrored" in done.said
    assert "--mirror-poses" in done.said
    assert not any("--guess" in command for command in printed_commands(done.said))
    converted(tmp_path / "cell", tmp_path / "fixed", "--yes").refused(
        "mirrored images are the usual cause"
    )
    assert not (tmp_path / "fixed").exists()
    converted(tmp_path / "cell", tmp_path / "fixed", "--yes", "--mirror-poses").good()
    fixed = Session.load(tmp_path / "fixed")
    assert "left-handed frame" in fixed.declaration.corrected[0]
    # Of mirrored corners the board is still seen from behind.
    assert visioncal.calibrate(fixed).verdict.status == "check"
    mend = next(command for command in printed_commands(done.said) if "--mend-images" in command)
    assert mend.count("cell-fixed") == 2
    typed("convert", tmp_path / "cell", tmp_path / "mended", "--mend-images").good()
    mended = Session.load(tmp_path / "mended")
    assert [*mended.declaration.corrected] == ["the corners of all views were mirrored back"]
    assert visioncal.calibrate(mended).verdict.status == "good"


def test_poses_are_left_handed_where_markers_show_that_images_are_not_mirrored(tmp_path):
    cell = simulate(CellOptions(camera=SMALL, blur_px=0.5, views=14, seed=3))
    write_session(cell, tmp_path / "cell")
    # In a frame whose y points the other way.
    turned = [POSE[at] for at in (1, 3, 5)]
    rewritten(
        tmp_path / "cell", lambda _, row: row | {name: repr(-float(row[name])) for name in turned}
    )
    done = typed("calibrate", tmp_path / "cell", "-o", tmp_path / "out")
    assert "With the robot's poses in a left-handed frame" in done.said
    assert "images mirrored" not in done.said
    command = printed_commands(done.said)[0]
    assert "--guess --yes --mirror-poses" in command
    typed("convert", tmp_path / "cell", tmp_path / "mended", "--mend-images").refused("mirrored")
    converted(tmp_path / "cell", tmp_path / "fixed", "--yes", "--mirror-poses").good()
    assert visioncal.calibrate(tmp_path / "fixed").verdict.status == "good"


def test_corner_numbers_of_another_program_are_no_proof_that_images_are_not_mirrored(tmp_path):
    """Pictures and numbers are mirrored, so that the board seems seen from its front."""
    cell = simulate(CellOptions(views=14, seed=3))
    (width, _), inner = cell.stated[""].resolution, cell.options.target.columns - 1
    corners = []
    for seen in cell.corners:
        ids = seen.ids // inner * inner + inner - 1 - seen.ids % inner
        px, order = np.abs([width - 1.0, 0.0] - seen.px), np.argsort(ids)
        corners.append((ids[order], px[order]))
    save_corners(cell, corners, tmp_path / "cell")
    done = typed("calibrate", tmp_path / "cell", "-o", tmp_path / "out")
    assert "images mirrored, or the robot's poses in a left-handed frame" in done.said
    assert "Look at an image first" in done.said
    assert not any("--guess" in command for command in printed_commands(done.said))
    typed("convert", tmp_path / "cell", tmp_path / "mended", "--mend-images").good()


def test_an_unknown_robot_is_named_with_the_correction(cell):
    document = cell / "session.toml"
    document.write_text(document.read_text("utf-8").replace('"ur10e"', '"ur10ee"'), "utf-8")
    found = visioncal.doctor(cell).findings[0]
    assert found.kind == "misread_joints"
    assert "There is no robot named 'ur10ee'. Did you mean ur10e" in found.words
    assert found.do.words.startswith("Correct the robot's model in session.toml")
    # Without poses there is no result, and that is why.
    rewritten(cell, lambda _, row: row | dict.fromkeys(POSE, ""))
    with pytest.raises(DataError) as caught:
        visioncal.calibrate(cell)
    assert caught.value.message.startswith("session.toml: robot.model: There is no robot named")
    assert caught.value.next_step == found.do.words


@pytest.mark.parametrize("moved", [(*POSE, *JOINTS), POSE], ids=["both", "poses alone"])
def test_columns_of_one_log_change_rows_together(cell, tmp_path, moved):
    views = Session.load(cell).views
    later = [*views[1:], views[0]]
    rewritten(cell, lambda at, row: row | {name: later[at].cell(name) for name in moved})
    converted(cell, tmp_path / "fixed", "--yes").good()
    fixed = Session.load(tmp_path / "fixed").views
    for names in (POSE, JOINTS):
        found = {view.number: view for view in fixed if names[0] in view.numbers}
        # One row at the end has lost its partner; the rest are the numbers that were written.
        assert len(found) == len(views) - (names[0] in moved)
        for number, view in found.items():
            wanted = [views[number].numbers[name] for name in names]
            assert [view.numbers[name] for name in names] == pytest.approx(wanted, abs=1e-15)


@pytest.mark.slow
def test_nothing_is_written_without_a_word_or_a_reading(cell, tmp_path):
    done = converted(cell, tmp_path / "same", "--yes").good()
    assert "fit as first read" in done.err
    assert Session.load(tmp_path / "same").digest() == Session.load(cell).digest()
    rewritten(cell, lambda _, row: row | {at: repr(1e3 * float(row[at])) for at in POSE[:3]})
    converted(cell, tmp_path / "fixed").refused("the robot's positions in mm", "--yes")
    assert not (tmp_path / "fixed").exists()
    converted(cell, tmp_path / "mended", "--yes").good()
    same, mended = (Session.load(tmp_path / name).views for name in ("same", "mended"))
    for old, new in zip(same, mended, strict=True):
        assert new.text == old.text
        for pose in (View.base_from_flange, View.cam_from_target):
            # Multiplied by 1000 and divided again, each rounded once.
            matrices = [pose(view).as_matrix() for view in (old, new)]
            np.testing.assert_allclose(*matrices, atol=1e-14)
    turns = np.random.default_rng(0).normal(size=(12, 4))
    turns = (turns / np.linalg.norm(turns, axis=1, keepdims=True)).tolist()
    rewritten(cell, lambda at, row: row | dict(zip(POSE[3:], map(repr, turns[at]), strict=True)))
    converted(cell, tmp_path / "fixed", "--yes").refused("no other reading stands out")
    assert not (tmp_path / "fixed").exists()


@pytest.mark.parametrize("with_poses", [False, True], ids=["joints alone", "both"])
def test_a_shift_moves_the_joints(tmp_path, with_poses):
    """In a log in which the robot's rows are one late."""
    joints = 0.5 * np.random.default_rng(1).normal(size=(12, 6)) + [0, -1.5, 1.5, -1.5, -1.5, 0]
    poses = load_robot("ur5e", None).base_from_flange(joints)
    x = exp(np.array([0.1, 0.2, 1.5, 0.03, 0.02, 0.08]))
    late = np.array([0, *range(11)])
    keyed = {
        "joints": joints[late],
        "camera_pose": invert(poses @ x) @ exp(np.array([0.1, 2, 0.5, 1, 0.2, 0])),
        **({"robot_pose": poses[late]} if with_poses else {}),
    }
    rows = [{name: value[at].tolist() for name, value in keyed.items()} for at in range(12)]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    options = ImportOptions(mount="eye-in-hand", robot_model="ur5e")
    foreign = read_foreign(tmp_path / "log.json", options)
    session = assemble(foreign)
    for recorded in (DoubtfulSession.of(foreign), DoubtfulSession(session)):
        guess = recorded.guess()
        assert guess.stands_out
        fixed = reread(recorded, guess.best)
        found = [view.joints_rad for view in fixed.views]
        # The last row's robot was never logged, and the first one's twice.
        np.testing.assert_array_equal(found[:-1], joints[:-1])
        assert found[-1] is None
        assert fixed.digest() != session.digest()
        assert any("read otherwise" in warning for warning in fixed.warnings)
    if not with_poses:
        best = guess.best.hypothesis
        inverse = replace(best, robot=replace(best.robot, inverse=True))
        with pytest.raises(DataError, match="known by its joint angles alone"):
            reread(DoubtfulSession.of(foreign), replace(guess.best, hypothesis=inverse))


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_another_mount_and_a_board_of_another_size_are_found_together(mount):
    poses = cell_poses(MOUNTS[1 - MOUNTS.index(mount)])
    camera = poses.camera.poses()
    camera[:, :3, 3] /= 1.16
    guess = guessed(replace(poses, mount=mount, camera=numbers(camera)))
    assert guess.stands_out, guess.sentence
    assert guess.best.hypothesis.mount == poses.mount
    # The start of a fit, which takes the rest: views of 0.1 px tell a size to less than a percent.
    assert guess.best.board_scale == pytest.approx(1.16, rel=0.01)
    assert "the board 1.1" in guess.sentence


def test_distances_that_are_several_times_too_long_are_mended_by_the_printed_command(
    tmp_path, monkeypatch
):
    poses = cell_poses("eye-to-hand")
    camera = poses.camera.poses()
    camera[:, :3, 3] *= 5.714
    pairs_session("eye-to-hand", poses.true_robot, camera).save(tmp_path / "cell")
    monkeypatch.chdir(tmp_path)
    followed = follow("calibrate", "cell", "-o", "out")
    assert "times as large" in followed.runs[0].out
    assert followed.last.status == 0
    # Nobody measured the size.
    assert Session.load("cell-fixed").document["camera"]["scale_sigma"] == 0.01
    x = Calibration.load(tmp_path / "out").transforms["base_from_cam"].as_matrix()
    true = SOLVERS["park"](invert(poses.true_robot), poses.camera.poses()).x
    # Two fits of the same poses differ by less than their noise of half a millimetre.
    assert np.linalg.norm(x[:3, 3] - true[:3, 3]) < 1.5e-3


def test_rivals_of_a_symmetric_board_turn_as_the_robot_does():
    poses, half = cell_poses(views=14), np.diag([-1.0, -1.0, 1.0])
    seen = poses.camera.poses()[:, None, :3, :3]
    rivals = np.concatenate([seen, seen @ half], axis=1)
    mixed = np.random.default_rng(3).integers(0, 2, len(rivals))
    rivals = rivals[np.arange(len(rivals))[:, None], [[one, 1 - one] for one in mixed]]
    chosen = in_one_turn(poses.true_robot[:, :3, :3], rivals)
    assert chosen is not None
    # All of them may be turned, which is another frame of the board.
    assert len({*(chosen ^ mixed).tolist()}) == 1


@pytest.mark.parametrize("mount", [slow(MOUNTS[0]), MOUNTS[1]])
def test_of_rivals_of_a_symmetric_board_those_are_where_the_robot_is(mount):
    """Beside rotations that were made of a rotation vector, taken for roll, pitch and yaw."""
    poses, half = cell_poses(mount, views=14), np.diag([-1.0, -1.0, 1.0, 1.0])
    half[:2, 3] = 0.1, 0.06
    mixed = np.random.default_rng(3).integers(0, 2, 14)
    seen = poses.camera.poses()
    rivals = np.stack([seen, seen @ half], axis=1)
    rivals = rivals[np.arange(14)[:, None], [[one, 1 - one] for one in mixed]]
    vectors = Rotation.from_matrix(poses.true_robot[:, :3, :3]).as_rotvec()
    turned = Rotation.from_euler("xyz", vectors).as_matrix()
    assert in_one_turn(turned, rivals[..., :3, :3]) is None
    chosen = in_one_place(1e3 * poses.true_robot[:, :3, 3], rivals, mount)
    assert len({*(chosen ^ mixed).tolist()}) == 1
    robot = numbers(compose(turned, poses.true_robot[:, :3, 3]))
    guess = guessed(replace(poses, robot=robot, camera=numbers(rivals[np.arange(14), chosen])))
    assert "rotation vector" in guess.sentence
    assert "taken for Euler angles" in guess.sentence


@pytest.mark.parametrize(
    ("mount", "share", "by"),
    [(MOUNTS[0], 30, -1), slow(MOUNTS[1], 20, 1), slow(MOUNTS[1], 8, -1)],
)
def test_poses_that_were_read_on_the_way_are_named_with_the_share_of_it(mount, share, by):
    """Of a tracker, whose sightings have no image: each pose is between where the arm stood."""
    rng = np.random.default_rng(3)
    spread = rng.normal(size=(24, 6)) * np.repeat([0.5, 0.15], 3)
    stood = exp(spread + np.array([3.0, 0.0, 0.0, 0.6, 0.0, 0.4]))
    edges = exp(np.array([[0.1, 0.2, -1.5, 0.03, 0.05, 0.1], [3.0, 0.1, 0.2, 1.2, 0.1, 0.0]]))
    noise = exp(rng.normal(size=(24, 6)) * np.repeat([5e-4, 2e-4], 3))
    others = stood[np.clip(np.arange(24) + by, 0, 23)]
    read = stood @ exp(0.01 * share * log(invert(stood) @ others))
    carrying = stood if mount == MOUNTS[0] else invert(stood)
    seen = invert(carrying @ edges[0]) @ edges[1] @ noise
    (cause, *_) = visioncal.calibrate(pairs_session(mount, read, seen)).verdict.causes
    assert cause.kind == "misread_poses"
    words = "The arm moved between image and pose: with each pose moved away from the "
    assert f"{words}{'next' if by > 0 else 'last'} stop by {share} % of the way" in cause.words
