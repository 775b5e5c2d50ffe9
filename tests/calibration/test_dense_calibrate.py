"""`calibrate --dense`: views that it brings in, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import pytest
from support.smeared import smeared

from visioncal.calibration.run import run
from visioncal.core.transforms import invert, log
from visioncal.session import MemoryImages
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.boards import BOARDS
from visioncal.simulation.optics import wide_camera

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
