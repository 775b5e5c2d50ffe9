"""Sessions of simulated cells whose images are out of focus or smeared by motion."""

from dataclasses import replace

import cv2
import numpy as np
from support.cells import session_of
from support.rendered import disc_kernel, line_kernel

from visioncal.session import MemoryImages, Session
from visioncal.simulation import SimulatedCell, prepare_scene
from visioncal.simulation.render import developed, encode, light_on


def smeared(cell: SimulatedCell, *, disc_px: float = 0.0, motion_px: float = 0.0) -> Session:
    """The session of a cell, its images rendered, blurred further, and read out with noise.

    Args:
        cell: The cell, with its own small blur.
        disc_px: Radius of the disc of defocus.
        motion_px: How far everything moves during an exposure, in each image into a direction of
            its own.
    """
    scene, session, files = prepare_scene(cell), session_of(cell), {}
    for at, pose in enumerate(cell.cam_from_target):
        light = light_on(scene, pose)
        rng = np.random.default_rng([cell.options.seed, at])
        along = rng.uniform(0, np.pi)
        half = 0.5 * motion_px * np.array([np.cos(along), np.sin(along)])
        for kernel in (disc_kernel(disc_px), line_kernel(half)):
            if kernel.size > 1:
                light = cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE)
        files[session.views[at].image] = encode(developed(light, cell.options, rng), None)
    return replace(session, images=MemoryImages(files))
