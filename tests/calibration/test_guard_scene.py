"""A look without a board: what is registered, what is refused, when it alarms, the command."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.later import usual
from support.scenes import CAMERA, Scene, disturbed, turned

from visioncal.calibration.verification.scene_guard import SceneWatch, scene_plane
from visioncal.session import View
from visioncal.session.columns import POSE
from visioncal.vision.scene import register

TURNS_DEG = np.array([[0.02, 0.01, 0.0], [-0.1, 0.3, 0.4], [0.05, -0.06, -0.2]])
DOCUMENT = """schema = 1
name = "{}"
mount = "eye-in-hand"
target = "charuco_9x6_30mm"
[camera]
resolution = [480, 360]
"""
TABLE = "view,image,x_m,y_m,z_m,qx,qy,qz,qw\n"


@pytest.fixture(scope="module")
def lights():
    """The light of three scenes, before and after each has turned."""
    pairs = [(np.zeros(3), turn) for turn in TURNS_DEG]
    return [[Scene(seed).light(turned(at)) for at in pair] for seed, pair in enumerate(pairs)]


def test_turns_are_as_right_as_their_covariance_says(lights):
    """In other light; where parts move; with the camera's offset over a plane."""
    squares, rng = [], np.random.default_rng(0)
    for covered in (0.0, 0.3):
        for (before, now), turn in zip(lights, TURNS_DEG, strict=True):
            reference = disturbed(before, rng, covered, (1.0, 1.0))
            found = register(reference, disturbed(now, rng, covered), CAMERA)
            assert not found.reason
            error = found.turn - np.deg2rad(turn)
            # Hundredths of a pixel: hundreds of patches of a twentieth each.
            assert np.abs(error).max() * CAMERA.matrix[0] < 0.06
            squares.append(error @ np.linalg.solve(found.covariance, error))
    # The interval of a chi-square of 18 degrees of freedom that 1 in 1000 leaves.
    assert 4.4 < sum(squares) < 43.0
    offset, plane = np.array([0.002, -0.001, 0.003]), np.array([0.0, 0.0, 1.0, 1.0])
    poses = turned(np.zeros(3)), turned(TURNS_DEG[1], offset)
    images = [disturbed(Scene(3, flat=True).light(pose), rng) for pose in poses]
    found = register(*images, CAMERA, None, plane)
    error = found.turn - np.append(np.deg2rad(TURNS_DEG[1]), offset)
    # Of six degrees of freedom.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5


def test_images_that_say_nothing_are_named(lights):
    """None is a shift by accident."""
    rng = np.random.default_rng(1)
    reference = disturbed(lights[0][0], rng, 0.0, (1.0, 1.0))
    columns = np.arange(reference.shape[1])
    for words, image in (
        ("another scene", disturbed(lights[1][0], rng)),
        ("another scene", rng.integers(0, 255, reference.shape).astype(np.uint8)),
        ("blurred", cv2.GaussianBlur(reference, (0, 0), 8.0)),
        ("black, white or even", np.zeros_like(reference)),
        ("has 360 x 480 px, the camera 480 x 360", reference.T.copy()),
        ("stand still while", np.where(columns < 300, np.roll(reference, 7, axis=1), reference)),
    ):
        found = register(reference, image, CAMERA)
        assert words in found.reason
        assert np.isnan(found.turn).all()
    masked = register(reference, reference, CAMERA, np.zeros(reference.shape, bool))
    assert "too little texture" in masked.reason
    # What the mask leaves out may do anything.
    still = np.broadcast_to(columns >= 320, reference.shape)
    moving = np.where(still, reference, np.roll(reference, 7, axis=1))
    assert np.abs(register(reference, moving, CAMERA, still).shift_px).max() < 0.01


def test_no_single_look_is_an_alarm_and_shifts_are():
    rng = np.random.default_rng(2)
    watches = [SceneWatch(np.ones(3), 0.1, 10_000.0) for _ in range(3)]
    for look in range(60):
        noise = 0.1 * rng.normal(size=3)
        # Wrong by far once in ten looks, in any direction; shifted by 1 px from look 50 on.
        wrong = 50.0 * rng.normal(size=3) * (look % 10 == 9)
        shift = np.array([0.8, 0.0, 0.6]) * (look >= 50)
        for watch, other in zip(watches, (0.0, wrong, shift), strict=True):
            watch.update(look % 2, noise + other, 1e-4 * np.eye(3))
        assert [watch.holds for watch in watches] == [True, True, look < 52]


def test_the_boards_plane_is_where_it_stands():
    place = usual("eye-in-hand")
    pose = place.cell.robot.base_from_flange[4]
    numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    view = View(4, numbers=dict(zip(POSE, numbers, strict=True)))
    plane = scene_plane(place.calibration, view, "board")
    cam_from_target = place.cell.cam_from_target[4]
    # As well as it is calibrated.
    np.testing.assert_allclose(plane[:3], cam_from_target[:3, 2], atol=2e-3)
    np.testing.assert_allclose(plane[3], plane[:3] @ cam_from_target[:3, 3], atol=1e-3)


def test_of_the_command_line(tmp_path, lights):
    """A session is audited by poses that it shows again."""
    calibration = usual("eye-in-hand").calibration
    lens = replace(calibration.camera, camera=CAMERA, field=None)
    replace(calibration, camera=lens).save(tmp_path / "calibration.json")
    rng = np.random.default_rng(3)

    def audited(name, numbers, *options):
        """Answers to views of scenes at two poses; the camera has turned in those from 100 on."""
        folder, rows = tmp_path / name, TABLE
        (folder / "images").mkdir(parents=True)
        for at, number in enumerate(numbers):
            light = lights[1 if number % 2 else 2][number >= 100]
            cv2.imwrite(str(folder / f"images/{at}.png"), disturbed(light, rng, 0.1))
            rows += f"{at},images/{at}.png,{0.1 * (number % 2)},0,0.5,0,0,0,1\n"
        (folder / "views.csv").write_text(rows)
        (folder / "session.toml").write_text(DOCUMENT.format(name))
        done = visioncal("guard", "--scene", folder, "--against", tmp_path, *options)
        return done, [json.loads(line) for line in done.out.splitlines()]

    done, said = audited("still", [0, 1, 0, 1, 0, 1])
    assert [look["reference"] for look in done.good() and said] == [0, 1, 0, 1, 0, 1]
    done, said = audited("turned", [1, 1, 1, 101, 101, 101, 101], "--plane", "1200")
    assert (done.status, said[2]["holds"], said[-1]["holds"]) == (3, True, False)
    assert {"offset_mm", "sigma_mm"} < said[-1].keys()
    audited("few", [0, 1, 0])[0].refused("could be compared with an earlier one")
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((10, 20), 255, np.uint8))
    audited("masked", [0], "--mask", tmp_path / "mask.png")[0].refused("20 x 10 px")
    audited("flat", [0], "--plane", "floor")[0].refused("board, or a distance in mm")
