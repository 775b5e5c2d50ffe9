"""Torques that come later than their angles: by how much, and what is done about it."""

import json

import numpy as np
import pytest
from support.commands import visioncal as run
from support.moved_arms import changed, robot_with_bodies

from visioncal.dynamics.conditioning import condition
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.identify import Options, find_lag
from visioncal.dynamics.reading import read_recorded
from visioncal.session import Stream
from visioncal.simulation.dynamics import (
    exercise_session,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)

TERMS = Options().terms


def late(stream, lag_s):
    """The stream with torques that come so much later [s]."""

    def change(columns):
        times_s = columns["stamp_s"]
        for joint in range(1, 7):
            torques = columns[f"tau{joint}_nm"]
            columns[f"tau{joint}_nm"] = np.interp(times_s - lag_s, times_s, torques)

    return changed(stream, change)


def some_of(stream, rng):
    """Four rows in five."""
    rows = np.sort(rng.permutation(len(stream))[: 4 * len(stream) // 5])
    return Stream(stream.columns, stream.values[rows])


def found(stream, name="ur5e"):
    rows = read_recorded(stream, "streams/robot.csv", 6)
    return find_lag(robot_with_bodies(nominal_dynamics(name)), [condition(rows)], TERMS)


@pytest.mark.parametrize(("lag_s", "whole"), [(0.02, True), (-0.03, False), (0.2, True)])
def test_lags_are_found_to_their_sigmas(lag_s, whole):
    away = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stream = record(real_dynamics("ur5e", rng), multi_sine(6, rng, rate_hz=250.0), rng)
        lag = found(late(stream, lag_s) if whole else some_of(late(stream, lag_s), rng))
        away.append((lag.seconds - lag_s) / lag.sigma_s)
        # Three in a hundred of noise, and dry friction that turns within milliseconds.
        assert lag.sigma_s < 4e-4
        # Motions of 0.1 to 0.25 Hz turn by 0.6 to 1.6 rad a second; dry friction adds its jumps.
        assert 0.5 * abs(lag_s) < lag.share < 4.0 * abs(lag_s)
    # Chance does it once in 150,000 draws; sigmas know nothing of the noise that angles leave in
    # the regressor.
    assert np.abs(away).max() < 4.5


@pytest.mark.parametrize("motion", [multi_sine, slow_sweep])
def test_torques_in_time_have_none(motion):
    rng = np.random.default_rng(4)
    assert found(record(real_dynamics("ur5e", rng, stribeck=True), motion(6, rng), rng)) is None


def test_a_torque_that_never_changes_is_no_warning():
    """Warnings are errors here: a share of nothing is no number."""
    rng = np.random.default_rng(4)
    stream = late(record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng), 0.08)

    def still(columns):
        columns["tau1_nm"] = np.zeros(len(stream))

    # It contradicts the other five, and no lag mends that.
    assert found(changed(stream, still)) is None


def test_what_no_lag_mends_has_none():
    rng = np.random.default_rng(5)
    stream = late(record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng), 0.08)
    turned = [column for column in stream.columns if column.startswith("tau")]

    def shuffle(columns):
        kept = {name: columns[name] for name in turned}
        for name, other in zip(turned, [*turned[1:], turned[0]], strict=True):
            columns[name] = kept[other]

    assert found(changed(stream, shuffle)) is None


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """The same motions, with torques in time, 10 ms late, and 80 ms late."""
    places = {}
    for lag_s in (0.0, 0.01, 0.08):
        rng = np.random.default_rng(6)
        built = real_dynamics("ur5e", rng)
        streams = {
            name: late(record(built, multi_sine(6, rng, rate_hz=250.0), rng), lag_s)
            for name in ("excite", "fresh")
        }
        places[lag_s] = tmp_path_factory.mktemp("late") / "session"
        exercise_session("ur5e", streams).save(places[lag_s])
    return places


@pytest.mark.slow
def test_late_torques_are_named_and_taken_earlier(sessions, tmp_path):
    results = {}
    for lag_s, place in sessions.items():
        asked = ("--stream", "excite", "--validate-on", "fresh", "-o", tmp_path / str(lag_s))
        done = run("dynamics", "identify", place, *asked)
        assert done.status == 0, done.err
        results[lag_s] = Identified.load(tmp_path / str(lag_s)), done.out
    assert results[0.0][0].lag is None
    assert "lag" not in json.loads((tmp_path / "0.0" / "dynamics.json").read_text())
    # Late by a little it is a note, by much a reason to look for the cause.
    for lag_s, word in ((0.01, "good"), (0.08, "check")):
        result, words = results[lag_s]
        assert result.lag.seconds == pytest.approx(lag_s, abs=5e-4)
        assert words.startswith(word)
        assert "The torques lag the angles by" in words
        assert ("Record angles and torques by one clock" in words) is (word == "check")
        # Taken earlier, they are predicted as those in time are, but for the rows at the ends,
        # which are lost, and for the noise that interpolation averages.
        known = results[0.0][0].validation.rms_nm
        assert (result.validation.rms_nm < 1.25 * known).all()


@pytest.mark.slow
def test_late_torques_of_another_day_are_taken_earlier_too(sessions, tmp_path):
    asked = ("--stream", "excite", "--validate-on", "fresh", "-o", tmp_path)
    assert run("dynamics", "identify", sessions[0.0], *asked).status == 0
    told = run("dynamics", "validate", sessions[0.08], "--against", tmp_path, "--stream", "fresh")
    assert "The torques lag the angles by 80 ms" in told.out
    asked = ("--against", tmp_path, "--stream", "fresh", "--json")
    done = run("dynamics", "validate", sessions[0.08], *asked)
    (figures,) = json.loads(done.out)
    shares = np.array(figures["rms_nm"]) / np.array(figures["torque_nm"])
    assert (shares < 0.02).all()
