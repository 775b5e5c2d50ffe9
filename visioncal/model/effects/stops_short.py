"""A robot whose poses are read while it moves, or that are commanded and not reached."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import LEVER_M, invert, log
from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Effect, Named, Stood


@dataclass(frozen=True, eq=False)
class _AlongMotion(Effect, Named):
    """Where the arm stands along a motion: by a share of it, and by as much of each.

    The latter as a share of a motion of 0.3 m, with turns at a lever. The first two values are of a
    straight line with an even turn, two more of how far a screw departs from it, and two of the
    place alone, as of a controller that waits for places and turns apart. At other moments than
    the cell's stops the poses are right.
    """

    count, bounds, most = 6, (1e-2, 1e-6, 0.1), 5e-2
    # After the largest motions it is no multiple of these.
    hides = ("wrong_views",)
    poses: FloatArray  # (s, 4, 4) `base_from_flange` at the cell's stops; NaN where unknown.

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """See `Named`."""
        if not stood.is_swept:
            yield cls(flange, stood.poses)

    @staticmethod
    @abstractmethod
    def motions(poses: FloatArray) -> FloatArray:
        """(n, 3, 6) motions at (n, 4, 4) poses: along lines, screws beside these, places."""

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        return np.where(moments.stops[:, None, None] >= 0, self._of_stops[moments.stops], 0.0)

    @cached_property
    def _of_stops(self) -> FloatArray:
        stood, found = np.isfinite(self.poses[:, 0, 0]), np.zeros((len(self.poses), 6, 6))
        motions = self.motions(self.poses[stood])
        length = np.linalg.norm(motions * np.repeat([LEVER_M, 1.0], 3), axis=2)
        # How far a screw departs from a line is small beside both.
        length[:, 1] = length[:, 0]
        even = motions * (0.3 / np.maximum(length, 1e-6))[:, :, None]
        found[stood] = np.swapaxes(np.stack([motions, even], axis=2).reshape(-1, 6, 6), 1, 2)
        return found

    @staticmethod
    def off_m(values: FloatArray) -> float:
        """How far beyond the end of a motion of 0.3 m it stands by (6,) values [m]."""
        return 0.3 * float(values[[0, 1, 4, 5]].sum())


def _between(poses: FloatArray, seen_from: FloatArray) -> FloatArray:
    """(n - 1, 3, 6) motions from each of (n, 4, 4) poses to the next.

    Motions are in the frame of the (n - 1, 4, 4) pose from which they are seen.
    """
    screws, shifts = log(invert(poses[:-1]) @ poses[1:]), np.diff(poses[:, :3, 3], axis=0)
    along = np.einsum("nji,nj->ni", seen_from[:, :3, :3], shifts)
    across = np.append(np.zeros_like(along), screws[:, 3:] - along, axis=1)
    places = np.append(np.zeros_like(along), along, axis=1)
    return np.stack([screws - across, across, places], axis=1)


@dataclass(frozen=True, eq=False)
class StopsShort(_AlongMotion):
    """An arm that stands short of its poses, along its last motion."""

    kind = "stops short"
    clause = "the arm stood short of its poses"
    do = (
        "Wait until the arm stands still before each image, and log the poses that the controller "
        "measures, not those that it was sent to."
    )

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        off = cls.off_m(values)
        way = "short of" if off < 0.0 else "beyond"
        return (
            f"At each stop the arm stood {way} the pose that was logged, along its last motion: by "
            f"{figure(1e3 * abs(off))} mm after one of 0.3 m. The result counts it."
        )

    @staticmethod
    def motions(poses: FloatArray) -> FloatArray:
        """See `_AlongMotion`."""
        return np.append(np.zeros((1, 3, 6)), _between(poses, poses[1:]), axis=0)


@dataclass(frozen=True, eq=False)
class MovesOn(_AlongMotion):
    """An arm that moves on to its next stop between pose and image."""

    kind = "moves on"
    clause = "the arm had moved on between pose and image"
    do = "Log pose and image of each stop while the arm stands still, before it is sent on."

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        off = cls.off_m(values)
        first, then = ("image", "pose") if off < 0.0 else ("pose", "image")
        return (
            f"The arm had moved on towards the next stop between {first} and {then}, of which the "
            f"{then} is the later: by {figure(1e3 * abs(off))} mm of a motion of 0.3 m. The result "
            "counts it."
        )

    @staticmethod
    def motions(poses: FloatArray) -> FloatArray:
        """See `_AlongMotion`."""
        return np.append(_between(poses, poses[:-1]), np.zeros((1, 3, 6)), axis=0)
