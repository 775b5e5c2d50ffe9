"""Slips that people make with joint angles and models of robots, planted into simulated cells."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support.cells import session_of

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.cameras import detect_targets
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.robot import load_robot, read_robot_document
from visioncal.session import Session, View
from visioncal.session.columns import POSE
from visioncal.simulation import SimulatedCell

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
