"""What an arm carries, by what its drives give more; and their gains, by a body that is known.

The torques of a body on the flange are linear in its ten inertial parameters, and all ten are
identifiable: what the arm itself takes is known from a run without it (Atkeson, An and Hollerbach
1986, Estimation of inertial parameters of manipulator loads and links).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import qr

from visioncal.core.choices import GAIN_SIGMA
from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import figure
from visioncal.core.threads import on_one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import FrictionTerms
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.regression import NoiseBlock, Regression, regress, rms_of
from visioncal.robot import Inertias, body_regressor, entries

# A mass that is known no better than to this share of itself is none [-].
_WORST = 0.5
# How much of the variance of their gains the drives of an arm have in common: of the 12 % of
# GAIN_SIGMA a mean of 11 % is alike in all joints [-].
_ALIKE = 0.8
# Weighing knows a mass as well as gravity: where that is not stated, it is within such a standard
# deviation of the standard value where people live [-].
_GRAVITY_SIGMA = 5e-4
_HOW = "Drive the exciting trajectory of visioncal dynamics plan with the payload on the flange."
# A gain that is known no better than to this share of itself counts as not determined [-].
_WORST_GAIN = 0.1
# Columns of which less is left are multiples of others [-].
_RANK = 1e-8


@dataclass(frozen=True, eq=False)
class Payload:
    """A body on the flange.

    Attributes:
        values: (10,) its inertial parameters in the flange's frame, in the order of `Inertias`.
        covariance: (10, 10) of these.
        rms_nm: (n,) torques that it leaves unexplained where they count, as a root mean square
            [N m].
        gains_sigma_kg: What of the mass's standard deviation comes from the drives' gains [kg].
    """

    values: FloatArray
    covariance: FloatArray
    rms_nm: FloatArray
    gains_sigma_kg: float = 0.0

    @property
    def mass_kg(self) -> float:
        """Its mass [kg]."""
        return float(self.values[0])

    @property
    def mass_sigma_kg(self) -> float:
        """Standard deviation of its mass [kg]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def centre_m(self) -> FloatArray:
        """(3,) its centre, in the flange's frame [m]."""
        return np.asarray(self.values[1:4] / self.mass_kg)

    @property
    def centre_sigma_m(self) -> FloatArray:
        """(3,) standard deviations of its centre [m]."""
        jacobian = np.column_stack([-self.centre_m, np.eye(3)]) / self.mass_kg
        return np.asarray(np.sqrt(np.diag(jacobian @ self.covariance[:4, :4] @ jacobian.T)))

    @property
    def inertia_kg_m2(self) -> FloatArray:
        """(6,) xx, xy, yy, xz, yz, zz about its centre, along the flange's axes [kg m^2]."""
        return entries(self._inertias.about_centres[0])

    @property
    def consistent(self) -> bool:
        """Whether a body can have this inertia; that of a light one is lost in the noise."""
        return self._inertias.consistent

    @property
    def body(self) -> FloatArray:
        """(10,) parameters to reckon with: of one point where its inertia can be no body's.

        `ArmDynamics.carrying` takes them.
        """
        if self.consistent:
            return self.values
        point = Inertias.of_bodies(self.values[:1], self.centre_m[None], np.zeros((1, 3, 3)))
        return np.asarray(point.values[0])

    @property
    def _inertias(self) -> Inertias:
        return Inertias(self.values[None])

    def document(self) -> dict[str, Any]:
        """The estimate as JSON."""
        document: dict[str, Any] = {
            "mass_kg": self.mass_kg,
            "mass_sigma_kg": self.mass_sigma_kg,
            "com_m": self.centre_m.tolist(),
            "com_sigma_m": self.centre_sigma_m.tolist(),
            "unexplained_nm": self.rms_nm.tolist(),
        }
        if self.gains_sigma_kg:
            document["gains_sigma_kg"] = self.gains_sigma_kg
        if self.consistent:
            document["inertia_kg_m2"] = self.inertia_kg_m2.tolist()
        return document


@on_one_blas_thread
def estimate_payload(
    identified: Identified,
    loaded: Sequence[Conditioned],
    *,
    friction_changes: bool = True,
    gain_sigma: float = GAIN_SIGMA,
) -> Payload:
    """Estimates what the arm carried.

    Args:
        identified: The arm's dynamics without it.
        loaded: Motions with it.
        friction_changes: Whether dry and viscous friction may be others than without it, as with
            gears that are pressed harder or warmer.
        gain_sigma: What each drive's gain is known to, as a share of it, where torques are currents
            times gains.

    Raises:
        DegenerateError: The motion does not determine a mass, or there is none.
    """
    terms = FrictionTerms(
        coulomb=friction_changes,
        viscous=friction_changes,
        offset=False,
        slow_rad_s=identified.base.model.terms.slow_rad_s,
    )
    try:
        fit = regress([_block(identified, terms, conditioned) for conditioned in loaded])
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "payload: the motion does not determine all of its inertia.", next_step=_HOW
        ) from error
    of_gains = _of_gains(loaded, fit, gain_sigma)
    found = Payload(
        fit.values[:10],
        (fit.covariance + _of_arm(identified, loaded, fit) + of_gains)[:10, :10]
        + _of_gravity(identified, fit),
        rms_of(np.concatenate(fit.residuals), np.concatenate([block.used for block in fit.blocks])),
        float(np.sqrt(of_gains[0, 0])),
    )
    if not found.mass_sigma_kg < _WORST * found.mass_kg:
        raise DegenerateError(
            f"payload: a mass of {figure(found.mass_kg)} kg, with a sigma of "
            f"{figure(found.mass_sigma_kg)} kg, does not differ from none.",
            next_step=f"{_HOW} Is this the run with it?",
        )
    return found


def _block(identified: Identified, terms: FrictionTerms, stream: Conditioned) -> NoiseBlock:
    """What the drives gave beyond what the arm alone takes, and its derivatives."""
    robot = identified.robot

    def columns(motion: JointMotion) -> FloatArray:
        body = body_regressor(robot, motion.q, motion.dq, motion.ddq)
        return np.concatenate([body, terms.columns(motion)], axis=2)

    more = stream.torques_nm - stream.filtered(identified.torques)
    return NoiseBlock(stream.filtered(columns), more, stream.used, stream.correlation)


def _of_arm(identified: Identified, loaded: Sequence[Conditioned], fit: Regression) -> FloatArray:
    """What the arm's own covariance adds to that of the payload."""
    # The fit takes torques that the arm's parameters explain wrongly for the payload's.
    base = identified.base
    information = np.zeros((len(fit.values), len(fit.values)))
    cross = np.zeros((len(fit.values), base.rank))
    for stream, block, sigma in zip(loaded, fit.blocks, fit.sigmas, strict=True):
        weights = (block.used / sigma)[:, :, None]
        own = stream.filtered(base.regressor) * weights
        rows = (block.x * weights).reshape(-1, len(fit.values))
        information += rows.T @ rows
        cross += rows.T @ own.reshape(-1, base.rank)
    taken = np.linalg.solve(information, cross)
    kept = slice(base.rank)
    return np.asarray(taken @ identified.covariance[kept, kept] @ taken.T)


def _of_gravity(identified: Identified, fit: Regression) -> FloatArray:
    """(10, 10) what gravity that is not stated adds: to the mass and, alike, to its moments."""
    weighed = np.zeros(10)
    if "gravity_m_s2" not in identified.robot.document:
        weighed[:4] = _GRAVITY_SIGMA * fit.values[:4]
    return np.outer(weighed, weighed)


def _of_gains(loaded: Sequence[Conditioned], fit: Regression, sigma: float) -> FloatArray:
    """What errors of the drives' gains add to the covariance."""
    # A joint's torques with and without the payload are currents times one gain: what they say of
    # the payload is as wrong, in share, as the gain.
    count = len(fit.values)
    information, parts = np.zeros((count, count)), np.zeros((count, fit.blocks[0].y.shape[1]))
    for stream, block, noise in zip(loaded, fit.blocks, fit.sigmas, strict=True):
        weights = block.used / noise
        rows = block.x * weights[:, :, None]
        information += np.einsum("kjp,kjq->pq", rows, rows)
        parts += stream.of_currents * np.einsum("kjp,kj->pj", rows, block.y * weights)
    by_joint = sigma * np.linalg.solve(information, parts)
    whole = by_joint.sum(axis=1, keepdims=True)
    return np.asarray((1.0 - _ALIKE) * by_joint @ by_joint.T + _ALIKE * whole @ whole.T)


@dataclass(frozen=True, eq=False)
class Gains:
    """The gains of n drives.

    Attributes:
        nm_per_a: (n,) torque about the joint for a current [N m/A].
        sigma: (n,) standard deviations [N m/A]; inf where the payload does not move the joint.
    """

    nm_per_a: FloatArray
    sigma: FloatArray

    @property
    def determined(self) -> FloatArray:
        """(n,) which of them are determined to a tenth of their value."""
        return np.asarray(self.sigma < _WORST_GAIN * np.abs(self.nm_per_a))


@on_one_blas_thread
def drive_gains(
    base: BaseModel,
    empty: Sequence[Conditioned],
    loaded: Sequence[Conditioned],
    body: FloatArray,
) -> Gains:
    """Finds the drives' gains.

    Each joint's current is a sum of what the arm takes, in the joint's own measure, and of the
    known torque of the payload over the gain. The former is eliminated (Frisch and Waugh 1933).

    Args:
        base: The arm's model.
        empty: Motions without the payload; `torques_nm` are currents [A] here.
        loaded: The same with it.
        body: (10,) the payload's inertial parameters in the flange's frame.

    Raises:
        DegenerateError: No joint's gain is determined.
    """
    robot = base.model.robot

    def load(motion: JointMotion) -> FloatArray:
        return np.asarray(body_regressor(robot, motion.q, motion.dq, motion.ddq) @ body)

    streams = (*empty, *loaded)
    own = np.concatenate([stream.filtered(base.regressor) for stream in streams])
    pulls = np.concatenate(
        [np.zeros_like(item.torques_nm) for item in empty]
        + [item.filtered(load) for item in loaded]
    )
    currents = np.concatenate([stream.torques_nm for stream in streams])
    used = np.concatenate([stream.used for stream in streams])
    found = np.array(
        [
            _gain(own[rows, joint], pulls[rows, joint], currents[rows, joint])
            for joint, rows in enumerate(used.T)
        ]
    )
    gains = Gains(found[:, 0], found[:, 1])
    if not gains.determined.any():
        raise DegenerateError(
            "drive gains: the payload's torques stand out at no joint.",
            next_step="Carry a heavier one, off the last joint's axis, and move all joints.",
        )
    return gains


def _gain(own: FloatArray, load: FloatArray, currents: FloatArray) -> tuple[float, float]:
    """A joint's gain and its sigma, from rows of what it takes (m, b), the load, the currents."""
    acts = own.any(axis=0)
    lengths = np.linalg.norm(own[:, acts], axis=0)
    directions, upper, _ = qr(own[:, acts] / lengths, mode="economic", pivoting=True)
    left = np.abs(np.diag(upper))
    directions = directions[:, left > _RANK * left[0]]
    load = load - directions @ (directions.T @ load)
    currents = currents - directions @ (directions.T @ currents)
    square = float(load @ load)
    if square <= 0.0:
        return 0.0, np.inf
    share = float(load @ currents) / square
    rest = currents - share * load
    freedom = max(len(rest) - directions.shape[1] - 1, 1)
    sigma = float(np.sqrt(rest @ rest / freedom / square))
    if share == 0.0:
        return 0.0, np.inf
    return 1.0 / share, sigma / share**2
