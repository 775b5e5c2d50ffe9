"""Hand-eye from points by a 3D sensor: within its covariance, and refused in its own words."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support.commands import visioncal
from support.refusals import raised

import visioncal as package
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import invert, log
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import pose_row

BALL = Path(__file__).parents[3] / "shared/data/field/cases/ball-points/ball.csv"
CAM = RigidTransform.from_components(
    [0.042, -0.061, 0.078], Rotation.from_rotvec([0.07, -0.02, 1.5])
)
REACH_M = (0.5, 0.0, 0.4), (0.7, 0.2, 0.6)
BALL_M = np.array([0.52, 0.13, 0.02])


def session_of(seed, mount, *, count=16, turns=(0.6, 0.6, 1.5), sigma_m=1e-4):
    """A ball that a camera sees from 16 poses, with noise of each coordinate."""
    rng, rows = np.random.default_rng(seed), []
    for view in range(count):
        turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * turns) * Rotation.from_rotvec(
            [3.1, 0, 0]
        )
        flange = RigidTransform.from_components(rng.uniform(*REACH_M), turn)
        seen = (flange * CAM).inv().apply(BALL_M)
        if mount == "eye-to-hand":
            seen = CAM.inv().apply(flange.apply(BALL_M - [0.5, 0.1, 0.0]))
        seen = seen + sigma_m * rng.standard_normal(3)
        row = {"view": str(view)} | {k: repr(v) for k, v in pose_row(flange.as_matrix()).items()}
        row |= dict(
            zip(("meas_x_m", "meas_y_m", "meas_z_m"), map(repr, map(float, seen)), strict=True)
        )
        rows.append(row)
    document = {
        "schema": 1,
        "name": "ball",
        "mount": mount,
        "cameras": {"top": {"model": "points"}},
    }
    cells = [[*row.values()] for row in rows]
    return Session.assemble(document, list(rows[0]), cells, MemoryImages({}))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_ball_gives_the_camera_within_its_covariance(mount):
    name = "flange_from_cam" if mount == "eye-in-hand" else "base_from_cam"
    squares = []
    for seed in range(12):
        result = package.calibrate(session_of(seed, mount))
        assert result.mount == mount
        edge = result.edges[name]
        error = log(invert(edge.matrix) @ CAM.as_matrix())
        squares.append(error @ np.linalg.solve(edge.covariance, error) / 6.0)
        # The noise is estimated: 0.1 mm of 16 stops, to a fifth.
        assert result.noise["combined_translation_mm"] == pytest.approx(0.1, rel=0.5)
    assert 0.5 < np.mean(squares) < 1.6
    said = " ".join(result.verdict.reasons)
    assert "camera" in said
    assert "instrument" not in said


def test_a_motion_about_one_axis_is_refused_in_the_words_of_the_camera():
    refused = raised(
        DegenerateError,
        "the camera's offset along the tool's",
        package.calibrate,
        session_of(1, "eye-in-hand", turns=(0, 0, 1.5)),
    )
    said = f"{refused} {refused.next_step}"
    assert "instrument" not in said
    assert "[prior.base_from_target]" in said


def test_rows_without_points_are_refused():
    session = session_of(1, "eye-in-hand")
    cells = [
        [view.cell(name) for name in session.columns[:-3]] + ["b.png"] for view in session.views
    ]
    with pytest.raises(package.VisioncalError, match=r"meas_x_m|target is missing"):
        package.calibrate(
            session.with_content(columns=[*session.columns[:-3], "image"], cells=cells)
        )


@pytest.mark.skipif(not BALL.exists(), reason="measurements beside the project")
def test_a_recorded_ball_comes_in_as_it_is(tmp_path):
    table = tmp_path / "ball.csv"
    table.write_bytes(BALL.read_bytes())
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == 16
    visioncal(
        *("convert", table, tmp_path / "ball", "--mount", "eye-in-hand"),
        *("--camera-columns", "ball_x,ball_y,ball_z"),
    ).good()
    result = package.calibrate(tmp_path / "ball")
    edge = result.edges["flange_from_cam"]
    # What the reporter's least squares gave, and the truth.
    for place_mm in ([41.7, -60.9, 78.2], [42.0, -61.0, 78.0]):
        away = edge.matrix[:3, 3] - 1e-3 * np.array(place_mm)
        assert away @ np.linalg.solve(edge.covariance[3:, 3:], away) < 7.8  # 95 % of three
