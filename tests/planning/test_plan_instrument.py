"""Stops for an instrument: condition, sight, added stops, and what they are worth in a fit."""

import csv
import json
import re

import numpy as np
import pytest
from support.commands import visioncal as command

from visioncal.calibration.run import calibrate
from visioncal.core.transforms import compose
from visioncal.estimation.problem_parts import ANYTHING
from visioncal.planning.cell import TYPICAL_NOISE, InstrumentCell, Limits
from visioncal.planning.instrument import STABLE, plan_for_instrument, readings
from visioncal.planning.purposes import purpose_of
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.kinds import Instrument, known_instruments
from visioncal.simulation.instrument_session import InstrumentOptions, session_of, tracked

ARM = "generic-6r-1800"
TRACKER = ("--instrument", "leica-at960", "--cam", "2500 -1000 400", "--board", "30 -20 120")
AT500 = ("--instrument", "leica-at500", *TRACKER[2:])


def cell_of(*, are_poses: bool = False, at=(2.5, -1.0, 0.4), **limits) -> InstrumentCell:
    x, z = compose(np.eye(3), np.array(at)), compose(np.eye(3), np.array([0.03, -0.02, 0.12]))
    instrument = known_instruments()["leica-at960"]
    robot = load_robot(ARM)
    return InstrumentCell(robot, instrument, x, z, are_poses, TYPICAL_NOISE, Limits(**limits))


@pytest.mark.parametrize("criterion", ["D", "I"])
@pytest.mark.parametrize("are_poses", [False, True], ids=["point", "pose"])
def test_planned_stops_are_well_conditioned_and_better_than_random_ones(criterion, are_poses):
    plan = plan_for_instrument(
        cell_of(are_poses=are_poses), purpose_of("kinematics"), 30, criterion, possible=600
    )
    # Of 36 twists of the links, 6 of the instrument and 3 (6) of the probe: 4 of each revolute
    # joint but the first and last, whose further two are of base and tool, and the frames' own.
    assert plan.parameters == (30 if are_poses else 27)
    assert plan.condition() < STABLE
    rng = np.random.default_rng(1)
    drawn = [plan.condition(plan.candidates[rng.choice(600, 30, replace=False)]) for _ in range(10)]
    assert plan.condition() < np.median(drawn)


def test_information_rows_are_those_of_the_fit():
    shop = tracked(InstrumentOptions(robot=ARM, stops=25, seed=3))
    found = calibrate(session_of(shop), level="hand-eye")
    read = readings(cell_of(), purpose_of("hand-eye"), shop.joints)
    assert read.slopes.shape == (25, 6, 12)
    # An unread rotation counts as unknown, as in the fit.
    assert (read.seen.covariance[:, 0, 0] == ANYTHING).all()
    x, z = (found.edges[name].matrix for name in ("base_from_instrument", "flange_from_probe"))
    cell = cell_of()
    noise = found.noise
    cell = InstrumentCell(
        cell.robot,
        Instrument(2e-5),
        x,
        z,
        False,
        TYPICAL_NOISE.of_robot(
            np.deg2rad(noise["robot_rotation_deg"]), 1e-3 * noise["robot_translation_mm"]
        ),
    )
    read = readings(cell, purpose_of("hand-eye"), shop.joints)
    rows = read.whitened[:, :, [0, 1, 2, 3, 4, 5, 9, 10, 11]]
    information = np.einsum("mij,mil->jl", rows, rows)
    predicted = np.sqrt(np.diag(np.linalg.inv(information)))
    stated = np.sqrt(np.diag(found.joint_covariance))[[0, 1, 2, 3, 4, 5, 9, 10, 11]]
    # The fit's own noise was estimated beside what an arm may do wrong, which adds a little.
    assert stated == pytest.approx(predicted, rel=0.35)


def test_the_probe_is_seen_and_everything_is_clear():
    cell = cell_of(floor_m=-0.5)
    plan = plan_for_instrument(cell, purpose_of("kinematics"), 12, possible=200)
    assert (cell.collisions().first_contact(plan.q) < 0).all()
    assert [len(via) >= 0 for via in plan.via] == [True] * 12
    # From the point itself to the instrument nothing of the arm is within a link's radius.
    frames = cell.robot.link_frames(plan.q)
    probe = (frames[:, -1] @ cell.z)[:, :3, 3]
    along = np.linspace(0.1, 0.9, 50)[:, None, None]
    sight = probe + along * (cell.x[:3, 3] - probe)
    elbow = frames[:, 3, :3, 3]
    assert np.linalg.norm(sight - elbow, axis=2).min() > 0.045


def test_stops_are_added_to_a_session_and_what_was_recorded_counts(tmp_path):
    command("simulate", tmp_path / "A", "--instrument", "point", "--robot", ARM, "--views", 12)
    out = tmp_path / "plan"
    options = ("--candidates", 300, "-o", out)
    printed = command("plan", tmp_path / "A", "--add", 8, *options).good().out
    figures = re.search(r"sigma: ([0-9.]+) mm before, ([0-9.]+) mm after", printed)
    before, after = map(float, figures.groups())
    # 12 stops determine 27 values with 36 numbers; 20 have twice the redundancy.
    assert after < 0.8 * before
    with (out / "stops.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["view"]) for row in rows] == list(range(12, 20))
    assert rows[0]["meas_x_m"] == ""
    document = json.loads((out / "plan.json").read_text())
    assert document["condition"]["parameters"] == 27
    read = ("--instrument", "point", "--robot", ARM, "--at", out)
    command("simulate", tmp_path / "B", *read, "--force-n", 10, "--force-n", 50).good()
    views = Session.load(tmp_path / "B").views
    planned = np.array([[float(row[f"q{at}_rad"]) for at in range(1, 7)] for row in rows])
    assert np.array([view.joints_rad for view in views]) == pytest.approx(
        planned.repeat(2, axis=0), abs=1e-9
    )
    assert [view.numbers["force_z_n"] for view in views] == [-10.0, -50.0] * 8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((ARM, "--mount", "instrument"), "--cam, --board, --instrument are needed"),
        ((ARM, "--mount", "instrument", "--add", 3), "holds no recorded session"),
        ((ARM, "--mount", "instrument", *TRACKER, "--target", "x"), "sees no board"),
        ((ARM, "--mount", "instrument", "--probe", "pose", *AT500), "reads rotations is not known"),
    ],
)
def test_missing_inputs_are_named(arguments, words, tmp_path):
    assert words in command("plan", *arguments, "-o", tmp_path / "plan").refused().err
