"""Flat prints registered to all pixels: poses, covariances and derivatives against the truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import seeds
from support.printed import PICTURES, Look, photographed, pose_at

from visioncal.core.types import Target
from visioncal.simulation import CAMERAS
from visioncal.vision.camera import project
from visioncal.vision.dense import drawn_print
from visioncal.vision.patches import places_of
from visioncal.vision.register.fit import register
from visioncal.vision.register.image_model import BLOCK_PX, Level, Print, Seen

WIDE = CAMERAS["wide"]
# A quarter of the pixels.
CAMERA = replace(WIDE, resolution=(640, 400), matrix=WIDE.matrix / 2)
WIDTH_M = 0.3


def flat_print(picture):
    return Print(picture.astype(np.float32) / 255, WIDTH_M / picture.shape[1], np.zeros(2))


def view(seed, look, kind="poster", tilt_deg=40.0, off=(0.5, 0.1)):
    """A print, its picture, its pose and a start that is off by so many mm and deg."""
    rng = np.random.default_rng(seed)
    picture = PICTURES[kind](seed)
    flat = flat_print(picture)
    middle = np.append(flat.size_m / 2, 0.0)
    pose = pose_at(rng.uniform(0.4, 0.55), rng.uniform(0, tilt_deg), middle, rng)
    image = photographed(picture, WIDTH_M, CAMERA, pose, look, seed)
    start = pose.copy()
    away = rng.normal(0, 1, (2, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    turn = Rotation.from_rotvec(np.deg2rad(off[1]) * away[0]).as_matrix()
    # About the middle, as a robot's flange turns what it carries.
    at = pose[:3, :3] @ middle + pose[:3, 3]
    start[:3, :3] = turn @ pose[:3, :3]
    start[:3, 3] = at + 1e-3 * off[0] * away[1] - start[:3, :3] @ middle
    return flat, image, pose, start


def error(found, pose):
    """(6,) right perturbation from what was found to the truth, rotation first."""
    off = np.linalg.inv(found.seen.cam_from_target) @ pose
    return np.concatenate([Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]])


def squared(found, pose):
    """Squared error over covariance, per component of the pose."""
    off = error(found, pose)
    return off @ np.linalg.solve(found.covariance[:6, :6], off) / 6


def away(found, pose, flat):
    """Distance of the print's middle [mm] and turn [deg] from the truth."""
    middle = np.append(flat.size_m / 2, 1.0).tolist()
    middle = np.array([*middle[:2], 0.0, 1.0])
    off = (found.seen.cam_from_target - pose) @ middle
    return 1e3 * np.linalg.norm(off[:3]), np.rad2deg(np.linalg.norm(error(found, pose)[:3]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("disc_px", "twist"),
    [(0.0, ()), (6.0, ()), (0.0, (0.004, 0.002, 0.001, 0.002, 0.001, 0.004))],
)
def test_derivatives_are_those_of_differences(disc_px, twist):
    flat, image, pose, _ = view(1, Look())
    moving = bool(twist)
    lens = np.array([1.0, 0.5, -0.5, 0.001])
    seen = Seen(pose, 3.2, disc_px, np.array(twist or [0.0] * 6), lens)
    level = Level.of(image, 2, flat, CAMERA, seen, len(lens))
    drawn = level.rendered(flat, seen, moving=moving)
    # Some tenths of a pixel, beside which the sampling of the print is exact.
    steps = [2e-4] * 3 + [4e-4] * 3 + [0.1] + [0.2] * bool(disc_px)
    steps += [8e-4] * 6 * moving + [0.5, 0.2, 0.2, 8e-3]
    size = BLOCK_PX
    shares = drawn.shares.repeat(size, axis=2).repeat(size, axis=3)
    assert shares.shape == (len(drawn.slopes), len(steps), *level.image.shape)
    inner = ((drawn.places_m > 0.03) & (drawn.places_m < flat.size_m[:, None, None] - 0.03)).all(0)
    for at, step in enumerate(steps):
        change = np.zeros(len(steps))
        change[at] = step
        ends = (level.rendered(flat, seen.moved(way * change, moving), moving=moving).light
                for way in (1, -1))  # fmt: skip
        numeric = np.subtract(*ends)[inner] / (2 * step)
        closed = np.sum(drawn.slopes * shares[:, at], axis=0)[inner]
        # Slopes of places vary within a blur, and differences over two steps are no slopes: some
        # percent, most for motions along the axis. A wrong sign, factor or axis is off by 1.
        assert numeric @ closed / (closed @ closed) == pytest.approx(1.0, abs=0.1), at
        assert numeric @ closed > 0.93 * np.linalg.norm(numeric) * np.linalg.norm(closed), at


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["poster", "board"])
@pytest.mark.parametrize("views", seeds(4, 8))
def test_covariances_of_poses_are_true_where_half_of_the_views_are_covered(kind, views):
    squares = []
    for seed in views:
        flat, image, pose, start = view(seed, Look(covered=0.15 * (seed % 2)), kind)
        found = register(image, flat, CAMERA, Seen(start), factors=(2, 1))
        assert np.all(np.less(away(found, pose, flat), (0.2, 0.1)))
        squares.append(squared(found, pose))
    # Of 24 components' mean 97 %, of 48 99.9 % are within; by pixels alone it is 4 to 26 times off.
    assert 0.5 < np.mean(squares) < 2.0


@pytest.mark.slow
def test_prints_whose_ends_are_at_other_distances_bias_no_pose():
    # A pixel sees 1.5 times more of the far end than of the near one.
    squares, picture = [], PICTURES["label"](0)
    flat = flat_print(picture)
    middle = np.append(flat.size_m / 2, 0.0)
    for seed in range(3):
        pose = pose_at(0.42, 35.0, middle, np.random.default_rng(seed))
        image = photographed(picture, WIDTH_M, WIDE, pose, Look(), seed)
        squares.append(squared(register(image, flat, WIDE, Seen(pose), factors=(2, 1)), pose))
    # Of 18 components' mean, 99 % are below.
    assert np.mean(squares) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("views", seeds(2, 6))
def test_a_lens_that_is_off_counts_in_the_covariance(views):
    # By what a calibration of few views leaves: the pose is off by far more than its noise.
    sigma = np.array([0.4, 0.5, 0.5, 0.002])
    squares, plain = [], []
    for seed in views:
        flat, image, pose, start = view(seed, Look())
        draw = sigma * np.random.default_rng(seed).normal(size=4)
        matrix = CAMERA.matrix + draw[[0, 0, 1, 2]]
        lens = replace(CAMERA, matrix=matrix, distortion=CAMERA.distortion + draw[3] * np.eye(5)[0])
        found = register(image, flat, lens, Seen(start), lens_sigma=sigma, factors=(2, 1))
        squares.append(squared(found, pose))
        plain.append(squared(register(image, flat, lens, Seen(start), factors=(2, 1)), pose))
    assert 0.4 < np.mean(squares) < 2.0
    assert np.mean(plain) > 20.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "most"),
    [
        (Look(disc_px=5.0, covered=0.1), (0.1, 0.05)),
        (Look(twist=(0.007, -0.003, 0.002, 0.001, 0.002, 0.005)), (0.03, 0.02)),
    ],
)
@pytest.mark.parametrize("views", seeds(1, 2))
def test_blurred_prints_are_found_from_a_start_by_the_robot(look, most, views):
    for seed in views:
        flat, image, pose, start = view(seed, look, off=(1.0, 0.1))
        found = register(
            image, flat, CAMERA, Seen(start), moving=bool(look.twist), factors=(4, 2, 1), rough=True
        )
        # A pixel is a millimetre here.
        assert np.all(np.less(away(found, pose, flat), most))
        assert squared(found, pose) < 4.0
        if look.twist:
            # Turns and shifts of the print's middle go together; its direction has no sign.
            middle = flat.middle_at(pose)
            moved, true = (
                np.array(twist[:3]) + np.cross(twist[3:], middle)
                for twist in (found.seen.twist, look.twist)
            )
            np.testing.assert_allclose(moved[:2] * np.sign(moved[0]), true[:2], atol=1e-4)
        else:
            assert found.seen.disc_px == pytest.approx(look.disc_px, abs=0.7)


@pytest.mark.slow
@pytest.mark.parametrize(("lens_px", "within"), [(0.3, 0.1), (0.5, 0.02)])
@pytest.mark.parametrize("views", seeds(1, 2))
def test_the_blur_of_a_small_covered_board_is_found_from_sharper_and_wider_ones(
    lens_px, within, views
):
    target = Target("board", "charuco", 6, 4, 0.1 / 6, 1e-6, marker_m=0.0125,
                    dictionary="DICT_5X5_100")  # fmt: skip
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((6, 4), target.square_m, target.marker_m, words)
    paper_m = target.square_m / 2
    picture = np.pad(board.generateImage((1680, 1120)), 140, constant_values=255)
    for seed in (1 + view for view in views):
        rng = np.random.default_rng(seed)
        pose = pose_at(0.31, rng.uniform(0, 35), np.array([0.05, 0.033, 0.0]), rng)
        image = photographed(picture, 0.1 + 2 * paper_m, WIDE, pose,
                             Look(lens_px, covered=0.15), seed, (-paper_m, -paper_m))  # fmt: skip
        for start_px in (0.32, 2.0):
            found = register(image, drawn_print(target, 160), WIDE, Seen(pose, start_px),
                             factors=(2, 1))  # fmt: skip
            # The sensor's pixels are boxes, which sharper lenses show to be no Gaussian. A kernel
            # that hardly changes with its sigma stays too narrow, and squares are 2.6 and 6.4.
            assert found.seen.gauss_px == pytest.approx(np.hypot(lens_px, 12**-0.5), abs=within)
            assert squared(found, pose) < 2.0


@pytest.mark.slow
def test_a_slanted_label_is_drawn_as_it_is_seen():
    # A Gaussian on the print, as wide along as across, and kernels that blur what is finest too
    # little leave 0.008 of the grey levels' range at this tilt.
    picture = PICTURES["label"](0)
    flat = Print.of_picture(picture, 0.3)
    half = replace(WIDE, resolution=(640, 400), matrix=CAMERAS["wide"].matrix / 2)
    pose = pose_at(0.5, 50.0, np.array([0.15, 0.1, 0.0]), np.random.default_rng(1), off=0.0)
    image = photographed(picture, 0.3, half, pose, Look(noise=0.3, light=0.0))
    found = register(image, flat, half, Seen(pose), factors=(1,))
    # Of rounding and noise, 0.0016; and by the pixels' boxes.
    rest = found.look.residuals[found.look.weights > 0.5]
    assert np.sqrt(np.mean(rest**2)) < 0.005
    assert found.seen.gauss_px == pytest.approx(np.hypot(0.5, 12**-0.5), abs=0.015)


def test_too_small_a_part_of_a_print_is_not_registered():
    flat, image, pose, _ = view(0, Look())
    outside = pose.copy()
    outside[0, 3] += 2.0
    assert register(image, flat, CAMERA, Seen(outside), factors=(2,)) is None
    assert register(np.zeros_like(image), flat, CAMERA, Seen(pose), factors=(2,)) is None


@pytest.mark.parametrize("views", seeds(1, 2))
def test_places_are_within_their_sigmas_whatever_the_lens_does(views):
    # A lens that is far from the one assumed bends no patch, as its columns and shifts take it.
    for seed in views:
        flat, image, pose, start = view(seed, Look(covered=0.15 * seed))
        matrix, wrong = 1.03 * CAMERA.matrix, np.array([0.0, 0.0, 0.0, 0.0, 0.0])
        lens = replace(CAMERA, matrix=matrix, distortion=wrong)
        sigma = np.array([20.0, 20.0, 20.0, 0.2])
        found = register(image, flat, lens, Seen(start), lens_sigma=sigma, factors=(2, 1))
        columns = (np.arange(12) + 0.5) * WIDTH_M / 12
        points = np.stack(np.meshgrid(columns, columns[:9]), axis=-1).reshape(-1, 2)
        points = np.pad(points, ((0, 0), (0, 1)))
        ids, px, sigma_px = places_of(found, points, WIDTH_M / 24)
        assert len(ids) > 50
        off = px - project(CAMERA, points[ids] @ pose[:3, :3].T + pose[:3, 3])
        # Of 100 coordinates or more. Bent images leave 10 and more; where the shifts by the wrong
        # lens counted as noise, a quarter was left.
        assert 0.5 < np.mean((off / sigma_px[:, None]) ** 2) < 1.6
        assert np.median(sigma_px) < 0.05
