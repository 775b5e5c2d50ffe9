"""The whole way on simulated corners, by ways that few sessions take."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, error_of, known_of, session_of
from support.marks import slow

from visioncal.calibration.pipeline.result import view_evidence
from visioncal.calibration.run import STAGES
from visioncal.core.errors import DataError
from visioncal.core.types import MOUNTS, Camera, Target
from visioncal.simulation import CellOptions, fine_camera, fisheye_camera, simulate, wide_camera

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
# Simulated boards have exactly their size.
MARKER = replace(
    FINE,
    target=Target("tag", "marker", 1, 1, 0.12, 1e-6, dictionary="DICT_5X5_100", marker_id=3),
    pixel_sigma_px=0.03,
)
# Its corners look the same after half a turn, and at small tilts its mirrored pose fits as well.
AMBIGUOUS = replace(
    FINE,
    target=Target("sym", "checkerboard", 8, 6, 0.025, 2.5e-5),
    camera=wide_camera(),
    pixel_sigma_px=0.3,
    tilt_rad=(0.0, 0.3),
    seed=1,
)


def with_camera(cell, off_px=(0, 0, 0, 0), **table):
    """What the session says of the camera: a matrix that is off, and more fields."""
    stated = replace(cell.options.camera, matrix=cell.options.camera.matrix + off_px)
    told = session_of(replace(cell, stated={"": stated}))
    return replace(told, document=told.document | {"camera": told.document["camera"] | table})


def mahalanobis_sq(cell, known):
    """Squared error of both edges over the covariance, divided by their twelve numbers."""
    error, covariance = error_of(cell, known), known.assessment.covariance[:12, :12]
    return error @ np.linalg.solve(covariance, error) / 12


def test_intrinsics_are_refined_where_they_are_asked_to_be():
    off = np.array([4.0, 4.0, -3.0, 2.0])
    surprises = []
    for seed in range(2):
        cell = simulate(replace(FINE, seed=seed))
        known = calibrated(cell, session=with_camera(cell, off, intrinsics="refine"))
        assert np.isin(
            known.cell_fit.camera_parameters.lens_of("cam")[:4],
            known.cell_fit.linearised_corners.moving,
        ).all()
        refined = known.cell_fit.camera_parameters.camera("cam")
        sigma = np.sqrt(np.diag(known.assessment.covariance)[12:16])
        # Chi-square of four under 23.5 in all but one case of ten thousand, were they independent.
        assert np.all(np.abs(refined.matrix - cell.options.camera.matrix) < 4.5 * sigma)
        surprises.append(mahalanobis_sq(cell, known))
    # Mean of 2 chi-square of 12 over 12: beyond is one in a thousand.
    assert np.mean(surprises) < 2.13


@pytest.mark.parametrize("mode", [slow("hold"), "auto"])
def test_a_matrix_known_to_a_pixel_is_counted_as_such(mode):
    rng = np.random.default_rng(1)
    surprises = []
    for seed in range(4):
        cell = simulate(replace(FINE, seed=seed))
        off = 0.5 * rng.standard_normal(4)
        told = with_camera(cell, off, matrix_sigma_px=0.5, intrinsics=mode)
        known = calibrated(cell, session=told)
        assert known.uncertainty.budget_mm["intrinsics"] > 0.0
        surprises.append(mahalanobis_sq(cell, known))
    # Mean of 4 chi-square of 12 over 12: sigma 0.2; four sigma, and held values err a bit more.
    assert 0.2 < np.mean(surprises) < 2.0


@pytest.mark.parametrize("mode", ["auto", slow("refine")])
def test_a_rough_matrix_is_refined_within_its_prior_by_views_of_one_marker(mode):
    rng, sigma_px, nees = np.random.default_rng(3), 6.0, []
    for seed in range(5):
        cell = simulate(replace(MARKER, seed=seed))
        # Of the stated sigma, but without the rare draws beyond three sigmas, which are named.
        off_px = sigma_px * rng.uniform(-(3**0.5), 3**0.5, 4)
        session = with_camera(cell, off_px, matrix_sigma_px=sigma_px, intrinsics=mode)
        known = calibrated(cell, session=session)
        nees.append(mahalanobis_sq(cell, known))
        # The corners' noise does not absorb the lens's error, and nothing is accused for it.
        (noise_px,) = known.cell_fit.linearised_corners.sigmas_px
        assert noise_px == pytest.approx(0.03, rel=0.5)
        assert known.verdict.status == "good", known.verdict.reasons
        assert not any("was not done" in finding.words for finding in known.verdict.findings)
    # Mean of 5 chi-square of 12 over 12: sigma 0.18; beyond is one in a thousand on either side.
    assert 0.5 < np.mean(nees) < 1.7


@pytest.mark.slow
def test_a_matrix_off_by_many_of_its_sigmas_is_refined_without_its_prior_and_named():
    nees = []
    for seed in range(2):
        cell = simulate(replace(MARKER, seed=seed))
        session = with_camera(cell, (9.0, -9.0, 6.0, -9.0), matrix_sigma_px=0.6)
        known = calibrated(cell, session=session)
        nees.append(mahalanobis_sq(cell, known))
        assert "lens" in [cause.kind for cause in known.verdict.causes]
    # Mean of 2 chi-square of 12 over 12: beyond is one in a thousand.
    assert np.mean(nees) < 2.13


@pytest.mark.parametrize(
    ("table", "is_refused"),
    [
        ({}, False),
        slow({"matrix_sigma_px": 6.0, "intrinsics": "hold"}, False),
        ({"intrinsics": "refine"}, True),
    ],
    ids=["no prior", "held", "refined without a prior"],
)
def test_a_matrix_without_a_prior_is_held_on_views_of_one_marker(table, is_refused):
    cell = simulate(MARKER)
    known = calibrated(cell, session=with_camera(cell, **table))
    fitted = known.cell_fit
    assert not np.isin(
        fitted.camera_parameters.lens_of("cam"), fitted.linearised_corners.moving
    ).any()
    refused = [finding for finding in known.verdict.findings if "was not done" in finding.words]
    assert len(refused) == is_refused
    assert all("matrix_sigma_px" in finding.do.words for finding in refused)


@pytest.mark.parametrize("given", [slow(True), False], ids=["lens given", "lens estimated"])
def test_a_fisheye_camera_goes_the_whole_way(given):
    surprises = []
    for seed in range(4):
        options = CellOptions(camera=fisheye_camera(), state_intrinsics=given, seed=seed)
        known = calibrated(cell := simulate(options))
        assert known.used == tuple(range(20))
        assert len(known.cell_fit.camera_parameters.lens_of("cam")) == 8
        surprises.append(mahalanobis_sq(cell, known))
    # Mean of 4 chi-square of 12 over 12: sigma 0.2.
    assert np.mean(surprises) == pytest.approx(1.0, abs=0.8)


def test_a_closed_form_is_diagnosed_too():
    cell = simulate(replace(FINE, seed=2))
    joint, park = (calibrated(cell, solver=name).uncertainty for name in ("joint", "park"))
    assert {"pixels", "robot", "total"} < set(park.budget_mm)
    # The levels of noise belong to the session, whichever solver gave the estimate: both maximise
    # the same restricted likelihood, to the tolerance of its search. What is held pulls at a fit
    # that is at rest only.
    assert "held_values" not in park.budget_mm
    noise = [np.hypot(work.budget_mm["pixels"], work.budget_mm["robot"]) for work in (joint, park)]
    assert noise[1] == pytest.approx(noise[0], rel=1e-3)


@pytest.mark.parametrize("solver", ["joint", slow("park")])
def test_views_held_back_may_be_ambiguous(solver):
    cell = simulate(AMBIGUOUS)
    told = session_of(cell)
    views = tuple(replace(view, holdout=view.number % 4 == 0) for view in told.views)
    plain = known_of(cell, session=replace(told, views=views), solver=solver)
    for stage in (stage for stage in STAGES if stage.name in ("intrinsics", "pnp")):
        plain = stage.run(plain)
    held = range(0, 20, 4)
    assert any(len(plain.poses[index].cam_from_target) > 1 for index in held)
    known = calibrated(cell, session=replace(told, views=views), solver=solver)
    assert known.used == tuple(index for index in range(20) if index % 4)
    # Of the order of the used views': half a turn of the board would be metres.
    assert known.findings.pairs[0].holdout.mm < 5 * known.findings.held_out.mm


def test_a_view_left_out_as_ambiguous_is_shown_by_its_best_pose():
    # A small board far away: in frontal views perspective hardly tells the tilt's sign.
    small = Target("small", "checkerboard", 5, 4, 0.025, 2.5e-5)
    far = CellOptions(
        target=small, pixel_sigma_px=0.3, distance_m=(1.0, 1.5), tilt_rad=(0.0, 0.5), seed=3
    )
    known = calibrated(simulate(far))
    assert known.reasons[4].startswith("ambiguous")
    shown = {view.view: view for view in view_evidence(known)}
    np.testing.assert_array_equal(shown[4].cam_from_target, known.poses[4].cam_from_target[0])
    assert shown[4].predicted_px is None
    assert all(shown[view].predicted_px is not None for view in known.used)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_lens_stated_for_images_twice_as_large_is_refined(mount):
    matrix, bent = np.array([520.0, 519, 320, 190]), np.array([-0.37, 0.1, 0.001, 0.0, 0.03])
    camera = Camera("brown", (640, 360), matrix, bent)
    told = CellOptions(robot="ur3e", mount=mount, views=24, camera=camera, pixel_sigma_px=0.03)
    cell = simulate(replace(told, robot_sigma_m=1e-4))
    known = calibrated(cell, session=with_camera(cell, matrix))
    refined = known.cell_fit.camera_parameters.camera("cam")
    sigma = np.sqrt(np.diag(known.assessment.covariance)[12:16])
    # Chi-square of four under 23.5 in all but one case of ten thousand, were they independent.
    assert np.all(np.abs(refined.matrix - matrix) < 4.5 * sigma)


@pytest.mark.parametrize("given", [True, False], ids=["lens given", "lens estimated"])
def test_a_session_that_holds_all_views_back_is_told_so(given):
    cell = simulate(replace(FINE, views=8, state_intrinsics=given))
    told = session_of(cell)
    held = replace(told, views=tuple(replace(view, holdout=True) for view in told.views))
    with pytest.raises(DataError, match="are held back") as caught:
        calibrated(cell, session=held)
    assert "Clear role" in caught.value.next_step
