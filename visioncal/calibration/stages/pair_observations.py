"""Observations of a whole cell by pairs of frames, from which initial poses are found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.pairwise import Candidates
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.tree import PathStep, Tree

# Share of the stops, and fewest views of a pair, that initial poses are estimated from.
_EARLY_SHARE, _FEWEST_EARLY = 0.4, 8


@dataclass(frozen=True, eq=False)
class Sighted:
    """Candidate poses of n observations."""

    seers: tuple[str, ...]  # (n,) the observing frame.
    seen: tuple[str, ...]  # (n,) the observed frame.
    stops: IntArray  # (n,) the stop, numbered from 0 in the order of time.
    candidates: Candidates  # The poses `seer_from_seen` that each allows.
    # (t, 4, 4) rotational symmetries, by the frame of a target that has them.
    turned: Mapping[str, FloatArray]
    places: Mask  # (n,) whether a position alone was read, so that the rotation has no meaning.

    def turns_of(self, frame: str) -> FloatArray:
        """The turns (t, 4, 4) after which a frame looks the same, the identity first."""
        return self.turned.get(frame, np.eye(4)[None])

    def early(self, rows: IntArray) -> IntArray:
        """The earliest of a pair's rows, which are in the order of time."""
        last_stop = _EARLY_SHARE * float(self.stops.max())
        count = int(np.searchsorted(self.stops[rows], last_stop, side="right"))
        return rows[: max(count, _FEWEST_EARLY)]


@dataclass(frozen=True, eq=False)
class Relation:
    """A transform `first_from_second` (4, 4) between two frames of one body.

    `sigma_m` has rotations on a lever [m]; `turns` (t, 4, 4) are symmetries by which the second
    frame may have been seen turned.
    """

    first: str
    second: str
    matrix: FloatArray
    sigma_m: float
    turns: FloatArray


@dataclass(frozen=True, eq=False)
class FramePair:
    """The observations of a pair of frames (rows, in the order of time), and their path."""

    seer: str
    seen: str
    rows: IntArray
    path: tuple[PathStep, ...]

    @property
    def robots(self) -> tuple[PathStep, ...]:
        """The robots in the path."""
        return tuple(step for step in self.path if step.robot)


@dataclass(frozen=True, eq=False)
class Growth:
    """Input of the tree's growth."""

    tree: Tree  # The frames.
    poses: Mapping[str, FloatArray]  # (s, 4, 4) `base_from_flange` by robot and stop.
    sighted: Sighted  # The observations.
    pairs: Sequence[FramePair]  # The observations by pairs of frames.
    relations: Sequence[Relation]  # Transforms that pairs determine by themselves.
    measured: frozenset[str] = frozenset()  # The frames with a prior.

    @property
    def oriented(self) -> tuple[FramePair, ...]:
        """The pairs whose rotations were measured, too."""
        return tuple(pair for pair in self.pairs if not self.sighted.places[pair.rows[0]])

    @property
    def pointed(self) -> tuple[FramePair, ...]:
        """The pairs of which positions alone were read."""
        return tuple(pair for pair in self.pairs if self.sighted.places[pair.rows[0]])


@dataclass(frozen=True, eq=False)
class Factor:
    """A factor of a chain: a frame's pose in its body, or a robot's poses (m, 4, 4)."""

    frame: str
    robot: FloatArray
    is_inverse: bool


def factors_of(growth: Growth, pair: FramePair, rows: IntArray) -> list[Factor]:
    """The chain `seer_from_seen` as factors."""
    stops = growth.sighted.stops[rows]
    identity = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
    chain = [Factor(pair.seer, identity, True)]
    for step in pair.robots:
        robot = growth.poses[step.robot][stops]
        base = Factor(growth.tree.branches[step.frame].parent, identity, step.is_up)
        flange = Factor("", robot, step.is_up)
        chain += [flange, base] if step.is_up else [base, flange]
    return [*chain, Factor(pair.seen, identity, False)]


def product_of(factors: Sequence[Factor], placed: Mapping[str, FloatArray]) -> FloatArray:
    """Product (m, 4, 4) of factors with placed frames; (1, 4, 4) without a robot."""
    product = np.eye(4)[None]
    for factor in factors:
        matrix = factor.robot @ placed[factor.frame] if factor.frame else factor.robot
        product = product @ (invert(matrix) if factor.is_inverse else matrix)
    return product
