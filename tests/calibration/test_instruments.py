"""Calibration by a measuring instrument: recovery, sigmas, rank, wrong rows and refusals."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal as command
from support.marks import slow
from support.refusals import raised
from support.tracked import errors_of, known_of
from support.wrong_arms import CARRIED, COBOT

import visioncal
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES, calibrate, run_stages
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import exp, invert
from visioncal.robot import load_robot
from visioncal.robot.workspace import postures
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.session.document import InstrumentTable
from visioncal.session.kinds import known_instruments, stated_instrument
from visioncal.simulation import arms
from visioncal.simulation.arms import Payload, arm_named, forward
from visioncal.simulation.instrument_session import (
    THREE,
    InstrumentOptions,
    random_postures,
    session_of,
    tracked,
)

PROBE, POINT, POINTS = (
    InstrumentOptions(poses=True),
    InstrumentOptions(),
    InstrumentOptions(points=THREE),
)
WRONG = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3, "offset_sigma_rad": 1e-3}


@pytest.mark.slow
@pytest.mark.parametrize("options", [PROBE, POINT], ids=["probe", "point"])
def test_errors_follow_their_covariance(options):
    kept = np.arange(12) if options.poses else np.r_[:6, 9:12]
    squares = 0.0
    for seed in range(3):
        shop = tracked(replace(options, seed=seed))
        known = known_of(session_of(shop), level="hand-eye")
        error = errors_of(shop, known)[kept]
        covariance = known.assessment.fit.whole[np.ix_(kept, kept)]
        squares += float(error @ np.linalg.solve(covariance, error))
    # In one case of a thousand chi-square is beyond either.
    low, high = chi2_limit(np.array([0.9995, 0.0005]), 3 * len(kept))
    assert low < squares < high


@pytest.fixture(scope="module")
def bending():
    """Readings of a standing arm that bends, and what is known where its gravity is stated so."""
    bends = {"payloads": CARRIED, "compliance_rad_per_nm": tuple(1.0 / np.array(COBOT))}
    shop = tracked(replace(POINT, stops=40, **bends))
    return shop, known_of(stating_gravity(shop, [0, 0, -9.81]))


def stating_gravity(shop, stated):
    """The session of readings with gravity as it is stated."""
    return session_of(shop, robot={"model": "ur10e", "gravity_m_s2": stated})


@pytest.mark.parametrize("stated", [[-9.81, 0, 0], slow([0, 0, 9.81])])
def test_an_arm_whose_mounting_is_not_as_stated_is_named_with_its_gravity(bending, stated):
    shop, right = bending
    known = known_of(stating_gravity(shop, stated))
    first = known.verdict.causes[0]
    assert first.kind == "mounting"
    assert first.probability > 0.99
    assert "Write gravity_m_s2 = [0, 0, -9.81] under [robot]" in first.do.words
    assert not any("run out" in finding.words for finding in known.verdict.findings)
    assert right.verdict.status == "good"


@pytest.mark.slow
def test_an_arm_off_by_millimetres_is_calibrated_all_over_its_workspace():
    shop = tracked(replace(PROBE, **WRONG, stops=40))
    known = known_of(session_of(shop))
    assert known.robot_arm.kinematics.level == "geometry"
    assert known.verdict.status == "good"
    q = postures(known.robot)
    (x, z), size = known.assessment.fit.state.edges[:2], len(known.robot_arm.model.values)

    def place(robot):
        return (invert(x) @ robot.base_from_flange(q) @ z)[:, :3, 3]

    true = invert(shop.base_from_instrument) @ forward(shop.true_arm, q) @ shop.flange_from_probe
    away = 1e3 * np.linalg.norm(place(known.robot_arm.model.robot) - true[:, :3, 3], axis=1)
    nominal = known.robot_arm.kinematics.nominal.rms_mm
    assert nominal > 1.0
    # 40 readings of 20 um by an arm that repeats to 30 um; seen 0.03 mm.
    assert np.median(away) < 0.06
    # What the fit says of its own worth holds.
    assert 0.3 < np.median(away) / known.findings.arms[0].workspace_mm < 1.5
    assert size == 36


@pytest.mark.slow
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


def test_known_instruments_grow_noisy_with_distance_and_unknown_ones_are_refused():
    assert len(known_instruments()) == 13
    tracker = known_instruments()["leica-at960"]
    places = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])
    # 20 um at 5 m is what is commonly said of it.
    assert tracker.sigmas_m(places) == pytest.approx([17.5e-6, 20e-6])
    assert tracker.sigma_rad == pytest.approx(9e-5)
    assert known_instruments()["zeiss-contura"].sigma_per_m == 0.0
    # What is stated comes before the table.
    stated = stated_instrument(InstrumentTable(name="leica-at960", sigma_m=5e-5))
    assert (stated.sigma_m, stated.sigma_per_m, stated.sigma_rad) == (5e-5, 0.5e-6, 9e-5)
    ours = {"name": "ours", "sigma_per_m": 1e-6}
    assert stated_instrument(InstrumentTable(**ours, sigma_m=1e-4)).sigma_per_m == 1e-6
    for table, words in (
        ({"name": "leica-at96"}, "not in the table .* Did you mean leica-at960"),
        (ours, "noise is not stated. State sigma_m .*zeiss-contura"),
    ):
        raised(DataError, words, stated_instrument, InstrumentTable(**table))


def test_without_a_model_poses_give_the_frames_alone():
    result = calibrate(session_of(tracked(POINTS), joints=False, poses=True))
    assert list(result.transforms) == ["base_from_instrument", "flange_from_probe"]
    assert result.arm is None
    places = np.array([[point.x_m, point.y_m, point.z_m] for point in result.points])
    # Readings know them to 0.012 mm each; what an arm may do wrong from stop to stop adds as much.
    assert places == pytest.approx(np.array(THREE), abs=5e-5)
    assert [point.point for point in result.points] == ["a", "b", "c"]
    assert all(point.sigma_mm < 0.024 for point in result.points)


@pytest.mark.slow
def test_outputs_are_whole_and_the_recording_gives_them_again(tmp_path):
    session_of(tracked(replace(PROBE, **WRONG))).save(tmp_path / "shop")
    out = tmp_path / "out"
    command("calibrate", tmp_path / "shop", "-o", out).good()
    text = (out / "calibration.json").read_text()
    document = json.loads(text)
    assert "null" not in text
    assert document["mount"] == "instrument"
    assert document["noise"]["instrument_mm"] == pytest.approx(0.02)
    # The arm's 0.03 mm is told from the instrument's 0.02 mm, to some 15 %.
    assert document["noise"]["robot_translation_mm"] == pytest.approx(0.03, rel=0.5)
    found = document["kinematics"]
    rotation = np.array(document["transforms"]["flange_from_probe"]["covariance"])[:3, :3]
    with_rotations = [
        "deg" in document["rms"],
        "held_out_deg" in found["levels"][0],
        "deg" in found["left_out"][0],
        rotation.any(),
    ]
    assert all(with_rotations)
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


def edited(session: Session, column: str, change) -> Session:
    """The session with a column's cells changed, by row."""
    place = session.columns.index(column)
    rows = [[view.cell(name) for name in session.columns] for view in session.views]
    for at, row in enumerate(rows):
        row[place] = change(at, row[place])
    return Session.assemble(session.document, session.columns, rows, MemoryImages({}))


def multiplied(session, factor):
    for joint in range(1, 7):
        session = edited(session, f"q{joint}_rad", lambda _, cell: repr(factor * float(cell)))
    return session


def in_degrees(session):
    return multiplied(session, float(np.rad2deg(1.0)))


def in_gon(session):
    """Angles in gon, taken for degrees."""
    return multiplied(session, 400.0 / 360.0)


def of_no_instrument(session):
    rows = [[view.cell(column) for column in session.columns] for view in session.views]
    document = {name: value for name, value in session.document.items() if name != "instrument"}
    document["mount"] = "eye-to-hand"
    return Session.assemble(document, session.columns, rows, MemoryImages({}))


def by_photographs(session):
    return replace(session, document={**session.document, "instrument": {"name": "v-stars"}})


@pytest.mark.parametrize(
    ("options", "change", "words"),
    [
        (
            POINT,
            lambda it: edited(it, "meas_x_m", lambda _, cell: str(1e3 * float(cell))),
            "millimetres",
        ),
        (PROBE, lambda it: edited(it, "point", lambda at, _: "ab"[at % 2]), "poses of 2 probes"),
        (
            POINTS,
            lambda it: edited(it, "q5_rad", lambda _, cell: repr(-float(cell))),
            "With q5_rad of the opposite sign, they fit what the instrument reads",
        ),
        (POINTS, in_degrees, "With the angles in degrees, they fit what the instrument reads"),
        (PROBE, in_gon, "With all angles 10.00 % smaller, they fit what the instrument reads"),
        (POINT, of_no_instrument, r"nothing says how good they are.*leica-at960"),
        (PROBE, by_photographs, r"State sigma_rad in .instrument., or leave the columns"),
    ],
)
def test_a_session_that_cannot_be_calibrated_is_refused_by_name(options, change, words):
    raised(DataError, words, known_of, change(session_of(tracked(options))))


def read(session: Session) -> RunState:
    """What is known of a session before anything is fitted."""
    return run_stages(RunState(session), STAGES[: [stage.name for stage in STAGES].index("solve")])


def test_a_misspelt_point_is_named_and_measured_poses_come_before_readings():
    named = edited(session_of(tracked(POINTS)), "point", lambda _, cell: f"nest_{cell}")
    for name, words in (
        ("nset_a", "'nset_a' was read once"),
        ("nset_a", "Did you mean nest_a"),
        ("", "no name in column point"),
        ("tooling ball", "was read once"),
    ):
        wrong = edited(named, "point", lambda at, cell, name=name: name if at == 6 else cell)
        assert words in read(wrong).reasons[6]
    session = session_of(tracked(PROBE))
    views = []
    for view in session.views:
        seen = {f"cft_{name}": view.numbers[f"meas_{name}"] for name in POSE}
        views.append(replace(view, numbers=view.numbers | seen))
    two_sides = replace(
        session,
        columns=(*session.columns, *(f"cft_{name}" for name in POSE)),
        views=tuple(views),
        document={**session.document, "mount": "eye-to-hand"},
    )
    known = read(two_sides)
    assert two_sides.mount == "eye-to-hand"
    assert known.readings is None
    words = "30 rows have an instrument's readings"
    assert any(words in warning.reason for warning in known.warnings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: q[:3], "3 usable stops of the robot, but it takes at least 4"),
        (
            lambda q: np.repeat(q[:1], 12, axis=0),
            "12 used views are all from one pose of the robot",
        ),
        # The point goes round in a circle. Where a search without an answer ends is up to
        # rounding, and with it which of the directions is named.
        (
            lambda q: q[:1] + np.outer(np.linspace(-1.5, 1.5, 12), np.eye(6)[0]),
            r"all 12 used views turn about the base's z",
        ),
    ],
    ids=["three", "one", "axis"],
)
def test_motion_that_determines_too_little_is_refused(change, words):
    shop = tracked(POINT, joints=change(tracked(POINT).joints))
    with pytest.raises(DegenerateError, match=words):
        known_of(session_of(shop, joints="one pose" not in words, poses="one pose" in words))
    with pytest.raises(DataError, match="needs poses, and the instrument reads positions only"):
        known_of(session_of(tracked(POINT)), solver="tsai")


def test_a_joint_that_slips_between_readings_is_named():
    """Functions of the joints would explain much of it, and leave the result good."""
    joint, slip_deg = 3, 0.15
    shop = tracked(replace(POINT, **WRONG, stops=40))
    slipped = shop.joints.copy()
    slipped[20:, joint - 1] += np.deg2rad(slip_deg)
    known = known_of(session_of(replace(shop, joints=slipped)))
    assert known.verdict.status != "good"
    found = known.verdict.causes[0]
    assert found.kind == "joint_slipped"
    assert f"joint {joint} (" in found.words
    assert "from stop 20 on" in found.words
    said = re.search(r"it reads ([+-][0-9.]+) deg \(sigma ([0-9.]+)\)", found.words)
    slip, sigma_deg = map(float, said.groups())
    # Known to its sigma; the noise beside an unmodelled step is that of a fit without it.
    assert slip == pytest.approx(slip_deg, abs=4.0 * sigma_deg)
    assert sigma_deg < 0.03


@pytest.mark.slow
def test_an_arm_that_cannot_tilt_is_asked_for_a_measured_height():
    scara = load_robot("generic-scara-600")
    rng, place = np.random.default_rng(1), np.array([0.06, 0.02, 0.05, 1.0])
    q = rng.uniform(scara.lower_rad, scara.upper_rad, (20, 4))
    instrument_from_base = invert(exp(np.array([0.1, -0.2, 2.5, 2.5, -1.0, 0.4])))
    read = instrument_from_base @ scara.base_from_flange(q) @ place
    read[:, :3] += 2e-5 * rng.normal(size=(20, 3))
    columns = ["view", "q1_rad", "q2_rad", "q3_rad", "q4_rad", "meas_x_m", "meas_y_m", "meas_z_m"]
    numbers = np.hstack([q, read[:, :3]]).tolist()
    rows = [[str(at), *map(repr, row)] for at, row in enumerate(numbers)]

    def session(**more):
        document = {"schema": 1, "name": "scara", "robot": {"model": scara.name}, **more}
        document["instrument"] = {"sigma_m": 2e-5}
        images = MemoryImages({})
        return Session.assemble(document, columns, rows, images, robot_document=scara.document)

    with pytest.raises(DegenerateError) as refused:
        calibrate(session())
    measure = "This arm cannot tilt: measure that offset for [prior.flange_from_probe]."
    assert refused.value.next_step.startswith(measure)
    prior = {"flange_from_probe": {"z_m": 0.05, "sigma_m": 5e-4}}
    found = calibrate(session(prior=prior))
    steps = [finding.do.words for finding in found.verdict.findings if finding.do]
    assert not any("tilt" in step for step in steps)
    height = found.edges["flange_from_probe"].matrix[2, 3]
    # Readings alone leave it open: it is where it was measured.
    assert height == pytest.approx(0.05, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [0.5, 1.0])
def test_gears_of_two_slopes_are_found_under_heavy_loads(beyond, monkeypatch):
    """Shoulder and elbow yield half as much beyond a torque, or as much."""
    stiff, knees = np.array([1e6, 4.7e5, 3e5, 1e5, 1e5, 7e4]), {1: 900.0, 2: 500.0}

    def yielding(arm, compliance, joints, payloads=()):
        most = np.array([knees.get(joint, np.inf) for joint in range(6)])
        bent, each = joints, np.array(compliance)
        for _ in range(8):
            torques = arms.load_torques(arm, bent, payloads)
            over = np.sign(torques) * np.maximum(np.abs(torques) - most, 0.0)
            bent = joints + each * (torques + (beyond - 1.0) * over)
        return bent

    monkeypatch.setattr(arms, "loaded_joints", yielding)
    loads = tuple(Payload(kg, (0.0, 0.0, 0.1)) for kg in (0.0, 20.0, 100.0))
    options = InstrumentOptions(
        robot="generic-6r-1800",
        dh_sigma_m=5e-4,
        dh_sigma_rad=5e-4,
        compliance_rad_per_nm=tuple(1.0 / stiff),
        payloads=loads,
    )
    drawn = random_postures(arm_named(options.robot), 20, np.random.default_rng(100))
    found = calibrate(session_of(tracked(options, np.repeat(drawn, 3, axis=0))))
    found_slopes = {
        at: spring.slopes for at, spring in enumerate(found.elastic.joints) if spring.slopes
    }
    assert found_slopes.keys() == (knees.keys() if beyond < 1.0 else set())
    words = " ".join(finding.words for finding in found.verdict.findings)
    assert words.count("yields by two slopes") == len(found_slopes)
    for joint, slopes in found_slopes.items():
        assert slopes.knee_nm == pytest.approx(knees[joint], rel=0.15)
        first, second = 1.0 / stiff[joint], beyond / stiff[joint]
        assert abs(slopes.compliance_rad_per_nm - first) < 2.0 * slopes.sigma_rad_per_nm
        assert abs(slopes.beyond_rad_per_nm - second) < 2.0 * slopes.sigma_beyond_rad_per_nm
