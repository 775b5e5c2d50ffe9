"""Mistakes made in cells: what is said first. Sessions are made with numpy and OpenCV alone."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support.marks import slow

import visioncal

COLUMNS, ROWS, SQUARE_M, RESOLUTION = 9, 6, 0.03, (1280, 800)
MATRIX, DISTORTION = (1105.0, 1103.0, 652.0, 388.0), (-0.11, 0.07, 0.0006, -0.0004, 0.0)
MIDDLE_M = np.array([COLUMNS, ROWS, 0.0]) * SQUARE_M / 2.0
STATED_LENS = f"matrix = {list(MATRIX)}\ndistortion = {list(DISTORTION)}\n"


def pose(xyz_m, *xyz_deg) -> RigidTransform:
    """A pose by its place [m] and its turns about the fixed axes x, y, z [deg]."""
    return RigidTransform.from_components(xyz_m, Rotation.from_euler("xyz", xyz_deg, degrees=True))


FLANGE_FROM_CAM = pose([0.071, -0.032, 0.094], 3.0, -4.0, 88.0)
BASE_FROM_TARGET = pose([0.62, -0.11, 0.012], 178.2, 0.0, 25.0)


@dataclass(frozen=True)
class Stop:
    """What is real at one stop of a camera on the flange."""

    cam_from_target: RigidTransform
    flange_from_cam: RigidTransform = FLANGE_FROM_CAM
    matrix: tuple[float, float, float, float] = MATRIX
    size: float = 1.0


def looks(count: int, seed: int = 1) -> list[Stop]:
    """Stops that look at the board's middle from all sides, tilted by up to 35 degrees."""
    rng, stops = np.random.default_rng(seed), []
    for _ in range(count):
        turn = Rotation.from_euler("xyz", rng.uniform([-35, -35, -180], [35, 35, 180]), True)
        place = [*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.4, 0.65)]
        stops.append(Stop(RigidTransform.from_components(place - turn.apply(MIDDLE_M), turn)))
    return stops


def about_the_axis(count: int, tilt_deg: float = 14.0, seed: int = 1) -> list[Stop]:
    """Stops of an arm that turns the flange about its z alone, over a board that lies flat."""
    rng, stops = np.random.default_rng(seed), []
    flange_from_cam = pose([0.06, 0.02, 0.05], tilt_deg, 0.0, 86.0)
    for _ in range(count):
        turn = Rotation.from_euler("z", rng.uniform(-180.0, 180.0), degrees=True)
        flat = (flange_from_cam.rotation.inv() * turn).as_matrix()
        place = [*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.4, 0.55)]
        rotation = Rotation.from_matrix(flat)
        cam_from_target = RigidTransform.from_components(place - rotation.apply(MIDDLE_M), rotation)
        stops.append(Stop(cam_from_target, flange_from_cam))
    return stops


def write(
    folder: Path,
    stops: Sequence[Stop],
    camera: str = "",
    more: str = "",
) -> Path:
    """Writes a session with corners.csv; the robot has noise of 0.03 mm.

    Args:
        folder: Where.
        stops: What is real.
        camera: Further lines of `[camera]`.
        more: Further tables of session.toml.
    """
    rng = np.random.default_rng(5)
    folder.mkdir()
    (folder / "session.toml").write_text(
        'schema = 1\nname = "cell"\nmount = "eye-in-hand"\ntarget = "charuco_9x6_30mm"\n'
        f"[camera]\nresolution = {list(RESOLUTION)}\n{camera}{more}"
    )
    inner = np.mgrid[1:COLUMNS, 1:ROWS].T.reshape(-1, 2) * SQUARE_M
    points = np.c_[inner, np.zeros(len(inner))]
    views, corners = ["view,x_m,y_m,z_m,qx,qy,qz,qw"], ["view,point,u_px,v_px"]
    flanges = [
        BASE_FROM_TARGET * stop.cam_from_target.inv() * stop.flange_from_cam.inv() for stop in stops
    ]
    for view, (stop, flange) in enumerate(zip(stops, flanges, strict=True)):
        numbers = [*flange.translation, *flange.rotation.as_quat()]
        views.append(",".join(map(repr, [view, *map(float, numbers)])))
        off = RigidTransform.from_exp_coords(rng.normal(size=6) * np.repeat([5e-5, 3e-5], 3))
        seen = stop.cam_from_target * off
        fx, fy, cx, cy = stop.matrix
        lens = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        turn, place = seen.rotation.as_rotvec(), seen.translation
        px, _ = cv2.projectPoints(stop.size * points, turn, place, lens, np.array(DISTORTION))
        noise = rng.normal(0.0, 0.1, (len(points), 2))
        for point, (u_px, v_px) in enumerate(px[:, 0] + noise):
            corners.append(f"{view},{point},{u_px:.4f},{v_px:.4f}")
    (folder / "views.csv").write_text("\n".join(views) + "\n")
    (folder / "corners.csv").write_text("\n".join(corners) + "\n")
    return folder


def test_an_arm_that_cannot_tilt_takes_a_measured_height(tmp_path):
    stops = about_the_axis(18)
    measured = "[prior.flange_from_cam]\nz_m = 0.05\nsigma_m = 0.0005\n"
    # The corners alone leave the focal length open to 8 %, which is said, and counts.
    for name, lens in (("open", ""), ("stated", STATED_LENS)):
        found = visioncal.calibrate(write(tmp_path / name, stops, lens, measured))
        off = found.transforms["flange_from_cam"].inv() * stops[0].flange_from_cam
        assert 1e3 * np.linalg.norm(off.translation) < 1.5
        assert found.verdict.status == "check" or name == "stated"


def with_lens(stops: Sequence[Stop], longer: Sequence[float], aside_px: float = 0.0) -> list[Stop]:
    """The same stops with focal lengths that are longer by some shares, and another centre."""
    fx, fy, cx, cy = MATRIX
    return [
        replace(stop, matrix=(fx + fx * share, fy + fy * share, cx + aside_px, cy - aside_px))
        for stop, share in zip(stops, longer, strict=True)
    ]


def test_a_lens_that_was_zoomed_midway_is_no_camera_that_moved(tmp_path):
    stops = with_lens(looks(18), [0.0] * 7 + [0.02] * 11)
    first = visioncal.calibrate(write(tmp_path / "zoomed", stops)).verdict.causes[0]
    assert first.kind == "lens_changed"
    found = re.search(r"from view 7 on, its focal length is (\S+) % longer", first.words)
    # By a step of Newton's method, which is exact to as much as the step.
    assert float(found.group(1)) == pytest.approx(2.0, abs=0.3)
    assert "autofocus" in first.do.words
    # A lens that was hit: its centre is elsewhere.
    stops = [*looks(18)[:7], *with_lens(looks(18)[7:], [0.0] * 11, aside_px=8.0)]
    first = visioncal.calibrate(write(tmp_path / "hit", stops)).verdict.causes[0]
    assert first.kind == "lens_changed"
    found = re.search(r"from view 7 on, .* its principal point is \((\S+), (\S+)\) px", first.words)
    # Known to 1 px.
    assert np.array(found.groups(), float) == pytest.approx([8.0, -8.0], abs=3.0)


@pytest.mark.parametrize(("since", "size"), [slow(9, 1.01), (14, 25 / 30)])
def test_a_board_that_was_exchanged_midway_is_no_thing_that_moved(tmp_path, size, since):
    stops = looks(19)
    stops[since:] = [replace(stop, size=size) for stop in stops[since:]]
    folder = write(tmp_path / "board", stops)
    if since == 14:
        warned = visioncal.doctor(folder).findings[0]
        assert "Views 14, 15, 16, 17, 18 disagree with the others" in warned.words
        assert "visioncal calibrate" in warned.do.command
    first = visioncal.calibrate(folder).verdict.causes[0]
    # Of unlike parts, the views of the smaller one are left out.
    assert first.kind == ("board_changed" if since == 9 else "something_moved")
    found = re.search(
        rf"from view {since} on.* (\S+) % {'larger' if size > 1 else 'smaller'}", first.words
    )
    # Its sigma is an eighth of it: each half is known by the noise of both.
    assert 1e-2 * float(found.group(1)) == pytest.approx(abs(size - 1.0), rel=0.25)
    assert "target is another one" in first.words
    assert "Measure both prints" in first.do.words
