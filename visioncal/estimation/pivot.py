"""Pivot calibration: a tool's tip and rotation from touches of fixed points.

The linear solution starts a joint fit of the tool and of the touched points, whitened by the
robot's stated noise, so that touches along the tool's axes propagate the tip's uncertainty into its
rotation. Outlier touches are left out (see `group_outliers`) and named.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure
from visioncal.core.quantiles import f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, fit_groups
from visioncal.estimation.linalg import covariance_from, spectrum
from visioncal.estimation.observability import SIGMA_LIMIT_M, Direction, Turning
from visioncal.estimation.placing import LEAST_NOISE_M, TOUCH_NOISE_M, counted_noise_m, worst_of
from visioncal.estimation.problem_parts import Noise
from visioncal.estimation.readings import readings_that_close
from visioncal.estimation.touching import Touches, TouchProblem, TouchUnknowns, in_tool

# Chance that an outlier touch fits another point.
_FALSE_ALARM = 1e-3
_NO_NOISE = Noise.of_robot(0.0, 0.0)

# Scaled eigenvalue ratio below which the touches do not determine a direction.
_NULL_RATIO = 1e-8
# Largest scatter of careful touches [m]: beyond, the motion alone is not at fault.
CARELESS_M = 1e-3
FEWEST_TOUCHES = 3
_ADVICE = (
    "Touch the same point 3 or more times with the flange tilted by 20 to 45 degrees about "
    "different axes, not only turned about one."
)


@dataclass(frozen=True, eq=False)
class PivotFit:
    """A tool from n touches of k points."""

    # The inlier touches, and their fit, in the tool's frame.
    agreement: GroupInliers[TouchUnknowns]
    oriented: bool  # Whether the rotation was measured; else it is the flange's own.
    # (6, 6) of the tool's right perturbation (rotation [rad], translation [m]); zero in the
    # rotation where that was not measured.
    covariance: FloatArray
    points_covariance: FloatArray  # (k, 3, 3) of the touched points [m^2].
    # (n,) the other point that an outlier touch fits; None for none.
    belongs_to: tuple[int | None, ...]
    # The least certain directions: the tip's, then the rotation's if measured.
    worst: tuple[Direction, ...]

    @property
    def flange_from_tool(self) -> FloatArray:
        """(4, 4) the tool [m]."""
        return self.agreement.fit.state.flange_from_tool

    @property
    def points(self) -> FloatArray:
        """(k, 3) the touched points in the base [m]."""
        return self.agreement.fit.state.points

    @property
    def sigma_m(self) -> float:
        """Noise of a touch per axis [m], beyond the robot's stated one."""
        return self.agreement.fit.sigma

    @property
    def looks_inverse(self) -> bool:
        """Whether the poses may be `flange_from_base`, which exchanges the tip and the one point.

        Touches of one point close either way; the poses look inverse where the tip is farther from
        the flange than the point is from the base.
        """
        reach = float(np.linalg.norm(self.flange_from_tool[:3, 3]))
        return len(self.points) == 1 and reach > float(np.linalg.norm(self.points[0]))


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
    check_counts(touches)
    with one_blas_thread():
        return _fitted(touches, noise, expected_sigma_m)


def _fitted(touches: Touches, noise: Noise, expected: float | None) -> PivotFit:
    tips = touches.are("point")
    problem = TouchProblem(touches.subset(tips), noise, oriented=False)
    inliers = find_inlier_groups(problem, expected)
    _check_doubt(problem, inliers)
    worst = check_turning(problem, inliers.fit)
    if not tips.all():
        # Touches of the axes alone determine the tool's rotation: a consensus of few would fit them
        # and nothing else, so they join the inliers of the tip.
        presumed = np.ones(len(touches), dtype=bool)
        presumed[tips] = inliers.mask
        problem = TouchProblem(touches, noise, oriented=True)
        inliers = find_inlier_groups(
            problem, expected, (presumed, problem.turned(inliers.fit.state))
        )
        _check_sides(touches, inliers)
        worst = check_turning(problem, inliers.fit)
    level = counted_noise_m(inliers.fit, TOUCH_NOISE_M if expected is None else expected)
    if level > inliers.fit.sigma:
        covariance = covariance_from(inliers.fit.groups.subset(inliers.fit.used).information(level))
        inliers = replace(inliers, fit=replace(inliers.fit, sigma=level, covariance=covariance))
        worst = check_turning(problem, inliers.fit)
    fit, edge, count = inliers.fit, 6 if problem.oriented else 3, len(inliers.fit.state.points)
    blocks = fit.covariance[edge:, edge:].reshape(count, 3, count, 3)
    at = np.arange(count)
    return PivotFit(
        inliers,
        problem.oriented,
        _edge_covariance(problem, fit.covariance),
        blocks[at, :, at, :],
        _belonging(problem, inliers),
        worst,
    )


def _check_doubt(problem: TouchProblem, inliers: GroupInliers[TouchUnknowns]) -> None:
    """Refuses touches that contradict each other grossly without an identifiable outlier."""
    if not inliers.doubtful.any() or inliers.fit.sigma < CARELESS_M:
        return
    touches, rows = problem.touches, np.flatnonzero(inliers.doubtful)
    labels = [touches.labels[row] for row in rows]
    belongs = _belonging(problem, inliers)
    fitting = [
        f"touch {touches.labels[index]} fits point {touches.names[at]!r}"
        for index, at in enumerate(belongs)
        if inliers.doubtful[index] and at is not None
    ]
    matches = f" ({', '.join(fitting)})" if fitting else ""
    raise DataError(
        f"tcp: touches {', '.join(labels)} contradict each other, at a scatter of "
        f"{1e3 * inliers.fit.sigma:.3g} mm, and which of them is wrong is not known{matches}.",
        culprits=labels,
        next_step="Touch their point once or twice more, or correct its name.",
    )


def _check_sides(touches: Touches, inliers: GroupInliers[TouchUnknowns]) -> None:
    local = in_tool(touches, inliers.fit.state)
    for kind, coordinates in (("z", local[:, 2]), ("xz", local[:, 0])):
        used = inliers.mask & np.array([name == kind for name in touches.kinds])
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


def _belonging(
    problem: TouchProblem, inliers: GroupInliers[TouchUnknowns]
) -> tuple[int | None, ...]:
    """The other point that each outlier touch fits, by the touches beyond doubt."""
    suspects = ~inliers.mask | inliers.doubtful
    fit = inliers.fit
    if inliers.doubtful.any():
        fit = fit_groups(problem, ~suspects, fit.state)
    belongs: list[int | None] = [None] * len(suspects)
    for row in np.flatnonzero(suspects):
        ratios = [
            _mahalanobis_sq_at(problem, fit, int(row), index)
            for index in range(len(fit.state.points))
        ]
        ratios[problem.touches.points[row]] = np.inf
        best = int(np.argmin(ratios))
        if ratios[best] < 1.0:
            belongs[row] = best
    return tuple(belongs)


def _mahalanobis_sq_at(
    problem: TouchProblem, fit: GroupFit[TouchUnknowns], row: int, point: int
) -> float:
    """Squared distance of a touch from the prediction if it were of a point, over its limit."""
    if not np.any(fit.used & (problem.touches.points == point)):
        return float("inf")
    points = problem.touches.points.copy()
    points[row] = point
    touched = replace(problem, touches=replace(problem.touches, points=points))
    groups = touched.linearise(fit.state)
    rows = groups.observed[row]
    residual, slope = groups.residuals[row][rows], groups.jacobian[row][rows]
    covariance = (
        groups.covariance(fit.sigma)[row][np.ix_(rows, rows)] + slope @ fit.covariance @ slope.T
    )
    limit = f_limit(_FALSE_ALARM, len(residual), max(fit.freedom, 1))
    return float(residual @ np.linalg.solve(covariance, residual) / (len(residual) * limit))


def check_counts(touches: Touches) -> None:
    """Refuses too few touches, and touches of an axis whose point or partner is missing.

    Raises:
        DataError: Naming what to add.
    """
    tips = touches.points[touches.are("point")]
    counts = np.bincount(tips, minlength=len(touches.names))
    if np.maximum(counts - 1, 0).sum() < FEWEST_TOUCHES - 1:
        counted = ", ".join(
            f"{n} of {name or 'one point'}" for name, n in zip(touches.names, counts, strict=True)
        )
        raise DataError(
            f"tcp: {len(tips)} touches of kind point ({counted}): at least {FEWEST_TOUCHES} of one "
            "point, or 2 each of two points, are needed.",
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


def check_turning(problem: TouchProblem, fit: GroupFit[TouchUnknowns]) -> tuple[Direction, ...]:
    """Refuses touches that leave a direction undetermined; otherwise returns the worst ones.

    Wild disagreement of touches is no fault of the motion: it is judged by a noise of at most the
    limit, and the rest is left to the verdict.

    Returns:
        The least certain direction of the tip, and of the tool's rotation where that is estimated.

    Raises:
        DegenerateError: A direction is numerically null, or its predicted sigma is over the limit.
    """
    level = min(max(fit.sigma, LEAST_NOISE_M), SIGMA_LIMIT_M)
    worst = _worst(problem, fit, level)
    null = spectrum(fit.groups.subset(fit.used).information(level)).ratio < _NULL_RATIO
    beyond = [direction for direction in worst if direction.sigma > direction.limit]
    if not beyond and not null:
        return _worst(problem, fit, max(fit.sigma, LEAST_NOISE_M))
    culprit = beyond[0] if beyond else max(worst, key=lambda value: value.sigma / value.limit)
    cause, next_step = _cause(problem, fit, culprit)
    fault = "is not determined at all" if null else f"has a predicted sigma of {culprit.figure}"
    raise DegenerateError(
        f"tcp: {culprit.words} {fault}: {cause}.",
        culprits=[direction.words for direction in beyond] or [culprit.words],
        next_step=next_step,
    )


def _worst(
    problem: TouchProblem, fit: GroupFit[TouchUnknowns], level: float
) -> tuple[Direction, ...]:
    edge = _edge_covariance(
        problem, covariance_from(fit.groups.subset(fit.used).information(level))
    )
    offset, rotation = worst_of(fit.state.flange_from_tool, edge, "tool", "flange", origin="tip")
    return (offset, rotation) if problem.oriented else (offset,)


def _edge_covariance(problem: TouchProblem, covariance: FloatArray) -> FloatArray:
    """(6, 6) of the tool's right perturbation; zero in a rotation that is not estimated."""
    edge, size = np.zeros((6, 6)), 6 if problem.oriented else 3
    edge[6 - size :, 6 - size :] = covariance[:size, :size]
    return edge


def _cause(
    problem: TouchProblem, fit: GroupFit[TouchUnknowns], culprit: Direction
) -> tuple[str, str]:
    """Cause of an undetermined direction, and advice."""
    used = problem.touches.subset(fit.used)
    careful = [
        direction
        for direction in _worst(problem, fit, CARELESS_M)
        if direction.words == culprit.words
    ]
    if fit.sigma > CARELESS_M and all(direction.sigma < direction.limit for direction in careful):
        readings = readings_that_close(problem.touches)
        cause = f"the touches scatter by {1e3 * fit.sigma:.3g} mm"
        if readings:
            return cause, (
                f"Read the poses {readings[0].words}: then they close to "
                f"{figure(1e3 * readings[0].rms_m)} mm."
            )
        return cause, "Look for poses of another tool or in other units, and touch again."
    if culprit.is_rotation:
        # Levers of the touches of the axes.
        local = np.abs(in_tool(used, fit.state))
        along = 1e3 * local[used.are("z"), 2].max()
        aside = 1e3 * local[used.are("xz"), 0].max()
        return (
            f"the touches of kind z have their point at most {figure(along)} mm from the tip, and "
            f"those of kind xz at most {figure(aside)} mm beside the tool's z axis"
        ), "Move the tool back by 50 mm or more along its axes before touching for z and xz."
    return _motion(used), _ADVICE


def _motion(used: Touches) -> str:
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
