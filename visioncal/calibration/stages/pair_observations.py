"""What was seen of a whole cell, as its start is found from it: by pairs of frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.pairwise import Candidates
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.tree import PathStep, Tree

# The earliest share of the stops, and the fewest views of a pair, that a start is taken from.
_EARLY_SHARE, _FEWEST_EARLY = 0.4, 8


@dataclass(frozen=True, eq=False)
class Sighted:
    """What n observations may have seen.

    Attributes:
        seers: (n,) the frame that saw.
        seen: (n,) the frame that was seen.
        stops: (n,) the stop, numbered from 0 in the order of time.
        candidates: The poses `seer_from_seen` that each allows.
        turned: By the frame of a target that looks the same turned: (t, 4, 4) its turns.
        places: (n,) whether a place alone was read; its rotation then says nothing.
    """

    seers: tuple[str, ...]
    seen: tuple[str, ...]
    stops: IntArray
    candidates: Candidates
    turned: Mapping[str, FloatArray]
    places: Mask

    def turns_of(self, frame: str) -> FloatArray:
        """The turns (t, 4, 4) after which a frame looks the same; the identity comes first."""
        return self.turned.get(frame, np.eye(4)[None])

    def early(self, rows: IntArray) -> IntArray:
        """The earliest of a pair's rows, which are in the order of time."""
        last = _EARLY_SHARE * float(self.stops.max())
        count = int(np.searchsorted(self.stops[rows], last, side="right"))
        return rows[: max(count, _FEWEST_EARLY)]


@dataclass(frozen=True, eq=False)
class Relation:
    """A transform between two frames of one body.

    Attributes:
        first: The one.
        second: The other.
        matrix: (4, 4) `first_from_second`.
        sigma_m: What it is known to, rotations on a lever [m].
        turns: (t, 4, 4) those by which the second may have been seen turned.
    """

    first: str
    second: str
    matrix: FloatArray
    sigma_m: float
    turns: FloatArray


@dataclass(frozen=True, eq=False)
class FramePair:
    """The observations of one pair of frames.

    Attributes:
        seer: The frame that saw.
        seen: The frame that was seen.
        rows: The observations, in the order of time.
        way: The way from the one to the other.
    """

    seer: str
    seen: str
    rows: IntArray
    way: tuple[PathStep, ...]

    @property
    def robots(self) -> tuple[PathStep, ...]:
        """The robots in the way."""
        return tuple(step for step in self.way if step.robot)


@dataclass(frozen=True, eq=False)
class Growth:
    """All that the tree may grow by.

    Attributes:
        tree: The frames.
        poses: (s, 4, 4) `base_from_flange` by robot and stop.
        sighted: What was seen.
        pairs: The same by pairs of frames.
        relations: What pairs say by themselves.
        measured: The frames that a prior is about.
    """

    tree: Tree
    poses: Mapping[str, FloatArray]
    sighted: Sighted
    pairs: Sequence[FramePair]
    relations: Sequence[Relation]
    measured: frozenset[str] = frozenset()

    @property
    def oriented(self) -> tuple[FramePair, ...]:
        """The pairs of which rotations were measured, too."""
        return tuple(pair for pair in self.pairs if not self.sighted.places[pair.rows[0]])

    @property
    def pointed(self) -> tuple[FramePair, ...]:
        """The pairs of which places alone were read."""
        return tuple(pair for pair in self.pairs if self.sighted.places[pair.rows[0]])


@dataclass(frozen=True, eq=False)
class Factor:
    """A part of a chain: where a frame is in its body, or a robot's poses (m, 4, 4)."""

    frame: str
    robot: FloatArray
    is_inverse: bool


def factors_of(growth: Growth, pair: FramePair, rows: IntArray) -> list[Factor]:
    """The chain `seer_from_seen` by bodies."""
    stops = growth.sighted.stops[rows]
    none = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
    chain = [Factor(pair.seer, none, True)]
    for step in pair.robots:
        robot = growth.poses[step.robot][stops]
        base = Factor(growth.tree.branches[step.frame].parent, none, step.is_up)
        flange = Factor("", robot, step.is_up)
        chain += [flange, base] if step.is_up else [base, flange]
    return [*chain, Factor(pair.seen, none, False)]


def product_of(factors: Sequence[Factor], placed: Mapping[str, FloatArray]) -> FloatArray:
    """Their product (m, 4, 4) with the frames where they are placed; (1, 4, 4) of no robot."""
    product = np.eye(4)[None]
    for factor in factors:
        matrix = factor.robot @ placed[factor.frame] if factor.frame else factor.robot
        product = product @ (invert(matrix) if factor.is_inverse else matrix)
    return product
