"""Closing the chain of frames: both unknown edges from the poses of all views.

Every view says `robot * x * camera = z`, up to noise, with its residual
`log(z^-1 * robot * x * camera)` in the target's frame:

    eye-in-hand   robot = base_from_flange, x = flange_from_cam, z = base_from_target
    eye-to-hand   robot = flange_from_base, x = base_from_cam,   z = flange_from_target

The noise of a residual is that of the camera's pose, which is known from its corners, and one small
error of the flange, whose two levels are estimated (Strobl and Hirzinger 2006; Ulrich and Hillemann
2021). Where nothing is known of the camera's poses, both are estimated as one.

Where the lens was estimated from the same corners, its error moves all camera poses together. It is
an unknown beside the edges, with the corners' information on it: to first order, that is the bundle
adjustment of corners, lens and edges in one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimator.descend import Linearised, descend
from visioncal.estimator.linalg import covariance, damped_step
from visioncal.estimator.variance import Components, Knowledge, RatioPrior, estimate_sigmas
from visioncal.transforms import (
    adjoint,
    exp,
    inverse_right_jacobian,
    invert,
    log,
    mean_transform,
    rotation_angle,
)
from visioncal.types import FloatArray, IntArray, Mask, Mount

_ROUNDS = 20
_SETTLED = 1e-10
# Noise levels are started from above: at least here [rad and m].
_START_SIGMAS = np.array([5e-4, 5e-4])
# Arms and cameras err by some 0.6 mm for each mrad, give or take a factor of five.
_PRIOR = RatioPrior(ratio=0.6, spread=1.5)


@dataclass(frozen=True, eq=False)
class Lens:
    """What the corners leave open of the intrinsics that the camera poses were made with.

    Attributes:
        information: (k, k) on the intrinsics, from the corners alone.
        shift: (m, 6, k) how each view's `cam_from_target` moves with them.
    """

    information: FloatArray
    shift: FloatArray


@dataclass(frozen=True, eq=False)
class Closure:
    """The poses of m views.

    Attributes:
        mount: Which of the two trees it is.
        robot: (m, 4, 4) the known part of the chain that is the robot's.
        camera: (m, 4, 4) `cam_from_target`.
        camera_covariance: (m, 6, 6) of the camera's right perturbations; None where unknown.
        lens: What is open about the intrinsics; None where they are held.
    """

    mount: Mount
    robot: FloatArray
    camera: FloatArray
    camera_covariance: FloatArray | None = None
    lens: Lens | None = None

    def __len__(self) -> int:
        return len(self.robot)

    @property
    def unchanged_lens(self) -> FloatArray:
        """(k,) no change of the intrinsics; k = 0 where they are held."""
        return np.zeros(0 if self.lens is None else len(self.lens.information))

    def subset(self, chosen: Mask) -> "Closure":
        """Returns the views of an (m,) mask."""
        known, lens = self.camera_covariance, self.lens
        return Closure(
            self.mount,
            self.robot[chosen],
            self.camera[chosen],
            None if known is None else known[chosen],
            None if lens is None else Lens(lens.information, lens.shift[chosen]),
        )

    def merged(self, stops: IntArray) -> "Closure":
        """Makes one view of all that were taken at one stop of the robot.

        They share the robot's error, and count once. Their camera poses are averaged with their
        information, which loses nothing; where that is unknown, evenly.

        Args:
            stops: (m,) the stop of each view, numbered from 0 in the order of first appearance.
        """
        if len(np.unique(stops)) == len(stops):
            return self
        return _joined([self.subset(stops == stop) for stop in range(stops.max() + 1)])

    def through(self, lens_change: FloatArray) -> "Closure":
        """Returns the views as seen through a lens that is changed by (k,) intrinsics."""
        if self.lens is None or not len(lens_change):
            return self
        return replace(self, camera=self.camera @ exp(self.lens.shift @ lens_change))

    def placed(self, x: FloatArray) -> FloatArray:
        """Where each view places the target: (m, 4, 4) `robot * x * camera`."""
        return self.robot @ x @ self.camera

    def predicted_camera(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """The (m, 4, 4) `cam_from_target` that the edges and the robot predict."""
        return invert(self.robot @ x) @ z


def _joined(groups: Sequence[Closure]) -> Closure:
    robot, camera, spreads, shifts = [], [], [], []
    for group in groups:
        first = group.camera[0]
        known = group.camera_covariance
        information = np.tile(np.eye(6), (len(group), 1, 1)) if known is None else covariance(known)
        spread = covariance(information.sum(axis=0))
        shares = spread @ information
        away = log(invert(first) @ group.camera)
        robot.append(group.robot[0])
        camera.append(first @ exp(np.einsum("mij,mj->i", shares, away)))
        spreads.append(spread)
        if group.lens is not None:
            shifts.append(np.einsum("mij,mjk->ik", shares, group.lens.shift))
    lens = groups[0].lens
    return Closure(
        groups[0].mount,
        np.array(robot),
        np.array(camera),
        None if groups[0].camera_covariance is None else np.array(spreads),
        None if lens is None else Lens(lens.information, np.array(shifts)),
    )


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis, of rotation [rad] and of translation [m].

    Of the flange where the noise of the camera's poses is known, else of both together, as the
    target's pose shows them.
    """

    sigma_rad: float
    sigma_m: float

    @property
    def sigmas(self) -> FloatArray:
        """Both as (2,): rotation, translation."""
        return np.array([self.sigma_rad, self.sigma_m])


@dataclass(frozen=True, eq=False)
class Edges:
    """The unknowns: both edges (4, 4), and the change (k,) of the intrinsics."""

    x: FloatArray
    z: FloatArray
    lens: FloatArray

    def moved(self, step: FloatArray) -> "Edges":
        """Returns the unknowns after a (12 + k,) step, on the right of both edges."""
        by = exp(step[:12].reshape(2, 6))
        return Edges(self.x @ by[0], self.z @ by[1], self.lens + step[12:])


@dataclass(frozen=True, eq=False)
class ClosureFit:
    """The unknowns, the noise that their residuals show, and whether the fit settled."""

    edges: Edges
    noise: Noise
    settled: bool = True


def deviations(placed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviation of each view's target from the mean of all: (m,) [m] and (m,) [rad]."""
    return distances(placed, mean_transform(placed))


def distances(placed: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of each view's target from a place: (m,) [m] and (m,) [rad]."""
    return (
        np.linalg.norm(placed[:, :3, 3] - z[:3, 3], axis=1),
        rotation_angle(invert(z)[None] @ placed),
    )


def fit_closure(data: Closure, edges: Edges) -> ClosureFit:
    """Minimises the whitened residuals, estimating the noise's levels too.

    Args:
        data: The views.
        edges: Where to start.

    Returns:
        The unknowns and the noise.
    """
    noise, settled = estimate_noise(data, edges), False
    for _ in range(_ROUNDS):
        edges, settled = solve_closure(data, edges, noise)
        before, noise = noise, estimate_noise(data, edges)
        if np.allclose(before.sigmas, noise.sigmas, rtol=1e-4):
            break
    return ClosureFit(edges, noise, settled)


def solve_closure(data: Closure, edges: Edges, noise: Noise) -> tuple[Edges, bool]:
    """Minimises the residuals whitened by a known noise.

    Returns:
        The unknowns, and whether they came to rest.
    """
    # Held at the start: weights that follow the edges would reward edges with large noise.
    weights = _weights(data, edges.z, noise)

    def linearise(at: Edges) -> Linearised[Edges]:
        residuals, jacobian = _residuals(data, at), closure_jacobian(data, at)
        weighted, known = weights @ jacobian, _knowledge(data, at)
        information = np.einsum("mij,mik->jk", jacobian, weighted) + known.information
        pull = known.information @ known.offset
        gradient = np.einsum("mij,mi->j", weighted, residuals) + pull
        cost = np.einsum("mi,mij,mj->", residuals, weights, residuals) + known.offset @ pull
        return Linearised(
            at,
            float(cost),
            lambda damping: at.moved(damped_step(information, gradient, damping)),
        )

    return descend(edges, linearise, _SETTLED)


def closure_jacobian(data: Closure, edges: Edges) -> FloatArray:
    """Derivatives (m, 6, 12 + k) of the residuals by the unknowns' steps: x, z, intrinsics."""
    seen = data.through(edges.lens)
    error = invert(edges.z) @ seen.placed(edges.x)
    log_slope = inverse_right_jacobian(log(error))
    blocks = [log_slope @ adjoint(invert(seen.camera)), -log_slope @ adjoint(invert(error))]
    if data.lens is not None:
        # The intrinsics' change is so small that the order of its steps does not matter.
        blocks.append(log_slope @ data.lens.shift)
    return np.concatenate(blocks, axis=2)


def closure_information(data: Closure, edges: Edges, noise: Noise) -> FloatArray:
    """Fisher information (12 + k, 12 + k) on the unknowns.

    It is taken where the chain closes exactly: at the measured poses their noise would pass for
    information about directions that the motion leaves open.
    """
    ideal = replace(data, camera=data.predicted_camera(edges.x, edges.z))
    jacobian = closure_jacobian(ideal, replace(edges, lens=data.unchanged_lens))
    weighted = _weights(data, edges.z, noise) @ jacobian
    known = _knowledge(data, edges).information
    return np.asarray(np.einsum("mij,mik->jk", jacobian, weighted) + known)


def estimate_noise(data: Closure, edges: Edges) -> Noise:
    """Estimates the noise's levels from the residuals at some edges."""
    residuals = _residuals(data, edges)
    rms = np.sqrt([np.mean(residuals[:, :3] ** 2), np.mean(residuals[:, 3:] ** 2)])
    sigmas = estimate_sigmas(
        residuals,
        closure_jacobian(data, edges),
        _components(data, edges.z),
        _knowledge(data, edges),
        np.maximum(rms, _START_SIGMAS),
        _PRIOR,
    )
    return Noise(float(sigmas[0]), float(sigmas[1]))


def _knowledge(data: Closure, edges: Edges) -> Knowledge:
    """What is known of the unknowns without the robot: of the lens alone."""
    size = 12 + len(edges.lens)
    information = np.zeros((size, size))
    if data.lens is not None:
        information[12:, 12:] = data.lens.information
    return Knowledge(information, np.concatenate([np.zeros(12), edges.lens]))


def _components(data: Closure, z: FloatArray) -> Components:
    """How the camera's known noise and the two levels make up the residuals' covariance."""
    levels = np.zeros((2, 6, 6))
    levels[0, :3, :3] = levels[1, 3:, 3:] = np.eye(3)
    if data.camera_covariance is None:
        return Components(
            np.zeros((len(data), 6, 6)), np.repeat(levels[:, None], len(data), axis=1)
        )
    # The flange's error, seen in the target's frame; the camera's is there already.
    flange_from_target = invert(data.robot) @ z if data.mount == "eye-in-hand" else z[None]
    carried = np.broadcast_to(adjoint(invert(flange_from_target)), (len(data), 6, 6))
    parts = carried @ levels[:, None] @ np.swapaxes(carried, 1, 2)
    return Components(data.camera_covariance, parts)


def _weights(data: Closure, z: FloatArray, noise: Noise) -> FloatArray:
    """Inverse covariances (m, 6, 6) of the residuals."""
    return np.asarray(np.linalg.inv(_components(data, z).total(noise.sigmas)))


def _residuals(data: Closure, edges: Edges) -> FloatArray:
    return log(invert(edges.z) @ data.through(edges.lens).placed(edges.x))
