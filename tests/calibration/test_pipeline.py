"""The whole way on simulated corners and poses: lenses, several boards, and what was measured."""

import re
from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from support.cells import board_numbers, calibrated, error_of, known_of, pairs_session, session_of
from support.following import follow
from support.marks import crossed, seeds, slow
from support.misfits import misfit
from support.refusals import raised

import visioncal
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import calibrate, run
from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.distance_scale import distance_scale
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import compose, exp, invert, log, pose_difference
from visioncal.core.types import MOUNTS, Camera, Target
from visioncal.core.verdict import NOTE
from visioncal.frames.session_observations import detect_session_target
from visioncal.interchange.outputs import write_outputs
from visioncal.planning.information import predict_worlds
from visioncal.planning.purposes import PURPOSES
from visioncal.planning.recorded import start_from_session
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    Second,
    SimulatedCell,
    simulate,
    write_session,
)
from visioncal.simulation.records import cell_session
from visioncal.verification.calibration_prior import CalibrationPrior

FINE = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1)
# Simulated boards have exactly their size.
MARKER = replace(
    FINE,
    target=Target("tag", "marker", 1, 1, 0.12, 1e-6, dictionary="DICT_5X5_100", marker_id=3),
    pixel_sigma_px=0.03,
)
# Corners as exact as centres of circles.
EXACT = replace(FINE, seed=2, pixel_sigma_px=0.002)
# Its corners look the same after half a turn, and at small tilts its mirrored pose fits as well.
AMBIGUOUS = replace(
    FINE,
    target=Target("sym", "checkerboard", 8, 6, 0.025, 2.5e-5),
    camera=CAMERAS["wide"],
    pixel_sigma_px=0.3,
    tilt_rad=(0.0, 0.3),
    seed=1,
)
TWO = CellOptions(
    camera=CAMERAS["fine"], pixel_sigma_px=0.1, robot="ur5e", views=16, second=Second()
)
SIGMA_M = 5e-4
X = exp(np.array([0.02, -0.03, 0.4, 0.06, -0.02, 0.081]))
Z = compose(np.diag([1.0, -1.0, -1.0]), np.array([0.4, 0.1, -0.25]))
# Of the target's poses, as a camera measures them [rad and m].
NOISE = np.repeat([2e-4, 1e-4], 3)
TWICE = Camera(
    "brown", (640, 360), np.array([520.0, 519, 320, 190]), np.array([-0.37, 0.1, 0.001, 0.0, 0.03])
)
OF_HALF = CellOptions(robot="ur3e", views=24, camera=TWICE, pixel_sigma_px=0.03, robot_sigma_m=1e-4)


def with_camera(cell, off_px=(0, 0, 0, 0), **table):
    """What the session says of the camera: a matrix that is off, and more fields."""
    stated = replace(cell.options.camera, matrix=cell.options.camera.matrix + off_px)
    session = session_of(replace(cell, stated={"": stated}))
    return replace(
        session, document=session.document | {"camera": session.document["camera"] | table}
    )


@pytest.mark.slow
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


def test_views_held_back_may_be_ambiguous():
    cell = simulate(AMBIGUOUS)
    session = session_of(cell)
    views = tuple(replace(view, holdout=view.number % 4 == 0) for view in session.views)
    known = calibrated(cell, session=replace(session, views=views))
    assert any(len(known.poses[index].cam_from_target) > 1 for index in range(0, 20, 4))
    assert known.used == tuple(index for index in range(20) if index % 4)
    # Of the order of the used views': half a turn of the board would be metres.
    assert known.findings.pairs[0].holdout.mm < 5 * known.findings.held_out.mm


def test_a_session_that_holds_all_views_back_is_refused():
    for given in (True, False):
        cell = simulate(replace(FINE, views=8, state_intrinsics=given))
        session = session_of(cell)
        held = replace(session, views=tuple(replace(view, holdout=True) for view in session.views))
        caught = raised(DataError, "are held back", calibrated, cell, session=held)
        assert "Clear role" in caught.next_step


def without(cell, views):
    """A cell that lacks some views."""
    return cell.only([at for at in range(len(cell.corners)) if at not in views])


@pytest.mark.parametrize(
    ("axis", "said", "step"),
    [
        slow("z_m", "has a predicted sigma of 6", "Measure that to 4"),
        ("x_m", "is not determined at all", "; where the arm cannot tilt, measure that offset"),
    ],
)
def test_a_stated_prior_that_does_not_suffice_is_named(axis, said, step):
    with pytest.raises(DegenerateError, match=said) as refused:
        calibrate(
            scara(
                0, {"flange_from_cam": {axis: float(X["xyz".index(axis[0]), 3]), "sigma_m": 6e-3}}
            )
        )
    known = f"[prior.flange_from_cam] counts, with {axis[0]} known to 6 mm."
    assert refused.value.message.endswith(known)
    assert step in refused.value.next_step
    if axis == "z_m":
        # What it asks for suffices.
        needed_mm = float(refused.value.next_step.split()[3])
        prior = {"z_m": float(X[2, 3]), "sigma_m": 1e-3 * needed_mm}
        found = calibrate(scara(0, {"flange_from_cam": prior})).verdict
        weak = next(finding for finding in found.findings if finding.kind == "weak_motion")
        # A caliper on the board would not help.
        assert "Weakly determined by the motion" in weak.words
        assert "caliper" not in weak.do.words


@pytest.mark.slow
def test_each_image_is_searched_for_its_own_board(tmp_path):
    cell = simulate(replace(TWO, camera=CAMERAS["wide"], views=4, seed=11))
    session = Session.load(write_session(cell, tmp_path / "session"))
    found = detect(session)
    assert sorted(found.corners) == [0, 1, 2, 3]
    views = list(session.views)
    views[1] = replace(views[1], text={"target": "first"})
    wrong = detect(replace(session, views=tuple(views)))
    assert sorted(wrong.corners) == [0, 2, 3]
    (lost,) = wrong.rejections
    assert (lost.view, lost.reason.endswith("(looked for target first)")) == (1, True)


@pytest.mark.slow
def test_four_axes_give_a_result_with_a_measured_height_and_none_without():
    with pytest.raises(DegenerateError, match="the tool's z is not determined at all") as refused:
        calibrate(scara(0, {}))
    assert "measure that offset for [prior.flange_from_cam]" in refused.value.next_step
    squares = []
    for seed in range(2):
        wrong = SIGMA_M * np.random.default_rng(100 + seed).standard_normal()
        prior = {"z_m": float(X[2, 3] + wrong), "sigma_m": SIGMA_M}
        found = calibrate(scara(seed, {"flange_from_cam": prior}))
        assert found.verdict.status == "good"
        said = f"The measured z_m of flange_from_cam = {1e3 * prior['z_m']:g} mm was"
        (reason,) = (reason for reason in found.verdict.reasons if reason.startswith(said))
        assert reason.endswith("the views alone leave it open.")
        edge = found.edges["flange_from_cam"]
        # What was measured is all that is known of the height.
        height = X[2, :3] @ edge.covariance[3:, 3:] @ X[2, :3]
        assert np.sqrt(height) == pytest.approx(SIGMA_M, rel=0.05)
        squares.append(misfit(edge, X))
    # Chi-square of twelve, which chance leaves in one of a thousand cases on either side; the noise
    # is itself estimated from each session, to a tenth.
    assert 1.8 < np.sum(squares) < 40.0


@pytest.mark.slow
def test_doctor_says_of_few_stops_what_the_verdict_says_and_tilts_no_arm_that_cannot():
    prior = {"z_m": float(X[2, 3]), "sigma_m": SIGMA_M}
    session = scara(0, {"flange_from_cam": prior}, views=8)
    judged = calibrate(session).verdict.findings
    (said,), (found,) = (
        [(finding.words, finding.do) for finding in findings if finding.kind == "few_stops"]
        for findings in (judged, visioncal.doctor(session).findings)
    )
    assert found == said
    assert "tilt" not in str(found)


@pytest.mark.slow
def test_a_board_of_several_may_be_known_whole():
    options = CellOptions(robot="ur5e", motion="one_axis", views=12, second=Second(), seed=2)
    cell = simulate(options)
    name = "base_from_target_second"
    edge = cell.transforms[name]
    turn = Rotation.from_matrix(edge[:3, :3]).as_quat().tolist()
    prior = dict(zip(("x_m", "y_m", "z_m"), edge[:3, 3].tolist(), strict=True))
    prior |= {"sigma_m": SIGMA_M, "quaternion_xyzw": turn, "sigma_rad": 1e-5}
    known = run_with(cell, {name: prior})
    sigmas = np.sqrt(np.diag(known.assessment.fit.whole)[:18])
    # Four sigma, for eighteen numbers.
    assert np.all(np.abs(error_of(cell, known)) < 4.0 * sigmas)
    # The board is turned no farther than that is known.
    assert sigmas[12:15].max() < 1.001e-5
    notes = [finding.words for finding in known.verdict.findings if finding.kind == NOTE]
    assert sum("was used" in note and name in note for note in notes) == 3


@pytest.mark.slow
def test_only_the_components_that_views_contradict_are_left_out():
    height = float(X[2, 3])
    prior = {"x_m": float(X[0, 3]) + 0.04, "y_m": float(X[1, 3]) - 0.04, "z_m": height}
    found = calibrate(scara(0, {"flange_from_cam": prior | {"sigma_m": SIGMA_M}}))
    assert found.verdict.status == "check"
    doubts = [finding.words for finding in found.verdict.findings if finding.kind == "prior"]
    for doubt, axis in zip(doubts, "xy", strict=True):
        stated_mm = 1e3 * prior[f"{axis}_m"]
        assert f"{axis}_m of flange_from_cam = {stated_mm:g} mm, known to 0.5 mm, is" in doubt
        seen_mm = float(doubt.partition("alone say ")[2].split()[0])
        # Some ten of their sigmas, and a fifth of the smaller of both offsets.
        assert seen_mm == pytest.approx(1e3 * X["xy".index(axis), 3], abs=1.0)
    kept = f"The measured z_m of flange_from_cam = {1e3 * height:g} mm was used"
    assert any(reason.startswith(kept) for reason in found.verdict.reasons)
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert misfit(found.edges["flange_from_cam"], X) < 22.0


@pytest.mark.slow
def test_a_plan_counts_what_was_measured():
    cell = simulate(CellOptions(robot="ur5e", motion="one_axis", views=8, seed=4))
    place = cell.transforms["flange_from_cam"][:3, 3].tolist()
    prior = dict(zip(("x_m", "y_m", "z_m"), place, strict=True)) | {"sigma_m": SIGMA_M}
    begun = start_from_session(run_with(cell, {"flange_from_cam": prior}))
    (world,) = predict_worlds(
        [begun.cell], PURPOSES["hand-eye"], cell.robot.joints[:1], recorded=begun.recorded
    )
    covariance = world.covariance(np.arange(0))
    # Without a further stop: the three lengths are known to what they were measured to, or better.
    assert np.sqrt(np.diag(covariance)[3:6]).max() < 1.05 * SIGMA_M


def mahalanobis_sq(cell, known):
    """Squared error of both edges over the covariance, divided by their twelve numbers."""
    error, covariance = error_of(cell, known)[:12], known.assessment.fit.whole[:12, :12]
    return error @ np.linalg.solve(covariance, error) / 12


def is_refined(known):
    """Whether the fit moves the intrinsics."""
    return len(known.cell_fit.fit.unknowns.values_of(("lens", "cam"), moved=True)) > 0


def by_sigma(sigma_px):
    return lambda rng: sigma_px * rng.standard_normal(4)


def within(sigma_px):
    """Of the stated sigma, but without the rare draws beyond three sigmas, which are named."""
    return lambda rng: sigma_px * rng.uniform(-(3**0.5), 3**0.5, 4)


def by(*off_px):
    return lambda _: np.array(off_px)


def lens(options, off_px, least=0.0, most=2.74, seeds=1, refined=None, status=None, **table):
    """A case: whether the lens is refined and how it is judged, where that is sure.

    `least` and `most` are limits of the mean of n chi-square of 12 over 12: beyond is one in a
    thousand; what is held errs by a bit more.
    """
    return options, seeds, off_px, table, (least, most), refined, status


REFINE, HOLD, RIGHT = {"intrinsics": "refine"}, {"intrinsics": "hold"}, by(0, 0, 0, 0)


@pytest.mark.parametrize(
    ("options", "seeds", "off_px", "table", "limits", "refined", "status"),
    [
        slow(*lens(FINE, by(4.0, 4.0, -3.0, 2.0), most=2.13, seeds=2, refined=True, **REFINE)),
        lens(FINE, RIGHT, refined=True, status="good", **REFINE),
        slow(*lens(FINE, by_sigma(0.5), 0.2, 2.0, 4, matrix_sigma_px=0.5)),
        # The corners' noise does not absorb the lens's error, and nothing is accused for it.
        slow(*lens(MARKER, within(6.0), 0.5, 1.7, 5, True, "good", matrix_sigma_px=6.0)),
        # Without a prior, one marker tells no lens.
        slow(*lens(MARKER, RIGHT, refined=False, **REFINE)),
        # A lens that is stated for images twice as large.
        slow(*lens(OF_HALF, by(520.0, 519.0, 320.0, 190.0), refined=True)),
        # Corners as exact as centres of circles: both moves are beyond chance.
        slow(*lens(EXACT, by(0.02, -0.02, 0.02, 0.01), status="good")),
        slow(*lens(EXACT, by(0.5, -0.5, 0.5, 0.25), status="check")),
    ],
)
def test_a_stated_lens_counts_by_its_prior_and_is_refined_where_that_helps(
    options, seeds, off_px, table, limits, refined, status
):
    rng, surprises = np.random.default_rng(1), []
    for seed in range(seeds):
        cell = simulate(replace(options, seed=options.seed + seed))
        known = calibrated(cell, session=with_camera(cell, off_px(rng), **table))
        surprises.append(mahalanobis_sq(cell, known))
        assert is_refined(known) == (is_refined(known) if refined is None else refined)
        assert known.verdict.status == (status or known.verdict.status), known.verdict.reasons
        if refined:
            camera = known.cell_fit.fit.camera_parameters.camera("cam")
            sigma = np.sqrt(np.diag(known.assessment.fit.whole))[12:16]
            # Chi-square of four under 23.5 in all but one case of ten thousand.
            assert np.all(np.abs(camera.matrix - options.camera.matrix) < 4.5 * sigma)
        elif "matrix_sigma_px" in table:
            assert known.uncertainty.budget_mm["intrinsics"] > 0.0
        refused = [finding for finding in known.verdict.findings if "was not done" in finding.words]
        assert bool(refused) == (refined is False and table.get("intrinsics") == "refine")
        assert all("matrix_sigma_px" in finding.do.words for finding in refused)
        named = any("do not fit these images" in reason for reason in known.verdict.reasons)
        assert status is None or named == (status == "check")
        (noise_px,) = known.cell_fit.linearised_corners.sigmas_px
        assert noise_px == pytest.approx(options.pixel_sigma_px, rel=0.5)
    assert limits[0] < np.mean(surprises) < limits[1]


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_sigmas_beside_a_lens_that_counts_as_exact_say_what_a_pixel_of_it_moves(mount):
    """The sentence is a derivative of the fit: a lens that is a bit off moves the camera by it."""
    cell = simulate(replace(FINE, mount=mount, seed=2))

    def known(*off_px, **table):
        return calibrated(cell, session=with_camera(cell, np.array(off_px), **table))

    def said(run):
        return [found.words for found in run.verdict.findings if found.kind == "given_lens"]

    right = known(0, 0, 0, 0, **HOLD)
    assert right.verdict.status == "good"
    (words,) = said(right)
    focal_mm, _, _, centre_deg = map(float, re.findall(r"(\S+) (?:mm|deg)\b", words))
    for off_px, place, figure in (((0.2, 0.2, 0, 0), 0, focal_mm), ((0, 0, 0.2, 0), 1, centre_deg)):
        poses = (run.assessment.edges["cam"].matrix for run in (right, known(*off_px, **HOLD)))
        # The sentence has two digits, and the centre's other axis may move it by a bit more.
        assert pose_difference(*poses)[place] == pytest.approx(0.2 * figure, rel=0.1)
    assert not said(known(0, 0, 0, 0, matrix_sigma_px=0.5))
    assert not said(calibrated(simulate(replace(FINE, mount=mount, state_intrinsics=False))))


@pytest.mark.slow
def test_a_held_distortion_that_does_not_fit_is_named_and_freed_by_what_is_advised():
    cell = simulate(replace(FINE, camera=CAMERAS["wide"], seed=4))
    held = calibrated(cell, session=with_camera(cell, distortion=[0.0] * 5, **HOLD))
    (cause, *_) = held.verdict.causes
    assert cause.kind == "lens"
    assert "the distortion, k1, k2, p1, p2, k3, would move corners by up to" in cause.words
    assert cause.do.command.startswith("visioncal convert SESSION FIXED --intrinsics estimate && ")
    freed = calibrated(cell, session=with_camera(cell, distortion=[0.0] * 5, **REFINE))
    # Chi-square of 12 over 12: beyond in one case of a thousand.
    assert mahalanobis_sq(cell, freed) < 2.74


BENT = [-0.28, 0.09, 0.0012, -0.0009, -0.015]


@pytest.mark.parametrize(
    ("true", "off_px", "stated", "words"),
    [
        (BENT, (0, 0, 0, 0), [*BENT[:2], BENT[4], *BENT[2:4]], f"write distortion = {BENT}"),
        slow([0.0] * 5, (0, 0, 0, 0), BENT, "The pictures are rectified"),
        slow(BENT, (0, 0, 80, 60), BENT, "begins 80 px to the right and 60 px below"),
    ],
    ids=["another order", "rectified", "cropped"],
)
@pytest.mark.parametrize("is_long", [False, slow(True)], ids=["", "and another"])
def test_a_lens_that_was_misread_is_named_with_its_right_reading(
    true, off_px, stated, words, is_long
):
    camera = replace(CAMERAS["wide"], distortion=np.array(true))
    cell = simulate(replace(FINE, camera=camera, seed=4))
    known = calibrated(cell, session=with_camera(cell, off_px, distortion=stated))
    (cause, *_) = known.verdict.causes
    assert cause.kind == "lens"
    assert words in cause.words
    assert mahalanobis_sq(cell, known) < 2.74
    if not is_long:
        return
    # Another one is of rectified pictures, too, but of no order and no part.
    other = calibrated(cell, session=with_camera(cell, off_px, distortion=[0.1, *stated[1:]]))
    assert (words in other.verdict.causes[0].words) == (not any(true))


@pytest.mark.parametrize("draws", seeds(1, 2))
def test_a_fisheye_camera_goes_the_whole_way(draws):
    surprises = []
    for seed in draws:
        options = CellOptions(camera=CAMERAS["fisheye"], state_intrinsics=False, seed=seed)
        known = calibrated(cell := simulate(options))
        assert known.used == tuple(range(20))
        assert len(known.cell_fit.fit.values(("lens", "cam"))) == 8
        surprises.append(mahalanobis_sq(cell, known))
    # Mean of chi-squares of 12 over 12: beyond this in one case of a thousand.
    assert np.mean(surprises) < chi2.isf(1e-3, 12 * len(draws)) / (12 * len(draws))


LENS_FREE = CellOptions(state_intrinsics=False, seed=3)


@pytest.mark.slow
def test_a_fisheye_lens_that_is_taken_for_another_is_named():
    wide = known_of(simulate(replace(LENS_FREE, camera=CAMERAS["fisheye"])))
    document = wide.session.document
    camera = {**document["camera"], "model": "brown"}
    session = replace(wide.session, document={**document, "camera": camera})
    verdict = calibrate(session, corners=wide.corners).verdict
    assert verdict.causes[0].kind == "lens_model"
    assert 'write model = "fisheye"' in verdict.causes[0].do.words
    assert "lens_field" not in {found.kind for found in verdict.findings if found.probability}
    narrow = known_of(simulate(LENS_FREE))
    verdict = calibrate(narrow.session, corners=narrow.corners).verdict
    assert "lens_model" not in {found.kind for found in verdict.findings}


@pytest.mark.slow
def test_boards_have_names_and_a_common_covariance_that_holds():
    cell = simulate(replace(TWO, seed=3))
    known = calibrated(cell)
    result, error = result_of(known), error_of(cell, known)
    # Chi-square of eighteen exceeds this in one case of a thousand.
    assert error @ np.linalg.solve(result.joint_covariance, error) < 42.3
    assert list(result.edges) == list(cell.transforms)
    assert set(result.boards) == {"first", "second"}
    for at, edge in enumerate(result.edges.values()):
        rows = slice(6 * at, 6 * at + 6)
        assert np.array_equal(edge.covariance, result.joint_covariance[rows, rows])
    # The boards hang together by the camera's edge.
    assert np.abs(result.joint_covariance[6:12, 12:]).max() > 0.0
    assert np.linalg.eigvalsh(result.joint_covariance).min() > 0.0
    assert all(list(form.matrices) == list(cell.transforms) for form in result.solvers.values())
    park = result.solvers["park"].matrices
    for name, true in cell.transforms.items():
        # Closed forms are off by a few tenths of a millimetre.
        assert np.linalg.norm((invert(true) @ park[name])[:3, 3]) < 2e-3


@pytest.mark.slow
def test_one_view_places_a_board_and_a_board_without_views_is_reported():
    cell = simulate(replace(TWO, second=replace(Second(), target=BOARDS["charuco"]), seed=6))
    first, further = (np.flatnonzero(board_numbers(cell) == board) for board in (0, 1))
    known = calibrated(without(cell, {*further[1:]}))
    edges = result_of(known).edges
    edge = edges["base_from_target_second"]
    assert edge.sigma_mm > edges["base_from_target_first"].sigma_mm
    # One draw of chi-square with six degrees of freedom, at one in ten thousand.
    assert misfit(edge, cell.transforms["base_from_target_second"]) < chi2.ppf(1.0 - 1e-4, 6)
    # Without that view nothing places the board: it has no part in what is held out.
    assert np.isnan(known.assessment.held_out.residual_m).sum() == 1
    assert np.isfinite(known.findings.held_out.mm)
    known = calibrated(without(cell, {*further}))
    assert list(result_of(known).edges) == ["flange_from_cam", "base_from_target_first"]
    assert any("No usable view shows target second" in reason for reason in known.verdict.reasons)
    with pytest.raises(DegenerateError, match="it takes 3 stops or more"):
        calibrated(without(cell, {*first[2:], *further[2:]}))


def test_every_output_shows_all_boards(tmp_path):
    cell = simulate(replace(TWO, seed=10))
    session = Session.load(write_session(cell, tmp_path / "pairs", images=False))
    written = run(session)
    write_outputs(tmp_path / "out", session, written)
    file = tmp_path / "out" / "recording.rrd"
    assert Session.load(file).digest() == session.digest()
    again = run(Session.load(file)).calibration
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    logged = {str(chunk.entity_path) for chunk in RrdReader(file).stream()}
    for name, edge in written.calibration.edges.items():
        assert np.array_equal(again.edges[name].matrix, edge.matrix)
        assert np.array_equal(again.edges[name].covariance, edge.covariance)
        assert name in report
    assert {f"/targets/{name}/sheet" for name in ("first", "second")} <= logged
    with pytest.raises(DataError, match=r"several targets \(first, second\)"):
        detect_session_target(session, written.calibration, "base")


@pytest.mark.slow
def test_sections_of_the_fit_are_read_back_as_written():
    """Further boards are written relative to the first."""
    wrong = replace(TWO, seed=2, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
    known = calibrated(simulate(wrong))
    assert known.robot_arm.model is not None
    prior, solved = CalibrationPrior.of(result_of(known)), known.assessment
    np.testing.assert_allclose(prior.state.edges, solved.fit.state.edges, atol=1e-12)
    # What lenses do beyond their models is not written.
    written = np.delete(
        np.arange(len(solved.fit.whole)), solved.fit.unknowns.of_kinds("lens errors")
    )
    covariance = solved.fit.whole[np.ix_(written, written)]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    # Slopes there and back undo each other up to rounding.
    np.testing.assert_allclose(prior.covariance / scale, covariance / scale, atol=1e-6)


def texts(pose):
    return [repr(value) for value in pose_row(pose).values()]


def scara(seed: int, prior: dict[str, dict[str, float]], views: int = 12, tilted: int = 0):
    """A session of four axes: the tool turns about z alone, but for some first views."""
    rng, rows = np.random.default_rng(seed), []
    for view in range(views):
        turn = np.array([0.0, 0.0, rng.uniform(-2.5, 2.5)])
        if view < tilted:
            turn = rng.uniform(-0.5, 0.5, 3)
        place = np.array([0.4, 0.1, 0.1]) + rng.uniform(-0.1, 0.1, 3)
        flange = compose(Rotation.from_rotvec(turn).as_matrix(), place)
        seen = invert(flange @ X) @ Z @ exp(NOISE * rng.standard_normal(6))
        rows.append([str(view), *texts(flange), *texts(seen)])
    document = {"schema": 1, "name": "scara", "mount": "eye-in-hand", "prior": prior}
    columns = ["view", *POSE, *(f"cft_{name}" for name in POSE)]
    return Session.assemble(document, columns, rows, MemoryImages({}))


def run_with(cell: SimulatedCell, prior: dict[str, dict[str, float]]) -> RunState:
    """Calibrates a cell whose session knows something beforehand."""
    session = known_of(cell).session
    session = replace(session, document={**session.document, "prior": prior})
    return calibrated(cell, session=session, level="hand-eye")


def test_rows_that_cannot_be_used_are_named():
    prior = {"z_m": 0.1, "sigma_m": SIGMA_M}
    other = calibrate(scara(5, {"base_from_cam": prior}, 14, tilted=8)).verdict
    words = (
        "[prior.base_from_cam] was not used: what is unknown of this session is flange_from_cam "
        "and base_from_target"
    )
    assert any(words in reason for reason in other.reasons)
    (unused,) = (cause for cause in other.causes if cause.kind == "unused")
    assert unused.do.words.endswith("or delete [prior.base_from_cam] from session.toml.")
    closed = calibrate(scara(5, {"flange_from_cam": prior}, 14, tilted=8), solver="park").verdict
    assert any("was not used: the closed form park cannot" in reason for reason in closed.reasons)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.01, 0.484])
def test_measured_distances_of_another_scale_are_named_and_mended(scale, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = CellOptions(mount="eye-to-hand", views=16, board_scale=scale, seed=2)
    session = cell_session(simulate(options), "measured", seen="poses")
    verdict = calibrate(session).verdict
    assert verdict.status != "good"
    session.save("cell")
    assert follow("calibrate", "cell", "-o", "out").last.status == 0
    if scale < 0.8:
        # Farther than a fit follows, it is another reading.
        assert verdict.causes[0].kind == "misread_poses"
        assert "the board, 0.484" in verdict.causes[0].words
        return
    (named,) = (finding for finding in verdict.findings if finding.kind == "board_size")
    assert verdict.causes[0] is named
    # A scale's sigma is a hundredth of a percent there; the factor has five digits.
    factor = float(re.search(r"--board-scale ([\d.]+)", named.do.command)[1])
    assert factor == pytest.approx(scale, abs=4e-4)
    # The sentence says the same, with two digits.
    share, size = re.search(r"the board is ([\d.]+) % .* (larger|smaller)", named.words).groups()
    said = 1.0 + float(share) / 100.0 * (1 if size == "larger" else -1)
    assert said == pytest.approx(factor, abs=0.05 * abs(1.0 - scale))


def test_a_board_of_quite_another_size_is_as_large_as_the_fit_says():
    """Poses of single images find another reading, of a size that would be held as stated."""
    options = CellOptions(views=12, board_scale=0.8, seed=3, pixel_sigma_px=0.05)
    verdict = calibrate(cell_session(simulate(options), "cell", seen="corners")).verdict
    named, *_ = verdict.causes
    assert named.kind == "board_size"
    # Four sigmas of 12 views of an arm that repeats to 0.1 mm.
    factor = float(re.search(r"--board-scale ([\d.]+)", named.do.command)[1])
    assert factor == pytest.approx(0.8, rel=4e-4)
    assert not any(finding.kind == "misread_poses" for finding in verdict.findings)


@pytest.mark.slow
def test_an_arm_that_is_off_is_no_other_scale():
    arm = simulate(CellOptions(views=10, dh_sigma_m=2e-3))
    verdict = calibrate(cell_session(arm, "measured", seen="poses")).verdict
    assert "board_size" not in {finding.kind for finding in verdict.findings}


def test_a_head_that_only_turns_says_nothing_of_the_scale():
    rng = np.random.default_rng(3)
    pan, tilt = rng.uniform(-0.4, 0.4, (2, 18))
    turns = Rotation.from_euler("ZY", np.column_stack([pan, tilt])).as_matrix()
    noise = exp(rng.normal(size=(18, 6)) * np.repeat([3e-3, 5e-4], 3))
    for off_m in (0.0, 1e-4):
        # Axes that meet, and that do not quite, so that the head moves by a thirtieth of a mm.
        head = compose(turns, off_m * turns[:, :, 0] + np.array([0.0, 0.0, 0.25]))
        seen = invert(X) @ invert(head) @ Z @ noise
        assert distance_scale(head, seen, X) is None
    # An arm that moves by decimetres does, with the same noise.
    arm = compose(turns, rng.uniform(-0.2, 0.2, (18, 3)))
    seen = invert(X) @ invert(arm) @ Z @ noise
    seen[:, :3, 3] /= 1.1
    found = distance_scale(arm, seen, X)
    factor = float(re.search(r"--board-scale ([\d.]+)", found.do.command)[1])
    # To a twentieth of the error: 18 views with half a millimetre of noise leave a fiftieth.
    assert factor == pytest.approx(1.1, abs=5e-3)


def single_tags(rms_mm, rms_deg, views=30, seed=0):
    """A session of an exact arm and poses of a tag whose errors last over neighbouring views."""
    rng = np.random.default_rng(seed)
    tilts = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (views, 3))).as_matrix()
    places = rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.8], (views, 3))
    seen = compose(tilts, places)
    flanges = Z @ invert(seen) @ invert(X)
    # A tag's errors follow how it is seen: smoothly, by its place in the image.
    waves = np.sin(places @ rng.normal(0.0, 12.0, (3, 6)) + rng.uniform(0.0, 6.0, 6))
    waves *= np.sqrt(2.0 / 3.0) * np.repeat([np.deg2rad(rms_deg), 1e-3 * rms_mm], 3)
    noisy = seen @ exp(waves + rng.normal(size=waves.shape) * np.repeat([1e-4, 5e-5], 3))
    return pairs_session("eye-in-hand", flanges, noisy)


@pytest.mark.slow
@pytest.mark.parametrize(("mm", "deg", "is_accused"), [(0.8, 0.1, True), (8.0, 1.0, False)])
def test_an_arm_is_not_accused_of_more_than_arms_err_by(mm, deg, is_accused):
    verdict = calibrate(single_tags(mm, deg, seed=7)).verdict
    assert verdict.status != "good"
    assert ("arm_errors" in {found.kind for found in verdict.findings}) is is_accused
    if not is_accused:
        assert verdict.causes[0].kind == "unexplained"
        assert "the arm's own errors" not in " ".join(verdict.reasons)


@pytest.mark.slow
def test_the_motion_is_not_to_blame_for_errors_that_last():
    """Chance may explain them, so that no finding on the arm says so."""
    verdict = calibrate(single_tags(0.8, 0.1)).verdict
    (weak,) = verdict.causes
    assert weak.kind == "weak_motion"
    assert weak.words.startswith("Weakly determined by errors that last from view to view")
    assert "tilted" not in weak.do.words


@pytest.mark.slow
@pytest.mark.parametrize(("off", "mount"), crossed([0.0, 3e-4], ["eye-in-hand", "eye-to-hand"]))
def test_a_size_of_measured_distances_competes_with_the_lengths_of_an_arm(mount, off) -> None:
    """Both stay in the covariance: neither becomes an error of the frames."""
    errors = {"dh_sigma_m": off, "dh_sigma_rad": off, "offset_sigma_rad": off}
    options = CellOptions(mount=mount, views=20, board_scale=1.004, seed=2, **errors)
    truth = simulate(options)
    found = calibrate(cell_session(truth, "measured", seen="poses"))
    assert found.verdict.causes[0].kind == "board_size"
    assert "takes the robot's scale" in found.verdict.causes[0].words
    for name, edge in found.edges.items():
        away = log(invert(edge.matrix) @ truth.transforms[name])
        assert away @ np.linalg.solve(edge.covariance, away) < chi2_limit(1e-3, 6)
