"""A hypothesis about how recorded numbers are to be read, and its differences from the declared."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.number_format import figure
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray, IntArray, Mask, Mount

# `mirror`: the whole frame is left-handed. A letter: that coordinate alone has the wrong sign.
Signs: TypeAlias = Literal["", "mirror", "x", "y", "z"]
MIRROR_WORDS = (
    "the images mirrored, or the robot's poses in a left-handed frame (one axis mirrored)"
)
SIGNS: tuple[Signs, ...] = ("", "mirror", "x", "y", "z")

# Mirroring another axis is equivalent, up to half turns of both frames.
_MIRROR = np.array([1.0, -1.0, 1.0])
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
# The second triple of angles about three axes of the same rotation [deg]: the outer ones half a
# turn farther on, the supplement of the middle one.
_HALF_TURNED, _BEYOND = 180.0, np.array([-1.0, 1.0, -1.0])
# Euler angle orders that robot makers and libraries use, about moving and about fixed axes.
_ORDERS = {
    form.rotation.split("-")[1].upper()
    for form in POSE_FORMS.values()
    if form.rotation.startswith("euler-")
}


@dataclass(frozen=True)
class Turns:
    """How the numbers of a rotation are read."""

    form: str  # A name among `ROTATION_FORMS`.
    # Where the recorded numbers came from misreading others: the form in which those were misread.
    # Writing the rotations in it gets them back, and they are read as `form`.
    written: str = ""
    # Whether the middle angles so got back are replaced by those beyond 90 degrees: angles about
    # three axes are written up to 90, those about two axes, as of a tool that points down, reach
    # 180.
    is_beyond: bool = False

    def numbers(self, numbers: PoseNumbers) -> FloatArray:
        """(n, k) the numbers that are read as `form`."""
        if not self.written:
            return numbers.rotations
        rotations = ROTATION_FORMS[numbers.reading.rotation].read(numbers.rotations)
        valid: Mask = np.asarray(np.isfinite(rotations).all(axis=(1, 2)))
        misread = np.full((len(rotations), ROTATION_FORMS[self.written].size), np.nan)
        misread[valid] = ROTATION_FORMS[self.written].write(rotations[valid])
        return _HALF_TURNED - misread * _BEYOND if self.is_beyond else misread

    def rotations(self, numbers: PoseNumbers) -> FloatArray:
        """(n, 3, 3) rotations; NaN where the numbers give none."""
        return ROTATION_FORMS[self.form].read(self.numbers(numbers))


@dataclass(frozen=True)
class SideReading:
    """How one side's numbers, the robot's or the camera's, are read."""

    turns: Turns  # How rotations are read.
    unit: str  # The positions' unit, a name among `UNITS_M`.
    inverse: bool = False  # Whether the numbers give the inverse of the wanted pose.
    # Whether rotations are transposed while positions are not those of an inverse.
    transposed: bool = False
    signs: Signs = ""  # Which axis has the wrong sign.
    half_turned: bool = False  # Whether the base has to be turned by 180 degrees about its z.
    scale: float = 1.0  # Further factor of distances, for a target of another size than stated.

    @classmethod
    def as_declared(cls, reading: Reading) -> "SideReading":
        """The side as a declared reading has it."""
        return cls(Turns(reading.rotation), reading.unit, reading.inverse)

    @property
    def reading(self) -> Reading | None:
        """The equivalent `Reading` of the recorded numbers; None where there is none."""
        form = self.turns.form
        if self.transposed and form in ("matrix", "matrix-transposed"):
            form = "matrix" if form == "matrix-transposed" else "matrix-transposed"
        elif self.transposed:
            return None
        if self.turns.written or self.signs or self.half_turned or self.scale != 1.0:
            return None
        return Reading(form, self.unit, self.inverse)

    def poses(self, numbers: PoseNumbers) -> FloatArray:
        """(n, 4, 4) transforms [m]; NaN in rows without a pose."""
        rotations = self.turns.rotations(numbers)
        positions = UNITS_M[self.unit] * self.scale * numbers.positions
        if self.signs == "mirror":
            rotations = rotations * np.outer(_MIRROR, _MIRROR)
            positions = positions * _MIRROR
        elif self.signs:
            positions = positions * np.where(np.arange(3) == "xyz".index(self.signs), -1.0, 1.0)
        if self.transposed:
            rotations = np.swapaxes(rotations, 1, 2)
        valid = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(positions).all(axis=1)
        poses = compose(rotations, positions)
        poses[~valid] = np.nan
        poses = invert(poses) if self.inverse else poses
        return HALF_TURN @ poses if self.half_turned else poses

    def corrected(self, numbers: PoseNumbers) -> PoseNumbers:
        """Returns numbers whose `poses()` are right, unchanged where a reading suffices."""
        if self.reading is not None:
            return numbers.read_as(self.reading)
        poses = self.poses(numbers)
        return replace(
            numbers,
            positions=poses[:, :3, 3],
            rotations=poses[:, :3, :3].reshape(-1, 9),
            reading=Reading("matrix", "m"),
        )


def _as_text(count: int) -> IntArray:
    """(count,) the numbers from 0 on, sorted as text: 0, 1, 10, 11, ..., 2."""
    return np.array(sorted(range(count), key=str))


def _as_text_from_one(count: int) -> IntArray:
    """(count,) the same for rows that are numbered from 1."""
    return np.array(sorted(range(1, count + 1), key=str)) - 1


# Orders of the robot's rows beside the camera's: functions that return the robot's row for each of
# `count` views.
ROW_ORDERS: dict[str, Callable[[int], IntArray]] = {
    "the robot's poses in reverse order": lambda count: np.arange(count)[::-1].copy(),
    "the images sorted as text (10 before 2)": _as_text,
    "the images, counted from 1, sorted as text (10 before 2)": _as_text_from_one,
    "the robot's poses sorted as text (10 before 2)": lambda count: np.argsort(_as_text(count)),
    "the robot's poses, counted from 1, sorted as text (10 before 2)": lambda count: np.argsort(
        _as_text_from_one(count)
    ),
}


@dataclass(frozen=True)
class Hypothesis:
    """One reading of a whole recording."""

    robot: SideReading  # How the robot's numbers are read.
    camera: SideReading  # How the camera's are read.
    mount: Mount  # How the camera is mounted.
    shift: int = 0  # The robot's row `i + shift` belongs to the camera's row `i`.
    swap: tuple[int, ...] = ()  # Two of the robot's rows that are exchanged; empty for none.
    order: str = ""  # Order of the rows, a name among `ROW_ORDERS`; empty for that of the views.

    def rows(self, count: int) -> IntArray:
        """(count,) the robot's row for each of the camera's rows; -1 for none."""
        rows = ROW_ORDERS[self.order](count) if self.order else np.arange(count)
        rows += self.shift
        rows[(rows < 0) | (rows >= count)] = -1
        if self.swap:
            first, second = self.swap
            at_first, at_second = rows == first, rows == second
            rows[at_first], rows[at_second] = second, first
        return rows

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

    def camera_numbers(self, camera: PoseNumbers) -> PoseNumbers:
        """The camera's numbers, corrected."""
        return self.camera.corrected(camera)

    def chain(self, robot: PoseNumbers, camera: PoseNumbers) -> tuple[FloatArray, FloatArray]:
        """(n, 4, 4) the robot's part of the chain and `cam_from_target`; NaN in rows without."""
        base_from_flange = self.robot.poses(robot)
        rows = self.rows(len(robot))
        part = base_from_flange if self.mount == "eye-in-hand" else invert(base_from_flange)
        return np.where((rows >= 0)[:, None, None], part[rows], np.nan), self.camera.poses(camera)


def differences(
    tried: Hypothesis, declared: Hypothesis, places: tuple[str, ...], *, is_board: bool
) -> Iterator[str]:
    """Words for each difference between a hypothesis and the declared reading.

    `places` are the locations of the robot's rows in the files, `is_board` is whether the camera's
    poses were measured from images of a board of stated size.
    """
    yield from _side_differences("the robot's", tried.robot, declared.robot)
    if is_board and tried.camera.unit != declared.camera.unit:
        yield f"the board's size in {tried.camera.unit}"
    elif not is_board:
        yield from _side_differences("the camera's", tried.camera, declared.camera)
    if tried.camera.scale != declared.camera.scale:
        yield f"the target {figure(tried.camera.scale)} times as large as stated"
    if tried.mount != declared.mount:
        yield f"the camera mounted {tried.mount}"
    if tried.shift:
        where = "after" if tried.shift > 0 else "before"
        count = "one row" if abs(tried.shift) == 1 else f"{abs(tried.shift)} rows"
        yield f"the robot's pose of a view {count} {where} it"
    if tried.order:
        yield tried.order
    if tried.swap:
        first, second = (places[row] for row in tried.swap)
        yield f"the robot's poses of {first} and {second} exchanged"


def _side_differences(whose: str, tried: SideReading, declared: SideReading) -> Iterator[str]:
    if tried.unit != declared.unit:
        yield f"{whose} positions in {tried.unit}"
    if tried.turns != declared.turns:
        words = ROTATION_FORMS[tried.turns.form].words
        if tried.turns.written:
            mistaken = ROTATION_FORMS[tried.turns.written].words
            yield f"{whose} rotations as {words}, which were taken for {mistaken}"
        else:
            yield f"{whose} rotations as {words}"
    if tried.inverse != declared.inverse:
        yield f"{whose} poses {'inverse' if tried.inverse else 'as given, not inverse'}"
    if tried.transposed != declared.transposed:
        yield f"{whose} rotations transposed"
    if tried.signs == "mirror":
        yield MIRROR_WORDS
    elif tried.signs:
        yield f"{whose} positions with {tried.signs} negated"
    if tried.half_turned:
        yield f"{whose} base turned by 180 deg about z (base and base_link taken for each other)"


def strangeness(turns: Turns) -> float:
    """Extra cost of an unlikely form: misread angles, orders of axes that nobody uses."""
    names = [name.split("-") for name in (turns.form, turns.written) if name.startswith("euler-")]
    orders = [order for _, order, _ in names]
    unused = any(order.upper() not in _ORDERS for order in orders)
    # Degrees taken for radians are one mistake; with another order they are two.
    one_mistake = len(orders) == 2 and orders[0] == orders[1]
    return (0.25 if one_mistake else 0.5) * bool(turns.written) + 0.25 * unused
