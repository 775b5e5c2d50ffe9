"""Verdicts: each doubt with its sentence, what a task needs, and causes by their probability."""

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc
from support.cells import calibrated, cell_session, pairs_session, reporting, showing
from support.marks import slow
from support.sound_findings import SOUND, changed, directions, views

from visioncal.calibration.guess import guess_reading
from visioncal.calibration.pipeline.checkup import doctor
from visioncal.calibration.pipeline.judging import findings_of
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.need import Picks, need_met
from visioncal.calibration.suspects.arm import NO_JOINTS
from visioncal.calibration.suspects.board import scale_finding
from visioncal.calibration.suspects.judge import in_reading_order, judge
from visioncal.calibration.suspects.lens import pane_finding
from visioncal.calibration.suspects.moved_views import _changed_words
from visioncal.calibration.suspects.outliers import farthest_by_arms
from visioncal.calibration.suspects.ranking import MEASURE_BOARD, correcting, rank_causes
from visioncal.core.codec import read, write
from visioncal.core.conventions import PoseNumbers
from visioncal.core.quantiles import chi2_limit
from visioncal.core.tolerance_probability import chance_within, radius_within
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import MOUNTS, Need, Rejection
from visioncal.core.verdict import (
    CALIBRATE,
    GUESS,
    GUESS_AND_CALIBRATE,
    LEFT_OPEN,
    PLAN,
    READ_AGAIN,
    Finding,
    Remedy,
    Verdict,
    need_options,
    remarks,
    with_paths,
)
from visioncal.estimation.joint import MeasuredScale, size_of_measured
from visioncal.estimation.unknowns import LENS
from visioncal.interchange.formats.mending import remove_tool
from visioncal.model.effects import Window
from visioncal.present.report.content import need_facts
from visioncal.results import Calibration, Rms, to_document
from visioncal.results.parts import VerdictForm
from visioncal.robot import load_robot
from visioncal.robot.conversion import with_base
from visioncal.robot.errors import ArmErrors, pose_basis
from visioncal.robot.files import read_robot_document
from visioncal.session import Session
from visioncal.session.columns import POSE
from visioncal.simulation import CAMERAS, CellOptions, SimulatedCell, simulate
from visioncal.vision.camera import intrinsics
from visioncal.vision.targets import corner_positions, load_target

EXCHANGED = Finding(
    "exchanged_views",
    "Views 3 and 4 are exchanged: the image of each fits the pose in the other's row.",
    Remedy("Exchange them.", CALIBRATE),
    (3, 4),
    without_it="Without them all is well.",
)
POSTURE = Finding("arm_errors", "Residuals follow the arm's posture.", mahalanobis_sq=45.0)
FIELD = Finding("lens_field", "The lens departs.", mahalanobis_sq=300.0, up_to_mm=0.08)
DRIFT = Finding("moved_slowly", "Residuals drift with time.")
MEASURED = MeasuredScale(4.7e-3, 6e-4, 8e-4)
SIZE = scale_finding(
    "board", load_target("charuco_9x6_30mm"), MEASURED, replace(MEASURED, scale=4e-3, sigma=9e-4)
)
HELD_LENS = Finding("lens", "The given intrinsics do not fit.", mahalanobis_sq=2000.0)
FOCUS = Finding("focus", "The lens changes its focal length.", mahalanobis_sq=300.0)
MOVED = Finding("something_moved", "From view 12 on, the camera stood elsewhere.")
HOME = Remedy('Write model = "ur5e".')
MISREAD = Finding("misread_joints", "With the arm a ur5e and not a ur3e, they fit.", HOME)
ALIKE = replace(load_target("checkerboard_9x6_25mm"), rows=7)
LOST = [Rejection(at, "blurred: very") for at in range(30, 40)]
MISSPELT = Finding("remark", "squaresize is not read.", Remedy("Correct it."))
NEED = Need(0.5)


def chi2_chance(square: float) -> float:
    return float(chdtrc(1.0, square))


def ids(verdict: Verdict) -> list[str]:
    return [cause.kind for cause in verdict.causes]


@pytest.mark.parametrize(
    ("warnings", "chances"),
    [
        ((DRIFT,), (1e-4,)),
        # Those that give figures are weighed by them: twice a gain of 45, and 3.9 sigmas of all
        # sources.
        ((POSTURE, DRIFT), (chi2_chance(45.0), 1e-4)),
        ((SIZE, DRIFT), (chi2_chance(4.7**2 / (0.9**2 + 0.8**2)), 1e-4)),
    ],
)
def test_explanations_of_one_misfit_share_it(warnings, chances) -> None:
    """By the bound of Sellke, Bayarri and Berger on what a chance says, none of them among them."""
    verdict = judge(changed(SOUND, warnings=warnings, noise_mm=1.0))
    odds = {text: -1.0 / (np.e * p * np.log(p)) for text, p in zip(warnings, chances, strict=True)}
    found = {cause.words: cause.probability for cause in verdict.causes}
    for text in warnings:
        assert found[text.words] == pytest.approx(odds[text] / (1.0 + sum(odds.values())))
    (unexplained,) = (cause for cause in verdict.causes if cause.kind == "unexplained")
    assert unexplained.probability == pytest.approx(1.0 / (1.0 + sum(odds.values())))
    assert sum(cause.probability for cause in verdict.causes) == pytest.approx(1.0)


def test_an_error_that_moves_picks_little_is_no_cause_of_a_large_misfit() -> None:
    """However sure it is that it is there."""
    found = changed(SOUND, warnings=(FIELD, SIZE), noise_mm=1.0)
    verdict = judge(found)
    assert ids(verdict)[0] == "board_size"
    share = (FIELD.up_to_mm / found.held_out.mm) ** 2
    assert next(cause for cause in verdict.causes if cause.kind == "lens_field").probability < share
    # Of what is small, or not known, the evidence decides.
    for warnings in ((replace(FIELD, up_to_mm=5.0), SIZE), (replace(FIELD, up_to_mm=np.inf), SIZE)):
        assert ids(judge(replace(found, warnings=warnings)))[0] == "lens_field"
    assert ids(judge(replace(changed(SOUND), warnings=(FIELD,)))) == ["lens_field"]


def test_a_held_lens_explains_a_misfit_that_it_is_large_enough_for() -> None:
    """No step then says that nothing explains it."""
    found = changed(SOUND, noise_mm=1.0)
    for up_to_mm, is_explained in ((2.0 * found.held_out.mm, True), (0.1, False)):
        warnings = (replace(HELD_LENS, up_to_mm=up_to_mm),)
        verdict = judge(replace(found, warnings=warnings))
        (unexplained,) = (one for one in verdict.findings if one.kind == "unexplained")
        assert (unexplained.do is None) == is_explained


def test_effects_of_a_cause_are_no_causes_and_have_no_steps_of_their_own() -> None:
    wrong = Finding("wrong_views", "View 3 was left out.", Remedy("Delete its row."), (3,))
    short = Finding("stops_short", "The arm stood short.", mahalanobis_sq=300.0)
    sole, joint = (judge(changed(SOUND, warnings=some)) for some in ((wrong,), (short, wrong)))
    assert ids(sole) == ["wrong_views"]
    assert ids(joint) == ["stops_short"]
    assert next(one for one in joint.findings if one.kind == "wrong_views").do is None


def test_errors_of_an_arm_are_as_likely_as_what_another_cure_leaves() -> None:
    refined = replace(HELD_LENS, mahalanobis_sq=0.0)
    for left, first in ((1.0, "arm_errors"), (1e-3, "lens")):
        found = changed(SOUND, warnings=(replace(POSTURE, explains=left), refined))
        assert ids(judge(found))[0] == first


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("charuco_9x6_30mm", "squares of 30.14 mm, not of 30 mm"),
        ("aprilgrid_6x4_32mm", "tags of 32.15 mm, not of 32 mm"),
        ("apriltag_36h11_id0_120mm", "a side of 120.6 mm, not of 120 mm"),
    ],
)
def test_another_size_is_reported_under_the_key_of_the_targets_file(name, said) -> None:
    found = scale_finding("board", load_target(name), MEASURED, MEASURED, "left")
    assert said in found.words
    assert "--board-scale left:1.0047 " in found.do.command
    # By so little, an arm may err as well; by more, none does.
    rival = "the board is as stated, and the arm goes 0.47 % less far than it reports"
    assert found.rivals == (rival,)
    assert found.in_words().words == f"{found.words}{LEFT_OPEN} {rival}."
    larger = replace(MEASURED, scale=9e-3)
    found = scale_finding("board", load_target(name), larger, larger, "left")
    assert not found.rivals
    assert "if the board is right, the arm's model is off by as much" in found.words


@pytest.mark.parametrize(("tilt_deg", "kind"), [(60.0, "window"), (103.0, "lens_field")])
def test_a_pane_through_which_no_camera_looks_is_of_the_lens(tilt_deg: float, kind: str) -> None:
    tilt = np.deg2rad(tilt_deg)
    pane = Window("cam", (float(np.sin(tilt)), 0.0, float(np.cos(tilt))))
    assert pane_finding(pane, np.array([2e-3, 0.0, 0.0])).kind == kind


def test_a_result_that_goes_far_from_the_stated_size_says_so() -> None:
    """However unsure the robot alone is of that."""
    target, measured = load_target("charuco_9x6_30mm"), MeasuredScale(4.7e-3, 1.7e-3, 3e-4)
    for scale, kind in ((4.6e-3, "board_size"), (7e-4, "note")):
        written = replace(measured, scale=scale, sigma=8e-4)
        assert scale_finding("board", target, measured, written).kind == kind


@pytest.mark.parametrize(("repeatability", "is_doubt"), [((0.1, 0.01), True), ((5.0, 1.5), False)])
def test_noise_is_plausible_by_the_kind_of_arm(repeatability, is_doubt) -> None:
    arm = replace(
        SOUND.arms[0], noise_mm=6.0, noise_deg=2.0, lower_bounds=None, repeatability=repeatability
    )
    scattered = replace(SOUND.pairs[0], weighted_held_out=Rms(30.0, 4.0))
    found = ids(judge(replace(SOUND, arms=(arm,), pairs=(scattered,))))
    assert ("unexplained" in found) == is_doubt
    servo = load_robot("so101")
    for arm in (servo, servo.corrected(), with_base(servo, exp(np.full(6, 0.1)))):
        assert arm.repeatability == (5.0, 1.5)
    assert load_robot("ur5e").repeatability == (0.1, 0.01)


@pytest.mark.parametrize("need", [None, Need(0.5)])
def test_errors_that_are_too_large_come_from_their_sources(need) -> None:
    large, small = (np.diag(np.repeat([1e-6, value], 3) ** 2)[None] for value in (4e-4, 3e-4))
    picks = (Picks("cam", "robot", {"calibration": small, "look": large}, np.inf, 0.5),)
    found = replace(SOUND, need=need, picks=picks, worst=directions(2e-3, 0, 0, 0))
    verdict = judge(found)
    assert ids(verdict) == ["robot_noise", "calibration"]
    assert [cause.probability for cause in verdict.causes] == pytest.approx([0.64, 0.36])
    without = f"Without this part 95 % of picks land within {0.3 * np.sqrt(7.815):.2f} mm"
    assert verdict.causes[0].without_it.startswith(without)
    assert ("within what is needed" in verdict.causes[0].without_it) == (need is not None)
    # No command proposes views of an arm whose model nobody knows.
    assert "visioncal plan proposes them" in verdict.causes[1].do.words
    assert not verdict.causes[1].do.command
    (arm,) = found.arms
    known = judge(replace(found, arms=(replace(arm, modelled=True),)))
    assert known.causes[1].do.command == PLAN
    # No view tells how large a board is that limits the rest.
    parts = {"calibration": small, "board": 1.1 * small, "look": large}
    of_board = judge(replace(found, picks=(replace(picks[0], parts=parts),)))
    assert all(cause.do is MEASURE_BOARD for cause in of_board.causes[1:])
    # What can be had without them is no cause of a doubt about something else.
    met = replace(found, need=None, worst=directions(1e-4), warnings=(DRIFT,))
    assert ids(judge(met)) == ["moved_slowly"]


@pytest.mark.parametrize(("repeats", "advised"), [((0.1, 0.01), False), ((5.0, 1.5), True)])
def test_no_better_robot_is_advised_where_none_errs_so(repeats, advised) -> None:
    """Eight millimetres are a servo arm's noise, and no industrial arm's."""
    spread = np.diag(np.repeat([1e-6, 5e-3], 3) ** 2)[None]
    picks = (Picks("cam", "robot", {"pick": spread}, np.inf, 0.1),)
    (arm,) = SOUND.arms
    found = replace(SOUND, need=NEED, picks=picks, arms=(replace(arm, repeatability=repeats),))
    verdict = judge(found)
    assert any("repeats better" in str(cause.do) for cause in verdict.causes) == advised
    # Ten centimetres from the camera, 14 mm are no task.
    assert not any(
        "good for" in finding.words for finding in judge(replace(found, need=None)).findings
    )


def test_a_sigma_far_beyond_its_limit_is_the_cause_of_a_bad_result() -> None:
    spread = np.diag(np.repeat([1e-6, 4e-4], 3) ** 2)[None]
    picks = (Picks("cam", "robot", {"look": spread}, np.inf, 0.5),)
    bad = replace(SOUND, picks=picks, worst=directions(4e-3))
    verdict = judge(bad)
    assert verdict.status == "bad"
    # What picks err by is within the limits, and no reason for it.
    assert ids(verdict) == ["weak_motion"]
    assert verdict.reasons[0].startswith("Weakly determined by the motion")
    misplaced = replace(bad, worst=directions(1e-4), picks=(of_size(4.0),))
    assert ids(judge(misplaced)) == ["place"]
    # A mistake that is found is likelier, and a need asks for what picks err by.
    drifting = judge(replace(bad, warnings=(DRIFT,)))
    assert "moved_slowly" in ids(drifting)
    assert "weak_motion" not in ids(drifting)
    assert ids(judge(replace(bad, need=Need(0.5)))) == ["robot_noise"]


def test_the_cause_its_cost_and_what_to_do_come_first() -> None:
    found = (
        Finding("place", "A point is placed to 4 mm.", Remedy("Add views."), is_fatal=True),
        Finding("remark", "It is odd."),
        Finding("lens", "The lens is another.", Remedy("Leave it out."), probability=0.2),
        DRIFT,
        replace(EXCHANGED, probability=0.7),
        Finding("holdout", "Held back.", Remedy("Add views."), probability=0.01),
    )
    verdict = Verdict("bad", in_reading_order(found, "bad"))
    assert verdict.top == (
        f"Most likely (70 %): {EXCHANGED.words} Without them all is well.",
        "A point is placed to 4 mm.",
        "Possibly (20 %): The lens is another.",
    )
    assert verdict.rest == ("It is odd.", DRIFT.words, "Held back.")
    sure = replace(found[2], probability=0.6)
    assert Verdict("bad", (found[4], sure)).top[1] == "Also likely (60 %): The lens is another."
    assert verdict.next_steps == (EXCHANGED.do, Remedy("Add views."), Remedy("Leave it out."))
    # A cure that was tried precedes what is as certain by a limit alone.
    field = Finding("lens", "The lens is odd.", probability=1.0, by_limit=True)
    size = Finding("board_size", "The board is larger.", probability=1.0 - 1e-9)
    assert in_reading_order((field, size), "bad") == (size, field)
    assert Verdict.of("good", "Fine.").top == ("Fine.",)


def test_findings_are_kept_and_name_the_session(tmp_path: Path, monkeypatch) -> None:
    verdict = judge(changed(SOUND, warnings=(EXCHANGED,), stops=8))
    document = json.loads(json.dumps(write(VerdictForm, verdict)))
    assert read(VerdictForm, document, "verdict").verdict("verdict") == verdict
    first = verdict.causes[0]
    assert (first.without_it, first.do, first.probability > 0.9999) == (
        EXCHANGED.without_it,
        EXCHANGED.do,
        True,
    )
    named = verdict.with_paths(tmp_path / "my cell", "out")
    command = f"visioncal calibrate '{tmp_path}/my cell' -o out"
    assert named.next_steps[0].command == command
    # Too few stops were found before it, and are no cause.
    assert command in named.reasons[0]
    folder = tmp_path / "cell"
    # An apostrophe of a sentence is no quotation.
    assert with_paths("Look at the camera's driver.", folder) == "Look at the camera's driver."
    assert with_paths(GUESS, folder) == f"visioncal convert {folder} {folder}-fixed --guess --yes"
    # A copy of the folder in which somebody stands is beside it.
    monkeypatch.chdir(tmp_path)
    assert with_paths(GUESS, ".").split()[2:4] == [".", f"../{tmp_path.name}-fixed"]
    some = ("--need-mm", "0.5", "--views", "1-9")
    of_others = with_paths("visioncal calibrate SESSION -o NEW --views 2-5", "s", "out", need=some)
    assert of_others == "visioncal calibrate s -o out-new --need-mm 0.5 --views 2-5"
    needed = with_paths(GUESS_AND_CALIBRATE, "s", "out", need=("--need-mm", "0.5"))
    assert needed.endswith("&& visioncal calibrate s-fixed -o out --need-mm 0.5")
    command = correcting(Need(mm=0.5)).command
    needed = with_paths(command, "s", "out", need=need_options(0.5, None))
    assert needed.startswith("visioncal calibrate s -o out --need-mm 0.5 --corrected && ")
    assert need_options(None, 0.1, corrected=True) == ("--need-deg", "0.1", "--corrected")
    again = with_paths("visioncal calibrate SESSION -o NEW", folder, tmp_path / "out.2")
    assert again.endswith(f"-o {tmp_path}/out.2-new")
    recording = tmp_path / "cell.rrd"
    recording.touch()
    assert with_paths(GUESS, recording).endswith(f"cell.rrd {folder}-fixed --guess --yes")


def session_of(cell: SimulatedCell, base_from_flange: np.ndarray) -> Session:
    """A cell's corners with other reported poses."""
    return Session.from_corners(
        [(view_corners.ids, view_corners.px) for view_corners in cell.corners],
        base_from_flange,
        cell.options.target,
        cell.stated[""].resolution,
        mount=cell.options.mount,
        camera=cell.stated[""],
    )


def test_poses_of_another_instant_than_the_joints_are_found_by_the_images() -> None:
    cell = simulate(CellOptions(views=20, robot_sigma_m=5e-5, robot_sigma_rad=5e-5))
    late = exp(np.random.default_rng(2).normal(size=(20, 6)) * np.repeat([1e-3, 6e-4], 3))
    flanges = cell.robot.base_from_flange @ late
    verdict = calibrated(reporting(cell, base_from_flange=flanges)).verdict
    assert ids(verdict)[:1] == ["late_poses"]
    assert "--by-joints" in verdict.causes[0].do.command
    # Where both are right, or the joints are the late ones, nothing is said of that.
    sound = calibrated(cell).verdict
    assert "late_poses" not in {found.kind for found in sound.findings}


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_images_that_are_shifted_from_some_view_on_are_distinguished_from_a_camera_that_moved(
    mount,
) -> None:
    cell = simulate(CellOptions(views=24, mount=mount, pixel_sigma_px=0.1, seed=2))
    shifts = np.where(np.arange(24)[:, None] < 10, 0.0, [24.0, -16.0])
    corners = [replace(at, px=at.px + by) for at, by in zip(cell.corners, shifts, strict=True)]
    first = calibrated(showing(cell, corners)).verdict.causes[0]
    assert first.kind == "image_shifted"
    assert "From view 10 on, the images are shifted by (24, -16) px" in str(first.words)
    moved = simulate(replace(cell.options, camera_moved_m=5e-3))
    bumped = showing(cell, [*cell.corners[:10], *moved.corners[10:]])
    assert calibrated(bumped).verdict.causes[0].kind != "image_shifted"


def changed_lens(
    mount: str, seed: int, *, is_stated: bool, shift_px: float = 0.0, share: float = 0.0
) -> Finding:
    """The first cause of a cell whose lens changes at view 13, of an arm that reports no joints."""
    options = CellOptions(
        views=24,
        mount=mount,
        pixel_sigma_px=0.12,
        seed=seed,
        state_intrinsics=is_stated,
        robot_sigma_m=4e-5,
        robot_sigma_rad=1e-4,
    )
    cell, centre = simulate(options), options.camera.matrix[2:]
    corners = [
        replace(at, px=at.px + share * (at.px - centre) + [shift_px, 0.0])
        for at in cell.corners[13:]
    ]
    seen = showing(cell, [*cell.corners[:13], *corners])
    return calibrated(seen, joints=False).verdict.causes[0]


@pytest.mark.parametrize(
    ("mount", "seed"), [("eye-in-hand", 0), slow("eye-to-hand", 0), slow("eye-to-hand", 1)]
)
def test_an_image_that_is_shifted_a_little_is_no_camera_that_moved(mount, seed) -> None:
    """With an estimated lens, its centre is between both: by noise alone, either half is left."""
    first = changed_lens(mount, seed, is_stated=False, shift_px=4.0)
    assert first.kind == "image_shifted"
    assert first.words.startswith("From view 13 on, the images are shifted by (4")


@pytest.mark.parametrize(
    ("mount", "seed", "is_stated"),
    [
        slow("eye-in-hand", 0, True),
        ("eye-to-hand", 2, True),
        slow("eye-to-hand", 0, True),
        slow("eye-to-hand", 2, False),
    ],
)
def test_a_lens_that_was_refocused_at_once_neither_varies_nor_moved(mount, seed, is_stated) -> None:
    """A stated lens is that of the views before: those after have another one."""
    first = changed_lens(mount, seed, is_stated=is_stated, share=-0.01)
    assert first.kind == "focus"
    (percent,) = re.findall("from view 13 on, its focal length is ([0-9.]+) % shorter", first.words)
    assert float(percent) == pytest.approx(1.0, abs=0.05)
    assert "--views 13-23" in first.do.command


@pytest.mark.parametrize(
    ("mount", "seed", "share", "shift_px"),
    [
        ("eye-in-hand", 1, -0.003, 0.0),
        slow("eye-in-hand", 2, 0.003, 0.0),
        slow("eye-to-hand", 1, 0.004, 1.5),
        slow("eye-in-hand", 1, 0.0, 2.0),
        ("eye-to-hand", 2, 0.0, 2.0),
    ],
)
def test_a_given_lens_that_changed_a_little_competes_with_a_frame(mount, seed, share, shift_px):
    """The robot's motion separates a focal length from a place, and corners alone hardly do."""
    first = changed_lens(mount, seed, is_stated=True, share=share, shift_px=shift_px)
    assert first.kind == ("focus" if share else "image_shifted")
    assert "rom view 13 on, " + ("its focal length" if share else "the images") in first.words
    assert ("lens changed at once" if share else "the lens was hit") in first.words


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("is_stated", [True, False])
def test_a_camera_that_moved_a_little_is_no_lens_that_changed(mount, is_stated) -> None:
    options = CellOptions(views=24, mount=mount, state_intrinsics=is_stated, seed=4)
    cell, moved = simulate(options), simulate(replace(options, camera_moved_m=1e-3))
    bumped = showing(cell, [*cell.corners[:10], *moved.corners[10:]])
    causes = calibrated(bumped, joints=False).verdict.causes
    assert causes[0].kind in ("moved_at_once", "something_moved")
    assert not {"focus", "image_shifted"} & {cause.kind for cause in causes}


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand")])
def test_views_of_another_camera_are_not_in_the_estimate_of_its_lens(mount) -> None:
    """A camera that was knocked, and its lens with it, so that the lens of all views is neither."""
    options = CellOptions(
        views=24, mount=mount, pixel_sigma_px=0.12, seed=1, state_intrinsics=False
    )
    cell, moved = simulate(options), simulate(replace(options, camera_moved_m=5e-3))
    hit = [replace(at, px=at.px + np.array([12.0, 0.0])) for at in moved.corners[14:]]
    found = calibrated(showing(cell, [*cell.corners[:14], *hit]), joints=False)
    assert found.verdict.causes[0].views == tuple(range(14, 24))
    fit = found.assessment.fit
    (camera,) = fit.unknowns.of(LENS)
    away = fit.values((LENS, camera)) - intrinsics(options.camera)
    within = away @ np.linalg.solve(fit.covariance((LENS, camera)), away)
    assert within < chi2_limit(1e-3, len(away))


@pytest.mark.parametrize(("off_mm", "named"), [slow(2.0, []), (30.0, [(7,)])])
def test_doctor_calls_no_view_wrong_for_what_an_arm_may_err_by(off_mm, named) -> None:
    cell = simulate(CellOptions(views=20))
    flanges = cell.robot.base_from_flange.copy()
    flanges[7, 0, 3] += 1e-3 * off_mm
    found = doctor(session_of(cell, flanges)).findings
    assert [each.views for each in found if each.kind == "wrong_views"] == named


@pytest.mark.slow
@pytest.mark.parametrize(("off_mm", "may_err"), [(2.0, True), (30.0, False)])
def test_the_arm_is_among_the_causes_of_a_view_that_is_off_by_what_arms_err_by(off_mm, may_err):
    cell = simulate(CellOptions(views=20))
    flanges = cell.robot.base_from_flange.copy()
    flanges[7, 0, 3] += 1e-3 * off_mm
    cause = calibrate(session_of(cell, flanges)).verdict.causes[0]
    assert cause.views == (7,)
    assert ("or the arm errs so there" in cause.words) == may_err
    servo = replace(load_robot("ur10e"), repeatability=(2.0, 0.5))
    assert farthest_by_arms([servo]) == pytest.approx((12.0, 3.0))


@pytest.mark.slow
def test_a_view_just_beyond_the_limit_of_outliers_is_no_mistake():
    cell = simulate(CellOptions(views=20))
    flanges = cell.robot.base_from_flange.copy()
    # The limit is 0.23 mm.
    flanges[7, 0, 3] += 3e-4
    found = calibrate(session_of(cell, flanges))
    assert [view.view for view in found.views if not view.used] == [7]
    assert found.verdict.status == "good"
    words = "View 7 was left out: off by what arms err by now and then."
    assert words in [finding.words for finding in found.verdict.findings]


@pytest.mark.parametrize(
    ("step_mm", "step_deg", "noise_mm", "words"),
    [
        (1.0, 0.0, 0.03, "their positions to 1 mm: this alone puts the flange off by 0.29 mm per"),
        slow(1.0, 1.0, 0.03, "their positions to 1 mm and angles to 1 deg:"),
        slow(0.1, 0.0, 0.03, ""),
        # Rounding is the smaller part of it.
        slow(1.0, 0.0, 0.6, ""),
    ],
)
def test_poses_with_too_few_digits_are_the_cause(step_mm, step_deg, noise_mm, words) -> None:
    cell = simulate(CellOptions(views=20, robot_sigma_m=1e-3 * noise_mm))
    flanges = cell.robot.base_from_flange.copy()
    flanges[:, :3, 3] = np.round(flanges[:, :3, 3] * 1e3 / step_mm) * step_mm * 1e-3
    if step_deg:
        angles = Rotation.from_matrix(flanges[:, :3, :3]).as_euler("ZYX", degrees=True)
        flanges[:, :3, :3] = Rotation.from_euler("ZYX", angles.round(), degrees=True).as_matrix()
    session = session_of(cell, flanges)
    verdict = calibrate(session).verdict
    assert (ids(verdict)[:1] == ["rounded_poses"]) == bool(words)
    assert words in verdict.top[0]
    assert ("rounded_poses" in [found.kind for found in doctor(session).findings]) == bool(words)


@pytest.mark.parametrize("form", ["quaternions", slow("rotation vectors")])
def test_rotations_of_three_decimals_are_the_cause(form) -> None:
    cell = simulate(CellOptions(views=20, robot_sigma_m=3e-5, robot_sigma_rad=5e-5))
    flanges = cell.robot.base_from_flange.copy()
    words = "rotations (quaternions of 3 decimals) to 0.11 deg: this alone"
    if form == "rotation vectors":
        turns = Rotation.from_matrix(flanges[:, :3, :3]).as_rotvec().round(3)
        flanges[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
        words = "rotation vectors to 0.057 deg: this alone"
    session = session_of(cell, flanges)
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    if form == "quaternions":
        for row, name in product(cells, ("qx", "qy", "qz", "qw")):
            row[name] = f"{float(row[name]):.3f}"
    rows = [[*row.values()] for row in cells]
    verdict = calibrate(session.with_content(document=session.document, cells=rows)).verdict
    assert ids(verdict)[:1] == ["rounded_poses"]
    assert words in verdict.top[0]


@pytest.mark.slow
def test_a_frame_of_the_controller_that_is_switched_on_midway_is_named():
    cell = simulate(CellOptions(views=18, seed=3))
    switched = exp(np.array([0.0, 0.5, 0.7, 0.02, -0.01, 0.18]))
    flange = cell.robot.base_from_flange.copy()
    flange[12:] = flange[12:] @ switched
    cause = calibrate(session_of(cell, flange)).verdict.causes[0]
    assert cause.kind == "something_moved"
    # Of the two parts the larger one is kept.
    assert "The result is that of the views before." in cause.words
    assert "from view 12 on, the camera or the controller's tool was another one" in cause.words
    # What the controller's table of tools has to be compared with.
    x, y, z = re.search(r"tool by \(([^)]*)\) mm and 49 deg", cause.words)[1].split(", ")
    np.testing.assert_allclose(
        [float(x), float(y), float(z)], 1e3 * switched[:3, 3], atol=0.5, rtol=0.01
    )
    # No knock moves a camera so far.
    assert "Look whether a tool was active there." in cause.do.words
    assert "alone (--views 12-17): their result is for the tool" in cause.do.words
    assert "--without-tool 12-17:" in cause.do.command


@pytest.mark.slow
def test_a_tool_that_is_longer_from_some_view_on_is_taken_off() -> None:
    """By more than any knock moves a camera."""
    cell = simulate(CellOptions(views=24, seed=3))
    flange = cell.robot.base_from_flange.copy()
    flange[12:] = flange[12:] @ exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 25e-3]))
    session = session_of(cell, flange)
    cause = calibrate(session).verdict.causes[0]
    assert cause.kind in ("moved_at_once", "something_moved")
    option = re.search(r"--without-tool ([0-9-]+):(\S+)", cause.do.command)
    assert option[1] == "12-23"
    numbers = tuple(map(float, option[2].split(",")))
    np.testing.assert_allclose(numbers, [0, 0, 25.0, 0, 0, 0], atol=0.3)
    mended = calibrate(remove_tool(session, range(12, 24), numbers))
    assert mended.verdict.status == "good"


@pytest.mark.slow
def test_a_base_frame_that_is_switched_far_is_named_by_one_size() -> None:
    """A cell in which neither part is left out; the views after it are of that frame."""
    cell = simulate(CellOptions(views=20, seed=5, mount="eye-to-hand"))
    switched = exp(np.array([0.0, 0.0, np.pi / 2, 0.31, -0.12, 0.045]))
    flange = cell.robot.base_from_flange.copy()
    flange[8:] = invert(switched) @ flange[8:]
    cause = calibrate(session_of(cell, flange)).verdict.causes[0]
    assert (
        "their result is for the tool and the base frame that were active there" in cause.do.words
    )
    assert "--views 8-19" in cause.do.command
    turns = re.findall(r"([0-9.]+) deg", cause.words)[:2]
    np.testing.assert_allclose([*map(float, turns)], 90.0, atol=1.0)


@pytest.mark.slow
def test_a_step_by_a_few_times_the_noise_is_named_though_a_view_agrees_by_chance():
    """The views after it are calibrated alone, as the camera stands: picks come after them."""
    cell, rng = simulate(CellOptions(views=20, seed=3)), np.random.default_rng(2)
    step = np.array([0.02, 0.03, -0.02, 0.006, -0.004, 0.008])
    twists = step + rng.normal(0.0, [0.008] * 3 + [0.002] * 3, (9, 6))
    flange = cell.robot.base_from_flange.copy()
    some = [at for at in range(10, 20) if at != 16]
    flange[some] = flange[some] @ exp(twists)
    cause = calibrate(session_of(cell, flange)).verdict.causes[0]
    assert cause.kind == "something_moved"
    assert "left out: from view 10 on, the camera" in cause.words
    assert "or calibrate the 10 views from there on alone" in cause.do.words
    assert cause.do.command.endswith("--views 10-19")


@pytest.mark.slow
def test_a_row_that_was_not_filled_in_is_reported() -> None:
    cell = simulate(CellOptions(views=20))
    flange = cell.robot.base_from_flange.copy()
    flange[7] = np.eye(4)
    result = calibrate(session_of(cell, flange))
    (view,) = (view for view in result.views if not view.used)
    assert view.view == 7
    assert "the robot's pose in its row is all zeros" in view.reason


@pytest.mark.slow
def test_wrong_poses_at_the_end_have_no_move_in_common() -> None:
    cell, rng = simulate(CellOptions(views=20)), np.random.default_rng(1)
    flange = cell.robot.base_from_flange.copy()
    flange[16:] = flange[16:] @ exp(rng.normal(0.0, [0.3] * 3 + [0.1] * 3, (4, 6)))
    found = ids(calibrate(session_of(cell, flange)).verdict)
    assert "something_moved" not in found
    assert "wrong_views" in found


@pytest.mark.parametrize(("sigma", "is_another"), [(0.002, True), (0.0099, False), (0.02, False)])
def test_a_size_of_which_the_motion_says_less_than_the_prior_is_as_stated(sigma, is_another):
    """Errors that last from view to view may leave it less sure than its prior alone."""
    prior = SimpleNamespace(information=np.array([[0.01**-2.0]]))
    fitted = SimpleNamespace(
        problem=SimpleNamespace(effects=[SimpleNamespace(name="size", prior=prior)]),
        values=lambda _: np.array([-0.02]),
        sigmas=lambda _: np.array([sigma]),
    )
    measured = size_of_measured(SimpleNamespace(has_links=False), fitted)
    assert measured.is_another == is_another
    assert measured.contradicts == is_another


@pytest.mark.slow
def test_views_of_one_end_that_are_all_off_are_no_chance():
    """As where the zero of a joint is lost, which moves each flange by its own posture."""
    cell, rng = simulate(CellOptions(views=20)), np.random.default_rng(1)
    flange, amid = cell.robot.base_from_flange.copy(), cell.robot.base_from_flange.copy()
    off = exp(rng.normal(0.0, [0.006] * 3 + [0.003] * 3, (8, 6)))
    flange[12:] = flange[12:] @ off
    cause = calibrate(session_of(cell, flange)).verdict.causes[0]
    assert cause.kind == "something_moved"
    assert "from view 12 on, the camera, the target or a frame of the controller" in cause.words
    # Picks come after it.
    assert cause.do.command.endswith("--views 12-19")
    some = np.arange(1, 17, 2)
    amid[some] = amid[some] @ off
    assert "something_moved" not in ids(calibrate(session_of(cell, amid)).verdict)


@pytest.mark.parametrize("orders", [("xyz", "ZYZ"), *map(slow, [("ZYZ", "ZYX"), ("ZYZ", "xyz")])])
def test_angles_taken_for_another_makers_are_brought_back_row_by_row(orders: tuple[str, str]):
    """Of the two triples of angles of a rotation, some rows had the one that writing gives."""
    cell, (order, taken) = simulate(CellOptions(views=16)), orders
    poses = cell.robot.base_from_flange
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler(order)
    misread = compose(Rotation.from_euler(taken, angles).as_matrix(), poses[:, :3, 3])
    cause = calibrate(session_of(cell, misread)).verdict.causes[0]
    assert cause.kind == "misread_poses"
    assert f"as Euler angles {order}" in cause.words
    assert f"taken for Euler angles {taken}" in cause.words
    assert "convert SESSION FIXED --guess --yes" in cause.do.command
    rows = tuple(map(str, range(len(poses))))
    numbers = [PoseNumbers.of_poses(side, rows) for side in (misread, cell.cam_from_target)]
    best = guess_reading(*numbers, cell.options.mount).best.hypothesis
    # As precise as the turns of twelve digits are.
    np.testing.assert_allclose(best.robot.poses(numbers[0]), poses, atol=1e-7)


@pytest.mark.parametrize("mount", [slow(MOUNTS[0]), MOUNTS[1]])
def test_a_cell_that_is_the_other_way_round_is_doubted(mount: str) -> None:
    cell = simulate(CellOptions(views=20, mount=mount))
    robot, camera = cell.robot.base_from_flange, cell.cam_from_target
    sound = [robot]
    if mount == "eye-in-hand":  # Also by poses in the frame of the board, but for a centimetre.
        near_board = invert(cell.transforms["base_from_target"])
        near_board[:3, 3] += 0.01
        sound.append(near_board @ robot)
    for poses in sound:
        assert "mirrored_cell" not in ids(calibrate(pairs_session(mount, poses, camera)).verdict)
    other = MOUNTS[mount == MOUNTS[0]]
    mirrored = pairs_session(other, invert(robot), camera)
    named = replace(mirrored, robot_document=read_robot_document("ur10e"))
    for session in (mirrored, named):
        verdict = calibrate(session).verdict
        assert ids(verdict)[:1] == ["mirrored_cell"]
        assert verdict.status == "check"


@pytest.mark.parametrize(
    ("mount", "tool_mm", "where"),
    [
        ("eye-in-hand", (0, 0, 0), ""),
        # Beside the wrist the centre of a camera is some centimetres behind the flange.
        ("eye-in-hand", (0, 0, 100), ""),
        ("eye-in-hand", (0, 0, 130), "the camera is 71 mm behind the flange"),
        ("eye-in-hand", (700, 0, 0), "the camera is 0.62 m away from the flange"),
        ("eye-to-hand", (0, 0, 130), ""),
        ("eye-to-hand", (0, 0, 600), "the target is 0.56 m away from the flange"),
    ],
)
def test_a_tool_that_was_active_is_asked_for(mount, tool_mm, where) -> None:
    cell, tool = simulate(CellOptions(views=14, mount=mount)), np.eye(4)
    tool[:3, 3] = 1e-3 * np.array(tool_mm)
    poses = cell.robot.base_from_flange @ tool
    verdict = calibrate(pairs_session(mount, poses, cell.cam_from_target)).verdict
    # It is a question, and no doubt.
    assert (verdict.status, verdict.causes) == ("good", ())
    questions = [finding for finding in verdict.findings if finding.kind == "carried_away"]
    assert len(questions) == bool(where)
    for finding in questions:
        assert where in finding.words
        assert "Was a tool active on the controller" in finding.words
        assert finding.do in verdict.next_steps
        assert finding.words in " ".join(verdict.top)


def test_a_large_board_is_where_its_middle_is() -> None:
    """Its first corner is half a metre from the flange that holds its middle."""
    target = replace(CellOptions().target, columns=13, rows=8, square_m=0.06, marker_m=0.045)
    cell = simulate(CellOptions(views=14, mount="eye-to-hand", target=target, seed=2))
    middle = corner_positions(target).mean(axis=0)
    edge = cell.transforms["flange_from_target"]
    turn = edge[:3, :3]
    held = compose(turn, np.array([0.0, 0.0, 0.35]) - turn @ middle)
    flange = cell.robot.base_from_flange @ edge @ invert(held)
    known = calibrate(session_of(cell, flange))
    found = known.edges["flange_from_target"].matrix
    assert np.linalg.norm(found[:3, 3]) > 0.5
    np.testing.assert_allclose((found @ [*middle, 1.0])[:3], [0.0, 0.0, 0.35], atol=5e-3)
    assert "carried_away" not in {finding.kind for finding in known.verdict.findings}


@pytest.mark.parametrize("mount", MOUNTS)
def test_poses_of_the_camera_in_place_of_the_robots_are_named(mount: str) -> None:
    cell = simulate(CellOptions(views=14, mount=mount))
    seen = cell.cam_from_target.copy()
    # Another program has a longer lens, and the board's first corner at its other end.
    seen[:, 2, 3] *= 1.01
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[:2, 3] = 0.24, 0.15
    seen = seen @ turned
    poses = invert(seen) if mount == MOUNTS[0] else seen
    verdict = calibrate(pairs_session(mount, poses, cell.cam_from_target)).verdict
    assert (verdict.status, ids(verdict)[:1]) == ("check", ["camera_poses"])
    assert "with the poses that the robot reported" in verdict.next_steps[0].words
    # Images show that nothing but the camera was there.
    session = session_of(cell, poses)
    assert [finding.kind for finding in doctor(session).findings] == ["camera_poses"]
    verdict = calibrate(session).verdict
    assert (verdict.status, ids(verdict)[:1]) == ("bad", ["camera_poses"])


def test_readings_turned_about_their_own_origin_are_no_other_tool() -> None:
    """A tracker that takes markers for others turns its body by half a turn, in three views."""
    cell = simulate(CellOptions(views=16, mount="eye-to-hand"))
    seen = cell.cam_from_target.copy()
    seen[[0, 1, 9]] = seen[[0, 1, 9]] @ np.diag([1.0, -1.0, -1.0, 1.0])
    verdict = calibrate(pairs_session("eye-to-hand", cell.robot.base_from_flange, seen)).verdict
    cause = verdict.causes[0]
    assert (cause.kind, cause.views) == ("something_moved", (0, 1, 9))
    assert "the target was another one: turned by 180 deg in its own place" in cause.words
    assert "without-tool" not in cause.do.command


def test_a_row_of_zeros_is_left_out_by_name() -> None:
    """A program that waits for its first target writes them for both sides."""
    cell = simulate(CellOptions(views=14))
    poses, seen = cell.robot.base_from_flange.copy(), cell.cam_from_target.copy()
    poses[9], seen[9] = np.eye(4), np.eye(4)
    found = calibrate(pairs_session(MOUNTS[0], poses, seen))
    assert "measured position of the target is zero" in found.views[9].reason
    assert [view.view for view in found.views if not view.used] == [9]


def test_a_camera_behind_its_flange_where_no_bracket_has_it_is_a_doubt() -> None:
    cell, tool = simulate(CellOptions(views=14)), np.eye(4)
    tool[2, 3] = 0.17
    pairs = "eye-in-hand", cell.robot.base_from_flange @ tool, cell.cam_from_target
    verdict = calibrate(pairs_session(*pairs)).verdict
    assert (verdict.status, ids(verdict)[:1]) == ("check", ["tool_active"])
    assert "the camera is 111 mm behind the flange" in verdict.first_reason
    assert "Was a tool active on the controller" in verdict.first_reason
    # It is there where session.toml says so.
    place = {"z_m": -0.112, "sigma_m": 0.005}
    known = pairs_session(*pairs)
    known.document["prior"] = {"flange_from_cam": place}
    verdict = calibrate(known).verdict
    assert (verdict.status, verdict.causes) == ("good", ())
    assert "tool_active" not in [finding.kind for finding in verdict.findings]


@pytest.mark.parametrize(("freedom", "places", "flat"), [(np.inf, 1, 1.0), (15.0, 7, 0.03)])
def test_the_chance_is_that_of_drawn_errors(freedom: float, places: int, flat: float) -> None:
    rng, count = np.random.default_rng(places), 200_000
    sizes = 1e-3 * np.geomspace(flat, 1.0, 6)[rng.permutation(6)]
    roots = sizes[:, None] * rng.standard_normal((places, 6, 6))
    spreads = roots @ np.swapaxes(roots, 1, 2)
    away = np.einsum(
        "nij,nj->ni", roots[np.arange(count) % places], rng.standard_normal((count, 6))
    )
    if np.isfinite(freedom):
        away /= np.sqrt(rng.chisquare(freedom, count) / freedom)[:, None]
    turned, shifted = (np.linalg.norm(value, axis=1) for value in (away[:, :3], away[:, 3:]))
    # 4,096 even points leave 0.007 at most, as 200,000 drawn ones leave three times 0.001.
    for share in (0.3, 0.7, 0.95):
        turn, shift = np.quantile(turned, share), np.quantile(shifted, share)
        share_within = np.mean((turned < turn) & (shifted < shift))
        assert chance_within(spreads, turn, shift, freedom) == pytest.approx(share_within, abs=0.01)
        assert chance_within(spreads, np.inf, shift, freedom) == pytest.approx(share, abs=0.01)
        assert chance_within(spreads, turn, np.inf, freedom) == pytest.approx(share, abs=0.01)
    radius = radius_within(spreads, 0.95, freedom)
    assert chance_within(spreads, np.inf, radius, freedom) == pytest.approx(0.95, abs=1e-6)
    # Round errors have a closed form.
    covariance = 1e-8 * np.eye(6)[None]
    radius = 1e-4 * np.sqrt(chi2_limit(0.05, 3))
    assert radius_within(covariance, 0.95) == pytest.approx(radius, rel=2e-3)
    assert chance_within(covariance, np.inf, np.inf) == 1.0
    assert chance_within(np.zeros((1, 6, 6)), 1e-3, 1e-3) == 1.0
    assert radius_within(np.zeros((1, 6, 6)), 0.95) == 0.0


def without_arm_errors(known: RunState) -> RunState:
    """The same with an arm of which nothing but noise is known."""
    answer, solved = known.assessment, known.cell_fit
    arms = {name: replace(arm, errors=None) for name, arm in solved.arms.items()}
    by_source = {name: part for name, part in answer.fit.by_source.items() if name != "arm"}
    changed = replace(answer, fit=replace(answer.fit, by_source=by_source))
    return replace(known, assessment_or_none=changed, cell_fit_or_none=replace(solved, arms=arms))


@pytest.mark.slow
def test_a_wrong_length_of_an_arm_and_a_board_of_another_size_both_stay_possible() -> None:
    """The fit takes the board for 0.23 % larger, since one length of many is off by 3 mm."""
    target = replace(CellOptions().target, square_sigma_m=1e-5)
    options = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1, target=target, seed=1)
    options = replace(options, robot="generic-6r-1800", views=32, mount=MOUNTS[1])
    cell = simulate(replace(options, dh_sigma_m=8e-5, dh_sigma_rad=1e-4))
    session, robot = cell_session(cell, "cell", seen="corners"), load_robot(options.robot).document
    first, second, *rest = robot["joint"]
    joints = [first, {**second, "a_m": second["a_m"] + 3e-3}, *rest]
    columns = [name for name in session.columns if name not in POSE]
    known = calibrate(
        Session.assemble(
            session.document,
            columns,
            [[view.cell(name) for name in columns] for view in session.views],
            session.images,
            target_document=session.target_document,
            robot_document={**robot, "joint": joints},
            corners=session.corner_table,
        )
    )
    # The length itself comes first; the board, which the fit takes for larger, is its effect.
    assert ids(known.verdict)[0] == "arm_parameter"
    edge = known.edges["base_from_cam"]
    away = log(invert(edge.matrix) @ cell.transforms["base_from_cam"])
    assert np.linalg.norm(away[3:]) > 3e-3
    assert away @ np.linalg.solve(edge.covariance, away) < chi2_limit(1e-3, 6)


@pytest.mark.slow
def test_a_board_of_another_size_misplaces_things_for_a_calibrated_arm() -> None:
    """Its size is known to 0.1 %, and is off by 1.5 times that: the arm becomes as large."""
    size = 1.0015
    cell = simulate(CellOptions(dh_sigma_m=3e-4, dh_sigma_rad=3e-4, board_scale=size))
    known = calibrated(cell)
    assert all(arm.is_modelled for arm in known.cell_fit.arms.values())
    (picks,) = known.findings.picks
    middle, scaled = np.array([0.135, 0.09, 0.0, 1.0]), np.diag([size, size, size, 1.0])
    went = known.assessment.fit.problem.predicted(known.assessment.fit.state) @ middle
    seen = cell.cam_from_target[np.array(known.used)] @ scaled @ middle
    away_mm = 1e3 * np.sqrt(np.mean(np.sum((went - seen)[:, :3] ** 2, axis=1)))
    # 1.5 sigma of that size make nearly all of it, and what is held counts by its pull as well.
    assert 0.7 < away_mm / picks.budget_mm["total"] < 2.0
    # More views would not help, and are not the advice.
    needing = replace(known.findings, need=Need(0.15), corrects_targets=True)
    cause = judge(needing).causes[0]
    assert cause.kind == "unmeasured_board"
    assert "square_sigma_m" in cause.do.words


@pytest.mark.parametrize(("views", "is_found"), [slow(slice(1), False), (slice(1, None), True)])
def test_only_views_that_are_known_well_show_what_is_not_predicted(views: slice, is_found: bool):
    """A view of a small board from the front: off by 2 deg, which is 2.5 times its sigma."""
    known = calibrated(simulate(CellOptions(views=12)), joints=False)
    answer = known.assessment
    seen = answer.fit.problem.observations
    among = seen.covariance.copy()
    among[0, :3, :3] = np.deg2rad(0.8) ** 2 / 3.0 * np.eye(3)
    away_rad = answer.held_out.residual_rad.copy()
    away_rad[views] = np.deg2rad(2.0)
    blurred = replace(answer.fit.problem, observations=replace(seen, covariance=among))
    held = replace(answer.held_out, residual_rad=away_rad)
    answer = replace(answer, fit=replace(answer.fit, problem=blurred), held_out=held)
    findings = findings_of(replace(known, assessment_or_none=answer))
    (picks,) = findings.picks
    kinds = [finding.kind for finding in judge(findings).findings]
    assert (("left out" in picks.parts), ("unexplained" in kinds)) == (is_found, is_found)


def of_size(sigma_mm: float, camera: str = "cam", robot: str = "robot") -> Picks:
    """Picks that err alike along all axes."""
    covariance = np.diag(np.repeat([1e-4, 1e-3 * sigma_mm], 3) ** 2)[None]
    return Picks(camera, robot, {"calibration": covariance}, np.inf, 0.5)


@pytest.mark.parametrize(
    ("changes", "status", "words"),
    [
        ({"held_out": Rms(3.0, 0.011), "rms": Rms(2.9, 0.01)}, "check", "by 3 mm (doubt begins"),
        ({"held_out": Rms(30.0, 0.011), "rms": Rms(29.0, 0.01)}, "bad", "by 30 mm"),
        ({"held_out": Rms(0.11, 0.5), "rms": Rms(0.1, 0.45)}, "check", "by 0.5 deg"),
        ({"holdout": Rms(2.0, 0.01)}, "check", "holds back are missed by 2 mm"),
        ({"worst": directions(2e-3, 0, 0, 0)}, "check", "the direction 0 (2 mm)"),
        ({"worst": directions(4e-3, 0, 0, 0)}, "bad", "the direction 0 (4 mm)"),
        ({"noise_mm": 1.0}, "check", "take a flange that is off by 1 mm and 0.0057 deg"),
        ({"noise_deg": 0.029}, "check", "0.029 deg from stop to stop"),
        ({"stops": 8}, "check", "Only 8 stops are used"),
        ({"stops": 4, "views": views(4)}, "bad", "Only 4 views are used"),
        (
            {"lost": LOST},
            "check",
            "views are not used. The first that is no outlier: view ",
        ),
        ({"pixel_px": 1.0}, "check", "Corners deviate by 1 px"),
        ({"warnings": remarks(("It is upside down.",))}, "check", "It is upside down."),
        # Coarse poses leave noise open: doubt is about what it is at the least.
        ({"noise_mm": 0.1, "noise_deg": 0.025, "lower_bounds": (0.05, 0.012)}, "good", ""),
        ({"noise_mm": 0.1, "noise_deg": 0.025, "lower_bounds": (0.05, 0.021)}, "check", ""),
        # A small board far away scatters by as much as its pixels do; half more is beyond chance.
        ({"held_out": Rms(0.1, 0.36), "rms": Rms(0.1, 0.35), "noise": Rms(0.1, 0.33)}, "good", ""),
        ({"held_out": Rms(0.1, 0.36), "rms": Rms(0.1, 0.35), "noise": Rms(0.1, 0.2)}, "check", ""),
        ({"lost": LOST[:3]}, "good", ""),
        ({"noise_mm": None}, "good", ""),
        # A scatter that settles it is not blamed on the motion.
        (
            {
                "held_out": Rms(80.0, 5.0),
                "rms": Rms(75.0, 4.8),
                "worst": directions(0.02, 0.02, 0.02, 0.02),
            },
            "bad",
            "units or conventions",
        ),
        # What settles it comes first.
        (
            {"pixel_px": 4.0, "warnings": remarks(("Something.",)), "stops": 8},
            "bad",
            "Corners deviate",
        ),
    ],
)
def test_each_doubt_has_its_sentence(changes, status, words):
    verdict = judge(changed(SOUND, **changes))
    assert verdict.status == status
    if words:
        assert words in verdict.reasons[0]
        count = 1 if len(changes) < 3 else 3 - ("worst" in changes) * 2
        assert len(verdict.reasons) == count + (not verdict.has_accuracy)


@pytest.mark.parametrize(
    ("scatter", "noise", "is_of_arm"),
    [
        (Rms(3.3, 0.31), (1.3, 0.15), True),
        (Rms(1.2, 0.12), (0.5, 0.05), True),
        # Turns without shifts are a marker's; no arm scatters by centimetres.
        (Rms(0.6, 0.9), (0.2, 0.5), False),
        (Rms(30.0, 3.0), (13.0, 1.5), False),
    ],
)
def test_the_scatter_of_an_arm_is_named_whatever_its_size(scatter, noise, is_of_arm):
    verdict = judge(changed(SOUND, held_out=scatter, noise_mm=noise[0], noise_deg=noise[1]))
    first = verdict.reasons[0]
    assert ("neither posture nor time" in first) == is_of_arm
    assert (f"a flange that is off by {noise[0]} mm and {noise[1]} deg" in first) == is_of_arm
    assert ("measured, not commanded" in str(verdict.findings[0].do)) == is_of_arm
    drifting = judge(changed(SOUND, held_out=scatter, noise_mm=1.3, warnings=(DRIFT,)))
    assert "neither posture nor time" not in str(drifting)


@pytest.mark.parametrize(("sigma_mm", "status"), [(0.3, "check"), (4.0, "bad")])
def test_an_arm_that_is_unsure_elsewhere_is_bad_where_views_place_no_better(sigma_mm, status):
    verdict = judge(changed(SOUND, workspace_mm=4.0, picks=(of_size(sigma_mm),)))
    assert verdict.status == status
    assert any("All over the workspace" in reason for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("changes", "causes"),
    [
        ({"worst": directions(2e-3)}, ["weak_motion"]),
        ({"warnings": (MISSPELT,)}, ["remark"]),
        ({"stops": 8, "worst": directions(2e-3)}, ["weak_motion", "few_stops"]),
        # They are none where something else is likely.
        ({"stops": 8, "warnings": (DRIFT,)}, ["moved_slowly"]),
        # What happened comes before what nothing explains.
        ({"noise_mm": 1.0, "warnings": (MOVED,)}, ["something_moved", "unexplained"]),
        # What moves with the time passes for a focus, and not the other way round.
        ({"warnings": (FOCUS, DRIFT)}, ["moved_slowly"]),
        # A held lens that is wrong is no arm that errs.
        ({"warnings": (POSTURE, HELD_LENS), "noise_mm": 2.0}, ["lens"]),
        # Joints that are there but misread come before the errors they would explain.
        ({"warnings": (replace(POSTURE, do=NO_JOINTS), MISREAD)}, ["misread_joints", "arm_errors"]),
    ],
)
def test_every_doubt_has_a_cause_and_a_next_step(changes, causes) -> None:
    verdict = judge(changed(SOUND, **changes))
    assert verdict.status == "check"
    assert ids(verdict)[: len(causes)] == causes
    assert sum(cause.probability for cause in verdict.causes) < 1.0 + 1e-9 or len(causes) > 1
    # To record what is there already is no advice.
    assert NO_JOINTS not in verdict.next_steps
    with_words = {"remark", "misread_joints", "few_stops", "weak_motion", "place", "unexplained"}
    assert all(cause.do for cause in verdict.causes if cause.kind in with_words)


def test_poses_that_are_misread_explain_the_rest_but_exchanged_rows() -> None:
    misread = Finding("misread_poses", "The quaternions are w, x, y, z.", READ_AGAIN)
    verdict = judge(changed(SOUND, warnings=(DRIFT, misread), noise_mm=3.0))
    assert ids(verdict) == ["misread_poses", "unexplained", "moved_slowly"]
    assert sum(cause.probability for cause in verdict.causes) <= 1.0 + 1e-9
    assert verdict.top[0].startswith("Most likely: The quaternions are w, x, y, z.")
    assert verdict.next_steps == (READ_AGAIN,)
    assert ids(judge(changed(SOUND, warnings=(EXCHANGED, misread))))[0] == "exchanged_views"
    with pytest.raises(KeyError, match="something_odd"):
        judge(changed(SOUND, warnings=(Finding("something_odd", "It is odd."),)))


@pytest.mark.parametrize(
    ("changes", "sigma_mm", "need", "status", "kinds"),
    [
        ({}, 0.17, NEED, "good", []),
        ({}, 0.2, NEED, "check", ["calibration"]),
        ({}, 0.4, NEED, "bad", ["calibration"]),
        # Both have to hold.
        ({}, 0.1, Need(0.5, 0.05), "good", []),
        ({}, 0.1, Need(0.5, 0.005), "bad", ["calibration"]),
        ({}, 0.1, Need(None, 0.05), "good", []),
        ({}, 0.2, None, "good", []),
        ({}, 0.7, None, "check", ["calibration"]),
        # What moves picks by 0.08 mm is no doubt where they err by three times that anyway.
        ({"warnings": (FIELD,)}, 0.1, None, "check", ["lens_field"]),
        ({"warnings": (FIELD,)}, 0.3, None, "good", []),
    ],
)
def test_the_verdict_is_about_what_picks_err_by(changes, sigma_mm, need, status, kinds) -> None:
    verdict = judge(replace(SOUND, need=need, picks=(of_size(sigma_mm),), **changes))
    assert verdict.status == status
    assert ids(verdict) == kinds
    if need == NEED:
        words = "where the views looked lands within 0.5 mm with a probability of"
        assert words in verdict.reasons[0]
        assert verdict.good_for_mm == pytest.approx(sigma_mm * np.sqrt(7.815), rel=5e-3)
    found = {finding.words for finding in verdict.findings}
    assert {finding.words for finding in changes.get("warnings", ())} <= found
    placed = "place" in {finding.kind for finding in verdict.findings}
    assert placed == (sigma_mm == 0.7)


@pytest.mark.parametrize("need", [None, NEED])
def test_repeated_readings_are_a_hint_and_no_doubt(need) -> None:
    empty = Finding("repeated_readings", "A place was read twice.", Remedy("Read others."))
    verdict = judge(replace(SOUND, warnings=(empty,), picks=(of_size(0.1),), need=need))
    assert (verdict.status, verdict.causes) == ("good", ())
    assert verdict.good_for_mm == pytest.approx(0.28, rel=0.01)
    assert empty.do in verdict.next_steps


SHUFFLED = CellOptions(mount="eye-to-hand", views=18, seed=4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "order", "status", "words"),
    [
        (SHUFFLED, lambda rng: rng.permutation(18), "bad", "poses are not those of the images"),
        # Where the other half is as it should be, that is not said.
        (
            replace(SHUFFLED, mount="eye-in-hand"),
            lambda rng: [*rng.permutation(9), *range(9, 18)],
            "check",
            "",
        ),
        # Of the two poses that each image allows, the one that fits its own row best was taken.
        (
            replace(SHUFFLED, target=ALIKE, views=14, seed=1),
            lambda _: [0, 1, 2, 7, 4, 5, 6, 3, *range(8, 14)],
            "check",
            "Views 3 and 7 are exchanged",
        ),
    ],
    ids=["all", "half", "two of a board that looks the same turned"],
)
def test_rows_that_were_shuffled_are_named(options, order, status, words):
    cell = simulate(options)
    flange = cell.robot.base_from_flange[np.array(order(np.random.default_rng(1)))]
    verdict = calibrate(session_of(cell, flange)).verdict
    assert verdict.status == status
    assert words in verdict.top[0]
    assert ("poses are not those of the images" in verdict.top[0]) == (status == "bad")


def drawn_misses_m(known: RunState, mount: str) -> np.ndarray:
    """(n, 3) by how much picks miss, drawn one by one and seen through the chain [m]."""
    answer, rng, count = known.assessment, np.random.default_rng(0), 20_000
    problem, (camera, target) = answer.fit.problem, answer.fit.state.edges[:2]
    views = rng.integers(len(known.used), size=count)
    (poses,) = problem.poses.values()
    flange, middle = poses[problem.observations.stops][views], np.array([0.135, 0.09, 0.0, 1.0])
    sigmas = np.repeat(answer.fit.noise.robots[0], 3)
    look, pick = (sigmas * rng.standard_normal((count, 6)) for _ in range(2))
    edges = rng.standard_normal((count, 12)) @ np.linalg.cholesky(answer.fit.whole[:12, :12]).T
    first, second = exp(edges[:, :6]), exp(edges[:, 6:])
    if mount == "eye-in-hand":
        seen = problem.measured(answer.fit.state)[views] @ middle[:, None]
        away = flange @ (exp(look) @ camera @ first - camera) @ seen
        return away[:, :3, 0] + pick[:, 3:]
    went = flange @ exp(pick) @ target @ second
    return ((went - camera @ first @ invert(camera) @ flange @ target) @ middle)[:, :3]


@pytest.mark.slow
def test_picks_err_as_the_chain_does() -> None:
    """Against errors that are drawn and put through the chain, by no slope of ours."""
    for mount, seed in (("eye-in-hand", 0), ("eye-to-hand", 4)):
        # Of these cells the images and the motion raise no doubt about the lens that is given.
        cell = simulate(CellOptions(mount=mount, views=12, seed=seed))
        known = without_arm_errors(calibrated(cell, joints=False))
        (picks,), away = findings_of(known).picks, drawn_misses_m(known, mount)
        parts = {name: value for name, value in picks.budget_mm.items() if name != "left out"}
        total = np.sqrt(sum(part**2 for name, part in parts.items() if name != "total"))
        assert total == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(away**2, axis=1))), rel=0.05)
        looks = {"look"} if mount == "eye-in-hand" else set()
        # A focus that varies by what noise alone shows is next to nothing.
        assert looks or parts.pop("look", 0.0) < 0.2 * parts["total"]
        assert set(parts) == {"board", "calibration", "pick", "total"} | looks


@pytest.mark.slow
def test_an_error_that_an_arm_repeats_moves_no_pick() -> None:
    """Its base and its flange are off by 2 mm and 4 mrad: the frames have taken it up."""
    known = without_arm_errors(calibrated(simulate(CellOptions()), joints=False))
    answer, solved = known.assessment, known.cell_fit
    ((robot, arm),) = solved.arms.items()
    errors = ArmErrors(
        pose_basis(answer.fit.problem.poses[robot])[:, :, :12], 4e-3, 0.0, of_links=False
    )
    off = errors.sigma * answer.fit.bias(robot, errors)
    fit = replace(answer.fit, by_source={**answer.fit.by_source, "arm": off @ off.T})
    erring = replace(
        known,
        assessment_or_none=replace(answer, fit=fit),
        cell_fit_or_none=replace(solved, arms={robot: replace(arm, errors=errors)}),
    )
    (before,), (after,) = (findings_of(run_state).picks for run_state in (known, erring))
    # Both are the same to rounding, of spreads that would be a hundred times as large.
    np.testing.assert_allclose(
        after.covariances, before.covariances, atol=1e-3 * before.covariances.max()
    )


@pytest.mark.slow
def test_an_occasional_error_happens_at_picks_too() -> None:
    cell, rng = simulate(CellOptions(views=25)), np.random.default_rng(1)
    poses, away = cell.robot.base_from_flange.copy(), np.zeros((25, 6))
    # At four stops the flange is 0.6 mm off, which is twice as much as is needed.
    away[[3, 9, 14, 20], 3:] = 6e-4 * rng.permuted(np.eye(3)[[0, 1, 2, 0]], axis=1)
    sound, shaken = (
        calibrated(reporting(cell, base_from_flange=poses @ exp(errors)), joints=False)
        for errors in (0.0 * away, away)
    )
    assert sum(not view.used for view in shaken.assessment.views) == 4
    need = Need(mm=0.3)
    before, after = (known.findings.picks[0].probability(need) for known in (sound, shaken))
    # The look and the pick are eight of 21 + 8 chances, and the others stay as they were.
    assert after == pytest.approx(before * 21 / 29, abs=0.05)
    assert before > 0.95


@pytest.mark.slow
def test_an_error_that_differs_by_image_happens_at_picks_too() -> None:
    # A focus of 0.2 %, which shows a thing that much nearer or farther.
    cell, rng, share = simulate(CellOptions()), np.random.default_rng(3), 2e-3
    centre = cell.options.camera.matrix[2:]
    zoomed = [
        replace(seen, px=centre + (1.0 + share * rng.standard_normal()) * (seen.px - centre))
        for seen in cell.corners
    ]
    (picks,) = calibrated(showing(cell, zoomed), joints=False).findings.picks
    # Twenty views know a standard deviation to a sixth; three of that.
    assert picks.budget_mm["look"] == pytest.approx(1e3 * share * picks.distance_m, rel=0.5)


@pytest.mark.parametrize(
    ("changes", "good_from_mm"),
    [
        ({"held_out": Rms(3.0, 0.5), "rms": Rms(2.9, 0.45)}, 0.0),
        ({"worst": directions(4e-3, 0, 0, 0)}, 0.0),
        ({"stops": 8}, 0.0),
        ({"noise_mm": 1.0}, 10.0),
        ({"held_out": Rms(3.0, 0.1), "noise_mm": 1.0}, 10.0),
        ({"warnings": remarks(["It is upside down."])}, np.inf),
    ],
)
def test_limits_give_way_to_the_need_and_what_is_unexplained_does_not(changes, good_from_mm):
    found = replace(changed(SOUND, **changes), picks=(of_size(0.1),))
    plain = judge(found)
    assert plain.status != "good"
    if np.isinf(good_from_mm):
        assert plain.good_for_mm is None
        assert judge(replace(found, need=Need(1e3))).status == "check"
        return
    assert plain.good_for_mm == pytest.approx(max(good_from_mm, 0.28), rel=0.01)
    assert f"good for tasks of {good_from_mm:g}" in plain.reasons[-1] or not good_from_mm
    assert judge(replace(found, need=Need(plain.good_for_mm))).status == "good"
    assert judge(replace(found, need=Need(0.9 * plain.good_for_mm))).status == "check"


@pytest.mark.parametrize("need", [None, NEED])
@pytest.mark.parametrize(
    "changes",
    [
        {"held_out": Rms(80.0, 5.0), "rms": Rms(75.0, 4.8)},
        {"held_out": Rms(80.0, 5.0), "rms": Rms(75.0, 4.8), "warnings": (EXCHANGED,)},
        {"pixel_px": 4.0, "stops": 8},
    ],
)
def test_nothing_is_said_of_an_accuracy_where_no_fit_explains_the_views(changes, need) -> None:
    parts = {name: of_size(60.0).parts["calibration"] for name in ("calibration", "look", "pick")}
    picks = (replace(of_size(0.1), parts=parts),)
    findings = replace(changed(SOUND, **changes), picks=picks, need=need)
    # What the frames of the result would be is asked of a result alone.
    far = [Finding(kind, "The target is far.") for kind in ("carried_away", "mirrored_cell")]
    verdict = judge(replace(findings, warnings=(*findings.warnings, *far)))
    assert "The target is far." not in " ".join(verdict.reasons)
    assert (verdict.status, verdict.has_accuracy) == ("bad", False)
    assert verdict.good_for_mm is verdict.good_for_mm_uncorrected is None
    # Neither what tasks it would be good for, nor what picks err by, nor another robot.
    said = " ".join(verdict.reasons)
    for words in ("good for tasks", "Picks err", "A pick", "repeats better", "95 %"):
        assert words not in said
    assert verdict.causes
    assert verdict.next_steps
    assert sum("How accurate it is cannot be said" in words for words in verdict.top) == 1
    met = None if need is None else need_met(need, picks)
    assert not [*need_facts(met, verdict)]
    # A task that needs ten times as much takes it for noise, but not that everything is turned.
    for need_mm, deg, status in ((299.0, 0.1, "check"), (301.0, 0.1, "good"), (1e3, 5.0, "check")):
        scattered = changed(SOUND, held_out=Rms(30.0, deg), rms=Rms(29.0, deg))
        crude = replace(scattered, picks=(of_size(30.0),), need=Need(need_mm))
        assert judge(crude).status == status
    # It is known where too little motion alone makes a result bad.
    weak = judge(replace(SOUND, picks=(of_size(4.0),), worst=directions(4e-3)))
    assert (weak.status, weak.has_accuracy) == ("bad", True)
    assert "It would be good for tasks of" in " ".join(weak.reasons)


def test_noise_beyond_any_such_arm_is_not_said_to_be_the_robots() -> None:
    large = np.diag(np.repeat([1e-6, 3e-3], 3) ** 2)[None]
    picks = (Picks("cam", "robot", dict.fromkeys(("look", "pick"), large), np.inf, 0.5),)
    for need in (None, NEED):
        verdict = judge(replace(changed(SOUND, noise_mm=3.0), picks=picks, need=need))
        assert verdict.status == ("check" if need is None else "bad")
        assert ids(verdict) == ["unexplained"]
        assert "repeats better" not in " ".join(verdict.reasons)


def test_a_step_that_several_frames_explain_alike_has_its_size() -> None:
    step = exp(np.array([1e-3, 0.0, 0.0, 2e-3, 0.0, 0.0]))
    what, how = _changed_words(SimpleNamespace(arms={}), "", step)
    assert what == "the camera, the target or a frame of the controller"
    assert how == ": by about 2 mm and 0.057 deg"
    assert not _changed_words(SimpleNamespace(arms={}), "", np.eye(4))[1]


def test_sources_of_one_kind_are_one_sentence() -> None:
    """Of a robot's noise at the look and at the pick, both larger than any arm's."""
    large = np.diag(np.repeat([1e-6, 3e-3], 3) ** 2)[None]
    picks = (Picks("cam", "robot", dict.fromkeys(("look", "pick"), large), np.inf, 0.5),)
    doubts = [Finding("few_stops", "Only 9 views are used.", until_mm=0.0)]
    (source,) = (at for at in rank_causes(doubts, picks, None) if at.is_share)
    assert "Picks err by 7.3 mm (sigma); 7.3 mm of this come from errors" in source.words
    assert source.probability == pytest.approx(1.0)
    assert not source.without_it


def test_a_board_of_another_size_is_no_noise_of_the_robot() -> None:
    parts = {name: of_size(0.8).parts["calibration"] for name in ("look", "pick")}
    picks = (replace(of_size(0.1), parts=parts),)
    board = Finding("board_size", "The board is 2 % smaller.", until_mm=0.0)
    assert [at.kind for at in rank_causes([board], picks, None)] == ["board_size"]


def test_a_lens_that_explains_its_own_misfit_is_likely_beside_a_step() -> None:
    """Without the lens all views disagree by centimetres, and the step explains the rest."""
    step = Finding("moved_at_once", "The target moved.", mahalanobis_sq=400.0)
    lens = Finding("lens", "The intrinsics do not fit.", is_apart=True)
    assert all(at.probability > 0.9 for at in rank_causes([step, lens], (), None))
    assert rank_causes([step, replace(lens, is_apart=False)], (), None)[1].probability < 0.01


def test_noise_that_a_finding_explains_asks_no_more_of_a_need_than_the_finding() -> None:
    found = changed(SOUND, held_out=Rms(3.0, 0.1), noise_mm=1.0)
    found = replace(found, picks=(of_size(0.1),))
    rounded = Finding("rounded_poses", "The poses are rounded.", until_mm=0.0)
    known = judge(replace(found, warnings=(rounded,)))
    assert known.good_for_mm == pytest.approx(0.28, rel=0.01)
    assert judge(found).good_for_mm == pytest.approx(10.0)
    assert "whatever is behind the doubts; if mere noise is, of 0.28 mm" in judge(found).reasons[-1]


def test_a_cause_that_inflates_all_sigmas_is_named_with_the_accuracy() -> None:
    length = Finding("arm_parameter", "A length is 4 mm longer.", until_mm=0.0)
    verdict = judge(replace(SOUND, picks=(of_size(4.0),), warnings=(length,)))
    (words,) = (at.words for at in verdict.findings if at.kind == "good_for")
    assert "and of less once the first cause is mended" in words


@pytest.mark.parametrize(("sigma_m", "status"), [(2e-3, "check"), (4e-3, "bad")])
def test_a_step_hides_no_sigma_of_which_a_result_is_of_no_use(sigma_m, status) -> None:
    """Below its limit a sigma is the step's effect; beyond, the transform is not to be used."""
    step = Finding("moved_at_once", "The target moved.", mahalanobis_sq=400.0)
    verdict = judge(replace(SOUND, worst=directions(sigma_m, 0, 0, 0), warnings=(step,)))
    assert verdict.status == status
    assert verdict.findings[0].kind == "moved_at_once"
    # More views would not help.
    weak = [at for at in verdict.findings if at.kind == "weak_motion"]
    assert [at.do for at in weak] == [None] * (status == "bad")


def test_a_turn_that_a_lens_leaves_open_is_not_blamed_on_a_board() -> None:
    """No size of a board turns anything, and views that are tilted enough are not too few."""
    picks = (of_size(0.3),)
    turned = replace(SOUND, worst=directions(1e-4, np.deg2rad(0.12)), picks=picks)
    (weak,) = (at for at in judge(turned).findings if at.kind == "weak_motion")
    assert weak.words.startswith("Weakly determined by the motion, ")
    (weak,) = (at for at in judge(replace(turned, by_lens=True)).findings if at.probability)
    assert weak.words.startswith("Weakly determined by how well the views determine the lens, ")
    assert weak.do is not None
    assert weak.do.words.startswith("State a lens that was calibrated with more images (matrix ")


def test_coarse_corners_leave_an_estimated_lens_open_and_no_stated_one() -> None:
    cell = CellOptions(seed=1, mount="eye-to-hand", views=16, pixel_sigma_px=0.6)
    weak = list[list[str]]()
    for known in (False, True):
        session = cell_session(simulate(replace(cell, state_intrinsics=known)), "c", seen="corners")
        found = calibrate(session).verdict.findings
        weak.append([at.words for at in found if at.kind == "weak_motion"])
    (words,), stated = weak
    assert "by how well the views determine the lens" in words
    assert not any("lens" in words for words in stated)


@pytest.mark.parametrize("sigma_mm", [0.1, 0.102])
def test_a_result_is_good_for_the_need_that_it_prints(sigma_mm: float) -> None:
    found = replace(SOUND, picks=(of_size(sigma_mm),))
    plain = judge(found)
    (words,) = (finding.words for finding in plain.findings if finding.kind == "good_for")
    (fact,) = need_facts(None, plain)
    for shown in (words.partition("tasks of ")[2], fact.value):
        assert judge(replace(found, need=Need(float(shown.split()[0])))).status == "good"


def test_the_worst_pair_counts_and_is_named() -> None:
    picks = (of_size(0.1, "cam_left", "a"), of_size(0.3, "cam_right", "b"))
    verdict = judge(replace(SOUND, need=NEED, picks=picks))
    assert "A pick by robot b of what cam_right sees where" in verdict.reasons[0]
    met = need_met(NEED, picks, whole=True)
    assert [pair.camera for pair in met.pairs] == ["left", "right"]
    assert met.probability == min(pair.probability for pair in met.pairs)
    assert met.of("left", "a").probability == met.pairs[0].probability
    assert need_met(None, picks) is None


def test_a_result_states_the_need_that_it_meets() -> None:
    known = calibrated(simulate(CellOptions(views=12)))
    plain = result_of(known)
    assert plain.need is None
    assert plain.verdict.good_for_mm == pytest.approx(0.2, abs=0.1)
    need = {"mm": plain.verdict.good_for_mm, "at": [0.5, 0.1, 0.0]}
    session = replace(known.session, document={**known.session.document, "need": need})
    with_need = result_of(calibrated(simulate(CellOptions(views=12)), session=session))
    # The camera looks at a declared place as it looked at the board.
    assert with_need.need.probability == pytest.approx(0.95, abs=1e-3)
    again = Calibration.from_json(json.dumps(to_document(with_need)), "again")
    assert (again.need, again.verdict) == (with_need.need, with_need.verdict)
