"""Errors of an arm's posture: a base that tilts, and what the flange carries that bends."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import LEVER_M, adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import SIGNIFICANT, Effect, Named, Size, Stood

# Likelihood ratio of linear axes that are off: arms of revolute joints that err otherwise by their
# posture are a hundred times as frequent.
_RARER = SIGNIFICANT + 2.0 * float(np.log(100.0))


@dataclass(frozen=True, eq=False)
class PostureEffect(Effect):
    """Errors of a flange, less one twist of its base, or of its base and itself, at all postures.

    These belong to the frames of which the robot reports: the result is that of the stops' mean
    posture.
    """

    stops: FloatArray  # (s, 4, 4) the flange at them.
    # Whether what errs goes along with the flange: else it is where the arm says, but for its base.
    moves_flange: ClassVar[bool] = False

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """See `Named`."""
        yield cls(flange, stood.poses[stood.seen])

    @abstractmethod
    def raw(self, poses: FloatArray) -> FloatArray:
        """Columns (k, 6, c) at (k, 4, 4) flanges."""

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`."""
        del distances
        poses = moments.poses[self.frame]
        return np.asarray(self.raw(poses) - twists_of_frames(poses) @ self.frames)

    @property
    def _weights(self) -> FloatArray:
        """(6, 1) weights of a twist: a turn counts by its motion at the lever [m]."""
        return np.repeat([LEVER_M, 1.0], 3)[:, None]

    @cached_property
    def frames(self) -> FloatArray:
        """(12, c) twists of base and flange that are nearest to the columns at the stops."""
        return self._by_stops @ (self._weights * self.raw(self.stops)).reshape(-1, self.count)

    @cached_property
    def _by_stops(self) -> FloatArray:
        """(12, 6 s) derivative of the nearest twists of base and flange by errors at the stops."""
        every = (self._weights * twists_of_frames(self.stops)).reshape(-1, 12)
        if not self.moves_flange:
            every[:, 6:] = 0.0
        return np.asarray(np.linalg.pinv(every, rcond=1e-9))

    def covariance_of_frames(self, square: FloatArray) -> FloatArray:
        """(12, 12) covariance of these twists, as other stops have them.

        The stops are some of all postures: each is an independent draw (White 1980).

        Args:
            square: (c, c) expectation of the values' products.
        """
        count = len(self.stops)
        raw = self.raw(self.stops) - twists_of_frames(self.stops) @ self.frames
        by_stop = self._by_stops.reshape(12, count, 6).swapaxes(0, 1)
        each = by_stop @ (self._weights * raw)
        found = np.einsum("uac,cd,ubd->ab", each, square, each, optimize=True)
        return np.asarray(found * count / max(count - 2, 1))


def twists_of_frames(poses: FloatArray) -> FloatArray:
    """(k, 6, 12) twists of (k, 4, 4) flanges by those of their base, and by their own."""
    by_flange = np.broadcast_to(np.eye(6), (len(poses), 6, 6))
    return np.concatenate([adjoint(invert(poses)), by_flange], axis=2)


@dataclass(frozen=True, eq=False)
class BaseTilts(PostureEffect, Named):
    """Tilts of the base about its x and y [rad/m] with the flange's x, and with its y.

    Its stand, or the floor, gives way under the moment of the arm's weight.
    """

    kind, bounds, count, most = "base tilts", (1e-2, 1e-7, 0.1), 4, 5e-3
    clause = "the base tilts as the arm reaches out"
    do = "Tighten the base's screws, and stiffen what it stands on, or keep to one reach."

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        size = figure(1e3 * float(np.linalg.norm(values.reshape(2, 2), ord=2)))
        return (
            f"The base tilts as the arm reaches out, by {size} mrad for each metre. The result "
            "counts it, with the base as it stands on average at these stops; the robot's own "
            "poses do not."
        )

    def raw(self, poses: FloatArray) -> FloatArray:
        """See `PostureEffect`."""
        turns = adjoint(invert(poses))[:, :, :2]
        return np.concatenate([turns * poses[:, axis, 3, None, None] for axis in (0, 1)], axis=2)


@dataclass(frozen=True, eq=False)
class Stretches(PostureEffect, Named):
    """The share by which a robot goes farther along an axis of its base than it reports.

    As of a linear axis of another scale than its controller has.
    """

    bounds, count, most = (1e-2, 1e-6, 0.1), 1, 2e-2
    # Along which axis the flange goes by a share of its place along another, or along the same.
    shares: ClassVar[tuple[tuple[int, int], ...]]
    do = (
        "Measure a long way along that axis, and correct its scale in the controller; then record "
        "again."
    )

    @property
    def size(self) -> Size:
        """See `Effect`."""
        return replace(super().size, limit=_RARER)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        (share,) = values.tolist()
        way, axis = "farther" if share > 0.0 else "less far", "xyz"[cls.shares[0][0]]
        return (
            f"The robot goes {figure(100 * abs(share))} % {way} along its base's {axis} than it "
            "reports, as where a linear axis has another scale. The result counts it; the robot's "
            "own poses do not."
        )

    def raw(self, poses: FloatArray) -> FloatArray:
        """See `PostureEffect`."""
        found = np.zeros((len(poses), 6, self.count))
        for column, (axis, by) in enumerate(self.shares):
            found[:, 3:, column] = poses[:, axis, :3] * poses[:, by, 3:]
        return found


class XStretches(Stretches):
    """Stretch along the base's x."""

    kind, shares = "x stretches", ((0, 0),)
    clause = "the robot's x has another scale"


class YStretches(Stretches):
    """Stretch along the base's y."""

    kind, shares = "y stretches", ((1, 1),)
    clause = "the robot's y has another scale"


class ZStretches(Stretches):
    """Stretch along the base's z."""

    kind, shares = "z stretches", ((2, 2),)
    clause = "the robot's z has another scale"


class AxesSkew(Stretches):
    """Linear axes that are not square to each other."""

    kind, count, shares = "axes skew", 3, ((0, 1), (0, 2), (1, 2))
    clause = "the robot's linear axes are not square"
    do = "Measure the axes with a square, and correct them in the controller; then record again."

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        angles = 90.0 - np.rad2deg(values)
        pairs = ("x and y", "x and z", "y and z")
        meet = ", ".join(
            f"{pair} meet at {at:.3f} deg" for pair, at in zip(pairs, angles, strict=True)
        )
        return (
            f"The robot's linear axes are not square: {meet}. The result counts it; the robot's "
            "own poses do not."
        )


@dataclass(frozen=True, eq=False)
class BracketBends(PostureEffect, Named):
    """Bends of what the flange carries [m], linear in gravity's direction along its axes.

    Turns are times a length of 0.1 m. A bend that is a twist of base and flange is in no view:
    where the tool bends along, the base is as if it were elsewhere; where the camera's bracket does
    alone, it is not, and the mean bend is all the flange's.
    """

    kind, bounds, count, most = "bracket bends", (1e-2, 1e-7, 0.1), 18, 3e-3
    clause = "what the flange carries bends with its weight"
    moves_flange = True
    do = "Stiffen the bracket, or record and work in the same attitudes."

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        by = mm_and_deg(*cls.up_to(values))
        return (
            f"The load on the flange bends with its weight, by up to {by}. The result is that of "
            "the views' mean attitude; whether a tool bends along, no view shows."
        )

    @staticmethod
    def up_to(values: FloatArray) -> tuple[float, float]:
        """How far it bends at most, by its (18,) values [mm, deg]."""
        turn, shift = (float(np.linalg.norm(at, ord=2)) for at in values.reshape(2, 3, 3))
        return 1e3 * shift, float(np.rad2deg(turn / 0.1))

    def unseen(self, moments: Moments) -> FloatArray:
        """See `Effect`: by twists of base and flange, less those of the flange alone."""
        away = self.frames.copy()
        away[6:] -= self.raw(self.stops).mean(axis=0)
        shown, sizes, _ = np.linalg.svd(away, full_matrices=False)
        # Of a bracket that bends at random; of one that bends alike in all directions, up to three
        # times as large, which would be said of an arm's errors that look like bends, too.
        return np.asarray(twists_of_frames(moments.poses[self.frame]) @ (shown * sizes))

    def raw(self, poses: FloatArray) -> FloatArray:
        """See `PostureEffect`."""
        scales = np.repeat([10.0, 1.0], 3)
        return np.asarray(
            np.kron(np.diag(scales), np.ones((1, 3))) * np.tile(-poses[:, None, 2, :3], 6)
        )
