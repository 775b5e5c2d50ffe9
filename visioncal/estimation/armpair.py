"""Observations of a robot's arm: its stops, and the pair of frames observed across it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.transforms import adjoint, invert, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.arm import stops_of
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Linear, Noise, Observations, State
from visioncal.estimation.unknowns import ARM, EDGE
from visioncal.robot import Loads
from visioncal.robot.arm_model import ArmModel


@dataclass(frozen=True, eq=False)
class ArmPair:
    """The two frames on either side of an arm between which it is observed most often."""

    problem: Problem
    state: State
    robot: str
    rows: IntArray  # Rows of the pair's observations.
    observer: str  # The observing frame.
    observed: str  # The observed frame.

    @classmethod
    def of(cls, problem: Problem, state: State, robot: str) -> "ArmPair":
        """The pair with the most pose observations, if possible with no other robot between."""

        def rank(at: int) -> tuple[bool, int]:
            robots = [step.robot for step in problem.groups[at].path if step.robot]
            pose_count = int(observations.has_rotation[problem.groups[at].rows].sum())
            return robots == [robot], pose_count if robot in robots else -1

        observations = problem.observations
        rows = problem.groups[max(range(len(problem.groups)), key=rank)].rows
        observer, observed = observations.observers[rows[0]], observations.observed[rows[0]]
        return cls(problem, state, robot, rows, observer, observed)

    @property
    def is_observer_carried(self) -> bool:
        """Whether the arm carries the observer; else it carries the observed frame."""
        path = self.problem.tree.path(self.observer, self.observed)
        return next(step.is_up for step in path if step.robot == self.robot)

    def at(self, base_from_flange: FloatArray) -> tuple[Linear, FloatArray]:
        """Linearises the pair at flange poses (k, 4, 4), with other robots as at its first stop.

        Returns:
            Its Jacobian by the problem's edges and by errors of this flange alone; and (k, 4, 4)
            `observer_from_observed`.
        """
        count, stop = len(base_from_flange), self.problem.observations.stops[self.rows[0]]
        poses = {
            name: np.repeat(pose[stop][None], count, axis=0)
            for name, pose in self.problem.poses.items()
        }
        observations = Observations(
            (self.observer,) * count,
            (self.observed,) * count,
            np.arange(count),
            np.full(count, -1),
            np.tile(np.eye(4), (count, 1, 1)),
            np.tile(np.eye(6), (count, 1, 1)),
            np.ones(count, dtype=bool),
            np.zeros(count, dtype=bool),
        )
        pair_problem = replace(
            self.problem,
            poses=poses | {self.robot: base_from_flange},
            observations=observations,
            effects=(),
            is_combined=False,
            with_repeats=False,
        )
        edges = State(self.state.edges, np.zeros(0))
        linear = pair_problem.linear(edges, ideal=True)
        slot = pair_problem.units[1][0].tolist().index(pair_problem.robots.index(self.robot))
        errors = linear.by_errors[:, :, 6 * slot : 6 * slot + 6]
        return replace(linear, by_errors=errors), pair_problem.predicted(edges)

    def jacobian(
        self, base_from_flange: FloatArray, moved: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Jacobian of the observed pose by all edges and by perturbations of the arm.

        Args:
            base_from_flange: (k, 4, 4) the flange.
            moved: (k, 6, p) its right perturbations.

        Returns:
            (k, 4, 4) `observer_from_observed`, and its (k, 6, 6 e + p) right perturbations.
        """
        linear, poses = self.at(base_from_flange)
        # Residuals have the opposite sign of the prediction.
        return poses, -np.concatenate([linear.jacobian, linear.by_errors @ moved], axis=2)

    def frame_jacobian(self, base_from_flange: FloatArray) -> FloatArray:
        """(k, 6, 12) flange twists equivalent to twists of its base and of the carried frame."""
        flange = self.problem.tree.flanges[self.robot]
        carried = self.observer if self.is_observer_carried else self.observed
        flange_from_end = self.problem.between(flange, carried, self.state, self.rows[:1])[0]
        of_end = np.broadcast_to(adjoint(flange_from_end), (len(base_from_flange), 6, 6))
        return np.concatenate([adjoint(invert(base_from_flange)), of_end], axis=2)

    def place_jacobian(self, poses: FloatArray, jacobian: FloatArray, at: FloatArray) -> FloatArray:
        """Jacobian of the carried point's position, seen from the stationary side.

        The point is the observer's origin seen from the observed frame, or a point of the observed
        frame seen from the observer.

        Args:
            poses: (k, 4, 4) `observer_from_observed`.
            jacobian: (k, 6, p) their right perturbations.
            at: (3,) the point in the observed frame [m].

        Returns:
            (k, 3, p), up to a rotation [m].
        """
        positions = np.broadcast_to(at, (len(poses), 3))
        if self.is_observer_carried:
            positions = invert(poses)[:, :3, 3]
        return np.asarray(-skew(positions) @ jacobian[:, :3] + jacobian[:, 3:])

    def weight(self, noise: Noise, measured: Mask) -> FloatArray:
        """Whitening matrix (6, 6) of the pair's mean noise; zero for components not measured."""
        linear = self.problem.linear(self.state, ideal=True)
        covariance = self.problem.total_covariance(linear, noise)[self.rows][:, measured][
            :, :, measured
        ]
        whitening = np.zeros((6, 6))
        root = np.linalg.cholesky(np.linalg.inv(covariance).mean(axis=0))
        whitening[np.ix_(measured, measured)] = root.T
        return whitening


@dataclass(frozen=True, eq=False)
class ArmData:
    """Observations of a robot's arm whose errors are estimated."""

    fit: Fit  # Their fit.
    robot: str
    model: ArmModel
    q: FloatArray  # (m, n) joint angles at the stops at which it was observed [rad].
    loads: Loads  # Its loads there.
    middles: Mapping[str, FloatArray]  # (3,) centre of targets by their frames, in these [m].

    @cached_property
    def pair(self) -> ArmPair:
        """The pair of frames between which the arm is observed."""
        return ArmPair.of(self.fit.problem, self.fit.state, self.robot)

    @property
    def stops(self) -> IntArray:
        """(m,) the stops at which it was observed."""
        return stops_of(self.fit.problem, self.robot)

    @cached_property
    def frames(self) -> IntArray:
        """(f,) columns of the unknown frames without a prior."""
        edges, problem = self.fit.problem.counted.copy(), self.fit.problem
        # A point has no rotation to be determined.
        edges[self.fit.unknowns[EDGE, self.pair.observed]] = True
        return np.flatnonzero(edges[: 6 * len(problem.unknown)])

    @property
    def measured(self) -> Mask:
        """(6,) which components of the poses are measured (rotation, translation)."""
        # A single point shows no rotation; several points make a frame.
        directions = self.fit.problem.observations.directions[self.pair.rows]
        return np.repeat([bool((directions > 3).any()), True], 3)

    @property
    def columns(self) -> IntArray:
        """(p,) columns of the arm's errors among the unknowns."""
        return self.fit.unknowns.columns((ARM, self.robot))

    @property
    def arm_covariance(self) -> FloatArray:
        """(p, p) covariance of the arm's errors."""
        return self.fit.covariance((ARM, self.robot))

    @property
    def chain(self) -> IntArray:
        """(f + p,) columns of the frames and of the arm's errors."""
        return np.concatenate([self.frames, self.columns])

    def place_jacobian(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobian of the carried point's position at (k, n) joint angles [rad].

        Returns:
            (k, 3, f + p) by the chain's unknowns, and (k, 3, 6) by motions of the flange.
        """
        motions = np.broadcast_to(np.eye(6), (len(q), 6, 6))
        perturbations = np.concatenate([self.model.basis(q), motions], axis=2)
        poses, pair_jacobian = self.pair.jacobian(self.model.base_from_flange(q), perturbations)
        of_arm = pair_jacobian[:, :, -perturbations.shape[2] :]
        jacobian = np.concatenate([pair_jacobian[:, :, self.frames], of_arm], axis=2)
        middle = self.middles.get(self.pair.observed, np.zeros(3))
        whole = self.pair.place_jacobian(poses, jacobian, middle)
        return whole[:, :, :-6], whole[:, :, -6:]

    def place_sigmas_m(self, q: FloatArray) -> FloatArray:
        """(k,) predicted sigma of that position at (k, n) joint angles, over all three axes [m]."""
        by_chain, by_flange = self.place_jacobian(q)
        chain_covariance = self.fit.whole[np.ix_(self.chain, self.chain)]
        undetermined = self.model.error_rad**2 * self.model.undetermined_covariance(q)
        variances = np.einsum("mij,jk,mik->m", by_chain, chain_covariance, by_chain)
        variances += np.einsum("mij,mjk,mik->m", by_flange, undetermined, by_flange)
        return np.asarray(np.sqrt(variances))
