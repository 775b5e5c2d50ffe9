"""`calibrate --dense`: views that it brings in, and what it leaves alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cells import session_of
from support.rendered import disc_kernel, line_kernel

from visioncal.calibration.run import run
from visioncal.core.transforms import invert, log
from visioncal.session import MemoryImages, Session
from visioncal.simulation import CellOptions, SimulatedCell, prepare_scene, simulate
from visioncal.simulation.boards import BOARDS
from visioncal.simulation.optics import wide_camera
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


pytestmark = pytest.mark.slow
CAMERA = wide_camera()
# A quarter of the pixels.
OPTIONS = CellOptions(
    views=8,
    seed=3,
    blur_px=0.5,
    target=BOARDS["checkerboard"],
    camera=replace(CAMERA, resolution=(640, 400), matrix=CAMERA.matrix / 2),
)


@pytest.fixture(scope="module")
def cell():
    return simulate(OPTIONS)


@pytest.fixture(scope="module")
def session(cell):
    """Five sharp images; the others are smeared by 18 px, most of a square."""
    sharp, moved = smeared(cell), smeared(cell, motion_px=18.0)
    files = {
        view.image: (sharp if view.number < 5 else moved).images.read(view.image)
        for view in sharp.views
    }
    return replace(sharp, images=MemoryImages(files))


def used(calibration):
    return {view.view for view in calibration.views if view.used}


@pytest.fixture(scope="module")
def both(session):
    return run(session).calibration, run(session, dense=True).calibration


def test_refused_views_come_in_and_x_stays_within_its_sigma(cell, both):
    plain, dense = both
    assert used(plain) == set(range(5))
    assert used(dense) == set(range(8))
    edge, known = dense.edges["flange_from_cam"], plain.edges["flange_from_cam"]
    true = cell.transforms["flange_from_cam"]
    error = log(invert(true) @ edge.matrix)
    # Beyond 16.8 is a chi-square of six degrees of freedom in 1 % of sessions.
    assert error @ np.linalg.solve(edge.covariance, error) < 16.8
    assert np.trace(edge.covariance[3:, 3:]) < np.trace(known.covariance[3:, 3:])
    assert any("--dense" in reason for reason in dense.verdict.reasons)


def test_sharp_images_keep_the_corners_of_the_template(session, both):
    sharp = session.only(sorted(range(5)))
    found = run(sharp, dense=True).calibration
    np.testing.assert_array_equal(
        found.edges["flange_from_cam"].matrix, both[0].edges["flange_from_cam"].matrix
    )
