"""Payload from the additional drive torques, and drive gains from a known payload.

The torques of a body on the flange are linear in its ten inertial parameters. With the arm's own
torques known from a run without it, all ten are identifiable (Atkeson, An and Hollerbach 1986,
Estimation of inertial parameters of manipulator loads and links).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import qr

from visioncal.core.choices import GAIN_SIGMA
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import DynamicsLimits
from visioncal.core.number_format import figure
from visioncal.core.threads import on_one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.convention_hypotheses import check_recording, described_scales
from visioncal.dynamics.differences import check_as_identified, excess_block
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.model import FrictionTerms, JointMotion
from visioncal.dynamics.regression import Regression, regress, rms_of, std_of
from visioncal.robot.inertia import Inertias, symmetric_entries
from visioncal.robot.torques import body_regressor

# Correlation of the gain errors of an arm's drives: of the 12 % of GAIN_SIGMA about 11 % are common
# to all joints [-].
_GAIN_CORRELATION = 0.8
_LIMITS = DynamicsLimits()
_HOW = "Drive the exciting trajectory of visioncal dynamics plan with the payload on the flange."


@dataclass(frozen=True, eq=False)
class Payload:
    """Estimated inertial parameters of a body on the flange."""

    # (10,) inertial parameters in the flange's frame, in the order of `Inertias`.
    values: FloatArray
    covariance: FloatArray  # (10, 10) of these.
    rms_nm: FloatArray  # (n,) root mean square of the residual torques [N m].
    gains_sigma_kg: float = 0.0  # Standard deviation of the mass by the drive gains alone [kg].

    @property
    def mass_kg(self) -> float:
        """Mass [kg]."""
        return float(self.values[0])

    @property
    def mass_sigma_kg(self) -> float:
        """Standard deviation of the mass [kg]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def centre_m(self) -> FloatArray:
        """(3,) centre of mass in the flange's frame [m]."""
        return np.asarray(self.values[1:4] / self.mass_kg)

    @property
    def centre_sigma_m(self) -> FloatArray:
        """(3,) standard deviations of the centre of mass [m]."""
        jacobian = np.column_stack([-self.centre_m, np.eye(3)]) / self.mass_kg
        return np.asarray(np.sqrt(np.diag(jacobian @ self.covariance[:4, :4] @ jacobian.T)))

    @property
    def inertia_kg_m2(self) -> FloatArray:
        """(6,) xx, xy, yy, xz, yz, zz about the centre, along the flange's axes [kg m^2]."""
        return symmetric_entries(self._inertias.about_centres[0])

    @property
    def consistent(self) -> bool:
        """Whether the inertia is physically consistent; a light body's is lost in the noise."""
        return self._inertias.consistent

    @property
    def body(self) -> FloatArray:
        """(10,) consistent parameters for `ArmDynamics.carrying`: a point mass where needed."""
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
    """Estimates the payload of an arm.

    Args:
        identified: The arm's dynamics without payload.
        loaded: Motions with it.
        friction_changes: Whether dry and viscous friction may differ from those without payload, as
            with gears under more load or warmer.
        gain_sigma: Relative standard deviation of each drive's gain, where torques are currents
            times gains.

    Raises:
        DataError: The recording shows no payload, but a mistake.
        DegenerateError: The motion does not determine a mass, or there is none.
    """
    terms = FrictionTerms(
        coulomb=friction_changes,
        viscous=friction_changes,
        offset=False,
        slow_rad_s=identified.base.model.terms.slow_rad_s,
    )
    try:
        fit = regress([excess_block(identified, item, terms, body=True) for item in loaded])
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "payload: the motion does not determine all of its inertia.", next_step=_HOW
        ) from error
    # A joint's torques with and without the payload are currents times one gain: its contribution
    # to the payload has the gain's relative error. Errors of the arm's predicted torques pass into
    # the payload through the same least-squares fit.
    base, count = identified.base, len(fit.values)
    information, cross = np.zeros((count, count)), np.zeros((count, base.rank))
    parts = np.zeros((count, fit.blocks[0].y.shape[1]))
    for stream, block, sigma in zip(loaded, fit.blocks, fit.sigmas, strict=True):
        weights = block.used / sigma
        rows = block.x * weights[:, :, None]
        arm_rows = stream.filtered(base.regressor) * weights[:, :, None]
        information += np.einsum("kjp,kjq->pq", rows, rows)
        cross += rows.reshape(-1, count).T @ arm_rows.reshape(-1, base.rank)
        parts += stream.of_currents * np.einsum("kjp,kj->pj", rows, block.y * weights)
    by_joint = gain_sigma * np.linalg.solve(information, parts)
    common = by_joint.sum(axis=1, keepdims=True)
    gains_covariance = np.asarray(
        (1.0 - _GAIN_CORRELATION) * by_joint @ by_joint.T + _GAIN_CORRELATION * common @ common.T
    )
    sensitivity, kept = np.linalg.solve(information, cross), slice(base.rank)
    sigmas = np.zeros(10)
    if "gravity_m_s2" not in identified.robot.document:
        # Gravity's relative standard deviation over inhabited places.
        sigmas[:4] = 5e-4 * fit.values[:4]
    payload = Payload(
        fit.values[:10],
        (
            fit.covariance
            + np.asarray(sensitivity @ identified.covariance[kept, kept] @ sensitivity.T)
            + gains_covariance
        )[:10, :10]
        + np.outer(sigmas, sigmas),
        rms_of(np.concatenate(fit.residuals), np.concatenate([block.used for block in fit.blocks])),
        float(np.sqrt(gains_covariance[0, 0])),
    )
    _check_plausible(identified, loaded, fit, payload)
    # A mass so uncertain does not differ from none.
    if not payload.mass_sigma_kg < 0.5 * payload.mass_kg:
        raise DegenerateError(
            f"payload: a mass of {figure(payload.mass_kg)} kg, with a sigma of "
            f"{figure(payload.mass_sigma_kg)} kg, does not differ from none.",
            next_step=f"{_HOW} Is this the run with it?",
        )
    return payload


def _check_plausible(
    identified: Identified, loaded: Sequence[Conditioned], fit: Regression, payload: Payload
) -> None:
    """Refuses a payload that only a mistaken recording shows, by its cause.

    Units, signs and mounts change the arm's own torques, too, which a payload and friction leave
    as they are.
    """
    base, n = identified.base, identified.robot.joint_count
    of_links = np.where(base.independent < 10 * n, identified.values, 0.0)
    blocks = []
    for stream, block in zip(loaded, fit.blocks, strict=True):
        link_torques = stream.filtered(lambda motion: base.regressor(motion) @ of_links)
        blocks.append(replace(block, x=np.concatenate([block.x, link_torques[:, :, None]], axis=2)))
    scaled = regress(blocks)
    change, sigma = float(scaled.values[-1]), float(np.sqrt(scaled.covariance[-1, -1]))
    torques = np.concatenate([stream.torques_nm for stream in loaded])
    used = np.concatenate([block.used for block in fit.blocks])
    ranges_nm = np.maximum(std_of(torques, used), 1e-12)
    left = float(np.max(payload.rms_nm / ranges_nm))
    # Friction that is free would take much of torques in another unit.
    unloaded_nm = np.max([stream.torque_nm for stream in identified.streams], axis=0)
    left = max(left, 0.1 * float(np.max(payload.rms_nm / unloaded_nm)))
    if left > _LIMITS.range_share[0]:
        # Another scale of all torques would also seem to be one of the wrist's, by the payload.
        remaining = rms_of(np.concatenate(scaled.residuals), used) / ranges_nm
        if remaining.max() > _LIMITS.range_share[0] or not 0.2 < 1.0 + change < 5.0:
            check_as_identified(identified, loaded)
    inertias = identified.inertias
    if (
        abs(change) > max(_LIMITS.own_torques, 5.0 * sigma)
        or left > _LIMITS.range_share[1]
        or payload.mass_kg < -5.0 * payload.mass_sigma_kg
        # No arm carries more than it weighs.
        or (inertias is not None and payload.mass_kg > inertias.masses.kg.sum())
    ):
        raise DataError(
            f"payload: {figure(payload.mass_kg)} kg are none: with them the arm's own torques "
            f"seem {figure(1.0 + change)} times those it was identified with, and up to "
            f"{figure(100.0 * left)} % of a joint's range stays unexplained.",
            culprits=[stream.label for stream in loaded],
            next_step="Record it as without payload: the same arm, mounted alike, with torques in "
            "N m of the joints, or currents of the same --gains.",
        )


@dataclass(frozen=True, eq=False)
class Gains:
    """The gains of n drives."""

    nm_per_a: FloatArray  # (n,) joint torque per current [N m/A].
    # (n,) standard deviations [N m/A]; inf where the payload does not act on the joint.
    sigma: FloatArray
    misfit: FloatArray  # (n,) root mean square of unexplained currents, over the currents' range.

    @property
    def determined(self) -> FloatArray:
        """(n,) gains that are determined to a tenth of their value."""
        return np.asarray(self.sigma < 0.1 * np.abs(self.nm_per_a))


@on_one_blas_thread
def drive_gains(
    base: BaseModel, empty: Sequence[Conditioned], loaded: Sequence[Conditioned], body: FloatArray
) -> Gains:
    """Estimates the drive gains.

    Each joint's current is the sum of the arm's own, linear in unknown parameters, and of the
    payload's known torque over the gain. The former is eliminated (Frisch and Waugh 1933).

    Args:
        base: The arm's model.
        empty: Motions without the payload; their `torques_nm` are currents [A].
        loaded: The same with it.
        body: (10,) the payload's inertial parameters in the flange's frame.

    Raises:
        DegenerateError: No joint's gain is determined.
    """
    robot = base.model.robot

    def load(motion: JointMotion) -> FloatArray:
        return np.asarray(body_regressor(robot, motion.q, motion.dq, motion.ddq) @ body)

    streams = (*empty, *loaded)
    arm_regressor = np.concatenate([stream.filtered(base.regressor) for stream in streams])
    payload_torques = np.concatenate(
        [np.zeros_like(item.torques_nm) for item in empty]
        + [item.filtered(load) for item in loaded]
    )
    currents = np.concatenate([stream.torques_nm for stream in streams])
    used = np.concatenate([stream.used for stream in streams])
    estimates = np.array(
        [
            _gain(arm_regressor[rows, joint], payload_torques[rows, joint], currents[rows, joint])
            for joint, rows in enumerate(used.T)
        ]
    )
    gains = Gains(*estimates.T)
    if not gains.determined.any():
        raise DegenerateError(
            "drive gains: the payload's torques stand out at no joint.",
            next_step="Carry a heavier one, off the last joint's axis, and move all joints.",
        )
    return gains


def check_gains(gains: Gains, base: BaseModel, empty: Sequence[Conditioned]) -> tuple[str, ...]:
    """Refuses gains that no drives have, by the likeliest cause.

    Returns:
        Doubts about the others.

    Raises:
        DataError: They are negative, explain the currents badly, or make torques of another unit.
    """
    sure = gains.determined
    sizes = np.where(sure, np.abs(gains.nm_per_a), np.median(np.abs(gains.nm_per_a[sure])))
    in_nm = [stream.scaled(sizes) for stream in empty]
    check_recording(base, in_nm)
    found = ", ".join(f"{value:.3g}" for value in gains.nm_per_a)
    backward = gains.nm_per_a[sure] < 0.0
    if backward.any():
        cause = "turn the signs of the currents of these joints"
        if backward.all():
            cause = "name the run without the body first, and that with it by --loaded"
        else:
            cause = f"give the body's centre in the flange's frame, or {cause}"
        raise DataError(
            f"drive gains: {found} N m/A, but no drive brakes what it drives.",
            culprits=["--loaded" if backward.all() else "--com-mm"],
            next_step=f"{cause[0].upper()}{cause[1:]}.",
        )
    worst = int(np.argmax(np.where(sure, gains.misfit, 0.0)))
    misfit = float(gains.misfit[worst])
    unexplained = (
        f"{figure(100.0 * misfit)} % of the range of joint {worst + 1}'s currents unexplained"
    )
    step = "Give the body's centre in the flange's frame in mm, and its inertia about that centre."
    if misfit > _LIMITS.range_share[0] or np.ptp(np.log10(sizes)) > 2.0:
        raise DataError(
            f"drive gains: {found} N m/A leave {unexplained}: the body is another one.",
            culprits=["--com-mm", "--mass-kg", "--inertia"],
            next_step=step,
        )
    doubts = [f"the gains leave {unexplained}. {step}"] if misfit > _LIMITS.differs_share else []
    if base.model.robot.inertias is not None:
        piece = max(in_nm[0].pieces, key=lambda value: len(value.measured))
        measured = piece.measured.chosen(slice(None, None, max(len(piece.measured) // 250, 1)))
        scales = described_scales(base.model.robot, measured)
        scale = float(np.nanmedian(scales)) if np.isfinite(scales).any() else 1.0
        # Makers' inertias are off by a fifth, and some of them by a half.
        if not 1.0 / 1.6 < scale < 1.6:
            doubts.append(
                f"by these gains the arm would weigh {figure(scale)} times what its description "
                "states: is --mass-kg right?"
            )
    return tuple(doubts)


def _gain(
    regressor: FloatArray, load: FloatArray, currents: FloatArray
) -> tuple[float, float, float]:
    """A joint's gain, its sigma and misfit, by regressor (m, b), payload torques and currents."""
    size = max(float(np.std(currents)), 1e-12)
    effective = regressor.any(axis=0)
    lengths = np.linalg.norm(regressor[:, effective], axis=0)
    directions, upper, _ = qr(regressor[:, effective] / lengths, mode="economic", pivoting=True)
    pivots = np.abs(np.diag(upper))
    directions = directions[:, pivots > 1e-8 * pivots[0]]
    load = load - directions @ (directions.T @ load)
    currents = currents - directions @ (directions.T @ currents)
    square = float(load @ load)
    if square <= 0.0:
        return 0.0, np.inf, 0.0
    inverse_gain = float(load @ currents) / square
    residual = currents - inverse_gain * load
    freedom = max(len(residual) - directions.shape[1] - 1, 1)
    sigma = float(np.sqrt(residual @ residual / freedom / square))
    misfit = float(np.sqrt(np.mean(residual**2))) / size
    if inverse_gain == 0.0:
        return 0.0, np.inf, misfit
    return 1.0 / inverse_gain, sigma / inverse_gain**2, misfit
