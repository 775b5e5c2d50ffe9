"""Stiffness by a session under several loads, held against a calibration of the unloaded arm.

The calibration's frames and arm are the prior, with their joint covariance; the unknowns beside
them are the joints' compliances. One posture is enough: moments tell which joints a load reaches.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.calibration.stages.readings import read_instrument, stops_of_views
from visioncal.core.errors import DataError
from visioncal.core.limits import CONTRADICTION, DETERMINED
from visioncal.core.number_format import counted, figure
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import adjoint, invert, log
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.results import Calibration
from visioncal.results.arm import ElasticResult, JointSpring, Sag
from visioncal.robot import Loads
from visioncal.robot.arm_model import COMPLIANCE, ArmModel
from visioncal.robot.elasticity import BENDS, SOFT, weight_words
from visioncal.robot.loads import load_ranges
from visioncal.session import Session
from visioncal.session.table import loads_of
from visioncal.verification.calibration_prior import CalibrationPrior

_MISFIT = Remedy(
    "Read unloaded stops again: instrument, probe or base may have moved since. Calibrate them, "
    "and compare both results with visioncal diff."
)
_WEIGH = Remedy("Weigh the loads, and correct payload_kg and its centre in views.csv.")


@dataclass(frozen=True, eq=False)
class PredictedReadings:
    """An instrument's readings beside those that a calibrated arm would give."""

    prior: CalibrationPrior  # The calibration.
    views: tuple[int, ...]  # (m,) their numbers.
    stops: IntArray  # (m,) stop of each.
    q: FloatArray  # (m, n) joint angles [rad].
    loads: Loads
    read: FloatArray  # (m, 4, 4) the probe in the instrument's frame; of a point, as predicted.
    predicted: FloatArray  # (m, 4, 4) the same by the calibration.
    axes: IntArray  # Of the six residuals of a reading (rotation, position), those that were read.
    # (m, 6, k) right perturbations of the predicted pose by the frames and the arm's errors.
    by_prior: FloatArray
    by_flange: FloatArray  # (m, 6, 6) the same by the flange.
    reading_variances: FloatArray  # (m, 6) variances of the instrument.
    flange: FloatArray  # (6,) variances of the flange from stop to stop.

    @property
    def residuals(self) -> FloatArray:
        """(m, d) read less predicted, in the probe's frame [rad, m]."""
        return np.asarray(log(invert(self.predicted) @ self.read)[:, self.axes])

    @property
    def noise(self) -> FloatArray:
        """(m d, m d) covariance of the residuals; readings at one stop share the flange's error."""
        by_flange = self.by_flange[:, self.axes] * np.sqrt(self.flange)
        shared = np.einsum("mik,njk->minj", by_flange, by_flange)
        shared *= (self.stops[:, None] == self.stops)[:, None, :, None]
        count = len(self.views) * len(self.axes)
        independent = np.diag(self.reading_variances[:, self.axes].ravel())
        return np.asarray(shared.reshape(count, count) + independent)


def predict_readings(session: Session, calibration: Calibration) -> PredictedReadings:
    """Predicts an instrument's readings by a calibration of the same instrument's place and probe.

    Raises:
        DataError: The session is none of an instrument, or has no joint angles of the arm.
    """
    label = f"session {session.name!r}"
    if calibration.mount != "instrument" or session.mount != "instrument":
        other = "calibration" if calibration.mount != "instrument" else "session"
        raise DataError(
            f"{label}: readings of an instrument are held against a calibration by one, and the "
            f"{other} is of a camera.",
            culprits=[f"{other} mount"],
            next_step="Calibrate the unloaded arm with the same instrument and probe.",
        )
    prior = CalibrationPrior.of(calibration)
    readings, stop_of = read_instrument(session), stops_of_views(session)
    arm = calibration.calibrated_robot
    joints = {number: view.joints_rad for number, view in readings.views.items()}
    used = [readings.views[number] for number, at in joints.items() if at is not None]
    counts = {len(at) for at in joints.values() if at is not None}
    if arm is None or counts != {arm.joint_count}:
        raise DataError(
            f"{label}: {counted(len(used), 'reading')} with joint angles; those of the calibrated "
            f"arm{'' if arm is None else f' {arm.name}'} are needed with every reading.",
            culprits=["views.csv: q1_rad"],
            next_step="Record q1_rad ... with every reading.",
        )
    q = np.array([view.joints_rad for view in used])
    sides = [view.text.get("approach", "") for view in used]
    loads = loads_of([view.numbers for view in used], sides)
    x, z = prior.state.edges[:2]
    model = prior.model or ArmModel.of(arm, q, arm.base_from_flange(q))
    flange = model.base_from_flange(q, loads)
    predicted = invert(x) @ flange @ z
    by_flange = np.broadcast_to(adjoint(invert(z)), (len(q), 6, 6))
    by_x = -adjoint(invert(predicted))
    by_z = np.broadcast_to(np.eye(6), by_x.shape)
    parts = [by_x, by_z]
    if prior.model is not None and prior.model.weights:
        parts.append(by_flange @ prior.model.basis(q, loads))
    read = predicted.copy()
    read[:, :3, 3] = [view.reading_m for view in used]
    axes = np.arange(0 if readings.are_poses else 3, 6)
    if readings.are_poses:
        read = np.array([view.instrument_from_probe() for view in used])
    variances = np.zeros((len(q), 6))
    variances[:, :3] = (readings.instrument.sigma_rad or 0.0) ** 2
    variances[:, 3:] = readings.instrument.sigmas_m(read[:, :3, 3])[:, None] ** 2
    noise = np.repeat(prior.noise(from_corners=True).robots[0] ** 2, 3)
    names = [str(stop_of[view.number]) for view in used]
    stops = np.unique(names, return_inverse=True)[1]
    return PredictedReadings(
        *(prior, tuple(view.number for view in used), stops, q, loads, read, predicted, axes),
        *(np.concatenate(parts, axis=2), by_flange, variances, noise),
    )


def calibrate_loaded(session: Session, unloaded: Calibration) -> Calibration:
    """Adds the stiffness that a loaded session shows to a calibration of the unloaded arm.

    Raises:
        DataError: The session has no loads, or is not of the same instrument and arm.
    """
    seen, arm = predict_readings(session, unloaded), unloaded.calibrated_robot
    prior = seen.prior
    if arm is None or not seen.loads.any:
        raise DataError(
            f"session {session.name!r} states no load: payload_kg and force_z_n ... are empty.",
            culprits=["views.csv: payload_kg"],
            next_step="State payload_kg (with payload_x_m ...) or force_x_n, force_y_n, force_z_n "
            "in newtons, in the base's frame; weight pulls along -z.",
        )
    model, count = prior.model, arm.joint_count
    if unloaded.elastic is not None and (model is None or COMPLIANCE not in model.weights):
        # The error of the unloaded arm at a posture is the same in both: it must not count twice.
        raise DataError(
            f"calibration {unloaded.session_name!r} has the stiffness of earlier loads already.",
            culprits=["--against"],
            next_step="Put all loads into one session, and name the calibration of the unloaded "
            "arm.",
        )
    if unloaded.elastic is None:
        # Bends by the arm's own weight are in the geometry already.
        arm = arm.with_weight_compensated
    torques = arm.load_torques(seen.q, seen.loads) - arm.load_torques(seen.q)
    bends = seen.by_flange @ (arm.axis_jacobian(seen.q) * torques[:, None])
    jacobian, covariance = seen.by_prior, prior.covariance
    if model is not None and COMPLIANCE in model.weights:
        first = len(covariance) - len(model.values) + model.columns_of(COMPLIANCE).start
        springs, unit = slice(first, first + count), model.weights[COMPLIANCE] / model.torque_nm
        if unloaded.elastic is not None:
            # Its own weight did not bend them: what the others yield is no bound of theirs.
            stored = np.array([at.sigma_rad_per_nm for at in unloaded.elastic.joints])
            wider = np.zeros(len(covariance))
            wider[springs] = (unloaded.elastic.sigmas**2 - stored**2) / unit**2
            covariance = covariance + np.diag(wider)
    else:
        jacobian = np.concatenate([jacobian, bends], axis=2)
        covariance = block_diag(covariance, np.eye(count) * SOFT**2)
        springs, unit = slice(len(covariance) - count, None), 1.0
    rows = jacobian[:, seen.axes].reshape(-1, len(covariance))
    innovation = seen.noise + rows @ covariance @ rows.T
    gain = np.linalg.solve(innovation, rows @ covariance).T
    residuals = seen.residuals.ravel()
    found = unloaded.compliance + unit * (gain @ residuals)[springs]
    values = np.maximum(found, 0.0)
    after = unit**2 * (covariance - gain @ rows @ covariance)[springs, springs]
    misfit = float(residuals @ np.linalg.solve(innovation, residuals))
    before = unit * np.sqrt(np.diag(covariance)[springs])
    off_mm = 1e3 * np.linalg.norm(bends[:, 3:] @ found, axis=1)
    tip = bends[int(off_mm.argmax()), 3:]
    elastic = ElasticResult(
        joints=tuple(
            _springs(
                arm.joint_names, values, np.sqrt(np.diag(after)), torques + arm.load_torques(seen.q)
            )
        ),
        not_determined=(),
        weight=weight_words(arm),
        sag_mm=Sag(float(np.median(off_mm)), float(off_mm.max())),
        weight_moments=unloaded.weight_moments,
        **load_ranges(seen.loads),
    )
    open_joints = tuple(row.joint for row in elastic.joints if not row.determined)
    elastic = replace(elastic, not_determined=open_joints)
    sigma_mm = 1e3 * float(np.sqrt(np.trace(tip @ after @ tip.T)))
    begin = f"By {counted(len(seen.views), 'reading')} against {unloaded.session_name!r}"
    words = _words(elastic, sigma_mm, before, np.abs(torques).max(axis=0))
    findings = [Finding(NOTE, f"{begin}, {words}")]
    status = unloaded.verdict.status
    if misfit > chi2_limit(FALSE_ALARM, len(residuals)):
        status = "bad"
        # Loads in proportion to those stated, of any size.
        by_load = (bends @ unloaded.compliance)[:, seen.axes].ravel()
        weighed = np.linalg.solve(innovation, np.column_stack([by_load, residuals]))
        (square, cross), (_, all_of) = np.column_stack([by_load, residuals]).T @ weighed
        over = cross / square if square > 0.0 else 0.0
        is_load = all_of - over * cross < chi2_limit(FALSE_ALARM, len(residuals) - 1)
        words, do = "Load, instrument, probe or base differ from what was stated.", _MISFIT
        if is_load:
            words, do = f"Loads about {1.0 + over:.2g} times as large as stated do.", _WEIGH
        begin = f"No stiffness explains the readings: chi-square {figure(misfit)} for "
        words = f"{begin}{len(residuals)} numbers. {words}"
        findings.append(Finding("loads_misfit", words, do, is_fatal=True))
    robot = unloaded.arm if unloaded.arm is None else replace(unloaded.arm, robot=arm)
    return replace(
        unloaded,
        robot=unloaded.robot if robot is not None else arm,
        arm=robot,
        elastic=elastic,
        verdict=replace(
            unloaded.verdict,
            status=status,
            findings=(
                *findings,
                *(at for at in unloaded.verdict.findings if not at.words.startswith(BENDS)),
            ),
        ),
    )


def _springs(
    names: Sequence[str], values: FloatArray, sigmas: FloatArray, torques: FloatArray
) -> Iterator[JointSpring]:
    """Springs (n,); those that the loads' moments do not show stay open."""
    low, high = torques.min(axis=0).tolist(), torques.max(axis=0).tolist()
    for row in zip(names, values.tolist(), sigmas.tolist(), low, high, strict=True):
        name, value, sigma, least, most = row
        shown = value > CONTRADICTION * sigma
        yield JointSpring(
            joint=name,
            compliance_rad_per_nm=value,
            sigma_rad_per_nm=sigma,
            determined=shown,
            torque_nm=(least, most),
            stiffness_nm_per_rad=1.0 / value if shown else None,
            stiffness_sigma_nm_per_rad=sigma / value**2 if shown else None,
        )


def _words(
    elastic: ElasticResult, sigma_mm: float, before: FloatArray, loads_nm: FloatArray
) -> str:
    """Findings about the loads, joint by joint.

    Args:
        elastic: The joints' springs.
        sigma_mm: Standard deviation of the tip's largest motion [mm].
        before: (n,) prior standard deviations of the compliances [rad/(N m)].
        loads_nm: (n,) largest torques by the loads alone [N m].
    """
    shown, bounds = [], []
    for row, prior, load_nm in zip(elastic.joints, before, loads_nm, strict=True):
        if row.stiffness_nm_per_rad is not None and row.stiffness_sigma_nm_per_rad is not None:
            sigma = figure(1e-3 * row.stiffness_sigma_nm_per_rad)
            shown.append(f"{row.joint} {1e-3 * row.stiffness_nm_per_rad:.4g} +- {sigma} kN m/rad")
        elif load_nm < 0.01 * loads_nm.max():
            bounds.append(f"{row.joint} (no moment reaches it)")
        elif row.sigma_rad_per_nm > DETERMINED * prior:
            bounds.append(f"{row.joint} (its moment is too small)")
        else:
            least = 1.0 / (row.compliance_rad_per_nm + 2.0 * row.sigma_rad_per_nm)
            bounds.append(f"{row.joint} (over {figure(1e-3 * least)} kN m/rad)")
    words = f"{elastic.loads_words} move the tip by {figure(elastic.sag_mm.most)} +- "
    words += f"{figure(sigma_mm)} mm at most: the stiffness is {', '.join(shown) or 'open'}."
    if bounds:
        words += f" Not determined one by one: {', '.join(bounds)}."
    return words
