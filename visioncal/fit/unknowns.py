"""Unknowns of a cell: the one place that knows columns, sizes and how a step moves a value."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray, IntArray, Target
from visioncal.fit.lens_field import Field, by_lens
from visioncal.model.boards import BEND, PLANE, SHAPES, SIZE, shape_count
from visioncal.model.effects import Effect, Size
from visioncal.session.document import CameraTable
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA
from visioncal.vision.camera import intrinsics, with_intrinsics

Kind: TypeAlias = Literal["edge", "lens", "shape", "effect", "field"]
Key: TypeAlias = tuple[Kind, str]

# Likelihood ratio from which what is off in one of ten cases is likelier so than not: given lenses,
# and boards that are not flat.
_ONE_IN_TEN = 2.0 * float(np.log(9.0))


@dataclass(frozen=True, eq=False)
class Prior:
    """A zero-mean Gaussian prior of some columns of an unknown."""

    columns: IntArray  # (n,) among the unknown's own.
    size: Size | None = None  # Its standard deviation, which is estimated.
    sigma: float = 1.0  # Its standard deviation where it is known, in the columns' units.
    # Columns that are held, by a small sigma: in the covariance alone.
    considered: float = 0.0


@dataclass(frozen=True, eq=False)
class Unknown(ABC):
    """One unknown of d columns."""

    key: Key
    priors: tuple[Prior, ...] = ()  # Columns without one are flat.

    @property
    @abstractmethod
    def units(self) -> FloatArray:
        """(d,) what one unit of each column is, in SI units or pixels."""

    @abstractmethod
    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        """The value after a step (d,), in the columns' units."""

    @abstractmethod
    def offset(self, value: FloatArray) -> FloatArray:
        """(d,) how far a value is from its prior's mean, in the columns' units."""

    @property
    def count(self) -> int:
        """Number of the unknown's columns."""
        return len(self.units)


@dataclass(frozen=True, eq=False)
class Edge(Unknown):
    """`parent_from_frame` (4, 4), perturbed on the right by (rotation [rad], translation [m])."""

    @property
    def units(self) -> FloatArray:
        """See `Unknown`."""
        return np.ones(6)

    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        """See `Unknown`."""
        return value @ exp(step)

    def offset(self, value: FloatArray) -> FloatArray:
        """See `Unknown`."""
        del value
        return np.zeros(6)


@dataclass(frozen=True, eq=False)
class Vector(Unknown):
    """A (n,) vector, of which the first d are unknown: a lens, a board, an effect or a field."""

    mean: FloatArray = field(default_factory=lambda: np.zeros(0))  # (d,) of its prior.
    scale: FloatArray = field(default_factory=lambda: np.zeros(0))  # (d,) `units`.

    @property
    def units(self) -> FloatArray:
        """See `Unknown`."""
        return self.scale

    def moved(self, value: FloatArray, step: FloatArray) -> FloatArray:
        """See `Unknown`."""
        found = value.copy()
        found[: len(step)] += step * self.scale
        return found

    def offset(self, value: FloatArray) -> FloatArray:
        """See `Unknown`."""
        return np.asarray((value[: len(self.mean)] - self.mean) / self.scale)


@dataclass(frozen=True, eq=False)
class State:
    """A point of linearisation."""

    # Estimated or held: (4, 4) edges, intrinsics, (10,) shapes, effects, fields.
    values: Mapping[Key, FloatArray]
    errors: Mapping[str, FloatArray]  # (s, 6) right perturbations of each flange's pose.


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All unknowns and sizes of a fit."""

    members: tuple[Unknown, ...]
    effects: tuple[Effect, ...]  # Of which there are unknowns.
    lenses: Mapping[str, Camera]  # By camera: its model; the state has its intrinsics.
    # Flanges that err at each stop: sizes `rad NAME` and `m NAME`.
    erring: tuple[str, ...]
    noise: tuple[Size, ...]  # Of sightings and flanges.
    fields: Mapping[str, Field] = field(default_factory=dict)  # Of lenses with one, by camera.
    # Pairs of sizes [rad], [m], whose ratio has a prior.
    ratios: tuple[tuple[str, str], ...] = ()
    closed: frozenset[str] = frozenset()  # Sizes that are held at their lower bounds.
    # By kinds of effects that a search opened: kinds of others that would have done about as well.
    rivals: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @cached_property
    def slices(self) -> Mapping[Key, slice]:
        """Columns of each unknown."""
        ends = np.cumsum([0, *(member.count for member in self.members)]).tolist()
        return {m.key: slice(a, b) for m, a, b in zip(self.members, ends, ends[1:], strict=False)}

    @property
    def opened(self) -> tuple[Effect, ...]:
        """Effects whose sizes are not held at their lower bounds."""
        return tuple(effect for effect in self.effects if effect.name not in self.closed)

    @property
    def count(self) -> int:
        """The number p of columns."""
        return sum(member.count for member in self.members)

    def columns(self, kind: Kind, name: str) -> IntArray:
        """Columns of an unknown; none where it is held."""
        found = self.slices.get((kind, name), slice(0, 0))
        return np.arange(found.start, found.stop)

    def __contains__(self, key: Key) -> bool:
        return key in self.slices

    def __getitem__(self, key: Key) -> Unknown:
        return next(member for member in self.members if member.key == key)

    @cached_property
    def units(self) -> FloatArray:
        """(p,) what one unit of each column is."""
        return np.concatenate([np.zeros(0), *(member.units for member in self.members)])

    @cached_property
    def sizes(self) -> tuple[Size, ...]:
        """All sizes: of noise, then of random unknowns."""
        random = (prior.size for member in self.members for prior in member.priors)
        return (*self.noise, *(size for size in random if size is not None))

    @cached_property
    def size_index(self) -> Mapping[str, int]:
        """Index of each size by its name."""
        return {size.name: at for at, size in enumerate(self.sizes)}

    def size_of(self, name: str) -> int:
        """Index of a size; -1 where there is none, since the rows are whitened."""
        return self.size_index.get(name, -1)

    def priors(self) -> Iterable[tuple[int, IntArray, float]]:
        """Each prior: its size (-1 for none), its columns (n,) and its known sigma."""
        for member in self.members:
            start = self.slices[member.key].start
            for prior in member.priors:
                name = prior.size.name if prior.size else ""
                yield self.size_of(name), start + prior.columns, prior.sigma

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(t,) lowest and highest logarithms of the sizes."""
        low, high = np.log([[size.low, size.high] for size in self.sizes] or np.ones((0, 2))).T
        is_closed = np.array([size.name in self.closed for size in self.sizes], bool)
        return low, np.where(is_closed, low, high)

    def starts(self) -> FloatArray:
        """(t,) logarithms at which a search begins."""
        low, high = self.bounds()
        return np.clip(np.log([size.start for size in self.sizes]), low, high)

    def offsets(self, state: State) -> FloatArray:
        """(p,) distances of a state from the priors' means."""
        parts = [member.offset(state.values[member.key]) for member in self.members]
        return np.concatenate([np.zeros(0), *parts])

    def moved(self, state: State, steps: FloatArray, errors: Mapping[str, FloatArray]) -> State:
        """The state after a step (p,) of the unknowns, and (s, 6) of each flange's errors."""
        values = dict(state.values)
        for member in self.members:
            step = steps[self.slices[member.key]]
            values[member.key] = member.moved(values[member.key], step)
        added = {name: state.errors[name] + step for name, step in errors.items()}
        return State(values, {**state.errors, **added})

    def camera(self, state: State, frame: str) -> Camera:
        """A lens at a state, as it projects beside its field."""
        values, at = state.values["lens", frame], self.fields.get(frame)
        if at is not None and at.instead is not None:
            values = values - at.instead @ state.values["field", frame]
        return with_intrinsics(self.lenses[frame], values)

    def with_members(self, *others: Unknown) -> "Unknowns":
        """The unknowns with others: in the places of those of the same key, or at the end."""
        found = {member.key: member for member in (*self.members, *others)}
        return replace(self, members=tuple(found.values()))

    def closing(self, names: Iterable[str]) -> "Unknowns":
        """The unknowns with some sizes held at their lower bounds."""
        return replace(self, closed=frozenset(names))


def given_lens(table: CameraTable, frame: str, px: FloatArray, *, is_spare: bool) -> Vector | None:
    """A stated lens, as far as it may be off; None where no sigma is known.

    Focal lengths and centre are off by the stated sigma, if there is one. Where `is_spare`, (n, 2)
    corners determine the rest: by a maker's prior if the lens is to be refined, else by a size of
    focal lengths, centre and distortion each. In units of intrinsics that move the corners by one
    pixel (rms), but where these are stated.
    """
    lens, stated = table.stated, table.matrix_sigma_px
    if lens is None:
        raise KeyError(frame)
    values, count = intrinsics(lens), 4 if stated is not None else 0
    units, priors = np.ones(len(values)), list[Prior]()
    if stated is not None:
        priors.append(Prior(np.arange(4), sigma=stated))
    if is_spare and table.intrinsics == "refine":
        estimated_priors = {prior.columns[0]: prior for prior in estimated_lens(frame, lens).priors}
        priors += [prior for first, prior in estimated_priors.items() if first >= count]
        count = len(values)
    elif is_spare and table.intrinsics == "auto":
        moved = np.sqrt(np.nanmean(by_lens(lens, px) ** 2, axis=(0, 1)) * 2.0)
        parts = {"focal": (0, 2), "centre": (2, 4), "distortion": (4, len(values))}
        for part, (first, last) in parts.items():
            if first >= count:
                units[first:last] = 1.0 / moved[first:last]
                name, of = f"{part} {frame}", f"given lens of {frame}"
                size = Size(name, 1.0, 1e-3, 100.0, _ONE_IN_TEN, of)
                priors.append(Prior(np.arange(first, last), size))
        count = len(values)
    return Vector(("lens", frame), tuple(priors), values[:count], units[:count]) if count else None


def estimated_lens(frame: str, lens: Camera) -> Vector:
    """A lens of which nothing is stated, but that it is a maker's."""
    values, width, height = intrinsics(lens), *lens.resolution
    mean = values.copy()
    mean[2:4] = (width - 1) / 2, (height - 1) / 2
    # A maker's lens: its centre is in the middle of the image within this share of the width, and
    # p1 and p2 are within this.
    priors = [Prior(np.array([2, 3]), sigma=0.02 * width)]
    if lens.model == "brown":
        mean[6:8] = 0.0
        priors.append(Prior(np.array([6, 7]), sigma=1e-3))
    return Vector(("lens", frame), tuple(priors), mean, np.ones(len(values)))


def printed_board(frame: str, board: Target | None, *, has_shape: bool, is_sized: bool) -> Vector:
    """A printed board, or None of which nothing is stated: its size, its shape if `has_shape`.

    `is_sized` where errors of the arms are not confounded with its size: then that is estimated,
    else held.
    """
    share = board.square_sigma_m / board.square_m if board else DEFAULT_RELATIVE_SIGMA
    share, size_columns = max(share, 1e-7), np.arange(SHAPES)[SIZE]
    # No corners and no arm show a millionth.
    held = Prior(size_columns, sigma=min(share, 1e-6), considered=share)
    priors = [Prior(size_columns, Size(f"scale {frame}", 0.01, share, 0.2)) if is_sized else held]
    if has_shape:
        for part, columns, bounds in (
            ("plane", PLANE, (3e-4, 1e-7, 0.02)),
            ("bend", BEND, (1e-4, 1e-7, 0.05)),
        ):
            size = Size(f"{part} {frame}", *bounds, _ONE_IN_TEN, f"shape of {frame}")
            priors.append(Prior(np.arange(SHAPES)[columns], size))
        if (whole := shape_count(board)) > SHAPES and board is not None:
            priors.append(Prior(np.arange(SHAPES, whole), sigma=board.point_sigmas_m[0]))
    count = shape_count(board) if has_shape else 1
    return Vector(("shape", frame), tuple(priors), np.zeros(count), np.ones(count))


def random_effect(effect: Effect) -> Vector:
    """The unknowns of an effect."""
    none, prior = np.zeros(effect.count), Prior(np.arange(effect.count), effect.size)
    return Vector(("effect", effect.name), (prior,), none, np.ones(effect.count))


def lens_field(frame: str, at: Field, size_px: float) -> Vector:
    """The field of a lens, whose size is near some value [px]."""
    size, count = Size(f"field {frame}", size_px, 1e-4, 5.0), at.count
    prior = Prior(np.arange(count), size)
    return Vector(("field", frame), (prior,), np.zeros(count), np.ones(count))


def flange_noise(flanges: Sequence[str]) -> tuple[Size, ...]:
    """Sizes of what each arm errs by from stop to stop [rad], [m]."""
    return tuple(
        Size(f"{unit} {name}", 1e-3, 1e-8, 0.3) for name in flanges for unit in ("rad", "m")
    )
