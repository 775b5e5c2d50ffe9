"""Corners by all pixels around them, against boards that are known."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from support.boards import charuco, checkerboard
from support.rendered import Shot, photograph

from visioncal.core.errors import DataError
from visioncal.core.types import Camera
from visioncal.vision.dense import library
from visioncal.vision.dense.blur import Blur, transfer
from visioncal.vision.dense.board_rendering import MIDDLE, Print, render_board
from visioncal.vision.dense.fit import fit_corners
from visioncal.vision.finders.template import refine

CHECKERBOARD, CHARUCO = checkerboard(6, 5), charuco(6, 5)
SHOT = Shot(square_px=32, noise=2)


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="torch is missing: pip install '.[dense]'")


def fitted(target, shot, seed=1, **options):
    """The picture's true corners, those by the template, and those by all pixels."""
    image, truth = photograph(target, shot, seed)
    ids = np.arange(len(truth))
    seen = refine(image, target, ids, truth + 0.2)
    assert set(seen.reasons) == {""}
    return truth, seen, fit_corners(image, target, ids, seen.px, seen.blur_px, **options)


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize(
    ("target", "shot"),
    [
        (CHECKERBOARD, SHOT),
        (CHECKERBOARD, replace(SHOT, disc_px=4, noise=8)),
        (CHECKERBOARD, replace(SHOT, square_px=14, motion_px=12)),
        (CHECKERBOARD, replace(SHOT, square_px=9, disc_px=4)),
        (CHECKERBOARD, replace(SHOT, gamma=0.45)),
        (CHECKERBOARD, replace(SHOT, uneven=0.5)),
        (CHARUCO, SHOT),
        (CHARUCO, replace(SHOT, motion_px=8)),
    ],
)
def test_corners_are_more_exact_than_the_template_has_them(target, shot):
    truth, seen, found = fitted(target, shot)
    assert found.fitted.all()
    # The same picture, and so the same noise: where it alone is left, a twentieth is a gain.
    assert rms(found.px - truth) < 0.95 * rms(seen.px - truth)
    scaled = (found.px - truth) / found.sigma_px[:, None]
    # 40 to 60 coordinates tell a mean square to a fifth.
    assert 0.5 < np.mean(scaled**2) < 1.7
    assert found.noise == pytest.approx(shot.noise, rel=0.1)


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("target", [CHECKERBOARD, CHARUCO])
def test_motion_is_measured_with_its_direction(target):
    image, truth = photograph(target, replace(SHOT, noise=1), 2)
    along = np.deg2rad(30.0)
    steps = np.linspace(-4, 4, 33)[:, None] * [np.cos(along), np.sin(along)]
    # Of one exposure: the mean of the picture at places a quarter of a pixel apart.
    height, width = image.shape
    wu, wv = np.fft.rfftfreq(width), np.fft.fftfreq(height)[:, None]
    covariance = sum(np.exp(-2j * np.pi * (wu * u + wv * v)) for u, v in steps) / len(steps)
    moved = np.fft.irfft2(np.fft.rfft2(image - 210.0) * covariance, s=image.shape) + 210.0
    moved = np.clip(np.rint(moved), 0, 255).astype(np.uint8)
    ids = np.arange(len(truth))
    seen = refine(moved, target, ids, truth)
    found = fit_corners(moved, target, ids, seen.px, seen.blur_px)
    assert found.blur.length_px == pytest.approx(8.25, abs=0.3)
    assert found.blur.direction_deg == pytest.approx(30.0, abs=3.0)
    assert found.blur.cause == "motion"


@pytest.mark.usefixtures("torch")
def test_defocus_is_measured():
    found = fitted(CHECKERBOARD, replace(SHOT, disc_px=3))[2]
    assert found.blur.disc_px == pytest.approx(3.0, abs=0.2)
    assert found.blur.cause == "focus"
    assert fitted(CHECKERBOARD, SHOT)[2].blur.cause == ""


@pytest.mark.usefixtures("torch")
def test_smoothing_helps_where_neighbours_are_not_independent():
    shot = replace(SHOT, square_px=20, jpeg=60)
    truth, _, plain = fitted(CHECKERBOARD, shot)
    smooth = fitted(CHECKERBOARD, shot, smooth_px=0.7)[2]
    assert rms(smooth.px - truth) < 0.85 * rms(plain.px - truth)
    # It shows without the truth.
    assert smooth.scatter_px < 0.9 * plain.scatter_px
    sharp, smoothed = (fitted(CHECKERBOARD, SHOT, smooth_px=value)[2] for value in (0.0, 0.7))
    # The noise is that before the smoothing.
    assert smoothed.noise == pytest.approx(sharp.noise, rel=0.1)


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("target", [CHECKERBOARD, CHARUCO])
def test_what_covers_a_corner_leaves_it_out(target):
    image, truth = photograph(target, replace(SHOT, square_px=40), 1)
    u, v = np.rint(truth[7]).astype(int)
    image[v - 3 : v + 30, u - 4 : u + 30] = 120
    start = truth + np.random.default_rng(0).normal(0.0, 0.05, truth.shape)
    found = fit_corners(image, target, np.arange(len(truth)), start, np.full(2, 0.5))
    assert not found.fitted[7]
    assert np.isnan(found.covariance[7]).all()
    # The cover reaches into the patches of three others at most.
    assert found.fitted.sum() >= len(truth) - 4
    assert np.median(np.abs(found.px - truth)[found.fitted]) < 0.004


@pytest.mark.usefixtures("torch")
def test_too_few_corners_or_one_row_give_none():
    image, truth = photograph(CHECKERBOARD, SHOT, 1)
    for ids in (np.arange(5), np.arange(6)):
        assert fit_corners(image, CHECKERBOARD, ids, truth[ids], np.full(2, 0.5)) is None


def explained(target, shot, shift_px=0.0):
    """The picture, its true corners, and how far corners moved by so much explain it."""
    image, truth = photograph(target, shot, 1)
    ids = np.arange(len(truth))
    seen = refine(image, target, ids, truth)
    found = fit_corners(image, target, ids, seen.px, seen.blur_px)
    # The lens of these pictures is no camera's; what bends them is left to the map.
    size = image.shape[::-1]
    camera = Camera("brown", size, np.array([1300.0, 1300.0, *np.array(size) / 2]), np.zeros(5))
    px = truth + np.array([shift_px, 0.0])
    return image, truth, render_board(image, target, ids, px, camera, found.blur, found.tone)


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("target", [CHECKERBOARD, CHARUCO])
@pytest.mark.parametrize("blurred", [{}, {"disc_px": 3}, {"motion_px": 6}])
def test_an_image_is_explained_up_to_its_noise(target, blurred):
    image, truth, found = explained(target, replace(SHOT, uneven=0.3, **blurred))
    # Markers have cells of three pixels, which both sides draw a little otherwise when sharp.
    assert found.difference_rms == pytest.approx(2.0, rel=0.2)
    u, v = np.rint(truth[0]).astype(int)
    near = (slice(v - 5, v + 6), slice(u - 5, u + 6))
    assert np.abs(found.rendered[near].astype(float) - image[near]).max() < 12
    # Around the board, the image is shown as it is, and nothing is said to be unexplained.
    np.testing.assert_array_equal(found.rendered[0], image[0])
    assert set(found.difference[0].tolist()) == {MIDDLE}


@pytest.mark.usefixtures("torch")
def test_a_board_that_is_elsewhere_is_not_explained():
    right, wrong = (explained(CHARUCO, SHOT, value)[2] for value in (0.0, 0.3))
    assert wrong.difference_rms > 3 * right.difference_rms
    assert np.std(wrong.difference.astype(float)) > 2 * np.std(right.difference.astype(float))
    # Predicted far outside of the image, or nowhere at all.
    for shift in (2000.0, np.nan):
        assert explained(CHARUCO, SHOT, shift)[2] is None


@pytest.mark.usefixtures("torch")
def test_corners_that_scatter_more_than_before_are_none():
    image, truth = photograph(CHECKERBOARD, replace(SHOT, noise=8), 1)
    ids, widths = np.arange(len(truth)), np.full(2, 0.5)
    # Known from elsewhere, they are as exact as no image has them.
    assert fit_corners(image, CHECKERBOARD, ids, truth, widths) is None
    rough = truth + np.random.default_rng(0).normal(0.0, 0.05, truth.shape)
    assert fit_corners(image, CHECKERBOARD, ids, rough, widths) is not None


def test_derivatives_of_the_blur(torch):
    wu = torch.linspace(-6, 6, 7, dtype=torch.float64)
    wv = torch.linspace(-5, 6, 6, dtype=torch.float64)[:, None]
    start = np.array([0.7, 1.5, 2.0, -1.0])
    value, *jacobian = transfer(Blur.of(start), wu, wv)
    assert float(value.abs().max()) <= 1.0
    step = 1e-5
    for slope, change in zip(jacobian, step * np.eye(4), strict=True):
        ends = [transfer(Blur.of(start + value), wu, wv)[0] for value in (change, -change)]
        # torch's Bessel functions are good to 5e-7.
        assert float(((ends[0] - ends[1]) / (2 * step) - slope).abs().max()) < 1e-6


def test_a_print_is_drawn_as_its_cells_are(torch):
    printed = Print.of(CHARUCO)
    x, y = (torch.tensor((array[1:] + array[:-1]) / 2) for array in (printed.x, printed.y))
    narrow = torch.tensor(1e-3, dtype=torch.float64)
    drawn = printed.drawn(*torch.meshgrid(x, y, indexing="xy"), narrow, narrow)
    np.testing.assert_array_equal(drawn.numpy() > 0.5, printed.light[1:-1, 1:-1])
    line = torch.tensor([printed.x[0]])
    outside = torch.tensor([printed.y[0] - 0.5])
    assert float(printed.drawn(line - 0.5, outside, narrow, narrow)) == 1.0


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(DataError, match="--dense needs torch") as caught:
        library.chosen_device("auto")
    assert "pip install 'visioncal[dense]'" in caught.value.next_step


def test_a_device_that_is_not_there_is_refused(torch, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert library.chosen_device("auto") == "cpu"
    with pytest.raises(DataError, match="no GPU"):
        library.chosen_device("cuda")
    with pytest.raises(DataError, match="not one of auto, cpu, cuda"):
        library.chosen_device("tpu")
