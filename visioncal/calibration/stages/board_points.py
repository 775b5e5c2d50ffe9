"""Printed boards whose corners are elsewhere in all views: a row glued back, a warped print, glare.

The same corners are then off alike in every view, which noise is not. Each corner's mean residual
over all views is tested beside poses, lens, shape of the board and a smooth field of the image, by
the scatter from view to view: errors of a view that many of its corners share count once. Corners
that scatter by more than the others are left out before.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.special import chdtrc

from visioncal.calibration.stages.cameras import estimate_lenses, locate_targets
from visioncal.calibration.stages.observed import Observed
from visioncal.core.number_format import figure, ranges
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Target, evenly
from visioncal.core.verdict import Finding, Remedy
from visioncal.fit.lens_field import orders_of_waves, waves
from visioncal.vision.board_shape import SCALE, board_basis
from visioncal.vision.corners import (
    CornerStack,
    Reprojection,
    WithoutPoses,
    mean_square_by_view,
    reproject,
)
from visioncal.vision.lens_field import row_motions, zooms
from visioncal.vision.poses import fit_poses
from visioncal.vision.targets import corner_positions, first_numbers

T = TypeVar("T", bound=Observed)
# Fewest views of which the scatter of a mean is known.
_FEWEST = 8
# Combinations of what is smooth that corners show by less than this share of the most are none.
_SHOWN = 1e-5


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Errors of the places of a board's corners."""

    sigma_m: float  # Their standard deviation along each axis.
    p_value: float  # Of a board without any.
    # Numbers of corners that scatter by more than the others, as where glare lies on them.
    unsteady: IntArray
    unsteady_px: float  # By how much (rms, along each axis); zero of none.
    noise_px: float  # Of the other corners.


def with_board_points(seen: T) -> T:
    """Gives corners that are elsewhere on their boards a size, in `Target.point_sigmas_m`."""
    errors = [*_errors(seen)]
    if any(len(found.unsteady) for *_, found in errors):
        seen = _without_unsteady(seen, errors)
        errors = [*_errors(seen)]
    session, loose = seen.session, dict[str, Target]()
    for name, _, _, found in errors:
        if found.p_value <= FALSE_ALARM:
            target = loose.get(name, session.boards[name])
            sigma_m = max(found.sigma_m, *target.point_sigmas_m[:1], 0.0)
            count = len(corner_positions(target))
            loose[name] = replace(target, point_sigmas_m=(sigma_m,) * count)
    if not loose:
        return seen
    if not session.targets:
        return replace(seen, session=replace(session, target=loose[""]))
    return replace(seen, session=replace(session, targets={**session.targets, **loose}))


def _errors(seen: Observed) -> Iterator[tuple[str, str, int, PointErrors]]:
    """Errors of printed boards by each camera: board, camera, the board's first corner, errors."""
    boards = seen.session.boards
    for index, (name, start) in enumerate(first_numbers(boards).items()):
        target = boards[name]
        for frame, look in seen.cameras.items():
            views = {
                view: replace(corners, ids=corners.ids - start)
                for view, corners in look.corners.items()
                if view in seen.poses
                and view not in seen.held_back
                and seen.poses[view].board == index
                and len(set(seen.poses[view].turns)) == 1
            }
            if look.lens is not None and views and not target.is_rig:
                poses = {view: seen.poses[view].cam_from_target[0] for view in views}
                found = point_errors(target, look.lens.camera, views, poses)
                if found is not None:
                    yield name, frame, start, found


def _without_unsteady(seen: T, errors: Iterable[tuple[str, str, int, PointErrors]]) -> T:
    """Leaves out corners that scatter by more than others in one camera's images, with a note."""
    lost = dict[str, list[IntArray]]()
    for name, frame, start, found in errors:
        if not len(found.unsteady):
            continue
        lost.setdefault(frame, []).append(found.unsteady + start)
        numbers = ranges(found.unsteady.tolist())
        words = (
            f"Corners {numbers} of the {f'board {name}'.strip()} are off by "
            f"{figure(found.unsteady_px)} px (rms) from view to view, and others are not, as where "
            "glare, dirt or an edge lies on them. They were left out."
        )
        do = "Look at these corners in the images: see to even light, and clean the board."
        seen = seen.noting((), (Finding("unsteady_corners", words, Remedy(do)),))
    for frame, numbers_of in lost.items():
        look, ids = seen.cameras[frame], np.concatenate(numbers_of)
        kept = {
            view: corners.take(~np.isin(corners.ids, ids)) for view, corners in look.corners.items()
        }
        seen = seen.with_camera(frame, replace(look, corners=kept))
    return locate_targets(estimate_lenses(seen))


def point_errors(
    target: Target,
    camera: Camera,
    corners: Mapping[int, Corners],
    cam_from_target: Mapping[int, FloatArray],
) -> PointErrors | None:
    """The errors of a board's corners that its images show alike; None where there are too few.

    The sum of squares of the estimated errors in units of their noise is compared with what the
    views' own pulls scatter by (Satterthwaite 1946).

    Args:
        target: The printed board.
        camera: The lens.
        corners: Those of each view.
        cam_from_target: (4, 4) pose of each view, near which it is linearised.
    """
    found = _point_errors(target, camera, corners, cam_from_target, is_moving=False)
    if found is None:
        return None
    rest = {view: at.take(~np.isin(at.ids, found.unsteady)) for view, at in corners.items()}
    moving = _point_errors(target, camera, rest, cam_from_target, is_moving=True)
    # Noise beside what moves in single views, over that without, above which nothing does.
    if moving is None or moving.noise_px > 0.9 * found.noise_px:
        return found
    # Focus, a rolling shutter or a wrong lens: these move the outer corners of a board most.
    moving = _point_errors(target, camera, corners, cam_from_target, is_moving=True)
    return moving and replace(moving, unsteady=found.unsteady[:0], unsteady_px=0.0)


def _point_errors(
    target: Target,
    camera: Camera,
    corners: Mapping[int, Corners],
    cam_from_target: Mapping[int, FloatArray],
    *,
    is_moving: bool,
) -> PointErrors | None:
    """`point_errors`; beside zoom and motion of the rows of each view where `is_moving`."""
    positions = corner_positions(target)
    chosen = [view for view in corners if len(corners[view].ids) * 2 > len(positions)]
    # Most views that are needed.
    chosen = [chosen[at] for at in evenly(len(chosen), 60).tolist()]
    # Two unknowns a corner: larger boards are taken to be true.
    if len(chosen) < _FEWEST or len(positions) > 150:
        return None
    stack = CornerStack.of({view: corners[view] for view in chosen}, positions)
    stack = replace(stack, weights=None)
    poses = fit_poses(stack, camera, np.array([cam_from_target[v] for v in chosen]))
    squares = mean_square_by_view(stack, poses.residuals)
    # Views whose residuals are larger than the typical ones by this ratio are wrong.
    right = squares <= 5.0**2 * np.median(squares)
    if right.sum() < _FEWEST:
        return None
    stack, starts = stack.keep(right[stack.view_of]), poses.cam_from_target[right]
    views, count = len(stack.views), 2 * len(positions)
    basis, weights = board_basis(positions), np.ones(len(positions))
    at = reproject(stack, camera, starts)
    # Of a radian, they are as good as free.
    each_view = (zooms(at.px, camera), row_motions(at.px, camera))
    by_view = np.concatenate(each_view, axis=2)[:, :, : None if is_moving else 0]
    columns, smooth = _columns(stack, camera, at, basis, count)
    # Wrong corners hide each other, since poses and lens follow them: each counts by what it
    # scatters beside the others, in at most so many rounds.
    for _ in range(12):
        stack = replace(stack, weights=weights[stack.ids], zooms=by_view)
        by_places, pulls, unknowns = _reduced(stack, columns, smooth)
        flat = by_places.reshape(-1, count)
        inner = flat.T @ flat
        values, vectors = np.linalg.eigh(inner)
        # Directions that poses, lens and shape leave open, by the information left: of corners that
        # stay where they are in the image, the smooth field takes most.
        is_open = values > 1e-4 * values[-1]
        values, vectors = values[is_open], vectors[:, is_open]
        rows = by_places @ (vectors / np.sqrt(values))
        found = np.einsum("nai,na->i", rows, pulls)
        left = pulls - rows @ found
        ratios, scatter = _scatter(stack, left / stack.given_weights[:, None], len(positions))
        if ratios.max() < chi2_limit(0.1 / len(ratios), 2 * views) / (2 * views):
            break
        before, weights = weights, 1.0 / np.sqrt(np.maximum(ratios, 1.0))
        # Weights have converged at a hundredth of the noise of corners.
        if np.abs(weights - before).max() < 0.01:
            break
    # Chance by which a sound board has a corner that scatters too much.
    limit = chi2_limit(1e-6 / len(ratios), 2 * views) / (2 * views)
    # Less does no harm [px].
    wrong = np.flatnonzero((ratios > limit) & (scatter > 0.1))
    if len(wrong):
        rest = {view: at.take(~np.isin(at.ids, wrong)) for view, at in corners.items()}
        others = _point_errors(target, camera, rest, cam_from_target, is_moving=is_moving)
        if others is None:
            return None
        unsteady = np.union1d(others.unsteady, wrong)
        most = max(others.unsteady_px, float(np.sqrt(np.mean(scatter[wrong] ** 2))))
        if len(unsteady) <= len(positions) / 3:
            # Of few views they are not named, but say nothing of the board either. Fewest views in
            # which a corner scatters: of fewer, poses and lens take so much of the others' noise
            # that one which they follow no more looks as if it had twice theirs.
            named = views >= 12
            unsteady, most = (unsteady, most) if named else (unsteady[:0], 0.0)
            return replace(others, unsteady=unsteady, unsteady_px=most)
    each = stack.sum_by_view(np.einsum("nai,na->ni", rows, left))
    products = each @ each.T
    freedom = left.size - (6 + by_view.shape[2]) * views - unknowns - len(values)
    if freedom < left.size / 3:
        return None
    share = left.size / freedom
    mean = share * float(np.trace(products))
    spread = share**2 * float(np.sum(products**2) - np.sum(np.diag(products) ** 2))
    spread = max(spread * views / (views - 1), mean**2 / len(values))
    scale = spread / mean
    p_value = float(chdtrc(mean / scale, found @ found / scale))
    noise = mean / len(values)
    # Each direction counts by its information, so that one that hardly shows adds no noise.
    square = float(values @ (found**2 - noise) / (values @ values))
    sigma_m = float(np.sqrt(max(square, 0.0)))
    none = np.zeros(0, dtype=np.int64)
    return PointErrors(sigma_m, p_value if square > 0.0 else 1.0, none, 0.0, noise**0.5)


def _scatter(stack: CornerStack, left: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Scatter of each of `count` corners by (n, 2) residuals.

    Returns:
        Mean squares in units of each view's typical one, over the median of these; and the rms
        along each axis [px].
    """
    squares = np.sum(left**2, axis=1)
    typical = np.array(
        [np.median(squares[stack.view_of == view]) for view in range(len(stack.views))]
    )
    counts = np.maximum(np.bincount(stack.ids, minlength=count), 1)
    relative = squares / np.maximum(typical, np.finfo(float).tiny)[stack.view_of]
    ratios = np.bincount(stack.ids, relative, count) / counts
    rms = np.sqrt(np.bincount(stack.ids, squares, count) / counts / 2.0)
    return ratios / np.median(ratios[ratios > 0.0]), rms


def _columns(
    stack: CornerStack, camera: Camera, at: Reprojection, basis: FloatArray, count: int
) -> tuple[FloatArray, int]:
    """Derivatives (n, 2, 6 + s + count) by poses, what is smooth and places, then residuals; s."""
    orders = orders_of_waves()
    # Half waves of the image's field: a finer one would be that of single corners.
    orders = orders[np.sum(orders**2, axis=1) <= 6.0**2]
    # Where corners are predicted: at those seen, the field could explain their noise.
    field = waves(at.px, float(camera.resolution[0]), orders)
    none = np.zeros_like(field)
    by_field = np.stack([np.hstack([field, none]), np.hstack([none, field])], axis=1)
    by_shape = at.by_point @ np.delete(basis, SCALE, axis=2)[stack.ids]
    by_places = np.zeros((len(stack.px), 2, count))
    each = np.arange(len(stack.px))
    for axis in (0, 1):
        by_places[each, :, 2 * stack.ids + axis] = at.by_point[:, :, axis]
    smooth = np.concatenate([at.by_intrinsics, by_shape, by_field], axis=2)
    # Residuals are predicted less detected ones.
    columns = [at.by_pose, smooth, by_places, -at.residuals[:, :, None]]
    return np.concatenate(columns, axis=2), smooth.shape[2]


def _reduced(
    stack: CornerStack, columns: FloatArray, smooth: int
) -> tuple[FloatArray, FloatArray, int]:
    """Derivatives (n, 2, c) by corners' places, and residuals, beside all that is smooth.

    Returns:
        Derivatives and residuals, and the number of eliminated unknowns beside the poses.
    """
    columns = columns.copy()
    stack.weigh(columns)
    left = WithoutPoses.of(stack, columns[:, :, :6], columns[:, :, 6:], None).left
    others, by_places = np.split(left.reshape(2 * len(stack.px), -1), [smooth], axis=1)
    scale = np.linalg.norm(others, axis=0)
    others = others / np.where(scale > 0.0, scale, 1.0)
    squares, vectors = np.linalg.eigh(others.T @ others)
    is_shown = squares > _SHOWN**2 * squares[-1]
    root = others @ (vectors[:, is_shown] / np.sqrt(squares[is_shown]))
    by_places = (by_places - root @ (root.T @ by_places)).reshape(len(stack.px), 2, -1)
    return by_places[:, :, :-1], by_places[:, :, -1], root.shape[1]
