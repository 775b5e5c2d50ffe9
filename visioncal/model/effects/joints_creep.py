"""Joints whose zeros creep during the session, as those of an arm that warms up, or step."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.moves import still_to_come
from visioncal.model.arm import Moments
from visioncal.model.effects.creep import RATES
from visioncal.model.effects.effect import Effect, Named, Stood
from visioncal.model.effects.joints import JointEffect


@dataclass(frozen=True, eq=False)
class _ZerosMove(JointEffect):
    """Turn of each joint's zero during the session [rad].

    The picks come after the session: at its end it is zero.
    """

    bounds = 1e-2, 1e-7, 0.1

    @abstractmethod
    def left(self, moments: Moments) -> FloatArray:
        """(k,) share of the motion that is still to come."""

    def turns(self, q: FloatArray, moments: Moments) -> FloatArray:
        """See `JointEffect`."""
        return np.tile(np.eye(self.count), (len(q), 1, 1)) * self.left(moments)[:, None, None]


@dataclass(frozen=True, eq=False)
class JointsStep(_ZerosMove):
    """Joints whose zeros were lost at once."""

    kind, clause = "joints step", "a joint's zero was lost"
    progress: float = -0.5  # Of the session, up to which the joints are where they were.

    def left(self, moments: Moments) -> FloatArray:
        """See `_ZerosMove`."""
        return np.asarray(moments.progress <= self.progress, dtype=float)


@dataclass(frozen=True, eq=False)
class JointsCreep(_ZerosMove, Named):
    """Joints whose zeros creep all over the session."""

    kind, most = "joints creep", 3e-3
    hides = ("joint_slipped",)
    clause = "the arm's joints crept"
    do = (
        "Let the arm warm up at its work for half an hour, and record again; or record its "
        "temperatures, by which --level thermal calibrates what they do."
    )
    rate: float = 0.0  # By which it fades, over the session; zero of an even one.

    @classmethod
    def of_flange(cls, flange: str, stood: Stood) -> Iterator[Effect]:
        """Evenly; as what warms up; as what settles in the first stops."""
        # Sliding joints have other sizes; their creep is that of frames.
        if stood.robot is not None and not stood.robot.chain.prismatic.any():
            yield from (cls(flange, stood.robot, rate) for rate in RATES)

    @classmethod
    def says(cls, values: FloatArray) -> str:
        """See `Named`."""
        up_to_deg = float(np.rad2deg(np.abs(values).max()))
        return (
            f"The joints' zeros crept during the session, by up to {figure(up_to_deg)} deg, as of "
            "an arm that warms up or cools. The result is that of its end."
        )

    def left(self, moments: Moments) -> FloatArray:
        """See `_ZerosMove`."""
        return still_to_come(moments.progress, self.rate)
