"""Identifiability of an arm's errors: by given stops, and by any postures; in numbers and words.

Jacobians are in units of the noise by rows and of the errors' prior size by columns, and the frames
at both ends of the chain, without a prior, are projected out. A singular value is then the ratio of
prior to measurement sigma of a direction: over one, it is determined. Observability indices are of
the same singular values.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import svd

from visioncal.core.limits import DETERMINED
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.parameters import Parameter
from visioncal.robot import Robot
from visioncal.robot.model import joint_words

# Directions whose singular value is below this share of the largest are unidentifiable.
_LEAST_SHARE = 1e-7
_WORDS = {
    "theta": "offset",
    "d": "length d",
    "a": "length a",
    "alpha": "twist alpha",
    "beta": "twist beta",
    "ratio": "gear ratio",
    "sine": "eccentricity (sine)",
    "cosine": "eccentricity (cosine)",
}


@dataclass(frozen=True, eq=False)
class Jacobians:
    """Jacobians of the observations by the frames at both ends and by the arm's errors."""

    frames: FloatArray  # (r, f) by the frames.
    arm: FloatArray  # (r, p) by the arm's errors, in units of their prior size.

    @classmethod
    def of_stops(cls, arm: ArmData) -> "Jacobians":
        """Root of the information of an arm's observations, without priors."""
        columns = np.concatenate([arm.frames, arm.columns[arm.model.is_kept]])
        fit = arm.fit
        information = fisher_information(fit.problem, fit.state, fit.noise)
        information -= fit.problem.prior_information(fit.state).information
        values, vectors = np.linalg.eigh(information[np.ix_(columns, columns)])
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        return cls(root[:, : len(arm.frames)], arm.model.error_rad * root[:, len(arm.frames) :])

    def free(self) -> tuple[int, FloatArray]:
        """Rank of the frames, and (r, p) the arm's Jacobian projected off them."""
        scale = np.linalg.norm(self.frames, axis=0)
        shown = scale > _LEAST_SHARE * scale.max()
        basis, sizes, _ = np.linalg.svd(self.frames[:, shown] / scale[shown], full_matrices=False)
        basis = basis[:, sizes > _LEAST_SHARE * sizes[0]]
        return basis.shape[1], self.arm - basis @ (basis.T @ self.arm)

    def spectrum(self) -> tuple[int, FloatArray]:
        """Rank of the frames, and singular values (p,) of the arm's errors."""
        rank, free = self.free()
        padded = np.vstack([free, np.zeros((free.shape[1],) * 2)])
        # Divide and conquer, which numpy has, does not converge on some of these.
        triangle = np.linalg.qr(padded, mode="r")
        return rank, np.asarray(svd(triangle, compute_uv=False, lapack_driver="gesvd"))

    def shares(self, moves: FloatArray) -> FloatArray:
        """(k,) ratio of the posterior to the prior sigma of parameters, by the errors (k, p)."""
        _, free = self.free()
        covariance = covariance_from(free.T @ free + np.eye(free.shape[1]))
        prior = np.maximum(np.linalg.norm(moves, axis=1), np.finfo(float).tiny)
        return np.asarray(np.sqrt(np.sum(moves @ covariance * moves, axis=1)) / prior)


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Identifiable and determined errors of an arm."""

    columns: int  # Number of unknowns: of the frames and of the arm's errors.
    # Number of them, or of their combinations, that any postures could determine.
    identifiable: int
    determined: int  # Number of them that the stops determine better than the prior.
    values: FloatArray  # (L,) singular values of the determined directions of the arm, descending.

    @classmethod
    def of(cls, stops: Jacobians, anywhere: Jacobians) -> "Identifiability":
        """Counts the directions that stops determine, and that postures anywhere could."""
        frame_rank, sizes = anywhere.spectrum()
        shown = int(np.sum(sizes > _LEAST_SHARE * sizes[0]))
        frames_determined, values = stops.spectrum()
        values = values[values > 1.0]
        return cls(
            columns=stops.frames.shape[1] + stops.arm.shape[1],
            identifiable=frame_rank + shown + stops.frames.shape[1] - anywhere.frames.shape[1],
            determined=frames_determined + len(values),
            values=values,
        )


def observability_indices(values: FloatArray, stops: int) -> dict[str, float]:
    """Observability indices, by which sets of stops are compared; larger is better.

    With the singular values s_1 >= ... >= s_L of the determined directions, over m stops:

    - o1: `(s_1 ... s_L)^(1/L) / sqrt(m)` (Borm and Menq 1991, eq. 14), the noise ellipsoid's volume
    - o2: `s_L / s_1` (Driels and Pathre 1990), one over the `condition`
    - o3: `s_L` (Nahvi, Hollerbach and Hayward 1994)
    - o4: `s_L^2 / s_1`, the noise amplification index (Nahvi and Hollerbach 1996, eq. 9)
    - o5: `1 / (1 / s_1 + ... + 1 / s_L)` (Sun and Hollerbach 2008, of A-optimality)
    """
    if not len(values):
        return {}
    least, greatest = float(values.min()), float(values.max())
    return {
        "condition": greatest / least,
        "o1": float(np.exp(np.mean(np.log(values))) / np.sqrt(stops)),
        "o2": least / greatest,
        "o3": least,
        "o4": least**2 / greatest,
        "o5": 1.0 / float(np.sum(1.0 / values)),
    }


def is_linear_zero(parameter: Parameter, robot: Robot) -> bool:
    """Whether a parameter is where a linear axis counts from, as d is along it."""
    return parameter.kind == "d" and bool(robot.chain.prismatic[parameter.joint])


def parameter_words(parameter: Parameter, robot: Robot) -> str:
    """A parameter of an arm's table by its kind and joint."""
    words = "zero" if is_linear_zero(parameter, robot) else _WORDS[parameter.kind]
    return f"the {words} of {joint_words(parameter.joint, robot)}"


def undetermined(
    stops: Jacobians,
    anywhere: Jacobians,
    moves: FloatArray,
    named: Sequence[Parameter],
    robot: Robot,
) -> str:
    """Names parameters, by the errors (k, p), that other stops would determine."""
    is_open = (stops.shares(moves) > DETERMINED) & (anywhere.shares(moves) < DETERMINED)
    things = [
        parameter_words(parameter, robot)
        for parameter, found in zip(named, is_open.tolist(), strict=True)
        if found
    ]
    return some_of(things, most=3) or "some combinations of its parameters"
