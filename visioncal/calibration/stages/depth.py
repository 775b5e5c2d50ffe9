"""Whether a camera's depth is true: its distances against those that the calibrated chain predicts.

Distances of the board's white in small cells are compared with the board's plane at each view. By
generalised least squares the deviations give the model of `DepthResult`; the offset and tilt of
each view by the noise of the robot and of the sensor are random effects, whose variances are
estimated by REML (Patterson and Thompson 1971), and the errors of the calibration have their joint
covariance. Only what a calibration says of itself is used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.optimize import minimize, nnls

from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import counted, figure, some_of
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.transforms import adjoint, apply, invert
from visioncal.core.types import Camera, FloatArray, Image, Mask
from visioncal.core.verdict import DEPTH_CHANGED, NOTE, Finding, Remedy
from visioncal.estimation.chain import edge_names
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


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of depth on the board at one view."""

    view: int
    px: FloatArray  # (n, 2) their middles [px].
    true_m: FloatArray  # (n,) predicted distances [m].
    excess_m: FloatArray  # (n,) medians of measured minus predicted distances [m].
    noise_m: FloatArray  # (n,) robust standard deviation of the pixels [m].
    by_px: FloatArray  # (n, 2) derivatives of the predicted distances by the pixels [m/px].
    by_common: FloatArray  # (n, q) the same by independent errors of the calibration [m].
    by_robot: FloatArray  # (n, 6) the same by the independent noise of the flange [m].
    inks_m: FloatArray  # (n,) how much deeper black is read, NaN where unknown [m].

    def take(self, kept: Mask) -> "Cells":
        """Some of the cells."""
        names = ("px", "true_m", "excess_m", "noise_m", "by_px", "by_common", "by_robot", "inks_m")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


@dataclass(frozen=True, eq=False)
class BoardPlane:
    """A board as the calibrated chain places it at one view, and how errors move it."""

    cam_from_target: FloatArray  # (4, 4).
    by_edges: FloatArray  # (6, 12) its right perturbation by those of both edges.
    by_flange: FloatArray  # (6, 6) the same by the flange's.

    def distances(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) its depth along (n, 3) rays of unit depth, and (n, 6) Jacobian by its pose."""
        rotation, origin = self.cam_from_target[:3, :3], self.cam_from_target[:3, 3]
        along = rays @ rotation[:, 2]
        depth = (rotation[:, 2] @ origin) / along
        lever = (origin - depth[:, None] * rays) @ rotation
        z = np.broadcast_to([0.0, 0.0, 1.0], lever.shape)
        by_pose = np.concatenate([np.cross(z, lever), z], axis=1) / along[:, None]
        return depth, by_pose


def plane_at(calibration: Calibration, base_from_flange: FloatArray) -> BoardPlane:
    """The board of one camera and robot at a pose (4, 4) of the flange."""
    x, z = (calibration.edges[name].matrix for name in edge_names(calibration.mount))
    if calibration.mount == "eye-in-hand":
        pose = invert(base_from_flange @ x) @ z
        by_flange = -adjoint(invert(z) @ base_from_flange)
    else:
        pose = invert(x) @ base_from_flange @ z
        by_flange = adjoint(invert(z))
    return BoardPlane(pose, np.concatenate([-adjoint(invert(pose)), np.eye(6)], axis=1), by_flange)


@dataclass(frozen=True, eq=False)
class Sensor:
    """What the depth of one camera is compared with."""

    calibration: Calibration  # Of one camera, robot and board.
    camera: CameraResult  # Its camera.
    session: Session
    corners_m: FloatArray  # (c, 3) the board's corners in its frame [m].
    lens: Camera  # The lens of the depth pictures.
    cam_from_depth: FloatArray  # (4, 4); the identity where they are aligned to the image.
    place: FloatArray  # (6,) its standard deviations [rad, m].
    unit_m: float | None  # Their unit, where stated [m].
    is_ray: bool  # Whether distances are along the ray.

    @cached_property
    def root(self) -> FloatArray:
        """(12 + k + m, q) root of the covariance of edges, lens and field."""
        joint = self.calibration.joint_covariance[:12, :12]
        values, vectors = np.linalg.eigh(self.camera.covariance_with(joint))
        kept = values > 1e-12 * values.max()
        return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))

    def rays(self, px: FloatArray) -> FloatArray:
        """(n, 3) rays of unit depth of pixels of the depth picture."""
        in_model = self.camera.in_model(px) if self.lens is self.camera.camera else px
        return np.column_stack([normalise(self.lens, in_model), np.ones(len(px))])

    def cells(self, view: View, plane: BoardPlane) -> Cells:
        """The cells of a view that are of the board; raises DataError where there are too few."""
        images, size = self.session.images, self.lens.resolution
        if why := images.absence(view.depth):
            raise DataError(f"{view.depth} {why}.")
        depth = read_depth(images.read(view.depth), view.depth, size, self.unit_m)
        pose = invert(self.cam_from_depth) @ plane.cam_from_target
        plane = replace(plane, cam_from_target=pose)
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
        true = plane.distances(rays)[0]
        length = np.linalg.norm(rays, axis=1) if self.is_ray else np.ones(len(px))
        excess = depth[rows, columns] - true * length
        shades = self._shades(view, apply(self.cam_from_depth, true[:, None] * rays))
        side = max(float(np.ptp(corners, axis=0).max()) / _CELLS, 6.0)
        key = px // side @ [1e4, 1.0]
        order, found, inks = np.argsort(key, kind="stable"), [], []
        for cell in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            white, ink = (cell[shade[cell] & np.isfinite(excess[cell])] for shade in shades)
            if len(white) >= _LEAST:
                middle = float(np.median(excess[white]))
                spread = _MAD * float(np.median(np.abs(excess[white] - middle)))
                found.append((*px[white].mean(axis=0), middle, spread))
                deeper = float(np.median(excess[ink])) - middle if len(ink) >= _LEAST else np.nan
                inks.append(deeper)
        if len(found) < _FEWEST:
            raise DataError(
                f"{view.depth} has depth in {counted(len(found), 'cell')} of the board, but needs "
                f"{_FEWEST}."
            )
        table = np.array(found)
        px, rays = table[:, :2], self.rays(table[:, :2])
        true, by_pose = plane.distances(rays)
        length = np.linalg.norm(rays, axis=1) if self.is_ray else np.ones(len(px))
        by_errors = np.zeros((len(px), len(self.root)))
        by_errors[:, :12] = by_pose @ plane.by_edges
        if self.lens is self.camera.camera:
            by_lens = self.camera.rays_by_lens(px, true[:, None] * rays)[1]
            normal = pose[:3, 2] / (rays @ pose[:3, 2])[:, None]
            by_errors[:, 12:] = -np.einsum("na,nak->nk", normal, by_lens)
        ahead, behind = (
            np.stack([plane.distances(self.rays(px + sign * step))[0] for step in np.eye(2)])
            for sign in (0.5, -0.5)
        )
        by_robot = by_pose @ plane.by_flange * flange_sigmas(self.calibration)
        lengths = length[:, None]
        by_place = -by_pose @ adjoint(invert(pose)) * self.place
        by_common = np.hstack([by_errors @ self.root, by_place])
        cells = Cells(
            *(view.number, px, true * length, table[:, 2], table[:, 3], (ahead - behind).T),
            *(lengths * by_common, lengths * by_robot, np.array(inks)),
        )
        return cells.take(on_board(cells, size))

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


def flange_sigmas(calibration: Calibration) -> FloatArray:
    """(6,) noise of a robot's flange at one stop [rad, m]."""
    of = "robot" if "robot_translation_mm" in calibration.noise else "combined"
    turn = np.deg2rad(calibration.noise.get(f"{of}_rotation_deg", 0.0))
    return np.repeat([turn, 1e-3 * calibration.noise.get(f"{of}_translation_mm", 0.0)], 3)


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


@dataclass(frozen=True, eq=False)
class Mixed:
    """Estimates of a linear mixed model."""

    values: FloatArray  # (p,) fixed effects.
    covariance: FloatArray  # (p, p).
    with_known: FloatArray  # (p, q) covariance of their errors with known random effects.
    levels: FloatArray  # (3,) standard deviations: of noise, and of the views' offset and tilt.


def fit_mixed(
    excess: FloatArray, fixed: FloatArray, known: FloatArray, views: FloatArray, noise: FloatArray
) -> Mixed:
    """Fits fixed effects beside random ones, of which some variances are estimated by REML.

    Args:
        excess: (n,) observations.
        fixed: (n, p) columns of fixed effects.
        known: (n, q) columns of random effects with unit variance.
        views: (n, 3 v) columns of each view's own offset and two tilts.
        noise: (n,) relative standard deviations of the observations.
    """
    table = np.column_stack([fixed, known, views, excess]) / noise[:, None]
    gram, size = table.T @ table, fixed.shape[1]
    count, both = views.shape[1] // 3, size + known.shape[1]

    def solved(logs: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        of_noise, offset, tilt = np.exp(-2.0 * logs)
        prior = np.repeat([0.0, 1.0], [size, both - size])
        prior = np.concatenate([prior, np.tile([offset, tilt, tilt], count)])
        information = of_noise * gram[:-1, :-1] + np.diag(prior)
        estimate = np.linalg.solve(information, of_noise * gram[:-1, -1])
        misfit = of_noise * (gram[-1, -1] - estimate @ gram[:-1, -1])
        logs_of_g = 2.0 * count * (logs[1] + 2.0 * logs[2])
        determinant = np.linalg.slogdet(information)[1]
        return 2.0 * len(excess) * logs[0] + logs_of_g + determinant + misfit, estimate, information

    # From a tenth of a millimetre on; less than a micrometre is none.
    start, least = np.log([0.3, 1e-4, 1e-4]), np.log([1e-3, 1e-6, 1e-6])
    bounds = list(zip(least.tolist(), np.log([30.0, 0.1, 0.1]).tolist(), strict=True))
    logs = minimize(lambda at: solved(at)[0], start, method="L-BFGS-B", bounds=bounds).x
    _, estimate, information = solved(logs)
    inverse = np.linalg.inv(information)[:size]
    covariance, cross = np.split(inverse[:, :both], [size], axis=1)
    return Mixed(
        estimate[:size], np.asarray((covariance + covariance.T) / 2.0), cross, np.exp(logs)
    )


def with_depth(
    calibration: Calibration, evidence: Sequence[ViewEvidence], session: Session
) -> tuple[Calibration, tuple[ViewEvidence, ...]]:
    """The result with the depth of its cameras and what is to be said of it, and its evidence."""
    seen = {view.view: view for view in evidence}
    used = {view.view for view in calibration.views if view.used}
    views: dict[tuple[str, str], list[View]] = {}
    for observation in session.observations:
        view = observation.view
        if view.depth and view.number in used:
            key = view.text.get("camera", "").strip(), session.board_of(view)
            views.setdefault(key, []).append(view)
    findings, found = list[Finding](), dict[str, DepthResult]()
    for camera in dict.fromkeys(camera for camera, _ in views):
        # Of several boards, the one that is seen most.
        board = max((key for key in views if key[0] == camera), key=lambda key: len(views[key]))[1]
        try:
            pair = calibration.chosen(Choice(camera or None, None, board or None))
            of_board = views[camera, board]
            flanges = {view.number: seen[view.number].base_from_flange for view in of_board}
            result, cells, said = _depth_of(pair, session, camera, board, of_board, flanges)
        except DataError as error:
            findings.append(Finding("depth_unread", f"Depth was not compared: {error}").of(camera))
            continue
        findings += [finding.of(camera) for finding in said]
        if result is not None:
            found[camera] = result
        for part in cells:
            table = _shown(part, result, pair)
            seen[part.view] = replace(seen[part.view], depth=table)
    verdict = calibration.verdict
    verdict = replace(verdict, findings=(*verdict.findings[:1], *findings, *verdict.findings[1:]))
    calibration = replace(calibration, verdict=verdict)
    if calibration.cell is not None:
        cameras = dict(calibration.cell.cameras)
        for name, one in found.items():
            depth = replace(one, with_calibration=None)
            cameras[name] = replace(cameras[name], depth=depth)
        calibration = replace(calibration, cell=replace(calibration.cell, cameras=cameras))
    elif found and calibration.camera is not None:
        camera_result = replace(calibration.camera, depth=next(iter(found.values())))
        calibration = replace(calibration, camera=camera_result)
    return calibration, tuple(seen[view.view] for view in evidence)


def _shown(cells: Cells, result: DepthResult | None, pair: Calibration) -> FloatArray:
    """(n, 5) a view's cells, as its evidence has them."""
    px, left, true = cells.px, cells.excess_m, cells.true_m
    if result is not None and pair.camera is not None:
        camera = pair.camera.camera
        size = camera.resolution if result.by is None else result.by.resolution
        left = result.true_m(true + left, px, size) - true
        if result.by is not None:
            rays = np.column_stack([normalise(result.by.camera, px), np.ones(len(px))])
            px = project(camera, apply(result.by.cam_from_depth, true[:, None] * rays))
    return np.column_stack([px, true, cells.excess_m, left])


def depth_now(
    calibration: Calibration, session: Session, flanges: Mapping[int, FloatArray | None]
) -> tuple[Finding, ...]:
    """Whether the depth of one camera, robot and board still is what it was.

    Args:
        calibration: Theirs, with the depth.
        session: New views.
        flanges: (4, 4) the flange's pose at each by the calibrated arm.
    """
    views = [view for view in session.views if view.depth]
    if not views or calibration.camera is None or calibration.camera.depth is None:
        return ()
    camera, board = next(iter(session.cameras), ""), next(iter(session.boards), "")
    try:
        before = calibration.camera.depth
        return tuple(_depth_of(calibration, session, camera, board, views, flanges, before)[2])
    except DataError as error:
        return (Finding("depth_unread", f"Depth was not compared: {error}"),)


def _depth_of(
    pair: Calibration,
    session: Session,
    camera: str,
    board: str,
    views: Sequence[View],
    flanges: Mapping[int, FloatArray | None],
    before: DepthResult | None = None,
) -> tuple[DepthResult | None, list[Cells], list[Finding]]:
    """The depth of one camera, the cells that it is from, and what is to be said of it.

    Where it was something else before, whether it still is.
    """
    table, target = session.cameras[camera], session.boards[board]
    corners = corner_positions(target)
    if pair.camera is None or np.ptp(corners[:, 2]) > 0.0:
        raise DataError("it needs a camera and a flat board.")
    lens, own, beside, place = pair.camera.camera, session.declaration.depth, np.eye(4), np.zeros(6)
    by = None
    if own is not None and (stated := own.stated) is not None:
        prior, lens, table = session.declaration.prior["cam_from_depth"], stated, own
        beside = np.eye(4) if prior.pose is None else prior.pose
        place = np.repeat([prior.sigma_rad or 0.0, prior.sigma_m or 0.0], 3)
        by = DepthCamera(**vars(lens), cam_from_depth=beside)
    sensor = Sensor(
        *(pair, pair.camera, session, corners, lens, beside, place),
        *(table.depth_unit_m, table.depth_of == "ray"),
    )
    found, lost = list[Cells](), dict[str, list[int]]()
    for view in views:
        if (flange := flanges.get(view.number)) is None:
            continue
        try:
            found.append(sensor.cells(view, plane_at(pair, flange)))
        except DataError as error:
            lost.setdefault(str(error).replace(view.depth, "depth"), []).append(view.number)
    said = [
        Finding(
            "depth_unread", f"No depth of view {some_of([*map(str, of)])}: {words}", views=tuple(of)
        )
        for words, of in lost.items()
    ]
    if len(found) < CheckLimits.stops:
        words = f"Depth was not compared: it is of {counted(len(found), 'view')} of the board, "
        words += f"but must be of {CheckLimits.stops}."
        return None, found, [*said, Finding("depth_unread", words)]
    ratios = np.array([np.median(at.excess_m / at.true_m) for at in found])
    ratio = 1.0 + float(np.median(ratios))
    if not 0.67 < ratio < 1.5:
        return None, found, [*said, _another_unit(ratio, table.depth_unit_m)]
    # Views that something hides whole.
    off = np.abs(ratios - np.median(ratios))
    within = off < max(_GATE * _MAD * float(np.median(off)), 0.03)
    found = [cells for cells, is_kept in zip(found, within, strict=True) if is_kept]
    kept, shift = agreeing(found, sensor.lens.resolution)
    if shift.any():
        return None, found, [*said, _shifted(shift)]
    found = [cells for cells, is_kept in zip(found, kept, strict=True) if is_kept]
    stamps = {view.number: view.stamp_s for view in views}
    result, further = estimated(found, sensor.lens.resolution, stamps, sensor.root)
    result = replace(result, of=table.depth_of, unit_m=table.depth_unit_m, by=by)
    return result, found, [*said, _judged(result, found, sensor.lens.resolution, further, before)]


def agreeing(found: Sequence[Cells], size: tuple[int, int]) -> tuple[Mask, FloatArray]:
    """(v,) which views are not hidden whole by something, and (2,) the shift of the pictures [px].

    By least absolute deviations of the views' medians; the shift is zero where it is none.
    """
    middles = np.array([np.median(cells.excess_m) for cells in found])
    columns = np.array(
        [
            [np.median(cells.true_m), *bending(cells.px, size).mean(axis=0)[[0, 3]], *-by_px]
            for cells in found
            for by_px in [cells.by_px.mean(axis=0)]
        ]
    )

    def fitted(count: int) -> tuple[FloatArray, FloatArray]:
        weights, values = np.ones(len(middles)), np.zeros(count)
        for _ in range(30):
            rows = weights[:, None] * columns[:, :count]
            values = np.linalg.lstsq(rows, weights * middles, rcond=1e-6)[0]
            left = np.abs(middles - columns[:, :count] @ values)
            weights = 1.0 / np.sqrt(np.maximum(left, 1e-5))
        return np.abs(middles - columns[:, :count] @ values), values

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
    found: Sequence[Cells],
    size: tuple[int, int],
    stamps: Mapping[int, float | None],
    root: FloatArray,
) -> tuple[DepthResult, str]:
    """The model of some views' cells, and a sentence on what else they show."""
    px, true, excess, noise, by_common, inks = (
        np.concatenate([getattr(cells, name) for cells in found])
        for name in ("px", "true_m", "excess_m", "noise_m", "by_common", "inks_m")
    )
    of_pixel = nnls(np.column_stack([np.ones_like(true), true**4]) * 1e6, noise**2 * 1e6)[0]
    noise = np.sqrt(np.maximum(of_pixel @ [np.ones_like(true), true**4], 1e-10))
    bent = bending(px, size)
    fixed = np.column_stack([true, bent])
    views, robot = (np.zeros((len(true), count * len(found))) for count in (3, 6))
    first, times = 0, np.zeros(len(true))
    for at, cells in enumerate(found):
        rows = slice(first, first := first + len(cells.px))
        views[rows, 3 * at : 3 * at + 3] = bent[rows, :3]
        robot[rows, 6 * at : 6 * at + 6] = cells.by_robot
        times[rows] = stamps.get(cells.view) or 0.0
    known = np.column_stack([by_common, robot])
    further = ""
    extra = np.zeros((len(true), 0))
    if np.ptp(times) > 60.0:
        extra = ((times - times.mean()) / 3600.0)[:, None]
    mixed = fit_mixed(excess, np.column_stack([fixed, extra]), known, views, noise)
    if extra.size and abs(mixed.values[5]) > _GATE * np.sqrt(mixed.covariance[5, 5]):
        further = f" It drifts by {1e3 * mixed.values[5]:.2g} mm an hour."
    elif extra.size:
        mixed = fit_mixed(excess, fixed, known, views, noise)
    scale, offset, u, v, bowl = mixed.values[:5].tolist()
    return (
        DepthResult(
            scale=1.0 + scale,
            offset_m=offset,
            tilt_m=(u, v),
            bowl_m=bowl,
            covariance=mixed.covariance[:5, :5],
            with_calibration=mixed.with_known[:5, : root.shape[1]] @ root.T,
            noise_m=(float(np.sqrt(of_pixel[0])), float(np.sqrt(of_pixel[1]))),
            view_m=float(mixed.levels[1]),
            ink_m=float(np.nanmedian(inks)) if np.isfinite(inks).sum() >= _FEWEST else 0.0,
            distances_m=(float(true.min()), float(true.max())),
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
    known, covariance = np.array([1.0, 0.0, 0.0, 0.0, 0.0]), result.covariance
    if before is not None:
        known, covariance = before.values, covariance + before.covariance
    away = result.values - known
    statistic = float(away @ np.linalg.solve(covariance, away))
    middle, sigma = float(np.median(true)), np.sqrt(np.diag(result.covariance))
    px = np.concatenate([cells.px for cells in found])
    off = 1e3 * np.column_stack([true, bending(px, size)]) @ away
    is_true = statistic < float(chi2_limit(FALSE_ALARM, 5))
    centre = 1e3 * (away[0] * middle + away[1])
    figures = (
        f"scale {result.scale:.5f} +- {sigma[0]:.5f}, offset {1e3 * result.offset_m:.2f} +- "
        f"{1e3 * sigma[1]:.2f} mm, bowl {1e3 * result.bowl_m:.2f} +- {1e3 * sigma[4]:.2f} mm"
    )
    ink = f" Black reads {1e3 * result.ink_m:.1f} mm deeper than white." if result.ink_m else ""
    if before is not None:
        words = (
            f"The camera's depth is {'' if is_true else 'not '}what it was: at {middle:.2f} m it "
            f"reads {centre:+.1f} mm in the image's middle, and {off.min():+.1f} to "
            f"{off.max():+.1f} mm over the board, beside what it did; {figures}.{ink}{further}"
        )
        step = "Look at the sensor's window, warmth and settings, or calibrate again."
        return Finding(NOTE, words) if is_true else Finding(DEPTH_CHANGED, words, Remedy(step))
    if is_true:
        words = f"The camera's depth is true at {middle:.2f} m: {figures}.{ink}{further}"
        return Finding(NOTE, words)
    return Finding(
        "depth_scale",
        f"The camera's depth is {abs(centre):.1f} mm too {'long' if centre > 0 else 'short'} at "
        f"{middle:.2f} m in the image's middle, and over the board from {off.min():.1f} to "
        f"{off.max():.1f} mm: {figures}.{ink}{further}",
        Remedy("Correct it: visioncal locate applies camera.depth of calibration.json."),
    )
