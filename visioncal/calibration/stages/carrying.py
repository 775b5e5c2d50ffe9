"""Where a calibrated arm is better than as stated, and what its joints' functions are."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.kinematics import Kinematics
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.workspace import postures
from visioncal.results.arm import CarriedRegion, CarriesOver, JointFunction, JointFunctions, Region

# What real arms of a metre's reach err by in another session, beyond what one session shows of
# them: warmth, wear, another mount [m per m of reach]. Of a UR10, 0.15 to 0.2 mm after months.
_SESSION_SHARE = 1.2e-4
# It is better where it errs by less than this share of what the arm as stated errs by.
_BETTER = 0.8
# At so many angles all around functions of the joints are evaluated.
_ANGLES = 180
# Ahead of the base, and behind it, is so far from the middle of the stops about its axis [rad].
_AHEAD, _BEHIND = np.pi / 3, 2 * np.pi / 3


@dataclass(frozen=True, eq=False)
class Predicted:
    """What is predicted at k postures all over the workspace.

    Attributes:
        places: (k, 3) of the flange in the base [m].
        sigmas_m: (k,) of the place of what the calibrated arm carries, in another session [m].
        nominal_m: (k,) the same of the arm as stated [m].
        session_m: The share of another session in the former [m].
    """

    places: FloatArray
    sigmas_m: FloatArray
    nominal_m: FloatArray
    session_m: float


def carries_over(arm: ArmData, kinematics: Kinematics) -> CarriesOver:
    """Says where a calibrated arm is better than the arm as stated.

    Args:
        arm: What was seen of it.
        kinematics: Which levels were compared.
    """
    with one_blas_thread():
        found = _predicted(arm, kinematics)
    stops = arm.model.base_from_flange(arm.q, arm.loads)[:, :3, 3]
    regions = _regions(found.places, stops)
    boxed = regions["box"]
    away = ~boxed if (~boxed).any() else boxed
    sigma_mm, nominal_mm = (1e3 * _rms(array[away]) for array in (found.sigmas_m, found.nominal_m))
    return CarriesOver(
        measured_mm=kinematics.result.chosen.held_out_mm,
        measured_nominal_mm=kinematics.result.nominal.held_out_mm,
        sigma_mm=sigma_mm,
        nominal_mm=nominal_mm,
        session_mm=1e3 * found.session_m,
        better_share=float(np.mean(found.sigmas_m < _BETTER * found.nominal_m)),
        regions=tuple(
            _region(name, found, region) for name, region in regions.items() if region.any()
        ),
    )


def functions_of(arm: ArmData, kinematics: Kinematics) -> JointFunctions | None:
    """The functions of an arm's joints as tables; None where none were found."""
    found = kinematics.functions
    if found is None:
        return None
    errors, sigmas = arm.function_errors(np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False))
    rows = zip(arm.model.nominal.joint_names, 1e3 * errors, 1e3 * sigmas, strict=True)
    return JointFunctions(
        size_mrad=1e3 * found.sigma_rad,
        length_deg=float(np.rad2deg(found.length_rad)),
        joints=tuple(
            JointFunction(name, tuple(error.tolist()), tuple(sigma.tolist()))
            for name, error, sigma in rows
        ),
    )


def _predicted(arm: ArmData, kinematics: Kinematics) -> Predicted:
    q = postures(arm.model.robot)
    moved = arm.place_jacobian(q)[1]
    noise = np.repeat(arm.noise.robots[arm.problem.robots.index(arm.robot)], 3) ** 2
    places = arm.model.base_from_flange(q)[:, :3, 3]
    session_m = _SESSION_SHARE * float(np.linalg.norm(places, axis=1).max())
    known = arm.place_sigmas_m(q) ** 2
    variances = known + np.einsum("mij,j,mij->m", moved, noise, moved) + session_m**2
    stated = ArmPair.of(arm.problem, kinematics.nominal.fit.state, arm.robot)
    away = _place(arm, arm.pair, arm.model.base_from_flange(q)) - _place(
        arm, stated, arm.model.nominal.base_from_flange(q) @ arm.model.flange_from_reported
    )
    # The truth is off from the calibrated arm by its sigma, whichever way that is off.
    nominal = np.sqrt(np.sum(away**2, axis=1) + variances)
    return Predicted(places, np.sqrt(variances), nominal, session_m)


def _place(arm: ArmData, pair: ArmPair, flange: FloatArray) -> FloatArray:
    """(k, 3) where what the arm carries is, seen from what stands still [m]."""
    poses = pair.at(flange)[1]
    if pair.is_observer_carried:
        return invert(poses)[:, :3, 3]
    return np.asarray(poses[:, :3, :3] @ arm.at + poses[:, :3, 3])


def _regions(places: FloatArray, stops: FloatArray) -> dict[Region, Mask]:
    """(k,) masks of places in the box of the stops, and beside it by the turn about the base."""
    boxed = np.all((places >= stops.min(axis=0)) & (places <= stops.max(axis=0)), axis=1)
    middle = stops.mean(axis=0)
    turned = np.arctan2(places[:, 1], places[:, 0]) - np.arctan2(middle[1], middle[0])
    turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi)
    ahead, behind = turned < _AHEAD, turned > _BEHIND
    return {
        "box": boxed,
        "ahead": ~boxed & ahead,
        "beside": ~boxed & ~ahead & ~behind,
        "behind": ~boxed & behind,
    }


def _region(name: Region, found: Predicted, chosen: Mask) -> CarriedRegion:
    sigma_mm, nominal_mm = (
        1e3 * _rms(array[chosen]) for array in (found.sigmas_m, found.nominal_m)
    )
    return CarriedRegion(name, sigma_mm, nominal_mm, sigma_mm < _BETTER * nominal_mm)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
