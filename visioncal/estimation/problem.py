"""The estimation problem of a cell: a tree of frames, observations, and blocks of unknowns.

An observation is that one frame (a camera's, an instrument's) measured where another is (a
board's, a point's). Its residual is `log(predicted^-1 * measured)`, in the observed frame. Noise is
that of the observation itself, whose covariance is known up to its sensor's level, and one small
error of each robot's flange at each of its stops, which all observations by way of that flange
share (Strobl and Hirzinger 2006; Ulrich and Hillemann 2021, for one robot).

Unknown are pose edges of the tree, six numbers each, and the values of effects: vectors that move
many observations together, as lenses, boards' shapes, arms' errors and clocks do. A value may be
free, or held: it then stays where it is, has no column in the solver, and counts in the covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.problem_parts import Effect, FramePrior, Noise, Observations, State
from visioncal.estimation.tree import PathStep, Stride, Tree, TreePaths
from visioncal.estimation.variance import PriorInformation

# A rotation that was not measured is supplied, and counts for nothing beside a variance of one.
_NOT_MEASURED = 1.0
# Variance of a flange's error where nothing was observed of it [rad^2 and m^2]: nothing is known.
ANYTHING = 1e4


@dataclass(frozen=True, eq=False)
class _Group:
    """The observations of one pair of frames, and the path between them."""

    rows: IntArray
    path: tuple[PathStep, ...]


@dataclass(frozen=True, eq=False)
class _MovedGroup:
    """What of the effects moves the m observations of a group.

    Attributes:
        values: (c,) which of the effects' values.
        places: (s,) the places of those, among these, that move what was measured.
        by_sensor: (m, 6, s) how these do.
        by_steps: (m, 6, c) how all of them move the flange of each step of the group's path.
    """

    values: IntArray
    places: IntArray
    by_sensor: FloatArray
    by_steps: tuple[FloatArray | None, ...]


@dataclass(frozen=True, eq=False)
class JacobianBlock:
    """The Jacobian (m, 6, c) of m rows by the c columns that may move them: all others are zero."""

    rows: IntArray
    columns: IntArray
    jacobian: FloatArray


@dataclass(frozen=True, eq=False)
class Linear:
    """All residuals, linearised.

    Attributes:
        residuals: (n, 6).
        blocks: Their Jacobian by p unknowns, one block for each pair of frames.
        by_errors: (n, 6, 6 w) that by the flanges' errors, in the places of the robots that the
            observation's unit has; see `Problem.units`.
        by_flanges: (n, 6, 6 w) by these flanges themselves, which is the same but where the errors
            are those of the observed frame; see `Problem.is_combined`.
        size: How many unknowns p there are.
    """

    residuals: FloatArray
    blocks: tuple[JacobianBlock, ...]
    by_errors: FloatArray
    by_flanges: FloatArray
    size: int

    @property
    def jacobian(self) -> FloatArray:
        """(n, 6, p) the Jacobian as one."""
        return self.jacobian_of(np.arange(len(self.residuals)))

    def jacobian_of(self, rows: IntArray) -> FloatArray:
        """(m, 6, p) the Jacobian of some rows."""
        places = np.full(len(self.residuals), -1)
        places[rows] = np.arange(len(rows))
        found = np.zeros((len(rows), 6, self.size))
        for block in self.blocks:
            mine = places[block.rows]
            chosen = mine >= 0
            found[np.ix_(mine[chosen], np.arange(6), block.columns)] = block.jacobian[chosen]
        return found

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """Covariances (n, 6, 6) of what a (p, p) one of the unknowns predicts."""
        found = np.zeros((len(self.residuals), 6, 6))
        for block in self.blocks:
            among = covariance[np.ix_(block.columns, block.columns)]
            found[block.rows] = block.jacobian @ among @ np.swapaxes(block.jacobian, 1, 2)
        return found


@dataclass(frozen=True, eq=False)
class Problem:
    """The frames, the robots' poses, the observations and the unknowns.

    Attributes:
        tree: The frames.
        poses: (s, 4, 4) `base_from_flange` by robot and stop; not a number where unknown.
        observations: What was measured.
        effects: The vectors of unknowns, in the order of their columns behind the edges.
        priors: What was measured of frames by hand.
        points: Frames of which only the place is asked for: their rotation is a matter of choice,
            and fixed.
        least_levels: (s,) below which no sensor's level is; where there are none, any.
        with_repeats: Whether repeated observations of one still frame by another share an error as
            large as that of a single one: what a lens or a print does to one view it does to all.
        is_combined: Whether nothing is known of the observations' own noise, so that it and that of
            the only robot are one, of levels to be estimated, in the observed frame.
    """

    tree: Tree
    poses: Mapping[str, FloatArray]
    observations: Observations
    effects: tuple[Effect, ...] = ()
    priors: tuple[FramePrior, ...] = ()
    points: frozenset[str] = frozenset()
    least_levels: FloatArray = field(default_factory=lambda: np.zeros(0))
    with_repeats: bool = False
    is_combined: bool = False
    # The last of `linear`, ideal or not: a fit, its noise and its tests ask for the same one.
    _last: dict[bool, tuple[State, Linear]] = field(default_factory=dict, init=False, repr=False)
    # What `solve.robot_likelihood` last made of one.
    last_likelihood: list[tuple[State, Noise, object]] = field(
        default_factory=list, init=False, repr=False
    )
    _last_moved: list[tuple[State, tuple[FloatArray, FloatArray, tuple[JacobianBlock, ...]]]] = (
        field(default_factory=list, init=False, repr=False)
    )

    def __len__(self) -> int:
        return len(self.observations)

    def subset(self, chosen: Mask) -> "Problem":
        """Returns the problem with the observations of an (n,) mask; of all of them itself."""
        rows = np.flatnonzero(chosen)
        if len(rows) == len(self):
            return self
        return replace(
            self,
            observations=self.observations.take(rows),
            effects=tuple(effect.take(rows) for effect in self.effects),
        )

    @cached_property
    def of_one_stop(self) -> IntArray:
        """(n,) what is of the same frames at one stop, numbered in the order of appearance.

        What several effects on sensors move stays apart: merged, it would mix them.
        """
        seen, keys = self.observations, dict[tuple[int, str, str, int], int]()
        moved = [
            effect.by_sensor.any(axis=(1, 2))
            for effect in self.effects
            if effect.by_sensor is not None
        ]
        apart = np.where(np.sum(moved, axis=0) > 1, np.arange(len(seen)), -1).tolist()
        every = zip(seen.stops.tolist(), seen.observers, seen.observed, apart, strict=True)
        return np.array([keys.setdefault(pair, len(keys)) for pair in every], dtype=np.int64)

    def merged(self) -> "Problem":
        """Makes one observation of all of one stop (`of_one_stop`).

        Their poses are averaged with their information, and by how much they disagree they show
        the effect on sensors: nothing is lost. Where nothing is known of their noise, they are
        averaged evenly.
        """
        units = self.of_one_stop
        first = np.unique(units, return_index=True)[1]
        if len(first) == len(units):
            return self
        seen, by_sensor = self.observations.take(first), self.by_sensor[first]
        measured, covariance = seen.measured.copy(), seen.covariance.copy()
        width = by_sensor.shape[2]
        information, gradient = np.zeros((width, width)), np.zeros(width)
        for unit in np.flatnonzero(np.bincount(units) > 1).tolist():
            rows = np.flatnonzero(units == unit)
            weights = np.tile(np.eye(6), (len(rows), 1, 1))
            if not self.is_combined:
                weights = covariance_from(self.observations.covariance[rows])
            mean = covariance_from(weights.sum(axis=0))
            shares = mean @ weights
            away = log(invert(measured[unit]) @ self.observations.measured[rows])
            shift = np.einsum("mij,mj->i", shares, away)
            measured[unit] = measured[unit] @ exp(shift)
            by_sensor[unit] = np.einsum("mij,mjk->ik", shares, self.by_sensor[rows])
            if not self.is_combined:
                covariance[unit] = mean
                apart = self.by_sensor[rows] - by_sensor[unit]
                weighted = np.swapaxes(apart, 1, 2) @ weights
                information += np.sum(weighted @ apart, axis=0)
                gradient += np.einsum("mij,mj->i", weighted, away - shift)
        effects, at = [], 0
        for effect in self.effects:
            taken = effect.take(first)
            if effect.by_sensor is not None:
                mine = slice(at, at + len(effect))
                at += len(effect)
                known = PriorInformation(
                    effect.prior.information + information[mine, mine],
                    effect.prior.gradient + gradient[mine],
                )
                taken = replace(taken, prior=known, by_sensor=by_sensor[:, :, mine])
            effects.append(taken)
        return replace(
            self,
            observations=replace(seen, measured=measured, covariance=covariance),
            effects=tuple(effects),
        )

    def with_poses(self, robot: str, poses: FloatArray) -> "Problem":
        """Returns the problem with other poses of a robot; with those that it has, itself."""
        if np.array_equal(self.poses[robot], poses, equal_nan=True):
            return self
        return replace(self, poses={**self.poses, robot: poses})

    def with_effects(self, effects: Sequence[Effect]) -> "Problem":
        """Returns the problem with other effects; with those that it has, itself."""
        kept = tuple(effect for effect in effects if len(effect))
        return self if kept == self.effects else replace(self, effects=kept)

    @cached_property
    def unknown(self) -> Mapping[str, int]:
        """Places of the unknown frames among the edges."""
        return {name: at for at, name in enumerate(self.tree.unknown)}

    def edge_columns(self, frame: str) -> slice:
        """The columns of an unknown frame's edge."""
        at = 6 * self.unknown[frame]
        return slice(at, at + 6)

    @cached_property
    def effect_columns(self) -> Mapping[str, slice]:
        """The columns of each effect, by its name."""
        found, at = {}, 6 * len(self.unknown)
        for effect in self.effects:
            found[effect.name] = slice(at, at + len(effect))
            at += len(effect)
        return found

    def values_of(self, name: str, state: State) -> FloatArray:
        """The (k,) values of an effect; of one that is not there, none."""
        columns, first = self.effect_columns.get(name, slice(0, 0)), 6 * len(self.unknown)
        return state.values[max(columns.start - first, 0) : max(columns.stop - first, 0)]

    @property
    def size(self) -> int:
        """How many columns p there are."""
        return 6 * len(self.unknown) + sum(map(len, self.effects))

    def frames(self, state: State) -> dict[str, FloatArray]:
        """Where the unknown frames are: (4, 4) `parent_from_frame` by the frame."""
        return dict(zip(self.unknown, state.edges, strict=True))

    def start(self, frames: Mapping[str, FloatArray]) -> State:
        """The unknowns where frames are, and where effects were linearised."""
        return State(np.stack([frames[name] for name in self.unknown]), self.start_values)

    @cached_property
    def start_values(self) -> FloatArray:
        """(k,) the effects' values where the observations were linearised."""
        return np.concatenate([np.zeros(0), *(effect.values for effect in self.effects)])

    @cached_property
    def counted(self) -> Mask:
        """(p,) which columns count in the covariance: all but what is fixed."""
        found = np.ones(self.size, dtype=bool)
        for name, at in self.unknown.items():
            if name in self.points:
                found[6 * at : 6 * at + 3] = False
        return found

    @cached_property
    def moving(self) -> Mask:
        """(p,) which columns a fit moves: all but what is fixed or held."""
        found = self.counted.copy()
        found[6 * len(self.unknown) :] &= ~np.concatenate(
            [np.zeros(0, dtype=bool), *(effect.held for effect in self.effects)]
        )
        return found

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the order of the noise's levels."""
        return tuple(self.poses)

    @cached_property
    def groups(self) -> tuple[_Group, ...]:
        """The observations by pairs of frames."""
        rows: dict[tuple[str, str], list[int]] = {}
        pairs = zip(self.observations.observers, self.observations.observed, strict=True)
        for at, pair in enumerate(pairs):
            rows.setdefault(pair, []).append(at)
        return tuple(_Group(np.array(at), self.tree.path(*pair)) for pair, at in rows.items())

    def observations_through(self, frame: str) -> Mask:
        """(n,) the observations on whose way a frame's edge is, a robot's where it is a flange."""
        found = np.zeros(len(self), dtype=bool)
        for group in self.groups:
            found[group.rows] = any(step.frame == frame for step in group.path)
        return found

    @cached_property
    def units(self) -> tuple[IntArray, IntArray]:
        """Observations whose errors belong together: by the robots at one stop, or as repeats.

        Returns:
            (n,) the unit of each observation, -1 where it has none, and (u, w) the robots of each
            unit by their places, -1 where it has fewer; those of repeats come last and have none.
        """
        of, robots = self._robot_units
        found = of.copy()
        for at, rows in enumerate(self.repeats, start=len(robots)):
            found[rows] = at
        none = np.full((len(self.repeats), max(robots.shape[1], 1)), -1, dtype=np.int64)
        return found, np.concatenate([robots.reshape(-1, none.shape[1]), none])

    @cached_property
    def shared_units(self) -> tuple[tuple[int, IntArray], ...]:
        """The units of several observations, each with these."""
        of, members = self.units
        count = np.bincount(of[of >= 0], minlength=len(members))
        several = np.flatnonzero(count > 1).tolist()
        return tuple((unit, np.flatnonzero(of == unit)) for unit in several)

    @cached_property
    def alone(self) -> Mask:
        """(n,) which poses share the error of one robot's flange with no other observation."""
        of, members = self.units
        count = np.bincount(of[of >= 0], minlength=len(members))
        single = (count == 1) & (members >= 0).any(axis=1) & (members[:, 1:] < 0).all(axis=1)
        found = (of >= 0) & self.observations.has_rotation
        found[found] = single[of[found]]
        return found

    @cached_property
    def repeats(self) -> tuple[IntArray, ...]:
        """The rows of each pair of frames that no robot parts, where they repeat each other."""
        if not self.with_repeats:
            return ()
        still = [group.rows for group in self.groups if not any(step.robot for step in group.path)]
        return tuple(rows for rows in still if len(rows) > 1)

    @cached_property
    def _robot_units(self) -> tuple[IntArray, IntArray]:
        if self.is_combined:  # every observation is a unit of its own
            return np.arange(len(self)), np.zeros((len(self), 1), dtype=np.int64)
        count, joined = len(self.robots), []
        first = np.full(len(self), -1, dtype=np.int64)
        for group in self.groups:
            mine = [self.robots.index(step.robot) for step in group.path if step.robot]
            keys = self.observations.stops[group.rows] * count
            if mine:
                first[group.rows] = keys + mine[0]
                joined += [np.stack([keys + mine[0], keys + index], axis=1) for index in mine]
        if not joined:
            return first, np.zeros((0, 0), dtype=np.int64)
        used, pairs = np.unique(np.concatenate(joined), return_inverse=True)
        pairs = pairs.reshape(-1, 2)
        units, of_key = len(used), np.arange(len(used))
        if np.any(pairs[:, 0] != pairs[:, 1]):  # some observations are through several robots
            links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(used), len(used)))
            units, of_key = connected_components(links, directed=False)
        order = np.lexsort((used % count, of_key))
        rows, sizes = of_key[order], np.bincount(of_key)
        robots = np.full((units, sizes.max()), -1, dtype=np.int64)
        robots[rows, np.arange(len(rows)) - (np.cumsum(sizes) - sizes)[rows]] = used[order] % count
        of = np.where(first < 0, -1, of_key[np.searchsorted(used, np.maximum(first, used[0]))])
        return of, robots

    @cached_property
    def sensor_values(self) -> IntArray:
        """(s,) which of the effects' values move measured poses."""
        moves = [np.full(len(effect), effect.by_sensor is not None) for effect in self.effects]
        return np.flatnonzero(np.concatenate(moves)) if moves else np.zeros(0, dtype=np.int64)

    @cached_property
    def by_sensor(self) -> FloatArray:
        """(n, 6, s) how the measured poses move with the `sensor_values`."""
        parts = [effect.by_sensor for effect in self.effects if effect.by_sensor is not None]
        found = np.concatenate([np.zeros((len(self), 6, 0)), *parts], axis=2)
        # Repeats move alike: slopes that differ by the noise of each would explain that noise.
        for rows in self.repeats:
            found[rows] = found[rows].mean(axis=0)
        return found

    @cached_property
    def flange_jacobian(self) -> Mapping[str, FloatArray]:
        """By robot, (n, 6, k) how its flange moves with all effects; of unmoved robots, nothing."""
        robots = dict.fromkeys(robot for effect in self.effects for robot in effect.flange_jacobian)
        stops = self.observations.stops
        return {
            robot: np.concatenate(
                [effect.jacobian_of_flange(robot, stops) for effect in self.effects], axis=2
            )
            for robot in robots
        }

    def prior_information(self, state: State) -> PriorInformation:
        """What is known of all p unknowns beside the observations, and half its gradient there."""
        information, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for effect in self.effects:
            columns = self.effect_columns[effect.name]
            information[columns, columns] = effect.prior.information
            change = self.values_of(effect.name, state) - effect.values
            gradient[columns] = effect.prior.gradient + effect.prior.information @ change
        for prior in self.priors:
            away, jacobian = self.prior_rows(prior, state)
            information += jacobian.T @ jacobian
            gradient += jacobian.T @ away
        return PriorInformation(information, gradient)

    def prior_rows(self, prior: FramePrior, state: State) -> tuple[FloatArray, FloatArray]:
        """Residuals (d,) of a prior in units of its sigmas, and their slopes (d, p)."""
        rest, by_edges = np.eye(4), np.zeros((6, self.size))
        nowhere = np.zeros(0, dtype=np.int64)
        for step in reversed(self.tree.path(prior.first, prior.second)):
            edge = self._edge(step, state, nowhere)
            before = invert(edge) @ rest if step.is_up else edge @ rest
            if step.frame in self.unknown:
                moved = -adjoint(invert(before)) if step.is_up else adjoint(invert(rest))
                by_edges[:, self.edge_columns(step.frame)] += moved
            rest = before
        away, jacobian = prior.whitened(rest)
        return away, jacobian @ by_edges

    def prior_cost(self, state: State) -> float:
        """The squared error of what is known, in units of its sigmas, up to a constant."""
        cost = 0.0
        for effect in self.effects:
            change = self.values_of(effect.name, state) - effect.values
            cost += float(
                change @ (2.0 * effect.prior.gradient + effect.prior.information @ change)
            )
        for prior in self.priors:
            away, _ = self.prior_rows(prior, state)
            cost += float(away @ away)
        return cost

    def _edge(self, step: PathStep, state: State, rows: IntArray) -> FloatArray:
        """(4, 4) or (m, 4, 4) `parent_from_frame` of a step at some observations."""
        if step.robot:
            poses = self.poses[step.robot][self.observations.stops[rows]]
            moves = self.flange_jacobian.get(step.robot)
            if moves is None:
                return poses
            return np.asarray(poses @ exp(moves[rows] @ (state.values - self.start_values)))
        known = self.tree.branches[step.frame].known
        return state.edges[self.unknown[step.frame]] if known is None else known

    def product(self, path: tuple[PathStep, ...], state: State, rows: IntArray) -> FloatArray:
        """(m, 4, 4) the product of some steps' edges at some observations."""
        product = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
        for step in path:
            edge = self._edge(step, state, rows)
            product = product @ (invert(edge) if step.is_up else edge)
        return product

    def between(self, first: str, second: str, state: State, rows: IntArray) -> FloatArray:
        """The (m, 4, 4) `first_from_second` of two frames at some observations."""
        return self.product(self.tree.path(first, second), state, rows)

    def predicted(self, state: State) -> FloatArray:
        """The (n, 4, 4) `observer_from_observed` that the unknowns and the robots predict."""
        found, change = np.empty((len(self), 4, 4)), state.values - self.start_values
        for ways in self._ways:
            found[ways.rows] = invert(ways.backward(state.edges, change))
        return found

    def measured(self, state: State) -> FloatArray:
        """The (n, 4, 4) measured poses as they are under the effects' values."""
        poses, change = self.observations.measured, state.values - self.start_values
        if not change.any():
            return poses
        return np.asarray(poses @ exp(self.by_sensor @ change[self.sensor_values]))

    def linear(self, state: State, *, ideal: bool = False) -> Linear:
        """Linearises all residuals.

        Args:
            state: The point of linearisation.
            ideal: As if all that was measured were what is predicted: noise then does not pass for
                information about directions that are not determined.
        """
        before = self._last.get(ideal)
        if before is None or before[0] is not state:
            before = self._last[ideal] = state, self._linearised(state, ideal=ideal)
        return before[1]

    @cached_property
    def _ways(self) -> tuple[TreePaths, ...]:
        """The observations' ways through the tree, those of one kind together."""
        alike: dict[tuple[tuple[bool, ...], ...], list[int]] = {}
        for at, group in enumerate(self.groups):
            kind = [
                (step.is_up, step.frame in self.unknown, step.robot in self.flange_jacobian)
                for step in group.path
            ]
            alike.setdefault(tuple(kind), []).append(at)
        return tuple(self._ways_of(mine) for mine in alike.values())

    def _ways_of(self, mine: list[int]) -> TreePaths:
        """The ways of some groups whose steps are of the same kinds."""
        groups, (of, members) = [self.groups[index] for index in mine], self.units
        ends = np.cumsum([0, *(len(group.rows) for group in groups)]).tolist()
        rows = np.concatenate([group.rows for group in groups])
        strides = []
        for steps in zip(*(group.path for group in groups), strict=True):
            edges, poses, moves, slots = [], [], [], []
            for step, group in zip(steps, groups, strict=True):
                count = len(group.rows)
                slot = np.full(count, -1)
                if step.frame in self.unknown:
                    edges.append(np.full(count, self.unknown[step.frame]))
                elif step.robot:
                    poses.append(self.poses[step.robot][self.observations.stops[group.rows]])
                    robots = members[of[group.rows]] == self.robots.index(step.robot)
                    slot = np.where(robots.any(axis=1), robots.argmax(axis=1), -1)
                    if step.robot in self.flange_jacobian:
                        moves.append(_rows_of(self.flange_jacobian[step.robot], group.rows))
                elif (known := self.tree.branches[step.frame].known) is not None:
                    poses.append(np.broadcast_to(known, (count, 4, 4)))
                slots.append(slot)
            found = np.concatenate(poses) if poses else np.zeros((0, 4, 4))
            strides.append(
                Stride(
                    steps[0].is_up,
                    np.concatenate(edges) if edges else np.zeros(0, dtype=np.int64),
                    found if steps[0].is_up else invert(found),
                    None if not moves else np.concatenate(moves) if moves[1:] else moves[0],
                    np.concatenate(slots),
                )
            )
        places = tuple((at, slice(*pair)) for at, pair in zip(mine, pairwise(ends), strict=True))
        return TreePaths(rows, places, tuple(strides))

    @cached_property
    def _moved_groups(self) -> tuple[_MovedGroup, ...]:
        """What of the effects moves each group."""
        found = []
        for group in self.groups:
            by_sensor = self.by_sensor[group.rows]
            seen = by_sensor.any(axis=(0, 1))
            flanges = [self.flange_jacobian.get(step.robot) for step in group.path]
            by_steps = [
                None if flange is None else _rows_of(flange, group.rows) for flange in flanges
            ]
            moved = np.zeros(sum(map(len, self.effects)), dtype=bool)
            moved[self.sensor_values] = seen
            for by_step in by_steps:
                if by_step is not None:
                    moved |= by_step.any(axis=(0, 1))
            values, every = np.flatnonzero(moved), bool(moved.all())
            steps = tuple(
                by_step if by_step is None or every else by_step[:, :, values]
                for by_step in by_steps
            )
            places = np.searchsorted(values, self.sensor_values[seen])
            found.append(_MovedGroup(values, places, by_sensor[:, :, seen], steps))
        return tuple(found)

    def _moved(self, state: State) -> tuple[FloatArray, FloatArray, tuple[JacobianBlock, ...]]:
        """How the predicted poses move, on their right.

        Returns:
            (n, 4, 4) their inverses, (n, 6, 6 w) how they move with the flanges' errors, and by
            groups, as they are ordered, how with the unknowns.
        """
        if self._last_moved and self._last_moved[0][0] is state:
            return self._last_moved[0][1]
        change, width = state.values - self.start_values, self.units[1].shape[1]
        back, errors = np.empty((len(self), 4, 4)), np.zeros((len(self), 6, width, 6))
        blocks: dict[int, JacobianBlock] = {}
        for ways in self._ways:
            inverse, moved = ways.moved(state.edges, change)
            back[ways.rows] = inverse
            for stride, step in zip(ways.strides, moved, strict=True):
                erring = np.flatnonzero(stride.slots >= 0)
                if len(erring):
                    errors[ways.rows[erring], :, stride.slots[erring]] += step[erring]
            unknown = [at for at, stride in enumerate(ways.strides) if len(stride.edges)]
            for at, place in ways.groups:
                group = self._moved_groups[at]
                effects = np.zeros((place.stop - place.start, 6, len(group.values)))
                for step, by_flange in zip(moved, group.by_steps, strict=True):
                    if by_flange is not None:
                        effects += step[place] @ by_flange
                edges = [
                    6 * ways.strides[index].edges[place.start] + np.arange(6) for index in unknown
                ]
                blocks[at] = JacobianBlock(
                    ways.rows[place],
                    np.concatenate([*edges, 6 * len(self.unknown) + group.values]),
                    np.concatenate([*(moved[index][place] for index in unknown), effects], axis=2),
                )
        for rows in self.repeats:
            errors[rows, :, 0] = np.eye(6)
        by_flanges = errors.reshape(len(self), 6, 6 * width)
        found = back, by_flanges, tuple(blocks[index] for index in range(len(self.groups)))
        self._last_moved[:] = [(state, found)]
        return found

    def ideal_errors(self, state: State) -> FloatArray:
        """(n, 6, 6 w) the residuals by the flanges' errors, as an ideal `linear` has them."""
        found = -self._moved(state)[1]
        found[~self.observations.has_rotation, :3] = 0.0
        if self.is_combined:
            return np.broadcast_to(np.eye(6), found.shape)
        return found

    def _linearised(self, state: State, *, ideal: bool) -> Linear:
        rotation, (back, errors, moved) = self.observations.has_rotation, self._moved(state)
        error = np.broadcast_to(np.eye(4), back.shape)
        if not ideal:
            error = back @ self.measured(state)
        places = ~rotation
        residuals, by_measured = np.zeros((len(self), 6)), np.empty((len(self), 6, 6))
        residuals[rotation], residuals[places] = log(error[rotation]), _places(error[places])
        by_measured[rotation] = inverse_right_jacobian(residuals[rotation])
        by_measured[places] = _place_slope(error[places])
        by_predicted = np.empty_like(by_measured)
        by_predicted[rotation] = -by_measured[rotation] @ adjoint(invert(error[rotation]))
        by_predicted[places] = -_place_slope(np.broadcast_to(np.eye(4), error[places].shape))
        blocks = []
        for block, group in zip(moved, self._moved_groups, strict=True):
            jacobian = by_predicted[block.rows] @ block.jacobian
            if len(group.places):
                behind = len(block.columns) - len(group.values) + group.places
                jacobian[:, :, behind] += by_measured[block.rows] @ group.by_sensor
            blocks.append(replace(block, jacobian=jacobian))
        by_flanges = by_predicted @ errors
        by_errors = by_flanges
        if self.is_combined:
            by_errors = np.broadcast_to(np.eye(6), errors.shape)
        return Linear(residuals, tuple(blocks), by_errors, by_flanges, self.size)

    def change_of(self, frame: str, state: State) -> FloatArray:
        """The change of a frame's edge that each observation asks for, were all else right.

        Args:
            frame: A frame that hangs by no robot.
            state: The unknowns.

        Returns:
            (n, 4, 4) on the right of the edge; not a number where it is not on the path.
        """
        asked = np.full((len(self), 4, 4), np.nan)
        error = invert(self.predicted(state)) @ self.measured(state)
        for group in self.groups:
            frames = [step.frame for step in group.path]
            if frame not in frames:
                continue
            at = frames.index(frame)
            step, rest = group.path[at], self.product(group.path[at + 1 :], state, group.rows)
            if step.is_up:
                carry = invert(self._edge(step, state, group.rows)) @ rest
                asked[group.rows] = carry @ invert(error[group.rows]) @ invert(carry)
            else:
                asked[group.rows] = rest @ error[group.rows] @ invert(rest)
        return asked

    def covariance(self, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of the observations' own noise."""
        seen = self.observations
        # Behind the sensors' levels, that of covariances which are known.
        level = np.append(noise.sensors, 1.0)[seen.sensors]
        found = level[:, None, None] ** 2 * seen.covariance
        places = np.flatnonzero(~seen.has_rotation)
        found[places, :3, :] = found[places, :, :3] = 0.0
        found[places, :3, :3] = _NOT_MEASURED * np.eye(3)
        return found

    def total_covariance(self, linear: Linear, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of single residuals, the flanges' errors among their noise."""
        found, (of, _) = self.covariance(noise), self.units
        rows = of >= 0
        if rows.any():
            # Slots of robots that are not on an observation's path move nothing of it.
            jacobian, errors = linear.by_errors[rows], self.error_covariance(noise)[of[rows]]
            found[rows] += jacobian @ errors @ np.swapaxes(jacobian, 1, 2)
        return found

    def error_covariance(self, noise: Noise) -> FloatArray:
        """Covariances (u, 6 w, 6 w) of the errors of each unit."""
        _, members = self.units
        width = 6 * members.shape[1]
        if not len(members):
            return np.zeros((0, width, width))
        levels = np.repeat(noise.robots, 3, axis=1) ** 2
        variances = np.full((len(members), members.shape[1], 6), ANYTHING)
        variances[members >= 0] = levels[members[members >= 0]]
        found = variances.reshape(len(members), width)[:, :, None] * np.eye(width)
        own = self.covariance(noise) if self.repeats else np.zeros((0, 6, 6))
        first = len(members) - len(self.repeats)
        for at, rows in enumerate(self.repeats, start=first):
            # With it, the mean of n repeats is known as well as one of them.
            found[at, :6, :6] = (1.0 - 1.0 / len(rows)) * own[rows].mean(axis=0)
        return found


def _rows_of(array: FloatArray, rows: IntArray) -> FloatArray:
    """Some rows in ascending order; where they are all, the array itself, which may be large."""
    return array if len(rows) == len(array) else array[rows]


def _places(error: FloatArray) -> FloatArray:
    """Residuals (n, 6) of places alone."""
    return np.concatenate([np.zeros_like(error[:, :3, 3]), error[:, :3, 3]], axis=1)


def _place_slope(error: FloatArray) -> FloatArray:
    """How a place (n, 6, 6) moves with a motion of its frame."""
    slope = np.zeros((len(error), 6, 6))
    slope[:, 3:, 3:] = error[:, :3, :3]
    return slope
