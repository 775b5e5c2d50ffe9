"""Corners of images that the template refuses, against boards that are known."""

from dataclasses import replace

import numpy as np
import pytest
from support.boards import charuco, checkerboard
from support.marks import slow
from support.rendered import Shot, photograph

from visioncal.vision.dense import find_densely

CHECKERBOARD, CHARUCO = checkerboard(6, 5), charuco(6, 5)
SHOT = Shot(square_px=32, noise=2)


@pytest.mark.parametrize(
    ("target", "shot"),
    [
        slow(CHECKERBOARD, replace(SHOT, motion_px=20)),
        (CHECKERBOARD, replace(SHOT, disc_px=9, uneven=0.3)),
        slow(CHARUCO, replace(SHOT, disc_px=8)),
    ],
)
def test_corners_of_smeared_images_are_within_their_sigmas(target, shot):
    image, truth = photograph(target, shot, 1)
    found = find_densely(image, target)
    assert len(found.ids) >= 0.8 * len(truth)
    errors = found.px - truth[found.ids]
    # What the Gaussian leaves of a disc counts as noise, which widens the sigmas; it may double
    # them. Of a chi-square with 32 degrees of freedom or more, 1.9 is above 99.7 %.
    assert np.mean((errors / found.sigma_px[:, None]) ** 2) < 1.9
    # Half a percent of a square, 0.15 mm of 30, is what a pose of 20 corners can use.
    assert np.median(found.sigma_px) < 0.005 * shot.square_px
    moved = float(np.hypot(*found.motion_px))
    if shot.motion_px:
        assert moved == pytest.approx(shot.motion_px, abs=1.5)
    else:
        # A disc's sigma along an axis is half its radius; no edge is wider than the radius.
        assert 0.4 * shot.disc_px < found.width_px < shot.disc_px


@pytest.mark.slow
def test_another_board_or_none_gives_no_corners():
    image = photograph(CHARUCO, replace(SHOT, motion_px=14), 1)[0]
    assert find_densely(image, charuco(6, 5, "DICT_4X4_50")) is None
    assert find_densely(image, charuco(7, 5)) is None
    noise = np.random.default_rng(0).normal(128, 20, (300, 400)).clip(0, 255)
    assert find_densely(noise.astype(np.uint8), CHARUCO) is None
