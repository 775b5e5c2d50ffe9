"""Viewpoints of a simulated camera towards a board."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import apply, compose
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.simulation.boards import Sheet, centre_m, corners_m, outline_m
from visioncal.simulation.optics import rays, sees
from visioncal.vision.targets import extent_m, is_seen_in_part

Motion: TypeAlias = Literal["free", "one_axis", "translation"]

# Distance of the print from the image's edge in complete views [px].
MARGIN_PX = 12.0
# Share of corners that a view cut by the image's edge still shows.
LEAST_SHARE = 0.6


@dataclass(frozen=True, eq=False, kw_only=True)
class Viewpoints:
    """Range of viewpoints of a camera towards a board."""

    camera: Camera  # Optics of the camera.
    board: Sheet  # The board.
    distance_m: tuple[float, float]  # Range of the camera's distance from the board's centre [m].
    # Range of the angle between view and board normal [rad].
    tilt_rad: tuple[float, float] = (0.1, 0.75)
    roll_rad: float = 1.3  # Largest rotation about the optical axis, either way [rad].
    # `free`; or, degenerate for hand-eye calibration, rotation about `one_axis` only, or
    # `translation` only.
    motion: Motion = "free"
    # Share of views in which the image's edge may cut a board that can be detected in part.
    cut_views: float = 0.1

    def mean(self) -> FloatArray:
        """Central viewpoint: without tilt, at the mean distance, (4, 4)."""
        middle = 0.5 * sum(self.distance_m)
        return compose(np.eye(3), np.array([0.0, 0.0, middle]) - centre_m(self.board))

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draws views, and keeps those with the board inside the image.

        Returns:
            (k, 4, 4) `cam_from_target`, k <= count.
        """
        rotation = self._rotations(count, rng)
        distance = rng.uniform(*self.distance_m, size=count)
        # Largest share of views that may be cut.
        share = self.cut_views if is_seen_in_part(self.board.target) else 0
        may_be_cut = rng.random(count) < share
        reach = np.where(may_be_cut, 0.4, 0.3)[:, None]
        aim = (0.5 + reach * rng.uniform(-1.0, 1.0, size=(count, 2))) * np.array(
            self.camera.resolution
        )
        centre = distance[:, None] * rays(self.camera, aim)
        cam_from_target = compose(rotation, centre - rotation @ centre_m(self.board))
        seen = sees(self.camera, apply(cam_from_target, corners_m(self.board)), MARGIN_PX)
        fits = self.shows(cam_from_target) | (may_be_cut & (seen.mean(axis=1) > LEAST_SHARE))
        return np.asarray(cam_from_target[fits])

    def shows(self, cam_from_target: FloatArray) -> Mask:
        """(m,) whether all of the board is inside the image at (m, 4, 4) poses."""
        places = apply(cam_from_target, outline_m(self.board, 0.0))
        return np.asarray(sees(self.camera, places, MARGIN_PX).all(axis=1))

    def _rotations(self, count: int, rng: np.random.Generator) -> FloatArray:
        """(count, 3, 3) rotations: tilt about an axis in the board's plane, then roll."""
        low, high = self.tilt_rad
        # Uniform on the spherical cap: the cosine of the tilt is uniform.
        tilt = np.arccos(rng.uniform(np.cos(high), np.cos(low), size=count))
        azimuth = rng.uniform(-np.pi, np.pi, size=count)
        roll = rng.uniform(-self.roll_rad, self.roll_rad, size=count)
        if self.motion != "free":
            tilt, azimuth = np.full(count, 0.5 * (low + high)), np.full(count, 0.6)
        axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
        tilted = Rotation.from_rotvec(tilt[:, None] * axis)
        along_z = roll[:, None] * np.array([0.0, 0.0, 1.0])
        if self.motion == "translation":
            rotations = tilted
        elif self.motion == "one_axis":
            # Rotation about the board's normal, so that all relative rotations share that axis.
            rotations = tilted * Rotation.from_rotvec(along_z)
        else:
            rotations = Rotation.from_rotvec(along_z) * tilted
        return np.asarray(rotations.as_matrix(), dtype=float)


def looking_at(point: FloatArray, away: FloatArray, distance_m: float) -> FloatArray:
    """(4, 4) pose of an upright camera that looks along -`away` at a point, `distance_m` away."""
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-away, right), -away], axis=1)
    return compose(rotation, point + distance_m * away)


def filling_m(camera: Camera, board: Sheet) -> tuple[float, float]:
    """Smallest and largest distance at which a board fills a camera's image well [m]."""
    low, high = extent_m(board.target)
    focal, short_side = float(camera.matrix[0]), min(camera.resolution)
    full = focal * float(np.hypot(*(high - low))) / short_side
    return full / 1.15, full / 0.7
