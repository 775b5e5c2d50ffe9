"""`visioncal dynamics identify` and `validate`, from a session's folder to dynamics.json."""

import json

import numpy as np
import pytest
from support.commands import visioncal as run

from visioncal.core.errors import DataError
from visioncal.dynamics.identified import Identified
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation.dynamics import (
    Senses,
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
    motion = multi_sine(6, rng)
    streams = {
        "excite": record(built, motion, rng),
        "fresh": record(built, multi_sine(6, rng), rng),
        "motors": record(built, motion, rng, Senses(gains_nm_a=GAINS)),
        "sweeps": record(built, slow_sweep(6, rng, seconds=30.0), rng),
    }
    place = tmp_path_factory.mktemp("dynamics") / "session"
    exercise_session("ur5e", streams).save(place)
    return place


def test_a_session_of_streams_alone_survives_the_disk(folder):
    session = Session.load(folder)
    assert not (folder / "views.csv").exists()
    assert session.views == ()
    again = Session.of_streams(session.document, session.streams)
    assert again.digest() == session.digest()


@pytest.mark.slow
def test_the_end_of_a_motion_is_judged_by_the_torques_of_all_of_it(tmp_path, monkeypatch):
    # As the page types it, but for --validate-on: in the last 30 % joint 5 bears the same torque
    # all the time, and its error is 6 % of that.
    monkeypatch.chdir(tmp_path)
    assert run("simulate", "session", "--torques").status == 0
    done = run("dynamics", "identify", "session", "-o", "out")
    assert done.out.startswith("good  dynamics of ur10e"), done.out
    found = Identified.load(tmp_path / "out")
    assert found.validation.label == "the last 30 % of streams/fresh.csv"
    assert (found.validation.shares < 0.02).all()


def test_identify_and_validate(folder, tmp_path):
    asked = ("--stream", "excite", "--stream", "sweeps")
    done = run("dynamics", "identify", folder, *asked, "-o", tmp_path / "out")
    assert done.status == 0, done.err
    assert "good" in done.out
    assert "the last 30 % of streams/excite.csv" in done.out
    result = Identified.load(tmp_path / "out")
    # Drives have rotors, which torques that were left out told; and three terms of friction.
    assert "Ia4" in result.base.model.names
    assert result.base.rank == 58
    assert len(result.stribeck.joints) == 6
    assert result.facts["session"]["sha256"] == Session.load(folder).digest()
    figures = run(
        "dynamics", "validate", folder, "--against", tmp_path / "out", "--stream", "fresh", "--json"
    )
    assert figures.status == 0, figures.err
    (found,) = json.loads(figures.out)
    shares = np.array(found["rms_nm"]) / np.array(found["torque_nm"])
    assert (shares < 0.02).all()


def test_json_holds_what_was_asked_for(folder):
    done = run(
        *("dynamics", "identify", folder, "--stream", "motors", "--validate-on", "fresh"),
        *("--gains", ",".join(map(str, GAINS)), "--no-rotors", "--no-stribeck", "--json"),
    )
    assert done.status == 0, done.err
    document = json.loads(done.out)
    assert len(document["base"]) == 54
    assert document["validation"]["samples"] == "streams/fresh.csv"
    assert document["friction"]["motor_inertia"] is False
    assert {row["determined"] for row in document["base"]} <= {
        "2 %",
        "10 %",
        "poorly",
        "not at all",
    }
    assert document["verdict"]["reasons"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--stream", "exite"), "no stream 'exite'; it has excite, fresh, motors, sweeps"),
        (("--stream", "motors"), "currents and no torques; 6 gains"),
        (("--stream", "excite", "--validate-on", "excite"), "its only stream of torques"),
        (("--stream", "excite", "--friction", "dry"), "--friction names dry"),
        (("--stream", "excite", "--gains", "1,x"), "--gains is '1,x'"),
    ],
)
def test_wrong_wishes_are_named(folder, arguments, words):
    done = run("dynamics", "identify", folder, *arguments)
    assert done.status == 2
    assert words in done.err


def test_a_session_without_torques_or_robot_is_named(folder, tmp_path):
    session = Session.load(folder)
    there = [name for name in session.streams["fresh"].columns if not name.startswith("tau")]
    stream = session.streams["fresh"]
    bare = type(stream)(tuple(there), np.column_stack([stream[name] for name in there]))
    Session.of_streams(session.document, {"fresh": bare}).save(tmp_path / "bare")
    done = run("dynamics", "identify", tmp_path / "bare")
    assert done.status == 2
    assert "no stream with torques or currents: fresh" in done.err
    Session.of_streams({"schema": 1, "name": "x"}, session.streams).save(tmp_path / "any")
    done = run("dynamics", "identify", tmp_path / "any")
    assert done.status == 2
    assert "names no known robot" in done.err


def told_of(tmp_path, robot, stream):
    """What identify says of one stream."""
    exercise_session(robot, {"robot": stream}).save(tmp_path / robot)
    return run("dynamics", "identify", tmp_path / robot)


@pytest.mark.slow
def test_slow_motions_are_told_to_tell_nothing_of_fast_ones(folder, tmp_path):
    done = told_of(tmp_path, "ur5e", Session.load(folder).streams["sweeps"])
    assert done.status == 0
    assert done.out.startswith("check")
    assert "this motion was too slow, too small or too short" in done.out
    assert "visioncal dynamics plan" in done.out


@pytest.mark.slow
def test_another_robot_is_doubted(folder, tmp_path):
    done = told_of(tmp_path, "ur10e", Session.load(folder).streams["excite"])
    assert done.status == 0
    assert "Check whether it is the robot that was recorded" in done.out


@pytest.mark.slow
def test_a_robot_without_inertias_gets_base_parameters(folder, tmp_path):
    done = told_of(tmp_path, "irb120", Session.load(folder).streams["excite"])
    assert done.status == 0
    # Its axes lie otherwise than those that were recorded: no inertias explain the torques.
    assert done.out.startswith("check")


def test_torques_in_thousandths_are_named_though_beyond_all_limits(folder, tmp_path):
    stream = Session.load(folder).streams["excite"]
    values = stream.values.copy()
    values[:, [stream.columns.index(f"tau{index}_nm") for index in range(1, 7)]] *= 1e3
    done = told_of(tmp_path, "ur5e", type(stream)(stream.columns, values))
    assert done.status == 2
    assert "mN m, or mA for A" in done.err


def test_calibration_says_that_there_are_no_views(folder, tmp_path):
    done = run("calibrate", folder, "-o", tmp_path / "out")
    assert done.status == 2
    assert "has streams and no views" in done.err


def test_validation_needs_a_result(folder, tmp_path):
    done = run("dynamics", "validate", folder)
    assert done.status == 2
    assert "--against" in done.err
    (tmp_path / "dynamics.json").write_text("{}")
    done = run("dynamics", "validate", folder, "--against", tmp_path)
    assert done.status == 2
    assert "dynamics.json: schema is None, this version reads 1" in done.err


def test_results_of_the_one_kind_are_no_results_of_the_other(tmp_path):
    calibrated, identified = tmp_path / "calibrated", tmp_path / "identified"
    for folder, name in ((calibrated, "calibration.json"), (identified, "dynamics.json")):
        folder.mkdir()
        (folder / name).write_text("{}", encoding="utf-8")
    with pytest.raises(DataError, match="is a result of visioncal dynamics identify"):
        Calibration.load(identified)
    with pytest.raises(DataError, match=r"has no dynamics\.json") as caught:
        Identified.load(calibrated)
    assert "visioncal dynamics identify" in caught.value.next_step
