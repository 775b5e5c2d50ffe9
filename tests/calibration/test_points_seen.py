"""Hand-eye from points by a 3D sensor: within its covariance, and refused in its own words."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from support.ball_seen import session_of, squared
from support.commands import visioncal
from support.marks import seeds, slow
from support.refusals import raised

import visioncal as package
from visioncal.calibration.stages.points import named
from visioncal.core.errors import DegenerateError

BALL = Path(__file__).parents[3] / "shared/data/field/cases/ball-points/ball.csv"


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
@pytest.mark.parametrize("drawn", seeds(1, 12))
def test_a_ball_gives_the_camera_within_its_covariance(mount, drawn):
    name = "flange_from_cam" if mount == "eye-in-hand" else "base_from_cam"
    squares = []
    for seed in drawn:
        result = package.calibrate(session_of(seed, mount))
        assert result.mount == mount
        assert next(iter(result.edges)) == name
        squares.append(squared(result))
        # The noise is estimated: 0.1 mm of 16 stops, to a fifth.
        assert result.noise["combined_translation_mm"] == pytest.approx(0.1, rel=0.5)
    # Six values of each: in one case of a thousand chi-square is beyond either.
    low, high = chi2.ppf([5e-4, 0.9995], 6 * len(squares))
    assert low < 6.0 * np.sum(squares) < high
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


def test_a_sessions_own_name_and_its_paths_are_not_the_cameras():
    session = session_of(1, "eye-in-hand")
    said = "session 'probe': the instrument's base/views.csv has no probe."
    with pytest.raises(DegenerateError) as caught, named(session):
        raise DegenerateError(said, culprits=["base/views.csv"], next_step="Turn the base.")
    assert caught.value.message == "session 'probe': the camera's base/views.csv has no point."
    assert caught.value.culprits == ("base/views.csv",)
    assert caught.value.next_step == "Turn the tool."


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
