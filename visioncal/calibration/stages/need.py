"""Error budget of a pick where the views looked, and the probability that it meets a need.

A pick: the camera sees a thing as the views saw their target, and the robot goes to its position.
The error of the robot relative to the thing has these sources:

    calibration   the chain from the robot's base to the camera and the lens: the errors of all
                  unknowns together, through the fit's Jacobian
    board         what the uncertainty of its size and shape did to these; the thing is another
    look          the robot's noise at the look, where it carries the camera; and the focus, where
                  that changes from image to image
    arm           posture-dependent errors that were not calibrated, and errors that last from stop
                  to stop, which have other values at another time
    pick          the noise of the flange when it goes there, and the arm's error in that posture,
                  where it looked from another; a tool's length adds to it
    left out      the excess of held-out residuals over their prediction, beyond chance

Views that were rejected, by errors that an arm may have and for no reason that is known, count as
so many picks of their errors.

No camera finds a thing without noise; that is the task's own error, and not among them. Where the
arm has posture-dependent errors, calibrated or not, the position is compared with the one by the
whole chain: the errors of its first and last link are the same in all views, are absorbed by the
frames of camera and target, and recur when the arm picks. Of errors that are not significant, only
those of links are treated so.

A calibrated arm reaches its targets where they are corrected (`visioncal correct`). By the
controller's own poses it misses them by what was calibrated, which is known at each view, and adds
to the above: one that carries its camera looks in the posture of one view, and picks in that of
another.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.validate import HeldOutResiduals
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, rounded_up
from visioncal.core.prediction import at_points, sigmas_of, through, total_of
from visioncal.core.quantiles import chi2_limit
from visioncal.core.tolerance_probability import chance_within, radius_within
from visioncal.core.transforms import adjoint, apply_each, invert, log
from visioncal.core.types import FloatArray, IntArray, Need
from visioncal.estimation.fit import Closure, Fit
from visioncal.estimation.unknowns import BOARD, SIZE
from visioncal.results import NeedMet, Picker
from visioncal.robot.errors import ArmErrors
from visioncal.session.frames import object_name

# Source of what a calibrated arm misses by the controller's own poses.
CONTROLLER = "controller"


@dataclass(frozen=True, eq=False)
class Picks:
    """Predicted errors of picks by one robot of what one camera sees."""

    camera: str  # The camera's frame.
    robot: str  # The robot.
    # (k, 6, 6) covariance by source, of rotation [rad] and position [m] in the robot's base, at k
    # positions.
    parts: Mapping[str, FloatArray]
    freedom: float  # Degrees of freedom of the noise estimate.
    distance_m: float  # Mean distance of the positions from the camera.
    # (k, 6) known error, of the controller's own poses; None for targets that are corrected, or
    # need not be.
    offsets: FloatArray | None = None
    # The same picks by the controller's own poses; None where the arm is nominal.
    uncorrected: "Picks | None" = None
    # (m, 2) turn [rad] and shift [m] of rejected views, as may happen to m of k + m picks.
    strays: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def covariances(self) -> FloatArray:
        """(k, 6, 6) total covariance."""
        return total_of(self.parts)

    @cached_property
    def _with_strays(self) -> tuple[FloatArray, FloatArray | None]:
        """(k + m, 6, 6) covariances and (k + m, 6) known errors of picks, stray ones included."""
        covariances, count = self.covariances, len(self.strays)
        if not count:
            return covariances, self.offsets
        known = np.zeros((len(covariances), 6)) if self.offsets is None else self.offsets
        # Of a stray the size is known, and its direction is any.
        off = np.zeros((count, 6))
        off[:, [2, 3]] = self.strays
        mean = np.tile(covariances.mean(axis=0), (count, 1, 1))
        return np.concatenate([covariances, mean]), np.concatenate([known, off])

    def probability(self, need: Need) -> float:
        """The probability that a pick at one of the positions is within a need."""
        turn_rad = np.inf if need.deg is None else float(np.deg2rad(need.deg))
        shift_m = np.inf if need.mm is None else 1e-3 * need.mm
        covariances, offsets = self._with_strays
        return chance_within(covariances, turn_rad, shift_m, self.freedom, offsets)

    def without(self, *sources: str) -> "Picks":
        """Picks without the errors of some sources."""
        offsets = None if CONTROLLER in sources else self.offsets
        parts = {name: part for name, part in self.parts.items() if name not in sources}
        none = {"none": np.zeros_like(self.covariances)}
        return replace(self, parts=parts or none, offsets=offsets)

    @cached_property
    def good_for_mm(self) -> float:
        """The least need of position alone that would be met [mm]."""
        return 1e3 * self._least_need(0)

    @cached_property
    def good_for_deg(self) -> float:
        """The least need of rotation alone that would be met [deg]."""
        return float(np.rad2deg(self._least_need(3)))

    def _least_need(self, rolled: int) -> float:
        covariances, known = self._with_strays
        covariances = np.roll(covariances, rolled, axis=(1, 2))
        offsets = None if known is None else np.roll(known, rolled, axis=1)
        return radius_within(covariances, NeedLimits.probability[0], self.freedom, offsets)

    @property
    def budget_mm(self) -> dict[str, float]:
        """Standard deviation of the position by source, and as a `total` [mm]."""
        return self._budget(slice(3, 6), 1e3)

    @property
    def budget_deg(self) -> dict[str, float]:
        """Standard deviation of the rotation by source, and as a `total` [deg]."""
        return self._budget(slice(3), float(np.rad2deg(1.0)))

    def _budget(self, axes: slice, unit: float) -> dict[str, float]:
        known = {}
        if self.offsets is not None:
            known = {CONTROLLER: self.offsets[:, :, None] * self.offsets[:, None]}
        return sigmas_of({**self.parts, **known}, unit, axes)

    def stays_within(self, need: Need | None) -> str:
        """The limits that 95 % of picks are within, in the units of a need."""
        within = [f"{figure(rounded_up(self.good_for_deg))} deg"] if need and need.deg else []
        if need is None or need.mm or not within:
            within.insert(0, f"{figure(rounded_up(self.good_for_mm))} mm")
        return " and ".join(within)


def least_precise(picks: Sequence[Picks]) -> Picks:
    """The picks whose least need of position is the largest."""
    worst = max(picks, key=lambda pick: pick.budget_mm["total"])
    for other in picks:
        # A probability takes a tenth of the time of a least need.
        if other.probability(Need(mm=worst.good_for_mm)) < NeedLimits.probability[0]:
            worst = other
    return worst


def need_met(need: Need | None, picks: Sequence[Picks], *, whole: bool = False) -> NeedMet | None:
    """The probability that picks are within a need; None without a need or predictions.

    With `whole`, it is reported for each pair of a camera and a robot, too.
    """
    if need is None or not picks:
        return None
    pairs = [
        Picker(object_name(pick.camera, "camera"), pick.robot, pick.probability(need))
        for pick in picks
    ]
    return NeedMet(need, min(pair.probability for pair in pairs), tuple(pairs) if whole else ())


@dataclass(frozen=True, eq=False)
class PickInputs:
    """Input for the prediction of picks."""

    fit: Fit  # The fit of n sightings.
    held_out: HeldOutResiduals  # Their residuals by fits without their stops.
    # (3,) of each target, in its frame [m]; of others, their origin.
    target_centres: Mapping[str, FloatArray]
    freedom: Mapping[str, float]  # Degrees of freedom of each robot's noise.
    arms: Mapping[str, Arm]  # The robots' arms, at the fit's stops.
    # (3, b) Jacobian of each target's middle by the columns of boards, by its frame [m].
    centre_jacobians: Mapping[str, FloatArray]
    # (m, 2) turn [rad] and shift [m] of its views that were rejected, by camera; see `Picks`.
    strays: Mapping[str, FloatArray] = field(default_factory=dict)


def predict_picks(fitted: PickInputs, need: Need | None = None) -> tuple[Picks, ...]:
    """Predicts picks, for each camera and each robot between it and what it sees.

    They are at the need's place, or where the views looked.
    """
    seen, pairs = fitted.fit.seen, dict[tuple[str, str], list[int]]()
    for at, (observer, observed) in enumerate(zip(seen.observers, seen.observed, strict=True)):
        for step in fitted.fit.tree.path(observer, observed):
            if step.robot:
                pairs.setdefault((observer.partition("@")[0], step.robot), []).append(at)
    bias = {robot: _arm_bias(fitted, robot) for robot in {robot for _, robot in pairs}}
    return tuple(
        _picks(fitted, np.array(rows), camera, robot, bias[robot], need)
        for (camera, robot), rows in pairs.items()
    )


def _arm_bias(fitted: PickInputs, robot: str) -> FloatArray | None:
    """(p, q) bias of a fit for each error of an arm that it treats as noise."""
    arm = fitted.arms.get(robot)
    if arm is None or arm.model is not None or arm.errors is None or arm.errors.is_estimated:
        return None
    return arm.errors.sigma * fitted.fit.bias(robot, arm.errors)


def _picks(
    fitted: PickInputs,
    rows: IntArray,
    camera: str,
    robot: str,
    bias: FloatArray | None,
    need: Need | None,
) -> Picks:
    """Picks by one robot of what one camera sees, from the (n,) sightings with it between."""
    fit, arm, seen = fitted.fit, fitted.arms.get(robot), fitted.fit.seen.take(rows)
    base, stops = fit.tree.bases[robot], seen.stops
    frames = [name.partition("@")[0] for name in seen.observed]
    middles = np.array([fitted.target_centres.get(frame, np.zeros(3)) for frame in frames])
    closure, noise = fit.closure(rows, base), fit.noise
    in_base, to_base = closure.poses, adjoint(closure.poses)
    carries = np.array(
        [
            any(step.robot == robot for step in fit.tree.path(observer, base))
            for observer in seen.observers
        ]
    )
    calibrated = arm is not None and arm.model is not None
    errors = None if arm is None or calibrated else arm.errors
    as_noise = None if bias is None else errors
    whole = calibrated or (as_noise is not None and (as_noise.of_links or as_noise.is_significant))
    boards = fit.unknowns.of_kinds(BOARD, SIZE)
    if whole:
        # The whole chain, in the targets' frames, includes the noise of its flanges.
        unmoved = np.zeros((3, len(boards)))
        moved = [fitted.centre_jacobians.get(frame, unmoved) for frame in frames]
        closure, at_m = fit.closure(rows, things=np.array(moved)), middles
    else:
        at_m = apply_each(in_base, middles)
        if need is not None and need.at != "views":
            at_m = np.where(carries[:, None], at_m, np.array(need.at))
    covariance, parts = fit.whole, dict[str, FloatArray]()
    index = fit.robots.index(robot)
    level = pick_level = noise.robots[index]
    if as_noise is not None and bias is not None:
        covariance = covariance - bias @ bias.T
        by_posture, in_time = _arm_covariances(fit.closure(rows), robot, stops, as_noise, bias)
        if not whole:
            by_posture, in_time = (through(to_base, array) for array in (by_posture, in_time))
        parts["arm"] = by_posture + in_time
        if as_noise.white is not None:
            level = np.hypot(as_noise.white, as_noise.of_session)
            noise = noise.with_robot(index, level)
        pick_level = np.hypot(level, _lasting_sigma(as_noise))
    elif errors is not None:
        root = errors.sigma * adjoint(fit.flanges[robot][stops]) @ errors.basis[stops]
        parts["arm"] = root @ root.mT
    # The part of the covariance that is due to the boards' shapes.
    cross = covariance[:, boards]
    of_boards = cross @ np.linalg.pinv(cross[boards], hermitian=True) @ cross.T
    parts["calibration"] = closure.covariance(covariance - of_boards)
    parts["board"] = closure.covariance(of_boards)
    carried = carries[:, None, None]
    # Combined noise counts as the robot's, where it carries the camera.
    combined = carried * through(to_base, _diagonal(level))
    parts["look"] = combined if fit.is_combined else closure.noise(noise)
    by_source = {name: at_points(part, at_m) for name, part in parts.items()}
    at_camera = fit.measured[rows]
    in_camera = apply_each(at_camera, middles)
    axes = np.swapaxes(at_camera[:, :3, :3], 1, 2)[:, :, 2]
    if not whole:
        axes = (in_base[:, :3, :3] @ axes[:, :, None])[:, :, 0]
    # A focal length that is longer by a share shows a thing nearer by the same share.
    noise_px = fit.sigmas_px.get(camera)
    jitter = 0.0 if noise_px is None else noise_px * fit.lens_levels(camera).jitter
    focus_m = jitter * in_camera[:, 2, None] * axes
    by_source["look"][:, 3:, 3:] += focus_m[:, :, None] * focus_m[:, None]
    # A carried camera looks from another posture than the robot then has; before one that is fixed
    # the posture is the same, and the noise of a whole chain is already in it.
    fixed = 0.0 if whole else _diagonal(level)
    pick_noise = np.where(carried, _diagonal(pick_level), fixed)
    by_source["pick"] = _flange_covariance(fit, robot, stops, in_base, pick_noise)
    if as_noise is not None and not as_noise.of_links:
        by_source["pick"] = by_source["pick"] + carried * at_points(by_posture, at_m)
    by_source["left out"] = np.broadcast_to(_excess_covariance(fitted, rows), parts["look"].shape)
    picks = Picks(
        camera,
        robot,
        {name: array for name, array in by_source.items() if array.any()},
        fitted.freedom.get(robot, np.inf),
        float(np.linalg.norm(in_camera, axis=1).mean()),
        # Who carries the camera errs at the look and at the pick.
        strays=np.tile(fitted.strays.get(camera, np.zeros((0, 2))), (1 + bool(carries.any()), 1)),
    )
    by_controller = _uncorrected(
        *(picks, fitted, stops, in_base, at_m), whole=whole, is_carried=bool(carries.all())
    )
    return replace(picks, uncorrected=by_controller)


def _uncorrected(
    picks: Picks,
    fitted: PickInputs,
    stops: IntArray,
    in_base: FloatArray,
    at_m: FloatArray,
    *,
    whole: bool,
    is_carried: bool,
) -> Picks | None:
    """The same picks by the controller's own poses; None where these are the arm's.

    Args:
        picks: Picks at n sightings.
        fitted: The fit of the sightings.
        stops: (n,) the sightings' stops.
        in_base: (n, 4, 4) `base_from_target`.
        at_m: (n, 3) the positions, in the targets' frames where `whole`, else in the base [m].
        whole: Whether the picks are in the targets' frames.
        is_carried: Whether the robot carries the camera.
    """
    arm, flange = fitted.arms.get(picks.robot), fitted.fit.flanges[picks.robot][stops]
    if arm is None or (arm.model is None and arm.drift is None):
        return None
    carry = adjoint((invert(in_base) if whole else np.eye(4)) @ flange)
    missed = carry @ log(invert(flange) @ arm.reported[stops])[:, :, None]
    offsets = missed[:, :, 0]
    offsets[:, 3:] -= np.cross(at_m, offsets[:, :3])
    if not is_carried or len(offsets) < 2:
        return replace(picks, offsets=offsets)
    # A robot looks in the posture of one view, and picks in that of another.
    looks, after = np.arange(len(offsets)), np.arange(1, len(offsets))
    # So many pairs of views are picked by at most: twenty for each of fifty views.
    after = after[:: -(-len(looks) * len(after) // 1000)]
    goes = ((looks + after[:, None]) % len(looks)).ravel()
    looks = np.tile(looks, len(after))
    turn = np.zeros((len(offsets), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = in_base[:, :3, :3] if whole else np.eye(3)
    offsets = (turn @ offsets[:, :, None])[:, :, 0]
    parts = {name: (turn @ part @ turn.mT)[looks] for name, part in picks.parts.items()}
    strays = np.tile(picks.strays, (len(after), 1))
    return replace(picks, parts=parts, offsets=offsets[looks] - offsets[goes], strays=strays)


def _diagonal(level: FloatArray) -> FloatArray:
    """(6, 6) covariance of a flange's noise, from levels (2,) of rotation and position."""
    return np.diag(np.repeat(level, 3) ** 2)


def _flange_covariance(
    fit: Fit, robot: str, stops: IntArray, in_base: FloatArray, noise: FloatArray
) -> FloatArray:
    """(n, 6, 6) noise of a flange at its own origin, from (n, 6, 6) by its level."""
    # Combined noise of robot and camera is that of targets: its position part includes the flange's
    # rotation times their distance.
    covariance = noise.copy()
    if fit.is_combined:
        flange_m = fit.flanges[robot][stops, :3, 3]
        lever_m2 = np.sum((in_base[:, :3, 3] - flange_m) ** 2, axis=1)
        # With equal rotations about three axes, a point moves by two of their components.
        position_m2 = np.maximum(noise[:, 3, 3] - noise[:, 0, 0] * lever_m2 * 2.0 / 3.0, 0.0)
        covariance[:, 3:, 3:] = position_m2[:, None, None] * np.eye(3)
    return covariance


def _arm_covariances(
    closure: Closure, robot: str, stops: IntArray, errors: ArmErrors, bias: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances from arm errors that a fit treats as noise, for each of n sightings.

    Args:
        closure: The closure of the sightings.
        robot: The robot.
        stops: (n,) the sightings' stops.
        errors: The errors of the robot's arm.
        bias: (p, q) the fit's bias for each of them, scaled by its sigma.

    Returns:
        (n, 6, 6) twice: of posture-dependent errors, and of lasting ones. The latter have other
        values than at the stops of the fit, and vary as much as among these.
    """
    by_fit, last = closure.linear.jacobian @ bias, errors.is_time_correlated
    at_stops = errors.sigma * (closure.by_flange(robot) @ errors.basis[stops])
    by_posture = by_fit[:, :, ~last] - at_stops[:, :, ~last]
    changing = at_stops[:, :, last] - at_stops[:, :, last].mean(axis=0)
    in_time = np.concatenate([by_fit[:, :, last], changing], axis=2)
    return by_posture @ by_posture.mT, in_time @ in_time.mT


def _lasting_sigma(errors: ArmErrors) -> FloatArray:
    """(2,) RMS change of lasting errors among stops, of rotation [rad] and position [m]."""
    if not errors.time_correlated_count:
        return np.zeros(2)
    used = errors.basis.any(axis=(1, 2))
    change = errors.sigma * errors.basis[used][:, :, errors.is_time_correlated]
    squares = np.sum((change - change.mean(axis=0)) ** 2, axis=2).reshape(-1, 2, 3)
    return np.asarray(np.sqrt(squares.mean(axis=(0, 2))))


def _excess_covariance(fitted: PickInputs, rows: IntArray) -> FloatArray:
    """(6, 6) excess of some held-out residuals over their prediction, beyond chance."""
    expected, held_out, excess = fitted.fit.expected[rows], fitted.held_out, np.zeros((6, 6))
    for residuals, axes in (
        (held_out.residual_rad[rows], slice(0, 3)),
        (held_out.residual_m[rows], slice(3, 6)),
    ):
        measured = np.isfinite(residuals)
        if not measured.any():
            continue
        block = expected[measured][:, axes, axes]
        variance = np.trace(block, axis1=1, axis2=2)
        # Weights by the variance of a sum of squares: a view whose own pose is uncertain shows
        # little.
        weights = 1.0 / np.sum(block**2, axis=(1, 2))
        mean, observed = np.average([variance, residuals[measured] ** 2], axis=1, weights=weights)
        # About chi-square, with this many degrees of freedom (Satterthwaite 1946).
        count = mean**2 * float(weights.sum())
        if observed > mean * chi2_limit(NeedLimits.chance, count) / count:
            excess[axes, axes] = (observed - mean) / 3.0 * np.eye(3)
    return excess
