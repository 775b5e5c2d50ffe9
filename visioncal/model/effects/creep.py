"""Frames that creep, settle or step during the session: a base, and what a flange carries."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import LEVER_M, adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.moves import still_to_come
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Named, Stood
from visioncal.model.effects.lens_grows import TIME_CONSTANTS

# By which motion fades over the session: evenly, as what warms up, as what settles in some stops.
RATES = (0.0, TIME_CONSTANTS, 20.0)


@dataclass(frozen=True, eq=False)
class _Moves(Effect):
    """Motion of a frame over the session [m, of turns at a lever].

    The picks come after the session: at its end it is zero.
    """

    bounds, count = (1e-2, 1e-7, 0.1), 6

    @abstractmethod
    def left(self, moments: Moments) -> FloatArray:
        """(k, 1, 1) share of the motion that is still to come."""


@dataclass(frozen=True, eq=False)
class _OfBase(_Moves):
    """Motion of a base, or of what stands in it, about a place [m].

    A camera beside the robot that turns moves what it sees by centimetres about the base, and no
    base that slips turns about the camera.
    """

    about_m: tuple[float, ...] = ()  # Empty for the base's origin.

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        place = np.eye(4)
        place[:3, 3] = self.about_m or 0.0
        flange_from_place = invert(moments.poses[self.frame]) @ place
        twists = adjoint(flange_from_place) / np.repeat([LEVER_M, 1.0], 3)
        return np.asarray(twists * self.left(moments))


@dataclass(frozen=True, eq=False)
class _OfMount(_Moves):
    """Motion of what the flange carries."""

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.asarray(self.left(moments) * np.diag(np.repeat([1.0 / LEVER_M, 1.0], 3)))


@dataclass(frozen=True, eq=False)
class Creeps(_Moves, Named):
    """Motion all over the session."""

    most = 3e-3
    what: ClassVar[str]  # The creeping part, as a sentence begins.
    rate: float = 0.0  # By which it fades, over the session; zero of an even one.

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """Even creep, creep as of warming, and creep that settles in the first stops."""
        del stood
        yield from (cls(flange, rate=rate) for rate in RATES)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        turn_rad, shift_m = np.linalg.norm(values.reshape(2, 3), axis=1) / (LEVER_M, 1.0)
        by = mm_and_deg(1e3 * float(shift_m), float(np.rad2deg(turn_rad)))
        return f"{cls.what} crept by {by} during the session. The result is that of its end."

    def left(self, moments: Moments) -> FloatArray:
        """See `_Moves`."""
        return still_to_come(moments.progress, self.rate)[:, None, None]


@dataclass(frozen=True, eq=False)
class BaseCreeps(Creeps, _OfBase):
    """A base, or what stands in it, that creeps."""

    kind, what = "base creeps", "The base, or what stands in it,"
    clause = "the base, or what stands in it, crept"
    do = (
        "Fasten the base, the fixed camera and the fixed target, let the cell warm up, and record "
        "again."
    )

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """Creeps about the base, and about what stands in it, of all rates."""
        for place in dict.fromkeys([(), stood.beside_m]):
            yield from (cls(flange, place, rate) for rate in RATES)


@dataclass(frozen=True, eq=False)
class MountCreeps(Creeps, _OfMount):
    """Creep of all that the flange carries."""

    kind, what = "mount creeps", "The load on the flange"
    clause = "what the flange carries crept"
    do = "Fasten what the flange carries, let the cell warm up, and record again."


@dataclass(frozen=True, eq=False)
class ArmGrows(Creeps):
    """Share by which the flange is farther from the base's origin, of an arm that warms up."""

    kind, what, bounds, count = "arm grows", "The arm", (1e-3, 1e-7, 0.02), 1
    clause = "the arm warmed up or cooled"
    most = 1e-3  # Aluminium grows by so much in 43 K, and steel in 90.
    do = "Let the arm warm up at its work for half an hour, and record again."

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        way, percent = "grew" if values[0] > 0.0 else "shrank", figure(100.0 * abs(values[0]))
        return (
            f"The arm {way} by {percent} % of its length during the session, as one that warms up "
            "or cools. The result is that of its end."
        )

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        inwards = np.zeros((len(moments), 6, 1))
        inwards[:, 3:, 0] = invert(moments.poses[self.frame])[:, :3, 3]
        return np.asarray(inwards * self.left(moments))


@dataclass(frozen=True, eq=False)
class FrameCreeps(Creeps, _OfMount):
    """Creep of one of several cameras or targets that share a base or a flange."""

    kind, what = "frame creeps", "A camera or target"
    clause = "a camera or target crept"
    do = "Fasten it, let the cell warm up, and record again."


@dataclass(frozen=True, eq=False)
class _Step(_Moves):
    """Motion at once."""

    progress: float = -0.5  # Of the session, up to which the frame is where it was.

    def left(self, moments: Moments) -> FloatArray:
        """See `_Moves`."""
        return np.asarray((moments.progress <= self.progress)[:, None, None].astype(float))


@dataclass(frozen=True, eq=False)
class BaseSteps(_Step, _OfBase):
    """A base, or what stands in it, that was moved at once."""

    kind = "base steps"
    clause = "the base, or what stands in it, moved at once"


@dataclass(frozen=True, eq=False)
class MountSteps(_Step, _OfMount):
    """A sudden move of all that the flange carries."""

    kind = "mount steps"
    clause = "what the flange carries moved at once"


@dataclass(frozen=True, eq=False)
class SightSteps(_Step):
    """A camera, or what measures poses by it, whose distances changed at once."""

    kind, count = "sight steps", 1
    clause = "the camera's distances changed at once"

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.asarray(self.left(moments) * np.eye(6)[:, 5:])
