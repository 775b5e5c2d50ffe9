"""Joint angles and models of robots that are mistaken: named, and sound ones left alone."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import session_of

from visioncal.calibration.guess.joints import guess_joints
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.cameras import detect_targets
from visioncal.calibration.stages.joints import match_joints
from visioncal.calibration.stages.reported_poses import reported_poses
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import FloatArray
from visioncal.robot import (
    load_robot,
    other_convention,
    read_robot_document,
    table_document,
    with_base,
)
from visioncal.robot.conversion import table_of
from visioncal.session import Session, View
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, SimulatedCell, fine_camera, simulate

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


def is_named(told: Identifiability) -> bool:
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
TURN = np.array([0.2, -0.1, 0.4, 0.3, 0.1, -0.2])


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
    assert is_named(told), told.said()


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


def test_an_arm_asked_for_is_refused_where_its_joints_are_misread():
    with pytest.raises(DataError, match="needs the joint angles") as caught:
        finished(planted("joints in degrees", with_poses=True), level="kinematics")
    assert "multiply q1_rad to q6_rad by pi / 180" in caught.value.next_step


def test_rows_without_poses_are_not_taken_by_misread_joints():
    session = planted("joints in degrees", with_poses=True).session
    views = list(session.views)
    joints = {name: number for name, number in views[3].numbers.items() if name.endswith("_rad")}
    views[3] = replace(views[3], numbers=joints)
    reported = reported_poses(replace(session, views=tuple(views)), load_robot("ur5e"))
    (rejection,) = reported.rejections
    assert rejection.view == 3
    assert "joint angles are misread" in rejection.reason


def test_degrees_are_known_by_their_fit_and_not_by_their_size():
    # A table whose zeros are where the arm works: all angles are within a few degrees.
    middle = IN_HAND.robot.joints.mean(axis=0)
    zeros = np.pad(middle[:, None], ((0, 0), (0, 3)))
    robot = load_robot("ur5e").corrected(functions=zeros)
    near = 0.1 * (IN_HAND.robot.joints - middle)
    poses = robot.base_from_flange(near)
    assert np.abs(np.rad2deg(near)).max() < 13.0
    assert not guess_joints(robot, near, poses).stands_out
    guess = guess_joints(robot, np.rad2deg(near), poses)
    assert guess.best.reading.words == "the angles in degrees"


def test_two_turns_are_no_degrees():
    # Joints of many arms turn by two turns either way.
    robot = load_robot("ur5e")
    q = IN_HAND.robot.joints + 2.0 * np.pi * np.where(IN_HAND.robot.joints > 0.0, -1.0, 1.0)
    assert not guess_joints(robot, q, robot.base_from_flange(q)).stands_out


def test_poses_that_turn_about_one_axis_accuse_nobody():
    robot = load_robot("ur5e")
    q = np.tile(IN_HAND.robot.joints[0], (12, 1))
    q[:, 5] += np.linspace(-1.0, 1.0, 12)
    assert not guess_joints(robot, q * [1, 1, -1, 1, 1, -1], robot.base_from_flange(q)).stands_out


def test_readings_that_no_row_tells_apart_are_all_named():
    robot = load_robot("ur5e")
    q = IN_HAND.robot.joints.copy()
    # These two never move, and stand alike: exchanged with a third they are the same.
    q[:, 1] = q[:, 4] = -1.2
    guess = guess_joints(robot, q[:, [0, 2, 1, 3, 4, 5]], robot.base_from_flange(q))
    assert guess.stands_out
    assert "q2_rad and q3_rad exchanged" in guess.sentence("the reported poses")


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


@pytest.mark.parametrize("as_chain", [False, True])
def test_arms_move_with_their_base(as_chain):
    robot = load_robot("ur5e")
    if as_chain:
        robot = robot.corrected()
    base = exp(TURN)
    q = IN_HAND.robot.joints
    assert with_base(robot, base).base_from_flange(q) == pytest.approx(
        base @ robot.base_from_flange(q), abs=1e-12
    )


def test_the_other_convention_of_a_table_is_the_arm_that_was_meant():
    # A modified table that is declared standard: read as modified it is the right arm again.
    robot = load_robot("ur5e")
    document = table_document(table_of(robot, "modified")) | {"convention": "standard"}
    other, convention = other_convention(type(robot).from_document(document))
    assert convention == "modified"
    guess = guess_joints(other, IN_HAND.robot.joints, robot.base_from_flange(IN_HAND.robot.joints))
    assert guess.declared.score < 1e-3
