"""Whether a calibration still holds by a few fresh stops, and what is recovered after a knock."""

import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from support.beyond import with_field
from support.cells import board_numbers, calibrated, known_of, pairs_session, reporting, session_of
from support.commands import visioncal
from support.later import ANYHOW, Change, again, knock, known_again, usual
from support.marks import seeds, slow
from support.misfits import misfit
from support.pages import Page
from support.refusals import raised
from support.wrong_arms import COBOT, target_in_camera

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import Finding
from visioncal.results import Calibration
from visioncal.results.arm import ArmErrorsResult
from visioncal.results.history import History
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.table import loads_of
from visioncal.simulation import (
    CellOptions,
    Second,
    cell_session,
    read_truth,
    simulate,
    write_session,
)
from visioncal.simulation.arms import Payload
from visioncal.simulation.instrument_session import InstrumentOptions, tracked
from visioncal.simulation.instrument_session import session_of as tracked_session
from visioncal.verification import to_document, triggers_of, verdict_of, verify
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.check import check
from visioncal.verification.messages import signed_axis
from visioncal.verification.prediction import predict_detected, predict_stops
from visioncal.verification.recovery import causes_found, changed, moved_along, parted, recover
from visioncal.vision.targets import corner_positions

BUMP = np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.0])
ANEW = np.array([0.0, 0.0, 0.3, 0.02, 0.01, 0.0])


def checked_of(known, calibration, **options):
    prior = CalibrationPrior.of(calibration)
    return check(predict_detected(known, prior), prior, **options)


def checked(place, rng, change=None, stops=5, **options):
    return checked_of(known_again(place.cell, rng, change, stops), place.calibration, **options)


def names(found):
    return [value.name for value in found.named]


def test_an_unchanged_cell_passes_as_often_as_it_should(place):
    rng = np.random.default_rng(0)
    found = [checked(place, rng) for _ in range(4)]
    assert all(value.passed and not value.named for value in found)
    # Chi-square of thirty directions; the mean of four is known to 3.9, and the noise's scale to
    # a tenth, which is three more.
    assert np.mean([value.unchanged.misfit for value in found]) == pytest.approx(30.0, abs=15.0)


@pytest.mark.parametrize(
    ("count", "kind", "raises"),
    [
        (4, "wrong_views", True),
        (4, "lost_views", True),
        (2, "wrong_views", False),
        (4, "something_moved", False),
    ],
)
def test_views_that_an_erring_arm_put_off_count_in_the_noise_of_a_check(place, count, kind, raises):
    size = ArmErrorsResult(sigma_mm=0.1, sigma_deg=0.01, likelihood_ratio=9.0, estimated=False)
    result = replace(place.calibration, arm_errors=size)
    strays = tuple(
        replace(view, used=False, reason="the arm errs so there", residual_mm=0.9, residual_deg=0.1)
        for view in result.views[:count]
    )
    found = Finding(kind, "They were left out.", views=tuple(view.view for view in strays))
    verdict = replace(result.verdict, findings=(found, *result.verdict.findings))
    odd = replace(result, views=(*strays, *result.views[count:]), verdict=verdict)
    # Pictures of a camera that shook say nothing of an arm without errors.
    sound = replace(odd, arm_errors=None)
    before, after, other = (
        CalibrationPrior.of(one).noise(from_corners=True).robots[0] for one in (result, odd, sound)
    )
    assert other == pytest.approx(before)
    share = count / sum(view.used for view in result.views)
    wanted = np.sqrt(
        (1.0 - share) * before**2 + share * np.array([np.deg2rad(0.1), 9e-4]) ** 2 / 3.0
    )
    assert after == pytest.approx(wanted if raises else before)


def test_a_lens_that_departs_from_its_model_is_seen_with_its_field(place):
    known = known_again(place.cell, np.random.default_rng(0))
    prior, result = CalibrationPrior.of(place.calibration), with_field(place.calibration)
    plain = predict_detected(known, prior)
    ((frame, look),) = known.cameras.items()
    points, lens, displaced = corner_positions(place.cell.options.target), result.camera, {}
    for view, seen in look.corners.items():
        pose = plain.observed.poses[view].cam_from_target[0]
        far_m = float(np.mean(points[seen.ids] @ pose[2, :3] + pose[2, 3]))
        away_px = lens.displacements(seen.px, far_m) @ lens.field.coefficients
        displaced[view] = replace(seen, px=seen.px + away_px)
    shown = known.with_camera(frame, replace(look, corners=displaced))
    for calibration, is_near in ((result, True), (place.calibration, False)):
        other = CalibrationPrior.of(calibration)
        off = predict_detected(shown, other).away(other) - plain.away(prior)
        # A field of 0.3 px changes by some thousandths of that over itself.
        assert (1e3 * np.abs(off[:, :3, 3]).max() < 0.02) == is_near


@pytest.mark.slow
def test_stops_that_repeat_calibrated_ones_show_what_the_arms_errors_hide():
    wrong = {"dh_sigma_m": 1e-4, "dh_sigma_rad": 1e-4, "branches": True, "roll_rad": np.pi}
    cell = simulate(CellOptions(views=25, seed=11, **wrong))
    calibration = result_of(calibrated(cell, joints=False))
    # The arm is off by its posture, and without joint angles that is noise.
    assert calibration.noise["robot_translation_mm"] > 0.1

    def seen(rng, change):
        return checked_of(
            known_of(again(cell, rng, change, repeated=25), joints=False), calibration
        )

    for seed in range(3):
        rng = np.random.default_rng(seed)
        same = seen(rng, None)
        assert same.passed
        assert same.repeated == 5
        assert "(5 of them where the calibration's stood)" in verdict_of(same).reasons[0]
        bumped = seen(rng, Change(camera=knock(rng, 0.4, 0.0)))
        assert names(bumped)[0] == "camera"


def test_triggers_fire_by_their_limits_and_say_what_is_not_known():
    place = usual("eye-in-hand")
    created = datetime(2026, 1, 1, tzinfo=UTC)
    calibration = replace(place.calibration, means={"ambient_c": 21.0}, created=created.isoformat())
    session = session_of(place.cell.only(range(5)))
    warm = tuple(replace(view, numbers={"ambient_c": 33.0}) for view in session.views)
    also = {"failed": False, "collision": True, "now": created + timedelta(days=200)}
    evaluated = triggers_of(replace(session, views=warm), calibration, **also)
    by_quantity = {trigger.quantity: trigger for trigger in evaluated}
    assert {name: trigger.state for name, trigger in by_quantity.items()} == {
        "failed_check": "quiet",
        "collision": "fired",
        "ambient_change_k": "fired",
        "payload_change_kg": "unknown",
        "age_days": "quiet",
    }
    assert "12 K (limit 10)" in by_quantity["ambient_change_k"].words
    assert by_quantity["age_days"].value == 200.0
    limits = {"ambient_change_k": 15.0, "age_days": 180.0, "payload_change_kg": None}
    other = triggers_of(replace(session, views=warm), calibration, limits=limits, **also)
    assert {trigger.quantity for trigger in other if trigger.state == "fired"} == {
        "collision",
        "age_days",
    }
    assert "200 days (limit 180)" in next(at.words for at in other if at.quantity == "age_days")


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
    done = visioncal("verify", pairs / "later", "--against", out, "-o", tmp_path / "check").good()
    assert done.out.startswith("pass")
    assert "the ambient temperature's change, 0 K (limit 10)" in done.out
    written = json.loads((tmp_path / "check/verify.json").read_text())
    assert written["passed"]
    assert not written["recalibrate"]
    page = Page((tmp_path / "check/report.html").read_text(encoding="utf-8"))
    assert "The calibration still holds" in page.words
    assert all(reference.startswith(("#", "data:")) for reference in page.references)
    # A check has no business with the files of a calibration.
    visioncal("verify", pairs / "later", "--against", out, "-o", out).refused("holds a calibration")
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


def test_poses_of_another_unit_and_a_bad_calibration_are_named(pairs, tmp_path):
    session, joints = Session.load(pairs / "later"), {f"q{at}_rad" for at in range(1, 7)}
    in_mm = tuple(
        replace(view, numbers={
            name: value * (1e3 if name in ("x_m", "y_m", "z_m") else 1.0)
            for name, value in view.numbers.items() if name not in joints
        })
        for view in session.views
    )  # fmt: skip
    columns = tuple(name for name in session.columns if name not in joints)
    replace(session, columns=columns, views=in_mm).save(tmp_path / "mm")
    done = visioncal("verify", tmp_path / "mm", "--against", pairs / "out")
    assert done.status == 3
    assert "With the robot's positions in mm" in done.out
    document = json.loads((pairs / "out/calibration.json").read_text("utf-8"))
    document["verdict"] |= {"status": "bad"}
    (tmp_path / "calibration.json").write_text(json.dumps(document), "utf-8")
    done = visioncal("verify", pairs / "later", "--against", tmp_path / "calibration.json")
    assert "The calibration itself is bad" in done.out


@pytest.fixture
def place():
    return usual("eye-in-hand")


def slip(joint, deg, **more):
    return Change(joints_rad=np.deg2rad(deg) * np.eye(6)[joint - 1], **more)


# The board's.
MIDDLE = compose(np.eye(3), np.array([0.135, 0.09, 0.0]))
TURNED = log(MIDDLE @ exp(np.array([0.02, -0.05, 2.5, 0.0, 0.02, 0.0])) @ invert(MIDDLE))


def knocked(seed, **sizes):
    """A change by knocks of some millimetres and degrees, beside others."""
    rng = np.random.default_rng(seed)
    knocks = {name: knock(rng, *size) for name, size in sizes.items() if isinstance(size, tuple)}
    return Change(**sizes | knocks)


# What changed, what is named for it, the values that are found, and what is said.
CHANGES = {
    "bumped camera": (Change(camera=BUMP), ["camera"], BUMP, "The camera moved by"),
    "turned camera": (knocked(2, camera=(0.0, 0.2)), ["camera"], None, "The camera turned by"),
    "moved board": (knocked(3, board=(1.0, 0.0)), ["board"], None, "board"),
    "turned board": (Change(board=TURNED), ["board"], TURNED, "board"),
    "slip": (slip(3, -0.05), ["joint 3"], [np.deg2rad(-0.05)], "Joint 3 (elbow_joint) off by -0.0"),
    # Five stops know it to some hundredths of a percent.
    "larger board": (Change(board_scale=1.005), ["board_size"], [0.005], "0.5 % larger"),
    "longer lens": (Change(lens_scale=1.01), ["lens"], [0.01], "The lens is 1 % longer"),
    "other board": (knocked(7, board=(5.0, 1.0), board_scale=0.99), ["board_replaced"], None, ""),
    "two": (knocked(6, camera=(2.0, 0.3), board=(2.0, 0.3)), ["camera_and_board"], None, ""),
    "noise": (Change(noise_factor=8.0), ["robot_noise"], None, ""),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_reported_with_its_size(place, name):
    change, expected, true, words = CHANGES[name]
    found = checked(place, np.random.default_rng(1), change)
    assert names(found) == expected
    assert not found.passed
    card = repr(found).splitlines()
    assert card[0].endswith(": does not hold")
    assert expected[0] in card[2]
    assert len(card) == 4
    said = verdict_of(found).reasons[0]
    assert words in said
    # Whatever stands still moves as much in a base that was pushed.
    assert ("or the robot's base was pushed" in said) == (expected == ["board"])
    document = to_document(found, ())["changes"][0]
    if name == "two":
        assert set(document) >= {"camera", "board"}
    if true is not None:
        explained = found.named[0].explained
        error = explained.values - true
        assert found.explained
        # Chi-square of six exceeds 22.5 in one case of a thousand, of one or two values 16.
        assert error @ np.linalg.solve(explained.covariance, error) < 22.5
    if name == "bumped camera":
        assert document["moved_mm"] == pytest.approx(1.0, abs=4 * document["sigma_mm"])
    if name == "slip":
        assert document["offset_deg"] == pytest.approx(-0.05, abs=4 * document["sigma_deg"])
    if name == "other board":
        assert found.named[0].explained.values[-1] == pytest.approx(-0.01, abs=5e-4)
        anew = checked(place, np.random.default_rng(1), change, board_placed_anew=True)
        assert names(anew) == ["board_size"]


def test_a_stated_load_that_the_calibration_has_not_seen_is_what_bends_the_arm(place):
    cell, robot = again(place.cell, np.random.default_rng(4)), load_robot("ur10e")
    q, load = cell.robot.joints, Payload(6.0, (0.0, 0.0, 0.1))
    moments = robot.load_torques(q, loads_of([load.row()] * len(q))) - robot.load_torques(q)
    carrying = reporting(cell, joints=q - moments / COBOT, loads=(load,) * len(q))
    found = checked_of(known_of(carrying), place.calibration)
    assert names(found) == ["load"]
    assert "payload_kg up to 6, and 0 kg when it was calibrated" in verdict_of(found).reasons[0]
    # One that bends nothing is no change.
    same = reporting(cell, loads=(load,) * len(q))
    assert checked_of(known_of(same), place.calibration).passed


def test_angles_in_degrees_are_no_scatter_of_the_robot(place):
    cell = again(place.cell, np.random.default_rng(4))
    known = known_of(reporting(cell, joints=np.rad2deg(cell.robot.joints)))
    raised(DataError, "With the angles in degrees", checked_of, known, place.calibration)


def test_readings_of_an_instrument_are_compared_by_calibrating_them():
    session = tracked_session(tracked(InstrumentOptions(stops=12)))
    raised(DataError, "visioncal diff", verify, session, calibrate(session))


def test_a_board_that_was_placed_anew_is_no_fault(place):
    rng = np.random.default_rng(5)
    assert checked(place, rng, Change(board=ANEW), board_placed_anew=True).passed
    slipped = checked(place, rng, slip(3, 0.1, board=ANEW), board_placed_anew=True)
    assert names(slipped) == ["joint 3"]


def test_a_small_shift_without_a_turn_is_the_cameras_and_no_growth_of_lens_or_arm(place):
    rng = np.random.default_rng(8)
    found = [checked(place, rng, Change(camera=knock(rng, 0.5, 0.0)), stops=6) for _ in range(4)]
    likeliest = [value.compared[0] for value in found]
    assert [change.name for change in likeliest] == 4 * ["camera"]
    # The verdict then says over 99 %.
    assert min(change.probability for change in likeliest) > 0.99


def test_changes_that_no_stop_separates_are_named_together(place):
    rng = np.random.default_rng(3)
    # A slip of the first joint turns all that stands in the base; of the last, what is carried.
    first = checked(place, rng, slip(1, 0.05))
    assert set(names(first)) == {"joint 1", "board"}
    assert "No stops separate that from" in verdict_of(first).reasons[1]
    # A probability of the first beside that would say that they are separated.
    assert "%" not in verdict_of(first).top[0]
    assert set(names(checked(place, rng, slip(6, 0.05)))) == {"joint 6", "camera"}
    # One stop is no robot that scatters.
    found = checked(place, rng, Change(board=knock(rng, 2.0, 0.0)), stops=1)
    assert not found.passed
    assert {"camera", "board"} <= set(names(found))
    assert "1 stop cannot separate that from" in verdict_of(found).reasons[1]


def test_a_view_at_another_pose_than_its_row_states_is_reported(place):
    cell = again(place.cell, np.random.default_rng(6))
    joints = cell.robot.joints.copy()
    joints[2] += 0.02
    found = checked_of(known_of(reporting(cell, joints=joints)), place.calibration)
    assert names(found) == ["view 2"]
    assert "View 2 alone contradicts" in verdict_of(found).reasons[0]


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ((0, 3, 2, 1, 4), "those of views 1 and 3 are exchanged"),
        ((0, 1, 3, 4, 2), "those of views 2, 3, 4 fit the poses of views 4, 2, 3"),
    ],
)
def test_images_in_other_rows_than_their_poses_are_named(place, order, words):
    cell = again(place.cell, np.random.default_rng(6))
    rows = list(order)
    poses = {
        "joints": cell.robot.joints[rows],
        "base_from_flange": cell.robot.base_from_flange[rows],
    }
    found = checked_of(known_of(reporting(cell, **poses)), place.calibration)
    assert names(found) == ["pairing"]
    assert found.explained
    finding = verdict_of(found).findings[0]
    assert words in finding.words
    assert ("--exchange 1,3 && visioncal verify" in finding.do.command) == ("exchanged" in words)


@pytest.mark.slow
def test_one_of_two_boards_that_moved_is_named():
    cell = simulate(replace(ANYHOW, second=Second(turn_rad=0.6, tilt_rad=0.2), views=24, seed=2))
    prior, shown = CalibrationPrior.of(result_of(calibrated(cell))), board_numbers(cell)
    assert len(prior.boards) == 2
    seen = predict_detected(known_of(cell), prior)
    assert check(seen, prior).passed
    # Some stops show both.
    assert len(seen.problem) > seen.stops == 24
    pushed = exp(np.array([0.0, 0.0, 0.0, 0.0, 3e-3, 0.0]))
    is_shelf = (shown[list(seen.views)] == 1)[:, None, None]
    observations = seen.problem.observations
    measured = np.where(is_shelf, observations.measured @ pushed, observations.measured)
    moved = replace(observations, measured=measured)
    found = check(replace(seen, problem=replace(seen.problem, observations=moved)), prior)
    assert names(found) == [f"board {tuple(prior.targets)[1]}"]
    axis = prior.state.edges[1 + prior.boards.index(1), :3, 1]
    words = f"along the base's {signed_axis(axis)}."
    assert verdict_of(found).findings[0].words.endswith(words)
    refused = raised(DataError, "several boards", check, seen, prior, board_placed_anew=True)
    assert "the one that moved is named" in refused.next_step
    # A session's only board needs no name: it is that with an equal print.
    session = cell_session(cell, "both", seen="poses")
    document = {key: value for key, value in session.document.items() if key != "targets"}
    for name, board in session.targets.items():
        views = [replace(view, text={}) for view in session.views if view.text["target"] == name]
        of_board = replace(session, document=document, target=board, targets={}, views=tuple(views))
        later = predict_stops(of_board, prior)
        assert {view.text["target"] for view in later.observed.session.views} == {name}


def test_other_cells_are_refused_by_what_differs(place):
    prior, session = CalibrationPrior.of(place.calibration), session_of(place.cell)
    for wrong, words in (
        (replace(session, document={**session.document, "mount": "eye-to-hand"}), "eye-to-hand"),
        (replace(session, target=replace(session.target, columns=11)), "columns = 11"),
        (replace(session, robot_document=load_robot("ur10e").document), "another robot"),
    ):
        raised(DataError, words, predict_stops, wrong, prior)
    board, wider = session.target, replace(session.target, columns=11)
    several = replace(prior, targets={"floor": board, "wall": replace(board, rows=8)})
    for target, words in ((None, "which of the targets"), (wider, "must be one of those")):
        raised(DataError, words, predict_stops, replace(session, target=target), several)
    known = known_again(place.cell, np.random.default_rng(9))
    small = replace(known.cameras["cam"], resolution=(640, 480))
    for wrong, words in (
        (replace(known, robots={"": replace(known.reported, matched=None)}), "no joint angles"),
        (known.with_camera("cam", small), "640 x 480"),
    ):
        raised(DataError, words, predict_detected, wrong, prior)
    spoilt = replace(place.calibration.joint_fit, covariance=np.eye(1))
    for fit, words in ((None, "holds no fit"), (spoilt, "joint_fit cannot be read")):
        raised(DataError, words, CalibrationPrior.of, replace(place.calibration, joint_fit=fit))


STOPS = 10


@pytest.fixture(scope="module", params=["eye-in-hand", "eye-to-hand"])
def either(request):
    return usual(request.param)


def recovered(either, change, rng, causes=None):
    known = known_again(either.cell, rng, change, STOPS)
    prior = CalibrationPrior.of(either.calibration)
    found = check(predict_detected(known, prior), prior)
    causes = causes or causes_found(found)
    return causes, changed(found, causes, either.calibration.rms)[0]


@pytest.mark.parametrize(
    ("kind", "either"),
    [("camera and board", MOUNTS[0]), slow("camera and board", MOUNTS[1])]
    + [slow(kind, mount) for kind in ("camera", "board", "joint 3") for mount in MOUNTS],
    indirect=["either"],
)
@pytest.mark.parametrize("knocks", seeds(1, 3))
def test_a_change_is_estimated_with_its_covariance_and_the_rest_is_kept(either, kind, knocks):
    rng, old, squares = np.random.default_rng(7), either.calibration, []
    (x, z), q = either.cell.transforms.values(), either.cell.robot.joints
    for _ in knocks:
        change = Change(
            camera=knock(rng, 30.0, 10.0) * ("camera" in kind),
            board=knock(rng, 10.0, 3.0) * ("board" in kind),
            joints_rad=np.deg2rad(0.5) * np.eye(6)[2] * (kind == "joint 3"),
        )
        causes, found = recovered(either, change, rng)
        assert causes == tuple(kind.split(" and "))
        new = Calibration.from_json(found.text, "recovered")
        truth = (x @ exp(change.camera), z @ exp(change.board))
        # Errors of what changed, beyond those that the old calibration had and keeps.
        for name, moved, before, after in zip(
            ("camera", "board"), truth, old.edges.values(), new.edges.values(), strict=True
        ):
            if name not in causes:
                assert np.array_equal(before.matrix, after.matrix)
                continue
            squares.append(misfit(after, moved) / 6)
        if kind == "joint 3":
            errors = [
                log(invert(either.cell.robot.flange_at(q + offset)) @ arm.standing(q))[:, 3:]
                for arm, offset in ((old, 0.0), (new, change.joints_rad))
            ]
            before_m, after_m = (np.sqrt(np.mean(error**2)) for error in errors)
            # One angle from ten stops adds little to the errors of an arm of 36 parameters.
            squares.append(after_m / before_m)
            assert after_m < 1.1 * before_m
    # Errors of three knocks are correlated by those of the old calibration, which is one draw: a
    # chi-square of 6 over its freedom is below 3.7 in 999 of 1000.
    assert np.mean(squares) < 3.7
    # Another look at the recovered cell passes, and is predicted about as surely as before: the
    # errors of what is new compensate those of what was kept, and would else add to them.
    sigmas = []
    for calibration, later in ((old, None), (new, change)):
        prior = CalibrationPrior.of(calibration)
        seen = predict_detected(known_again(either.cell, np.random.default_rng(9), later), prior)
        assert check(seen, prior).passed
        linear = seen.problem.linear(prior.state)
        sigmas.append(np.sqrt(np.trace(linear.covariance(prior.covariance).sum(axis=0)[3:, 3:])))
    # Ten stops to forty: 1.03 to 1.3, and of two changes to 1.62; added up 1.5 to 2.6, and 2.9.
    assert sigmas[1] < (1.8 if " and " in kind else 1.45) * sigmas[0]


@pytest.mark.parametrize("either", [MOUNTS[0], slow(MOUNTS[1])], indirect=True)
def test_targets_follow_a_base_or_a_mount_that_moved_with_all_on_its_side(either):
    rng, old = np.random.default_rng(1), either.calibration
    in_hand = old.mount == "eye-in-hand"
    change = Change(camera=knock(rng, 20.0, 5.0), board=knock(rng, 15.0, 2.0))
    causes, found = recovered(either, change, rng, ("base", "mount"))
    base_moved, flange_moved = moved_along(old, found, causes)
    on_flange, in_base = [*old.edges.values()][:: 1 if in_hand else -1]
    now = [*found.edges.values()][:: 1 if in_hand else -1]
    # A tool that stood at a fixed part stands there again.
    part, tool = exp(np.array([0.1, 0.2, 0.3, 0.0, 0.1, 0.1])), exp(np.full(6, 0.05))
    target = in_base.matrix @ part @ invert(on_flange.matrix @ tool)
    stands = base_moved @ target @ flange_moved @ now[0].matrix @ tool
    assert np.allclose(stands, now[1].matrix @ part, atol=1e-12)
    with pytest.raises(DataError, match="each motion once"):
        recovered(either, change, rng, ("base", "board" if in_hand else "camera"))
    with pytest.raises(DataError, match="what can be recovered here is camera"):
        recovered(either, change, rng, ("gripper",))


def test_stops_recorded_by_a_plan_of_the_calibrated_arm_are_verified_and_recovered_from():
    place, slip = usual("eye-in-hand"), Change(joints_rad=np.deg2rad(0.5) * np.eye(6)[2])
    stops, old = again(place.cell, np.random.default_rng(3), slip, 9), place.calibration
    session = cell_session(stops, "stops", seen="corners")
    planned = replace(session, robot_document=old.arm.robot.document)
    found = [verify(parted(each)[0], old) for each in (session, planned)]
    assert found[0].unchanged.misfit == pytest.approx(found[1].unchanged.misfit, rel=1e-6)
    new = recover(planned, old, ("joint 3",), found[1])
    assert "3 stops held back from a first estimate agree" in new.verdict.findings[0].words


def test_a_joint_is_to_be_mastered_where_its_angle_is_proven_and_nothing_else_changed(tmp_path):
    place, slip = usual("eye-in-hand"), Change(joints_rad=np.deg2rad(0.5) * np.eye(6)[2])
    stops, out = tmp_path / "my stops", tmp_path / "my out"
    fresh = again(place.cell, np.random.default_rng(3), slip, 9)
    cell_session(fresh, "stops", seen="corners").save(stops)
    out.mkdir()
    place.calibration.save(out / "calibration.json")
    act = ("recover", tmp_path / "act", "--against", out, "--stops", stops, "--count", 9)
    mastered = visioncal(*act).good().out
    assert f"Or master joint 3 on the controller, by the angle above: then {out} holds" in mastered
    assert "only where: The transforms belong to the calibrated arm" in mastered
    printed = visioncal(*act, "--cause", "joint 3", "--cause", "camera").good().out
    assert "Or master" not in printed
    unproven = visioncal(*act, "--cause", "joint 2")
    assert unproven.status == 3
    assert "disagree" in unproven.out
    assert "Or master" not in unproven.out


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A calibrated cell, and later stops of it: as it was, and with the camera moved."""
    folder = tmp_path_factory.mktemp("knocked")
    of_cell = ("--robot", "ur5e", "--seed", 8, "--no-images")
    visioncal("simulate", folder / "cell", *of_cell, "--views", 20).good()
    visioncal("calibrate", folder / "cell", "-o", folder / "out", "--no-report").good()
    for number, (name, mm) in enumerate({"same": 0, "moved": 3, "more": 6}.items(), start=1):
        recording = ("--views", 15, "--recording", number, "--camera-moved-mm", mm)
        visioncal("simulate", folder / name, *of_cell, *recording).good()
    return folder


# Of what recover.json holds, and what is said of it; a text that is no act at all.
EDITED_ACTS = (
    ({"minutes": "x"}, "but must be a table"), ({"minutes": {"plan": np.nan}}, "minutes.plan"),
    ({"minutes": {"plan": "1"}}, "must be a number"), ({"stated": None}, "stated is null"),
    ({"stated": "camera"}, "must be a list"), ({"against": 3}, "against is 3"),
    ({"record": "visioncal record; rm -rf x"}, "must be a visioncal record"),
    ({"record": "rm -rf x"}, "must be a visioncal record"), ({"schema": 9}, "schema is 9"),
    ({}, "{"), ({}, "null"), ({}, "{}"), ({}, ""),
)  # fmt: skip


@pytest.mark.slow
def test_an_act_is_ended_and_gone_on_with_at_each_step(cell, tmp_path):
    act, out, stops = tmp_path / "act", cell / "out", tmp_path / "act/stops"
    command = ("recover", act, "--against", out)
    unknown = visioncal(*command, "--cause", "joint 9")
    unknown.refused("here is camera, board, joint 1, joint 2,", "joint 6, base and mount")
    assert not act.exists()
    begun = visioncal(*command)
    assert begun.status == 2
    assert f"visioncal record --arm manual --target BOARD --camera uvc:0 -o {stops}" in begun.err
    assert f"Drive to those of {act / 'plan/stops.csv'} that are missing, record them" in begun.err
    # A step of the act is no error.
    assert "error" not in begun.err
    assert "BOARD stands for the target's name" in begun.err
    begun_act = json.loads((act / "recover.json").read_text())
    for edited, words in EDITED_ACTS:
        (act / "recover.json").write_text(json.dumps(begun_act | edited) if edited else words)
        refused = visioncal(*command).refused("recover.json" if not edited else words)
        assert "rm -rf" not in refused.err.partition("needed.")[2]
    (act / "recover.json").write_text(json.dumps(begun_act))
    # The recording was cut off after nine stops, and is whole later.
    stops.mkdir()
    (stops / "session.toml").write_text((cell / "moved/session.toml").read_text())
    rows = (cell / "moved/views.csv").read_text().splitlines(keepends=True)
    (stops / "views.csv").write_text("".join(rows[:10]))
    visioncal(*command).refused("9 of 15 stops")
    elsewhere = visioncal(*command, "--stops", stops).refused("9 of 15 stops")
    assert f"visioncal record --page -o {stops} --resume" in elsewhere.err
    (stops / "views.csv").write_text("".join(rows))
    options = ("--targets", stops / "views.csv", "--to", "ur")
    visioncal(*command, *options).refused("--cause camera\n", "--cause mount\n")
    assert not (act / "result").exists()
    history = ("--history", tmp_path / "history.db")
    done = visioncal(*command, *options, "--cause", "camera", "--payload-kg", 3, *history).good()
    # It is of the cell of the calibration from before, not one of its own.
    (entry,) = History(history[1]).entries()
    assert (entry.session, entry.cell) == ("moved", Calibration.load(out).session_name)
    assert "--payload-kg 3 changes nothing" in " ".join(done.err.split())
    assert "the camera moved by 3 mm" in done.out
    assert "whether the mount moved instead" in done.out
    assert "say --cause mount." in done.out
    assert "minutes: plan" in done.out
    assert "5 stops held back from a first estimate agree" in done.out
    result = Calibration.load(act / "result")
    truth = read_truth(cell / "moved").transforms["flange_from_cam"]
    away = log(invert(truth) @ result.edges["flange_from_cam"].matrix)
    assert 1e3 * np.linalg.norm(away[3:]) < 3 * result.edges["flange_from_cam"].sigma_mm
    assert "p[" in (act / "exports/ur").read_text()
    assert len((act / "targets.csv").read_text().splitlines()) == len(rows)
    assert visioncal("verify", cell / "moved", "--against", act / "result").status == 0
    visioncal("recover", act, "--against", act / "result").refused("of another calibration")
    # The mount is said to have moved: as far as the camera, which did not turn.
    along = visioncal(*command, "--cause", "mount").good()
    assert re.search(r"the mount moved by (2\.9|3(\.[01])?)\d* mm", along.out)
    assert "the camera moved" not in along.out
    assert "moved instead" not in along.out
    # Taught targets are not overwritten by what becomes of them.
    taught = (act / "targets.csv").read_text()
    over = visioncal(*command, "--targets", act / "targets.csv", "--cause", "camera")
    over.refused("where the converted targets are written")
    assert (act / "targets.csv").read_text() == taught


def test_an_act_ends_where_nothing_changed_and_where_the_proof_fails(cell, tmp_path):
    out = ("--against", cell / "out")
    same = visioncal("recover", tmp_path / "same", *out, "--stops", cell / "same").good()
    assert re.match(r"nothing has changed: \S+ holds\. 10 stops agree with", same.out)
    assert not (tmp_path / "same/result").exists()
    # The stops that are held back come from after another knock.
    stops = tmp_path / "stops"
    stops.mkdir()
    (stops / "session.toml").write_text((cell / "moved/session.toml").read_text())
    rows = (cell / "moved/views.csv").read_text().splitlines(keepends=True)
    rows[3::3] = (cell / "more/views.csv").read_text().splitlines(keepends=True)[3::3]
    (stops / "views.csv").write_text("".join(rows))
    act = ("recover", tmp_path / "act", *out, "--stops", stops)
    failed = visioncal(*act, "--to", "ur")
    assert failed.status == 3
    assert "disagree" in failed.out
    assert not (tmp_path / "act/exports/ur").exists()
    visioncal(*act, "--to", "ur", "--force")
    assert (tmp_path / "act/exports/ur").exists()


@pytest.mark.parametrize(
    ("what", "mount"),
    [("board", MOUNTS[1]), *(slow("camera", mount) for mount in MOUNTS), slow("board", MOUNTS[0])],
)
def test_a_change_by_half_a_turn_is_found_without_a_shift_of_metres(what, mount):
    """By poses of the target, as a camera that is turned so far sees none in its image."""
    cell, rng = simulate(CellOptions(views=20, mount=mount)), np.random.default_rng(2)
    calibration = calibrate(pairs_session(mount, cell.robot.base_from_flange, cell.cam_from_target))
    x, z = cell.transforms.values()
    turn = exp(knock(rng, 0.0, 180.0))
    moved = (x @ turn, z) if what == "camera" else (x, z @ turn)
    flange = cell.robot.true_base_from_flange[:8]
    seen = target_in_camera(mount, *moved, flange) @ exp(2e-5 * rng.standard_normal((8, 6)))
    found = verify(pairs_session(mount, cell.robot.base_from_flange[:8], seen), calibration).named[
        0
    ]
    assert found.cause.kind == what
    values = found.explained.values
    assert abs(np.rad2deg(np.linalg.norm(values[:3])) - 180.0) < 0.1
    # The robot's noise of these stops, and no metre.
    assert np.linalg.norm(exp(values)[:3, 3]) < 5e-3
