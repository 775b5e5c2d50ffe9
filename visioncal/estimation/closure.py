"""Closing the chain of frames: both unknown edges from the poses of all views.

Every view says `robot * x * camera = z`, up to noise, with its residual
`log(z^-1 * robot * x * camera)` in the target's frame:

    eye-in-hand   robot = base_from_flange, x = flange_from_cam, z = base_from_target
    eye-to-hand   robot = flange_from_base, x = base_from_cam,   z = flange_from_target

The noise of a residual is that of the camera's pose, which is known from its corners, and one small
error of the flange, whose two levels are estimated (Strobl and Hirzinger 2006; Ulrich and Hillemann
2021). Where nothing is known of the camera's poses, both are estimated as one.

A measuring instrument that reads a probe on the flange is a camera that stands still, and the probe
its target. Where it reads points alone, the chain's rotation is told by nothing but the points: the
target's frame is then parallel to the flange by choice.

Lens and board move all camera poses together. What is open about them are unknowns beside the
edges, with the corners' information on them: to first order, and exactly where the poses were made
with the same values, that is the bundle adjustment of corners, lens, board and edges in one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from visioncal.estimation.chain import chain
from visioncal.estimation.linalg import covariance
from visioncal.estimation.problem import ROBOT, Effect, FramePrior, Problem, State
from visioncal.estimation.problem import Noise as Levels
from visioncal.estimation.solve import (
    fisher_information,
    fit_problem,
    robot_levels,
    solve_problem,
    starting_noise,
)
from visioncal.estimation.variance import Knowledge
from visioncal.transforms import distances, exp, invert, log, mean_transform
from visioncal.types import FloatArray, IntArray, Mask, Mount

# Information that keeps the target's rotation, where that is a matter of choice [1 / rad^2].
_CHOSEN = 1e12
# Variances of a direction that a pose leaves open are above this [rad^2].
_OPEN = 0.05


@dataclass(frozen=True, eq=False)
class Closure:
    """The poses of m views.

    Attributes:
        mount: Which of the two trees it is.
        robot: (m, 4, 4) the known part of the chain that is the robot's.
        camera: (m, 4, 4) `cam_from_target`.
        camera_covariance: (m, 6, 6) of the camera's right perturbations; None where unknown.
        effects: What moves the views together, at each view in place of a stop.
        guess: The edges near which rotations were supplied, where places are all that was measured;
            None where the poses themselves were.
        priors: What is known of the edges besides.
    """

    mount: Mount
    robot: FloatArray
    camera: FloatArray
    camera_covariance: FloatArray | None = None
    effects: tuple[Effect, ...] = ()
    guess: "Edges | None" = None
    priors: tuple[FramePrior, ...] = ()

    def __len__(self) -> int:
        return len(self.robot)

    @cached_property
    def problem(self) -> Problem:
        """The frames and the views as the estimation has them."""
        return chain(
            self.mount,
            self.robot if self.mount == "eye-in-hand" else invert(self.robot),
            self.camera,
            self.camera_covariance,
            # What is shared counts from where it is.
            effects=[replace(it, values=np.zeros(len(it))) for it in self.effects],
            priors=self.priors,
            turned_by_choice=self.guess is not None,
        )

    @property
    def unchanged(self) -> FloatArray:
        """(k,) no change of what is shared; k = 0 where it is held."""
        return np.zeros(sum(map(len, self.effects)))

    def subset(self, chosen: Mask) -> "Closure":
        """Returns the views of an (m,) mask."""
        known = self.camera_covariance
        return replace(
            self,
            robot=self.robot[chosen],
            camera=self.camera[chosen],
            camera_covariance=None if known is None else known[chosen],
            effects=tuple(it.of_stops(chosen).take(np.flatnonzero(chosen)) for it in self.effects),
        )

    @property
    def told(self) -> IntArray:
        """(m,) how many directions each view's pose tells: six, or fewer where places were read."""
        if self.guess is None or self.camera_covariance is None:
            return np.full(len(self), 6)
        return np.asarray(np.sum(np.linalg.eigvalsh(self.camera_covariance) < _OPEN, axis=1))

    def with_more(self, *more: Effect) -> "Closure":
        """Returns the views with more unknowns that they share, behind those that are there."""
        return replace(self, effects=(*self.effects, *(it for it in more if len(it))))

    def only(self, columns: slice) -> "Closure":
        """Returns the views with some of the unknowns that they share, and no others."""
        places, found, at = np.arange(len(self.unchanged))[columns], [], 0
        for it in self.effects:
            mine = places[(places >= at) & (places < at + len(it))] - at
            at += len(it)
            if len(mine):
                found.append(it.only(slice(mine[0], mine[-1] + 1)))
        return replace(self, effects=tuple(found))

    def with_first(self, count: int) -> "Closure":
        """Returns the views with the first of the unknowns that they share, and no others."""
        return self.only(slice(count))

    def merged(self, stops: IntArray) -> "Closure":
        """Makes one view of all that were taken at one stop of the robot.

        They share the robot's error, and count once. Their camera poses are averaged with their
        information, and by how much they disagree they tell of what is shared: nothing is lost.
        Where the information is unknown, they are averaged evenly.

        Args:
            stops: (m,) the stop of each view, numbered from 0 in the order of first appearance.
        """
        if len(np.unique(stops)) == len(stops):
            return self
        return _joined([self.subset(stops == stop) for stop in range(stops.max() + 1)])

    def under(self, change: FloatArray) -> "Closure":
        """Returns the views as they look when what is shared changes by (k,)."""
        if not len(change):
            return self
        robot, by_flange = self.robot, self.problem.by_flange.get(ROBOT)
        if by_flange is not None:
            flange = exp(by_flange @ change)
            hand = self.mount == "eye-in-hand"
            robot = robot @ flange if hand else invert(invert(robot) @ flange)
        return replace(self, robot=robot, camera=self.camera @ exp(self.problem.by_sensor @ change))

    def placed(self, x: FloatArray) -> FloatArray:
        """Where each view places the target: (m, 4, 4) `robot * x * camera`."""
        return self.robot @ x @ self.camera

    def predicted_camera(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """The (m, 4, 4) `cam_from_target` that the edges and the robot predict."""
        return invert(self.robot @ x) @ z


def _joined(groups: Sequence[Closure]) -> Closure:
    """One view of each group; what its views disagree on tells of all that they share together."""
    robot, camera, spreads, shifts, arms = [], [], [], [], []
    known_of = [it.known for it in groups[0].effects]
    information_of = np.asarray(block_diag(np.zeros((0, 0)), *(it.information for it in known_of)))
    pull = np.concatenate([np.zeros(0), *(it.pull for it in known_of)])
    for group in groups:
        first = group.camera[0]
        known = group.camera_covariance
        information = np.tile(np.eye(6), (len(group), 1, 1)) if known is None else covariance(known)
        spread = covariance(information.sum(axis=0))
        shares = spread @ information
        away = log(invert(first) @ group.camera)
        robot.append(group.robot[0])
        mean = np.einsum("mij,mj->i", shares, away)
        camera.append(first @ exp(mean))
        spreads.append(spread)
        by_sensor, by_flange = group.problem.by_sensor, group.problem.by_flange
        shift = np.einsum("mij,mjk->ik", shares, by_sensor)
        shifts.append(shift)
        arms.append(by_flange[ROBOT][0] if by_flange else np.zeros_like(shift))
        if known is not None and len(group) > 1:
            slopes = by_sensor - shift
            weighted = np.swapaxes(slopes, 1, 2) @ information
            information_of = information_of + np.sum(weighted @ slopes, axis=0)
            pull = pull + np.einsum("mij,mj->i", weighted, away - mean)
    held = np.concatenate([np.zeros(0, dtype=bool), *(it.held for it in groups[0].effects)])
    both, flange = Knowledge(information_of, pull), {ROBOT: np.array(arms)}
    return replace(
        groups[0],
        robot=np.array(robot),
        camera=np.array(camera),
        camera_covariance=None if groups[0].camera_covariance is None else np.array(spreads),
        effects=(),
    ).with_more(Effect("all", np.zeros(len(pull)), both, held, np.array(shifts), flange))


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis, of rotation [rad] and of translation [m].

    Of the flange where the noise of the camera's poses is known, else of both together, as the
    target's pose shows them.
    """

    sigma_rad: float
    sigma_m: float

    @property
    def levels(self) -> Levels:
        """As the estimation has them."""
        return Levels(self.sigmas[None], np.zeros(0))

    @property
    def sigmas(self) -> FloatArray:
        """Both as (2,): rotation, translation."""
        return np.array([self.sigma_rad, self.sigma_m])


@dataclass(frozen=True, eq=False)
class Edges:
    """The unknowns: both edges (4, 4), and the change (k,) of what all views share."""

    x: FloatArray
    z: FloatArray
    shared: FloatArray

    @property
    def state(self) -> State:
        """As the estimation has them."""
        return State(np.stack([self.x, self.z]), self.shared)

    def moved(self, step: FloatArray) -> "Edges":
        """Returns the unknowns after a (12 + k,) step, on the right of both edges."""
        by = exp(step[:12].reshape(2, 6))
        return Edges(self.x @ by[0], self.z @ by[1], self.shared + step[12:])


@dataclass(frozen=True, eq=False)
class ClosureFit:
    """The unknowns, the noise that their residuals show, and whether the fit settled."""

    edges: Edges
    noise: Noise
    settled: bool = True


def deviations(placed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviation of each view's target from the mean of all: (m,) [m] and (m,) [rad]."""
    return distances(placed, mean_transform(placed))


def fit_closure(data: Closure, edges: Edges) -> ClosureFit:
    """Minimises the whitened residuals, estimating the noise's levels too.

    Args:
        data: The views.
        edges: Where to start.

    Returns:
        The unknowns and the noise.
    """
    found = fit_problem(data.problem, edges.state)
    return ClosureFit(_edges(found.state), _noise(found.noise), found.settled)


def solve_closure(data: Closure, edges: Edges, noise: Noise) -> tuple[Edges, bool]:
    """Minimises the residuals whitened by a known noise.

    Returns:
        The unknowns, and whether they came to rest.
    """
    state, settled = solve_problem(data.problem, edges.state, noise.levels)
    return _edges(state), settled


def closure_information(data: Closure, edges: Edges, noise: Noise) -> FloatArray:
    """Fisher information (12 + k, 12 + k) on the unknowns.

    It is taken where the chain closes exactly: at the measured poses their noise would pass for
    information about directions that the motion leaves open.
    """
    found = fisher_information(data.problem, edges.state, noise.levels)
    return np.asarray(found + np.diag(np.where(data.problem.counted, 0.0, _CHOSEN)))


def estimate_noise(data: Closure, edges: Edges) -> Noise:
    """Estimates the noise's levels from the residuals at some edges."""
    problem = data.problem
    levels, _ = robot_levels(problem, edges.state, starting_noise(problem), from_above=True)
    return _noise(replace(starting_noise(problem), robots=levels))


def _edges(state: State) -> Edges:
    return Edges(state.edges[0], state.edges[1], state.values)


def _noise(noise: Levels) -> Noise:
    return Noise(float(noise.robots[0, 0]), float(noise.robots[0, 1]))
