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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.validate import HeldOutResiduals
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, rounded_up
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, apply_each, compose, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask, Need
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.tolerance_probability import chance_within, radius_within
from visioncal.estimation.unknowns import BOARD
from visioncal.results import NeedMet, Picker
from visioncal.session.frames import object_name

# Source of what a calibrated arm misses by the controller's own poses.
CONTROLLER = "controller"
# So many pairs of views are picked by at most: twenty for each of fifty views.
_MOST_PAIRS = 1000


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
        return np.asarray(np.sum(list(self.parts.values()), axis=0))

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

    def without(self, source: str) -> "Picks":
        """Picks without the error of one source."""
        if source == CONTROLLER:
            return replace(self, offsets=None)
        parts = {name: part for name, part in self.parts.items() if name != source}
        return replace(self, parts=parts or {"none": np.zeros_like(self.parts[source])})

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
        budget, known, total = {}, {}, self.covariances
        if self.offsets is not None:
            known = {CONTROLLER: self.offsets[:, :, None] * self.offsets[:, None]}
            total = total + known[CONTROLLER]
        for name, covariances in {**self.parts, **known, "total": total}.items():
            squares = np.trace(covariances[:, axes, axes], axis1=1, axis2=2)
            # Of two sources that compensate, one may be negative.
            budget[name] = unit * float(max(squares.mean(), 0.0) ** 0.5)
        return budget

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

    fit: Fit  # The fit.
    problem: Problem  # Its observations, or n of them.
    held_out: HeldOutResiduals  # The observations' residuals by fits without their stops.
    # (3,) of each target, in its frame [m]; of others, their origin.
    target_centres: Mapping[str, FloatArray]
    freedom: Mapping[str, float]  # Degrees of freedom of each robot's noise.
    arms: Mapping[str, RobotArm]  # The robots' arms, at the problem's stops.
    # (3, b) Jacobian of each target's middle by the columns of boards, by its frame [m].
    centre_jacobians: Mapping[str, FloatArray]
    # Relative change of the focal length of each camera from image to image.
    jitters: Mapping[str, float]
    # (m, 2) turn [rad] and shift [m] of its views that were rejected, by camera; see `Picks`.
    strays: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def board_columns(self) -> IntArray:
        """(b,) the columns of boards' shapes."""
        return self.fit.unknowns.of_kinds(BOARD)


def predict_picks(fitted: PickInputs, need: Need | None = None) -> tuple[Picks, ...]:
    """Predicts picks, for each camera and each robot between it and what it sees.

    They are at the need's place, or where the views looked.
    """
    problem = fitted.problem
    pairs: dict[tuple[str, str], list[int]] = {}
    for group in problem.groups:
        observer = problem.observations.observers[int(group.rows[0])].partition("@")[0]
        for step in group.path:
            if step.robot:
                pairs.setdefault((observer, step.robot), []).extend(group.rows.tolist())
    bias = {robot: _arm_bias(fitted, robot) for robot in {robot for _, robot in pairs}}
    return tuple(
        _picks(_subset(fitted, sorted(rows)), camera, robot, bias[robot], need)
        for (camera, robot), rows in pairs.items()
    )


def _arm_bias(fitted: PickInputs, robot: str) -> FloatArray | None:
    """(p, q) bias of a fit for each error of an arm that it treats as noise."""
    arm = fitted.arms.get(robot)
    if arm is None or arm.model is not None or arm.errors is None or arm.errors.is_estimated:
        return None
    return arm.errors.sigma * fitted.fit.bias(robot, arm.errors)


def _subset(fitted: PickInputs, rows: Sequence[int]) -> PickInputs:
    """The input restricted to some of the observations."""
    chosen = np.isin(np.arange(len(fitted.problem)), rows)
    held = fitted.held_out
    kept = replace(held, residual_m=held.residual_m[chosen], residual_rad=held.residual_rad[chosen])
    return replace(fitted, problem=fitted.problem.subset(chosen), held_out=kept)


def _picks(
    fitted: PickInputs, camera: str, robot: str, bias: FloatArray | None, need: Need | None
) -> Picks:
    """Picks by one robot of what one camera sees, from the observations with it between."""
    problem, state, noise = fitted.problem, fitted.fit.state, fitted.fit.noise
    seen, base, arm = problem.observations, problem.tree.bases[robot], fitted.arms.get(robot)
    in_base = _base_from_targets(problem, state, base)
    frames = (name.partition("@")[0] for name in seen.observed)
    middles = np.array([fitted.target_centres.get(frame, np.zeros(3)) for frame in frames])
    carries = np.array(
        [
            any(step.robot == robot for step in problem.tree.path(observer, base))
            for observer in seen.observers
        ]
    )
    calibrated = arm is not None and arm.model is not None
    errors = None if arm is None or calibrated else arm.errors
    as_noise = None if bias is None else errors
    whole = calibrated or (as_noise is not None and (as_noise.of_links or as_noise.is_significant))
    if whole:
        # The whole chain, in the targets' frames, includes the noise of its flanges.
        observations, at_m = _as_things(fitted), middles
    else:
        observations, at_m = _as_seen_by_base(fitted, base, in_base), apply_each(in_base, middles)
        if need is not None and need.at != "views":
            at_m = np.where(carries[:, None], at_m, np.array(need.at))
    linearised, covariance, parts = observations.linear(state, ideal=True), fitted.fit.whole, {}
    to_base, column = adjoint(in_base), problem.robots.index(robot)
    level = pick_level = noise.robots[column]
    if as_noise is not None and bias is not None:
        covariance = covariance - bias @ bias.T
        by_posture, in_time = _arm_covariances(fitted, robot, as_noise, bias)
        if not whole:
            by_posture, in_time = (to_base @ array @ to_base.mT for array in (by_posture, in_time))
        parts["arm"] = by_posture + in_time
        if as_noise.white is not None:
            level, levels = as_noise.white, noise.robots.copy()
            levels[column] = level
            noise = replace(noise, robots=levels)
        pick_level = np.hypot(level, _lasting_sigma(as_noise))
    elif errors is not None:
        stops = seen.stops
        root = errors.sigma * adjoint(problem.poses[robot][stops]) @ errors.basis[stops]
        parts["arm"] = root @ root.mT
    # The part of the covariance that is due to the boards' shapes.
    cross = covariance[:, fitted.board_columns]
    of_boards = cross @ np.linalg.pinv(cross[fitted.board_columns], hermitian=True) @ cross.T
    parts["calibration"] = linearised.covariance(covariance - of_boards)
    parts["board"] = linearised.covariance(of_boards)
    carried = carries[:, None, None]
    if problem.is_combined:
        # Combined noise counts as the robot's, where it carries the camera.
        look = carried * (to_base @ _diagonal(level) @ to_base.mT)
    else:
        look = observations.total_covariance(linearised, noise) - observations.covariance(noise)
    parts["look"] = look
    by_source = {name: _at_points(part, at_m) for name, part in parts.items()}
    at_camera = problem.measured(state)
    in_camera = apply_each(at_camera, middles)
    axes = np.swapaxes(at_camera[:, :3, :3], 1, 2)[:, :, 2]
    if not whole:
        axes = (in_base[:, :3, :3] @ axes[:, :, None])[:, :, 0]
    # A focal length that is longer by a share shows a thing nearer by the same share.
    focus_m = fitted.jitters.get(camera, 0.0) * in_camera[:, 2, None] * axes
    by_source["look"][:, 3:, 3:] += focus_m[:, :, None] * focus_m[:, None]
    # A carried camera looks from another posture than the robot then has; before one that is fixed
    # the posture is the same, and the noise of a whole chain is already in it.
    fixed = 0.0 if whole else _diagonal(level)
    pick_noise = np.where(carried, _diagonal(pick_level), fixed)
    by_source["pick"] = _flange_covariance(problem, robot, in_base, pick_noise)
    if as_noise is not None and not as_noise.of_links:
        by_source["pick"] = by_source["pick"] + carried * _at_points(by_posture, at_m)
    by_source["left out"] = np.broadcast_to(_excess_covariance(fitted), parts["look"].shape)
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
        picks, fitted, in_base, at_m, whole=whole, is_carried=bool(carries.all())
    )
    return replace(picks, uncorrected=by_controller)


def _uncorrected(
    picks: Picks,
    fitted: PickInputs,
    in_base: FloatArray,
    at_m: FloatArray,
    *,
    whole: bool,
    is_carried: bool,
) -> Picks | None:
    """The same picks by the controller's own poses; None where these are the arm's.

    Args:
        picks: Picks at the n observations.
        fitted: Their fit.
        in_base: (n, 4, 4) `base_from_target`.
        at_m: (n, 3) the positions, in the targets' frames where `whole`, else in the base [m].
        whole: Whether the picks are in the targets' frames.
        is_carried: Whether the robot carries the camera.
    """
    problem, arm = fitted.problem, fitted.arms.get(picks.robot)
    if arm is None or (arm.model is None and arm.drift is None):
        return None
    stops = problem.observations.stops
    flange = problem.poses[picks.robot][stops]
    carry = adjoint((invert(in_base) if whole else np.eye(4)) @ flange)
    missed = carry @ log(invert(flange) @ arm.reported[stops])[:, :, None]
    offsets = missed[:, :, 0]
    offsets[:, 3:] -= np.cross(at_m, offsets[:, :3])
    if not is_carried or len(offsets) < 2:
        return replace(picks, offsets=offsets)
    # It looks in the posture of one view, and picks in that of another.
    looks, after = np.arange(len(offsets)), np.arange(1, len(offsets))
    after = after[:: -(-len(looks) * len(after) // _MOST_PAIRS)]
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
    problem: Problem, robot: str, in_base: FloatArray, noise: FloatArray
) -> FloatArray:
    """(n, 6, 6) noise of a flange at its own origin, from (n, 6, 6) by its level."""
    # Combined noise of robot and camera is that of targets: its position part includes the flange's
    # rotation times their distance.
    covariance = noise.copy()
    if problem.is_combined:
        flange_m = problem.poses[robot][problem.observations.stops, :3, 3]
        lever_m2 = np.sum((in_base[:, :3, 3] - flange_m) ** 2, axis=1)
        # With equal rotations about three axes, a point moves by two of their components.
        own_m2 = np.maximum(noise[:, 3, 3] - noise[:, 0, 0] * lever_m2 * 2.0 / 3.0, 0.0)
        covariance[:, 3:, 3:] = own_m2[:, None, None] * np.eye(3)
    return covariance


def _base_from_targets(problem: Problem, state: State, base: str) -> FloatArray:
    """(n, 4, 4) `base_from_target` of each observation."""
    base_from_camera = np.zeros((len(problem), 4, 4))
    for group in problem.groups:
        observer = problem.observations.observers[int(group.rows[0])]
        base_from_camera[group.rows] = problem.between(base, observer, state, group.rows)
    return np.asarray(base_from_camera @ problem.measured(state))


def _with_sensors(
    fitted: PickInputs, change: Callable[[FloatArray, Mask], FloatArray]
) -> tuple[Effect, ...]:
    """Effects whose (n, 6, k) actions on measured poses are changed; the mask is of boards."""
    effects, at = [], 6 * len(fitted.problem.unknown)
    for effect in fitted.problem.effects:
        of_boards = np.isin(np.arange(at, at := at + len(effect)), fitted.board_columns)
        by_sensor = effect.by_sensor
        by_sensor = None if by_sensor is None else change(by_sensor, of_boards)
        effects.append(replace(effect, by_sensor=by_sensor))
    return tuple(effects)


def _as_seen_by_base(fitted: PickInputs, base: str, in_base: FloatArray) -> Problem:
    """The observations converted to ones of the base, through what they saw."""
    # The lens's effect on the measured poses of targets then moves the base instead.
    problem, carry = fitted.problem, adjoint(in_base)
    observations = replace(
        problem.observations,
        observed=(base,) * len(problem),
        measured=problem.measured(fitted.fit.state) @ invert(in_base),
        has_rotation=np.ones(len(problem), dtype=bool),
    )
    return replace(
        problem,
        observations=observations,
        effects=_with_sensors(fitted, lambda array, boards: carry @ array * ~boards),
        points=frozenset(),
        with_repeats=False,
    )


def _as_things(fitted: PickInputs) -> Problem:
    """The observations converted to ones of things at the boards' middles."""
    # A board of another size was measured at another distance, and a thing is not: a board's shape
    # then only moves its middle.
    problem, unmoved = fitted.problem, np.zeros((3, len(fitted.board_columns)))
    frames = (frame.partition("@")[0] for frame in problem.observations.observed)
    jacobian = np.array([fitted.centre_jacobians.get(frame, unmoved) for frame in frames])

    def moved(array: FloatArray, boards: Mask) -> FloatArray:
        array = array * ~boards
        if boards.any():
            array[:, 3:, boards] = -jacobian
        return array

    return replace(problem, effects=_with_sensors(fitted, moved))


def _at_points(covariances: FloatArray, points_m: FloatArray) -> FloatArray:
    """(n, 6, 6) covariance of rotation and (n, 3) points, from that of their frame's twist."""
    carry = adjoint(compose(np.eye(3), -points_m))
    return np.asarray(carry @ covariances @ carry.mT)


def _arm_covariances(
    fitted: PickInputs, robot: str, errors: ArmErrors, bias: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances from arm errors that a fit treats as noise, for each observation.

    Args:
        fitted: The fit.
        robot: The robot.
        errors: Its arm's errors.
        bias: (p, q) the fit's bias for each of them, scaled by its sigma.

    Returns:
        (n, 6, 6) twice: of posture-dependent errors, and of lasting ones. The latter have other
        values than at the stops of the fit, and vary as much as among these.
    """
    problem, state = fitted.problem, fitted.fit.state
    widened = problem.with_effects([*problem.effects, errors.effect(robot)])
    values = np.concatenate([state.values, np.zeros(bias.shape[1])])
    jacobian = widened.linear(replace(state, values=values), ideal=True).jacobian
    size, last = problem.size, errors.is_time_correlated
    by_fit, own = jacobian[:, :, :size] @ bias, errors.sigma * jacobian[:, :, size:]
    by_posture = by_fit[:, :, ~last] - own[:, :, ~last]
    changing = own[:, :, last] - own[:, :, last].mean(axis=0)
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


def _excess_covariance(fitted: PickInputs) -> FloatArray:
    """(6, 6) excess of held-out residuals over their prediction, beyond chance."""
    problem, noise = fitted.problem, fitted.fit.noise
    linear = problem.linear(fitted.fit.state, ideal=True)
    expected = linear.covariance(fitted.fit.whole) + problem.total_covariance(linear, noise)
    held_out, excess = fitted.held_out, np.zeros((6, 6))
    for residuals, axes in (
        (held_out.residual_rad, slice(0, 3)),
        (held_out.residual_m, slice(3, 6)),
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
