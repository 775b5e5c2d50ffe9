"""What a pick errs by where the views looked, and whether that is near enough.

A pick: the camera sees a thing as the views saw their target, and the robot goes to where it is.
Where the robot arrives differs from the thing by

    calibration   the chain from the robot's base to the camera and the lens: the errors of all
                  unknowns together, through the same slopes that the fit has
    board         by what the uncertainty of its size and shape did to these; the thing is another
    look          the robot's noise at the look, where it carries the camera; and the focus, where
                  that changes from image to image
    arm           errors that follow the arm's posture and were not calibrated, and errors that last
                  from stop to stop, which are others at another time
    pick          the noise of the flange when it goes there, and what the arm errs by in that
                  posture, where it looked from another; a tool's length adds to it
    left out      as far as views that were left out of the fit err by more than is predicted of
                  them and than chance explains

No camera finds a thing without noise; that is the task's own, and not among them. Where the arm
errs with its posture, calibrated or not, the place is compared with where the chain as a whole puts
it: what its first and last link do looks the same in all views, the frames of camera and target
have taken it up, and an arm that picks does it again. Of errors that are not beyond chance, they
alone are taken so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.validate import HeldOut
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, apply_each, invert, skew
from visioncal.core.types import FloatArray, IntArray, Need
from visioncal.estimation.arm import ArmErrors, misfit_jacobian
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution
from visioncal.estimation.tolerance_probability import chance_within, radius_within
from visioncal.results import NeedMet, Picker
from visioncal.session.frames import thing_name


@dataclass(frozen=True, eq=False)
class Picks:
    """Picks by one robot of what one camera sees.

    Attributes:
        camera: The camera's frame.
        robot: The robot.
        parts: (k, 6, 6) covariance by source, of rotation [rad] and place [m] in the robot's base,
            at k places.
        freedom: Degrees of freedom that the noise was estimated with.
        distance_m: How far the camera was from the places, on average.
    """

    camera: str
    robot: str
    parts: Mapping[str, FloatArray]
    freedom: float
    distance_m: float

    @property
    def spreads(self) -> FloatArray:
        """(k, 6, 6) of all sources together."""
        return np.asarray(np.sum(list(self.parts.values()), axis=0))

    def probability(self, need: Need) -> float:
        """The chance that a pick at one of the places lands within a need."""
        turn_rad = np.inf if need.deg is None else float(np.deg2rad(need.deg))
        shift_m = np.inf if need.mm is None else 1e-3 * need.mm
        return chance_within(self.spreads, turn_rad, shift_m, self.freedom)

    def without(self, source: str) -> "Picks":
        """Picks that do not err by one of the sources."""
        parts = {name: part for name, part in self.parts.items() if name != source}
        return replace(self, parts=parts or {"none": np.zeros_like(self.parts[source])})

    @cached_property
    def good_for_mm(self) -> float:
        """The least need of places alone that would be met [mm]."""
        return 1e3 * radius_within(self.spreads, NeedLimits.probability[0], self.freedom)

    @cached_property
    def good_for_deg(self) -> float:
        """The least need of directions alone that would be met [deg]."""
        turned = np.roll(self.spreads, 3, axis=(1, 2))
        return float(np.rad2deg(radius_within(turned, NeedLimits.probability[0], self.freedom)))

    @property
    def budget_mm(self) -> dict[str, float]:
        """Standard deviation of the place by source, and as a `total` [mm]."""
        return {name: 1e3 * value for name, value in self._budget(slice(3, 6)).items()}

    @property
    def budget_deg(self) -> dict[str, float]:
        """Standard deviation of the direction by source, and as a `total` [deg]."""
        return {name: float(np.rad2deg(value)) for name, value in self._budget(slice(3)).items()}

    def _budget(self, of: slice) -> dict[str, float]:
        every = {**self.parts, "total": self.spreads}
        squares = {
            name: np.trace(array[:, of, of], axis1=1, axis2=2) for name, array in every.items()
        }
        # Of two sources that make up for each other, one may be under zero.
        return {name: float(max(square.mean(), 0.0) ** 0.5) for name, square in squares.items()}

    def stays_within(self, need: Need | None) -> str:
        """Within what 95 % of picks land, in the units of a need."""
        within = [f"{figure(self.good_for_deg)} deg"] if need and need.deg else []
        if need is None or need.mm or not within:
            within.insert(0, f"{figure(self.good_for_mm)} mm")
        return " and ".join(within)


def need_met(need: Need | None, picks: Sequence[Picks], *, whole: bool = False) -> NeedMet | None:
    """How likely picks land within a need; None where nothing is needed or predicted.

    Args:
        need: What the task needs.
        picks: Those of each camera and robot.
        whole: Whether pairs are distinguished.
    """
    if need is None or not picks:
        return None
    pairs = [
        Picker(thing_name(pick.camera, "camera"), pick.robot, pick.probability(need))
        for pick in picks
    ]
    return NeedMet(need, min(pair.probability for pair in pairs), tuple(pairs) if whole else ())


@dataclass(frozen=True, eq=False)
class PickInputs:
    """What picks are predicted from.

    Attributes:
        problem: The n observations of the fit.
        fit: Their fit.
        covariance: (p, p) of the unknowns, with all that counts beside the noise.
        held_out: The observations' residuals by fits without their stops.
        middles: (3,) of each target, in its frame [m]; of others, their origin.
        freedom: Degrees of freedom of each robot's noise.
        arms: The robots' arms, at the problem's stops.
        of_boards: The problem's columns of boards' shapes.
        moved: (3, b) how the middle of each target moves with these, by its frame [m].
        whole: The observations of all pairs, merged or not, that the fit was made from.
        jitters: By which share the focal length of each camera changes from image to image.
    """

    problem: Problem
    fit: Solution
    covariance: FloatArray
    held_out: HeldOut
    middles: Mapping[str, FloatArray]
    freedom: Mapping[str, float]
    arms: Mapping[str, RobotArm]
    of_boards: IntArray
    moved: Mapping[str, FloatArray]
    whole: Problem
    jitters: Mapping[str, float]


def picks_of(fitted: PickInputs, need: Need | None = None) -> tuple[Picks, ...]:
    """Predicts picks, for each camera and each robot that parts it from what it sees.

    Args:
        fitted: The fit.
        need: Where they count; where the views looked without.
    """
    problem = fitted.problem
    pairs: dict[tuple[str, str], list[int]] = {}
    for group in problem.groups:
        observer = problem.observations.observers[int(group.rows[0])].partition("@")[0]
        for step in group.path:
            if step.robot:
                pairs.setdefault((observer, step.robot), []).extend(group.rows.tolist())
    off = {robot: _off_by_arm(fitted, robot) for robot in {robot for _, robot in pairs}}
    return tuple(
        _picks(_part(fitted, sorted(rows)), camera, robot, off[robot], need)
        for (camera, robot), rows in pairs.items()
    )


def _off_by_arm(fitted: PickInputs, robot: str) -> FloatArray | None:
    """By how much (p, q) a fit is off with each error of an arm that it takes for noise."""
    arm = fitted.arms.get(robot)
    if arm is None or arm.model is not None or arm.errors is None or arm.errors.is_estimated:
        return None
    state, noise = fitted.fit.state, fitted.fit.noise
    return arm.errors.sigma * misfit_jacobian(fitted.whole, state, noise, robot, arm.errors)


def _part(fitted: PickInputs, rows: Sequence[int]) -> PickInputs:
    """The information of some of the observations on picks."""
    chosen = np.isin(np.arange(len(fitted.problem)), rows)
    held = fitted.held_out
    kept = replace(held, away_m=held.away_m[chosen], away_rad=held.away_rad[chosen])
    return replace(fitted, problem=fitted.problem.subset(chosen), held_out=kept)


def _picks(
    fitted: PickInputs, camera: str, robot: str, off: FloatArray | None, need: Need | None
) -> Picks:
    """Picks of what one camera sees by one robot, from the observations that it parts."""
    problem, state, noise = fitted.problem, fitted.fit.state, fitted.fit.noise
    seen, base, arm = problem.observations, problem.tree.bases[robot], fitted.arms.get(robot)
    in_base = _in_base(problem, state, base)
    middles = np.array(
        [fitted.middles.get(name.partition("@")[0], np.zeros(3)) for name in seen.observed]
    )
    carries = np.array([_is_between(problem, observer, base, robot) for observer in seen.observers])
    calibrated = arm is not None and arm.model is not None
    errors = None if arm is None or calibrated else arm.errors
    unfitted = None if off is None else errors
    whole = calibrated or (unfitted is not None and (unfitted.of_links or unfitted.is_significant))
    if whole:
        # The whole chain, in the targets' frames: the noise of its flanges is in it.
        looking, at_m = _of_things(fitted), middles
    else:
        looking, at_m = _to_base(fitted, base, in_base), apply_each(in_base, middles)
        if need is not None and need.at != "views":
            at_m = np.where(carries[:, None], at_m, np.array(need.at))
    linear, covariance, parts = looking.linear(state, ideal=True), fitted.covariance, {}
    turned, at = adjoint(in_base), problem.robots.index(robot)
    white = again = noise.robots[at]
    if unfitted is not None and off is not None:
        covariance = covariance - off @ off.T
        by_posture, in_time = _left_by_arm(fitted, robot, unfitted, off)
        if not whole:
            by_posture, in_time = (turned @ array @ turned.mT for array in (by_posture, in_time))
        parts["arm"] = by_posture + in_time
        if unfitted.white is not None:
            white, levels = unfitted.white, noise.robots.copy()
            levels[at] = white
            noise = replace(noise, robots=levels)
        again = np.hypot(white, _lasting(unfitted))
    elif errors is not None:
        parts["arm"] = _of_arm(problem, robot, errors)
    of_boards = _by_boards(covariance, fitted.of_boards)
    parts["calibration"] = linear.covariance(covariance - of_boards)
    parts["board"] = linear.covariance(of_boards)
    if problem.is_combined:
        # Noise of both as one counts as the robot's, where it carries the camera.
        alone = turned @ _axes(white) @ turned.mT
        look = carries[:, None, None] * alone
    else:
        look = looking.total_covariance(linear, noise) - looking.covariance(noise)
    parts["look"] = look
    placed = {name: _at_points(part, at_m) for name, part in parts.items()}
    at_camera = problem.measured(state)
    in_camera = apply_each(at_camera, middles)
    axes = np.swapaxes(at_camera[:, :3, :3], 1, 2)[:, :, 2]
    if not whole:
        axes = (in_base[:, :3, :3] @ axes[:, :, None])[:, :, 0]
    # A focal length that is longer by a share shows a thing nearer by it.
    nearer_m = fitted.jitters.get(camera, 0.0) * in_camera[:, 2, None] * axes
    placed["look"][:, 3:, 3:] += nearer_m[:, :, None] * nearer_m[:, None]
    # A camera that is carried looks from another posture than the robot then has; before one that
    # stands still it is the same, and of a whole chain its noise is among the chain's already.
    alike = 0.0 if whole else _axes(white)
    going = np.where(carries[:, None, None], _axes(again), alike)
    placed["pick"] = _of_flange(problem, robot, in_base, going)
    if unfitted is not None and not unfitted.of_links:
        placed["pick"] = placed["pick"] + carries[:, None, None] * _at_points(by_posture, at_m)
    placed["left out"] = np.broadcast_to(_unpredicted(fitted), parts["look"].shape)
    return Picks(
        camera,
        robot,
        {name: array for name, array in placed.items() if array.any()},
        fitted.freedom.get(robot, np.inf),
        float(np.linalg.norm(in_camera, axis=1).mean()),
    )


def _axes(level: FloatArray) -> FloatArray:
    """(6, 6) the covariance of a flange's noise of a level (2,), of rotation and place."""
    return np.diag(np.repeat(level, 3) ** 2)


def _of_flange(problem: Problem, robot: str, in_base: FloatArray, noise: FloatArray) -> FloatArray:
    """(n, 6, 6) the noise of a flange at its own origin, of (n, 6, 6) by its level."""
    # Where the noise of robot and camera is one, it is that of targets: what the flange's rotation
    # does to them by their distance is in that of their place.
    found = noise.copy()
    if problem.is_combined:
        flange_m = problem.poses[robot][problem.observations.stops, :3, 3]
        lever_m2 = np.sum((in_base[:, :3, 3] - flange_m) ** 2, axis=1)
        # About three axes alike, a rotation moves a point by two of its components.
        own = np.maximum(noise[:, 3, 3] - noise[:, 0, 0] * lever_m2 * 2.0 / 3.0, 0.0)
        found[:, 3:, 3:] = own[:, None, None] * np.eye(3)
    return found


def _is_between(problem: Problem, observer: str, base: str, robot: str) -> bool:
    return any(step.robot == robot for step in problem.tree.path(observer, base))


def _in_base(problem: Problem, state: State, base: str) -> FloatArray:
    """(n, 4, 4) `base_from_target` as each observation has it."""
    found = np.zeros((len(problem), 4, 4))
    for group in problem.groups:
        observer = problem.observations.observers[int(group.rows[0])]
        found[group.rows] = problem.between(base, observer, state, group.rows)
    return np.asarray(found @ problem.measured(state))


def _to_base(fitted: PickInputs, base: str, in_base: FloatArray) -> Problem:
    """The observations as if they were of the base itself, by way of what they saw."""
    # What a lens does to the measured poses of targets then moves the base instead.
    problem = fitted.problem
    carry, effects = adjoint(in_base), []
    for effect in problem.effects:
        at = problem.effect_columns[effect.name]
        of_thing = ~np.isin(np.arange(at.start, at.stop), fitted.of_boards)
        seen = None if effect.by_sensor is None else carry @ effect.by_sensor * of_thing
        effects.append(replace(effect, by_sensor=seen))
    return replace(
        problem,
        observations=replace(
            problem.observations,
            observed=(base,) * len(problem),
            measured=problem.measured(fitted.fit.state) @ invert(in_base),
            has_rotation=np.ones(len(problem), dtype=bool),
        ),
        effects=tuple(effects),
        points=frozenset(),
        with_repeats=False,
    )


def _of_things(fitted: PickInputs) -> Problem:
    """The observations as if they were of things that stand where the boards' middles are."""
    # A board of another size was measured at another distance, and a thing is not: all that a
    # board's shape then moves is its middle.
    problem, effects = fitted.problem, []
    still, frames = np.zeros((3, len(fitted.of_boards))), problem.observations.observed
    moved = np.array([fitted.moved.get(frame.partition("@")[0], still) for frame in frames])
    for effect in problem.effects:
        at, seen = problem.effect_columns[effect.name], effect.by_sensor
        of_boards = np.isin(np.arange(at.start, at.stop), fitted.of_boards)
        if seen is not None and of_boards.any():
            seen = seen.copy()
            seen[:, :3, of_boards], seen[:, 3:, of_boards] = 0.0, -moved
        effects.append(replace(effect, by_sensor=seen))
    return replace(problem, effects=tuple(effects))


def _by_boards(covariance: FloatArray, columns: IntArray) -> FloatArray:
    """(p, p) what would not be of a covariance, were the boards' shapes known."""
    among = covariance[:, columns]
    return np.asarray(among @ np.linalg.pinv(among[columns], hermitian=True) @ among.T)


def _at_points(spreads: FloatArray, points_m: FloatArray) -> FloatArray:
    """(n, 6, 6) of rotation and of (n, 3) points, by those of their frame's twist."""
    jacobian = np.broadcast_to(np.eye(6), spreads.shape).copy()
    jacobian[:, 3:, :3] = -skew(points_m)
    return np.asarray(jacobian @ spreads @ np.swapaxes(jacobian, 1, 2))


def _left_by_arm(
    fitted: PickInputs, robot: str, errors: ArmErrors, off: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What errors that a fit takes for noise make of each observation.

    Args:
        fitted: The fit.
        robot: Whose they are.
        errors: The errors.
        off: (p, q) by how much the fit is off with each of them, in its own size.

    Returns:
        (n, 6, 6) twice: of those that follow the posture, and of those that last. These are others
        than at the stops of the fit: as much as they have changed among these.
    """
    problem, state = fitted.problem, fitted.fit.state
    widened = problem.with_effects([*problem.effects, errors.effect(robot)])
    values = np.concatenate([state.values, np.zeros(off.shape[1])])
    jacobian = widened.linear(replace(state, values=values), ideal=True).jacobian
    size, last = problem.size, errors.last
    by_fit, own = jacobian[:, :, :size] @ off, errors.sigma * jacobian[:, :, size:]
    left = by_fit[:, :, ~last] - own[:, :, ~last]
    changing = own[:, :, last] - own[:, :, last].mean(axis=0)
    in_time = np.concatenate([by_fit[:, :, last], changing], axis=2)
    return left @ left.mT, in_time @ in_time.mT


def _lasting(errors: ArmErrors) -> FloatArray:
    """(2,) how much errors that last change among stops, of rotation [rad] and place [m]."""
    if not errors.lasting:
        return np.zeros(2)
    stood = errors.basis.any(axis=(1, 2))
    moved = errors.sigma * errors.basis[stood][:, :, errors.last]
    squares = np.sum((moved - moved.mean(axis=0)) ** 2, axis=2).reshape(-1, 2, 3)
    return np.asarray(np.sqrt(squares.mean(axis=(0, 2))))


def _of_arm(problem: Problem, robot: str, errors: ArmErrors) -> FloatArray:
    """(n, 6, 6) what errors that follow the posture make of a place, as a twist of the base."""
    stops = problem.observations.stops
    jacobian = errors.sigma * adjoint(problem.poses[robot][stops]) @ errors.basis[stops]
    return np.asarray(jacobian @ np.swapaxes(jacobian, 1, 2))


def _unpredicted(fitted: PickInputs) -> FloatArray:
    """(6, 6) by how much left-out views err more than is predicted, and than chance lets them."""
    problem, noise = fitted.problem, fitted.fit.noise
    linear = problem.linear(fitted.fit.state, ideal=True)
    expected = linear.covariance(fitted.covariance) + problem.total_covariance(linear, noise)
    held, found = fitted.held_out, np.zeros((6, 6))
    for away, axes in ((held.away_rad, slice(0, 3)), (held.away_m, slice(3, 6))):
        known = np.isfinite(away)
        if not known.any():
            continue
        among = expected[known][:, axes, axes]
        variance = np.trace(among, axis1=1, axis2=2)
        # By how much a sum of squares varies: a view whose own pose is known badly shows little.
        weights = 1.0 / np.sum(among**2, axis=(1, 2))
        mean, shown = np.average([variance, away[known] ** 2], axis=1, weights=weights)
        # About chi-square, with so many degrees (Satterthwaite 1946).
        count = mean**2 * float(weights.sum())
        if shown > mean * chi2_limit(NeedLimits.chance, count) / count:
            found[axes, axes] = (shown - mean) / 3.0 * np.eye(3)
    return found
