"""Cells that are simulated and calibrated before one is bought."""

import numpy as np
import pytest
from support.commands import visioncal

from visioncal.core.errors import DataError
from visioncal.interchange.batch import run as batch_run
from visioncal.interchange.batch.cells import write_cells
from visioncal.interchange.batch.work import work
from visioncal.results import Calibration
from visioncal.simulation import read_truth


@pytest.fixture(autouse=True)
def here(monkeypatch):
    """Works in this process: what its workers are does not matter."""
    monkeypatch.setattr(batch_run, "rows_of", lambda jobs, *_: map(work, jobs))


def written(tmp_path, text):
    (tmp_path / "cells.toml").write_text(text)
    return tmp_path / "cells.toml"


def test_all_combinations_are_calibrated_and_compared_with_the_truth(tmp_path):
    file = written(tmp_path, 'views = [8, 20]\nrobot_sigma_mm = 0.1\ncamera = "fine"\nseeds = 3\n')
    out = tmp_path / "out"
    found = batch_run.batch((), out, cells=file, without=("report.html", "recording.rrd"))
    assert len(found.rows) == 6
    row = found.rows[0]
    true = read_truth(row.session).transforms["flange_from_cam"]
    edge = Calibration.load(out / row.name).edges["flange_from_cam"]
    away_mm = 1e3 * np.linalg.norm(edge.matrix[:3, 3] - np.array(true)[:3, 3])
    assert row.error_mm == pytest.approx(away_mm, rel=1e-6)
    few, many = (
        [row.sigma_mm for row in found.rows if row.group.startswith(f"views_{count}-")]
        for count in (8, 20)
    )
    # Two and a half times the stops are known by a factor of 1.6 at the least.
    assert np.median(few) > 1.3 * np.median(many)
    page = found.page.read_text()
    assert "views_8-robot_sigma_mm_0.1-camera_fine" in page
    assert "Simulated cells" in page
    again = batch_run.batch((), out, cells=file, without=("report.html", "recording.rrd"))
    assert {row.state for row in again.rows} == {"kept"}
    assert {row.error_mm for row in again.rows} == {row.error_mm for row in found.rows}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("view = [8]", "view is nothing that is varied; known are views"),
        ("views = [2]", "views has 2; 3 to"),
        ("views = [8]\nseeds = 0", "seeds is 0; 1 to"),
        ('board = "foo"', "board has 'foo'; known are charuco"),
        ('camera = "wise"', "camera has 'wise'; known are wide, fine"),
        ('arm_sigma_mm = ["much"]', "arm_sigma_mm has 'much'; a number from 0"),
    ],
)
def test_what_cannot_be_varied_is_refused(tmp_path, text, words):
    with pytest.raises(DataError, match=words) as caught:
        write_cells(written(tmp_path, text), tmp_path / "cells")
    assert caught.value.next_step or caught.value.culprits
    assert not (tmp_path / "cells").exists()


def test_cells_take_the_place_of_sessions(tmp_path):
    file = written(tmp_path, "views = [8]\nseeds = 1\n")
    done = visioncal("batch", tmp_path, "-o", tmp_path / "out", "--cells", file)
    assert done.status == 2
    assert "in the place of sessions" in done.err
    nothing = visioncal("batch", "-o", tmp_path / "out")
    assert nothing.status == 2
    assert "there is no session" in nothing.err
