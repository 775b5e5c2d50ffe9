"""What a result is valid for: the condition goes with every output."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cells import calibrated, showing
from support.wrong_arms import WRONG_LINKS

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.suspects.judge import judge
from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import controller_form
from visioncal.core.number_format import figure, rounded_up
from visioncal.core.transforms import invert, log
from visioncal.core.types import Need
from visioncal.interchange.exports import EXPORT_FORMATS, Selection, document
from visioncal.present.recording.notes import verdict_markdown
from visioncal.present.report.page import write_certificate
from visioncal.results.lens import sensor_tilt
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.boards import centre_m, corners_m
from visioncal.vision.camera import matrix_3x3

# A board whose size is known, so that picks err by the arm and not by the board.
SURE = replace(WRONG_LINKS, target=replace(WRONG_LINKS.target, square_sigma_m=1e-7), seed=1)


@pytest.fixture(scope="module", params=["eye-in-hand", "eye-to-hand"])
def run(request):
    """A cell with a wrong arm, which was calibrated along."""
    return calibrated(simulate(replace(SURE, mount=request.param)))


@pytest.fixture(scope="module")
def result(run):
    return result_of(run)


def test_picks_by_the_controllers_poses(result):
    """They err as the nominal arm does; a pick looks from one view, and goes to another."""
    cell = simulate(replace(SURE, mount=result.mount))
    x, z = (edge.matrix for edge in result.edges.values())
    nominal = result.robot.base_from_flange(cell.robot.joints)
    middle = np.append(centre_m(cell.board()), 1.0)
    if result.mount == "eye-in-hand":
        places = (nominal @ x @ cell.cam_from_target @ middle)[:, :3]
        looks, goes = np.nonzero(~np.eye(len(places), dtype=bool))
        away_m = places[looks] - places[goes]
    else:
        away_m = ((x @ cell.cam_from_target - nominal @ z) @ middle)[:, :3]
    within_mm = 1e3 * np.quantile(np.linalg.norm(away_m, axis=1), 0.95)
    # The error is known but for the calibration's own, which is 5 % of it; of the views, too, a
    # quantile of 30 is known to about so much.
    assert result.verdict.good_for_mm_uncorrected == pytest.approx(within_mm, rel=0.1)
    assert result.verdict.good_for_mm < 0.2 * within_mm


def test_the_verdict_is_about_the_controllers_poses(run, result):
    need = Need(2.0 * result.verdict.good_for_mm)
    uncorrected = judge(replace(run.findings, need=need))
    assert uncorrected.status == "bad"
    assert uncorrected.causes[0].kind == "uncorrected_targets"
    assert "visioncal correct" in uncorrected.next_steps[0].command
    assert judge(replace(run.findings, need=need, corrects_targets=True)).status == "good"
    met = Need(1.05 * result.verdict.good_for_mm_uncorrected)
    assert judge(replace(run.findings, need=met)).status == "good"
    assert judge(replace(run.findings, need=Need(0.95 * met.mm / 1.05))).status == "check"


def test_the_condition_goes_with_every_output(result, tmp_path):
    (condition,) = result.conditions
    assert condition.kind == "calibrated-arm"
    limit = figure(rounded_up(result.verdict.good_for_mm_uncorrected))
    assert f"within {limit} mm" in condition.sentence
    write_certificate(tmp_path / "page.html", result, None, {})
    said = [(tmp_path / "page.html").read_text(), result._repr_html_(), verdict_markdown(result)]
    assert all("belong to the calibrated arm" in text for text in said)
    for form in ("ur", "kuka", "abb", "ros", "urdf", "easy-handeye", "opencv", "text"):
        written = document(result, form)
        # XML and OpenCV wrap or escape what they hold; the sentence's first words are in one line.
        assert "belong to the calibrated arm" in written.text, form
        assert any(condition.sentence in warning for warning in written.warnings), form
    assert any(condition.sentence in text for text in document(result, "zivid").warnings)
    lens = [form.name for form in EXPORT_FORMATS if getattr(form, "holds", "") == "lens"]
    for form in lens[:1]:
        assert condition.sentence not in " ".join(document(result, form, Selection()).warnings)


@pytest.mark.slow
def test_a_nominal_arm_has_no_condition():
    plain = result_of(calibrated(simulate(replace(SURE, views=12)), joints=False))
    assert plain.conditions == ()
    assert plain.verdict.good_for_mm_uncorrected is None


@pytest.mark.parametrize(
    ("model", "form"),
    [
        ("ur5e", "ur"),
        ("LBR iiwa 7", "kuka"),
        ("irb120", "abb"),
        ("FANUC LR Mate 200iD", "fanuc"),
        ("panda", None),
    ],
)
def test_the_controllers_notation_by_the_robots_name(model, form):
    assert controller_form(model) is (None if form is None else POSE_FORMS[form])


NAME = "flange_from_cam"
# A sensor tilted by a degree about each of its axes, behind a lens that is not decentred.
TILT_DEG = np.array([1.0, 1.0])
ORDINARY = CellOptions(
    views=20, state_intrinsics=False, pixel_sigma_px=0.05, robot_sigma_m=5e-5, robot_sigma_rad=1e-4
)


@pytest.fixture(scope="module")
def tilted_cell():
    """A cell whose camera shows what it sees by a tilted sensor, without decentring."""
    made = simulate(replace(ORDINARY, seed=1))
    rng, camera, board = np.random.default_rng(1), made.options.camera, corners_m(made.board())
    # OpenCV's 14 coefficients.
    lens = np.zeros(14)
    lens[[0, 1, 4]], lens[12:] = camera.distortion[[0, 1, 4]], np.deg2rad(TILT_DEG)
    shown, zero = [], np.zeros(3)
    for pose, corners in zip(made.cam_from_target, made.corners, strict=True):
        points = board[corners.ids] @ pose[:3, :3].T + pose[:3, 3]
        px, _ = cv2.projectPoints(points, zero, zero, matrix_3x3(camera), lens)
        noise = rng.normal(0.0, made.options.pixel_sigma_px, (len(points), 2))
        shown.append(replace(corners, px=px[:, 0] + noise))
    return showing(made, shown)


@pytest.fixture(scope="module")
def tilted(tilted_cell):
    return result_of(calibrated(tilted_cell, joints=False))


@pytest.mark.slow
def test_a_tilted_sensor_is_a_condition_with_its_size(tilted_cell, tilted):
    (condition,) = tilted.conditions
    assert condition.kind == "own-lens"
    error_deg = np.rad2deg(
        np.linalg.norm(log(invert(tilted.edges[NAME].matrix) @ tilted_cell.transforms[NAME])[:3])
    )
    assert error_deg == pytest.approx(np.linalg.norm(TILT_DEG), rel=0.1)
    assert error_deg > 10.0 * tilted.edges[NAME].sigma_deg
    tilt = sensor_tilt(tilted.camera)
    # The noise, and a tenth for the orders of distortion that decentring does not follow.
    within = 3.0 * tilt.sigma_rad + 0.1 * np.deg2rad(error_deg)
    assert tilt.rad == pytest.approx(np.deg2rad(error_deg), abs=within)


def test_decentring_behind_hardly_any_radial_distortion_is_no_tilt(tilted):
    """Its p1 and p2 are those of any lens; by the radial distortion they would be many degrees."""
    lens = tilted.camera
    distortion = np.array([0.0095, -0.0075, 0.00003, -0.00057, -0.0058])
    weak = replace(lens, camera=replace(lens.camera, distortion=distortion))
    tilt = sensor_tilt(weak)
    assert np.rad2deg(tilt.rad) > 1.5
    assert replace(tilted, camera=weak).conditions == ()


def test_a_stated_lens_and_a_bad_result_have_no_such_condition(tilted):
    held = replace(tilted, camera=replace(tilted.camera, estimated=False))
    assert held.conditions == ()
    bad = replace(tilted, verdict=replace(tilted.verdict, status="bad"))
    assert bad.conditions == ()


def test_every_output_carries_the_condition(tilted, tmp_path):
    (condition,) = tilted.conditions
    write_certificate(tmp_path / "page.html", tilted, None, {})
    assert "own lens" in (tmp_path / "page.html").read_text()
    assert "own lens" in tilted._repr_html_()
    for name in ("ur", "kuka", "urdf", "easy-handeye", "zivid"):
        assert condition.words in document(tilted, name).warnings, name
