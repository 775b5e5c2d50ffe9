"""Common misreadings of joint angles and of the robot model they belong to."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Robot, load_robot, other_convention, robot_names

# Joint 3 counted from the link before it, or from the horizontal: joint 2's share in it.
_COUPLINGS = ((1.0, "from the link before it"), (-1.0, "from the horizontal"))
_COUPLED = (1, 2)


@dataclass(frozen=True, eq=False)
class JointReading:
    """One reading of a session's joint angles."""

    robot: Robot  # The model.
    mixing: FloatArray  # (n, n) the true angles are `mixing @ recorded + zeros`.
    zeros: FloatArray  # (n,) correction of each joint's zero [rad].
    # The difference from the declared reading; empty for the declared reading itself.
    words: str = ""
    fix: str = ""  # What the user can do about it.
    columns: tuple[int, ...] = ()  # The columns concerned, numbered from 0; empty for all.
    cost: float = 0.0  # Number of mistakes it implies; a lost zero counts more than one.

    @property
    def is_zero(self) -> bool:
        """Whether it changes a joint's zero, and nothing else."""
        return bool(np.any(self.zeros))

    def angles(self, recorded: FloatArray) -> FloatArray:
        """The true angles (m, n) for recorded ones [rad]."""
        return np.asarray(recorded @ self.mixing.T + self.zeros)

    def poses(self, recorded: FloatArray) -> FloatArray:
        """(m, 4, 4) `base_from_flange` under this reading [m]."""
        return self.robot.base_from_flange(self.angles(recorded))


def declared_reading(robot: Robot) -> JointReading:
    """The joint angles as recorded."""
    return JointReading(robot, np.eye(robot.joint_count), np.zeros(robot.joint_count))


def joint_readings(robot: Robot) -> Iterator[JointReading]:
    """All other readings but lost zeros: one mistake, then two."""
    declared = declared_reading(robot)
    columns = [*_exchanges(declared), *_signs(declared)]
    units = [*unit_readings(declared)]
    yield from (*units, *columns)
    yield from _couplings(declared)
    yield from _models(declared)
    for unit in units:
        yield from (_combined(unit, column) for column in columns)
    for first, second in combinations(_signs(declared), 2):
        yield _combined(first, second)


def with_zero(declared: JointReading, joint: int, zero_rad: float) -> JointReading:
    """The reading in which one joint's zero is shifted."""
    zeros = declared.zeros.copy()
    zeros[joint] += zero_rad
    name, degrees = declared.robot.joint_names[joint], np.rad2deg(zero_rad)
    return replace(
        declared,
        zeros=zeros,
        words=f"the zero of {name} (q{joint + 1}_rad) moved by {degrees:.2f} deg",
        fix=f"Home {name} anew, or add {degrees:.2f} deg to q{joint + 1}_rad; --level offsets "
        "finds it to the precision of the views.",
        columns=(joint,),
        # A fitted number explains more by chance.
        cost=1.5,
    )


def unit_readings(declared: JointReading) -> Iterator[JointReading]:
    """The readings with angles in degrees, or in radians that were taken for degrees."""
    revolute = ~declared.robot.chain.prismatic
    columns = f"q1_rad to q{len(revolute)}_rad"
    yield replace(
        declared,
        mixing=np.diag(np.where(revolute, np.pi / 180.0, 1.0)),
        words="the angles in degrees",
        fix=f"Where the angles are recorded, multiply {columns} by pi / 180.",
        cost=1,
    )
    yield replace(
        declared,
        mixing=np.diag(np.where(revolute, 180.0 / np.pi, 1.0)),
        words="the angles in radians that were taken for degrees",
        fix=f"Where the angles are recorded, multiply {columns} by 180 / pi.",
        cost=1,
    )


def _exchanges(declared: JointReading) -> Iterator[JointReading]:
    names = declared.robot.joint_names
    count = len(names)
    # ROS's joint_states are sorted by the joints' names.
    alphabetical = [sorted(names).index(name) for name in names]
    for order, words in ((alphabetical, "names' alphabet"), (range(count)[::-1], "reverse")):
        changed = tuple(at for at in range(count) if order[at] != at)
        if len(changed) > 2:
            yield replace(
                declared,
                mixing=np.eye(count)[list(order)],
                words=f"the columns of the joints in the order of the {words}"
                if words != "reverse"
                else "the columns of the joints in reverse order",
                fix="Put the columns into the order from the base to the flange.",
                columns=changed,
                cost=1,
            )
    for pair in combinations(range(count), 2):
        order = list(range(count))
        order[pair[0]], order[pair[1]] = pair[1], pair[0]
        first, second = (f"q{at + 1}_rad" for at in pair)
        of_ros = ", as in ROS's joint_states, which sorts joints by their names"
        yield replace(
            declared,
            mixing=np.eye(count)[order],
            words=f"the columns {first} and {second} exchanged"
            + (of_ros if order == alphabetical else ""),
            fix=f"Exchange the headings {first} and {second} in views.csv.",
            columns=pair,
            cost=1,
        )


def _signs(declared: JointReading) -> Iterator[JointReading]:
    for at, name in enumerate(declared.robot.joint_names):
        signs = np.ones(declared.robot.joint_count)
        signs[at] = -1.0
        yield replace(
            declared,
            mixing=np.diag(signs),
            words=f"q{at + 1}_rad of the opposite sign",
            fix=f"Negate q{at + 1}_rad, or turn the axis of {name} in the robot's model.",
            columns=(at,),
            cost=1,
        )


def _couplings(declared: JointReading) -> Iterator[JointReading]:
    """Joint 3 counted from the horizontal: palletisers and arms with a parallelogram do so."""
    before, after = _COUPLED
    if declared.robot.joint_count <= after:
        return
    for share, words in _COUPLINGS:
        mixing = declared.mixing.copy()
        mixing[after, before] = share
        sign = "Add" if share > 0.0 else "Subtract"
        preposition = "to" if share > 0.0 else "from"
        yield replace(
            declared,
            mixing=mixing,
            words=f"q{after + 1}_rad counted {words}, unlike the model",
            fix=f"{sign} q{before + 1}_rad {preposition} q{after + 1}_rad.",
            columns=(after,),
            cost=1,
        )


def _models(declared: JointReading) -> Iterator[JointReading]:
    robot, other = declared.robot, other_convention(declared.robot)
    if other is not None:
        table, convention = other
        yield replace(
            declared,
            robot=table,
            words=f"the table of {robot.name} read as {convention}",
            fix=f'Write convention = "{convention}" into the table of {robot.name}.',
            cost=1,
        )
    for name in robot_names():
        model = load_robot(name)
        if name != robot.name and model.joint_count == robot.joint_count:
            yield replace(
                declared,
                robot=model,
                words=f"the arm a {name} and not a {robot.name}",
                fix=f'In session.toml, write [robot] model = "{name}".',
                cost=1,
            )


def _combined(first: JointReading, second: JointReading) -> JointReading:
    return replace(
        first,
        mixing=first.mixing @ second.mixing,
        words=f"{first.words} and {second.words}",
        fix=f"{first.fix} {second.fix}",
        columns=() if not first.columns else (*first.columns, *second.columns),
        cost=first.cost + second.cost,
    )
