"""Joint stiffness and backlash by the stops, and the check of stated loads against deflections."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from visioncal.core.limits import CONTRADICTION, DETERMINED
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT, ArmModel
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import Effect
from visioncal.results.arm import ElasticResult, Factor, JointBacklash, JointSpring, Sag
from visioncal.robot import Loads, Robot


def elastic_of(arm: ArmData, errors: Mapping[str, ArmErrors]) -> ElasticResult | None:
    """Estimated springs of an arm, with its loads and deflections; None for a rigid one.

    Args:
        arm: The observations of the arm.
        errors: Its errors with prior sizes, by block.
    """
    if not errors.keys() & {COMPLIANCE, WEIGHT}:
        return None
    model, loads, names = arm.model, arm.loads, arm.model.nominal.joint_names
    torques = model.robot.load_torques(model.bent(arm.q, loads), loads)
    sigmas, prior = np.zeros(len(names)), 0.0
    if COMPLIANCE in errors:
        prior = errors[COMPLIANCE].sigma / model.torque_nm
        variances = np.diag(arm.arm_covariance)[model.columns_of(COMPLIANCE)]
        unit = model.weights[COMPLIANCE] / model.torque_nm
        sigmas = np.minimum(unit * np.sqrt(variances), prior)
    determined = sigmas < DETERMINED * prior
    is_stiff = determined & (model.compliance > CONTRADICTION * sigmas)
    springs = []
    for at, (name, compliance, sigma) in enumerate(
        zip(names, model.compliance.tolist(), sigmas.tolist(), strict=True)
    ):
        stiff = 1.0 / compliance if is_stiff[at] else None
        spring = JointSpring(
            joint=name,
            compliance_rad_per_nm=compliance,
            sigma_rad_per_nm=sigma,
            determined=bool(determined[at]),
            torque_nm=(float(torques[:, at].min()), float(torques[:, at].max())),
            stiffness_nm_per_rad=stiff,
            stiffness_sigma_nm_per_rad=None if stiff is None else sigma * stiff**2,
        )
        springs.append(spring)
    rigid = model.robot.base_from_flange(arm.q)[:, :3, 3]
    deflection = model.base_from_flange(arm.q, loads)[:, :3, 3] - rigid
    sag_mm = 1e3 * np.linalg.norm(deflection, axis=1)
    return ElasticResult(
        joints=tuple(springs),
        not_determined=tuple(spring.joint for spring in springs if not spring.determined),
        weight=weight_words(model.nominal),
        **load_ranges(loads),
        sag_mm=Sag(float(np.median(sag_mm)), float(sag_mm.max())),
        weight_moments=model.moments,
        payload_factor=_payload_factor(arm),
    )


def weight_words(robot: Robot) -> str:
    """Where the deflection by the links' own weight comes from."""
    if robot.weight_compensated:
        return "compensated by the controller"
    return "unknown" if robot.masses is None else "of the model's masses"


def load_ranges(loads: Loads) -> dict[str, Any]:
    """Smallest and largest payload [kg] and, where there is one, force [N]."""
    force = np.linalg.norm(loads.force_n, axis=1)
    kg = (float(loads.payload_kg.min()), float(loads.payload_kg.max()))
    stated = {"force_n": (float(force.min()), float(force.max()))} if force.any() else {}
    return {"payload_kg": kg, **stated}


def _payload_factor(arm: ArmData) -> Factor | None:
    """Ratio of the actual to the predicted bending under the stated payload and force.

    One more unknown beside all others, tested at the solution (Rao's score test). The compliances
    are determined by the arm's own weight, and by the loads' differences between postures. None
    where there were no loads or they bend nothing.
    """
    model, loads, reported = arm.model, arm.loads, arm.fit.problem.poses[arm.robot]
    if not loads.any or not model.compliance.any():
        return None
    bent, robot = model.bent(arm.q, loads), model.robot
    load_torques = robot.load_torques(bent, loads) - robot.load_torques(bent)
    flange_jacobian = np.zeros((len(reported), 6, 1))
    twists = np.einsum("mij,mj->mi", robot.axis_jacobian(bent), model.compliance * load_torques)
    flange_jacobian[arm.stops] = twists[:, :, None]
    flanges = {arm.robot: flange_jacobian}
    payload = Effect.free("payload", PriorInformation.flat(1), flange_jacobian=flanges)
    widened = arm.fit.with_columns(payload)
    covariance, (_, gradient) = widened.absorbed, widened.equations
    sigma = float(np.sqrt(covariance[-1, -1]))
    return Factor(1.0 - float(covariance[-1] @ gradient), sigma)


def remarks(elastic: ElasticResult) -> Iterator[str]:
    """Remarks on the springs, for the verdict."""
    words = ", ".join(
        f"{spring.joint} {1e-3 * spring.stiffness_nm_per_rad:.4g} +- "
        f"{figure(1e-3 * spring.stiffness_sigma_nm_per_rad)} kN m/rad"
        for spring in elastic.joints
        if spring.stiffness_nm_per_rad is not None and spring.stiffness_sigma_nm_per_rad is not None
    )
    if words:
        yield (
            f"The joints bend under load: their stiffness is {words}. At these stops that moves "
            f"the flange by up to {figure(elastic.sag_mm.most)} mm."
        )
    if elastic.weight.startswith("compensated"):
        yield (
            "Loads bend the arm, and its own weight does not: its controller compensates that, as "
            "those of KUKA and ABB do."
        )
    if elastic.weight_moments is not None:
        yield (
            "The arm yields to its own weight, of which its model states nothing: how far is "
            "estimated at every posture, and counted. A payload_kg that changes, or mass_kg and "
            "com_m in the joints' table, determine the stiffness."
        )


def doubts(elastic: ElasticResult) -> Iterator[Finding]:
    """Findings where the stated load contradicts the deflection."""
    factor = elastic.payload_factor
    if factor is not None and elastic.weight.startswith("of ") and factor.is_off:
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
    variances = np.diag(covariance)[model.columns_of(BACKLASH)]
    sigmas = model.weights[BACKLASH] * np.sqrt(variances)
    bands = np.copysign(1.0, np.sum(model.backlash / sigmas**2)) * model.backlash
    columns = (model.nominal.joint_names, bands.tolist(), sigmas.tolist())
    return tuple(JointBacklash(*row) for row in zip(*columns, strict=True))


def play_remarks(plays: Sequence[JointBacklash]) -> Iterator[str]:
    """Remark on joints with significant backlash, for the verdict."""
    words = ", ".join(
        f"{play.joint} {figure(1e3 * abs(play.deadband_rad))} +- "
        f"{figure(1e3 * play.sigma_rad)} mrad"
        for play in plays
        if play.is_sure
    )
    if words:
        yield (
            f"Joints have play: {words}. The calibrated arm stands in the middle of it: approach "
            "every stop from the same side where half of that matters."
        )
