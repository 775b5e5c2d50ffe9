"""Folders of a recording with other files beside it: each is read as the recording that it is."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal

from visioncal.interchange.formats.intrinsics import FAULT, lenses_in, read_intrinsics
from visioncal.session import Session

BOARD = ("--target", "checkerboard_9x7_20mm", "--mount", "eye-to-hand")


def write(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))


def shoot(folder: Path, name: str, count: int, size=(128, 72)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for at in range(1, count + 1):
        cv2.imwrite(str(folder / name.format(at)), np.full(size[::-1], 40 + at, np.uint8))


def matrices(count: int, seed=0) -> np.ndarray:
    """(n, 4, 4) poses."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(0.2, 0.9, (count, 3))
    return poses


def frames_of_cameras(folder: Path) -> None:
    """Four cameras' poses in the base, whose names have numbers."""
    named = {f"cam{at + 1}": {"T_4x4": pose.tolist()} for at, pose in enumerate(matrices(4))}
    write(folder / "side/base_to_camera.json", {"T_base_to_camera": named})


def frames_in_a_list(folder: Path) -> None:
    """Five fixtures' poses, which are counted."""
    rows = [{"nr": at + 1, "T": pose.tolist()} for at, pose in enumerate(matrices(5))]
    write(folder / "side/fixtures.json", {"fixtures": rows})


def lengths_of_links(folder: Path) -> None:
    rows = [{"joint_id": f"J{at}", "a": 0.1 * at, "d": 0.2, "alpha": 1.5} for at in range(1, 7)]
    write(folder / "side/links.json", {"joints": rows})


LENS = {
    "camera_id": "cam1",
    "image_size_wh": {"width": 192, "height": 108},
    "number": 3.0,
    "intrinsics_K": {"fx": 150.0, "fy": 151.0, "cx": 95.5, "cy": 53.5},
    "distortion": {"model": "opencv", "coefficients": [-0.25, 0.125, 0.0, 0.0, 0.5]},
}


@pytest.mark.parametrize("beside", [frames_of_cameras, frames_in_a_list])
def test_joint_angles_of_all_pictures_come_before_frames_of_a_few(tmp_path, beside):
    shoot(tmp_path / "in/images", "img{}_cam1.png", 12)
    joints = np.random.default_rng(1).uniform(-90, 90, (12, 6))
    rows = [
        {
            "pose_id": at + 1,
            "joint_angles_deg": {f"joint_{n + 1}": q for n, q in enumerate(row)},
            "images": {f"cam{n}": f"cam{n}/img{at + 1}_cam{n}" for n in (1, 2)},
        }
        for at, row in enumerate(joints.tolist())
    ]
    write(tmp_path / "in/side/dataset.json", {"robot": "UR3", "poses": rows})
    beside(tmp_path / "in")
    lengths_of_links(tmp_path / "in")
    write(tmp_path / "in/lens/cam1.json", LENS)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    session = Session.load(tmp_path / "out")
    np.testing.assert_allclose([v.joints_rad for v in session.views], np.deg2rad(joints))
    assert len({view.image for view in session.views}) == 12
    assert "Left aside, as 12 images have other rows: " in done.err
    assert "calibrate needs the arm, as by --robot-model" in done.err
    # Read whole, for pictures of two thirds of its size.
    assert session.camera.matrix == pytest.approx([100.0, 151 / 1.5, 63.5, 35.5])
    assert list(session.camera.distortion) == [-0.25, 0.125, 0.0, 0.0, 0.5]
    assert "the matrix is scaled by 0.6667" in done.err


def test_a_reading_of_a_small_part_of_the_pictures_says_so(tmp_path):
    shoot(tmp_path / "in", "{:02}.png", 12)
    poses = matrices(5)
    for at, pose in enumerate(poses, 3):
        write(tmp_path / f"in/{at:02}.json", {"base_from_flange": pose.tolist()})
    write(tmp_path / "in/notes.csv", "\n".join(["temperature", *map(str, np.arange(12) / 7)]))
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    assert "ATTENTION: only 5 of 12 images are views" in done.err
    assert "notes.csv (12 rows)" in done.err


def test_a_lens_is_read_whole_or_not_at_all(tmp_path):
    write(tmp_path / "lens.json", LENS)
    lens, _ = read_intrinsics(tmp_path / "lens.json")
    assert lens["matrix"] == [150.0, 151.0, 95.5, 53.5]
    assert lens["distortion"] == [-0.25, 0.125, 0.0, 0.0, 0.5]
    assert lens["resolution"] == [192, 108]
    assert [*lenses_in(LENS, "lens")] == [("lens: intrinsics_K", lens)]
    other = LENS | {"distortion": {"model": "of our own", "coefficients": [0.1]}}
    (_, unread), = lenses_in(other, "lens")  # fmt: skip
    assert "'of our own' is not known" in unread[FAULT]
    # Sides that are not around the centre, and single numbers, are of something else.
    board = {"width": 5, "height": 7, "d": 0.3, "lens": LENS["intrinsics_K"]}
    (_, read), = lenses_in(board, "board")  # fmt: skip
    assert "resolution" not in read
    assert read["distortion"] == [0.0] * 5


def test_a_lens_that_is_not_read_is_named(tmp_path):
    shoot(tmp_path / "in", "{:02}.png", 6)
    rows = [{"image": f"{at:02}.png", "T": p.tolist()} for at, p in enumerate(matrices(6), 1)]
    write(tmp_path / "in/poses.json", rows)
    other = LENS | {"distortion": {"model": "of our own", "coefficients": [0.1]}}
    write(tmp_path / "in/lens.json", other)
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *BOARD).good()
    assert "The intrinsics are left aside: lens.json: intrinsics_K: the lens model" in done.err
    assert Session.load(tmp_path / "out").camera is None
