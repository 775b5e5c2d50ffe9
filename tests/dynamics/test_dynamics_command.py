"""Identification from a session's folder to dynamics.json, and what its result is good for."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.refusals import raised

from visioncal.core.errors import DataError, DegenerateError
from visioncal.dynamics import ArmDynamics, Identified
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.differences import (
    difference_of,
    scale_difference,
    stream_differences,
)
from visioncal.dynamics.identified import judge
from visioncal.dynamics.identify import Options, identify
from visioncal.dynamics.model import FrictionTerms
from visioncal.dynamics.payload import estimate_payload
from visioncal.dynamics.run import IdentificationRequest, conditioned_streams, identify_session
from visioncal.dynamics.statistics import Lag
from visioncal.interchange.outputs import write_dynamics
from visioncal.robot import Loads, Robot, load_robot
from visioncal.session import Session
from visioncal.simulation.dynamics import (
    LinkBody,
    Senses,
    drive_torques,
    exercise_session,
    multi_sine,
    real_dynamics,
    record,
    slow_sweep,
)

GAINS = (10.0, 10.0, 9.0, 7.0, 7.0, 7.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A session with an exciting motion, sweeps, another motion, and currents."""
    rng = np.random.default_rng(2)
    built = real_dynamics("ur5e", rng, stribeck=True)
    motion = multi_sine(6, rng, rate_hz=250.0)
    streams = {
        "excite": record(built, motion, rng),
        "fresh": record(built, multi_sine(6, rng, rate_hz=250.0), rng),
        "motors": record(built, motion, rng, Senses(gains_nm_a=GAINS)),
        "sweeps": record(built, slow_sweep(6, rng, seconds=30.0, rate_hz=250.0), rng),
    }
    place = tmp_path_factory.mktemp("dynamics") / "session"
    exercise_session("ur5e", streams).save(place)
    return place


def test_identified_dynamics_predict_other_motions(folder, tmp_path):
    options = ("--stream", "excite", "--stream", "sweeps")
    done = visioncal("dynamics", "identify", folder, *options, "-o", tmp_path / "out").good()
    assert "good" in done.out
    assert "the last 30 % of streams/excite.csv" in done.out
    result = Identified.load(tmp_path / "out")
    # Drives have rotors, which torques that were left out told; and three terms of friction.
    assert "Ia4" in result.base.model.names
    assert result.base.rank == 58
    assert len(result.stribeck.joints) == 6
    assert result.facts["session"]["sha256"] == Session.load(folder).digest()
    figures = visioncal(
        "dynamics", "validate", folder, "--against", tmp_path / "out", "--stream", "fresh", "--json"
    ).good()
    (found,) = json.loads(figures.out)
    shares = np.array(found["rms_nm"]) / np.array(found["torque_nm"])
    assert (shares < 0.02).all()


@pytest.mark.slow
def test_json_holds_what_was_asked_for(folder):
    done = visioncal(
        *("dynamics", "identify", folder, "--stream", "motors", "--validate-on", "fresh"),
        *("--gains", ",".join(map(str, GAINS)), "--no-rotors", "--no-stribeck", "--json"),
    ).good()
    document = json.loads(done.out)
    assert len(document["base"]) == 54
    assert document["validation"]["samples"] == "streams/fresh.csv"
    assert document["friction"]["motor_inertia"] is False


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--stream", "exite"), "no stream 'exite'; it has excite, fresh, motors, sweeps"),
        (("--stream", "motors"), "currents and no torques: it needs 6 gains"),
        (("--stream", "excite", "--validate-on", "excite"), "its only stream of torques"),
        (("--stream", "excite", "--friction", "dry"), "--friction names dry"),
        (("--stream", "excite", "--gains", "1,x"), "--gains is '1,x'"),
    ],
)
def test_wrong_options_are_named(folder, arguments, words):
    visioncal("dynamics", "identify", folder, *arguments).refused(words)


@pytest.mark.parametrize("is_folder", [True, False])
def test_a_table_of_torques_alone_is_answered_with_its_place(tmp_path, is_folder):
    (tmp_path / "log.csv").write_text("time,q0,tau0\n0.0,0.1,2.5\n0.1,0.2,2.4\n")
    source = tmp_path if is_folder else tmp_path / "log.csv"
    done = visioncal("dynamics", "identify", source, "--robot", "ur5e")
    assert "pictures" not in done.refused("streams/NAME.csv", "stamp_s, q1_rad").said


def test_a_session_without_torques_or_robot_is_named(folder, tmp_path):
    session = Session.load(folder)
    kept = [name for name in session.streams["fresh"].columns if not name.startswith("tau")]
    stream = session.streams["fresh"]
    bare = type(stream)(tuple(kept), np.column_stack([stream[name] for name in kept]))
    Session.of_streams(session.document, {"fresh": bare}).save(tmp_path / "bare")
    visioncal("dynamics", "identify", tmp_path / "bare").refused(
        "no stream with torques or currents: fresh"
    )
    Session.of_streams({"schema": 1, "name": "x"}, {"fresh": bare}).save(tmp_path / "any")
    visioncal("dynamics", "identify", tmp_path / "any").refused("names no known robot")


# The rotors of the simulated arm are not among what the maker tells.
TERMS = FrictionTerms(motor_inertia=True, slow_rad_s=3e-4)
QUICK = Options(TERMS, stribeck=False, consistent=False, checked=False)
LOAD = LinkBody(2.8, np.array([0.02, -0.03, 0.08]), np.diag([0.012, 0.01, 0.008]))


class World:
    """A simulated UR10e that moved without and with a load."""

    def __init__(self, seed=0, load=LOAD, senses=None, stribeck=False):
        rng = np.random.default_rng(seed)
        self.built = real_dynamics("ur10e", rng, stribeck=stribeck)
        self.loaded = self.built.carrying(load)
        done = {
            "exercise": multi_sine(6, rng, rate_hz=250.0),
            "check": multi_sine(6, rng, seconds=8.0, rate_hz=250.0),
        }
        if stribeck:
            done["sweep"] = slow_sweep(6, rng, seconds=20.0, rate_hz=250.0)
        runs = {name: record(self.built, exercise, rng, senses) for name, exercise in done.items()}
        self.done, self.empty = done, exercise_session("ur10e", runs)
        carried = record(self.loaded, done["exercise"], rng, senses)
        self.full = exercise_session("ur10e", {"loaded": carried})


@pytest.fixture(scope="module")
def world():
    return World(stribeck=True)


@pytest.fixture(scope="module")
def run(world):
    request = IdentificationRequest(
        validate_on="check", options=Options(terms=TERMS, checked=False)
    )
    return identify_session(world.empty, request)


def loaded_streams(identified, session):
    return conditioned_streams(session, identified, IdentificationRequest())


@pytest.mark.slow
def test_torques_are_fed_forward(world, run):
    arm, done = ArmDynamics.of(run.identified), world.done["check"]
    wanted = drive_torques(world.built, done.q, done.dq, done.ddq)
    away = arm.torques(done.q, done.dq, done.ddq) - wanted
    known = ArmDynamics(arm.robot, arm.robot.inertias, arm.friction)
    before = known.torques(done.q, done.dq, done.ddq) - wanted
    share = np.sqrt(np.mean(away**2, axis=0) / np.var(wanted, axis=0))
    # 3 % of noise in 3000 torques a joint tell each of 60 parameters to some thousandths.
    assert share.max() < 0.02
    # Links weigh 20 % otherwise than the maker says.
    assert np.sqrt(np.mean(before[:, 1] ** 2)) > 10.0 * np.sqrt(np.mean(away[:, 1] ** 2))


def test_the_doubt_about_a_result_is_named(run):
    """But for the first: a lag that is a small share of the torques is a remark."""
    known, checked = run.identified, run.identified.validation
    assert judge(known).status == "good"
    for changes, status, words in (
        ({"lag": Lag(0.01, 1e-4, 0.05)}, "good", "The torques lag the angles by 10 ms"),
        ({"lag": Lag(-0.08, 1e-4, 0.4)}, "check", "Record angles and torques by one clock"),
        ({"validation": None}, "check", "Nothing was left to predict"),
        (
            {"validation": replace(checked, consistent_rms_nm=2.0 * checked.rms_nm)},
            "check",
            "Check whether it is the robot that was recorded",
        ),
        (
            {"covariance": 1e4 * known.covariance},
            "check",
            "this motion was too slow, too small or too short",
        ),
        (
            {"validation": replace(checked, rms_nm=checked.torque_nm * [0.0, 0, 0, 0, 0, 0.6])},
            "bad",
            "predicted to 0, 0, 0, 0, 0, 60 %",
        ),
        ({"differences": ("Dry friction was 2 times.",)}, "check", "Dry friction was 2 times."),
    ):
        verdict = judge(replace(known, **changes))
        assert verdict.status == status
        assert words in " ".join(map(str, verdict.findings))


def test_a_payload_is_weighed(world, run):
    identified = run.identified
    found = estimate_payload(identified, loaded_streams(identified, world.full))
    assert found.mass_kg == pytest.approx(2.8, abs=0.05)
    assert found.centre_m == pytest.approx(LOAD.centre_m, abs=0.005)
    # Within four of its own sigmas: chance exceeds them once in some ten thousand.
    assert abs(found.mass_kg - 2.8) < 4.0 * found.mass_sigma_kg < 0.05
    assert (np.abs(found.centre_m - LOAD.centre_m) < 4.0 * found.centre_sigma_m).all()
    assert found.consistent
    assert found.document()["inertia_kg_m2"][0] == pytest.approx(0.012, rel=0.3)
    # Weighing knows a mass as well as gravity, and its centre better.
    document = {**identified.robot.document, "gravity_m_s2": [0.0, 0.0, -9.80665]}
    stated = replace(identified, robot=Robot.from_document(document))
    surer = estimate_payload(stated, loaded_streams(stated, world.full))
    assert surer.mass_kg == pytest.approx(found.mass_kg)
    assert found.mass_sigma_kg**2 - surer.mass_sigma_kg**2 == pytest.approx(
        (5e-4 * found.mass_kg) ** 2
    )
    assert surer.centre_sigma_m == pytest.approx(found.centre_sigma_m)
    # The arm that carries it holds it.
    q = world.done["check"].q[::500]
    more = ArmDynamics.of(identified).carrying(found.body).gravity(q)
    more -= ArmDynamics.of(identified).gravity(q)
    held = identified.robot.load_torques(
        q, Loads.alike(len(q), found.mass_kg, found.centre_m, (0.0, 0.0, 0.0))
    ) - identified.robot.load_torques(q)
    assert more == pytest.approx(-held, abs=1e-9)


def test_sigmas_of_the_drives_gains_count_in_the_mass(run, world):
    """All drives of one sign, as lists have it: the mass is as wrong as the gains."""
    streams = loaded_streams(run.identified, world.full)
    exact = estimate_payload(run.identified, streams)
    currents = [replace(stream, of_currents=True) for stream in streams]
    found = estimate_payload(run.identified, currents, gain_sigma=0.12)
    assert exact.gains_sigma_kg == 0.0
    assert found.mass_kg == exact.mass_kg
    # The larger part is common to all drives, and a common error is that of the mass.
    assert 0.8 * 0.12 < found.gains_sigma_kg / found.mass_kg < 0.13
    assert found.mass_sigma_kg > found.gains_sigma_kg
    assert found.document()["gains_sigma_kg"] == found.gains_sigma_kg


def test_a_recording_without_payload_is_refused(world, run):
    same = exercise_session("ur10e", {"again": world.empty.streams["check"]})
    with pytest.raises(DegenerateError, match="does not differ from none"):
        estimate_payload(run.identified, loaded_streams(run.identified, same))


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000.0, "mN m"),
        (-1.0, "the other sign"),
        (1.4, "torques seem 1.4"),
        (0.6, "torques seem 0.6"),
    ],
)
def test_torques_that_no_payload_makes_are_refused(run, world, scale, words):
    streams = [item.scaled(scale) for item in loaded_streams(run.identified, world.full)]
    raised(DataError, words, estimate_payload, run.identified, streams)


def test_how_a_stream_differs_is_named(world, run):
    """Gears of another temperature, and a body that nobody stated."""
    (loaded,) = loaded_streams(run.identified, world.full)
    assert difference_of(run.identified, loaded) == "2.8 kg more were on the flange"
    gears = world.built.gears
    colder = replace(gears, coulomb=1.5 * gears.coulomb, viscous=1.5 * gears.viscous)
    rng = np.random.default_rng(8)
    cold = record(replace(world.built, gears=colder), world.done["exercise"], rng)
    (sweeps,) = loaded_streams(run.identified, exercise_session("ur10e", {"cold": cold}))
    assert difference_of(run.identified, sweeps).startswith("dry friction was 1.")
    (alike,) = loaded_streams(
        run.identified, exercise_session("ur10e", {"check": world.empty.streams["check"]})
    )
    assert not difference_of(run.identified, alike)
    first = run.identification.streams[0]
    found = list(stream_differences(run.identified.robot, [first, alike, sweeps], QUICK))
    assert len(found) == 1
    assert "streams/cold.csv was recorded otherwise than streams/exercise.csv" in found[0]


def test_the_joint_of_another_gain_is_named(run):
    first = run.identification.streams[0]
    assert not scale_difference(identify(run.identified.robot, [first], QUICK))
    wrong = first.scaled(np.array([1.0, 1.0, 1.3, 1.0, 1.0, 1.0]))
    words = scale_difference(identify(run.identified.robot, [wrong], QUICK))
    assert words.startswith("The torques of joint 3 are 1.3")


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dynamics")
    assert [file.name for file in write_dynamics(folder, run).files] == [
        "dynamics.json",
        "report.html",
    ]
    return folder


def test_the_report_says_what_was_found(written, run):
    page = (written / "report.html").read_text(encoding="utf-8")
    identified = run.identified
    for text in ("shoulder_pan_joint", "Fc1", "kg m", "Base parameters", "m6*cx6"):
        assert text in page
    # One row a parameter, a plot a motion and one of friction.
    parameters = page[page.index("Base parameters</h2>") :]
    assert parameters.count('<tr class="') == identified.base.rank
    assert page.count("<svg role") == len(run.predictions) + 1
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.parametrize("form", ["robot-urdf", "robot-json"])
def test_identified_inertias_are_exported(written, run, form, tmp_path):
    suffix = {"robot-urdf": ".urdf", "robot-json": ".json"}[form]
    path = tmp_path / f"arm{suffix}"
    assert visioncal("export", written, "--to", form, "-o", path).status == 0
    again = load_robot(str(path), tip="tool0")
    assert again.inertias.values == pytest.approx(run.identified.inertias.values, abs=1e-9)
    assert again.rates.torque.tolist() == run.identified.robot.rates.torque.tolist()
    visioncal("export", written, "--to", "ros").refused("robot-urdf and robot-json")


def test_without_known_inertias_there_are_no_bodies(run):
    with pytest.raises(DataError, match="its links have none"):
        ArmDynamics.of(replace(run.identified, consistent=None))


def test_the_command_weighs(written, world, tmp_path):
    world.full.save(tmp_path / "loaded")
    arguments = ("dynamics", "payload", tmp_path / "loaded", "--against", written)
    document = json.loads(visioncal(*arguments, "--json").out)
    assert document["mass_kg"] == pytest.approx(2.8, abs=0.05)
    assert "on a UR: set_target_payload(2." in visioncal(*arguments).out
    arguments = ("dynamics", "validate", tmp_path / "loaded", "--against", written)
    predicted = visioncal(*arguments)
    assert predicted.status == 3
    assert "loaded.csv was recorded otherwise: 2.8 kg more were on the flange" in predicted.out
    assert Identified.load(written).base.rank == 58


def test_the_command_finds_gains(tmp_path):
    gains = (20.0, 21.0, 16.0, 9.0, 9.5, 8.7)
    load = LinkBody(8.0, np.array([0.08, -0.03, 0.08]), LOAD.inertia_kg_m2)
    world = World(4, load, Senses(gains_nm_a=gains))
    world.empty.save(tmp_path / "empty")
    world.full.save(tmp_path / "loaded")
    known = ("--mass-kg", 8.0, "--com-mm", "80,-30,80", "--inertia", "0.012,0,0.01,0,0,0.008")
    arguments = ("dynamics", "gains", tmp_path / "empty", "--loaded", tmp_path / "loaded", *known)
    rows = json.loads(visioncal(*arguments, "--json").out)
    assert [row["nm_per_a"] for row in rows] == pytest.approx(gains, rel=0.02)
    assert visioncal(*arguments).out.startswith("--gains ")
    again = ("dynamics", "gains", tmp_path / "loaded", "--loaded", tmp_path / "empty", *known)
    visioncal(*again).refused("Name the run without the body first")
    visioncal(*arguments, "--com-mm", "0.08,-0.03,0.08").refused("It is in mm, not in m.")
    visioncal(*arguments, "--com-mm", "80,-30,-80").refused("the body is another one")
    doubted = visioncal(*arguments, "--mass-kg", "17.6").good()
    assert "times what its description states" in doubted.err
    visioncal(*arguments, "--mass-kg", "8000").refused("mN m, or mA for A")
    visioncal(*arguments, "--inertia", "0.1,0,0.01,0,0,0.01").refused("are those of no body")


def test_base_parameters_are_read_as_they_were_kept(run, tmp_path):
    """Another machine may have kept other columns of the same model."""
    identified = run.identified
    other = BaseModel.reduce(identified.base.model, np.random.default_rng(5))
    assert other.independent.tolist() != identified.base.independent.tolist()
    turn = other.dependence[:, identified.base.independent]
    humps = np.eye(len(identified.covariance) - other.rank)
    across = np.block(
        [[turn, np.zeros((other.rank, len(humps)))], [np.zeros((len(humps), other.rank)), humps]]
    )
    covariance = across @ identified.covariance @ across.T
    written = replace(
        identified, base=other, values=turn @ identified.values, covariance=covariance
    )
    written.save(tmp_path / "dynamics.json")
    again = Identified.load(tmp_path)
    assert again.base.independent.tolist() == other.independent.tolist()
    found = run.identification.streams[0].pieces[0].measured.motion.chosen(slice(0, 50))
    # Both are the same torques, to rounding of sums of some 60 products.
    assert again.torques(found) == pytest.approx(identified.torques(found), abs=1e-7)
