"""Where a calibrated arm is more accurate than the nominal one, and its joint error functions."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.kinematics import SelectedArmLevel
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.workspace import postures
from visioncal.results.arm import CarriedRegion, CarriesOver, JointFunction, JointFunctions, Region

# Error of real arms between sessions (warm-up, wear, remounting), which one session does not show
# [m per m of reach]. Of a UR10, 0.15 to 0.2 mm after months.
_SESSION_SHARE = 1.2e-4
# The calibrated arm is better where its error is below this share of the nominal arm's.
_BETTER = 0.8
# Number of angles per turn at which joint error functions are tabulated.
_ANGLES = 180
# Angles about the base from the centre of the stops: ahead below the first, behind above the
# second [rad].
_AHEAD, _BEHIND = np.pi / 3, 2 * np.pi / 3


@dataclass(frozen=True, eq=False)
class PredictedAccuracy:
    """Predicted accuracy at k postures over the workspace."""

    places: FloatArray  # (k, 3) positions of the flange in the base frame [m].
    # (k,) position sigma of what the calibrated arm carries, in another session [m].
    sigmas_m: FloatArray
    nominal_m: FloatArray  # (k,) the same for the nominal arm [m].
    session_m: float  # Contribution of the change of session to `sigmas_m` [m].


def carries_over(arm: ArmData, kinematics: SelectedArmLevel) -> CarriesOver:
    """Computes where a calibrated arm is more accurate than the nominal one."""
    with one_blas_thread():
        predicted = _predicted_accuracy(arm, kinematics)
    stops = arm.model.base_from_flange(arm.q, arm.loads)[:, :3, 3]
    regions = _regions(predicted.places, stops)
    box = regions["box"]
    sigma_mm, nominal_mm = _region_rms_mm(predicted, ~box if (~box).any() else box)
    return CarriesOver(
        measured_mm=kinematics.result.chosen.held_out_mm,
        measured_nominal_mm=kinematics.result.nominal.held_out_mm,
        sigma_mm=sigma_mm,
        nominal_mm=nominal_mm,
        session_mm=1e3 * predicted.session_m,
        better_share=float(np.mean(predicted.sigmas_m < _BETTER * predicted.nominal_m)),
        regions=tuple(
            _region(name, predicted, region) for name, region in regions.items() if region.any()
        ),
    )


def functions_of(arm: ArmData, kinematics: SelectedArmLevel) -> JointFunctions | None:
    """Tables of an arm's joint error functions; None where none were found."""
    functions = kinematics.functions
    if functions is None:
        return None
    errors, sigmas = arm.function_errors(np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False))
    rows = zip(arm.model.nominal.joint_names, 1e3 * errors, 1e3 * sigmas, strict=True)
    return JointFunctions(
        size_mrad=1e3 * functions.sigma_rad,
        length_deg=float(np.rad2deg(functions.length_rad)),
        joints=tuple(
            JointFunction(name, tuple(error.tolist()), tuple(sigma.tolist()))
            for name, error, sigma in rows
        ),
    )


def _predicted_accuracy(arm: ArmData, kinematics: SelectedArmLevel) -> PredictedAccuracy:
    q = postures(arm.model.robot)
    jacobian = arm.place_jacobian(q)[1]
    noise = np.repeat(arm.noise.robots[arm.problem.robots.index(arm.robot)], 3) ** 2
    flange = arm.model.base_from_flange(q)
    places = flange[:, :3, 3]
    session_m = _SESSION_SHARE * float(np.linalg.norm(places, axis=1).max())
    estimated = arm.place_sigmas_m(q) ** 2
    variances = estimated + np.einsum("mij,j,mij->m", jacobian, noise, jacobian) + session_m**2
    nominal_pair = ArmPair.of(arm.problem, kinematics.nominal.fit.state, arm.robot)
    nominal_flange = arm.model.nominal.base_from_flange(q) @ arm.model.flange_from_reported
    difference = _carried_position(arm, arm.pair, flange) - _carried_position(
        arm, nominal_pair, nominal_flange
    )
    # The calibrated arm's own error is independent of its difference from the nominal arm.
    nominal = np.sqrt(np.sum(difference**2, axis=1) + variances)
    return PredictedAccuracy(places, np.sqrt(variances), nominal, session_m)


def _carried_position(arm: ArmData, pair: ArmPair, flange: FloatArray) -> FloatArray:
    """Position (k, 3) of what the arm carries, in the frame of what stands still [m]."""
    poses = pair.at(flange)[1]
    if pair.is_observer_carried:
        return invert(poses)[:, :3, 3]
    return np.asarray(poses[:, :3, :3] @ arm.at + poses[:, :3, 3])


def _regions(places: FloatArray, stops: FloatArray) -> dict[Region, Mask]:
    """Masks (k,) of places in the stops' bounding box, and outside it by angle about the base."""
    box = np.all((places >= stops.min(axis=0)) & (places <= stops.max(axis=0)), axis=1)
    centre = stops.mean(axis=0)
    angle = np.arctan2(places[:, 1], places[:, 0]) - np.arctan2(centre[1], centre[0])
    angle = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
    ahead, behind = angle < _AHEAD, angle > _BEHIND
    return {
        "box": box,
        "ahead": ~box & ahead,
        "beside": ~box & ~ahead & ~behind,
        "behind": ~box & behind,
    }


def _region(name: Region, predicted: PredictedAccuracy, region: Mask) -> CarriedRegion:
    sigma_mm, nominal_mm = _region_rms_mm(predicted, region)
    return CarriedRegion(name, sigma_mm, nominal_mm, sigma_mm < _BETTER * nominal_mm)


def _region_rms_mm(predicted: PredictedAccuracy, region: Mask) -> tuple[float, float]:
    """Rms over a region for the calibrated and the nominal arm [mm]."""
    sigma_m, nominal_m = (
        float(np.sqrt(np.mean(values[region] ** 2)))
        for values in (predicted.sigmas_m, predicted.nominal_m)
    )
    return 1e3 * sigma_m, 1e3 * nominal_m
