"""Whether a calibration still holds: what a few fresh stops say of a change, and of none."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from support.beyond import with_field
from support.cells import board_numbers, calibrated, known_of, reporting, session_of
from support.commands import visioncal
from support.later import ANYHOW, FITTED, Change, again, knock, known_again, usual
from support.marks import slow
from support.pages import Page

from visioncal import calibrate, verify
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.verification import to_document, triggers_of, verdict_of
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.check import check
from visioncal.calibration.verification.messages import _signed_axis
from visioncal.calibration.verification.prediction import (
    predict_detected,
    predict_stops,
)
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.simulation import CellOptions, Payload, Second, simulate, write_session
from visioncal.simulation.boards import centre_m
from visioncal.vision.targets import numbered_positions

MOUNTS = ("eye-in-hand", "eye-to-hand")


def checked(place, rng, change=None, stops=5, **options):
    prior_calibration = CalibrationPrior.of(place.calibration)
    return check(
        predict_detected(known_again(place.cell, rng, change, stops), prior_calibration),
        prior_calibration,
        **options,
    )


def names(found):
    return [value.name for value in found.named]


def slip(joint, deg):
    offsets = np.zeros(6)
    offsets[joint - 1] = np.deg2rad(deg)
    return Change(joints_rad=offsets)


@pytest.fixture
def place():
    return usual("eye-in-hand")


def test_an_unchanged_cell_passes_as_often_as_it_should(place):
    rng = np.random.default_rng(0)
    found = [checked(place, rng) for _ in range(4)]
    assert all(value.passed and not value.named for value in found)
    # Chi-square of thirty directions; the mean of four is known to 3.9, and the noise's scale to
    # a tenth, which is three more.
    assert np.mean([value.misfit for value in found]) == pytest.approx(30.0, abs=15.0)


def test_a_lens_that_departs_from_its_model_is_seen_with_its_field(place):
    plain = predict_detected(
        known_again(place.cell, np.random.default_rng(0)), CalibrationPrior.of(place.calibration)
    )
    result = with_field(place.calibration)
    lens, known = result.camera, known_again(place.cell, np.random.default_rng(0))
    ((frame, look),) = known.cameras.items()
    poses = {view: pose.cam_from_target[0] for view, pose in plain.observed.poses.items()}
    displaced = {}
    for view, view_corners in look.corners.items():
        points = numbered_positions(tuple(plain.observed.session.boards.values()))[view_corners.ids]
        far_m = float(np.mean(points @ poses[view][2, :3] + poses[view][2, 3]))
        px = view_corners.px + lens.displacements(view_corners.px, far_m) @ lens.field.coefficients
        displaced[view] = replace(view_corners, px=px)
    known = known.with_camera(frame, replace(look, corners=displaced))
    expected = plain.away(CalibrationPrior.of(place.calibration))

    def off_mm(calibration):
        prior_calibration = CalibrationPrior.of(calibration)
        away = predict_detected(known, prior_calibration).away(prior_calibration)
        return 1e3 * np.abs(away - expected)[:, :3, 3].max()

    # A field of 0.3 px changes by some thousandths of that over itself.
    assert off_mm(result) < 0.02
    assert off_mm(place.calibration) > 0.2


def test_a_bumped_camera_is_told_with_its_size_and_direction(place):
    bump = np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.0])
    found = checked(place, np.random.default_rng(1), Change(camera=bump))
    assert names(found) == ["camera"]
    assert not found.passed
    assert found.explained
    values, covariance = found.named[0].explained.values, found.named[0].explained.covariance
    error = values - bump
    # Chi-square of six exceeds 22.5 in one case of a thousand.
    assert error @ np.linalg.solve(covariance, error) < 22.5
    told = to_document(found, ())["changes"][0]
    assert told["moved_mm"] == pytest.approx(1.0, abs=4 * told["sigma_mm"])
    assert "The camera moved by" in verdict_of(found).reasons[0]


def test_a_turned_camera_a_moved_board_and_a_slip_are_told_apart(place):
    rng = np.random.default_rng(2)
    assert names(checked(place, rng, Change(camera=knock(rng, 0.0, 0.2)))) == ["camera"]
    assert names(checked(place, rng, Change(board=knock(rng, 1.0, 0.0)))) == ["board"]
    found = checked(place, rng, slip(3, -0.05))
    assert names(found) == ["joint 3"]
    told = to_document(found, ())["changes"][0]
    assert told["offset_deg"] == pytest.approx(-0.05, abs=4 * told["sigma_deg"])
    assert "Joint 3 (elbow_joint) off by -0.0" in verdict_of(found).reasons[0]


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_what_no_stops_can_tell_apart_is_named_together(mount):
    place, rng = usual(mount), np.random.default_rng(3)
    stands, carried = "board", "camera"
    if mount == "eye-to-hand":
        stands, carried = carried, stands
    # A slip of the first joint turns all that stands in the base; of the last, what is carried.
    first = checked(place, rng, slip(1, 0.05))
    assert set(names(first)) == {"joint 1", stands}
    assert "No stops separate that from" in verdict_of(first).reasons[1]
    assert set(names(checked(place, rng, slip(6, 0.05)))) == {"joint 6", carried}


def test_one_stop_is_no_robot_that_scatters(place):
    rng = np.random.default_rng(1)
    found = checked(place, rng, Change(board=knock(rng, 2.0, 0.0)), stops=1)
    assert not found.passed
    assert {"camera", "board"} <= set(names(found))
    assert "1 stop cannot separate that from" in verdict_of(found).reasons[1]


def test_a_board_that_was_turned_by_much_is_told(place):
    middle = compose(np.eye(3), centre_m(place.cell.board()))
    turn = exp(np.array([0.02, -0.05, 2.5, 0.0, 0.02, 0.0]))
    moved = log(middle @ turn @ invert(middle))
    found = checked(place, np.random.default_rng(4), Change(board=moved))
    assert names(found) == ["board"]
    assert found.explained
    # Known to some hundredths of a millimetre and of a degree.
    assert found.named[0].explained.values == pytest.approx(moved, abs=1e-3)


def test_a_board_of_another_size_is_told_from_one_that_moved(place):
    rng = np.random.default_rng(7)
    found = checked(place, rng, Change(board_scale=1.005))
    assert names(found) == ["board_size"]
    # Five stops know it to some hundredths of a percent.
    assert found.named[0].explained.values == pytest.approx([0.005], abs=5e-4)
    assert "0.5 % larger" in verdict_of(found).reasons[0]
    exchanged = Change(board=knock(rng, 5.0, 1.0), board_scale=0.99)
    found = checked(place, rng, exchanged)
    assert names(found) == ["board_replaced"]
    assert found.named[0].explained.values[-1] == pytest.approx(-0.01, abs=5e-4)
    assert names(checked(place, rng, exchanged, board_placed_anew=True)) == ["board_size"]


def test_a_board_that_was_placed_anew_is_no_fault(place):
    rng = np.random.default_rng(5)
    anew = Change(board=np.array([0.0, 0.0, 0.3, 0.02, 0.01, 0.0]))
    assert checked(place, rng, anew, board_placed_anew=True).passed
    slipped = replace(anew, joints_rad=slip(3, 0.1).joints_rad)
    assert names(checked(place, rng, slipped, board_placed_anew=True)) == ["joint 3"]


def test_two_changes_more_noise_and_a_wrong_view_are_told(place):
    rng = np.random.default_rng(6)
    both = Change(camera=knock(rng, 2.0, 0.3), board=knock(rng, 2.0, 0.3))
    found = checked(place, rng, both)
    assert names(found) == ["camera_and_board"]
    assert set(to_document(found, ())["changes"][0]) >= {"camera", "board"}
    assert names(checked(place, rng, Change(noise_factor=8.0))) == ["robot_noise"]
    prior_calibration, cell = CalibrationPrior.of(place.calibration), again(place.cell, rng)
    # The third image was taken at another pose than is written beside it.
    wrong = cell.robot.joints.copy()
    wrong[2] = wrong[2] + 0.02
    found = check(
        predict_detected(known_of(reporting(cell, joints=wrong)), prior_calibration),
        prior_calibration,
    )
    assert names(found) == ["view 2"]
    assert "View 2 alone contradicts" in verdict_of(found).reasons[0]


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_stops_that_repeat_calibrated_ones_show_what_the_arms_errors_hide(mount):
    wrong = {"dh_sigma_m": 1e-4, "dh_sigma_rad": 1e-4, "branches": True, "roll_rad": np.pi}
    cell = simulate(CellOptions(mount=mount, views=25, seed=11, **wrong))
    calibration = result_of(calibrated(cell, joints=False))
    # The arm is off by its posture, and without joint angles that is noise.
    assert calibration.noise["robot_translation_mm"] > 0.1
    prior = CalibrationPrior.of(calibration)

    def seen(rng, change):
        known = known_of(again(cell, rng, change, repeated=25), joints=False)
        return check(predict_detected(known, prior), prior)

    for seed in range(3):
        rng = np.random.default_rng(seed)
        same = seen(rng, None)
        assert same.passed
        assert same.repeated == 5
        assert "(5 of them where the calibration's stood)" in verdict_of(same).reasons[0]
        bumped = seen(rng, Change(camera=knock(rng, 0.4, 0.0)))
        assert names(bumped)[0] == "camera"


@pytest.mark.slow
def test_an_arm_off_by_its_posture_raises_no_alarm_near_the_calibration():
    options = CellOptions(dh_sigma_m=5e-4, dh_sigma_rad=1e-3, seed=3)
    cell = simulate(replace(options, views=FITTED + 20))
    calibration = result_of(calibrated(cell.only(range(FITTED)), joints=False))
    prior_calibration = CalibrationPrior.of(calibration)
    # Without joint angles, its errors are in the noise of a look.
    assert prior_calibration.fit.arm is None
    assert np.linalg.eigvalsh(prior_calibration.covariance)[0] > -1e-12
    rng = np.random.default_rng(8)
    for _ in range(4):
        known = known_of(again(cell, rng), joints=False)
        assert check(predict_detected(known, prior_calibration), prior_calibration).passed


@pytest.mark.slow
def test_a_bent_arm_under_its_loads_is_no_change():
    """Springs and loads are in what is predicted."""
    loads = (Payload(), Payload(8.0, (0.0, 0.0, 0.1)))
    springs = {"compliance_rad_per_nm": (6e-5,) * 6, "payloads": loads}
    cell = simulate(replace(ANYHOW, robot="ur10e", views=FITTED + 20, seed=2, **springs))
    robot = load_robot("ur10e")
    lot = result_of(calibrated(cell.only(range(FITTED)), robot=robot))
    assert lot.arm.level == "elastic"
    rng, prior_calibration = np.random.default_rng(4), CalibrationPrior.of(lot)
    found = check(
        predict_detected(known_of(again(cell, rng), robot=robot), prior_calibration),
        prior_calibration,
    )
    assert found.passed, found.misfit
    bumped = again(cell, rng, Change(camera=knock(rng, 2.0, 0.0)))
    assert not check(
        predict_detected(known_of(bumped, robot=robot), prior_calibration), prior_calibration
    ).passed


@pytest.mark.slow
def test_one_of_two_boards_that_moved_is_named():
    cell = simulate(replace(ANYHOW, second=Second(turn_rad=0.6, tilt_rad=0.2), views=24, seed=2))
    calibration = result_of(calibrated(cell))
    prior_calibration = CalibrationPrior.of(calibration)
    assert len(prior_calibration.boards) == 2
    known = known_of(cell)
    shown = board_numbers(cell)
    pushed = np.array([0.0, 0.0, 0.0, 0.0, 3e-3, 0.0])
    assert check(predict_detected(known, prior_calibration), prior_calibration).passed
    assert shown.max() == 1
    moved = predict_detected(known, prior_calibration)
    # Some stops show both.
    assert len(moved.problem) > moved.stops == 24
    mine = np.array([shown[view] for view in moved.views]) == 1
    seen = moved.problem.observations
    measured = np.where(mine[:, None, None], seen.measured @ exp(pushed), seen.measured)
    pushed = replace(moved.problem, observations=replace(seen, measured=measured))
    found = check(replace(moved, problem=pushed), prior_calibration)
    assert names(found) == [f"board {tuple(prior_calibration.targets)[1]}"]
    axes = prior_calibration.state.edges[1 + prior_calibration.boards.index(1), :3, :3]
    assert (
        verdict_of(found)
        .findings[0]
        .words.endswith(f"along the base's {_signed_axis(axes[:, 1])}.")
    )
    with pytest.raises(DataError, match="several boards") as refused:
        check(moved, prior_calibration, board_placed_anew=True)
    assert "the one that moved is named" in refused.value.next_step


@pytest.mark.slow
def test_a_calibration_holds_by_its_own_session_of_which_it_left_views_out(tmp_path):
    cell = simulate(CellOptions(views=24, seed=3))
    flange = cell.robot.base_from_flange.copy()
    # Two images of one stop stand in the rows of another.
    flange[[4, 9]] = flange[[9, 4]]
    wrong = reporting(cell, base_from_flange=flange)
    session = Session.load(write_session(wrong, tmp_path / "cell", images=False))
    calibration = calibrate(session)
    assert [view.view for view in calibration.views if not view.used] == [4, 9]
    found = verify(session, calibration)
    assert found.passed
    assert found.predicted.stops == 22
    assert [value["view"] for value in to_document(found, ())["not_used"]] == [4, 9]
    # Of another session nothing is known beforehand.
    assert not verify(
        replace(session, document={**session.document, "name": "b"}), calibration
    ).passed


@pytest.mark.slow
def test_boards_are_those_of_the_same_name_or_print_however_many_a_session_has(tmp_path):
    cell = simulate(CellOptions(views=24, second=Second(), seed=3))
    two = Session.load(write_session(cell, tmp_path / "two", images=False))
    prior_calibration = CalibrationPrior.of(calibrate(two))
    named = dict(reversed(two.targets.items()))
    turned = replace(two, targets=named)
    assert check(predict_stops(turned, prior_calibration), prior_calibration).passed
    for name, board in two.targets.items():
        shown = tuple(view for view in two.views if view.text["target"] == name)
        alone = {key: value for key, value in two.document.items() if key != "targets"}
        one = replace(two, document=alone, target=board, targets={}, views=shown)
        found = check(predict_stops(one, prior_calibration), prior_calibration)
        assert found.passed
        assert found.predicted.stops == len(shown)
        with pytest.raises(DataError, match="which of the targets"):
            predict_stops(replace(one, target=None), prior_calibration)
        with pytest.raises(DataError, match="columns = 11"):
            predict_stops(
                replace(turned, targets={**named, name: replace(board, columns=11)}),
                prior_calibration,
            )
        with pytest.raises(DataError, match="is none of those") as refused:
            predict_stops(two, CalibrationPrior.of(calibrate(one)))
        assert "that target alone" in refused.value.next_step
        with pytest.raises(DataError, match="is none of those"):
            predict_stops(replace(one, target=replace(board, columns=11)), prior_calibration)


def test_other_cells_are_refused_by_what_differs():
    place = usual("eye-in-hand")
    prior_calibration = CalibrationPrior.of(place.calibration)
    session = session_of(place.cell)
    other = replace(session.target, columns=11)
    for wrong, words in (
        (replace(session, document={**session.document, "mount": "eye-to-hand"}), "eye-to-hand"),
        (replace(session, target=other), "columns = 11"),
        (replace(session, robot_document=load_robot("ur10e").document), "another robot"),
    ):
        with pytest.raises(DataError, match=words):
            predict_stops(wrong, prior_calibration)
    known = known_again(place.cell, np.random.default_rng(9))
    with pytest.raises(DataError, match="no joint angles"):
        predict_detected(
            known.with_robot("", replace(known.reported, matched=None)), prior_calibration
        )
    look = known.cameras["cam"]
    with pytest.raises(DataError, match="640 x 480"):
        predict_detected(
            known.with_camera("cam", replace(look, resolution=(640, 480))), prior_calibration
        )
    with pytest.raises(DataError, match="holds no fit"):
        CalibrationPrior.of(replace(place.calibration, joint_fit=None))
    spoilt = replace(place.calibration.joint_fit, covariance=np.eye(1))
    with pytest.raises(DataError, match="joint_fit cannot be read"):
        CalibrationPrior.of(replace(place.calibration, joint_fit=spoilt))


def test_triggers_fire_by_their_limits_and_say_what_is_not_known():
    place = usual("eye-in-hand")
    created = datetime(2026, 1, 1, tzinfo=UTC)
    calibration = replace(place.calibration, means={"ambient_c": 21.0}, created=created.isoformat())
    session = session_of(place.cell.only(range(5)))
    warm = tuple(replace(view, numbers={"ambient_c": 33.0}) for view in session.views)
    also = {"failed": False, "collision": True, "now": created + timedelta(days=200)}
    evaluated = triggers_of(replace(session, views=warm), calibration, **also)
    told = {trigger.quantity: trigger for trigger in evaluated}
    assert {name: trigger.state for name, trigger in told.items()} == {
        "failed_check": "quiet",
        "collision": "fired",
        "ambient_change_k": "fired",
        "payload_change_kg": "unknown",
        "age_days": "quiet",
    }
    assert "12 K (limit 10)" in told["ambient_change_k"].words
    assert told["age_days"].value == 200.0


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """A calibrated session of pose pairs, and five later ones of the same cell."""
    folder = tmp_path_factory.mktemp("pairs")
    whole = write_session(simulate(CellOptions(views=25, seed=5)), folder / "all", images=False)
    session = Session.load(whole)
    cold = [replace(view, numbers={**view.numbers, "ambient_c": 20.0}) for view in session.views]
    columns = (*session.columns, "ambient_c")
    for name, views in (("fit", cold[:20]), ("later", cold[20:])):
        replace(session, columns=columns, views=tuple(views)).save(folder / name)
    assert visioncal("calibrate", folder / "fit", "-o", folder / "out").status == 0
    return folder


def test_the_command_says_pass_or_fail_by_its_status(pairs, tmp_path):
    out = pairs / "out"
    assert Calibration.load(out).means == {"ambient_c": 20.0}
    done = visioncal("verify", pairs / "later", "--against", out, "-o", tmp_path / "check")
    assert done.status == 0
    assert done.out.startswith("pass")
    assert "the ambient temperature's change, 0 K (limit 10)" in done.out
    written = json.loads((tmp_path / "check/verify.json").read_text())
    assert written["passed"]
    assert not written["recalibrate"]
    page = Page((tmp_path / "check/report.html").read_text(encoding="utf-8"))
    assert "The calibration still holds" in page.words
    assert not [
        reference for reference in page.references if not reference.startswith(("#", "data:"))
    ]
    # A check has no business with the files of a calibration.
    refused = visioncal("verify", pairs / "later", "--against", out, "-o", out)
    assert refused.status == 2
    assert "holds a calibration" in refused.err
    session = Session.load(pairs / "later")
    # The camera's poses as if it had been knocked by 20 mm along its own x.
    pushed = tuple(
        replace(view, numbers={**view.numbers, "cft_x_m": view.numbers["cft_x_m"] - 0.02})
        for view in session.views
    )
    replace(session, views=pushed).save(tmp_path / "knocked")
    done = visioncal("verify", tmp_path / "knocked", "--against", out, "--json")
    assert done.status == 3
    document = json.loads(done.out)
    assert document["changes"][0]["cause"] == "camera"
    assert document["changes"][0]["moved_mm"] == pytest.approx(20.0, rel=0.1)
    assert document["recalibrate"]
    assert visioncal("verify", pairs / "later").status == 2
