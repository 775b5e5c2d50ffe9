"""Several boards in one chain of frames.

The chain ends at one board, the first. A view of another is brought there by where that board lies
from the first: a start, and six unknowns that all of its views share. So the chain stays one chain,
and what is estimated of it holds for all boards together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.closure import Closure, Edges, deviations
from visioncal.estimation.problem import Effect
from visioncal.estimation.variance import Knowledge
from visioncal.transforms import adjoint, exp, invert
from visioncal.types import FloatArray, IntArray

# Where a board lies is known to so much without any view [rad and m]: nothing, for a fit, but
# enough to keep a board in its place that has no view in a part of the data.
_ANYWHERE = 1e2


@dataclass(frozen=True, eq=False)
class Boards:
    """The boards of m views.

    Attributes:
        names: Their b names, the first one's first; an only board has an empty name.
        shown: (m,) the place in `names` of the board that each view shows.
        from_first: (b, 4, 4) `target_k_from_target_1` as it is thought to be; the first's is the
            identity.
        begin: Where their unknowns stand among those that the views share, once these are known:
            behind those of lens and boards.
    """

    names: tuple[str, ...]
    shown: IntArray
    from_first: FloatArray
    begin: int = 0

    @classmethod
    def one(cls, views: int) -> "Boards":
        """The only board of so many views."""
        return cls(("",), np.zeros(views, dtype=np.int64), np.eye(4)[None])

    @property
    def places(self) -> slice:
        """The unknowns of where the boards are, among those that the views share."""
        return slice(self.begin, self.begin + self.unknowns)

    @property
    def unknowns(self) -> int:
        """How many unknowns it takes to place the boards behind the first."""
        return 6 * (len(self.names) - 1)

    def brought(self, data: Closure) -> Closure:
        """Brings views to the first board, and adds the unknowns by which they come there.

        Args:
            data: The views, each with the pose of its own board, and how it moves with what is
                shared so far.
        """
        if not self.unknowns:
            return data
        carry = self.from_first[self.shown]
        carried = adjoint(invert(carry))
        known = data.camera_covariance
        return replace(
            data,
            camera=data.camera @ carry,
            camera_covariance=None
            if known is None
            else carried @ known @ np.swapaxes(carried, 1, 2),
            effects=tuple(map(self.carried, data.effects)),
        ).with_more(self._effect())

    def carried(self, effect: Effect) -> Effect:
        """Returns an effect on the views' own boards as one on the first board."""
        return effect.carried(adjoint(invert(self.from_first[self.shown])))

    def _effect(self) -> Effect:
        """Where the further boards are, as unknowns of the chain."""
        count = self.unknowns
        moved = np.zeros((len(self.shown), 6, count))
        for board in range(1, len(self.names)):
            moved[self.shown == board, :, 6 * board - 6 : 6 * board] = np.eye(6)
        known = Knowledge(np.eye(count) / _ANYWHERE**2, np.zeros(count))
        return Effect.free("boards", known, moved)

    def moved(self, shared: FloatArray) -> "Boards":
        """Returns the boards after a (k,) change of what the views share."""
        if not self.unknowns:
            return self
        steps = np.concatenate([np.zeros(6), shared[self.places]]).reshape(-1, 6)
        return replace(self, from_first=self.from_first @ exp(steps))

    @property
    def first_from_own(self) -> FloatArray:
        """(m, 4, 4) each view's board, in the frame of the first."""
        return invert(self.from_first)[self.shown]

    def deviations(self, placed: FloatArray, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviation of each view's board from its mean over the views: (m,) [m] and (m,) [rad].

        Args:
            placed: (m, 4, 4) where each view places the first board.
            shared: (k,) change of what the views share.
        """
        own = placed @ self.moved(shared).first_from_own
        away = np.zeros((2, len(placed)))
        for board in range(len(self.names)):
            mine = self.shown == board
            if mine.any():
                away[:, mine] = deviations(own[mine])
        return away[0], away[1]

    def units(self, stops: IntArray) -> IntArray:
        """Numbers what is seen of one board at one stop, from 0 in the order of appearance.

        Args:
            stops: (m,) the stop of each view.
        """
        keys: dict[tuple[int, int], int] = {}
        both = zip(stops.tolist(), self.shown.tolist(), strict=True)
        return np.array([keys.setdefault(it, len(keys)) for it in both], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Placed:
    """All boards as the chain places them.

    Attributes:
        names: The boards' names.
        z: (b, 4, 4) each board's edge: `base_from_target` or `flange_from_target`.
        slope: (6 + 6 b, 12 + k) how x and these edges move with the chain's unknowns, all of them
            by right perturbations.
        first_from: (b, 4, 4) `target_1_from_target_k`, the chain ending at board 1.
    """

    names: tuple[str, ...]
    z: FloatArray
    slope: FloatArray
    first_from: FloatArray

    def seen_with(self, z: FloatArray) -> FloatArray:
        """All boards' edges (b, 4, 4) where the first one's is another, (4, 4)."""
        return np.asarray(z @ self.first_from)

    def sorted(self, order: Sequence[int]) -> "Placed":
        """Returns the boards in another order."""
        blocks = [np.arange(6), *(6 + 6 * it + np.arange(6) for it in order)]
        return Placed(
            tuple(self.names[it] for it in order),
            self.z[list(order)],
            self.slope[np.concatenate(blocks)],
            self.first_from[list(order)],
        )

    def covariance(self, spread: FloatArray) -> FloatArray:
        """Covariance (6 + 6 b, 6 + 6 b) of x and all boards, from (12 + k, 12 + k) of the chain."""
        return np.asarray(self.slope @ spread @ self.slope.T)


def place(boards: Boards, edges: Edges) -> Placed:
    """Places all boards.

    Args:
        boards: Where they lie from the first.
        edges: Both edges of the chain, with what is shared.
    """
    settled = boards.moved(edges.shared)
    first_from = invert(settled.from_first)
    z = edges.z @ first_from
    slope = np.zeros((6 + 6 * len(z), 12 + len(edges.shared)))
    slope[:12, :12] = np.eye(12)
    for board in range(1, len(z)):
        # z_k exp(d_k) = z exp(d) exp(-d_u) target_1_from_target_k
        carried = adjoint(settled.from_first[board])
        rows = slice(6 + 6 * board, 12 + 6 * board)
        at = 12 + boards.begin + 6 * (board - 1)
        slope[rows, 6:12], slope[rows, at : at + 6] = carried, -carried
    return Placed(boards.names, z, slope, first_from)
