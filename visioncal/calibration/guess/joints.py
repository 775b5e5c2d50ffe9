"""Ways in which joint angles, or the model that they belong to, are commonly mistaken."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Robot, load_robot, other_convention, robot_names

# Joint 3 counted from the horizontal, or from the link before: the second row's share in it.
_COUPLINGS = ((1.0, "from the link before it"), (-1.0, "from the horizontal"))
_COUPLED = (1, 2)


@dataclass(frozen=True, eq=False)
class JointReading:
    """One way to take a session's joint angles.

    Attributes:
        robot: The model.
        mixing: (n, n) the angles meant are `mixing @ recorded + zeros`.
        zeros: (n,) what is added to each joint's zero [rad].
        words: What is different from what was declared; empty for the declared reading.
        fix: What the user can do about it.
        columns: The columns that it is about, numbered from 0; empty for all.
        cost: How many mistakes it takes; a lost zero counts more than one.
    """

    robot: Robot
    mixing: FloatArray
    zeros: FloatArray
    words: str = ""
    fix: str = ""
    columns: tuple[int, ...] = ()
    cost: float = 0.0

    @property
    def is_zero(self) -> bool:
        """Whether a joint's zero is all that it changes."""
        return bool(np.any(self.zeros))

    def angles(self, recorded: FloatArray) -> FloatArray:
        """The angles (m, n) that are meant by those that are recorded [rad]."""
        return np.asarray(recorded @ self.mixing.T + self.zeros)

    def poses(self, recorded: FloatArray) -> FloatArray:
        """(m, 4, 4) `base_from_flange` by this reading [m]."""
        return self.robot.base_from_flange(self.angles(recorded))


def declared_reading(robot: Robot) -> JointReading:
    """The joints as they are recorded."""
    return JointReading(robot, np.eye(robot.joint_count), np.zeros(robot.joint_count))


def joint_readings(robot: Robot) -> Iterator[JointReading]:
    """All other readings that are tried, but for lost zeros: one mistake, then two."""
    declared = declared_reading(robot)
    columns = [*_exchanges(declared), *_signs(declared)]
    units = list(unit_readings(declared))
    yield from units
    yield from columns
    yield from _couplings(declared)
    yield from _models(declared)
    for unit in units:
        yield from (_both(unit, column) for column in columns)
    for first, second in combinations(_signs(declared), 2):
        yield _both(first, second)


def with_zero(declared: JointReading, joint: int, zero_rad: float) -> JointReading:
    """The reading in which one joint's zero is elsewhere."""
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
        # A number that is fitted explains more than it means.
        cost=1.5,
    )


def unit_readings(declared: JointReading) -> Iterator[JointReading]:
    """The readings in which angles are in degrees, or were taken for degrees."""
    turns = ~declared.robot.chain.prismatic
    many = f"q1_rad to q{len(turns)}_rad"
    yield replace(
        declared,
        mixing=np.diag(np.where(turns, np.pi / 180.0, 1.0)),
        words="the angles in degrees",
        fix=f"Where the angles are recorded, multiply {many} by pi / 180.",
        cost=1,
    )
    yield replace(
        declared,
        mixing=np.diag(np.where(turns, 180.0 / np.pi, 1.0)),
        words="the angles in radians that were taken for degrees",
        fix=f"Where the angles are recorded, multiply {many} by 180 / pi.",
        cost=1,
    )


def _exchanges(declared: JointReading) -> Iterator[JointReading]:
    names = declared.robot.joint_names
    count = len(names)
    # ROS's joint_states come in the alphabetical order of the joints' names.
    sorted_to = [sorted(names).index(name) for name in names]
    for order, words in ((sorted_to, "names' alphabet"), (range(count)[::-1], "reverse")):
        moved = tuple(at for at in range(count) if order[at] != at)
        if len(moved) > 2:
            yield replace(
                declared,
                mixing=np.eye(count)[list(order)],
                words=f"the columns of the joints in the order of the {words}"
                if words != "reverse"
                else "the columns of the joints in reverse order",
                fix="Put the columns into the order from the base to the flange.",
                columns=moved,
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
            + (of_ros if order == sorted_to else ""),
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
    """Makers of palletisers and of arms with a parallelogram count joint 3 from the horizontal."""
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
    robot = declared.robot
    other = other_convention(robot)
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


def _both(first: JointReading, second: JointReading) -> JointReading:
    return replace(
        first,
        mixing=first.mixing @ second.mixing,
        words=f"{first.words} and {second.words}",
        fix=f"{first.fix} {second.fix}",
        columns=() if not first.columns else (*first.columns, *second.columns),
        cost=first.cost + second.cost,
    )
