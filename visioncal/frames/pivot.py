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

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.directions import SIGMA_LIMIT_M, Direction, Turning
from visioncal.core.errors import DataError
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import figure
from visioncal.core.robust import small_sets
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply, apply_each, compose, invert, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.estimation.points import FEWEST_POINTS, GroupFit, Placement, PointProblem, fit_groups
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.group_outliers import GroupInliers, find_inlier_groups
from visioncal.frames.placing import (
    LEAST_NOISE_M,
    TOUCH_NOISE_M,
    check_sides,
    counted_noise_m,
    refuse_exchanged_kinds,
    refuse_poor,
    worst_of,
)

TouchKind: TypeAlias = Literal["point", "z", "xz"]
# The coordinates that are zero, by kind.
_ZERO = {"point": (True, True, True), "z": (True, True, False), "xz": (False, True, False)}
_NO_NOISE = Noise.of_robot(0.0, 0.0)
_ADVICE = (
    "Touch the same point 3 or more times with the flange tilted by 20 to 45 degrees about "
    "different axes, not only turned about one."
)


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
        return chosen_rows(self, chosen, "names")


@dataclass(frozen=True, eq=False)
class PivotFit:
    """A tool from n touches of k points."""

    # The inlier touches, and their fit, in the tool's frame.
    agreement: GroupInliers
    oriented: bool  # Whether the rotation was measured; else it is the flange's own.
    # (6, 6) of the tool's right perturbation (rotation [rad], translation [m]); zero in the
    # rotation where that was not measured.
    covariance: FloatArray
    points_covariance: FloatArray  # (k, 3, 3) of the touched points [m^2].
    worst: tuple[Direction, ...]  # The least certain directions: the tip's, and the rotation's.

    @property
    def flange_from_tool(self) -> FloatArray:
        """(4, 4) the tool [m]."""
        return self.agreement.fit.state.frame

    @property
    def looks_inverse(self) -> bool:
        """Whether the poses may be `flange_from_base`; see `looks_inverse`."""
        return looks_inverse(self.agreement.fit.state)


def looks_inverse(state: Placement) -> bool:
    """Whether poses may be `flange_from_base`, which exchanges the tip and the one point.

    Touches of one point close either way; the poses look inverse where the tip is farther from the
    flange than the point is from the base.
    """
    tip_m, point_m = np.linalg.norm([state.frame[:3, 3], state.points[0]], axis=1)
    return bool(len(state.points) == 1 and tip_m > point_m)


def tip_start(touches: Touches) -> Placement:
    """The tip and its points by all touches of kind `point`, by linear least squares."""
    return _start(touches, np.flatnonzero(touches.are("point")), oriented=False)


def tool_problem(touches: Touches, noise: Noise = _NO_NOISE, *, oriented: bool) -> PointProblem:
    """The problem of a tool; `noise` is of the flange's poses."""
    turn_rad, shift_m = noise.robots[0]
    tips, count = np.flatnonzero(touches.are("point")), len(touches)

    def starts() -> Iterator[Placement]:
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


def scatter_m(touches: Touches) -> float:
    """Root mean square distance of the tips from their points, by all touches of kind `point`."""
    of_tips = touches.subset(touches.are("point"))
    tips, points = tips_and_points(of_tips)
    return float(np.sqrt(np.mean(np.sum((tips - points[of_tips.points]) ** 2, axis=1))))


def tips_and_points(
    touches: Touches, rows: IntArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """(n, 3) tips in the base, by some touches, and (k, 3) means of them by their points [m]."""
    chosen = np.arange(len(touches)) if rows is None else rows
    tip = _start(touches, chosen, oriented=False).frame[None, :3, 3]
    tips = apply(touches.base_from_flange, tip)[:, 0]
    means = [tips[touches.points == at].mean(axis=0) for at in range(len(touches.names))]
    return tips, np.array(means)


def two_points(touches: Touches) -> Touches | None:
    """Touches of one point with the tip as of two, where they agree best; None of too few.

    Three touches of one point determine a tip, whose places by all touches lie at two points.
    """
    # Five of two points would leave the choice of two touches among five few redundant coordinates.
    if len(touches) < 6 or len(touches.names) > 1:
        return None
    splits = list[Touches]()
    for rows in small_sets(len(touches), FEWEST_POINTS):
        tips = tips_and_points(touches, rows)[0]
        off_m = np.linalg.norm(tips - tips[rows].mean(axis=0), axis=1)
        points = (off_m > 0.5 * off_m.max()).astype(np.int64)
        if np.bincount(points).min() > 1:
            splits.append(replace(touches, points=points, names=("", "")))
    return min(splits, key=scatter_m, default=None)


def _start(touches: Touches, rows: IntArray, *, oriented: bool) -> Placement:
    """Start with the tip by some touches of kind `point`."""
    poses, are_tips = touches.base_from_flange, touches.are("point")
    # Linear least squares of `R_i tip - point = -t_i`, of minimum norm where that is undetermined.
    names, index = np.unique(touches.points[rows], return_inverse=True)
    by_points = -np.kron(np.eye(len(names))[index], np.eye(3))
    system = np.hstack([poses[rows, :3, :3].reshape(-1, 3), by_points])
    tip = np.asarray(np.linalg.lstsq(system, -poses[rows, :3, 3].ravel(), rcond=None)[0][:3])
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
        DataError: Touches are missing, or lie on both sides of the tip.
        DegenerateError: Touches leave a direction undetermined; named with its predicted sigma.
    """
    _check_counts(touches)
    tips = touches.are("point")
    with one_blas_thread():
        problem = tool_problem(touches.subset(tips), noise, oriented=False)
        inliers = find_inlier_groups(problem, expected_sigma_m)
        if not tips.all():
            # Touches of the axes alone determine the tool's rotation: a consensus of few would fit
            # them and nothing else, so they join the inliers of the tip.
            presumed = np.ones(len(touches), dtype=bool)
            presumed[tips] = inliers.mask
            problem = tool_problem(touches, noise, oriented=True)
            start = (presumed, _turned(touches, inliers.fit.state))
            inliers = find_inlier_groups(problem, expected_sigma_m, start)

            def refitted(kinds: tuple[TouchKind, ...]) -> GroupFit | None:
                of_kinds = replace(touches, kinds=kinds)
                with suppress(DataError):
                    _check_counts(of_kinds)
                    return fit_groups(tool_problem(of_kinds, noise, oriented=True))
                return None

            refuse_exchanged_kinds("tcp", touches.labels, touches.kinds, refitted)
        fit, edge = inliers.fit, 6 if problem.oriented else 3

        def edge_covariance(covariance: FloatArray) -> FloatArray:
            return np.pad(covariance[:edge, :edge], (6 - edge, 0))

        def worst(covariance: FloatArray) -> tuple[Direction, ...]:
            of_tool = edge_covariance(covariance)
            directions = worst_of(fit.state.frame, of_tool, "tool", "flange", origin="tip")
            return directions if problem.oriented else directions[:1]

        refuse_poor("tcp", fit, worst, partial(_cause, touches, fit))
        local = problem.local(fit.state)
        along = {"z": local[:, 2], "xz": local[:, 0]}
        check_sides("tcp", touches.labels, touches.kinds, inliers.mask, along)
        expected_m = TOUCH_NOISE_M if expected_sigma_m is None else expected_sigma_m
        level = counted_noise_m(fit, expected_m)
        covariance = covariance_from(fit.groups.subset(fit.used).information(level))
        inliers = replace(inliers, fit=replace(fit, sigma=level, covariance=covariance))
        count = len(fit.state.points)
        blocks, at = covariance[edge:, edge:].reshape(count, 3, count, 3), np.arange(count)
        return PivotFit(
            inliers,
            problem.oriented,
            edge_covariance(covariance),
            blocks[at, :, at, :],
            worst(covariance),
        )


def _check_counts(touches: Touches) -> None:
    """Refuses too few touches, and touches of an axis whose point or partner is missing."""
    tips = touches.points[touches.are("point")]
    counts = np.bincount(tips, minlength=len(touches.names))
    if np.maximum(counts - 1, 0).sum() < FEWEST_POINTS - 1:
        counted = ", ".join(
            f"{n} of {name or 'one point'}" for name, n in zip(touches.names, counts, strict=True)
        )
        raise DataError(
            f"tcp: {len(tips)} touches of kind point ({counted}), but it takes at least "
            f"{FEWEST_POINTS} of one point, or 2 each of two points.",
            culprits=[name for name in touches.names if name] or touches.labels,
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


def _cause(touches: Touches, fit: GroupFit, culprit: Direction) -> tuple[str, str]:
    """Why touches leave a direction undetermined, in words, and what to do."""
    if culprit.is_rotation and fit.sigma > SIGMA_LIMIT_M:
        return (
            f"the touches disagree by {figure(1e3 * fit.sigma)} mm per axis, as where poses are "
            "misread, or of another tool or moment in some rows, or several points were touched",
            "State the form of the poses (--robot-form, --robot-inverse), take all with the "
            "controller's tool at zero, and name the points in a column point.",
        )
    if culprit.is_rotation:
        return (
            "the touches of kind z or xz have their points too near to the tip",
            "Move the tool back by 50 mm or more along its axes before touching for z and xz.",
        )
    tips = touches.subset(fit.used & touches.are("point"))
    poses = tips.base_from_flange
    # Only touches of one point determine the tip.
    first, second = np.nonzero(np.triu(tips.points[:, None] == tips.points, 1))
    turns = (invert(poses[second]) @ poses[first])[:, :3, :3]
    turning = Turning.by(Rotation.from_matrix(turns).as_rotvec()) if len(turns) else None
    words = (turning or Turning.of(poses)).words(poses, f"{len(tips)} used touches", "the flange")
    return f"{words}, at a scatter of {figure(1e3 * fit.sigma)} mm", _ADVICE
