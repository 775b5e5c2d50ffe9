"""Causes of doubts: how likely each is, what competes, and what stands on top."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtrc
from support.cells import calibrated, showing
from support.marks import slow
from support.sound_findings import SOUND, changed, directions

from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.fit_messages import scale_finding
from visioncal.calibration.stages.need import Picks
from visioncal.calibration.suspects.judge import judge
from visioncal.calibration.suspects.judged import PointAccuracy
from visioncal.calibration.suspects.ranking import (
    MEASURE_BOARD,
    NO_JOINTS,
    explained_by,
)
from visioncal.core.codec import read, write
from visioncal.core.transforms import exp, pose_difference
from visioncal.core.types import Need
from visioncal.core.verdict import (
    CALIBRATE,
    GUESS,
    PLAN,
    READ_AGAIN,
    Finding,
    Remedy,
    Verdict,
    with_paths,
)
from visioncal.estimation.joint import MeasuredScale
from visioncal.results.parts import VerdictForm
from visioncal.session import Session
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.vision.targets import load_target

EXCHANGED = Finding(
    "exchanged_views",
    "Views 3 and 4 are exchanged: the image of each fits the pose in the other's row.",
    Remedy("Exchange them.", CALIBRATE),
    (3, 4),
)
POSTURE = Finding("arm_errors", "Residuals follow the arm's posture.", mahalanobis_sq=45.0)
FIELD = Finding("lens_field", "The lens departs.", mahalanobis_sq=300.0, up_to_mm=0.08)
DRIFT = Finding("moved_slowly", "Residuals drift with time.")
MEASURED = MeasuredScale(4.7e-3, 6e-4, 8e-4)
SIZE = scale_finding(
    "board", load_target("charuco_9x6_30mm"), MEASURED, replace(MEASURED, scale=4e-3, sigma=9e-4)
)


def chi2_chance(square: float) -> float:
    return float(chdtrc(1.0, square))


def ids(verdict: Verdict) -> list[str]:
    return [cause.kind for cause in verdict.causes]


def test_exchanged_rows_come_first_with_what_is_left_without_them() -> None:
    verdict = judge(changed(SOUND, warnings=(DRIFT, EXCHANGED), stops=8))
    assert ids(verdict)[0] == "exchanged_views"
    first = verdict.causes[0]
    assert first.probability > 0.9999
    assert first.without_it == (
        "Without these views, the others predict each other to 0.11 mm and 0.011 deg."
    )
    assert first.do == EXCHANGED.do
    assert verdict.causes == tuple(sorted(verdict.causes, key=lambda cause: -cause.probability))


@pytest.mark.parametrize(
    ("warnings", "chances"),
    [
        ((DRIFT,), (1e-4,)),
        # Those that give figures are weighed by them: twice a gain of 45, and 4.7 sigmas.
        ((POSTURE, DRIFT), (chi2_chance(45.0), 1e-4)),
        ((SIZE, DRIFT), (chi2_chance(22.09), 1e-4)),
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


def test_what_moves_picks_little_is_no_cause_of_a_large_misfit() -> None:
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


@pytest.mark.parametrize(("sigma_m", "kinds"), [(1e-4, ["lens_field"]), (3e-4, [])])
def test_what_picks_err_by_hardly_less_without_is_no_doubt(sigma_m, kinds) -> None:
    # It moves them by up to 0.08 mm; they err by 0.17 and by 0.52 mm.
    spread = np.diag(np.repeat([1e-6, sigma_m], 3) ** 2)[None]
    picks = (Picks("cam", "robot", {"look": spread}, np.inf, 0.5),)
    verdict = judge(replace(SOUND, picks=picks, warnings=(FIELD,)))
    assert ids(verdict) == kinds
    assert verdict.status == ("check" if kinds else "good")
    assert any(finding.words == FIELD.words for finding in verdict.findings)


def test_what_moves_with_the_time_passes_for_a_focus_and_not_the_other_way() -> None:
    focus = Finding("focus", "The lens changes its focal length.", mahalanobis_sq=300.0)
    assert ids(judge(changed(SOUND, warnings=(focus, DRIFT))))[0] == "moved_slowly"
    assert ids(judge(changed(SOUND, warnings=(focus,)))) == ["focus"]


def test_a_held_lens_that_is_wrong_is_no_arm_that_errs() -> None:
    held = Finding("lens", "The given intrinsics do not fit.", mahalanobis_sq=2000.0)
    verdict = judge(changed(SOUND, warnings=(POSTURE, held), noise_mm=2.0))
    assert ids(verdict)[0] == "lens"
    # It is the first reason, too, before how large the errors are.
    assert verdict.reasons[0] == held.words


@pytest.mark.parametrize(
    ("name", "said", "written"),
    [
        ("charuco_9x6_30mm", "squares of 30.14 mm, not of 30 mm", "square_m = 0.03014 in"),
        ("aprilgrid_6x4_32mm", "tags of 32.15 mm, not of 32 mm", "size_m = 0.03215 in"),
        ("apriltag_36h11_id0_120mm", "a side of 120.6 mm, not of 120 mm", "size_m = 0.1206 in"),
    ],
)
def test_another_size_is_said_by_what_the_targets_file_calls_it(name, said, written) -> None:
    found = scale_finding("board", load_target(name), MEASURED, MEASURED)
    assert said in found.words
    assert written in found.do.words


def test_what_nothing_explains_is_the_cause_itself() -> None:
    (only,) = judge(changed(SOUND, noise_mm=1.0)).causes
    assert (only.kind, only.probability) == ("unexplained", 1.0)
    assert "a board of another size than stated (measure it" in only.do.words


def test_what_happened_comes_before_what_nothing_explains() -> None:
    moved = Finding("something_moved", "From view 12 on, the camera stood elsewhere.")
    found = judge(changed(SOUND, noise_mm=1.0, warnings=(moved,)))
    assert ids(found)[:2] == ["something_moved", "unexplained"]


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
    budget = {"pixels": 0.05, "board": 0.02, "held values": 0.1, "total": 0.12}
    of_board = replace(found, places=(PointAccuracy("A point", budget, 0.2),))
    assert judge(of_board).causes[1].do is MEASURE_BOARD
    # What can be had without them is no cause of a doubt about something else.
    met = replace(found, need=None, worst=directions(1e-4), warnings=(DRIFT,))
    assert ids(judge(met)) == ["moved_slowly"]


def test_a_sigma_far_beyond_its_limit_is_the_cause_of_a_bad_result() -> None:
    spread = np.diag(np.repeat([1e-6, 4e-4], 3) ** 2)[None]
    picks = (Picks("cam", "robot", {"look": spread}, np.inf, 0.5),)
    place = PointAccuracy("cam", {"pixels": 4.0, "total": 4.0}, 7.0)
    bad = replace(SOUND, picks=picks, worst=directions(4e-3), places=(place, place))
    verdict = judge(bad)
    assert verdict.status == "bad"
    # What picks err by is within the limits, and no reason for it.
    assert ids(verdict) == ["weak_motion"]
    assert verdict.reasons[0].startswith("Weakly determined by the motion")
    assert ids(judge(replace(bad, worst=directions(1e-4)))) == ["place"]
    # A mistake that is found is likelier, and a need asks for what picks err by.
    drifting = judge(replace(bad, warnings=(DRIFT,)))
    assert "moved_slowly" in ids(drifting)
    assert "weak_motion" not in ids(drifting)
    assert ids(judge(replace(bad, need=Need(0.5)))) == ["robot_noise"]


MISSPELT = Finding("remark", "squaresize is not read.", Remedy("Correct it."))
PLACES = (PointAccuracy("cam", {"pixels": 2.0, "total": 2.0}, 4.0),)


@pytest.mark.parametrize(
    ("changes", "causes"),
    [
        ({"worst": directions(2e-3), "places": PLACES}, ["weak_motion"]),
        ({"places": PLACES}, ["place"]),
        ({"warnings": (MISSPELT,)}, ["remark"]),
        ({"stops": 8, "warnings": (MISSPELT,)}, ["few_stops", "remark"]),
        ({"stops": 8, "worst": directions(2e-3)}, ["weak_motion", "few_stops"]),
        # They are none where something else is likely.
        ({"stops": 8, "warnings": (DRIFT,)}, ["moved_slowly"]),
    ],
)
def test_every_doubt_has_a_cause_and_a_next_step(changes, causes) -> None:
    verdict = judge(changed(SOUND, **changes))
    assert verdict.status == "check"
    assert ids(verdict) == causes
    assert all(cause.do or cause.kind == "moved_slowly" for cause in verdict.causes)
    assert verdict.next_steps or causes == ["moved_slowly"]


def test_poses_that_are_misread_explain_the_rest() -> None:
    before = judge(changed(SOUND, warnings=(DRIFT,)))
    after = explained_by(
        before, Finding("misread_poses", "The quaternions are w, x, y, z.", READ_AGAIN)
    )
    assert ids(after) == ["misread_poses", "moved_slowly"]
    assert sum(cause.probability for cause in after.causes) <= 1.0
    assert after.top[0].startswith("Most likely: The quaternions are w, x, y, z.")
    assert after.reasons[1:] == before.reasons


def test_exchanged_rows_explain_poses_that_are_misread() -> None:
    before = judge(changed(SOUND, warnings=(EXCHANGED,), stops=8))
    after = explained_by(before, Finding("misread_poses", "With views exchanged.", READ_AGAIN))
    assert after == before


def test_a_kind_that_is_in_no_catalogue_is_no_finding() -> None:
    with pytest.raises(KeyError, match="something_odd"):
        judge(changed(SOUND, warnings=(Finding("something_odd", "It is odd."),)))


def test_joints_that_are_there_but_misread_come_before_the_errors_they_would_explain() -> None:
    step = Remedy('Write model = "ur5e".')
    misread = Finding("misread_joints", "With the arm a ur5e and not a ur3e, they fit.", step)
    warnings = (replace(POSTURE, do=NO_JOINTS), misread)
    verdict = judge(changed(SOUND, warnings=warnings))
    assert ids(verdict)[:2] == ["misread_joints", "arm_errors"]
    # To record what is there already is no advice.
    assert verdict.next_steps[0] == step
    assert NO_JOINTS not in verdict.next_steps


def test_the_cause_its_cost_and_what_to_do_come_first() -> None:
    found = (
        Finding("place", "A point is placed to 4 mm.", Remedy("Add views."), is_fatal=True),
        Finding("something_odd", "It is odd."),
        Finding("lens", "The lens is another.", Remedy("Leave it out."), probability=0.2),
        DRIFT,
        replace(EXCHANGED, probability=0.7, without_it="Without them all is well."),
        Finding("holdout", "Held back.", Remedy("Add views."), probability=0.01),
    )
    verdict = Verdict("bad", found)
    assert verdict.top == (
        f"Most likely (70 %): {EXCHANGED.words} Without them all is well.",
        "A point is placed to 4 mm.",
        "Possibly (20 %): The lens is another.",
    )
    assert verdict.rest == ("It is odd.", DRIFT.words, "Held back.")
    sure = replace(found[2], probability=0.6)
    assert Verdict("bad", (found[4], sure)).top[1] == "Also likely (60 %): The lens is another."
    assert verdict.next_steps == (EXCHANGED.do, Remedy("Add views."), Remedy("Leave it out."))
    assert Verdict.of("good", "Fine.").top == ("Fine.",)


def test_findings_are_kept_and_name_the_session(tmp_path: Path) -> None:
    verdict = judge(changed(SOUND, warnings=(EXCHANGED,), stops=8))
    document = json.loads(json.dumps(write(VerdictForm, VerdictForm.of(verdict))))
    assert read(VerdictForm, document, "verdict").verdict("verdict") == verdict
    named = verdict.with_paths(tmp_path / "my cell", "out")
    command = f"visioncal calibrate '{tmp_path}/my cell' -o out"
    assert named.next_steps[0].command == command
    # Too few stops were found before it, and are no cause.
    assert command in named.reasons[0]
    folder = tmp_path / "cell"
    # An apostrophe of a sentence is no quotation.
    assert with_paths("Look at the camera's driver.", folder) == "Look at the camera's driver."
    assert with_paths(GUESS, folder) == f"visioncal convert {folder} {folder}-fixed --guess --yes"
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


def crosswise(rng):
    """Each pair of views that are exchanged turns as it should, which shuffled rows do not."""
    mates, order = rng.permutation(18).reshape(9, 2), np.arange(18)
    order[mates] = mates[:, ::-1]
    return order


@pytest.mark.parametrize(
    ("mount", "mixed", "named"),
    [
        slow("eye-to-hand", lambda rng: rng.permutation(18), True),
        # Where the other half is as it should be, that is not said.
        ("eye-in-hand", lambda rng: [*rng.permutation(9), *range(9, 18)], False),
        slow("eye-to-hand", crosswise, True),
    ],
    ids=["all", "half", "crosswise"],
)
def test_rows_that_were_shuffled_are_named(mount, mixed, named):
    cell = simulate(CellOptions(mount=mount, views=18, seed=4))
    order = mixed(np.random.default_rng(1))
    verdict = calibrate(session_of(cell, cell.robot.base_from_flange[order])).verdict
    assert ("poses are not those of the images" in verdict.top[0]) == named
    assert verdict.status == ("bad" if named else "check")


def test_exchanged_rows_are_named_of_a_board_that_looks_the_same_turned():
    """Of the two poses that each image allows, the one that fits its own row best was taken."""
    target = replace(load_target("checkerboard_9x6_25mm"), rows=7)
    cell = simulate(CellOptions(target=target, mount="eye-to-hand", views=14, seed=1))
    order = np.arange(14)
    order[[3, 7]] = 7, 3
    verdict = calibrate(session_of(cell, cell.robot.base_from_flange[order])).verdict
    assert verdict.reasons[0].startswith("Views 3 and 7 are exchanged")


def test_a_push_is_found_in_few_views_of_an_arm_that_errs():
    # With joint angles its links are estimated; the push is in the noise of places alone.
    options = CellOptions(views=14, seed=12, dh_sigma_m=3e-4, dh_sigma_rad=3e-4)
    before, after = (
        simulate(replace(options, camera_moved_m=shift_m)).corners for shift_m in (0.0, 2e-3)
    )
    first = calibrated(showing(simulate(options), before[:5] + after[5:])).verdict.causes[0]
    said = re.search(r"camera moved at once: from view 5 on, it is (\S+) mm", first.words)
    # Its sigma is a tenth of a millimetre, of an arm that errs by three.
    assert float(said.group(1)) == pytest.approx(2.0, abs=0.3)
    assert {*ids(calibrated(simulate(options)).verdict)} <= {"optimism"}


@pytest.mark.parametrize(("since", "mount"), [(24, "eye-in-hand"), slow(6, "eye-to-hand")])
def test_views_left_out_after_a_bump_name_it_before_the_errors_of_the_arm(mount, since):
    options = CellOptions(mount=mount, seed=2, views=30, dh_sigma_m=3e-4, dh_sigma_rad=3e-4)
    before, after = (
        simulate(replace(options, camera_moved_m=shift_m)).corners for shift_m in (0.0, 4e-3)
    )
    bumped = showing(simulate(options), before[:since] + after[since:])
    verdict = calibrated(bumped, joints=False).verdict
    assert ids(verdict) == ["something_moved", "arm_errors"]
    # Fewer of them, in front or behind, are left out.
    when = "from view 24 on" if since == 24 else "before view 6"
    said = re.search(rf"{when}, as they agree, the camera stood (\S+) mm", verdict.causes[0].words)
    # What an arm errs by at six stops is another mean.
    assert float(said.group(1)) == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize(
    ("since", "which", "mount"),
    [
        (12, "tool", "eye-in-hand"),
        slow(6, "base", "eye-to-hand"),
    ],
)
def test_a_frame_of_the_controller_that_is_switched_on_midway_is_named(mount, which, since):
    cell = simulate(CellOptions(mount=mount, views=18, seed=3))
    switched = exp(np.array([0.0, 0.5, 0.7, 0.02, -0.01, 0.18]))
    flange = cell.robot.base_from_flange.copy()
    flange[since:] = flange[since:] @ switched if which == "tool" else switched @ flange[since:]
    cause = calibrate(session_of(cell, flange)).verdict.causes[0]
    assert cause.kind == "something_moved"
    # Of the two parts the larger one is kept.
    assert ("from view 12 on" if since == 12 else "before view 6") in cause.words
    said = re.search(rf"another {which} frame, (\d+) mm and (\d+) deg from", cause.words)
    # Seen from 1.5 m away, whose direction is known to 0.5 mrad; and figures are rounded.
    away = np.abs(np.array(said.groups(), float) - pose_difference(np.eye(4), switched))
    assert (away < [1.3, 0.55]).all()


def test_weak_motion_comes_first_and_its_advice_once() -> None:
    # Tilted by 3 degrees, a robot's rotation error of 0.02 deg moves the camera's offset by 2 mm.
    options = CellOptions(
        tilt_rad=(0.0, 0.06),
        distance_m=(0.25, 0.9),
        robot_sigma_m=1e-4,
        robot_sigma_rad=4e-4,
        state_intrinsics=False,
    )
    verdict = calibrated(simulate(options)).verdict
    assert verdict.status == "check"
    assert verdict.ranked[0].kind == "weak_motion"
    assert "weak_lens" in {finding.kind for finding in verdict.findings}
    (step,) = verdict.next_steps
    assert step.words.startswith("Add 5 views or more, tilted by 20 to 40 degrees")
