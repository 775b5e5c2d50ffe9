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

from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.parameters import Parameter
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.robot import Robot

# Directions whose singular value is below this share of the largest are unidentifiable.
_LEAST_SHARE = 1e-7
# Least share of the largest change for a parameter to be named.
_NAMED_SHARE = 0.5
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
    def of_stops(
        cls,
        problem: Problem,
        state: State,
        noise: Noise,
        frames: IntArray,
        arm: IntArray,
        size: float,
    ) -> "Jacobians":
        """Root of the information of all observations, without priors.

        Args:
            problem: The observations.
            state: The linearisation point.
            noise: Noise levels.
            frames: (f,) columns of the frames.
            arm: (p,) columns of the arm's errors.
            size: Their prior size.
        """
        both = np.concatenate([frames, arm])
        information = fisher_information(problem, state, noise)
        information -= problem.prior_information(state).information
        values, vectors = np.linalg.eigh(information[np.ix_(both, both)])
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        return cls(root[:, : len(frames)], size * root[:, len(frames) :])

    def free(self) -> tuple[int, FloatArray]:
        """Rank of the frames, and (r, p) the arm's Jacobian projected off them.

        Both are exact where the frames have no prior.
        """
        scale = np.linalg.norm(self.frames, axis=0)
        shown = scale > _LEAST_SHARE * scale.max()
        basis, sizes, _ = np.linalg.svd(self.frames[:, shown] / scale[shown], full_matrices=False)
        basis = basis[:, sizes > _LEAST_SHARE * sizes[0]]
        return basis.shape[1], self.arm - basis @ (basis.T @ self.arm)

    def spectrum(self) -> tuple[int, FloatArray, FloatArray]:
        """Rank of the frames; singular values (p,) and directions (p, p) of the arm's errors."""
        rank, free = self.free()
        padded = np.vstack([free, np.zeros((free.shape[1],) * 2)])
        return rank, *_singular(np.asarray(np.linalg.qr(padded, mode="r")))[1:]


def _singular(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Thin singular value decomposition of a matrix that may be rank deficient."""
    # Divide and conquer, which numpy has, does not converge on some of these.
    left, sizes, right = svd(matrix, full_matrices=False, lapack_driver="gesvd")
    return left, sizes, right


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Identifiable and determined errors of an arm."""

    columns: int  # Number of unknowns: of the frames and of the arm's errors.
    # Number of them, or of their combinations, that any postures could determine.
    identifiable: int
    determined: int  # Number of them that the stops determine better than the prior.
    values: FloatArray  # (L,) singular values of the determined directions of the arm, descending.
    # (p, k) the k directions of the arm's errors identifiable but not determined.
    missing: FloatArray

    @classmethod
    def of(cls, stops: Jacobians, anywhere: Jacobians) -> "Identifiability":
        """Counts the directions that stops determine, and that postures anywhere could."""
        frame_rank, sizes, vectors = anywhere.spectrum()
        shown = vectors[sizes > _LEAST_SHARE * sizes[0]]
        frames_determined, values, vectors = stops.spectrum()
        determined, values = vectors[values > 1.0], values[values > 1.0]
        # The identifiable space without the determined one; both have orthonormal bases.
        missing = _singular(shown.T - determined.T @ (determined @ shown.T))[0]
        return cls(
            columns=stops.frames.shape[1] + stops.arm.shape[1],
            identifiable=frame_rank + len(shown) + stops.frames.shape[1] - anywhere.frames.shape[1],
            determined=frames_determined + len(values),
            values=values,
            missing=missing[:, : max(len(shown) - len(values), 0)],
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


def joint_words(joint: int, robot: Robot) -> str:
    """A joint by its number and its name."""
    return f"joint {joint + 1} ({robot.joint_names[joint]})"


def _thing(parameter: Parameter, robot: Robot) -> str:
    return f"the {_WORDS[parameter.kind]} of {joint_words(parameter.joint, robot)}"


def missing_parameters(
    by_parameters: Jacobians,
    by_errors: Jacobians,
    directions: FloatArray,
    named: Sequence[Parameter],
    robot: Robot,
) -> str:
    """Names the parameters that change most along (p, n) directions of the arm's errors.

    Both Jacobians, by the table's parameters and by the arm's errors, are at the same postures.
    """
    (_, left), (_, right) = by_parameters.free(), by_errors.free()
    changes = np.linalg.lstsq(left, right @ directions, rcond=_LEAST_SHARE)[0]
    sizes = np.linalg.norm(changes, axis=1)
    kept = np.flatnonzero(sizes >= _NAMED_SHARE * sizes.max())
    return some_of([_thing(named[index], robot) for index in kept.tolist()], most=3)
