"""An effect: columns that act on an edge or on a lens at each moment, and their common size."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias

import numpy as np

from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.model.arm import Moments
from visioncal.robot import Robot
from visioncal.vision.camera import intrinsics

Place: TypeAlias = Literal["edge", "lens", "corners"]


# Likelihood ratio that chance exceeds in one session of ten thousand.
SIGNIFICANT = 13.8


@dataclass(frozen=True)
class Size:
    """Standard deviation of noise or of random unknowns, which is to be estimated."""

    name: str
    start: float  # Where a search begins: above what is likely.
    low: float  # At this it stands for none.
    high: float
    # Likelihood ratio below which one of random unknowns is none: less of what something else makes
    # likely.
    limit: float = SIGNIFICANT
    # Its kind, with others: where one of these is not by chance, none is held to be.
    of: str = ""


@dataclass(frozen=True)
class Effect(ABC):
    """Random unknowns a ~ N(0, s^2): they add `columns @ a` to a frame's pose or a lens.

    Of an edge, a robot's or an unknown one, the columns are right perturbations of
    `parent_from_frame` [rad, m]; of a lens, changes of its intrinsics. Changes from corner to
    corner of an image are in no column.
    """

    place: ClassVar[Place] = "edge"
    kind: ClassVar[str]
    clause: ClassVar[str]  # Its action as a clause: it may stand for another one.
    wider: ClassVar[str] = ""  # Kind of one that has its columns and more: no rival of it.
    bounds: ClassVar[tuple[float, float, float]]  # `start`, `low` and `high` of its size.
    curvature: ClassVar[float] = (
        0.0  # Share by which slopes change, at most, for one of its values.
    )
    frame: str  # The edge's child frame, or the camera.

    @property
    def name(self) -> str:
        """Name of the effect in sizes, budget and result."""
        return f"{self.kind} {self.frame}"

    @property
    def size(self) -> Size:
        """Size of the effect, with its bounds."""
        return Size(self.name, *self.bounds)

    @property
    @abstractmethod
    def count(self) -> int:
        """Number c of the effect's unknowns."""

    @abstractmethod
    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """Columns (k, 6, c), or (k, q, c) of a lens with q intrinsics.

        Args:
            moments: The k moments.
            distances: (k,) distance of what is seen from the camera along its axis [m]; ones
                where a frame moves.
        """

    def unseen(self, moments: Moments) -> FloatArray:
        """Columns (k, 6, u) of what no moment shows, of the same size: it counts, at zero."""
        return np.zeros((len(moments), 6, 0))

    @property
    def typical(self) -> "Effect":
        """An effect by whose score this one is judged, where it has very many unknowns."""
        return self

    def twists(self, moments: Moments, values: FloatArray) -> FloatArray:
        """(k, 6) right perturbations of an edge by (c,) values."""
        return np.asarray(self.columns(moments, np.ones(len(moments))) @ values)

    def slopes(self, moments: Moments, values: FloatArray) -> FloatArray:
        """Derivatives (k, 6, c) of `twists` at (c,) values: the columns where these are linear."""
        del values
        return self.columns(moments, np.ones(len(moments)))


@dataclass(frozen=True, eq=False)
class Stood:
    """Where a flange stood."""

    poses: FloatArray  # (s, 4, 4) `base_from_flange` at the cell's stops; NaN where unknown.
    seen: IntArray  # (k,) stops at which something was seen.
    is_swept: bool  # Whether it moved meanwhile.
    beside_m: tuple[float, ...] = ()  # Where its base has what stands in it; empty of nothing [m].
    robot: Robot | None = None  # The arm's model, where its joint angles are known.


class Named(ABC):
    """An effect that is tried in every cell, and of which a finding says what it means."""

    kind: ClassVar[str]
    # Size, a standard deviation of its values, beyond which what else looks like it is likelier.
    most: ClassVar[float]
    do: ClassVar[str]  # Advice.
    hides: ClassVar[tuple[str, ...]] = ()  # Kinds of findings that are mere effects of it.

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """Effects that are tried on a flange; none where the effect is on a lens."""
        del flange, stood
        return iter(())

    @classmethod
    def of_lens(cls, camera: str, lens: Camera, flange: str) -> Iterator[Effect]:
        """Effects that are tried on a lens; none where the effect is on a flange."""
        del camera, lens, flange
        return iter(())

    @classmethod
    @abstractmethod
    def says(cls, values: FloatArray) -> str:
        """The meaning of (c,) estimated values, as a sentence."""


@dataclass(frozen=True, eq=False)
class Displacement(Effect):
    """An effect on a camera's images that displaces what it sees, each corner otherwise."""

    place = "corners"
    is_positive: ClassVar = False  # Whether its first value cannot be negative.

    @abstractmethod
    def moved(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """Displacements (n, 3, c) of points in the camera's frame by as many values [m].

        Args:
            points: (n, 3) corners [m].
            poses: (n, 4, 4) or (4, 4) `cam_from_board` of their boards.
        """

    def moved_first(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """(n, 3) of `moved` by the first value alone."""
        return self.moved(points, poses)[:, :, 0]


@dataclass(frozen=True, eq=False)
class LensEffect(Effect):
    """An effect on a lens."""

    place = "lens"
    lens: Camera

    def none(self, moments: Moments) -> FloatArray:
        """Columns (k, q, c) of zeros."""
        return np.zeros((len(moments), len(intrinsics(self.lens)), self.count))
