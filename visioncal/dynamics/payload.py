"""What an arm carries, by what its drives give more than without it.

The torques of a body on the flange are linear in its ten inertial parameters, and all ten are
identifiable: what the arm itself takes is known from a run without it (Atkeson, An and Hollerbach
1986, Estimation of inertial parameters of manipulator loads and links).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.choices import GAIN_SIGMA
from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import FrictionTerms
from visioncal.dynamics.motion import Motion
from visioncal.dynamics.regression import Block, Regression, regress
from visioncal.robot import Inertias, body_regressor, entries

# A mass that is known no better than to this share of itself is none [-].
_WORST = 0.5
# How much of the variance of their gains the drives of an arm have in common: of the 12 % of
# GAIN_SIGMA a mean of 11 % is alike in all joints [-].
_ALIKE = 0.8
_HOW = "Drive the exciting trajectory of visioncal dynamics plan with the payload on the flange."


@dataclass(frozen=True, eq=False)
class Payload:
    """A body on the flange.

    Attributes:
        values: (10,) its inertial parameters in the flange's frame, in the order of `Inertias`.
        covariance: (10, 10) of these.
        rms_nm: (n,) torques that it leaves unexplained, as a root mean square [N m].
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
        fit = regress([_block(identified, terms, it) for it in loaded])
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "payload: the motion does not determine all of its inertia.", next_step=_HOW
        ) from error
    of_gains = _of_gains(loaded, fit, gain_sigma)
    found = Payload(
        fit.values[:10],
        (fit.covariance + _of_arm(identified, loaded, fit) + of_gains)[:10, :10],
        np.sqrt(np.mean(np.concatenate(fit.residuals) ** 2, axis=0)),
        float(np.sqrt(of_gains[0, 0])),
    )
    if not found.mass_sigma_kg < _WORST * found.mass_kg:
        raise DegenerateError(
            f"payload: a mass of {figure(found.mass_kg)} kg, with a sigma of "
            f"{figure(found.mass_sigma_kg)} kg, does not differ from none.",
            next_step=f"{_HOW} Is this the run with it?",
        )
    return found


def _block(identified: Identified, terms: FrictionTerms, stream: Conditioned) -> Block:
    """What the drives gave beyond what the arm alone takes, and its derivatives."""
    robot = identified.robot

    def columns(motion: Motion) -> FloatArray:
        body = body_regressor(robot, motion.q, motion.dq, motion.ddq)
        return np.concatenate([body, terms.columns(motion)], axis=2)

    more = stream.torques_nm - stream.filtered(identified.torques)
    return Block(stream.filtered(columns), more, stream.used, stream.correlation)


def _of_arm(identified: Identified, loaded: Sequence[Conditioned], fit: Regression) -> FloatArray:
    """What the arm's own covariance adds to that of the payload.

    The fit takes torques that the arm's parameters explain wrongly for the payload's.
    """
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


def _of_gains(loaded: Sequence[Conditioned], fit: Regression, sigma: float) -> FloatArray:
    """What errors of the drives' gains add to the covariance.

    A joint's torques with and without the payload are currents times one gain: what they say of the
    payload is as wrong, in share, as the gain.
    """
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
