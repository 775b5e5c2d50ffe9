"""Cells that nobody chose: the truth of their generator, and all commands on some of them."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.fuzz.varied_arms import built_in, built_in_names, placed, table_arm, urdf_arm
from support.fuzz.varied_cells import cell, write
from support.fuzz.varied_images import Lens, Light, Print, draw
from support.fuzz.varied_walk import walk
from support.marks import slow

from visioncal.robot import load_robot

# Together they have every kind of board, lens, mount and robot, several boards, every role, images
# that are torn, odd names, and all commands; the first two are run each time.
FIRST = (12, 63)
OTHERS = (39, 28, 52, 13, 19, 21, 34, 36, 37, 38, 40, 43, 48, 54, 56, 59, 62, 64, 60026)
# Beyond this an error is no chance: in one cell of a million.
SURPRISING = 5.0
# Commands whose answer may be a bad verdict.
SAYS_NO = ("calibrate", "verify")


@pytest.mark.parametrize("seed", [*FIRST, *(slow(other) for other in OTHERS)])
def test_an_ordinary_cell_goes_through_all_commands(seed, tmp_path):
    done = walk(seed, tmp_path, whole=False)
    assert not [step.trace for step in done.steps if step.status == 1]
    assert not done.missing
    assert not done.warned
    for step in done.steps:
        assert step.status in (0, 2) or (step.status == 3 and step.command in SAYS_NO)
        assert step.status != 2 or step.message
    if done.verdict == "good":
        assert done.error.sigmas < SURPRISING, done.facts


def test_a_seed_is_always_the_same_cell(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    one, two = (write(cell(3), tmp_path / name).folder for name in ("a", "b"))
    files = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert len(files) > 8
    for file in files:
        assert (one / file).read_bytes() == (two / file).read_bytes()


def test_both_kinematics_agree(tmp_path):
    rng = np.random.default_rng(1)
    arms = [built_in(name) for name in built_in_names()]
    arms += [urdf_arm(rng, f"{index}.urdf", "it") for index in range(4)]
    arms += [table_arm(rng, f"{index}.toml", "it") for index in range(4)]
    for arm in arms:
        if arm.text:
            (tmp_path / arm.model).write_text(arm.text, encoding="utf-8")
        robot = load_robot(arm.model, arm.tip, tmp_path)
        q = rng.uniform(-1.0, 1.0, (5, len(arm.lower)))
        tips = arm.frames(q)[1]
        # Numbers are written with 16 digits, of metres and of limits with six of a turn.
        np.testing.assert_allclose(robot.base_from_flange(q), tips, atol=1e-9)
        # Joints near the wanted ones come back.
        found, reached = arm.reach(tips, q.mean(axis=0))
        np.testing.assert_allclose(arm.frames(found[reached])[1], tips[reached], atol=1e-7)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(
            "brown",
            (640, 480),
            np.array([700.0, 705, 322, 236]),
            np.array([-0.2, 0.05, 1e-3, 0, 0]),
        ),
        Lens(
            "fisheye", (640, 480), np.array([380.0, 381, 315, 242]), np.array([0.02, -0.01, 0, 0])
        ),
    ],
    ids=["brown", "fisheye"],
)
def test_corners_are_drawn_where_they_are(lens):
    board = Print({"kind": "checkerboard", "columns": 8, "rows": 5}, 0.03)
    turn = Rotation.from_rotvec([0.4, -0.3, 0.2])
    depth_m = 0.0005 * lens.matrix[0] + 0.15
    pose = placed(np.array([0.01, 0.02, depth_m]) - turn.apply(board.centre), turn)
    image = np.full((480, 640), 120.0, np.float32)
    draw(image, lens, board, pose, Light(30, 220, 120, 0.7, 0.0), 45.0)
    exact = lens.project(board.corners @ pose[:3, :3].T + pose[:3, 3])
    start = exact[:, None].astype(np.float32)
    found = cv2.cornerSubPix(image.astype(np.uint8), start, (5, 5), (-1, -1), (3, 99, 1e-4))[:, 0]
    # Grey levels are rounded, and a window of 11 px is bent; a mistake would shift all corners.
    assert np.abs(found - exact).max() < 0.15
    assert np.abs((found - exact).mean(axis=0)).max() < 0.015
