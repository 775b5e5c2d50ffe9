"""Whether a camera's depth is true: its distances against the board's plane by its own images.

Distances of the board's white in small cells are compared with the plane of the board's pose by the
view's own corners, in which there is no noise of the robot. By generalised least squares the
deviations give the model of `DepthResult`; the noise of a view's corners and the errors of lens and
board have their covariance, and the offset and tilt of each view by the sensor are random effects,
whose variances are estimated by REML (Patterson and Thompson 1971). Only what a calibration says of
itself is used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares, nnls

from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import counted, figure, view_words
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import adjoint, apply, invert
from visioncal.core.types import Camera, Corners, FloatArray, Image, Mask, chosen_rows
from visioncal.core.verdict import DEPTH_CHANGED, NOTE, Finding, Remedy
from visioncal.estimation.appearance import shape_basis
from visioncal.estimation.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.estimation.lens_field import depths_m, zooms
from visioncal.fit.mixed import Estimate, Mixed, Term, prior_term
from visioncal.fit.sizes import most_likely
from visioncal.results import Calibration, CameraResult
from visioncal.results.depth import DepthCamera, DepthResult, bending
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, View
from visioncal.session.depth import read_depth
from visioncal.session.selecting import Choice
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.camera import normalise, project
from visioncal.vision.targets import corner_positions

# Cells along the board's longer side in the image, and the fewest pixels of one.
_CELLS, _LEAST = 12, 12
# Fewest cells of a view.
_FEWEST = 6
# Pixels of a view that are looked at: more make the median of a cell no better than its view.
_PIXELS = 60_000
# Deviation from the median, in its robust standard deviations, from which a cell is of something
# else, and the greatest curvature of depth over a board, as a share of its distance.
_GATE, _BENT = 4.0, 0.008
# Robust standard deviation of a median absolute deviation.
_MAD = 1.4826
# Of a pose's right perturbation, what moves its plane: turns about x and y, and z.
_OF_PLANE = [0, 1, 5]


def distances(pose: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) depth of a frame's plane z = 0 along (n, 3) rays of unit depth, and by `_OF_PLANE`."""
    normal, origin = pose[:3, 2], pose[:3, 3]
    along = rays @ normal
    depth = normal @ origin / along
    x, y = ((depth[:, None] * rays - origin) @ pose[:3, :2]).T
    return depth, np.stack([y, -x, np.ones_like(x)], axis=1) / along[:, None]


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of depth on the board at one view."""

    view: int
    px: FloatArray  # (n, 2) their middles [px].
    true_m: FloatArray  # (n,) predicted distances [m].
    excess_m: FloatArray  # (n,) medians of measured minus predicted distances [m].
    noise_m: FloatArray  # (n,) robust standard deviation of the pixels [m].
    inks_m: FloatArray  # (n,) how much deeper black is read, NaN where unknown [m].
    by_px: FloatArray  # (n, 2) derivatives of the predicted distances by the pixels [m/px].
    by_corners: FloatArray  # (n, 3) the same by independent errors of the view's own corners [m].
    by_common: FloatArray  # (n, q) the same by independent errors that all views share [m].


@dataclass(frozen=True, eq=False)
class Sensor:
    """The board and lens with which the depth of one camera is compared."""

    calibration: Calibration  # Of one camera and board.
    camera: CameraResult  # Its camera.
    session: Session
    corners_m: FloatArray  # (c, 3) corners of its board [m].
    shape: FloatArray  # (c, 3, s) their derivatives by its shape.
    unit_m: float | None  # The unit of depth pictures, where stated [m].
    is_ray: bool  # Whether distances are along the ray.
    by: DepthCamera | None = None  # The camera that measures depth, where it is another one.

    @classmethod
    def of(cls, pair: Calibration, session: Session, camera: str, board: str) -> "Sensor":
        """The depth beside a camera's images of a board; raises DataError."""
        own, target, lens = session.declaration.depth, session.boards[board], pair.camera
        if lens is None or np.ptp(corner_positions(target)[:, 2]) > 0.0:
            raise DataError("it needs a camera and a flat board.")
        table = session.cameras[camera] if own is None else own
        corners = corner_positions(target) if pair.board is None else pair.board.corners(target)
        seen, shape = (pair, lens, session), (corners, shape_basis(target))
        sensor = cls(*seen, *shape, table.depth_unit_m, table.depth_of == "ray")
        if own is None or own.stated is None:
            return sensor
        prior = session.declaration.prior["cam_from_depth"]
        pose = np.eye(4) if prior.pose is None else prior.pose
        sigmas = (prior.sigma_rad or 0.0, prior.sigma_m or 0.0)
        return replace(
            sensor, by=DepthCamera(**vars(own.stated), cam_from_depth=pose, sigmas=sigmas)
        )

    @property
    def lens(self) -> Camera:
        """The lens of the depth pictures."""
        return self.camera.camera if self.by is None else self.by.camera

    @cached_property
    def root(self) -> FloatArray:
        """(c, q) root of the covariance of edges, lens, field, board's shape and place."""
        known = self.camera.covariance_with(self.calibration.joint_covariance[:12, :12])
        count, lens = len(known), 4 + len(self.camera.camera.distortion)
        shape = np.zeros(self.shape.shape[2])
        place = np.repeat((0.0, 0.0) if self.by is None else self.by.sigmas, 3)
        covariance = block_diag(known, np.diag(shape), np.diag(place**2))
        if (fit := self.calibration.joint_fit) is not None:
            looks = np.array(fit.looks, dtype=np.int64)
            fitted = np.append(np.arange(12), looks + np.where(looks < lens, 12, count - lens))
            covariance[np.ix_(fitted, fitted)] = fit.covariance[: len(fitted), : len(fitted)]
            # Field and shape are correlated through the rest.
            rest, board = fitted[fitted < count], fitted[fitted >= count]
            inverse = np.linalg.pinv(known[np.ix_(rest, rest)], hermitian=True)
            cross = known[12 + lens :, rest] @ inverse @ covariance[np.ix_(rest, board)]
            covariance[12 + lens : count, board] = cross
            covariance[board, 12 + lens : count] = cross.T
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        kept = values > 1e-12
        return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))

    def rays(self, px: FloatArray) -> FloatArray:
        """(n, 3) rays of unit depth of pixels of the depth picture."""
        in_model = self.camera.in_model(px) if self.by is None else px
        return np.column_stack([normalise(self.lens, in_model), np.ones(len(px))])

    def cells(self, view: View, seen: ViewEvidence | None) -> Cells:
        """The cells of a view that are of the board; raises DataError where there are too few."""
        images, size = self.session.images, self.lens.resolution
        if why := images.absence(view.depth):
            raise DataError(f"{view.depth} {why}.")
        if seen is None or seen.corners is None or seen.cam_from_target is None:
            raise DataError("the board was not found in the image.")
        depth = read_depth(images.read(view.depth), view.depth, size, self.unit_m)
        beside = np.eye(4) if self.by is None else self.by.cam_from_depth
        pose = invert(beside) @ seen.cam_from_target
        corners = project(self.lens, apply(pose, self.corners_m))
        if not np.isfinite(corners).all():
            raise DataError("the board is not in front of the camera.")
        hull = np.rint(cv2.convexHull(corners.astype(np.float32))).astype(int)
        mask = cv2.fillConvexPoly(np.zeros(size[::-1], np.uint8), hull, 1)
        mask = cv2.erode(mask, np.ones((7, 7)))
        step = int(np.ceil(np.sqrt(max(int(mask.sum()), 1) / _PIXELS)))
        rows, columns = (step * axis for axis in np.nonzero(mask[::step, ::step]))
        px = np.column_stack([columns, rows]).astype(float)
        rays = self.rays(px)
        true = distances(pose, rays)[0]
        excess = depth[rows, columns] - true * self.lengths(rays)
        shades = self._shades(view, apply(beside, true[:, None] * rays))
        side = max(float(np.ptp(corners, axis=0).max()) / _CELLS, 6.0)
        key = px // side @ [1e4, 1.0]
        order, found = np.argsort(key, kind="stable"), []
        for cell in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            white, ink = (cell[shade[cell] & np.isfinite(excess[cell])] for shade in shades)
            if len(white) >= _LEAST:
                middle = float(np.median(excess[white]))
                spread = _MAD * float(np.median(np.abs(excess[white] - middle)))
                deeper = float(np.median(excess[ink])) - middle if len(ink) >= _LEAST else np.nan
                found.append((*px[white].mean(axis=0), middle, spread, deeper))
        if len(found) < _FEWEST:
            raise DataError(
                f"{view.depth} has depth in {counted(len(found), 'cell')} of the board, but needs "
                f"{_FEWEST}."
            )
        u, v, excess, noise, inks = np.array(found).T
        px = np.column_stack([u, v])
        rays = self.rays(px)
        true, by_pose = distances(pose, rays)
        by_corners, by_looks = self._plane_errors(seen.corners, seen.cam_from_target)
        by_errors = np.zeros((len(px), len(self.root)))
        by_errors[:, 12:-6] = by_pose @ by_looks
        by_errors[:, -6:] = -by_pose @ adjoint(invert(pose))[_OF_PLANE]
        if self.by is None:
            by_lens = self.camera.rays_by_lens(px, true[:, None] * rays)[1]
            normal = pose[:3, 2] / (rays @ pose[:3, 2])[:, None]
            by_errors[:, 12 : 12 + by_lens.shape[2]] -= np.einsum("na,nak->nk", normal, by_lens)
        by_px = [distances(pose, self.rays(px + step))[0] - true for step in np.eye(2)]
        lengths = self.lengths(rays)
        cells = Cells(
            *(view.number, px, true * lengths, excess, noise, inks, np.transpose(by_px)),
            *(lengths[:, None] * by_pose @ by_corners, lengths[:, None] * by_errors @ self.root),
        )
        return chosen_rows(cells, on_board(cells, size))

    def lengths(self, rays: FloatArray) -> FloatArray:
        """(n,) what is measured along (n, 3) rays of unit depth, over their depth."""
        return np.linalg.norm(rays, axis=1) if self.is_ray else np.ones(len(rays))

    def _plane_errors(self, seen: Corners, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors of a board's plane in the camera's frame, by `_OF_PLANE`.

        Returns:
            (3, 3) root of their covariance by the corners' noise, and (3, k + m + s) their Jacobian
            by lens, field and the board's shape.
        """
        camera, noise_px = self.camera.camera, floored_sigma_px(self.calibration.noise["pixel_px"])
        stack = CornerStack.of({seen.view: seen}, self.corners_m)
        if self.camera.field is not None and self.camera.field.jitter:
            jitter = self.camera.field.jitter / noise_px
            stack = replace(stack, zooms=jitter * zooms(stack.px, camera))
        seen_at = reproject(stack, camera, pose[None])
        field = self.camera.displacements(stack.px, float(depths_m(stack, pose[None])[0]))
        shape = seen_at.by_point @ self.shape[seen.ids]
        stack.weigh(field, shape)
        columns = np.concatenate([seen_at.by_intrinsics, field, shape], axis=2)
        fitted = WithoutPoses.of(stack, seen_at.by_pose, columns, None)
        noise = noise_px**2 * fitted.inverse[0][np.ix_(_OF_PLANE, _OF_PLANE)]
        return np.linalg.cholesky(noise), fitted.answer[0][_OF_PLANE]

    def _shades(self, view: View, points_cam: FloatArray) -> tuple[Mask, Mask]:
        """(n,) which of some points are imaged well within white, and which within black."""
        images, camera = self.session.images, self.camera.camera
        data = images.read(view.image) if images.exists(view.image) else b""
        image = decode_image(data) if data else ""
        if isinstance(image, str) or image.shape != camera.resolution[::-1]:
            return np.ones(len(points_cam), dtype=bool), np.zeros(len(points_cam), dtype=bool)
        px = np.nan_to_num(np.rint(project(camera, points_cam)))
        u, v = np.clip(px, 0, np.array(camera.resolution) - 1).astype(int).T
        white, ink = _shaded(image)
        return white[v, u], ink[v, u]


def _shaded(image: Image) -> tuple[Mask, Mask]:
    """(h, w) pixels well within white, and within black, relative to what is around them."""
    around, edge = (np.ones((side, side), np.uint8) for side in (max(image.shape) // 16, 3))
    even = cv2.blur(image, (3, 3))
    middle = (cv2.erode(even, around).astype(float) + cv2.dilate(even, around)) / 2.0
    white, ink = cv2.erode(image, edge) > middle, cv2.dilate(image, edge) < middle
    return np.asarray(white, dtype=bool), np.asarray(ink, dtype=bool)


def on_board(cells: Cells, size: tuple[int, int]) -> Mask:
    """(n,) which cells are of the board, and not of something before it.

    Most of the board is seen: the densest band of deviations is its own. Within the band, cells
    are of something else that do not lie in one plane with the others.
    """
    excess, band = cells.excess_m, _BENT * float(np.median(cells.true_m))
    counts = np.sum(np.abs(excess[:, None] - excess) < band, axis=0)
    kept = np.abs(excess - excess[np.argmax(counts)]) < band
    kept &= cells.noise_m < 3.0 * np.median(cells.noise_m[kept]) + 1e-4
    columns = bending(cells.px, size)[:, :3]
    for _ in range(3):
        fitted = columns @ np.linalg.lstsq(columns[kept], excess[kept])[0]
        away = np.abs(excess - fitted)
        kept = away < max(_GATE * _MAD * float(np.median(away[kept])), 3e-4)
    return np.asarray(kept, dtype=bool)


def fit_mixed(
    excess: FloatArray, fixed: FloatArray, known: FloatArray, views: FloatArray, noise: FloatArray
) -> Estimate:
    """Fits fixed effects beside random ones, of which some variances are estimated by REML.

    Args:
        excess: (n,) observations.
        fixed: (n, p) columns of fixed effects.
        known: (n, q) columns of random effects with unit variance.
        views: (n, 3 v) columns of each view's own offset and two tilts.
        noise: (n,) relative standard deviations of the observations.

    Returns:
        The estimate of all columns, by sizes of the noise and of the views' offset and tilt.
    """
    table = np.column_stack([fixed, known, views, excess]) / noise[:, None]
    count = table.shape[1] - 1
    _, randoms, own = np.split(np.arange(count), np.cumsum([fixed.shape[1], known.shape[1]]))
    groups = ((-1, randoms), (1, own[::3]), (2, np.delete(own, np.s_[::3])))
    terms = [prior_term(size, of, np.zeros(len(of)), 1.0) for size, of in groups]
    every = Term(0, len(table), np.arange(count), table.T @ table)
    mixed = Mixed((every, *terms), (), count, 3)
    # From a tenth of a millimetre on; less than a micrometre is none.
    logs, low, high = np.log([[0.3, 1e-4, 1e-4], [1e-3, 1e-6, 1e-6], [30.0, 0.1, 0.1]])
    for _ in range(3):
        logs = (found := most_likely(mixed, logs, low, high).estimate).logs
    return found


def with_depth(
    calibration: Calibration, evidence: Sequence[ViewEvidence], session: Session
) -> tuple[Calibration, tuple[ViewEvidence, ...]]:
    """The result with the depth of its cameras and what is to be said of it, and its evidence."""
    seen = {view.view: view for view in evidence}
    used = {view.view for view in calibration.views if view.used}
    views: dict[tuple[str, str], list[View]] = {}
    for view in session.views:
        if view.depth and view.number in used:
            key = view.text.get("camera", "").strip(), session.board_of(view)
            views.setdefault(key, []).append(view)
    findings, found = list[Finding](), dict[str, DepthResult]()
    for camera in dict.fromkeys(camera for camera, _ in views):
        # Of several boards, the one that is seen most.
        board = max((key for key in views if key[0] == camera), key=lambda key: len(views[key]))[1]
        try:
            pair = calibration.chosen(Choice(camera or None, None, board or None))
            sensor = Sensor.of(pair, session, camera, board)
            result, cells, said = _depth_of(sensor, views[camera, board], seen)
        except DataError as error:
            findings.append(Finding("depth_unread", f"Depth was not compared: {error}").of(camera))
            continue
        findings += [finding.of(camera) for finding in said]
        if result is not None:
            found[camera] = result
        for part in cells:
            seen[part.view] = replace(seen[part.view], depth=_shown(part, result, sensor))
    verdict = calibration.verdict
    verdict = replace(verdict, findings=(*verdict.findings[:1], *findings, *verdict.findings[1:]))
    calibration = replace(calibration, verdict=verdict)
    if calibration.cell is not None:
        # The pairs' transforms are others than the cell's.
        depths = {name: replace(one, with_calibration=None) for name, one in found.items()}
        cameras = {
            name: replace(one, depth=depths.get(name))
            for name, one in calibration.cell.cameras.items()
        }
        calibration = replace(calibration, cell=replace(calibration.cell, cameras=cameras))
    elif found and calibration.camera is not None:
        camera_result = replace(calibration.camera, depth=next(iter(found.values())))
        calibration = replace(calibration, camera=camera_result)
    return calibration, tuple(seen[view.view] for view in evidence)


def _shown(cells: Cells, result: DepthResult | None, sensor: Sensor) -> FloatArray:
    """(n, 5) a view's cells, as its evidence has them."""
    px, left, true = cells.px, cells.excess_m, cells.true_m
    if result is not None:
        left = result.true_m(true + left, px, sensor.lens.resolution) - true
    if sensor.by is not None:
        rays = sensor.rays(px)
        points = (true / sensor.lengths(rays))[:, None] * rays
        px = project(sensor.camera.camera, apply(sensor.by.cam_from_depth, points))
    return np.column_stack([px, true, cells.excess_m, left])


def depth_now(
    calibration: Calibration, session: Session, seen: Mapping[int, ViewEvidence]
) -> tuple[Finding, ...]:
    """Whether the depth of one camera and board still is what it was.

    Args:
        calibration: Theirs, with the depth.
        session: New views.
        seen: The board in each.
    """
    views = [view for view in session.views if view.depth]
    if not views or calibration.camera is None or calibration.camera.depth is None:
        return ()
    camera, board = next(iter(session.cameras), ""), next(iter(session.boards), "")
    try:
        sensor, before = Sensor.of(calibration, session, camera, board), calibration.camera.depth
        return tuple(_depth_of(sensor, views, seen, before)[2])
    except DataError as error:
        return (Finding("depth_unread", f"Depth was not compared: {error}"),)


def _depth_of(
    sensor: Sensor,
    views: Sequence[View],
    seen: Mapping[int, ViewEvidence],
    before: DepthResult | None = None,
) -> tuple[DepthResult | None, list[Cells], list[Finding]]:
    """The depth of one camera, the cells that it is from, and what is to be said of it.

    Where it was something else before, whether it still is.
    """
    size, found, lost = sensor.lens.resolution, list[Cells](), dict[str, list[int]]()
    for view in views:
        try:
            found.append(sensor.cells(view, seen.get(view.number)))
        except DataError as error:
            lost.setdefault(str(error).replace(view.depth, "depth"), []).append(view.number)
    said = [
        Finding("depth_unread", f"No depth of {view_words(of)}: {words}", views=tuple(of))
        for words, of in lost.items()
    ]
    if len(found) < CheckLimits.stops:
        words = f"Depth was not compared: it is of {counted(len(found), 'view')} of the board, "
        words += f"but must be of {CheckLimits.stops}."
        return None, found, [*said, Finding("depth_unread", words)]
    ratios = np.array([np.median(at.excess_m / at.true_m) for at in found])
    ratio = 1.0 + float(np.median(ratios))
    if not 0.67 < ratio < 1.5:
        return None, found, [*said, _another_unit(ratio, sensor.unit_m)]
    # Views that something hides whole.
    off = np.abs(ratios - np.median(ratios))
    within = off < max(_GATE * _MAD * float(np.median(off)), 0.03)
    found = [cells for cells, is_kept in zip(found, within, strict=True) if is_kept]
    kept, shift = agreeing(found, size)
    if shift.any():
        return None, found, [*said, _shifted(shift)]
    found = [cells for cells, is_kept in zip(found, kept, strict=True) if is_kept]
    result, further = estimated(found, sensor, {view.number: view.stamp_s for view in views})
    return result, found, [*said, _judged(result, found, size, further, before)]


def agreeing(found: Sequence[Cells], size: tuple[int, int]) -> tuple[Mask, FloatArray]:
    """(v,) which views are not hidden whole by something, and (2,) the shift of the pictures [px].

    By least absolute deviations of the views' medians; the shift is zero where it is none.
    """
    middles = np.array([np.median(cells.excess_m) for cells in found])
    columns = np.array(
        [
            [np.median(at.true_m), *bending(at.px, size).mean(axis=0)[[0, 3]], *-at.by_px.mean(0)]
            for at in found
        ]
    )

    def fitted(count: int) -> tuple[FloatArray, FloatArray]:
        def misfit(values: FloatArray) -> FloatArray:
            return np.asarray(columns[:, :count] @ values - middles)

        start = np.zeros(count)
        fit = least_squares(misfit, start, x_scale="jac", loss="soft_l1", f_scale=1e-5)
        return np.abs(misfit(fit.x)), fit.x

    (off, _), (left, values) = fitted(3), fitted(5)
    # Views that something hides are few: a shift moves most of them.
    usual = float(np.median(off))
    explains = len(found) > 7 and max(3.0 * np.median(left), 0.003 * columns[0, 0]) < usual
    shift = values[3:] * (explains and np.linalg.norm(values[3:]) > 2.0)
    return off < max(_GATE * _MAD * usual, 0.01 * columns[0, 0]), shift


def _shifted(shift: FloatArray) -> Finding:
    return Finding(
        "depth_shifted",
        "The depth pictures are not aligned to the images: they are shifted by about "
        f"({shift[0]:.0f}, {shift[1]:.0f}) px, and so were not compared with the board.",
        Remedy("Record depth aligned to the image (rs.align, setDepthAlign), at its size."),
    )


def estimated(
    found: Sequence[Cells], sensor: Sensor, stamps: Mapping[int, float | None]
) -> tuple[DepthResult, str]:
    """The model of some views' cells, and a sentence on what else they show."""
    px, true, excess, noise, by_common, inks = (
        np.concatenate([getattr(cells, name) for cells in found])
        for name in ("px", "true_m", "excess_m", "noise_m", "by_common", "inks_m")
    )
    powers = np.column_stack([np.ones_like(true), true**4])
    of_pixel = nnls(powers * 1e6, noise**2 * 1e6)[0]
    noise = np.sqrt(np.maximum(powers @ of_pixel, 1e-10))
    bent = bending(px, sensor.lens.resolution)
    rows = np.split(bent[:, :3], np.cumsum([len(cells.px) for cells in found])[:-1])
    known = np.column_stack([by_common, block_diag(*(cells.by_corners for cells in found))])
    times = np.concatenate([np.full(len(at.px), stamps.get(at.view) or 0.0) for at in found])
    fixed, further, views = np.column_stack([true, bent]), "", block_diag(*rows)
    if np.ptp(times) > 60.0:
        drifting = np.column_stack([fixed, (times - times.mean()) / 3600.0])
        mixed = fit_mixed(excess, drifting, known, views, noise)
        if abs(mixed.values[5]) > _GATE * np.sqrt(mixed.covariance[5, 5]):
            further = f" It drifts by {1e3 * mixed.values[5]:.2g} mm an hour."
            fixed = drifting
    mixed = fit_mixed(excess, fixed, known, views, noise)
    scale, offset, u, v, bowl = mixed.values[:5].tolist()
    # Of edges, lens and field, which come first.
    root = sensor.root[: -6 - sensor.shape.shape[2]]
    errors = fixed.shape[1] + np.arange(root.shape[1])
    return (
        DepthResult(
            scale=1.0 + scale,
            offset_m=offset,
            tilt_m=(u, v),
            bowl_m=bowl,
            covariance=mixed.covariance[:5, :5],
            with_calibration=mixed.covariance[:5, errors] @ root.T,
            noise_m=(float(np.sqrt(of_pixel[0])), float(np.sqrt(of_pixel[1]))),
            view_m=float(np.exp(mixed.logs[1])),
            ink_m=float(np.nanmedian(inks)) if np.isfinite(inks).sum() >= _FEWEST else 0.0,
            distances_m=(float(true.min()), float(true.max())),
            of="ray" if sensor.is_ray else "z",
            unit_m=sensor.unit_m,
            by=sensor.by,
        ),
        further,
    )


def _another_unit(ratio: float, unit_m: float | None) -> Finding:
    """The finding on depth in another unit than is stated."""
    # Left out, it is a millimetre of whole numbers, and a metre of others.
    taken = (0.001, 1.0) if unit_m is None else (unit_m,)
    _, nearest = min(
        (abs(float(np.log(one * ratio / unit))), one)
        for unit in taken
        for one in (1e-4, 1e-3, 2.5e-4, 1e-2, 1.0, 1.25e-4)
    )
    return Finding(
        "depth_unit",
        f"Depth is {figure(ratio)} times what the chain predicts: its unit is another one.",
        Remedy(f"Write depth_unit_m = {nearest:g} in [camera] of session.toml."),
    )


def _judged(
    result: DepthResult,
    found: Sequence[Cells],
    size: tuple[int, int],
    further: str,
    before: DepthResult | None,
) -> Finding:
    """Whether a depth is true, or what it was before, in mm at the distances of the views."""
    true = np.concatenate([cells.true_m for cells in found])
    known = before or DepthResult.exact()
    away = result.values - known.values
    statistic = float(away @ np.linalg.solve(result.covariance + known.covariance, away))
    middle, sigma = float(np.median(true)), np.sqrt(np.diag(result.covariance))
    px = np.concatenate([cells.px for cells in found])
    off = 1e3 * np.column_stack([true, bending(px, size)]) @ away
    is_true = statistic < float(chi2_limit(FALSE_ALARM, 5))
    centre = 1e3 * (away[0] * middle + away[1])
    figures = (
        f"scale {result.scale:.5f} +- {sigma[0]:.5f}, offset {1e3 * result.offset_m:.2f} +- "
        f"{1e3 * sigma[1]:.2f} mm, bowl {1e3 * result.bowl_m:.2f} +- {1e3 * sigma[4]:.2f} mm."
    )
    if result.ink_m:
        figures += f" Black reads {1e3 * result.ink_m:.1f} mm deeper than white."
    span = f"{off.min():.1f} to {off.max():.1f} mm"
    if is_true:
        what = "true" if before is None else "what it was"
        words = f"The camera's depth is {what} at {middle:.2f} m"
        return Finding(NOTE, f"{words}: {figures}{further}")
    if before is None:
        words = (
            f"The camera's depth is {abs(centre):.1f} mm too {'long' if centre > 0 else 'short'} "
            f"at {middle:.2f} m in the image's middle, and over the board from {span}"
        )
        step = "Correct it: visioncal locate applies camera.depth of calibration.json."
        return Finding("depth_scale", f"{words}: {figures}{further}", Remedy(step))
    words = (
        f"The camera's depth is not what it was: at {middle:.2f} m it reads {centre:+.1f} mm in "
        f"the image's middle beside what it did, and over the board {span}"
    )
    step = "Look at the sensor's window, warmth and settings, or calibrate again."
    return Finding(DEPTH_CHANGED, f"{words}: {figures}{further}", Remedy(step))
