"""A whole cell at once: its frames, what was seen of them, and how that moves with the unknowns.

An observation is that one frame (a camera's, an instrument's) saw where another was (a board's, a
point's). Its residual is `log(predicted^-1 * measured)`, in the frame that was seen. Noise is that
of the observation itself, whose covariance is known up to its sensor's level, and one small error
of each robot's flange at each of its stops, which all that was seen by way of that flange shares
(Strobl and Hirzinger 2006; Ulrich and Hillemann 2021, for one robot).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.estimator.networktree import Step, Tree
from visioncal.estimator.sightings import Common, Noise, Sightings, State
from visioncal.transforms import adjoint, exp, inverse_right_jacobian, invert, log
from visioncal.types import FloatArray, IntArray, Mask

# A rotation that was not measured is supplied, and counts for nothing beside a variance of one.
_UNTOLD = 1.0
# Information that keeps a rotation that is a matter of choice [1 / rad^2].
_CHOSEN = 1e12
# What a flange's error may be where nothing was seen of it [rad^2 and m^2]: nothing is known.
ANYTHING = 1e4


@dataclass(frozen=True, eq=False)
class _Group:
    """The observations of one pair of frames, and the way between them."""

    rows: IntArray
    way: tuple[Step, ...]


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals (n, 6), their derivatives (n, 6, p), and by the flanges' errors (n, 6, 6 w).

    The latter in the places of the robots that the observation's unit has; see `Network.units`.
    """

    residuals: FloatArray
    jacobian: FloatArray
    slack: FloatArray


@dataclass(frozen=True, eq=False)
class Network:
    """The frames, the robots' poses and the observations.

    Attributes:
        tree: The frames.
        poses: (s, 4, 4) `base_from_flange` by robot and stop; not a number where unknown.
        sightings: What was seen.
        common: What is known of the values that are shared.
        by_flange: (s, 6, k) by robot, how its flange moves at every stop with what is shared; of
            robots that are as they say, nothing.
        least_levels: (s,) below which no sensor's level is; where there are none, any.
        points: Frames of which only the place is asked for: their rotation is a matter of choice.
    """

    tree: Tree
    poses: Mapping[str, FloatArray]
    sightings: Sightings
    common: Common
    points: frozenset[str] = frozenset()
    least_levels: FloatArray = field(default_factory=lambda: np.zeros(0))
    by_flange: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.sightings)

    def subset(self, chosen: Mask) -> "Network":
        """Returns the network with the observations of an (n,) mask."""
        return replace(self, sightings=self.sightings.subset(chosen))

    @cached_property
    def unknown(self) -> Mapping[str, int]:
        """Places of the unknown frames among the edges."""
        return {name: at for at, name in enumerate(self.tree.unknown)}

    @cached_property
    def chosen(self) -> FloatArray:
        """(p,) information that keeps what is a matter of choice: rotations of points."""
        kept = np.zeros(self.size)
        for name, at in self.unknown.items():
            if name in self.points:
                kept[6 * at : 6 * at + 3] = _CHOSEN
        return kept

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return 6 * len(self.unknown) + len(self.common.pull)

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the order of the noise's levels."""
        return tuple(self.poses)

    @cached_property
    def groups(self) -> tuple[_Group, ...]:
        """The observations by pairs of frames."""
        rows: dict[tuple[str, str], list[int]] = {}
        pairs = zip(self.sightings.seers, self.sightings.seen, strict=True)
        for at, pair in enumerate(pairs):
            rows.setdefault(pair, []).append(at)
        return tuple(_Group(np.array(at), self.tree.way(*pair)) for pair, at in rows.items())

    @cached_property
    def units(self) -> tuple[IntArray, IntArray]:
        """Observations whose robots' errors belong together.

        Returns:
            (n,) the unit of each observation, -1 where no robot has a part in it, and (u, w) the
            robots of each unit by their places, -1 where it has fewer.
        """
        count, joined = len(self.robots), []
        first = np.full(len(self), -1, dtype=np.int64)
        for group in self.groups:
            mine = [self.robots.index(it.robot) for it in group.way if it.robot]
            keys = self.sightings.stops[group.rows] * count
            if mine:
                first[group.rows] = keys + mine[0]
                joined += [np.stack([keys + mine[0], keys + it], axis=1) for it in mine]
        if not joined:
            return first, np.zeros((0, 0), dtype=np.int64)
        used, pairs = np.unique(np.concatenate(joined), return_inverse=True)
        pairs = pairs.reshape(-1, 2)
        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(used), len(used)))
        units, of_key = connected_components(links, directed=False)
        members = [np.unique(used[of_key == it] % count) for it in range(units)]
        robots = np.full((units, max(map(len, members))), -1, dtype=np.int64)
        for row, robot in zip(robots, members, strict=True):
            row[: len(robot)] = robot
        of = np.where(first < 0, -1, of_key[np.searchsorted(used, np.maximum(first, used[0]))])
        return of, robots

    def _edge(self, step: Step, state: State, stops: IntArray) -> FloatArray:
        """(4, 4) or (m, 4, 4) `parent_from_frame` of a step."""
        if step.robot:
            poses, moves = self.poses[step.robot][stops], self.by_flange.get(step.robot)
            return poses if moves is None else poses @ exp(moves[stops] @ state.shared)
        known = self.tree.branches[step.frame].known
        return state.edges[self.unknown[step.frame]] if known is None else known

    def _product(self, way: tuple[Step, ...], state: State, stops: IntArray) -> FloatArray:
        product = np.broadcast_to(np.eye(4), (len(stops), 4, 4))
        for step in way:
            edge = self._edge(step, state, stops)
            product = product @ (invert(edge) if step.is_up else edge)
        return product

    def predicted(self, state: State) -> FloatArray:
        """The (n, 4, 4) `seer_from_seen` that the unknowns and the robots predict."""
        found = np.zeros((len(self), 4, 4))
        for group in self.groups:
            found[group.rows] = self._product(group.way, state, self.sightings.stops[group.rows])
        return found

    def measured(self, state: State) -> FloatArray:
        """The (n, 4, 4) measured poses as they are under the values that are shared."""
        seen = self.sightings
        if not len(state.shared):
            return seen.measured
        return seen.measured @ exp(seen.by_shared @ state.shared)

    def linear(self, state: State, *, ideal: bool = False) -> Linear:
        """Linearises all residuals.

        Args:
            state: Where.
            ideal: As if all that was measured were what is predicted: noise then does not pass for
                information about directions that are open.
        """
        seen, predicted = self.sightings, self.predicted(state)
        error = np.broadcast_to(np.eye(4), predicted.shape)
        if not ideal:
            error = invert(predicted) @ self.measured(state)
        residuals = np.where(seen.turned[:, None], log(error), _places(error))
        by_measured = np.where(
            seen.turned[:, None, None], inverse_right_jacobian(residuals), _place_slope(error)
        )
        by_predicted = -np.where(
            seen.turned[:, None, None],
            by_measured @ adjoint(invert(error)),
            _place_slope(np.broadcast_to(np.eye(4), error.shape)),
        )
        edges, slack, arms = self._slopes(state)
        shared = by_measured @ seen.by_shared + by_predicted @ arms
        return Linear(
            residuals, np.concatenate([by_predicted @ edges, shared], axis=2), by_predicted @ slack
        )

    def _slopes(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How what is predicted moves.

        Returns:
            (n, 6, 6 e) with the edges, (n, 6, 6 w) with the flanges, and (n, 6, k) with what is
            shared of the arms.
        """
        of, members = self.units
        edges = np.zeros((len(self), 6, 6 * len(self.unknown)))
        slack = np.zeros((len(self), 6, 6 * members.shape[1]))
        arms = np.zeros((len(self), 6, len(state.shared)))
        for group in self.groups:
            rest = np.broadcast_to(np.eye(4), (len(group.rows), 4, 4))
            stops = self.sightings.stops[group.rows]
            for step in reversed(group.way):
                edge = self._edge(step, state, stops)
                # An edge moves on its right: at its end, or at its start where it is gone up.
                before = invert(edge) @ rest if step.is_up else edge @ rest
                moved = -adjoint(invert(before)) if step.is_up else adjoint(invert(rest))
                if step.frame in self.unknown:
                    at = 6 * self.unknown[step.frame]
                    edges[group.rows, :, at : at + 6] += moved
                if step.robot:
                    mine = members[of[group.rows]] == self.robots.index(step.robot)
                    for slot in range(members.shape[1]):
                        rows = group.rows[mine[:, slot]]
                        slack[rows, :, 6 * slot : 6 * slot + 6] += moved[mine[:, slot]]
                if step.robot in self.by_flange:
                    arms[group.rows] += moved @ self.by_flange[step.robot][stops]
                rest = before
        return edges, slack, arms

    def change_of(self, frame: str, state: State) -> FloatArray:
        """The change of a frame's edge that each observation asks for, were all else right.

        Args:
            frame: A frame that hangs by no robot.
            state: The unknowns.

        Returns:
            (n, 4, 4) on the right of the edge; not a number where it has no part in what was seen.
        """
        asked = np.full((len(self), 4, 4), np.nan)
        error = invert(self.predicted(state)) @ self.measured(state)
        for group in self.groups:
            frames = [step.frame for step in group.way]
            if frame not in frames:
                continue
            at, stops = frames.index(frame), self.sightings.stops[group.rows]
            step, rest = group.way[at], self._product(group.way[at + 1 :], state, stops)
            if step.is_up:
                carry = invert(self._edge(step, state, stops)) @ rest
                asked[group.rows] = carry @ invert(error[group.rows]) @ invert(carry)
            else:
                asked[group.rows] = rest @ error[group.rows] @ invert(rest)
        return asked

    def spread(self, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of the observations' own noise."""
        seen = self.sightings
        # Behind the sensors' levels, that of covariances which are known.
        level = np.append(noise.sensors, 1.0)[seen.sensors]
        spread = level[:, None, None] ** 2 * seen.covariance
        untold = np.flatnonzero(~seen.turned)
        spread[untold, :3, :] = spread[untold, :, :3] = 0.0
        spread[untold, :3, :3] = _UNTOLD * np.eye(3)
        return spread

    def total(self, linear: Linear, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of single residuals, the flanges' errors among their noise."""
        spread, (of, _) = self.spread(noise), self.units
        rows = of >= 0
        if rows.any():
            # Slots of robots that are not in an observation's way move nothing of it.
            slack, between = linear.slack[rows], self.flange_spread(noise)[of[rows]]
            spread[rows] += (slack * between[:, None, :]) @ np.swapaxes(slack, 1, 2)
        return spread

    def flange_spread(self, noise: Noise) -> FloatArray:
        """Variances (u, 6 w) of the flanges' errors of each unit."""
        _, members = self.units
        levels = np.repeat(noise.robots, 3, axis=1) ** 2
        spread = np.where(members[:, :, None] >= 0, levels[members], ANYTHING)
        return spread.reshape(len(members), -1) if len(members) else np.zeros((0, 0))


def _places(error: FloatArray) -> FloatArray:
    """Residuals (n, 6) of places alone."""
    return np.concatenate([np.zeros_like(error[:, :3, 3]), error[:, :3, 3]], axis=1)


def _place_slope(error: FloatArray) -> FloatArray:
    """How a place (n, 6, 6) moves with a motion of its frame."""
    slope = np.zeros((len(error), 6, 6))
    slope[:, 3:, 3:] = error[:, :3, :3]
    return slope
