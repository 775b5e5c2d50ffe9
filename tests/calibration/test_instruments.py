"""Calibration by a measuring instrument: recovery, sigmas, rank, wrong rows and refusals."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found
from support.commands import visioncal as command
from support.marks import slow
from support.tracked import errors_of, known_of

import visioncal
from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import exp, invert
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.estimation.workspace import postures
from visioncal.robot import Robot
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.session.kinds import instrument_names, known_instrument, stated_instrument
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, session_of, tracked

PROBE, POINT, POINTS = (
    InstrumentOptions(poses=True),
    InstrumentOptions(),
    InstrumentOptions(points=THREE),
)
PROBE_FIRST = pytest.mark.parametrize(
    "options",
    [PROBE, *(slow(item) for item in (POINT, POINTS))],
    ids=["probe", "point", "three"],
)
WRONG = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3, "offset_sigma_rad": 1e-3}


def test_known_instruments_grow_noisy_with_distance():
    assert len(instrument_names()) == 15
    tracker = known_instrument("leica-at960")
    places = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])
    # 20 um at 5 m is what is commonly said of it.
    assert tracker.sigmas_m(places) == pytest.approx([17.5e-6, 20e-6])
    assert tracker.sigma_rad == pytest.approx(9e-5)
    assert known_instrument("zeiss-contura").sigma_per_m == 0.0


def test_what_is_stated_comes_before_the_table():
    stated = stated_instrument("leica-at960", 5e-5, None, None)
    assert (stated.sigma_m, stated.sigma_per_m, stated.sigma_rad) == (5e-5, 0.5e-6, 9e-5)
    assert stated_instrument("ours", 1e-4, 1e-6, None).sigma_per_m == 1e-6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("leica-at96", None, None, None), "not in the table .* Did you mean leica-at960"),
        (("ours", None, 1e-6, None), "noise is not stated. State sigma_m .*zeiss-contura"),
        (("renishaw-xl80", 1e-6, None, None), "measures lengths along its beam; readings of pl"),
    ],
)
def test_an_unknown_instrument_is_refused(arguments, words):
    with pytest.raises(DataError, match=words):
        stated_instrument(*arguments)


@PROBE_FIRST
def test_errors_follow_their_covariance(options):
    kept = np.arange(12) if options.poses else np.r_[:6, 9:12]
    by_sigma = []
    for seed in range(5):
        shop = tracked(replace(options, seed=seed))
        known = known_of(session_of(shop), level="hand-eye")
        error, covariance = (
            errors_of(shop, known)[kept],
            known.assessment.covariance[np.ix_(kept, kept)],
        )
        by_sigma.append(error @ np.linalg.solve(covariance, error) / len(kept))
    # Chi-square of 45 or 60 degrees of freedom over these: beyond is one in a thousand.
    assert np.mean(by_sigma) == pytest.approx(1.0, abs=0.78)


@pytest.mark.parametrize("options", [PROBE, slow(POINTS)], ids=["probe", "three"])
def test_an_arm_off_by_millimetres_is_calibrated_all_over_its_workspace(options):
    shop = tracked(replace(options, **WRONG, stops=40))
    known = known_of(session_of(shop))
    assert known.robot_arm.kinematics.level == "geometry"
    assert known.verdict.status == "good"
    q = postures(known.robot)
    (x, z), size = known.assessment.state.edges[:2], len(known.robot_arm.model.values)

    def place(robot):
        return (invert(x) @ robot.base_from_flange(q) @ z)[:, :3, 3]

    true = invert(shop.base_from_instrument) @ forward(shop.true_arm, q) @ shop.flange_from_probe
    away = 1e3 * np.linalg.norm(place(known.robot_arm.model.robot) - true[:, :3, 3], axis=1)
    nominal = known.robot_arm.kinematics.result.nominal.rms_mm
    assert nominal > 1.0
    # 40 readings of 20 um by an arm that repeats to 30 um; seen 0.03 mm.
    assert np.median(away) < 0.06
    # What the fit says of its own worth holds.
    assert 0.3 < np.median(away) / known.findings.arms[0].workspace_mm < 1.5
    assert size == 36


@pytest.mark.parametrize(
    ("options", "rank"),
    [slow(PROBE, 30), (POINT, 27)],
    ids=["probe", "point"],
)
def test_so_many_values_are_told_of_a_six_axis_arm(options, rank):
    """Everett and Hsu (1988): 4 for each axis and 6 for the tool; 3 where it is a point.

    Three points have six values more than one, of their places.
    """
    shop = tracked(replace(options, **WRONG))
    seen = arm_found(known_of(session_of(shop))).sections.arm.observability
    assert (seen.identifiable, seen.determined) == (rank, rank)


def test_without_a_model_poses_give_the_frames_alone(tmp_path):
    shop = tracked(POINTS)
    session_of(shop, joints=False, poses=True).save(tmp_path / "shop")
    result = visioncal.calibrate(tmp_path / "shop")
    assert list(result.transforms) == ["base_from_instrument", "flange_from_probe"]
    assert result.arm is None
    places = np.array([[point.x_m, point.y_m, point.z_m] for point in result.points])
    # Readings know them to 0.012 mm each; what an arm may do wrong from stop to stop adds as much.
    assert places == pytest.approx(np.array(THREE), abs=5e-5)
    assert [point.point for point in result.points] == ["a", "b", "c"]
    assert all(point.sigma_mm < 0.024 for point in result.points)


@PROBE_FIRST
def test_outputs_are_whole_and_the_recording_gives_them_again(options, tmp_path):
    session_of(tracked(replace(options, **WRONG))).save(tmp_path / "shop")
    out = tmp_path / "out"
    done = command("calibrate", tmp_path / "shop", "-o", out)
    assert done.status == 0, done.err
    document = json.loads((out / "calibration.json").read_text())
    assert "null" not in (out / "calibration.json").read_text()
    assert document["mount"] == "instrument"
    assert document["noise"]["instrument_mm"] == pytest.approx(0.02)
    # The arm's 0.03 mm is told from the instrument's 0.02 mm, to some 15 %.
    assert document["noise"]["robot_translation_mm"] == pytest.approx(0.03, rel=0.5)
    assert ("deg" in document["rms"]) == options.poses
    found = document["kinematics"]
    assert ("held_out_deg" in found["levels"][0]) == options.poses
    assert ("deg" in found["left_out"][0]) == options.poses
    rotation = np.array(document["transforms"]["flange_from_probe"]["covariance"])[:3, :3]
    assert rotation.any() == options.poses
    again = visioncal.calibrate(visioncal.Session.load(out / "recording.rrd"))
    again.save(tmp_path / "again.json")
    # What is calibrated by a call has no folder for its commands.
    repeated = (tmp_path / "again.json").read_text().replace("OUT", str(out))
    assert json.loads(repeated) | {"created": ""} == document | {"created": ""}
    assert "child_frame_id: instrument" in command("export", out, "--to", "ros").out
    assert "holds the camera, and" in command("export", out, "--to", "easy-handeye2").err
    report = (out / "report.html").read_text()
    assert "the instrument" in report
    assert "optical axis" not in report
    assert "Where the camera looked" not in report


def test_wrong_rows_are_named_and_left_out():
    shop = tracked(replace(POINT, **WRONG))
    rows = list(shop.rows)
    rows[4], rows[9] = (rows[4][0], 0, rows[9][2]), (rows[9][0], 0, rows[4][2])
    moved = rows[20][2].copy()
    # Ten times the noise, and a third of what the nominal arm is off by.
    moved[:3, 3] += [0.0, 1e-3, 0.0]
    rows[20] = (20, 0, moved)
    known = known_of(session_of(replace(shop, rows=tuple(rows))))
    assert set(known.reasons) >= {4, 9}
    assert "places the point" in known.reasons[4]
    assert (
        "it fits stop 9, and view 9 fits stop 4: these two rows are exchanged" in known.reasons[4]
    )
    assert known.robot_arm.kinematics.level == "geometry"


def test_measured_poses_of_a_target_come_before_readings():
    session = session_of(tracked(PROBE))
    views = tuple(
        replace(
            view,
            numbers=view.numbers
            | {f"cft_{name[5:]}": view.numbers[name] for name in view.numbers if "meas_" in name},
        )
        for view in session.views
    )
    document = {**session.document, "mount": "eye-to-hand"}
    columns = (*session.columns, *(f"cft_{name}" for name in POSE))
    both = replace(session, columns=columns, views=views, document=document)
    known = known_of(both)
    assert both.mount == "eye-to-hand"
    assert known.readings is None
    assert any(
        "30 rows have an instrument's readings" in warning.reason for warning in known.warnings
    )


def edited(session: Session, column: str, change) -> Session:
    """The session with a column's cells changed, by row."""
    place = session.columns.index(column)
    rows = [[view.cell(name) for name in session.columns] for view in session.views]
    for at, row in enumerate(rows):
        row[place] = change(at, row[place])
    return Session.assemble(session.document, session.columns, rows, MemoryImages({}))


def test_what_cannot_be_calibrated_is_refused_by_name():
    point, probe = (session_of(tracked(item)) for item in (POINT, PROBE))
    for session, words in (
        (edited(point, "meas_x_m", lambda _, cell: str(1e3 * float(cell))), "millimetres"),
        (edited(probe, "point", lambda at, _: "ab"[at % 2]), "poses of 2 probes"),
    ):
        with pytest.raises(DataError, match=words):
            known_of(session)


def test_misread_joints_are_named():
    sound = session_of(tracked(POINTS))
    wrong_sign = edited(sound, "q5_rad", lambda _, cell: repr(-float(cell)))
    in_degrees = sound
    for joint in range(1, 7):
        in_degrees = edited(
            in_degrees, f"q{joint}_rad", lambda _, cell: repr(float(np.rad2deg(float(cell))))
        )
    for session, words in (
        (wrong_sign, "With q5_rad of the opposite sign, they fit what the instrument reads"),
        (in_degrees, "With the angles in degrees, they fit what the instrument reads"),
    ):
        with pytest.raises(DataError, match=words):
            known_of(session)


def test_a_misspelt_point_is_named():
    named = edited(session_of(tracked(POINTS)), "point", lambda _, cell: f"nest_{cell}")
    wrong = edited(named, "point", lambda at, cell: "nset_a" if at == 6 else cell)
    assert "'nset_a' was read once" in (reason := known_of(wrong).reasons[6])
    assert "Did you mean nest_a" in reason
    unnamed = edited(named, "point", lambda at, cell: "" if at == 6 else cell)
    assert "no name in column point" in known_of(unnamed).reasons[6]
    odd = edited(named, "point", lambda at, cell: "tooling ball" if at == 6 else cell)
    assert "was read once" in known_of(odd).reasons[6]


def test_a_session_that_does_not_say_how_good_its_readings_are_is_refused():
    session = session_of(tracked(POINT))
    document = {name: value for name, value in session.document.items() if name != "instrument"}
    rows = [[view.cell(column) for column in session.columns] for view in session.views]
    silent = Session.assemble(
        document | {"mount": "eye-to-hand"}, session.columns, rows, MemoryImages({})
    )
    with pytest.raises(DataError, match=r"nothing says how good they are.*leica-at960"):
        known_of(silent)
    probe = session_of(tracked(PROBE))
    named = replace(probe, document={**probe.document, "instrument": {"name": "v-stars"}})
    with pytest.raises(DataError, match=r"State sigma_rad in .instrument., or leave the columns"):
        known_of(replace(named))


def test_motion_that_tells_too_little_is_refused():
    shop = tracked(POINT)
    with pytest.raises(DegenerateError, match="3 usable stops of the robot; at least 4"):
        known_of(session_of(tracked(replace(POINT, stops=3))))
    still = tracked(POINT, joints=np.repeat(shop.joints[:1], 12, axis=0))
    with pytest.raises(DegenerateError, match="12 used views are all from one pose of the robot"):
        known_of(session_of(still, joints=False, poses=True))
    # Joint 1 alone: the point goes round in a circle. Where a search without an answer ends is up
    # to rounding, and with it which of the directions is named.
    turning = np.repeat(shop.joints[:1], 12, axis=0)
    turning[:, 0] = np.linspace(-1.5, 1.5, 12)
    with pytest.raises(DegenerateError, match=r"all 12 used views turn about the base's z"):
        known_of(session_of(tracked(POINT, joints=turning)))
    with pytest.raises(DataError, match="needs poses, and the instrument reads places alone"):
        known_of(session_of(shop), solver="tsai")


def test_a_mounting_is_found():
    rng = np.random.default_rng(0)
    flange, (frame,) = exp(rng.normal(size=(8, 6))), exp(rng.normal(size=(1, 6)))
    on_flange, points = 0.1 * rng.normal(size=(2, 3)), np.arange(8) % 2
    in_base = (flange[:, :3, :3] @ on_flange[points][:, :, None])[:, :, 0] + flange[:, :3, 3]
    read = (in_base - frame[:3, 3]) @ frame[:3, :3]
    found, errors = find_mounting(mounting_problem(flange, read, points), np.arange(8) // 2)
    assert found.points == pytest.approx(on_flange, abs=1e-7)
    assert found.frame == pytest.approx(frame, abs=1e-7)
    assert np.abs(errors).max() < 1e-7


@pytest.mark.parametrize(
    ("options", "joint", "slip_deg"),
    [(POINT, 3, 0.15), slow(PROBE, 1, -0.1)],
)
def test_a_joint_that_slips_between_readings_is_named(options, joint, slip_deg):
    """Functions of the joints would explain much of it, and leave the result good."""
    shop = tracked(replace(options, **WRONG, stops=40))
    slipped = shop.joints.copy()
    slipped[20:, joint - 1] += np.deg2rad(slip_deg)
    known = known_of(session_of(replace(shop, joints=slipped)))
    assert known.verdict.status != "good"
    (found,) = (finding for finding in known.verdict.findings if finding.kind == "joint_slipped")
    assert found == known.verdict.causes[0]
    assert f"joint {joint} (" in found.words
    assert "from stop 20 on" in found.words
    ((slip, sigma_deg),) = _steps_deg(found.words)
    # Known to its sigma; the noise beside an unmodelled step is that of a fit without it.
    assert slip == pytest.approx(slip_deg, abs=4.0 * sigma_deg)
    assert sigma_deg < 0.03


def _steps_deg(words):
    found = re.findall(r"it reads ([+-][0-9.]+) deg \(sigma ([0-9.]+)\)", words)
    return [tuple(map(float, value)) for value in found]


def test_an_arm_that_cannot_tilt_is_asked_for_a_measured_height():
    joint = {"a_m": 0.4, "d_m": 0.1, "alpha_rad": 0.0}
    model = {"schema": 1, "name": "scara", "convention": "standard", "joint": [joint] * 3}
    rng, place = np.random.default_rng(1), np.array([0.06, 0.02, 0.05, 1.0])
    q = rng.uniform(-1.5, 1.5, (20, 3))
    instrument_from_base = invert(exp(np.array([0.1, -0.2, 2.5, 2.5, -1.0, 0.4])))
    read = instrument_from_base @ Robot.from_document(model).base_from_flange(q) @ place
    read[:, :3] += 2e-5 * rng.normal(size=(20, 3))
    columns = ["view", "q1_rad", "q2_rad", "q3_rad", "meas_x_m", "meas_y_m", "meas_z_m"]
    rows = [
        [str(at), *map(repr, (*angles.tolist(), *xyz[:3].tolist()))]
        for at, (angles, xyz) in enumerate(zip(q, read, strict=True))
    ]
    document = {"schema": 1, "name": "scara", "robot": {"model": "arm.toml"}}
    document["instrument"] = {"sigma_m": 2e-5}
    images = MemoryImages({})
    with pytest.raises(DegenerateError) as refused:
        calibrate(Session.assemble(document, columns, rows, images, robot_document=model))
    measure = "Where the arm cannot tilt, measure that offset for [prior.flange_from_probe]."
    assert refused.value.next_step.startswith(measure)
    document["prior"] = {"flange_from_probe": {"z_m": 0.05, "sigma_m": 5e-4}}
    found = calibrate(Session.assemble(document, columns, rows, images, robot_document=model))
    assert not [
        finding for finding in found.verdict.findings if finding.do and "tilt" in finding.do.words
    ]
    height = found.edges["flange_from_probe"].matrix[2, 3]
    # Readings alone leave it open: it is where it was measured.
    assert height == pytest.approx(0.05, abs=1e-5)
