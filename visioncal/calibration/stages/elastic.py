"""Joint stiffness and backlash by the stops, and the check of stated loads against deflections."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import figure, some_of
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT, ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.bending import (
    Factor,
    compliance_unit,
    flange_bends,
    observed_bends,
    payload_factor,
)
from visioncal.results.arm import ElasticResult, JointBacklash, JointSpring, LoadedStop, Sag

# A compliance is determined where its sigma is below this share of its prior sigma.
_DETERMINED = 0.5
# Least torque on a loaded joint [N m].
_LOADED_NM = 0.05
# Least compliance of a joint with a stiffness [sigma].
_SURE = 2.0


@dataclass(frozen=True, eq=False)
class Elastic:
    """Compliances of an arm's joints, with the loads and deflections at the stops."""

    springs: tuple[JointSpring, ...]  # The springs, joint by joint.
    torques_nm: FloatArray  # (m, n) torques on the joints at the stops [N m].
    # (m, n) deflection of each joint by each stop alone [rad]; NaN where undetermined.
    bends_rad: FloatArray
    sag_mm: FloatArray  # (m,) flange deflection under the loads of each stop [mm].
    payload_kg: FloatArray  # (m,) payload at each stop [kg].
    # Ratio of the deflection under load to that expected from the stated load; None without any
    # load on the flange.
    payload: Factor | None
    weighs: bool  # Whether the model of the arm states the masses of its links.
    # (n, 4 n) compliance of the joints to the weight of links of unknown mass (see `bent_joints`);
    # None where masses are known, or hardly matter.
    weight_moments: FloatArray | None

    @property
    def rigid(self) -> tuple[str, ...]:
        """The joints whose compliance the loads do not determine."""
        return tuple(spring.joint for spring in self.springs if not spring.determined)

    def result(self, views: Sequence[int]) -> ElasticResult:
        """The springs as a section of a calibration; `views` (m,) are those of the stops."""
        return ElasticResult(
            joints=self.springs,
            not_determined=self.rigid,
            weight="of the model's masses" if self.weighs else "unknown",
            payload_kg=(float(self.payload_kg.min()), float(self.payload_kg.max())),
            sag_mm=Sag(float(np.median(self.sag_mm)), float(self.sag_mm.max())),
            stops=tuple(self._stop(at, view) for at, view in enumerate(views)),
            weight_moments=self.weight_moments,
            payload_factor=self.payload,
        )

    def _stop(self, at: int, view: int) -> LoadedStop:
        """Torques and bends of a stop; a bend that is not determined is left out."""
        joints = (spring.joint for spring in self.springs)
        bends = zip(joints, self.bends_rad[at].tolist(), strict=True)
        return LoadedStop(
            view=view,
            payload_kg=float(self.payload_kg[at]),
            sag_mm=float(self.sag_mm[at]),
            torque_nm=tuple(self.torques_nm[at].tolist()),
            bend_mrad={name: 1e3 * bend for name, bend in bends if np.isfinite(bend)},
        )


def springs_of(arm: ArmData, errors: Mapping[str, ArmErrors]) -> Elastic | None:
    """Estimated springs of an arm, by its errors with prior sizes; None for a rigid one."""
    if not errors.keys() & {COMPLIANCE, WEIGHT}:
        return None
    model, q, loads = arm.model, arm.q, arm.loads
    prior = errors[COMPLIANCE].sigma / model.torque_nm if COMPLIANCE in errors else 0.0
    torques = model.robot.load_torques(model.bent(q, loads), loads)
    sigmas = np.full(model.nominal.joint_count, prior)
    bends_rad = np.full(torques.shape, np.nan)
    if COMPLIANCE in model.weights:
        variances = np.diag(arm.arm_covariance)[model.columns_of(COMPLIANCE)]
        sigmas = compliance_unit(model) * np.sqrt(variances)
        bends_rad = observed_bends(arm, torques)
    is_determined = (np.abs(torques).max(axis=0) > _LOADED_NM) & (sigmas < _DETERMINED * prior)
    return Elastic(
        tuple(_springs(model, np.minimum(sigmas, prior), is_determined, torques)),
        torques,
        bends_rad,
        1e3 * flange_bends(model, q, loads),
        loads.payload_kg,
        payload_factor(arm),
        model.nominal.masses is not None,
        model.moments,
    )


def _springs(
    model: ArmModel, sigmas: FloatArray, determined: Mask, torques: FloatArray
) -> Iterator[JointSpring]:
    names, compliances = model.nominal.joint_names, model.compliance.tolist()
    columns = (names, compliances, sigmas.tolist(), determined.tolist())
    for at, (name, compliance, sigma, is_determined) in enumerate(zip(*columns, strict=True)):
        stiff = 1.0 / compliance if is_determined and compliance >= _SURE * sigma else None
        yield JointSpring(
            joint=name,
            compliance_rad_per_nm=compliance,
            sigma_rad_per_nm=sigma,
            determined=is_determined,
            torque_nm=(float(torques[:, at].min()), float(torques[:, at].max())),
            stiffness_nm_per_rad=stiff,
            stiffness_sigma_nm_per_rad=None if stiff is None else sigma * stiff**2,
        )


def _stiffness_words(spring: JointSpring) -> str:
    """The stiffness of a joint with its sigma; empty where it has none."""
    stiffness, sigma = spring.stiffness_nm_per_rad, spring.stiffness_sigma_nm_per_rad
    if stiffness is None or sigma is None:
        return ""
    return f"{spring.joint} {1e-3 * stiffness:.4g} +- {figure(1e-3 * sigma)} kN m/rad"


def remarks(elastic: Elastic) -> Iterator[str]:
    """Remarks on the springs, for the verdict."""
    words = ", ".join(filter(None, map(_stiffness_words, elastic.springs)))
    if words:
        yield (
            f"The joints bend under load: their stiffness is {words}. At these stops that moves "
            f"the flange by up to {figure(float(elastic.sag_mm.max()))} mm."
        )
    if elastic.weight_moments is not None:
        yield (
            "The arm yields to its own weight, of which its model states nothing: how far is "
            "estimated at every posture, and counted. A payload_kg that changes, or mass_kg and "
            "com_m in the joints' table, determine the stiffness."
        )
    elif elastic.rigid and len(elastic.rigid) == len(elastic.springs):
        yield (
            "Of this level no joint is seen to bend under the loads of these stops: all are taken "
            "for rigid, and what was estimated is links, offsets and gears."
        )
    elif elastic.rigid:
        several = len(elastic.rigid) > 1
        yield (
            f"{some_of(elastic.rigid)} {'are' if several else 'is'} not seen to bend under the "
            f"loads of these stops, and {'are' if several else 'is'} taken for rigid. A load of "
            "another direction, or farther out, would show it."
        )


def doubts(elastic: Elastic) -> Iterator[Finding]:
    """Findings where the stated load contradicts the deflection."""
    factor = elastic.payload
    if factor is not None and elastic.weighs and factor.is_off:
        more = "heavier or hangs farther out" if factor.value > 1.0 else "lighter or hangs nearer"
        yield Finding(
            "load",
            f"Load and bend do not fit: the stops with a load bend {factor.value:.2f} +- "
            f"{figure(factor.sigma)} times as far as the load times its reach asks of joints that "
            f"yield to the arm's own weight as they do. The load is {more} than stated "
            "(payload_kg, payload_x_m ...), or the masses of the arm's links are off.",
            Remedy("Weigh the load, and correct payload_kg and its centre in views.csv."),
        )


def plays_of(model: ArmModel, covariance: FloatArray) -> tuple[JointBacklash, ...]:
    """Backlash of each joint; empty where stops were not approached from both sides.

    Joints lag behind their motion. Where they seem to lead as a whole, the column approach holds
    the opposite direction, and the sign is turned.

    Args:
        model: The arm.
        covariance: (p, p) covariance of its errors.
    """
    if BACKLASH not in model.weights:
        return ()
    place = model.columns_of(BACKLASH)
    sigmas = model.weights[BACKLASH] * np.sqrt(np.diag(covariance)[place])
    names = model.nominal.joint_names
    sign = np.copysign(1.0, np.sum(model.backlash / sigmas**2))
    columns = zip(names, (sign * model.backlash).tolist(), sigmas.tolist(), strict=True)
    return tuple(JointBacklash(name, band, sigma) for name, band, sigma in columns)


def play_remarks(plays: Sequence[JointBacklash]) -> Iterator[str]:
    """Remark on joints with significant backlash, for the verdict."""
    sure = [play for play in plays if play.is_sure]
    if not sure:
        return
    words = ", ".join(
        f"{backlash.joint} {figure(1e3 * abs(backlash.deadband_rad))} +- "
        f"{figure(1e3 * backlash.sigma_rad)} mrad"
        for backlash in sure
    )
    yield (
        f"Joints have play: {words}. The calibrated arm stands in the middle of it: approach every "
        "stop from the same side where half of that matters."
    )
