"""Distances of a board's white and ink, in cells of a depth picture, against the board's plane."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.core.quantiles import SIGMA_PER_MAD
from visioncal.core.transforms import adjoint, apply, invert
from visioncal.core.types import Camera, Corners, FloatArray, Image, Mask, chosen_rows
from visioncal.results import Calibration, CameraResult
from visioncal.results.depth import DepthCamera, bending
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, View
from visioncal.session.depth import read_depth
from visioncal.vision.board_shape import shape_basis
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.camera import normalise, project
from visioncal.vision.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.vision.lens_field import depths_m, zooms
from visioncal.vision.targets import corner_positions

# Fewest pixels of a cell.
_LEAST = 12
# Fewest cells of a view.
FEWEST_CELLS = 6
# Deviation from the median, in its robust standard deviations, from which a cell is of something
# else.
GATE = 4.0
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
        declared, target, lens = session.declaration.depth, session.boards.get(board), pair.camera
        # Measured poses of the target need neither.
        if lens is None or target is None or np.ptp(corner_positions(target)[:, 2]) > 0.0:
            raise DataError("it needs a camera and a flat board.")
        table = session.cameras[camera] if declared is None else declared
        corners = corner_positions(target) if pair.board is None else pair.board.corners(target)
        seen, shape = (pair, lens, session), (corners, shape_basis(target))
        sensor = cls(*seen, *shape, table.depth_unit_m, table.depth_of == "ray")
        if declared is None or declared.stated is None:
            return sensor
        prior = session.declaration.prior["cam_from_depth"]
        pose = np.eye(4) if prior.pose is None else prior.pose
        sigmas = (prior.sigma_rad or 0.0, prior.sigma_m or 0.0)
        return replace(
            sensor, by=DepthCamera(**vars(declared.stated), cam_from_depth=pose, sigmas=sigmas)
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
        cam_from_depth = np.eye(4) if self.by is None else self.by.cam_from_depth
        pose = invert(cam_from_depth) @ seen.cam_from_target
        corners = project(self.lens, apply(pose, self.corners_m))
        if not np.isfinite(corners).all():
            raise DataError("the board is not in front of the camera.")
        hull = np.rint(cv2.convexHull(corners.astype(np.float32))).astype(int)
        mask = cv2.fillConvexPoly(np.zeros(size[::-1], np.uint8), hull, 1)
        mask = cv2.erode(mask, np.ones((7, 7)))
        # Pixels of a view that are looked at: more make the median of a cell no better than its
        # view.
        step = int(np.ceil(np.sqrt(max(int(mask.sum()), 1) / 60_000)))
        rows, columns = (step * axis for axis in np.nonzero(mask[::step, ::step]))
        px = np.column_stack([columns, rows]).astype(float)
        rays = self.rays(px)
        true = distances(pose, rays)[0]
        excess = depth[rows, columns] - true * self.lengths(rays)
        shades = self._shades(view, apply(cam_from_depth, true[:, None] * rays))
        # Cells along the board's longer side in the image.
        side = max(float(np.ptp(corners, axis=0).max()) / 12, 6.0)
        key = px // side @ [1e4, 1.0]
        order, found = np.argsort(key, kind="stable"), []
        for cell in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            white, ink = (cell[shade[cell] & np.isfinite(excess[cell])] for shade in shades)
            if len(white) >= _LEAST:
                middle = float(np.median(excess[white]))
                spread = SIGMA_PER_MAD * float(np.median(np.abs(excess[white] - middle)))
                deeper = float(np.median(excess[ink])) - middle if len(ink) >= _LEAST else np.nan
                found.append((*px[white].mean(axis=0), middle, spread, deeper))
        if len(found) < FEWEST_CELLS:
            raise DataError(
                f"{view.depth} has depth in {counted(len(found), 'cell')} of the board, but needs "
                f"{FEWEST_CELLS}."
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
        """(n,) ratio of measured length to depth along (n, 3) rays of unit depth."""
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
        data = images.read(view.image) if view.image and images.exists(view.image) else b""
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
    # Greatest curvature of depth over a board, as a share of its distance.
    excess, band = cells.excess_m, 0.008 * float(np.median(cells.true_m))
    counts = np.sum(np.abs(excess[:, None] - excess) < band, axis=0)
    kept = np.abs(excess - excess[np.argmax(counts)]) < band
    kept &= cells.noise_m < 3.0 * np.median(cells.noise_m[kept]) + 1e-4
    columns = bending(cells.px, size)[:, :3]
    for _ in range(3):
        fitted = columns @ np.linalg.lstsq(columns[kept], excess[kept])[0]
        away = np.abs(excess - fitted)
        kept = away < max(GATE * SIGMA_PER_MAD * float(np.median(away[kept])), 3e-4)
    return np.asarray(kept, dtype=bool)
