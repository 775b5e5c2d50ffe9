"""The Cramer-Rao bound of a simulated cell, by code of its own.

Unknown are both edges, the flange's error at every view (with its variance as a prior), and the
lens where the session does not state it; the board is as stated. Derivatives are central
differences of the simulation's projection, which shares nothing with the application's.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from visioncal.simulation import Cell
from visioncal.simulation.boards import Sheet, corners_m
from visioncal.simulation.optics import project
from visioncal.transforms import exp, invert
from visioncal.types import FloatArray

# Small enough for central differences to be exact to 1e-8, large enough for rounding.
_STEP = 1e-5


def edge_bound(cell: Cell, views: Sequence[int] | None = None) -> FloatArray:
    """Least covariance (12, 12) of x and z (rotation, translation; right perturbations).

    Args:
        cell: The cell.
        views: Those that count; all where None.
    """
    options = cell.options
    lens = 0 if options.state_intrinsics else 4 + len(options.camera.distortion)
    shared = 12 + lens
    information = np.zeros((shared, shared))
    prior = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3) ** -2.0
    for at in range(len(cell.corners)) if views is None else views:
        slope = (
            _slopes(lambda it, at=at: _pixels(cell, at, it), shared + 6) / options.pixel_sigma_px
        )
        by_shared, by_slack = slope[:, :shared], slope[:, shared:]
        between = by_slack.T @ by_shared
        own = by_slack.T @ by_slack + np.diag(prior)
        information += by_shared.T @ by_shared - between.T @ np.linalg.solve(own, between)
    scale = 1.0 / np.sqrt(np.diag(information))
    scaled = np.linalg.inv(information * np.outer(scale, scale))
    return np.asarray((scaled * np.outer(scale, scale))[:12, :12])


def _slopes(function: Callable[[FloatArray], FloatArray], size: int) -> FloatArray:
    steps = _STEP * np.eye(size)
    return np.stack([(function(it) - function(-it)) / (2 * _STEP) for it in steps], axis=1)


def _pixels(cell: Cell, view: int, change: FloatArray) -> FloatArray:
    """Flat pixels of one view's corners when x, z, lens and slack change by (18 + k,)."""
    camera = cell.options.camera
    if len(change) > 18:
        values = np.concatenate([camera.matrix, camera.distortion])
        # Focal length and centre in thousands of pixels, so that one step suits all.
        values = values + change[12:-6] * np.where(np.arange(len(values)) < 4, 1e3, 1.0)
        camera = replace(camera, matrix=values[:4], distortion=values[4:])
    x, z = cell.transforms.values()
    flange = cell.true_base_from_flange[view] @ exp(change[-6:])
    robot = flange if cell.options.mount == "eye-in-hand" else invert(flange)
    cam_from_target = invert(robot @ x @ exp(change[:6])) @ z @ exp(change[6:12])
    stated = Sheet(cell.options.target, 1.0, 0.0)
    points = corners_m(stated)[cell.corners[view].ids]
    return project(camera, points @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]).ravel()
