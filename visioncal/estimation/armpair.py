"""What was observed of a robot's arm: its stops, and a pair of frames that it parts."""

from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.transforms import adjoint, invert, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.armmodel import HARMONICS, ArmModel
from visioncal.estimation.parts import Noise, Observations, State
from visioncal.estimation.problem import Linear, Problem
from visioncal.robot import Loads


@dataclass(frozen=True, eq=False)
class ArmPair:
    """The frames that an arm parts, and that most of its stops observe of each other.

    Attributes:
        problem: The observations.
        state: The unknowns.
        robot: The robot.
        observer: The frame that observes.
        observed: The frame that is observed.
    """

    problem: Problem
    state: State
    robot: str
    observer: str
    observed: str

    @classmethod
    def of(cls, problem: Problem, state: State, robot: str) -> "ArmPair":
        """The pair of the most observations of poses, without another robot where there is one."""

        def rank(at: int) -> tuple[bool, int]:
            group = problem.groups[at]
            robots = [step.robot for step in group.path if step.robot]
            turned = int(problem.observations.has_rotation[group.rows].sum())
            return robots == [robot], turned

        mine = [
            at
            for at, group in enumerate(problem.groups)
            if robot in {step.robot for step in group.path}
        ]
        row = int(problem.groups[max(mine, key=rank)].rows[0])
        seen = problem.observations
        return cls(problem, state, robot, seen.observers[row], seen.observed[row])

    @property
    def rows(self) -> IntArray:
        """The observations of the pair."""
        seen = self.problem.observations
        pairs = zip(seen.observers, seen.observed, strict=True)
        mine = (self.observer, self.observed)
        return np.flatnonzero(np.array([pair == mine for pair in pairs], dtype=bool))

    @property
    def is_observer_carried(self) -> bool:
        """Whether the arm carries the observer; else what it observes."""
        path = self.problem.tree.path(self.observer, self.observed)
        return next(step.is_up for step in path if step.robot == self.robot)

    def at(self, base_from_flange: FloatArray) -> tuple[Linear, FloatArray]:
        """The pair with its flange at (k, 4, 4), all other robots as at its first stop.

        Returns:
            How it moves with the edges of the problem, and with errors of this flange alone; and
            (k, 4, 4) `observer_from_observed`.
        """
        count, stop = len(base_from_flange), self.problem.observations.stops[self.rows[0]]
        poses = {
            name: np.repeat(pose[stop][None], count, axis=0)
            for name, pose in self.problem.poses.items()
        }
        seen = Observations(
            (self.observer,) * count,
            (self.observed,) * count,
            np.arange(count),
            np.full(count, -1),
            np.tile(np.eye(4), (count, 1, 1)),
            np.tile(np.eye(6), (count, 1, 1)),
            np.ones(count, dtype=bool),
            np.zeros(count, dtype=bool),
        )
        here = replace(
            self.problem,
            poses=poses | {self.robot: base_from_flange},
            observations=seen,
            effects=(),
            is_combined=False,
            with_repeats=False,
        )
        edges = State(self.state.edges, np.zeros(0))
        linear = here.linear(edges, ideal=True)
        slot = here.units[1][0].tolist().index(here.robots.index(self.robot))
        errors = linear.by_errors[:, :, 6 * slot : 6 * slot + 6]
        return replace(linear, by_errors=errors), here.predicted(edges)

    def jacobian(
        self, base_from_flange: FloatArray, moved: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """How the pose of the observed moves with all edges and with anything of the arm.

        Args:
            base_from_flange: (k, 4, 4) the flange.
            moved: (k, 6, p) its right perturbations.

        Returns:
            (k, 4, 4) `observer_from_observed`, and its (k, 6, 6 e + p) right perturbations.
        """
        linear, poses = self.at(base_from_flange)
        # Residuals fall as what is predicted moves on.
        return poses, -np.concatenate([linear.jacobian, linear.by_errors @ moved], axis=2)

    def frame_jacobian(self, base_from_flange: FloatArray) -> FloatArray:
        """(k, 6, 12) how the flange moves with the frames of its base and of what it carries."""
        flange = self.problem.tree.flanges[self.robot]
        carried = self.observer if self.is_observer_carried else self.observed
        flange_from_end = self.problem.between(flange, carried, self.state, self.rows[:1])[0]
        of_end = np.broadcast_to(adjoint(flange_from_end), (len(base_from_flange), 6, 6))
        return np.concatenate([adjoint(invert(base_from_flange)), of_end], axis=2)

    def place_jacobian(self, poses: FloatArray, jacobian: FloatArray, at: FloatArray) -> FloatArray:
        """How the place of what the arm carries moves, seen from what stands still.

        That is the observer's origin seen from what it observes, or a point of that seen from it.

        Args:
            poses: (k, 4, 4) `observer_from_observed`.
            jacobian: (k, 6, p) their right perturbations.
            at: (3,) the point of what is observed, in its frame [m].

        Returns:
            (k, 3, p), up to a rotation [m].
        """
        places = np.broadcast_to(at, (len(poses), 3))
        if self.is_observer_carried:
            places = invert(poses)[:, :3, 3]
        return np.asarray(-skew(places) @ jacobian[:, :3] + jacobian[:, 3:])

    def weight(self, noise: Noise, measured: Mask) -> FloatArray:
        """(6, 6) what makes noise like the pair's white; nothing of what is not measured."""
        linear = self.problem.linear(self.state, ideal=True)
        covariance = self.problem.total_covariance(linear, noise)[self.rows][:, measured][
            :, :, measured
        ]
        found = np.zeros((6, 6))
        root = np.linalg.cholesky(np.linalg.inv(covariance).mean(axis=0))
        found[np.ix_(measured, measured)] = root.T
        return found


@dataclass(frozen=True, eq=False)
class ArmData:
    """What was seen of a robot's arm whose errors are estimated.

    Attributes:
        problem: The observations.
        state: The unknowns.
        noise: The noise's levels.
        covariance: (u, u) of the unknowns.
        robot: The robot.
        model: The arm.
        columns: (p,) which of the unknowns are its errors.
        error_rad: Their size.
        stops: (m,) the stops at which it was observed.
        q: (m, n) joint angles there [rad].
        loads: What it carried there.
        at: (3,) the point of a target that counts, in its frame [m].
        frames: (f,) which of the unknowns are frames of which nothing is known.
        measured: (6,) which components of the poses are seen (rotation, translation).
    """

    problem: Problem
    state: State
    noise: Noise
    covariance: FloatArray
    robot: str
    model: ArmModel
    columns: IntArray
    error_rad: float
    stops: IntArray
    q: FloatArray
    loads: Loads
    at: FloatArray
    frames: IntArray
    measured: Mask = field(default_factory=lambda: np.ones(6, dtype=bool))

    @property
    def arm_covariance(self) -> FloatArray:
        """(p, p) covariance of its errors."""
        return self.covariance[np.ix_(self.columns, self.columns)]

    @property
    def chain(self) -> IntArray:
        """(f + p,) which of the unknowns are frames and the arm's errors."""
        return np.concatenate([self.frames, self.columns])

    @property
    def pair(self) -> ArmPair:
        """The frames that the arm is seen by."""
        return ArmPair.of(self.problem, self.state, self.robot)

    def basis(self, q: FloatArray) -> FloatArray:
        """(k, 6, p) how the flange moves with the arm's errors."""
        return self.model.basis(q)

    def place_jacobian(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How the place of what the arm carries moves at (k, n) joints [rad].

        Returns:
            (k, 3, f + p) by the chain's unknowns, and (k, 3, 6) by motions of the flange.
        """
        motions = np.broadcast_to(np.eye(6), (len(q), 6, 6))
        moved_by = np.concatenate([self.basis(q), motions], axis=2)
        poses, moved = self.pair.jacobian(self.model.base_from_flange(q), moved_by)
        edges, errors = moved.shape[2] - moved_by.shape[2], len(self.columns)
        jacobian = np.zeros((len(q), 6, self.problem.size))
        jacobian[:, :, :edges] = moved[:, :, :edges]
        jacobian[:, :, self.columns] = moved[:, :, edges : edges + errors]
        found = np.concatenate([jacobian[:, :, self.chain], moved[:, :, edges + errors :]], axis=2)
        place = self.pair.place_jacobian(poses, found, self.at)
        return place[:, :, :-6], place[:, :, -6:]

    def place_sigmas_m(self, q: FloatArray) -> FloatArray:
        """(k,) predicted sigma of that place at (k, n) joints, over all three axes [m]."""
        place, moved = self.place_jacobian(q)
        seen = self.covariance[np.ix_(self.chain, self.chain)]
        left_open = self.error_rad**2 * self.model.left_open(q)
        variances = np.einsum("mij,jk,mik->m", place, seen, place)
        return np.asarray(np.sqrt(variances + np.einsum("mij,mjk,mik->m", moved, left_open, moved)))

    def function_errors(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far joints turn beyond offset and ratio, and how surely that is known.

        Args:
            angles: (k,) angles of every joint [rad].

        Returns:
            (n, k) the error of each joint there, and its standard deviation [rad].
        """
        model = self.model
        count, chain = model.nominal.joint_count, model.bare.chain
        turned = np.repeat(angles[:, None], count, axis=1)
        errors = chain.effective(turned) - chain.functions[:, 0] - chain.functions[:, 1] * turned
        orders = len(model.harmonic_sizes) // (2 * count)
        phases = np.arange(1, orders + 2) * angles[:, None]
        waves = np.stack([np.sin(phases), np.cos(phases)], axis=2)
        first = model.weights["eccentricity"] * waves[:, 0]
        higher = model.weights[HARMONICS] * waves[:, 1:].reshape(len(angles), -1)
        eccentric, harmonic = (model.place_of(name) for name in ("eccentricity", HARMONICS))
        variances = np.zeros((count, len(angles)))
        for joint in range(count):
            rows = slice(2 * orders * joint, 2 * orders * (joint + 1))
            known = higher @ model.harmonic_directions[rows]
            slopes = np.zeros((len(angles), len(model.values)))
            slopes[:, harmonic] = known
            slopes[:, [eccentric.start + joint, eccentric.start + count + joint]] = first
            whole = np.sum((higher * model.harmonic_sizes[rows]) ** 2, axis=1)
            variances[joint] = np.einsum("kp,pq,kq->k", slopes, self.arm_covariance, slopes)
            variances[joint] += self.error_rad**2 * (whole - np.sum(known**2, axis=1))
        return errors.T, np.sqrt(np.maximum(variances, 0.0))
