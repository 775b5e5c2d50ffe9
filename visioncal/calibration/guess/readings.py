"""The table of readings: what people mistake about recorded poses, and how it is undone."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, IntArray, Mask, Mount

MIRROR_WORDS = (
    "the images mirrored, or the robot's poses in a left-handed frame (one axis mirrored)"
)
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
# Mirroring another axis is equivalent, up to half turns of both frames.
_MIRROR = np.array([1.0, -1.0, 1.0])
# Units of poses; micrometres are for instruments.
_UNITS = ("m", "mm", "cm", "inch")
# Euler angle orders that robot makers and libraries use, about moving and about fixed axes.
_USED_ORDERS = {
    form.rotation.split("-")[1].upper()
    for form in POSE_FORMS.values()
    if form.rotation.startswith("euler-")
}
# Extra cost of angles that were misread and written anew, of degrees among them, and of an order of
# axes that nobody uses.
_TWO_MISTAKES, _ONE_MISTAKE, _UNUSED = 0.5, 0.25, 0.25
# Radians that were read as degrees leave all rotations within 2 pi degrees of identity, per angle.
_RADIANS_AS_DEGREES_RAD = np.deg2rad(12.0)


@dataclass(frozen=True)
class Turns:
    """How the numbers of a rotation are read."""

    form: str  # A name among `ROTATION_FORMS`.
    # Where the recorded numbers came from misreading others: the form in which those were misread.
    # Writing the rotations in it gets them back, and they are read as `form`.
    written: str = ""

    def rotations(self, numbers: PoseNumbers) -> FloatArray:
        """(n, 3, 3) rotations; NaN where the numbers give none."""
        read = ROTATION_FORMS[self.form].read
        if not self.written:
            return read(numbers.rotations)
        rotations = ROTATION_FORMS[numbers.reading.rotation].read(numbers.rotations)
        valid: Mask = np.asarray(np.isfinite(rotations).all(axis=(1, 2)))
        misread = np.full((len(rotations), ROTATION_FORMS[self.written].size), np.nan)
        misread[valid] = ROTATION_FORMS[self.written].write(rotations[valid])
        return read(misread)


@dataclass(frozen=True)
class SideReading:
    """How one side's numbers, the robot's or the camera's, are read."""

    turns: Turns  # How rotations are read.
    unit: str  # The positions' unit, a name among `UNITS_M`.
    inverse: bool = False  # Whether the numbers give the inverse of the wanted pose.
    # Whether rotations are transposed while positions are not those of an inverse.
    transposed: bool = False
    mirrored: bool = False  # Whether the frame is left-handed.
    half_turned: bool = False  # Whether the base has to be turned by 180 degrees about its z.

    @property
    def reading(self) -> Reading | None:
        """The equivalent `Reading` of the recorded numbers; None where there is none."""
        form = self.turns.form
        if self.transposed and form in ("matrix", "matrix-transposed"):
            form = "matrix" if form == "matrix-transposed" else "matrix-transposed"
        elif self.transposed:
            return None
        if self.turns.written or self.mirrored or self.half_turned:
            return None
        return Reading(form, self.unit, self.inverse)

    def poses(self, numbers: PoseNumbers) -> FloatArray:
        """(n, 4, 4) transforms [m]; NaN in rows without a pose."""
        rotations = self.turns.rotations(numbers)
        positions = UNITS_M[self.unit] * numbers.positions
        if self.mirrored:
            rotations, positions = rotations * np.outer(_MIRROR, _MIRROR), positions * _MIRROR
        if self.transposed:
            rotations = np.swapaxes(rotations, 1, 2)
        poses = compose(rotations, positions)
        poses[~np.isfinite(poses).all(axis=(1, 2))] = np.nan
        poses = invert(poses) if self.inverse else poses
        return HALF_TURN @ poses if self.half_turned else poses

    def corrected(self, numbers: PoseNumbers) -> PoseNumbers:
        """Returns numbers whose `poses()` are right, unchanged where a reading suffices."""
        if self.reading is not None:
            return numbers.read_as(self.reading)
        return PoseNumbers.of_poses(self.poses(numbers), numbers.places)


def _shifted(by: int) -> tuple[str, Callable[[int], IntArray]]:
    def order(count: int) -> IntArray:
        rows = np.arange(count) + by
        return np.where((rows < 0) | (rows >= count), -1, rows)

    number = "one row" if abs(by) == 1 else f"{abs(by)} rows"
    return f"the robot's pose of a view {number} {'after' if by > 0 else 'before'} it", order


def _as_text(count: int, first: int = 0) -> IntArray:
    """(count,) rows that are numbered from `first`, sorted as text: 1, 10, 11, ..., 2."""
    return np.array(sorted(range(first, first + count), key=str)) - first


# Rows by which the robot's are shifted, by words.
SHIFTS = {_shifted(by)[0]: by for by in (1, -1, 2, -2)}
# Orders of the robot's rows beside the camera's: functions that return the robot's row for each of
# `count` views; -1 for none.
ROW_ORDERS: dict[str, Callable[[int], IntArray]] = {
    "": np.arange,
    **dict(map(_shifted, SHIFTS.values())),
    "the robot's poses in reverse order": lambda count: np.arange(count)[::-1].copy(),
    "the images sorted as text (10 before 2)": _as_text,
    "the images, counted from 1, sorted as text (10 before 2)": lambda count: _as_text(count, 1),
    "the robot's poses sorted as text (10 before 2)": lambda count: np.argsort(_as_text(count)),
    "the robot's poses, counted from 1, sorted as text (10 before 2)": lambda count: np.argsort(
        _as_text(count, 1)
    ),
}


@dataclass(frozen=True)
class Hypothesis:
    """One reading of a whole recording."""

    robot: SideReading  # How the robot's numbers are read.
    camera: SideReading  # How the camera's are read.
    mount: Mount  # How the camera is mounted.
    order: str = ""  # Order of the rows, a name among `ROW_ORDERS`; empty for that of the views.
    swap: tuple[int, ...] = ()  # Two of the robot's rows that are exchanged; empty for none.
    # Words for each difference from the declared reading, and their number, unlikely ones counted
    # more.
    changes: tuple[str, ...] = field(default=(), compare=False)
    cost: float = field(default=0.0, compare=False)

    def rows(self, count: int) -> IntArray:
        """(count,) the robot's row for each of the camera's rows; -1 for none."""
        rows = ROW_ORDERS[self.order](count)
        if self.swap:
            first, second = (rows == row for row in self.swap)
            rows[first], rows[second] = self.swap[::-1]
        return rows

    @property
    def chain_class(self) -> Hashable:
        """The same for readings that close the chain alike.

        Inverting the robot's poses, inverting the camera's and changing the mount all exchange the
        unknown edges; one unit for both sides scales the cell.
        """
        is_inverse = self.robot.inverse ^ self.camera.inverse ^ (self.mount == MOUNTS[0])
        ratio = round(UNITS_M[self.robot.unit] / UNITS_M[self.camera.unit], 9)
        sides = (replace(side, unit="", inverse=False) for side in (self.robot, self.camera))
        return *sides, is_inverse, ratio, self.order, self.swap

    def robot_numbers(self, robot: PoseNumbers) -> PoseNumbers:
        """The robot's numbers, corrected and in the order of the camera's rows."""
        rows = self.rows(len(robot))
        has_row = (rows >= 0)[:, None]
        ordered = self.robot.corrected(robot).rows(np.maximum(rows, 0))
        return replace(
            ordered,
            positions=np.where(has_row, ordered.positions, np.nan),
            rotations=np.where(has_row, ordered.rotations, np.nan),
        )


@dataclass(frozen=True)
class Change:
    """A mistake that people make: the field of a reading that it changes."""

    words: str
    part: Literal["robot", "camera", "chain"]  # A side, or the hypothesis itself.
    name: str  # The field's.
    value: Any  # What it should be.
    cost: float = 1.0  # In mistakes: all have the same prior odds, but for unlikely forms.

    @property
    def is_of_rotations(self) -> bool:
        """Whether the angles of relative rotations show it."""
        return self.name in ("turns", "order")

    @property
    def is_rewritten(self) -> bool:
        """Whether rotations are of misread angles."""
        return self.name == "turns" and bool(self.value.written)

    def of(self, reading: Hypothesis) -> Hypothesis:
        """A reading with this mistake undone."""
        fields: dict[str, Any] = {self.name: self.value}
        if self.part != "chain":
            fields = {self.part: replace(getattr(reading, self.part), **fields)}
        changes, cost = (*reading.changes, self.words), reading.cost + self.cost
        return replace(reading, changes=changes, cost=cost, **fields)

    def goes_with(self, other: "Change") -> bool:
        """Whether both may be mistaken together."""
        if self.is_rewritten or other.is_rewritten:
            # Nobody rewrites angles and takes their frame for left-handed, too.
            return {self.name, other.name}.isdisjoint(("transposed", "mirrored"))
        return (self.part, self.name) != (other.part, other.name)


def changes(
    declared: Hypothesis, *, is_measured: bool, rewritten: PoseNumbers | None = None
) -> Iterator[Change]:
    """All mistakes that are tried.

    Args:
        declared: The declared reading.
        is_measured: Whether the camera's poses were measured from images of a board of stated size.
        rewritten: The robot's numbers, where they may be those of misread angles.
    """
    robot, camera = declared.robot, declared.camera
    yield from _changes_of_side("robot", robot, () if rewritten is None else _misread(rewritten))
    yield Change(MIRROR_WORDS, "robot", "mirrored", True)
    if is_measured:
        for unit in _UNITS:
            if unit != camera.unit:
                yield Change(f"the board's size in {unit}", "camera", "unit", unit)
    else:
        yield from _changes_of_side("camera", camera)
    (other,) = {*MOUNTS} - {declared.mount}
    yield Change(f"the camera mounted {other}", "chain", "mount", other)
    yield from (Change(order, "chain", "order", order) for order in ROW_ORDERS if order)


def _changes_of_side(
    part: Literal["robot", "camera"], side: SideReading, misread: Iterable[Turns] = ()
) -> Iterator[Change]:
    whose, size = f"the {part}'s", ROTATION_FORMS[side.turns.form].size
    for unit in _UNITS:
        if unit != side.unit:
            yield Change(f"{whose} positions in {unit}", part, "unit", unit)
    # A matrix by columns is one by rows, transposed, and that is tried for every form.
    names = (name for name, form in ROTATION_FORMS.items() if form.size == size and size != 9)
    for turns in (*map(Turns, names), *misread):
        words = f"{whose} rotations as {ROTATION_FORMS[turns.form].words}"
        if turns.written:
            words += f", which were taken for {ROTATION_FORMS[turns.written].words}"
        if turns != side.turns:
            yield Change(words, part, "turns", turns, 1.0 + _strangeness(turns))
    given = "as given, not inverse" if side.inverse else "inverse"
    yield Change(f"{whose} poses {given}", part, "inverse", not side.inverse)
    yield Change(f"{whose} rotations transposed", part, "transposed", True)


def of_exchanged_rows(rows: tuple[int, int], places: Sequence[str]) -> Change:
    """Two rows of the robot that are exchanged."""
    first, second = (places[row] for row in rows)
    return Change(f"the robot's poses of {first} and {second} exchanged", "chain", "swap", rows)


# The robot's joints alone show this.
HALF_TURNED = Change(
    "the robot's base turned by 180 deg about z (base and base_link taken for each other)",
    "robot",
    "half_turned",
    True,
)


def _misread(numbers: PoseNumbers) -> Iterator[Turns]:
    """Forms of rotations that were written after others were misread as Euler angles."""
    form = ROTATION_FORMS[numbers.reading.rotation]
    if form.size == 3:
        return
    angles = [
        name for name in ROTATION_FORMS if name.startswith("euler-") and name.endswith("-deg")
    ]
    # An order about fixed axes is the reverse order about moving ones.
    intrinsic = [name for name in angles if name.split("-")[1].isupper()]
    for written in intrinsic:
        yield from (Turns(name, written) for name in angles if name != written)
    rotations = form.read(numbers.rotations)
    turned = rotation_angle(rotations[np.isfinite(rotations).all(axis=(1, 2))])
    if turned.max(initial=0.0) > _RADIANS_AS_DEGREES_RAD:
        return
    in_radians = [name.replace("-deg", "-rad") for name in angles]
    for written in intrinsic:
        yield from (Turns(name, written) for name in (*in_radians, "rotation-vector"))
    yield from (Turns(name, "rotation-vector-deg") for name in ("rotation-vector", *in_radians))


def _strangeness(turns: Turns) -> float:
    """Extra cost of an unlikely form: misread angles, orders of axes that nobody uses."""
    names = [name.split("-") for name in (turns.form, turns.written) if name.startswith("euler-")]
    orders = [order for _, order, _ in names]
    unused = any(order.upper() not in _USED_ORDERS for order in orders)
    # Degrees taken for radians are one mistake; with another order they are two.
    one_mistake = len(orders) == 2 and orders[0] == orders[1]
    return (_ONE_MISTAKE if one_mistake else _TWO_MISTAKES) * bool(turns.written) + (
        _UNUSED * unused
    )
