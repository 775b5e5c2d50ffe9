"""Images of a simulated cell's camera while the arm stands or moves."""

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import FloatArray, Image
from visioncal.simulation.arms import forward
from visioncal.simulation.boards import centre_m, corners_m, outline_m
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.layout import RandomStream
from visioncal.simulation.optics import project, rays
from visioncal.simulation.render import (
    Float32Array,
    Patch,
    between,
    developed,
    light_on,
    prepare_scene,
    trace,
)
from visioncal.simulation.textures import margin_m

# Image shift below the accuracy of corner detection [px].
_STILL_PX = 0.003
# Shorter motion blur is averaged from exact images, as it may count as standstill; longer blur from
# shifted ones.
_SHORT_PX = 2.0
_MOST_PARTS = 24
# Substitute for the distance of a board that is not in front of the camera [m].
_FAR_M = 1.0


class LiveView:
    """Takes images of a cell's board for any posture of its arm.

    Args:
        cell: Cell of one robot, one camera and one board. Its real arm, mountings, optics and noise
            are used, not its views.

    Raises:
        DataError: The cell has two boards, or OpenCV does not have the target's dictionary.
    """

    def __init__(self, cell: SimulatedCell) -> None:
        boards = cell.layout.boards
        if len(boards) != 1:
            raise DataError(
                f"simulation: the cell has {len(boards)} boards; live pictures show one."
            )
        self._cell = cell
        self._before = cell.seen_from("", "", "")
        self._scene = prepare_scene(cell)
        self._count = 0
        # Light of the last stationary posture; only the noise differs between its images.
        self._rest: tuple[FloatArray, Float32Array] | None = None

    def picture(self, joints: FloatArray) -> Image:
        """A (height, width) grey image with motion blur and independent noise.

        The true joint angles (k, n) [rad] are at equal intervals during the exposure; one row
        stands for a stationary arm.
        """
        poses = self.cam_from_target(joints)
        smear_px = float(self._moved_px(poses[:-1], poses[1:]).sum())
        if smear_px < _STILL_PX:
            pose = poses[len(poses) // 2]
            if self._rest is None or self._moved_px(self._rest[0][None], pose[None]) > _STILL_PX:
                self._rest = (pose, self._light(pose, joints[len(joints) // 2]))
            light = self._rest[1]
        else:
            light = self._smeared(joints, smear_px)
        self._count += 1
        noise = self._cell.options.stream(RandomStream.IMAGES, 1, self._count)
        return developed(light, self._cell.camera(), noise)

    def cam_from_target(self, joints: FloatArray) -> FloatArray:
        """True board poses: (k, n) joints [rad] to (k, 4, 4)."""
        return self._before(forward(self._cell.robot.true_arm, joints))

    def _light(self, pose: FloatArray, posture: FloatArray, **more: int) -> Float32Array:
        shows_board = _faces(self._cell, pose)
        return light_on(self._scene, pose, posture, shows_board=shows_board, **more)

    def _smeared(self, joints: FloatArray, smear_px: float) -> Float32Array:
        """Mean light over equal parts of the exposure."""
        parts = int(np.clip(np.ceil(smear_px), 3, _MOST_PARTS))
        positions = (np.arange(parts) + 0.5) / parts * (len(joints) - 1)
        steps = np.arange(len(joints))
        postures = np.stack([np.interp(positions, steps, column) for column in joints.T], axis=1)
        poses = self.cam_from_target(postures)
        if smear_px < _SHORT_PX:
            lights = (self._light(*pair) for pair in zip(poses, postures, strict=True))
        else:
            middle = self.cam_from_target(joints[len(joints) // 2, None])[0]
            sharp = self._light(middle, joints[len(joints) // 2], samples=1)
            lights = (self._shifted(sharp, pose @ invert(middle), middle) for pose in poses)
        total = next(lights).copy()
        for light in lights:
            total += light
        return np.asarray(total / np.float32(parts))

    def _shifted(
        self, light: Float32Array, now_from_middle: FloatArray, middle: FloatArray
    ) -> Float32Array:
        """Transforms an image as if all its content were at the board's distance."""
        # Motion blur is then correct at the board's centre, and symmetric about each corner's true
        # position everywhere.
        camera = self._cell.camera().camera
        raster = trace(camera, Patch(0, 0, *camera.resolution), 1)
        depth = float((middle[:3, :3] @ centre_m(self._cell.board()) + middle[:3, 3])[2])
        plane = compose(np.eye(3), np.array([0.0, 0.0, depth if depth > 0.0 else _FAR_M]))
        plane_from_now = invert(now_from_middle @ plane)
        directions = raster.directions @ plane_from_now[:3, :3].T
        start = plane_from_now[:3, 3]
        hits = start - directions * (start[2] / directions[..., 2])[..., None]
        px = project(camera, hits @ plane[:3, :3].T + plane[:3, 3])
        map_x, map_y = between(raster, px[..., 0]), between(raster, px[..., 1])
        shifted = cv2.remap(light, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shifted, np.float32)

    def _moved_px(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """(k,) bounds of the image motion between board poses (k, 4, 4) [px]."""
        centre = centre_m(self._cell.board())
        before = first[:, :3, :3] @ centre + first[:, :3, 3]
        after = second[:, :3, :3] @ centre + second[:, :3, 3]
        distance = np.maximum(np.linalg.norm(before, axis=1), 0.1)
        shift = np.linalg.norm(after - before, axis=1) / distance
        rotation = rotation_angle(second @ invert(first))
        return np.asarray(self._cell.camera().camera.matrix[0] * (shift + rotation))


def _faces(cell: SimulatedCell, cam_from_target: FloatArray) -> bool:
    """Whether the board's printed side may be in the image, at least in part."""
    board = cell.board()
    points = np.concatenate([corners_m(board), outline_m(board, margin_m(board.target))])
    points_cam = points @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    cosines = points_cam[:, 2] / np.linalg.norm(points_cam, axis=1)
    camera = cell.camera().camera
    ends = (
        np.array(np.meshgrid(*((0.0, index - 1.0) for index in camera.resolution))).reshape(2, 4).T
    )
    # The target's z points into the board.
    in_front = invert(cam_from_target)[2, 3] < 0.0
    return bool(in_front and cosines.max() > rays(camera, ends)[:, 2].min())
