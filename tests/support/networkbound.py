"""The Cramer-Rao bound of the frames of a simulated cell, by code of its own.

Unknown are where every frame hangs but one base, each flange's error at every stop (with its
variance as a prior), every board's size (likewise), and each lens that the session does not state.
Derivatives are central differences of the simulation's projection, which shares nothing with the
application's.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import exp, invert
from visioncal.core.types import FloatArray
from visioncal.session import frame_name
from visioncal.simulation import SimulatedCell, SimulatedSight
from visioncal.simulation.boards import corners_m
from visioncal.simulation.optics import project

# Small enough for central differences to be exact to 1e-8, large enough for rounding.
_STEP = 1e-5
# Focal lengths and centres count in thousands of pixels, so that one step suits all.
_THOUSAND = 1e3


@dataclass(frozen=True, eq=False)
class Bound:
    """The least covariance of the frames, by names that hang in their places.

    Attributes:
        frames: The frames, six unknowns each.
        covariance: (6 f, 6 f) of (rotation, translation) right perturbations.
    """

    frames: tuple[str, ...]
    covariance: FloatArray

    def of(self, frame: str) -> FloatArray:
        """(6, 6) of one frame."""
        at = 6 * self.frames.index(frame)
        return self.covariance[at : at + 6, at : at + 6]


def network_bound(cell: SimulatedCell, reference: str = "base_a", *, sizes: bool = True) -> Bound:
    """Computes the bound; `reference` stands for the cell.

    Args:
        cell: The cell.
        reference: The base that stands for it.
        sizes: Whether boards' sizes are unknown; else they are as stated.
    """
    frames = tuple(mounting for mounting in cell.mountings if mounting != reference)
    places = {name: slice(6 * at, 6 * at + 6) for at, name in enumerate(frames)}
    size = 6 * len(frames)
    boards = cell.layout.boards if sizes else ()
    for board in boards:
        places[f"size {board.name}"] = slice(size, size + 1)
        size += 1
    for camera in cell.layout.cameras:
        if not camera.state_intrinsics:
            count = 4 + len(camera.camera.distortion)
            places[f"lens {camera.name}"] = slice(size, size + count)
            size += count
    information = np.zeros((size, size))
    for board in boards:
        at = places[f"size {board.name}"].start
        target = board.target
        information[at, at] = (target.square_m / target.square_sigma_m) ** 2
    robots = [robot.name for robot in cell.layout.robots]
    sigmas = np.concatenate([robot.sigma for robot in cell.layout.robots])
    for stop in range(-1, cell.layout.stops):
        between = np.zeros((len(sigmas), size))
        own = np.diag(sigmas**-2.0)
        for sight in (sight for sight in cell.sights if sight.stop == stop):
            jacobian, slack = _jacobian(cell, sight, places, robots, size)
            information += jacobian.T @ jacobian
            between += slack.T @ jacobian
            own += slack.T @ slack
        information -= between.T @ np.linalg.solve(own, between)
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return Bound(frames, covariance[: 6 * len(frames), : 6 * len(frames)])


def _jacobian(
    cell: SimulatedCell,
    sight: SimulatedSight,
    places: Mapping[str, slice],
    robots: list[str],
    size: int,
) -> tuple[FloatArray, FloatArray]:
    """How one sight's pixels move with the unknowns and the flanges, in units of their noise."""
    camera, board = frame_name("camera", sight.camera), frame_name("target", sight.board)
    keys = [camera, board, f"size {sight.board}", f"lens {sight.camera}"]
    carriers = [cell.robot_of(camera), cell.robot_of(board)]
    keys += [frame_name("base", carrier) for carrier in carriers if carrier is not None]
    keys = [key for key in keys if key in places]
    if sight.stop < 0:
        # Of its lens alone: the board was anywhere.
        keys = [key for key in keys if key.startswith(("size", "lens"))]
    jacobian, slack = np.zeros((2 * len(sight.exact.ids), size)), []
    for key in keys:
        width = places[key].stop - places[key].start
        jacobian[:, places[key]] = _differences(cell, sight, key, width)
    for robot in robots:
        mine = robot in carriers and sight.stop >= 0
        slack.append(
            _differences(cell, sight, f"flange {robot}", 6)
            if mine
            else np.zeros((len(jacobian), 6))
        )
    every = np.concatenate([jacobian, *slack], axis=1) / cell.options.pixel_sigma_px
    if sight.stop < 0:
        free = _differences(cell, sight, "pose", 6) / cell.options.pixel_sigma_px
        every = every - free @ np.linalg.lstsq(free, every, rcond=None)[0]
    return every[:, :size], every[:, size:]


def _differences(cell: SimulatedCell, sight: SimulatedSight, key: str, width: int) -> FloatArray:
    steps = _STEP * np.eye(width)
    return np.stack(
        [
            (_pixels(cell, sight, key, step) - _pixels(cell, sight, key, -step)) / (2 * _STEP)
            for step in steps
        ],
        axis=1,
    )


def _pixels(cell: SimulatedCell, sight: SimulatedSight, key: str, change: FloatArray) -> FloatArray:
    """Flat pixels of a sight when one thing changes."""
    camera = cell.camera(sight.camera).camera
    sheet = cell.board(sight.board)
    kind, _, name = key.partition(" ")
    if kind == "lens" and name == sight.camera:
        matrix = camera.matrix + _THOUSAND * change[:4]
        camera = replace(camera, matrix=matrix, distortion=camera.distortion + change[4:])
    scale = 1.0 + (float(change[0]) if kind == "size" else 0.0)
    points = scale * corners_m(sheet)[sight.exact.ids]
    if sight.stop < 0:
        pose = sight.cam_from_target @ (exp(change) if kind == "pose" else np.eye(4))
    else:
        frames = frame_name("camera", sight.camera), frame_name("target", sight.board)
        pose = invert(_place(cell, sight.stop, frames[0], key, change)) @ _place(
            cell, sight.stop, frames[1], key, change
        )
    return project(camera, points @ pose[:3, :3].T + pose[:3, 3]).ravel()


def _place(cell: SimulatedCell, stop: int, frame: str, key: str, change: FloatArray) -> FloatArray:
    """(4, 4) `cell_from_frame` when one thing changes."""
    place = cell.mountings[frame] @ (exp(change) if key == frame else np.eye(4))
    robot = cell.robot_of(frame)
    if robot is None:
        return place
    base = frame_name("base", robot)
    flange = cell.robots[robot].true_base_from_flange[stop]
    if key == f"flange {robot}":
        flange = flange @ exp(change)
    return (
        cell.mountings.get(base, np.eye(4))
        @ (exp(change) if key == base else np.eye(4))
        @ flange
        @ place
    )
