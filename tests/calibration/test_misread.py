"""Poses, joints and rows that are misread: named, and sound ones left alone; `convert --guess`."""

import csv
import json
import shlex
import tracemalloc
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial, reduce
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.advice import printed_commands
from support.cells import known_of, pairs_session, session_of
from support.commands import visioncal as typed
from support.foreign_samples import easy_handeye_file
from support.fuzz.mistakes import (
    HALF_TURNS,
    MISTAKES,
    OTHER,
    Poses,
    numbers,
    sound,
)
from support.marks import slow
from support.refusals import raised
from typer.testing import CliRunner

import visioncal
from visioncal.calibration.guess import Guess, guess_reading
from visioncal.calibration.guess.joints import guess_joints
from visioncal.calibration.guess.readings import changes
from visioncal.calibration.pipeline.guess_inputs import chain_poses
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.cameras import detect_targets
from visioncal.calibration.stages.joints import match_joints
from visioncal.calibration.stages.reported_poses import reported_poses
from visioncal.cli.app import app
from visioncal.core.conventions import Reading
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import MOUNTS, FloatArray
from visioncal.estimation.closed_form import SOLVERS
from visioncal.interchange.formats import (
    DoubtfulSession,
    ImportOptions,
    assemble,
    read_foreign,
    reread,
)
from visioncal.results import Calibration
from visioncal.robot import (
    Robot,
    load_robot,
    read_robot_document,
    with_base,
)
from visioncal.session import Session, View
from visioncal.session.columns import POSE
from visioncal.simulation import (
    CellOptions,
    SimulatedCell,
    fine_camera,
    project,
    simulate,
    wide_camera,
    write_session,
)
from visioncal.vision.targets import corner_positions, load_target

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
# The generation before each arm.
BEFORE = {"ur3e": "ur3", "ur5e": "ur5", "ur10e": "ur10"}


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What a session tells of its robot."""

    cell: SimulatedCell  # What was seen.
    joints: FloatArray  # (m, n) joint angles as told.
    # (m, 4, 4) `base_from_flange` as told; None where joints are all there is.
    poses: FloatArray | None
    robot: Mapping[str, Any] | None  # The model's description; None where none is named.
    words: str = ""  # What has to be said about it; empty where nothing is wrong.

    @classmethod
    def of(cls, cell: SimulatedCell, *, with_poses: bool) -> "Identifiability":
        """A sound session."""
        poses = cell.robot.base_from_flange if with_poses else None
        return cls(cell, cell.robot.joints, poses, read_robot_document(cell.options.robot))

    @property
    def session(self) -> Session:
        """The session, its images not rendered."""
        views = []
        for at, row in enumerate(self.joints):
            numbers = {f"q{joint + 1}_rad": float(value) for joint, value in enumerate(row)}
            if self.poses is not None:
                turn = Rotation.from_matrix(self.poses[at, :3, :3]).as_quat()
                numbers |= dict(zip(POSE, [*self.poses[at, :3, 3], *turn], strict=True))
            views.append(View(at, image=f"{at}.png", numbers=numbers))
        return replace(session_of(self.cell), views=tuple(views), robot_document=self.robot)

    def known(self, **changes) -> Iterator[RunState]:
        """What is known after each stage; detection is given."""
        known = RunState(self.session, **changes)
        for stage in STAGES:
            if stage.name == "detect":
                known = detect_targets(
                    known, {view_corners.view: view_corners for view_corners in self.cell.corners}
                )
            else:
                known = stage.run(known)
            yield known

    def seen(self) -> RunState:
        """What is known once the joints were looked at."""
        return next(
            run_state
            for run_state, stage in zip(self.known(), STAGES, strict=False)
            if stage.name == "joints"
        )

    def said(self) -> str:
        """All that is said up to the stage that looks at the joints, errors included."""
        try:
            known = self.seen()
        except VisioncalError as error:
            return f"error: {error}"
        return " ".join(
            (*(warning.reason for warning in known.warnings), *known.notes, *known.reasons.values())
        )


Plant = Callable[[Identifiability, np.random.Generator], Identifiability]


def _degrees(told: Identifiability, _: np.random.Generator) -> Identifiability:
    return replace(told, joints=np.rad2deg(told.joints), words="the angles in degrees")


def _columns(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    pair = np.sort(rng.choice(told.joints.shape[1], 2, replace=False))
    order = np.arange(told.joints.shape[1])
    order[pair] = pair[::-1]
    words = f"q{pair[0] + 1}_rad and q{pair[1] + 1}_rad exchanged"
    return replace(told, joints=told.joints[:, order], words=words)


def _sign(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    at = int(rng.integers(told.joints.shape[1]))
    signs = np.where(np.arange(told.joints.shape[1]) == at, -1.0, 1.0)
    return replace(told, joints=told.joints * signs, words=f"q{at + 1}_rad of the opposite sign")


def _base_link(told: Identifiability, _: np.random.Generator) -> Identifiability:
    poses = None if told.poses is None else HALF_TURN @ told.poses
    return replace(told, poses=poses, words="base_link was taken for base")


def _convention(told: Identifiability, _: np.random.Generator) -> Identifiability:
    """A standard table that is declared modified."""
    robot = {**told.robot, "convention": "modified"}
    return replace(told, robot=robot, words="read as standard")


def _generation(told: Identifiability, _: np.random.Generator) -> Identifiability:
    true = told.cell.options.robot
    words = f"the arm a {true} and not a {BEFORE[true]}"
    return replace(told, robot=read_robot_document(BEFORE[true]), words=words)


def _encoder(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """An encoder that lost ten degrees; where poses are told, they come from the same encoder."""
    at, sign = int(rng.integers(1, 5)), (-1.0, 1.0)[rng.integers(2)]
    zeros = np.zeros(told.joints.shape[1])
    zeros[at] = sign * np.deg2rad(10.0)
    robot = load_robot(told.cell.options.robot)
    joints = told.joints - zeros
    poses = None if told.poses is None else robot.base_from_flange(joints)
    return replace(told, joints=joints, poses=poses, words=f"zero of {robot.joint_names[at]}")


def _rows(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """The joints of two views exchanged, beside poses."""
    pair = np.sort(rng.choice(len(told.joints), 2, replace=False))
    order = np.arange(len(told.joints))
    order[pair] = pair[::-1]
    words = f"disagree in view {pair[0]}, view {pair[1]}"
    return replace(told, joints=told.joints[order], words=words)


SLIPS: Mapping[str, Plant] = {
    "joints in degrees": _degrees,
    "two columns exchanged": _columns,
    "a joint's sign": _sign,
    "base_link for base": _base_link,
    "the other convention": _convention,
    "the arm before this one": _generation,
    "an encoder lost 10 deg": _encoder,
    "two rows exchanged": _rows,
}


def slip_is_named(told: Identifiability) -> bool:
    """Whether what was planted is named."""
    return told.words in told.said()


def with_tool(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """Poses of a tool's tip."""
    tool = compose(Rotation.from_rotvec(rng.normal(0.0, 0.5, 3)).as_matrix(), rng.normal(0, 0.1, 3))
    return replace(told, poses=told.poses @ tool)


def in_the_world(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """Poses in a frame of the world, in which the arm stands somewhere."""
    turn = Rotation.from_euler("z", rng.uniform(0.3, 2.6)).as_matrix()
    return replace(told, poses=compose(turn, rng.uniform(-1.0, 1.0, 3)) @ told.poses)


def as_built(told: Identifiability, _: np.random.Generator) -> Identifiability:
    """Poses of a controller that knows how its own arm was built."""
    return replace(told, poses=told.cell.robot.true_base_from_flange)


def as_identified(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """A model of an earlier calibration; the controller computes with the nominal one."""
    robot = load_robot(told.cell.options.robot)
    errors = rng.normal(0.0, np.repeat([5e-4, 3e-4], 3), (robot.joint_count + 1, 6))
    return replace(told, robot={**robot.corrected(errors).document, "name": "mine"})


def with_stray_offset(told: Identifiability, rng: np.random.Generator) -> Identifiability:
    """A joint that was assembled two degrees off; the controller does not know."""
    zeros = np.zeros(told.joints.shape[1])
    zeros[rng.integers(len(zeros))] = np.deg2rad(2.0)
    joints = told.joints - zeros
    robot = load_robot(told.cell.options.robot)
    poses = None if told.poses is None else robot.base_from_flange(joints)
    return replace(told, joints=joints, poses=poses)


ALARMS = (
    "misread",
    "not those of",
    "base_link was taken",
    "are exchanged",
    "were left out: nothing tells",
    "was left out: nothing tells",
    "disagree",
)


def alarms(told: Identifiability) -> tuple[str, ...]:
    """What is said that accuses somebody's input."""
    said = told.said()
    return tuple(alarm for alarm in ALARMS if alarm in said)


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


def test_a_mount_that_nothing_tells_is_asked_for():
    poses = cell_poses()
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
    poses = cell_poses()
    few = sound(poses.true_robot[:rows], poses.camera.poses()[:rows], poses.mount)
    wrong = getattr(few, side)
    wrong = replace(wrong, rotations=3.0 * wrong.rotations)
    guess = guessed(replace(few, **{side: wrong}, is_measured=False))
    assert not guess.stands_out
    assert not guess.declared.fit.is_readable
    assert "are none" in guess.sentence


def test_only_the_joints_tell_the_inverse_where_the_camera_is_far_from_the_flange():
    poses = cell_poses()
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
    (misread("euler-ZYX-deg", "mm", Reading("euler-xyz-rad")), MOUNTS[0], 14),
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


@pytest.mark.parametrize(("written", "read"), [("ZYX", "xyz"), ("xyz", "ZYX")])
def test_readings_with_the_same_poses_leave_nothing_open(written, read):
    # Angles of a KUKA read as those of a FANUC: several orders of turns undo that.
    poses = cell_poses()
    angles = Rotation.from_matrix(poses.true_robot[:, :3, :3]).as_euler(written)
    wrong = compose(Rotation.from_euler(read, angles).as_matrix(), poses.true_robot[:, :3, 3])
    guess = guess_reading(numbers(wrong), poses.camera, "eye-in-hand", is_measured=True)
    assert guess.stands_out, guess.sentence
    found = guess.best.hypothesis.robot_numbers(numbers(wrong))
    np.testing.assert_allclose(found.poses(), poses.true_robot, atol=1e-9)


def test_both_sides_in_millimetres_and_inverse_poses_of_the_camera_are_read_right():
    poses = cell_poses()
    camera, told = (
        numbers(side, unit="mm").read_as(Reading())
        for side in (poses.camera.poses(), poses.true_robot)
    )
    guess = guess_reading(told, camera, poses.mount)
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
        done = typed(*argv)
        assert done.status == 0, done.err
        fixed = Session.load(tmp_path / "fixed").views
        poses = [view.base_from_flange().as_matrix() for view in fixed]
        np.testing.assert_allclose(poses, told, atol=1e-9)


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


@pytest.mark.parametrize(("world", "mount"), list(zip(SOUND, cycle(MOUNTS), strict=False)))
def test_sound_poses_are_not_accused(world, mount):
    poses = seen_in(simulate(replace(CellOptions(mount=mount, views=12), **SOUND[world])))
    guess = guessed(replace(poses, is_measured=mount == MOUNTS[0]))
    assert not guess.stands_out, guess.sentence
    assert guess.best is guess.declared
    if world == "one axis":
        guess = guessed(plant("inverse poses", poses))
        assert not guess.stands_out
        assert "cannot distinguish readings" in guess.sentence


@pytest.mark.parametrize("name", [slow("board's size in mm"), "the other mount"])
def test_what_is_advised_runs_as_it_is_printed_and_mends_it(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    planted = plant(name, cell_poses())
    told, seen = planted.robot.poses(), planted.camera.poses()
    pairs_session(planted.mount, told, seen).save(Path("my cell"))
    done = typed("calibrate", "my cell", "-o", "out")
    assert done.status == 3, done.err
    first = done.said.split("What to do next:")[1].splitlines()[2].strip()
    assert first == (
        "visioncal convert 'my cell' 'my cell-fixed' --guess --yes"
        " && visioncal calibrate 'my cell-fixed' -o out"
    )
    for command in first.split(" && "):
        again = typed(*shlex.split(command)[1:])
        assert again.status == 0, again.err
    assert Calibration.load(Path("out/calibration.json")).verdict.status == "good"


@pytest.mark.parametrize(
    ("lost", "mount"),
    [
        ("rotations", "eye-in-hand"),
        ("poses", "eye-in-hand"),
        ("positions", "eye-in-hand"),
        slow("positions", "eye-to-hand"),
    ],
)
def test_what_was_never_recorded_is_named(lost, mount):
    poses = cell_poses(mount)
    told = poses.robot.poses()
    if lost == "positions":
        told[:, :3, 3] = 0.0
    else:
        told[:, :3, :3] = np.eye(3)
    if lost == "poses":
        told[:] = told[0]
    session = pairs_session(mount, told, poses.camera.poses())
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


OPTIONS = CellOptions(
    camera=fine_camera(),
    pixel_sigma_px=0.1,
    robot="ur5e",
    views=16,
    dh_sigma_m=5e-4,
    dh_sigma_rad=1e-3,
    seed=4,
)
CELLS = {name: simulate(replace(OPTIONS, mount=name)) for name in ("eye-in-hand", "eye-to-hand")}
IN_HAND = CELLS["eye-in-hand"]


def finished(told, **changes):
    """What is known at the end of the way."""
    return deque(told.known(**changes), maxlen=1).pop()


def planted(name, *, with_poses, seed=0):
    told = Identifiability.of(IN_HAND, with_poses=with_poses)
    return SLIPS[name](told, np.random.default_rng(seed))


# Beside poses, and where joints are all that there is; no camera tells how the base is turned, and
# exchanged rows are told by the rejection of views.
BESIDE_POSES = ("base_link for base", "two rows exchanged")


@pytest.mark.parametrize(
    ("name", "with_poses"),
    [(name, at % 2 == 0 or name in BESIDE_POSES) for at, name in enumerate(SLIPS)],
)
def test_slips_are_named(name, with_poses):
    mount = "eye-to-hand" if with_poses else "eye-in-hand"
    told = Identifiability.of(CELLS[mount], with_poses=with_poses)
    told = SLIPS[name](told, np.random.default_rng(int(with_poses)))
    assert slip_is_named(told), told.said()


@pytest.mark.parametrize(
    "change", [as_built, as_identified, in_the_world, with_stray_offset, with_tool]
)
def test_sound_sessions_raise_no_alarm(change):
    told = change(Identifiability.of(IN_HAND, with_poses=True), np.random.default_rng(0))
    assert not alarms(told), told.said()


def test_joints_alone_that_are_misread_are_refused_with_the_fix():
    with pytest.raises(DataError, match="opposite sign, they fit") as caught:
        finished(planted("a joint's sign", with_poses=False))
    error = caught.value
    assert "not those of ur5e" in error.message
    (column,) = error.culprits
    assert column.startswith("views.csv: q")
    assert error.next_step.startswith(f"Negate {column.removeprefix('views.csv: ')}")


def test_with_poses_the_hand_eye_goes_on_without_misread_joints():
    told = planted("joints in degrees", with_poses=True)
    known = finished(told)
    assert known.reported.joints_rad is None
    assert known.robot_arm.kinematics is None
    assert known.verdict.status != "good"
    assert any("pi / 180" in reason for reason in known.verdict.reasons)
    alone = finished(replace(told, robot=None))
    # What is done with the poses is what would be done if there were no joints.
    assert np.array_equal(known.assessment.state.edges[0], alone.assessment.state.edges[0])
    caught = raised(DataError, "needs the joint angles", finished, told, level="kinematics")
    assert "multiply q1_rad to q6_rad by pi / 180" in caught.next_step


def test_rows_without_poses_are_not_taken_by_misread_joints():
    session = planted("joints in degrees", with_poses=True).session
    views = list(session.views)
    joints = {name: number for name, number in views[3].numbers.items() if name.endswith("_rad")}
    views[3] = replace(views[3], numbers=joints)
    reported = reported_poses(replace(session, views=tuple(views)), load_robot("ur5e"))
    (rejection,) = reported.rejections
    assert rejection.view == 3
    assert "joint angles are misread" in rejection.reason


def test_a_lost_encoder_is_named_and_estimated_with_the_arm():
    told = Identifiability.of(IN_HAND, with_poses=True)
    joints = told.joints - np.deg2rad([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])
    poses = load_robot("ur5e").base_from_flange(joints)
    known = finished(replace(told, joints=joints, poses=poses))
    nominal, found = known.robot_arm.kinematics.result.levels
    assert nominal.held_out_mm > 10.0
    assert found.held_out_mm < 0.5
    assert known.verdict.status == "check"
    assert known.verdict.causes[0].kind == "misread_joints"
    assert known.verdict.causes[0].do.words.startswith("Home elbow_joint anew")
    # What is seen of the target hardly depends on whose errors the last tenths of a degree are.
    found = known.robot_arm.model.robot.base_from_flange(joints)
    true = IN_HAND.robot.true_base_from_flange
    moved, moves = invert(found[:-1]) @ found[1:], invert(true[:-1]) @ true[1:]
    away = np.linalg.norm((moved - moves)[:, :3, 3], axis=1)
    assert np.median(away) < 1e-3


def test_zeros_that_differ_between_poses_and_joints_are_named():
    told = Identifiability.of(IN_HAND, with_poses=True)
    off = np.deg2rad([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])
    session = replace(told, joints=told.joints - off).session
    matched = match_joints(session.views, load_robot("ur5e"))
    assert matched.joints_rad == {}
    assert "moved by 10.00 deg" in matched.warnings[0].reason
    assert "Home elbow_joint anew, or add 10.00 deg to q3_rad" in matched.warnings[0].reason


def test_one_row_of_wrong_joints_costs_its_view_alone():
    told = Identifiability.of(IN_HAND, with_poses=True)
    joints = told.joints.copy()
    joints[5, 1] += 0.3
    known = finished(replace(told, joints=joints))
    assert known.reported.joints_rad.keys() == set(range(16)) - {5}
    assert known.robot_arm.kinematics.level == "geometry"
    assert known.reasons[5].endswith("with which the camera agrees")


def test_joints_are_judged_by_their_fit():
    robot, joints = load_robot("ur5e"), IN_HAND.robot.joints

    def guess(told, q=joints, arm=robot):
        return guess_joints(arm, told, arm.base_from_flange(q))

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
    # Arms move with their base.
    base = exp(np.array([0.2, -0.1, 0.4, 0.3, 0.1, -0.2]))
    for arm in (robot, robot.corrected()):
        moved = with_base(arm, base).base_from_flange(joints)
        assert moved == pytest.approx(base @ arm.base_from_flange(joints), abs=1e-12)


JOINTS = tuple(f"q{at}_rad" for at in range(1, 7))


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return write_session(simulate(CellOptions(views=12, seed=4)), tmp_path / "cell", images=False)


def rewritten(folder, change):
    """Changes the rows of views.csv, each a dictionary, in place."""
    file = folder / "views.csv"
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows, names = list(reader), reader.fieldnames
    change(rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)


def shifted(columns):
    def change(rows):
        before = [dict(row) for row in rows]
        for at, row in enumerate(rows):
            row.update({name: before[(at + 1) % len(rows)][name] for name in columns})

    return change


def converted(source, dest, *more, strict=False):
    words = ["convert", str(source), str(dest), "--guess", *more]
    return CliRunner().invoke(app, words, catch_exceptions=not strict)


def by_view(session, names):
    return {
        view.number: [view.numbers[name] for name in names]
        for view in session.views
        if names[0] in view.numbers
    }


@pytest.mark.parametrize("corners", [slow(False), True], ids=["poses", "corners"])
def test_poses_are_mirrored_only_when_that_is_asked_for(tmp_path, corners):
    cell = simulate(CellOptions(views=18, seed=3))
    flange, width = cell.robot.base_from_flange, cell.stated[""].resolution[0]
    mirror = np.eye(4) if corners else np.diag([1.0, -1.0, 1.0, 1.0])
    seen = [
        view_corners.px * [-1, 1] + [width - 1, 0] if corners else view_corners.px
        for view_corners in cell.corners
    ]
    Session.from_corners(
        [(view_corners.ids, px) for view_corners, px in zip(cell.corners, seen, strict=True)],
        mirror @ flange @ mirror,
        replace(cell.options.target, square_sigma_m=1e-7),
        cell.stated[""].resolution,
        mount="eye-in-hand",
    ).save(tmp_path / "cell")
    done = typed("calibrate", tmp_path / "cell", "-o", tmp_path / "out")
    # Mirrored images fit as well, and no reading of the poses helps these.
    assert "Look at an image first: where it is mirrored" in done.said
    assert "--mirror-poses" in done.said
    assert not any("--guess" in command for command in printed_commands(done.said))
    with pytest.raises(DataError, match="mirrored images are the usual cause"):
        converted(tmp_path / "cell", tmp_path / "fixed", "--yes", strict=True)
    assert not (tmp_path / "fixed").exists()
    done = converted(tmp_path / "cell", tmp_path / "fixed", "--yes", "--mirror-poses")
    assert done.exit_code == 0
    fixed = Session.load(tmp_path / "fixed")
    assert "left-handed frame" in fixed.declaration.corrected[0]
    # Of mirrored corners the board is still seen from behind.
    assert visioncal.calibrate(fixed).verdict.status == ("check" if corners else "good")


# A cell: what the camera is from the flange, and the target from the base; or the other way round.
NEAR, FAR = (
    exp(np.array([0.1, 0.2, 1.5, 0.03, 0.02, 0.08])),
    exp(np.array([0.1, 2, 0.5, 1, 0.2, 0])),
)


def joints_and_poses(count, seed):
    """(n, 6) joint angles of a ur5e, and its (n, 4, 4) poses."""
    rng = np.random.default_rng(seed)
    joints = 0.5 * rng.normal(size=(count, 6)) + [0, -1.5, 1.5, -1.5, -1.5, 0]
    return joints, Robot.from_document(read_robot_document("ur5e", tip=None)).base_from_flange(
        joints
    )


def one_late(rows):
    return np.concatenate([rows[:1], rows[:-1]])


@pytest.fixture
def late(tmp_path):
    """Writes a log in which the robot's rows are one late."""

    def write(*, with_poses):
        joints, poses = joints_and_poses(12, seed=1)
        camera = invert(poses @ NEAR) @ FAR
        keyed = {"joints": one_late(joints), "camera_pose": camera}
        keyed |= {"robot_pose": one_late(poses)} if with_poses else {}
        rows = [
            {name: value[at].tolist() for name, value in keyed.items()} for at in range(len(joints))
        ]
        (tmp_path / "log.json").write_text(json.dumps(rows))
        foreign = read_foreign(
            tmp_path / "log.json", ImportOptions(mount="eye-in-hand", robot_model="ur5e")
        )
        return foreign, joints

    return write


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_mount_of_samples_that_do_not_say_it(tmp_path, mount):
    options = CellOptions(mount=mount, views=12)
    sound = Session.load(write_session(simulate(options), tmp_path / "cell", images=False))
    robot, camera = (
        np.array([getattr(view, name)().as_matrix() for view in sound.views])
        for name in ("base_from_flange", "cam_from_target")
    )
    # With the camera on the base easy_handeye2 stores the inverse.
    stored = robot if mount == "eye-in-hand" else invert(robot)
    source = easy_handeye_file(tmp_path / "cell.samples", stored, camera)
    done = converted(source, tmp_path / "read", "--yes")
    assert done.exit_code == 0, done.stderr
    session = Session.load(tmp_path / "read")
    assert session.mount == mount
    found = np.array([view.base_from_flange().as_matrix() for view in session.views])
    # A quaternion and back, and two inversions, in double precision.
    np.testing.assert_allclose(found, robot, atol=1e-13)


def test_a_robot_that_nobody_knows_is_named_with_what_to_correct(cell):
    document = cell / "session.toml"
    document.write_text(document.read_text("utf-8").replace('"ur10e"', '"ur10ee"'), "utf-8")
    found = visioncal.doctor(cell).findings[0]
    assert found.kind == "misread_joints"
    assert "There is no robot named 'ur10ee'. Did you mean ur10e" in found.words
    assert found.do.words.startswith("Correct the robot's model in session.toml")
    # Without poses there is no result, and that is why.
    rewritten(cell, lambda rows: [row.update(dict.fromkeys(POSE, "")) for row in rows])
    with pytest.raises(DataError) as caught:
        visioncal.calibrate(cell)
    assert caught.value.message.startswith("session.toml: robot.model: There is no robot named")
    assert caught.value.next_step == found.do.words


@pytest.mark.parametrize("moved", [(*POSE, *JOINTS), POSE], ids=["both", "poses alone"])
def test_what_is_of_one_log_changes_rows_together(cell, tmp_path, moved):
    sound = Session.load(cell)
    rewritten(cell, shifted(moved))
    done = converted(cell, tmp_path / "fixed", "--yes")
    assert done.exit_code == 0, done.stderr
    fixed = Session.load(tmp_path / "fixed")
    for names in (POSE, JOINTS):
        found, wanted = by_view(fixed, names), by_view(sound, names)
        # One row at the end has lost its partner; the rest are the numbers that were written.
        assert len(found) == len(wanted) - (names[0] in moved)
        rows = [wanted[index] for index in found]
        np.testing.assert_allclose(list(found.values()), rows, atol=1e-15)


def test_nothing_is_written_without_a_word_or_a_reading(cell, tmp_path):
    done = converted(cell, tmp_path / "same", "--yes")
    assert done.exit_code == 0, done.stderr
    assert "fit as declared" in done.stderr
    assert Session.load(tmp_path / "same").digest() == Session.load(cell).digest()

    def in_millimetres(rows):
        for row in rows:
            row.update({name: repr(1e3 * float(row[name])) for name in POSE[:3]})

    rewritten(cell, in_millimetres)
    done = converted(cell, tmp_path / "fixed")
    assert done.exit_code != 0
    assert "the robot's positions in mm" in done.stderr

    def scrambled(rows):
        turns = np.random.default_rng(0).normal(size=(len(rows), 4))
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        for row, turn in zip(rows, turns.tolist(), strict=True):
            row.update(zip(POSE[3:], map(repr, turn), strict=True))

    rewritten(cell, scrambled)
    done = converted(cell, tmp_path / "fixed", "--yes")
    assert isinstance(done.exception, DataError)
    assert "no other reading stands out" in str(done.exception)
    assert not (tmp_path / "fixed").exists()


@pytest.mark.parametrize("with_poses", [False, True], ids=["joints alone", "both"])
def test_a_shift_moves_the_joints(late, with_poses):
    foreign, joints = late(with_poses=with_poses)
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
