"""Processes of an arm's errors that last, by its posture and by time, and errors of stops."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import lapack
from scipy.spatial.distance import cdist

from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot.errors import POSTURE_RANGE_RAD, TWIST_UNITS, pose_basis, posture_features

# Lengths of processes by posture [rad], with the lever per radian, and by time [stops].
_RANGES, _MEMORIES = (POSTURE_RANGE_RAD, 0.4, 1.0, 2.8), (3.0, 10.0, 30.0, 100.0)
# Sizes of a process, and of what is independent beside it, over the level of the noise.
SIZES, WHITE = (0.3, 0.6, 1.2, 2.5, 5.0), (1.0, 0.7, 0.4, 0.15)


@dataclass(frozen=True, eq=False)
class Process:
    """A Gaussian process over s stops: `kernel_ij * basis_i basis_j'`, at a size of one."""

    prior: float
    kernel: FloatArray  # (s, s).
    basis: FloatArray  # (s, d, r) right perturbations of the flange [rad, m]: d is 6.
    is_of_time: bool = False
    is_creep: bool = False  # Whether base and flange creep evenly: no error of the arm.

    def covariance(self, at: IntArray) -> FloatArray:
        """(d k, d k) at some stops."""
        basis = self.basis[at]
        products = np.einsum("iar,jbr->iajb", basis, basis, optimize=True)
        full = self.kernel[at[:, None], at][:, None, :, None] * products
        return np.asarray(full.reshape(len(at) * basis.shape[1], -1))

    def through(self, gains: FloatArray) -> FloatArray:
        """(p, p) covariance of sums of the stops' errors with (s, 6, p) gains."""
        each = np.swapaxes(self.basis, 1, 2) @ gains
        total = np.zeros((gains.shape[2], gains.shape[2]))
        for part in np.swapaxes(each, 0, 1):
            total += part.T @ (self.kernel @ part)
        return total


def processes(
    poses: FloatArray, levels: FloatArray, *, creeps: bool, as_reported: bool = True
) -> Iterator[Process]:
    """Processes at (s, 4, 4) flanges, in units of the (6,) levels of the noise.

    Args:
        poses: The flanges.
        levels: The levels.
        creeps: Whether a base and a flange may creep evenly until the end: beside these as
            candidates, they are none of what else may last.
        as_reported: Whether base and flange are those of which the robot reports, which have what
            is the same at all postures; else it is an error like the others.
    """
    beyond = _beyond_mean if as_reported else np.asarray
    count, order = len(poses), np.arange(len(poses))
    size = np.sqrt(np.mean((levels / TWIST_UNITS) ** 2))
    flange = np.broadcast_to(np.diag(levels), (count, 6, 6))
    of_base = size * adjoint(invert(poses)) * TWIST_UNITS
    joint_basis = np.concatenate([flange, of_base], axis=2)
    factors = np.concatenate([poses[:, :3, 3] / 0.6, poses[:, :3, 2]], axis=1)
    if as_reported:
        yield Process(1 / 4, beyond(factors @ factors.T), of_base)
    else:
        yield Process(1 / 4, np.ones((count, count)), size * pose_basis(poses))
    features = posture_features(poses)
    squared = cdist(features, features, "sqeuclidean")
    for length in _RANGES:
        kernel = beyond(np.exp(-squared / (2.0 * length**2)))
        yield Process(1 / 4 / len(_RANGES), kernel, joint_basis)
    apart = np.abs(order[:, None] - order)
    for memory in _MEMORIES:
        yield Process(1 / 8 / len(_MEMORIES), np.exp(-apart / memory), flange, True)
    if creeps:
        ramp = (order - order[-1]) / order.std()
        yield Process(1 / 16, np.outer(ramp, ramp), joint_basis, is_of_time=True, is_creep=True)


def _beyond_mean(kernel: FloatArray) -> FloatArray:
    """A kernel (s, s) of errors by posture, less their mean over postures like these.

    One twist of the base and one of the flange at all postures belongs to the frames of which the
    robot reports. The mean over the stops differs from that by a share of what they vary by.
    """
    count = len(kernel)
    centre = np.eye(count) - 1.0 / count
    varying = centre @ kernel @ centre
    return np.asarray(varying + np.trace(varying) / (count - 1.0) / count)


@dataclass(frozen=True, eq=False)
class StopErrors:
    """Residuals of each stop alone of one flange, as rows in the common unknowns."""

    stops: IntArray  # (s,)
    known: FloatArray  # (s, d, d) covariance of what it says.
    independent: FloatArray  # (s, d, d) covariance of errors that do not last, as found alone.
    # (s, d, p + c + 1) by the unknowns, by c more columns, and the error itself.
    rows: FloatArray
    rest: FloatArray  # (p + c + 1, p + c + 1) information of all else.
    count: int  # p unknowns.

    def covariance(self, some: IntArray, white: float) -> FloatArray:
        """(d k, d k) of k stops beside errors that last, with independent ones times `white`."""
        stop_covariances = self.known[some] + white**2 * self.independent[some]
        count, width = stop_covariances.shape[:2]
        covariance = np.zeros((count, width, count, width))
        covariance[np.arange(count), :, np.arange(count)] = stop_covariances
        return covariance.reshape(count * width, -1)


@dataclass(frozen=True, eq=False)
class Tried:
    """A process of some size beside independent errors of some level; None beside the first."""

    prior: float  # Its logarithm.
    # (r + c + 1, r + c + 1) information under it, by r combinations of the unknowns.
    total: FloatArray
    log_det: float  # Of what stops say.
    boards: FloatArray  # (r, b) the sizes of boards that are held, by these.
    process: Process | None = None
    size: float = 0.0
    white: float = 1.0

    def with_stops(self, rows: FloatArray, shared: "Shared") -> Self:
        """The trial with rows (d k, r + c + 1) of k more stops."""
        covariance = shared.independent[self.white]
        is_new = self.process is not None
        if self.process is not None:
            covariance = covariance + self.size**2 * shared.lasting[self.process]
        # By columns, as LAPACK has it: NumPy's copies take as long as the solution of few columns.
        root, failed = lapack.dpotrf(covariance.T, lower=1, clean=0, overwrite_a=is_new)
        if failed:
            raise np.linalg.LinAlgError("a covariance of stops is not positive definite")
        solved, _ = lapack.dtrtrs(root, rows, lower=1)
        log_det = self.log_det + 2.0 * float(np.log(np.diag(root)).sum())
        return replace(self, total=solved.T @ solved + self.total, log_det=log_det)


@dataclass(frozen=True, eq=False)
class Shared:
    """(d k, d k) covariances of k stops, which all sizes of a process share."""

    independent: Mapping[float, FloatArray]  # By the level of what is independent.
    lasting: Mapping[Process, FloatArray]  # At a size of one.

    @classmethod
    def of(cls, stop_errors: StopErrors, some: IntArray, kinds: Iterable[Process]) -> Self:
        """Covariances at some stops (m,), of their own errors and of processes."""
        return cls(
            {white: stop_errors.covariance(some, white) for white in WHITE},
            {kind: kind.covariance(some) for kind in kinds},
        )
