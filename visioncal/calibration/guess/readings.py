"""The table of readings: what people mistake about recorded poses, and how it is undone."""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import permutations, product
from typing import Any, Literal, TypeVar

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, IntArray, Mount

# Mirroring another axis is equivalent, up to half turns of both frames.
_MIRROR = np.array([1.0, -1.0, 1.0])
# Part of the words of mirrored poses, which markers in images disprove.
OR_IMAGES = "the images mirrored, or "
# Units of poses; micrometres are for instruments.
_UNITS = tuple(unit for unit in UNITS_M if unit != "um")
# Radians that were read as degrees leave all rotations within 2 pi degrees of identity, per angle.
_RADIANS_AS_DEGREES_RAD = np.deg2rad(12.0)
# Weights of the numbers of a rotation, so that sums of different rotations differ.
_UNEVEN = np.sqrt(np.array([[2.0, 3.0, 5.0], [7.0, 11.0, 13.0], [17.0, 19.0, 23.0]]))
_GON = 0.9  # Degrees of a gon, of which 400 are a turn.


@dataclass(frozen=True)
class SideReading(Reading):
    """How one side's numbers, the robot's or the camera's, are read."""

    # Where the recorded rotations came from misreading others: the form in which those were
    # misread. Writing the rotations in it gets them back, and they are read as `rotation`.
    written: str = ""
    # Whether they were the other ones of the two angles of a rotation, which writing does not give.
    folded: bool = False
    # Signed places, from 1, of the numbers of a rotation; empty for as they are written.
    terms: tuple[int, ...] = ()
    angle_unit: float = 1.0  # Factor of the angles, beside the unit of their form.
    # Rotations of rows, by their places, that no formula gives back.
    by_place: tuple[tuple[str, tuple[float, ...]], ...] = ()
    # Whether rotations are transposed while positions are not those of an inverse.
    transposed: bool = False
    mirrored: bool = False  # Whether the frame is left-handed.
    # The number of a recorded position along each axis, and the signs of the axes.
    axes: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)
    scale: float = 1.0  # Factor of all distances, beside the unit.

    @property
    def reading(self) -> Reading | None:
        """The equivalent `Reading` of the recorded numbers; None where there is none."""
        plain = Reading(self.rotation, self.unit, self.inverse)
        return plain if self == SideReading(**vars(plain)) else None

    @property
    def has_lost_turns(self) -> bool:
        """Whether whole turns about the tool's last axis are lost, which a camera cannot show."""
        is_of_degrees = self.rotation.startswith("euler") and self.rotation.endswith("deg")
        return bool(self.by_place) and is_of_degrees

    def rotations(self, numbers: PoseNumbers) -> FloatArray:
        """(n, 3, 3) rotations as they are written; NaN where the numbers give none."""
        if self.by_place:
            rotation_of, none = dict(self.by_place), (np.nan,) * 9
            rows = [rotation_of.get(place, none) for place in numbers.places]
            return np.array(rows).reshape(-1, 3, 3)
        recorded = as_written(numbers, self.written).rotations
        if self.folded:
            recorded = _other_angles(recorded, self.written)
        if self.terms:
            recorded = recorded[:, np.abs(self.terms) - 1] * np.sign(self.terms)
        return ROTATION_FORMS[self.rotation].read(self.angle_unit * recorded)

    @property
    def of_rotations(self) -> tuple[object, ...]:
        """Key of the `rotations`: equal for readings that give the same of the same numbers."""
        written = self.written, self.folded
        return self.rotation, written, self.terms, self.angle_unit, self.by_place

    def poses(self, numbers: PoseNumbers, rotations: FloatArray | None = None) -> FloatArray:
        """(n, 4, 4) transforms [m]; NaN in rows without a pose.

        Args:
            numbers: The recorded numbers.
            rotations: Their `rotations`, where these are known.
        """
        rotations = self.rotations(numbers) if rotations is None else rotations
        positions = self.scale * UNITS_M[self.unit] * numbers.positions[:, self.axes] * self.signs
        if self.mirrored:
            rotations, positions = rotations * np.outer(_MIRROR, _MIRROR), positions * _MIRROR
        if self.transposed:
            rotations = np.swapaxes(rotations, 1, 2)
        poses = compose(rotations, positions)
        poses[~np.isfinite(poses).all(axis=(1, 2))] = np.nan
        return invert(poses) if self.inverse else poses

    def corrected(self, numbers: PoseNumbers) -> PoseNumbers:
        """Returns numbers whose `poses()` are right, unchanged where a reading suffices."""
        if self.reading is not None:
            return numbers.read_as(self.reading)
        return PoseNumbers.of_poses(self.poses(numbers), numbers.places)


def as_written(numbers: PoseNumbers, form: str) -> PoseNumbers:
    """The numbers with their rotations in another form, if any; NaN where they give none."""
    if not form:
        return numbers
    rotations = ROTATION_FORMS[numbers.reading.rotation].read(numbers.rotations)
    valid = np.isfinite(rotations).all(axis=(1, 2))
    recorded = np.full((len(rotations), ROTATION_FORMS[form].size), np.nan)
    recorded[valid] = ROTATION_FORMS[form].write(rotations[valid])
    return replace(numbers, rotations=recorded, reading=replace(numbers.reading, rotation=form))


def shifted(by: int, count: int) -> IntArray:
    """(count,) rows that many rows later, or earlier where negative; -1 for none."""
    rows = np.arange(count) + by
    return np.where((rows < 0) | (rows >= count), -1, rows)


def _as_text(first: int, count: int) -> IntArray:
    """(count,) rows that are numbered from `first`, sorted as text: 1, 10, 11, ..., 2."""
    return np.array(sorted(range(first, first + count), key=str)) - first


def _back_from_text(first: int, count: int) -> IntArray:
    return np.argsort(_as_text(first, count))


# Orders of the robot's rows beside the camera's: functions that return the robot's row for each of
# `count` views; -1 for none.
ROW_ORDERS: Mapping[str, Callable[[int], IntArray]] = {
    "": np.arange,
    "the robot's pose of a view one row after it": partial(shifted, 1),
    "the robot's pose of a view one row before it": partial(shifted, -1),
    "the robot's poses in reverse order": lambda count: np.arange(count)[::-1].copy(),
    "the images sorted as text (10 before 2)": partial(_as_text, 0),
    "the images, counted from 1, sorted as text (10 before 2)": partial(_as_text, 1),
    "the robot's poses sorted as text (10 before 2)": partial(_back_from_text, 0),
    "the robot's poses, counted from 1, sorted as text (10 before 2)": partial(_back_from_text, 1),
}


@dataclass(frozen=True)
class Hypothesis:
    """One reading of a whole recording."""

    robot: SideReading  # How the robot's numbers are read.
    camera: SideReading  # How the camera's are read.
    mount: Mount  # How the camera is mounted.
    order: str = ""  # Order of the rows, a name among `ROW_ORDERS`; empty for that of the views.
    # Words for each difference from the declared reading.
    changes: tuple[str, ...] = field(default=(), compare=False)
    cost: int = field(default=0, compare=False)  # Number of mistakes that it implies.

    def rows(self, count: int) -> IntArray:
        """(count,) the robot's row for each of the camera's rows; -1 for none."""
        return ROW_ORDERS[self.order](count)

    @property
    def chain_class(self) -> Hashable:
        """Key of the chain: equal for readings that close it alike.

        Inverting the robot's poses, inverting the camera's and changing the mount all exchange the
        unknown edges; one unit for both sides scales the cell.
        """
        is_inverse = self.robot.inverse ^ self.camera.inverse ^ (self.mount == MOUNTS[0])
        ratio = round(UNITS_M[self.robot.unit] / UNITS_M[self.camera.unit], 9)
        sides = (
            (*side.of_rotations, side.transposed, side.mirrored, side.axes, side.signs, side.scale)
            for side in (self.robot, self.camera)
        )
        return *sides, is_inverse, ratio, self.order

    def robot_numbers(self, robot: PoseNumbers) -> PoseNumbers:
        """The robot's numbers, corrected and in the order of the camera's rows."""
        rows = self.rows(len(robot))
        ordered = self.robot.corrected(robot).rows(np.maximum(rows, 0))
        ordered.positions[rows < 0] = ordered.rotations[rows < 0] = np.nan
        return ordered


_Read = TypeVar("_Read", SideReading, Hypothesis)


@dataclass(frozen=True)
class Change:
    """A mistake that people make: the fields of a reading that it changes."""

    words: str
    part: Literal["robot", "camera", "chain"]  # A side, or the hypothesis itself.
    fields: Mapping[str, Any]  # Its right fields.
    cost: int = 1  # Number of mistakes.

    def of(self, reading: Hypothesis) -> Hypothesis:
        """A reading with this mistake undone."""
        fields = self.fields
        if self.part != "chain":
            fields = {self.part: _with(getattr(reading, self.part), fields)}
        changes, cost = (*reading.changes, self.words), reading.cost + self.cost
        return _with(reading, {"changes": changes, "cost": cost, **fields})


def _with(reading: _Read, fields: Mapping[str, Any]) -> _Read:
    """A reading with other fields; thousands are tried, and `replace` takes five times as long."""
    changed = object.__new__(type(reading))
    vars(changed).update(vars(reading), **fields)
    return changed


def changes(declared: Hypothesis, is_measured: bool, count: int) -> Iterator[Change]:
    """All mistakes that are tried but rewritten rotations, by the declared reading of `count` rows.

    `is_measured` is whether the camera's poses were measured from images of a board of stated size.
    """
    yield from _changes_of_side("robot", declared.robot)
    words = f"{OR_IMAGES}the robot's poses in a left-handed frame (one axis mirrored)"
    yield Change(words, "robot", {"mirrored": True})
    yield from _axes()
    yield from _components(declared.robot.rotation)
    if is_measured:
        yield from _units("camera", declared.camera, "the board's size in")
    else:
        yield from _changes_of_side("camera", declared.camera)
        # As of y upwards, or of pictures that were turned over, beside rotations that are right.
        yield from (each for each in _other_signs("camera") if each.cost == 1)
    (other,) = {*MOUNTS} - {declared.mount}
    yield Change(f"the camera mounted {other}", "chain", {"mount": other})
    for order, rows in ROW_ORDERS.items():
        # Fewer than eleven rows are the same sorted as text.
        if not np.array_equal(rows(count), np.arange(count)):
            yield Change(order, "chain", {"order": order})


def _orders() -> Iterator[tuple[tuple[int, ...], str, int]]:
    """Other orders of three axes, their names, and the number of mistakes that they imply."""
    for axes in permutations((0, 1, 2)):
        if axes != (0, 1, 2):
            cost = 1 + (axes in ((1, 2, 0), (2, 0, 1)))
            yield axes, ", ".join("xyz"[axis] for axis in axes), cost


def _signs(names: Sequence[str]) -> Iterator[tuple[tuple[int, ...], str, int]]:
    """Other signs of three numbers, the names of those that change, and how many change."""
    for signs in product((1, -1), repeat=3):
        if min(signs) < 0:
            named = [name for name, sign in zip(names, signs, strict=True) if sign < 0]
            yield signs, " and ".join(named), len(named)


def _axes() -> Iterator[Change]:
    """Positions whose axes are exchanged, or have another sign, beside rotations that are right."""
    for axes, named, cost in _orders():
        words = f"the numbers of the robot's positions taken as {named}"
        yield Change(words, "robot", {"axes": axes}, cost)
    yield from _other_signs("robot")


def _other_signs(part: Literal["robot", "camera"]) -> Iterator[Change]:
    """Positions of which some axes have another sign."""
    for signs, named, cost in _signs("xyz"):
        words = f"another sign of {named} in the {part}'s positions"
        yield Change(words, part, {"signs": signs}, cost)


def _components(form: str) -> Iterator[Change]:
    """Rotations of which numbers are exchanged or have another sign, beside right positions.

    With one other sign, a rotation vector's rotation R is H R^T H, with a half turn H about its
    axis: transposed, and with the other two signs in the positions, it closes the chain alike.
    """
    size, subject = ROTATION_FORMS[form].size, "the robot's rotations"
    fields, names = dict[str, Any](), ("number 1", "number 2", "number 3")
    if size != 3:
        # The vector of a quaternion is along that of the rotation.
        fields, names = {"rotation": "rotation-vector", "written": "rotation-vector"}, (*"xyz",)
        subject += " (of qx, qy, qz, or of rx, ry, rz)"
    is_vector = not form.startswith("euler-")
    if form.endswith("-deg"):
        yield Change(f"{subject} in gon (400 to a turn)", "robot", {"angle_unit": _GON})
    if is_vector:
        # Transposed, it has the other three signs.
        fields["transposed"] = False
    for signs, named, cost in _signs(names):
        if not (is_vector and cost == 3):
            terms = tuple((np.arange(1, 4) * signs).tolist())
            words = f"another sign of {named} in {subject}"
            yield Change(words, "robot", {**fields, "terms": terms}, cost)
    for axes, named, cost in _orders() if is_vector else ():
        # The first and last are exchanged as where Euler angles ZYX are taken for xyz: `rewritten`.
        if size == 3 or axes != (2, 1, 0):
            terms = tuple(1 + axis for axis in axes)
            words = f"the numbers of {subject} taken as {named}"
            yield Change(words, "robot", {**fields, "terms": terms}, cost)


def _units(part: Literal["robot", "camera"], side: SideReading, words: str) -> Iterator[Change]:
    others = (unit for unit in _UNITS if unit != side.unit)
    yield from (Change(f"{words} {unit}", part, {"unit": unit}) for unit in others)


def _changes_of_side(part: Literal["robot", "camera"], side: SideReading) -> Iterator[Change]:
    owner, size = f"the {part}'s", ROTATION_FORMS[side.rotation].size
    yield from _units(part, side, f"{owner} positions in")
    # A matrix by columns is one by rows, transposed, and that is tried for every form.
    for name, form in ROTATION_FORMS.items():
        if form.size == size != 9 and name != side.rotation:
            yield Change(f"{owner} rotations as {form.words}", part, {"rotation": name})
    given = "as given, not inverse" if side.inverse else "inverse"
    yield Change(f"{owner} poses {given}", part, {"inverse": not side.inverse})
    yield Change(f"{owner} rotations transposed", part, {"transposed": True})


def rewritten(robot: PoseNumbers, *, by_makers: bool = False) -> Iterator[Change]:
    """Rotations of the robot that were written after others were misread as angles.

    Tried are the orders of angles that robot makers use, about moving and about fixed axes; of one
    maker's taken for another's alone where asked.
    """
    form = ROTATION_FORMS[robot.reading.rotation]
    if form.size == 3:
        return
    forms = [form.rotation.split("-") for form in POSE_FORMS.values()]
    used = sorted({form[1] for form in forms if form[0] == "euler"}, key=str.swapcase)[::-1]
    # Orders that makers use come first: others are the same numbers in another order.
    cases = [] if by_makers else [*map(str.upper, used), *map(str.lower, used)]
    orders = dict.fromkeys([*used, *cases])
    degrees = [f"euler-{order}-deg" for order in orders]
    pairs = [*product(degrees, degrees)]
    rotations = form.read(robot.rotations)
    turned = rotation_angle(rotations[np.isfinite(rotations).all(axis=(1, 2))])
    if not by_makers and turned.max(initial=0.0) < _RADIANS_AS_DEGREES_RAD:
        radians = [name.replace("-deg", "-rad") for name in degrees]
        pairs += [*product(radians, degrees), ("rotation-vector", "rotation-vector-deg")]
    known, of_form = _Known(), cache(partial(as_written, robot))
    known.adds(rotations)
    yield from _signed_angles(robot, known, [f"euler-{order}-deg" for order in used])
    for name, written in pairs:
        tried = SideReading(name).rotations(of_form(written))
        # Other names of the same numbers in another order are the same mistake.
        if known.adds(tried):
            words = (
                f"the robot's rotations as {ROTATION_FORMS[name].words}, which were taken for "
                f"{ROTATION_FORMS[written].words}"
            )
            if {name, written} == {"euler-ZYX-deg", "euler-xyz-deg"}:
                words += ", or the reverse (A, B, C of KUKA and W, P, R of FANUC)"
            for folded in (False, True) if by_makers else (False,):
                fields = {"rotation": name, "written": written, "folded": folded}
                yield Change(words, "robot", fields, 2)


class _Known:
    """Rotations that were tried; hundreds are compared, most of which differ in their sums."""

    def __init__(self) -> None:
        self._rotations = list[FloatArray]()
        self._sums = list[float]()

    def adds(self, tried: FloatArray) -> bool:
        """Whether (n, 3, 3) rotations are none of these yet, which from then on they are."""
        checksum = float(np.nansum(tried * _UNEVEN))
        near = np.flatnonzero(np.abs(np.array(self._sums) - checksum) <= 5e-4 * max(len(tried), 1))
        if any(np.allclose(tried, self._rotations[at], atol=1e-9, equal_nan=True) for at in near):
            return False
        self._rotations.append(tried)
        self._sums.append(checksum)
        return True


def _other_angles(angles: FloatArray, form: str) -> FloatArray:
    """The other (n, 3) Euler angles, in a form of these, of the same rotations."""
    _, order, unit = form.split("-")
    half = 180.0 if unit == "deg" else np.pi
    is_proper = order[0].lower() == order[2].lower()
    other = angles * [1.0, -1.0, 1.0] + [half, 0.0 if is_proper else half, half]
    return np.asarray(other)


def _signed_angles(robot: PoseNumbers, known: "_Known", forms: Sequence[str]) -> Iterator[Change]:
    """Rotations made of Euler angles in gon, or with one of another sign, which is then known."""
    for form in forms:
        words = f"the robot's {ROTATION_FORMS[form].words}, but in gon (400 to a turn)"
        fields = {"rotation": form, "written": form, "angle_unit": _GON}
        yield Change(words, "robot", fields, 2)
    for form, (signs, named, cost) in product(forms, _signs(("first", "second", "third"))):
        terms = tuple((np.arange(1, 4) * signs).tolist())
        if cost > 1:
            continue
        tried = SideReading(form, terms=terms).rotations(as_written(robot, form))
        if not known.adds(tried):
            continue
        words = f"another sign of the {named} of the robot's {ROTATION_FORMS[form].words}"
        yield Change(words, "robot", {"rotation": form, "written": form, "terms": terms}, 2)
