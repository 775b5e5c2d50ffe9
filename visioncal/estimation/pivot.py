"""Pivot calibration: a tool's tip and rotation from touches of fixed points.

In the tool's frame the touched point is `tool_from_flange * flange_from_base * point`, and the kind
of the touch says which of its coordinates are zero:

    point   x = y = z = 0             the tool's origin, its tip, is at the point
    z       x = y = 0,  z > 0         the point lies on the tool's positive z axis
    xz      y = 0,      x > 0         it lies in the tool's xz plane, on the side of positive x

Touches of kind `point` alone determine the tip but not the tool's rotation. The linear solution
starts a joint fit of the tool and of the touched points, whitened by the robot's stated noise.
Outlier touches are left out (see `group_outliers`) and named.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.quantiles import f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply_each, compose, invert, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, fit_groups
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.observability import Direction, Turning
from visioncal.estimation.placing import (
    LEAST_NOISE_M,
    TOUCH_NOISE_M,
    counted_noise_m,
    refuse_poor,
    worst_of,
)
from visioncal.estimation.points import Placement, PointProblem
from visioncal.estimation.problem_parts import Noise
from visioncal.estimation.robust import small_sets

TouchKind: TypeAlias = Literal["point", "z", "xz"]
# The coordinates that are zero, by kind.
_ZERO = {"point": (True, True, True), "z": (True, True, False), "xz": (False, True, False)}
# Chance that an outlier touch fits another point.
_FALSE_ALARM = 1e-3
_NO_NOISE = Noise.of_robot(0.0, 0.0)
# Largest scatter of careful touches [m]: beyond, the motion alone is not at fault.
_CARELESS_M = 1e-3
_FEWEST_TOUCHES = 3
_ADVICE = (
    "Touch the same point 3 or more times with the flange tilted by 20 to 45 degrees about "
    "different axes, not only turned about one."
)
# Least improvement of a correct convention over a wrong one, and largest rms with it [m].
_MUCH_BETTER, _CLOSED_M = 20.0, 2e-3


@dataclass(frozen=True, eq=False)
class Touches:
    """n touches of k points."""

    base_from_flange: FloatArray  # (n, 4, 4) poses of the flange [m].
    points: IntArray  # (n,) index of the touched point.
    kinds: tuple[TouchKind, ...]  # (n,) kind of each touch.
    labels: tuple[str, ...]  # (n,) names of the touches, for messages.
    names: tuple[str, ...]  # (k,) names of the points, for messages.

    def __len__(self) -> int:
        return len(self.points)

    def are(self, kind: TouchKind) -> Mask:
        """Mask (n,) of the touches of one kind."""
        return np.array([name == kind for name in self.kinds])

    def subset(self, chosen: Mask) -> "Touches":
        """Returns the touches of an (n,) mask; the points keep their numbers."""
        rows = np.flatnonzero(chosen)
        return replace(
            self,
            base_from_flange=self.base_from_flange[rows],
            points=self.points[rows],
            kinds=tuple(self.kinds[row] for row in rows),
            labels=tuple(self.labels[row] for row in rows),
        )


@dataclass(frozen=True, eq=False)
class PivotFit:
    """A tool from n touches of k points."""

    # The inlier touches, and their fit, in the tool's frame.
    agreement: GroupInliers[Placement]
    oriented: bool  # Whether the rotation was measured; else it is the flange's own.
    # (6, 6) of the tool's right perturbation (rotation [rad], translation [m]); zero in the
    # rotation where that was not measured.
    covariance: FloatArray
    points_covariance: FloatArray  # (k, 3, 3) of the touched points [m^2].
    # (n,) the other point that an outlier touch fits; None for none.
    belongs_to: tuple[int | None, ...]

    @property
    def flange_from_tool(self) -> FloatArray:
        """(4, 4) the tool [m]."""
        return self.agreement.fit.state.frame

    @property
    def points(self) -> FloatArray:
        """(k, 3) the touched points in the base [m]."""
        return self.agreement.fit.state.points

    @property
    def sigma_m(self) -> float:
        """Noise of a touch per axis [m], beyond the robot's stated one."""
        return self.agreement.fit.sigma

    @property
    def worst(self) -> tuple[Direction, ...]:
        """The least certain directions: the tip's, then the rotation's if measured."""
        return _worst(self.flange_from_tool, self.covariance, oriented=self.oriented)

    @property
    def looks_inverse(self) -> bool:
        """Whether the poses may be `flange_from_base`, which exchanges the tip and the one point.

        Touches of one point close either way; the poses look inverse where the tip is farther from
        the flange than the point is from the base.
        """
        reach = float(np.linalg.norm(self.flange_from_tool[:3, 3]))
        return len(self.points) == 1 and reach > float(np.linalg.norm(self.points[0]))


def tool_problem(touches: Touches, noise: Noise = _NO_NOISE, *, oriented: bool) -> PointProblem:
    """The problem of a tool; `noise` is of the flange's poses."""
    turn_rad, shift_m = noise.robots[0]
    tips, count = np.flatnonzero(touches.are("point")), len(touches)

    def starts(_: PointProblem) -> Iterator[Placement]:
        yield _start(touches, tips, oriented=oriented)
        for rows in small_sets(len(tips), min(len(touches.names) + 2, len(tips))):
            yield _start(touches, tips[rows], oriented=oriented)

    return PointProblem(
        np.zeros((count, 3)),
        np.array([_ZERO[kind] for kind in touches.kinds]).reshape(-1, 3),
        np.tile((shift_m**2 + LEAST_NOISE_M**2) * np.eye(3), (count, 1, 1)),
        starts,
        carriers=invert(touches.base_from_flange),
        points=touches.points,
        turn_rad=turn_rad,
        oriented=oriented,
    )


def _start(touches: Touches, rows: IntArray, *, oriented: bool) -> Placement:
    """Start with the tip by some touches of kind `point`."""
    tip = _linear_tip(touches.base_from_flange[rows], touches.points[rows])
    poses, are_tips = touches.base_from_flange, touches.are("point")
    tips = poses[:, :3, :3] @ tip + poses[:, :3, 3]
    points = [
        np.median(tips[are_tips & (touches.points == index)], axis=0)
        for index in range(len(touches.names))
    ]
    state = Placement(compose(np.eye(3), tip), np.array(points))
    return _turned(touches, state) if oriented else state


def _turned(touches: Touches, state: Placement) -> Placement:
    """Rotates the tool to the axes by the touches of kind `z` and `xz`."""
    tip = state.frame[:3, 3]
    offsets = apply_each(invert(touches.base_from_flange), state.points[touches.points]) - tip
    z_axis = _main_direction(offsets[touches.are("z")])
    aside = offsets[touches.are("xz")]
    x_axis = _main_direction(aside - np.outer(aside @ z_axis, z_axis))
    axes = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
    return replace(state, frame=compose(nearest_rotation(axes), tip))


def _main_direction(vectors: FloatArray) -> FloatArray:
    """Unit direction (3,) of a line along (n, 3) vectors, with the sign of the majority."""
    direction = np.linalg.svd(vectors, full_matrices=False)[2][0]
    side = np.sign(vectors @ direction)
    return np.asarray(direction * (1.0 if side.sum() + 0.5 * side[0] >= 0.0 else -1.0))


def _linear_tip(base_from_flange: FloatArray, points: IntArray) -> FloatArray:
    """The tip (3,) [m] in the flange by linear least squares: `R_i tip - point = -t_i`.

    The minimum-norm solution where the touches leave it undetermined.

    Args:
        base_from_flange: (n, 4, 4) poses of the flange [m].
        points: (n,) the point that the tip met.
    """
    names, index = np.unique(points, return_inverse=True)
    by_points = -np.kron(np.eye(len(names))[index], np.eye(3))
    system = np.hstack([base_from_flange[:, :3, :3].reshape(-1, 3), by_points])
    target = -base_from_flange[:, :3, 3].ravel()
    return np.asarray(np.linalg.lstsq(system, target, rcond=None)[0][:3])


def fit_pivot(
    touches: Touches, noise: Noise = _NO_NOISE, expected_sigma_m: float | None = None
) -> PivotFit:
    """Fits the tool on the flange.

    Args:
        touches: Of kind `point`, three of one point or two each of two points at least; with those
            of kind `z` and `xz`, one each at least, the tool's rotation too.
        noise: Stated errors of the flange's pose, per axis; zero where unknown.
        expected_sigma_m: Expected noise of a touch, per axis [m]; None where unknown.

    Raises:
        DataError: Touches are missing, or contradict each other: about the side of an axis, or
            grossly without an identifiable outlier.
        DegenerateError: They leave a direction undetermined; named with its predicted sigma.
    """
    _check_counts(touches)
    tips = touches.are("point")
    with one_blas_thread():
        used = touches.subset(tips)
        problem = tool_problem(used, noise, oriented=False)
        inliers = find_inlier_groups(problem, expected_sigma_m)
        _check_doubt(used, problem, inliers)
        _check_motion(used, problem, inliers.fit)
        if not tips.all():
            # Touches of the axes alone determine the tool's rotation: a consensus of few would fit
            # them and nothing else, so they join the inliers of the tip.
            presumed = np.ones(len(touches), dtype=bool)
            presumed[tips] = inliers.mask
            problem = tool_problem(touches, noise, oriented=True)
            start = (presumed, _turned(touches, inliers.fit.state))
            inliers = find_inlier_groups(problem, expected_sigma_m, start)
            _check_sides(touches, problem, inliers)
            _check_motion(touches, problem, inliers.fit)
        fit = inliers.fit
        expected_m = TOUCH_NOISE_M if expected_sigma_m is None else expected_sigma_m
        level = counted_noise_m(fit, expected_m)
        covariance = covariance_from(fit.groups.subset(fit.used).information(level))
        inliers = replace(inliers, fit=replace(fit, sigma=level, covariance=covariance))
        edge, count = 6 if problem.oriented else 3, len(fit.state.points)
        blocks, at = covariance[edge:, edge:].reshape(count, 3, count, 3), np.arange(count)
        return PivotFit(
            inliers,
            problem.oriented,
            _edge_covariance(covariance, oriented=problem.oriented),
            blocks[at, :, at, :],
            _belonging(problem, inliers),
        )


def _edge_covariance(covariance: FloatArray, *, oriented: bool) -> FloatArray:
    """(6, 6) of the tool's right perturbation; zero in a rotation that is not estimated."""
    size = 6 if oriented else 3
    return np.pad(covariance[:size, :size], (6 - size, 0))


def _worst(tool: FloatArray, covariance: FloatArray, *, oriented: bool) -> tuple[Direction, ...]:
    worst = worst_of(tool, covariance, "tool", "flange", origin="tip")
    return worst if oriented else worst[:1]


def _check_counts(touches: Touches) -> None:
    """Refuses too few touches, and touches of an axis whose point or partner is missing."""
    tips = touches.points[touches.are("point")]
    counts = np.bincount(tips, minlength=len(touches.names))
    if np.maximum(counts - 1, 0).sum() < _FEWEST_TOUCHES - 1:
        counted = ", ".join(
            f"{n} of {name or 'one point'}" for name, n in zip(touches.names, counts, strict=True)
        )
        raise DataError(
            f"tcp: {len(tips)} touches of kind point ({counted}): at least {_FEWEST_TOUCHES} of "
            "one point, or 2 each of two points, are needed.",
            culprits=touches.names,
            next_step=_ADVICE,
        )
    axes = [row for row, kind in enumerate(touches.kinds) if kind != "point"]
    unknown = [row for row in axes if not counts[touches.points[row]]]
    if unknown:
        name = touches.names[touches.points[unknown[0]]]
        raise DataError(
            f"tcp: touch {touches.labels[unknown[0]]} of kind {touches.kinds[unknown[0]]} is of "
            f"point {name!r}, which no touch of kind point has met.",
            culprits=[touches.labels[row] for row in unknown],
            next_step=f"Touch {name!r} with the tip, too, or name the point that was touched.",
        )
    kinds = {touches.kinds[row] for row in axes}
    if len(kinds) == 1:
        (given,) = kinds
        missing = "xz" if given == "z" else "z"
        raise DataError(
            f"tcp: there are touches of kind {given} but none of kind {missing}: together they "
            "determine the tool's rotation, one alone does not.",
            culprits=[touches.labels[row] for row in axes],
            next_step=f"Add a touch of kind {missing}, or leave out those of kind {given}.",
        )


def _check_doubt(touches: Touches, problem: PointProblem, inliers: GroupInliers[Placement]) -> None:
    """Refuses touches that contradict each other grossly without an identifiable outlier."""
    if not inliers.doubtful.any() or inliers.fit.sigma < _CARELESS_M:
        return
    labels = [touches.labels[row] for row in np.flatnonzero(inliers.doubtful)]
    fitting = [
        f"touch {touches.labels[index]} fits point {touches.names[at]!r}"
        for index, at in enumerate(_belonging(problem, inliers))
        if inliers.doubtful[index] and at is not None
    ]
    matches = f" ({', '.join(fitting)})" if fitting else ""
    raise DataError(
        f"tcp: touches {', '.join(labels)} contradict each other, at a scatter of "
        f"{1e3 * inliers.fit.sigma:.3g} mm, and which of them is wrong is not known{matches}.",
        culprits=labels,
        next_step="Touch their point once or twice more, or correct its name.",
    )


def _check_sides(touches: Touches, problem: PointProblem, inliers: GroupInliers[Placement]) -> None:
    local = problem.local(inliers.fit.state)
    sides: Sequence[tuple[TouchKind, FloatArray]] = (("z", local[:, 2]), ("xz", local[:, 0]))
    for kind, coordinates in sides:
        used = inliers.mask & touches.are(kind)
        behind = [touches.labels[index] for index in np.flatnonzero(used & (coordinates < 0.0))]
        before = [touches.labels[index] for index in np.flatnonzero(used & (coordinates > 0.0))]
        if behind:
            axis = kind[0]
            raise DataError(
                f"tcp: of the touches of kind {kind}, {', '.join(behind)} lie on the other side of "
                f"the tip along the tool's {axis} than {', '.join(before)}: each has to have its "
                f"point on the side of positive {axis}.",
                culprits=behind,
                next_step="Leave the wrong ones out, or touch again.",
            )


def _belonging(problem: PointProblem, inliers: GroupInliers[Placement]) -> tuple[int | None, ...]:
    """The other point that each outlier touch fits, by the touches beyond doubt."""
    suspects, fit = ~inliers.mask | inliers.doubtful, inliers.fit
    if inliers.doubtful.any():
        fit = fit_groups(problem, ~suspects, fit.state)
    belongs: list[int | None] = [None] * len(suspects)
    met = set(problem.points[fit.used].tolist())
    for row in np.flatnonzero(suspects).tolist():
        ratios = {}
        for point in met - {int(problem.points[row])}:
            points = problem.points.copy()
            points[row] = point
            groups = replace(problem, points=points).linearise(fit.state)
            seen = groups.observed[row]
            residual, jacobian = groups.residuals[row][seen], groups.jacobian[row][seen]
            covariance = groups.covariance(fit.sigma)[row][np.ix_(seen, seen)]
            covariance = covariance + jacobian @ fit.covariance @ jacobian.T
            limit = len(residual) * f_limit(_FALSE_ALARM, len(residual), max(fit.freedom, 1))
            ratios[point] = float(residual @ np.linalg.solve(covariance, residual) / limit)
        best = min(ratios, key=lambda point: ratios[point], default=None)
        if best is not None and ratios[best] < 1.0:
            belongs[row] = best
    return tuple(belongs)


def _check_motion(touches: Touches, problem: PointProblem, fit: GroupFit[Placement]) -> None:
    """Refuses touches that leave a direction undetermined."""

    def worst(covariance: FloatArray) -> tuple[Direction, ...]:
        edge = _edge_covariance(covariance, oriented=problem.oriented)
        return _worst(fit.state.frame, edge, oriented=problem.oriented)

    def cause(culprit: Direction) -> tuple[str, str]:
        used = touches.subset(fit.used)
        information = fit.groups.subset(fit.used).information(_CARELESS_M)
        careful = worst(covariance_from(information))
        if fit.sigma > _CARELESS_M and all(
            direction.sigma < direction.limit
            for direction in careful
            if direction.words == culprit.words
        ):
            words = f"the touches scatter by {1e3 * fit.sigma:.3g} mm"
            return words, "Look for poses of another tool or in other units, and touch again."
        if culprit.is_rotation:
            # Levers of the touches of the axes.
            local = 1e3 * np.abs(problem.local(fit.state)[fit.used])
            return (
                "the touches of kind z have their point at most "
                f"{figure(local[used.are('z'), 2].max())} mm from the tip, and those of kind xz "
                f"at most {figure(local[used.are('xz'), 0].max())} mm beside the tool's z axis"
            ), "Move the tool back by 50 mm or more along its axes before touching for z and xz."
        return _motion_words(used), _ADVICE

    refuse_poor("tcp", fit, worst, cause)


def _motion_words(used: Touches) -> str:
    """Words for what is wrong with the motion, of touches of the same point."""
    tips = used.subset(used.are("point"))
    first, second = np.triu_indices(len(tips), 1)
    same = tips.points[first] == tips.points[second]
    poses = tips.base_from_flange
    relative = invert(poses[second[same]]) @ poses[first[same]]
    turns = np.asarray(Rotation.from_matrix(relative[:, :3, :3]).as_rotvec())
    turning, count = Turning.by(turns), len(tips)
    if turning.is_still:
        return (
            f"the {count} used touches are all from one orientation of the flange (largest "
            f"rotation between two of them: {figure(np.rad2deg(turning.largest_rad))} deg)"
        )
    return turning.words(poses, f"{count} used touches", "the flange")


_INVERSE = "the other way round, as flange_from_base"


@dataclass(frozen=True)
class PoseReading:
    """Alternative convention for the poses, under which the touches close."""

    words: str  # Its name: `with quaternions as w, x, y, z`.
    rms_m: float  # Root mean square distance of the touches with it [m].
    as_read_m: float  # The same as they were read [m].
    # Command options that read columns of the usual names so; empty where none are known.
    options: str = ""


def readings_that_close(touches: Touches) -> tuple[PoseReading, ...]:
    """Finds pose conventions under which the touches close, where as read they do not.

    Touches of one point close in both directions alike, with the tip and the point exchanged; of
    several points, in one only.

    Returns:
        The conventions under which they close to within 2 mm and twenty times better, best first.
    """
    tips = touches.subset(touches.are("point"))
    as_read_m, found = _linear_rms_m(tips, tips.base_from_flange), []
    orders = (
        ("", "", 0),
        ("with quaternions as w, x, y, z", "--robot-columns x_m,y_m,z_m,qy,qz,qw,qx ", -1),
        ("with quaternions as x, y, z, w", "", 1),
    )
    several = len(np.unique(tips.points)) > 1
    for order, columns, shift in orders:
        numbers = Rotation.from_matrix(tips.base_from_flange[:, :3, :3]).as_quat()
        rotations = Rotation.from_quat(np.roll(numbers, shift, axis=1)).as_matrix()
        poses = compose(rotations, tips.base_from_flange[:, :3, 3])
        if shift:
            rms_m = _linear_rms_m(tips, poses)
            found.append(PoseReading(order, rms_m, as_read_m, columns.strip()))
        if several:
            words = f"{order} and {_INVERSE}" if order else _INVERSE
            options = f"{columns}--robot-inverse" if columns or not order else ""
            found.append(PoseReading(words, _linear_rms_m(tips, invert(poses)), as_read_m, options))
    closing = [
        reading
        for reading in found
        if reading.rms_m < min(reading.as_read_m / _MUCH_BETTER, _CLOSED_M)
    ]
    return tuple(sorted(closing, key=lambda value: value.rms_m))


def _linear_rms_m(touches: Touches, poses: FloatArray) -> float:
    """Rms distance of the touches from their points [m], by the linear tip."""
    positions = poses[:, :3, :3] @ _linear_tip(poses, touches.points) + poses[:, :3, 3]
    groups: Sequence[FloatArray] = [
        positions[touches.points == value] for value in np.unique(touches.points)
    ]
    deviations = np.concatenate([group - group.mean(axis=0) for group in groups])
    return float(np.sqrt(np.sum(deviations**2) / len(touches)))
