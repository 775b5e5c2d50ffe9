"""The estimation problem of a cell: a tree of frames, observations, and blocks of unknowns.

An observation is the pose of one frame (a board, a point) measured by another (a camera, an
instrument). Its residual is `log(predicted^-1 * measured)`, in the observed frame. Noise is the
observation's own, whose covariance is known up to its sensor's level, and one small error of each
robot's flange at each of its stops, which all observations through that flange share (Strobl and
Hirzinger 2006; Ulrich and Hillemann 2021, for one robot).

The unknowns are pose edges of the tree, six parameters each, and the values of effects: vectors
that affect many observations jointly, such as lenses, board shapes, arm errors and clocks. A value
is free or held: held values are not moved by the solver, but count in the covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import (
    ANYTHING,
    Effect,
    FramePrior,
    JacobianBlock,
    Linear,
    MovedGroup,
    Noise,
    Observations,
    PathGroup,
    State,
    by_size,
    place_slope,
    rows_of,
    units_of,
)
from visioncal.session.tree import PathStep, Tree


@dataclass(frozen=True, eq=False)
class Problem:
    """The frames, the robots' poses, the observations and the unknowns."""

    tree: Tree  # The frames.
    # (s, 4, 4) `base_from_flange` by robot and stop; NaN where unknown.
    poses: Mapping[str, FloatArray]
    observations: Observations
    # Jointly acting unknowns, in the order of their columns, after the edges.
    effects: tuple[Effect, ...] = ()
    priors: tuple[FramePrior, ...] = ()  # Manual measurements of frames.
    # Frames of which only the position is estimated; their rotation is arbitrary and fixed.
    points: frozenset[str] = frozenset()
    # (s,) lower bounds of the sensors' noise levels; empty for no bounds.
    least_levels: FloatArray = field(default_factory=lambda: np.zeros(0))
    # Whether repeated observations of one stationary frame by another count as one: errors of a
    # lens or a print repeat in every view.
    with_repeats: bool = False
    # Whether the observations' own noise is unknown: it and that of the only robot are then one
    # noise of estimated levels, in the observed frame.
    is_combined: bool = False
    # Last results of `linear`, keyed by `ideal`: a fit, its noise and its tests use the same one.
    _last: dict[bool, tuple[State, Linear]] = field(default_factory=dict, init=False, repr=False)
    # Cached result of `robot_likelihood.robot_likelihood`.
    last_likelihood: list[tuple[State, Noise, object]] = field(
        default_factory=list, init=False, repr=False
    )
    _last_moved: list[tuple[State, tuple[FloatArray, FloatArray, tuple[JacobianBlock, ...]]]] = (
        field(default_factory=list, init=False, repr=False)
    )

    def __len__(self) -> int:
        return len(self.observations)

    def subset(self, chosen: Mask) -> "Problem":
        """Returns the problem with the observations of an (n,) mask; itself if that is all."""
        rows = np.flatnonzero(chosen)
        if len(rows) == len(self):
            return self
        return replace(
            self,
            observations=self.observations.take(rows),
            effects=tuple(effect.take(rows) for effect in self.effects),
        )

    def with_poses(self, robot: str, poses: FloatArray) -> "Problem":
        """Returns the problem with other poses of a robot; itself if they are unchanged."""
        if np.array_equal(self.poses[robot], poses, equal_nan=True):
            return self
        return replace(self, poses={**self.poses, robot: poses})

    def with_effects(self, effects: Sequence[Effect]) -> "Problem":
        """Returns the problem with other effects; itself if they are unchanged."""
        kept = tuple(effect for effect in effects if len(effect))
        return self if kept == self.effects else replace(self, effects=kept)

    def sized_at(self, state: State) -> "Problem":
        """Returns the problem with the slopes by targets' sizes at the poses predicted by a state.

        Slopes at measured poses have the noise of these. Where arm and frames can follow a size,
        such noise is least with targets of no size (errors in variables: Fuller 1987, 1.1).
        """
        noise = by_size(invert(self.predicted(state)) @ self.measured(state))[:, :, None]

        def corrected(effect: Effect) -> Effect:
            if effect.by_sensor is None or not len(effect.sizes):
                return effect
            slopes = effect.by_sensor.copy()
            sized = slopes[:, :, effect.sizes]
            slopes[:, :, effect.sizes] = sized - noise * sized.any(axis=1, keepdims=True)
            return replace(effect, by_sensor=slopes, sizes=effect.sizes[:0])

        return self.with_effects([corrected(effect) for effect in self.effects])

    @cached_property
    def unknown(self) -> Mapping[str, int]:
        """Index of each unknown frame's edge."""
        return {name: at for at, name in enumerate(self.tree.unknown)}

    def edge_columns(self, frame: str) -> slice:
        """The columns of an unknown frame's edge."""
        at = 6 * self.unknown[frame]
        return slice(at, at + 6)

    @cached_property
    def effect_columns(self) -> Mapping[str, slice]:
        """The columns of each effect, by its name."""
        columns, start = {}, 6 * len(self.unknown)
        for effect in self.effects:
            columns[effect.name] = slice(start, start + len(effect))
            start += len(effect)
        return columns

    def values_of(self, name: str, state: State) -> FloatArray:
        """The (k,) values of an effect; empty if the problem does not have it."""
        columns, first = self.effect_columns.get(name, slice(0, 0)), 6 * len(self.unknown)
        return state.values[max(columns.start - first, 0) : max(columns.stop - first, 0)]

    @property
    def size(self) -> int:
        """Number of columns p."""
        return 6 * len(self.unknown) + sum(map(len, self.effects))

    def frames(self, state: State) -> dict[str, FloatArray]:
        """Poses (4, 4) `parent_from_frame` of the unknown frames."""
        return dict(zip(self.unknown, state.edges, strict=True))

    def start(self, frames: Mapping[str, FloatArray]) -> State:
        """Initial state: given poses of the frames, and the effects' linearisation point."""
        return State(np.stack([frames[name] for name in self.unknown]), self.start_values)

    @cached_property
    def start_values(self) -> FloatArray:
        """(k,) the effects' values at which the observations were linearised."""
        return np.concatenate([np.zeros(0), *(effect.values for effect in self.effects)])

    @cached_property
    def counted(self) -> Mask:
        """(p,) mask of the columns that count in the covariance: all but fixed ones."""
        counted = np.ones(self.size, dtype=bool)
        for name, at in self.unknown.items():
            if name in self.points:
                counted[6 * at : 6 * at + 3] = False
        return counted

    @cached_property
    def moving(self) -> Mask:
        """(p,) mask of the columns that a fit moves: all but fixed and held ones."""
        moving = self.counted.copy()
        moving[6 * len(self.unknown) :] &= ~np.concatenate(
            [np.zeros(0, dtype=bool), *(effect.held for effect in self.effects)]
        )
        return moving

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the order of their noise levels."""
        return tuple(self.poses)

    @cached_property
    def groups(self) -> tuple[PathGroup, ...]:
        """The observations, grouped by pair of frames."""
        rows: dict[tuple[str, str], list[int]] = {}
        pairs = zip(self.observations.observers, self.observations.observed, strict=True)
        for at, pair in enumerate(pairs):
            rows.setdefault(pair, []).append(at)
        return tuple(PathGroup(np.array(at), self.tree.path(*pair)) for pair, at in rows.items())

    def observations_through(self, frame: str) -> Mask:
        """(n,) mask of the observations whose path contains a frame's edge (or robot flange)."""
        through = np.zeros(len(self), dtype=bool)
        for group in self.groups:
            through[group.rows] = any(step.frame == frame for step in group.path)
        return through

    @cached_property
    def is_single(self) -> Mask:
        """(n,) mask of measured poses with one flange error, shared by no other observation."""
        of, members = self.units
        count = np.bincount(of[of >= 0], minlength=len(members))
        single = (count == 1) & (members[:, 1:] < 0).all(axis=1)
        is_single = (of >= 0) & self.observations.has_rotation
        is_single[is_single] = single[of[is_single]]
        return is_single

    @cached_property
    def repeat_counts(self) -> FloatArray:
        """(n,) number of the observations that count as one, with no robot on their path."""
        counts = np.ones(len(self))
        for group in self.groups if self.with_repeats else ():
            if not any(step.robot for step in group.path):
                counts[group.rows] = len(group.rows)
        return counts

    @cached_property
    def units(self) -> tuple[IntArray, IntArray]:
        """Unit (n,) of each observation, those that share errors of flanges at a stop; -1 for none.

        And (u, w) the indices of each unit's robots, padded with -1.
        """
        if self.is_combined:  # each observation is its own unit
            return np.arange(len(self)), np.zeros((len(self), 1), dtype=np.int64)
        return units_of(self.groups, self.observations.stops, self.robots)

    @cached_property
    def by_sensor(self) -> FloatArray:
        """(n, 6, k) Jacobian of the measured poses with respect to the effects' values."""
        rows = (len(self), 6)
        parts = [
            np.zeros((*rows, len(effect))) if effect.by_sensor is None else effect.by_sensor
            for effect in self.effects
        ]
        # A copy of a single one would be the largest array of a long session.
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros((*rows, 0)), *parts], 2)

    @cached_property
    def flange_jacobian(self) -> Mapping[str, FloatArray]:
        """Jacobian (n, 6, k) of each robot's flange by all effects; omits unaffected robots."""
        robots = dict.fromkeys(robot for effect in self.effects for robot in effect.flange_jacobian)
        stops = self.observations.stops
        return {
            robot: np.concatenate(
                [effect.jacobian_of_flange(robot, stops) for effect in self.effects], axis=2
            )
            for robot in robots
        }

    def prior_information(self, state: State) -> PriorInformation:
        """Prior information (p, p) on the unknowns, half the gradient of its cost, and this."""
        information, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        cost = 0.0
        for effect in self.effects:
            columns = self.effect_columns[effect.name]
            information[columns, columns] = effect.prior.information
            change = self.values_of(effect.name, state) - effect.values
            gradient[columns] = effect.prior.gradient + effect.prior.information @ change
            cost += float(change @ (effect.prior.gradient + gradient[columns]))
        for prior in self.priors:
            residuals, jacobian = self.prior_rows(prior, state)
            information += jacobian.T @ jacobian
            gradient += jacobian.T @ residuals
            cost += float(residuals @ residuals)
        return PriorInformation(information, gradient, cost)

    def prior_rows(self, prior: FramePrior, state: State) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (d,) of a frame prior, and their Jacobian (d, p)."""
        path, by_edges = self.tree.path(prior.first, prior.second), np.zeros((6, self.size))
        back, slopes = self._moved_path(path, state, np.zeros(1, dtype=np.int64))
        for step, slope in zip(path, slopes, strict=True):
            if step.frame in self.unknown:
                by_edges[:, self.edge_columns(step.frame)] += slope[0]
        residuals, jacobian = prior.whitened(invert(back[0]))
        return residuals, jacobian @ by_edges

    def _edge(self, step: PathStep, state: State, rows: IntArray) -> FloatArray:
        """(4, 4) or (m, 4, 4) `parent_from_frame` of a path step for m observations."""
        if step.robot:
            poses = self.poses[step.robot][self.observations.stops[rows]]
            moves, change = self.flange_jacobian.get(step.robot), state.values - self.start_values
            if moves is None or not change.any():
                return poses
            return np.asarray(poses @ exp(rows_of(moves, rows) @ change))
        known = self.tree.branches[step.frame].known
        return state.edges[self.unknown[step.frame]] if known is None else known

    def product(self, path: tuple[PathStep, ...], state: State, rows: IntArray) -> FloatArray:
        """(m, 4, 4) product of the edges along a path for m observations."""
        product = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
        for step in path:
            edge = self._edge(step, state, rows)
            product = product @ (invert(edge) if step.is_up else edge)
        return product

    def _moved_path(
        self, path: tuple[PathStep, ...], state: State, rows: IntArray
    ) -> tuple[FloatArray, list[FloatArray]]:
        """Inverse of `product`, and Jacobians (m, 6, 6) of its right perturbation by an edge's."""
        back, slopes = np.broadcast_to(np.eye(4), (len(rows), 4, 4)), []
        for step in reversed(path):
            edge, before = self._edge(step, state, rows), back
            back = back @ (edge if step.is_up else invert(edge))
            slopes.append(-adjoint(back) if step.is_up else adjoint(before))
        return back, slopes[::-1]

    def between(self, first: str, second: str, state: State, rows: IntArray) -> FloatArray:
        """(m, 4, 4) `first_from_second` of two frames for m observations."""
        return self.product(self.tree.path(first, second), state, rows)

    def predicted(self, state: State) -> FloatArray:
        """(n, 4, 4) `observer_from_observed` predicted by the unknowns and the robots' poses."""
        predicted = np.empty((len(self), 4, 4))
        for group in self.groups:
            predicted[group.rows] = self.product(group.path, state, group.rows)
        return predicted

    def measured(self, state: State) -> FloatArray:
        """(n, 4, 4) measured poses, corrected for the effects' values."""
        poses, change = self.observations.measured, state.values - self.start_values
        if not change.any():
            return poses
        return np.asarray(poses @ exp(self.by_sensor @ change))

    def linear(self, state: State, *, ideal: bool = False) -> Linear:
        """Linearises all residuals; `ideal` ones at the predictions in place of the measurements.

        Otherwise noise would appear as information on undetermined directions.
        """
        before = self._last.get(ideal)
        if before is None or before[0] is not state:
            before = self._last[ideal] = state, self._linearised(state, ideal=ideal)
        return before[1]

    @cached_property
    def _moved_groups(self) -> tuple[MovedGroup, ...]:
        """Effect Jacobians of each group."""
        moved_groups = []
        for group in self.groups:
            by_sensor = rows_of(self.by_sensor, group.rows)
            flanges = [self.flange_jacobian.get(step.robot) for step in group.path]
            by_steps = [
                None if flange is None else rows_of(flange, group.rows) for flange in flanges
            ]
            parts = [by_sensor, *(by_step for by_step in by_steps if by_step is not None)]
            moved = np.any([part.any(axis=(0, 1)) for part in parts], axis=0)
            values, every = np.flatnonzero(moved), bool(moved.all())
            steps = tuple(
                by_step if by_step is None or every else by_step[:, :, values]
                for by_step in by_steps
            )
            moves_sensor = np.asarray(by_sensor.any(axis=(0, 1)))
            places = np.flatnonzero(moves_sensor[values])
            if not moves_sensor.all():
                by_sensor = by_sensor[:, :, values[places]]
            moved_groups.append(MovedGroup(values, places, by_sensor, steps))
        return tuple(moved_groups)

    def _moved(self, state: State) -> tuple[FloatArray, FloatArray, tuple[JacobianBlock, ...]]:
        """Inverses (n, 4, 4) of the predicted poses, and Jacobians of their right perturbations.

        These are (n, 6, 6 w) by the flange errors, and by the unknowns, one block for each group.
        """
        if self._last_moved and self._last_moved[0][0] is state:
            return self._last_moved[0][1]
        (of, members), groups = self.units, zip(self.groups, self._moved_groups, strict=True)
        back, blocks = np.empty((len(self), 4, 4)), []
        errors = np.zeros((len(self), 6, members.shape[1], 6))
        for group, effects in groups:
            rows, columns, slopes = group.rows, [6 * len(self.unknown) + effects.values], []
            back[rows], by_steps = self._moved_path(group.path, state, rows)
            by_effects = np.zeros((len(rows), 6, len(effects.values)))
            for step, slope, by_flange in zip(group.path, by_steps, effects.by_steps, strict=True):
                if step.frame in self.unknown:
                    columns.insert(-1, 6 * self.unknown[step.frame] + np.arange(6))
                    slopes.append(slope)
                elif step.robot:
                    slots = members[of[rows]] == self.robots.index(step.robot)
                    errors[rows, :, slots.argmax(axis=1)] += slope
                if by_flange is not None:
                    by_effects += slope @ by_flange
            jacobian = np.concatenate([*slopes, by_effects], axis=2)
            blocks.append(JacobianBlock(rows, np.concatenate(columns), jacobian))
        result = back, errors.reshape(len(self), 6, -1), tuple(blocks)
        self._last_moved[:] = [(state, result)]
        return result

    def ideal_errors(self, state: State) -> FloatArray:
        """(n, 6, 6 w) Jacobian of the residuals by the flange errors, as in an ideal `linear`."""
        jacobian = -self._moved(state)[1]
        jacobian[~self.observations.has_rotation, :3] = 0.0
        if self.is_combined:
            return self._combined_shapes
        return jacobian

    def _linearised(self, state: State, *, ideal: bool) -> Linear:
        rotation, (back, errors, moved) = self.observations.has_rotation, self._moved(state)
        error = np.broadcast_to(np.eye(4), back.shape)
        if not ideal:
            error = back @ self.measured(state)
        places = ~rotation
        residuals, by_measured = np.zeros((len(self), 6)), np.empty((len(self), 6, 6))
        residuals[rotation], residuals[places, 3:] = log(error[rotation]), error[places, :3, 3]
        by_measured[rotation] = inverse_right_jacobian(residuals[rotation])
        by_measured[places] = place_slope(error[places])
        by_predicted = np.empty_like(by_measured)
        by_predicted[rotation] = -by_measured[rotation] @ adjoint(invert(error[rotation]))
        by_predicted[places] = -place_slope(np.broadcast_to(np.eye(4), error[places].shape))
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
            by_errors = self._combined_shapes
        return Linear(residuals, tuple(blocks), by_errors, by_flanges, self.size)

    def change_of(self, frame: str, state: State) -> FloatArray:
        """Change of an edge, no robot's, that would zero each observation's residual by itself.

        It is an (n, 4, 4) right factor of the edge; NaN where that is not on the path.
        """
        changes = np.full((len(self), 4, 4), np.nan)
        error = invert(self.predicted(state)) @ self.measured(state)
        for group in self.groups:
            frames = [step.frame for step in group.path]
            if frame not in frames:
                continue
            at = frames.index(frame)
            step, rest = group.path[at], self.product(group.path[at + 1 :], state, group.rows)
            if step.is_up:
                carry = invert(self._edge(step, state, group.rows)) @ rest
                changes[group.rows] = carry @ invert(error[group.rows]) @ invert(carry)
            else:
                changes[group.rows] = rest @ error[group.rows] @ invert(rest)
        return changes

    @property
    def _combined_shapes(self) -> FloatArray:
        """(n, 6, 6) Jacobian of the residuals by the combined noise of robot and camera."""
        shapes = self.observations.shapes
        return np.broadcast_to(np.eye(6), (len(self), 6, 6)) if shapes is None else shapes

    def _variances(self, noise: Noise) -> FloatArray:
        """(n, 1, 1) factors of the observations' own covariances at some noise."""
        # The last level is that of observations with known covariance.
        level = np.append(noise.sensors, 1.0)[self.observations.sensors]
        return np.asarray((self.repeat_counts * level**2)[:, None, None])

    @cached_property
    def _own_covariance(self) -> FloatArray:
        """(n, 6, 6) covariances of the observations at levels of one."""
        covariance = self.observations.covariance.copy()
        places = np.flatnonzero(~self.observations.has_rotation)
        covariance[places, :3, :] = covariance[places, :, :3] = 0.0
        # The residual and Jacobian rows of a rotation that was not measured are zero.
        covariance[places, :3, :3] = np.eye(3)
        return covariance

    @cached_property
    def _own_weights(self) -> FloatArray:
        """(n, 6, 6) `weights` at levels of one."""
        inverse, joined = np.zeros_like(self._own_covariance), ~self.is_single
        inverse[joined] = np.linalg.inv(self._own_covariance[joined])
        return inverse

    def covariance(self, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of the observations' own noise."""
        return np.asarray(self._variances(noise) * self._own_covariance)

    def weights(self, noise: Noise) -> FloatArray:
        """Inverses (n, 6, 6) of `covariance`; zero where `is_single` is true."""
        return np.asarray(self._own_weights / self._variances(noise))

    def total_covariance(self, linear: Linear, noise: Noise) -> FloatArray:
        """Covariances (n, 6, 6) of the residuals, including the flange errors."""
        covariance, (of, _) = self.covariance(noise), self.units
        rows = of >= 0
        if rows.any():
            # The Jacobian is zero in slots of robots that are not on an observation's path.
            jacobian, errors = linear.by_errors[rows], self.error_covariance(noise)[of[rows]]
            covariance[rows] += jacobian @ errors @ np.swapaxes(jacobian, 1, 2)
        return covariance

    def error_covariance(self, noise: Noise) -> FloatArray:
        """Covariances (u, 6 w, 6 w) of each unit's shared errors."""
        _, members = self.units
        width = 6 * members.shape[1]
        levels = np.repeat(noise.robots, 3, axis=1) ** 2
        variances = np.full((len(members), members.shape[1], 6), ANYTHING)
        variances[members >= 0] = levels[members[members >= 0]]
        return np.asarray(variances.reshape(len(members), width)[:, :, None] * np.eye(width))
