"""What a recording tells of board, arm and uncertainty, and how it draws views left out."""

from dataclasses import replace

import numpy as np
import pytest
from support.drawn import column
from support.findings import healthy, sick, with_findings
from support.samples import TARGET, made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import notes, paths, write_recording
from visioncal.present.recording.overlays import Overlay
from visioncal.present.viewer import blueprint
from visioncal.vision.targets import corner_positions, load_target


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def recorded(sample, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(path, sample.session, sample.calibration, sample.evidence, None)
    return path


@pytest.mark.parametrize(
    ("name", "document", "words"),
    [
        ("board", healthy()["board"] | {"shape": {}}, "board: shape.scale is missing"),
        ("arm_errors", {"sigma_mm": "much"}, "arm_errors.sigma_mm is 'much'; a number is needed"),
        (
            "uncertainty",
            healthy()["uncertainty"] | {"budget_mm": {"total": 0.1}},
            "uncertainty: budget_mm has no total, or no source",
        ),
        ("uncertainty", ["no table"], r"uncertainty is \['no table'\]; a table is needed"),
    ],
)
def test_findings_that_cannot_be_read_are_named(sample, name, document, words):
    with pytest.raises(DataError, match=words):
        with_findings(sample, {name: document})


def test_the_board_is_as_large_and_as_deep_as_its_corners(sample):
    target = load_target(TARGET)
    board = with_findings(sample, sick()).board
    flat, bent = corner_positions(target), board.corners(target)
    stretched = np.ptp(bent, axis=0)[:2] / np.ptp(flat, axis=0)[:2]
    # The shape is linear in its values.
    np.testing.assert_allclose(stretched, [1.0015, 1.0025], rtol=1e-12)
    np.testing.assert_allclose(board.squares_m(target), stretched * target.square_m, rtol=1e-12)
    # A parabola of 0.3 mm at the board's edge, less its mean plane.
    assert 2.5e-4 < np.ptp(bent[:, 2]) <= 3e-4


def test_residuals_of_views_left_out_end_at_the_scale_of_the_others(sample, recorded):
    used = [view.residual_mm for view in sample.calibration.views if view.used]
    beyond = column(recorded, f"{paths.POSITION_MM}/{paths.BEYOND}", "Scalars:scalars")
    # View 6 is off by 14 mm, fifty times as far as the others; view 3 has no residual at all.
    assert set(beyond) == {6}
    assert max(used) < beyond[6][0] < 1.5 * max(used)
    marks = column(recorded, f"{paths.POSITION_MM}/{paths.REJECTED}", "Scalars:scalars")
    assert set(marks) == {3}
    assert "14.2 mm" in notes.view_markdown(sample.calibration.views[6])


def test_residuals_of_views_left_out_are_drawn_to_scale(sample, recorded):
    overlay = Overlay.of(
        sample.session, sample.calibration, {view.view: view for view in sample.evidence}
    )
    magnified = column(recorded, paths.magnified_residuals(overlay.factor), "Arrows2D:vectors")
    to_scale = column(recorded, paths.RESIDUALS_TO_SCALE, "Arrows2D:vectors")
    assert overlay.factor > 1
    for view, used in ((4, True), (6, False)):
        seen = sample.evidence[view]
        assert seen.corners is not None
        assert seen.predicted_px is not None
        residuals = seen.predicted_px - seen.corners.px
        expected = (overlay.factor * residuals, []) if used else ([], residuals)
        for found, wanted in zip((magnified[view], to_scale[view]), expected, strict=True):
            # Single precision of arrows that are some ten pixels long.
            np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_the_target_as_a_view_left_out_sees_it_is_marked(recorded):
    drawn = column(recorded, paths.SEEN_TARGET, "LineStrips3D:colors")
    assert drawn[6] != drawn[5] == drawn[4]


def test_plots_explain_marks_only_where_there_are_some(sample):
    views = tuple(replace(view, used=True, reason="") for view in sample.calibration.views)
    everything = replace(sample.calibration, views=views)
    assert "red: not used" in str(blueprint_names(sample, sample.calibration))
    assert "not used" not in str(blueprint_names(sample, everything))


def blueprint_names(sample, calibration):
    tabs = blueprint(sample.session, calibration).root_container.contents
    return [view.name for view in tabs[1].contents[0].contents]
