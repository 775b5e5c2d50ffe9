"""Several boards in one chain: where they are, what they tell together, and what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.stats import chi2
from support.cells import board_numbers, calibrated, error_of, showing
from support.marks import slow

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.run import run
from visioncal.calibration.stages.detect import detect
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert, log
from visioncal.frames.session_observations import detect_session_target
from visioncal.interchange.outputs import write_outputs
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CellOptions,
    Second,
    fine_camera,
    simulate,
    wide_camera,
    write_session,
)
from visioncal.simulation.boards import corners_m
from visioncal.simulation.optics import project

# The second board is out of sight from where the first is looked at, unless it is turned less.
NEAR = Second(turn_rad=0.6, tilt_rad=0.2)
TWO = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1, robot="ur5e", views=16, second=Second())
WRONG_LINKS = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}
MOUNTS = ("eye-in-hand", "eye-to-hand")


def without(cell, views):
    """A cell that lacks some views."""
    return cell.only([at for at in range(len(cell.corners)) if at not in views])


@pytest.mark.slow
def test_all_boards_are_placed_as_well_as_their_sigmas_say():
    """Six cells, each with boards whose sizes are off by what their files allow."""
    squares, count = 0.0, 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        first, further = 1.0 + 1e-3 * rng.standard_normal(2)
        second = replace(NEAR if seed % 4 < 2 else Second(), scale=further)
        cell = simulate(
            replace(TWO, mount=MOUNTS[seed % 2], board_scale=first, second=second, seed=seed)
        )
        known = calibrated(cell, joints=False)
        assert len(known.used) == len(cell.corners)
        error, covariance = error_of(cell, known), result_of(known).joint_covariance
        assert error.shape == (18,)
        squares += float(error @ np.linalg.solve(covariance, error))
        count += len(error)
    # Both tails at one in ten thousand.
    assert chi2.ppf(1e-4, count) < squares < chi2.ppf(1.0 - 1e-4, count)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_boards_have_names_and_a_common_covariance(mount):
    cell = simulate(replace(TWO, mount=mount, seed=3))
    known = calibrated(cell)
    result = result_of(known)
    assert list(result.edges) == list(cell.transforms)
    assert result.joint_covariance.shape == (18, 18)
    for at, edge in enumerate(result.edges.values()):
        rows = slice(6 * at, 6 * at + 6)
        assert np.array_equal(edge.covariance, result.joint_covariance[rows, rows])
    # The boards hang together by the camera's edge.
    assert np.abs(result.joint_covariance[6:12, 12:]).max() > 0.0
    assert np.linalg.eigvalsh(result.joint_covariance).min() > 0.0
    assert set(result.boards) == {"first", "second"}
    for solver in result.solvers.values():
        assert list(solver.matrices) == list(cell.transforms)
    park = result.solvers["park"].matrices
    for name, true in cell.transforms.items():
        # Closed forms are off by a few tenths of a millimetre.
        assert np.linalg.norm((invert(true) @ park[name])[:3, 3]) < 2e-3


def test_a_wrong_view_of_one_board_is_named():
    cell = simulate(replace(TWO, seed=4))
    corners = list(cell.corners)
    # One view of the second board shows it shifted by two squares.
    slipped = next(
        at for at in np.flatnonzero(board_numbers(cell) == 1) if len(corners[at].ids) > 40
    )
    pose = cell.cam_from_target[slipped] @ exp(np.array([0, 0, 0.02, 0.03, 0.0, 0.0]))
    turned = replace(cell.exact_corners[slipped], view=int(slipped))
    points = corners_m(cell.layout.boards[1])[turned.ids] @ pose[:3, :3].T + pose[:3, 3]
    corners[slipped] = replace(turned, px=project(cell.options.camera, points))
    known = calibrated(showing(cell, corners))
    assert set(range(len(corners))) - set(known.used) == {slipped}
    assert "disagrees with the other views" in known.reasons[slipped]
    assert any(f"View {slipped} was left out" in reason for reason in known.verdict.reasons)


def test_one_view_places_a_board():
    cell = simulate(replace(TWO, second=replace(Second(), target=BOARDS["charuco"]), seed=6))
    further = np.flatnonzero(board_numbers(cell) == 1)
    known = calibrated(without(cell, set(further[1:].tolist())))
    result = result_of(known)
    edges = result.edges
    assert edges["base_from_target_second"].sigma_mm > edges["base_from_target_first"].sigma_mm
    true = cell.transforms["base_from_target_second"]
    away = log(invert(true) @ edges["base_from_target_second"].matrix)
    covariance = edges["base_from_target_second"].covariance
    # One draw of chi-square with six degrees of freedom, at one in ten thousand.
    assert away @ np.linalg.solve(covariance, away) < chi2.ppf(1.0 - 1e-4, 6)
    # Without that view nothing places the board: it has no part in what is held out.
    assert np.isnan(known.assessment.held_out.residual_m).sum() == 1
    assert np.isfinite(known.findings.held_out.mm)


def test_a_board_that_is_never_seen_is_told():
    cell = simulate(replace(TWO, seed=8))
    further = set(np.flatnonzero(board_numbers(cell) == 1).tolist())
    known = calibrated(without(cell, further))
    assert list(result_of(known).edges) == ["flange_from_cam", "base_from_target_first"]
    assert any("No usable view shows target second" in reason for reason in known.verdict.reasons)


def test_too_few_views_of_any_board_are_refused():
    cell = simulate(replace(TWO, seed=9))
    kept = {
        *np.flatnonzero(board_numbers(cell) == 0)[:2],
        *np.flatnonzero(board_numbers(cell) == 1)[:2],
    }
    with pytest.raises(DegenerateError, match="it takes 3 stops or more"):
        calibrated(without(cell, set(range(len(cell.corners))) - kept))


def test_each_image_is_searched_for_its_own_board(tmp_path):
    cell = simulate(replace(TWO, camera=wide_camera(), views=4, seed=11))
    session = Session.load(write_session(cell, tmp_path / "session"))
    found = detect(session)
    assert sorted(found.corners) == [0, 1, 2, 3]
    views = list(session.views)
    views[1] = replace(views[1], text={"target": "first"})
    wrong = detect(replace(session, views=tuple(views)))
    assert sorted(wrong.corners) == [0, 2, 3]
    (lost,) = wrong.rejections
    assert (lost.view, lost.reason.endswith("(looked for target first)")) == (1, True)


def test_the_turn_of_a_symmetric_board_is_told_by_its_other_views():
    """Eight by six corners look the same after half a turn."""
    even = replace(BOARDS["checkerboard"], name="even", columns=8)
    cell = simulate(replace(TWO, second=Second(target=even), seed=13))
    known = calibrated(cell)
    assert len(known.used) == len(cell.corners)
    away = error_of(cell, known)[12:]
    # The board's frame is that of the first view's numbering, which need not be ours.
    turned = np.linalg.norm(away[:3]) > 1.0
    assert np.linalg.norm(away[3:]) < (0.5 if turned else 2e-4)
    assert known.findings.held_out.mm < 0.5


def test_every_output_shows_all_boards(tmp_path):
    cell = simulate(replace(TWO, seed=10))
    session = Session.load(write_session(cell, tmp_path / "pairs", images=False))
    written = run(session)
    write_outputs(tmp_path / "out", session, written)
    file = tmp_path / "out" / "recording.rrd"
    assert Session.load(file).digest() == session.digest()
    again = run(Session.load(file)).calibration
    for name, edge in written.calibration.edges.items():
        assert np.array_equal(again.edges[name].matrix, edge.matrix)
        assert np.array_equal(again.edges[name].covariance, edge.covariance)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "base_from_target_first" in report
    assert "base_from_target_second" in report
    logged = {str(chunk.entity_path) for chunk in RrdReader(file).stream()}
    for name in ("first", "second"):
        assert f"/targets/{name}/sheet" in logged
    with pytest.raises(DataError, match=r"several targets \(first, second\)"):
        detect_session_target(session, written.calibration, "base")


@pytest.mark.parametrize("given", [slow(True), False], ids=["lens given", "lens estimated"])
def test_what_is_written_of_the_fit_is_read_back(given):
    """Further boards are written relative to the first."""
    known = calibrated(simulate(replace(TWO, seed=2, state_intrinsics=given, **WRONG_LINKS)))
    assert known.robot_arm.model is not None
    prior_calibration, solved = CalibrationPrior.of(result_of(known)), known.assessment
    np.testing.assert_allclose(prior_calibration.state.edges, solved.state.edges, atol=1e-12)
    # What lenses do beyond their models is not written.
    own = np.delete(np.arange(len(solved.covariance)), known.cell_fit.field_columns)
    covariance = solved.covariance[np.ix_(own, own)]
    sigmas = np.sqrt(np.diag(covariance))
    # Slopes there and back undo each other up to rounding.
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(prior_calibration.covariance / scale, covariance / scale, atol=1e-6)


@pytest.mark.parametrize("seed", [34, slow(46)])
def test_a_board_within_its_stated_size_is_no_other_lens(seed):
    """Views from about one distance determine neither alone, and its size is known to 0.1 %."""
    options = CellOptions(
        views=14,
        seed=seed,
        board_scale=1.0007,
        camera=fine_camera(),
        tilt_rad=(0.15, 0.5),
        roll_rad=3.1,
        distance_m=(0.45, 0.7),
        cut_views=0.0,
        pixel_sigma_px=0.1,
        robot_sigma_rad=9e-5,
    )
    known = calibrated(simulate(options))
    assert "lens" not in {finding.kind for finding in known.verdict.findings}
