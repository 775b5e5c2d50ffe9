"""Dynamics identified of simulated arms, and of a real one."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.moved_arms import changed, recorded, robot_with_bodies, true_base

from visioncal.core.errors import DegenerateError
from visioncal.dynamics.base import BaseModel, null_space
from visioncal.dynamics.conditioning import condition
from visioncal.dynamics.identified import Identified, TorqueValidation, judge
from visioncal.dynamics.identify import (
    SLOW_RAD_S,
    Options,
    block_of,
    fit_friction_to_known,
    identify,
    predict,
    validate,
)
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.reading import RecordedSamples, read_recorded
from visioncal.robot import load_robot
from visioncal.session import Stream
from visioncal.simulation.dynamics import (
    Senses,
    drive_torques,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)

PANDA = Path(__file__).parents[3] / "shared" / "data" / "dyn_franka_panda"
TERMS = FrictionTerms(motor_inertia=True, slow_rad_s=SLOW_RAD_S)
PLAIN = Options(terms=TERMS, stribeck=False)


def known_arm(name: str = "ur5e"):
    """The arm as its maker publishes it, which real ones are off from by a fifth."""
    return robot_with_bodies(nominal_dynamics(name))


@pytest.fixture(scope="module")
def worlds():
    """Four arms, each with what its first motion tells and a second motion."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        built = real_dynamics("ur5e", rng)
        first = recorded(built, multi_sine(6, rng), rng)
        fresh = multi_sine(6, rng)
        found.append((built, identify(known_arm(), [first], PLAIN), fresh, rng))
    return found


def test_parameters_are_within_their_sigmas(worlds):
    shares = []
    for built, found, _, _ in worlds:
        result = found.identified
        away = result.values - true_base(result.base, built)
        shares.append(away @ np.linalg.solve(result.covariance, away) / len(away))
    # Chi-square of 58 over its degrees of freedom has a standard deviation of 0.19, the mean of
    # four one of 0.1; that noise is estimated, too, adds 0.03. Sigmas off by a fifth would show.
    assert np.mean(shares) == pytest.approx(1.03, abs=0.3)
    assert max(shares) < 1.9


def test_parameters_are_within_their_sigmas_where_samples_are_lost():
    shares, wider = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        built = real_dynamics("ur5e", rng)
        stream = record(built, multi_sine(6, rng, rate_hz=100.0), rng)
        sigmas = []
        for kept in (np.arange(len(stream)), np.sort(rng.permutation(len(stream))[:1600])):
            rows = read_recorded(Stream(stream.columns, stream.values[kept]), "robot.csv", 6)
            result = identify(known_arm(), [condition(rows)], PLAIN).identified
            away = result.values - true_base(result.base, built)
            shares.append(away @ np.linalg.solve(result.covariance, away) / len(away))
            sigmas.append(result.sigmas)
        wider.append(float(np.median(sigmas[1] / sigmas[0])))
    # As without losses; and four samples in five tell by 12 % less.
    assert np.mean(shares[1::2]) == pytest.approx(np.mean(shares[::2]), abs=0.3)
    assert np.mean(wider) == pytest.approx(1.12, abs=0.1)


def test_torques_of_another_motion_are_predicted_to_their_noise(worlds):
    for built, found, fresh, rng in worlds:
        motion = recorded(built, fresh, rng).pieces[0].measured.motion
        begin = int(np.searchsorted(fresh.times_s, motion.times_s[0] - 1e-6))
        rows = slice(begin, begin + len(motion))
        true = drive_torques(built, fresh.q, fresh.dq, fresh.ddq)
        noise = 0.03 * np.sqrt(np.mean(true**2, axis=0))
        for torques in (found.identified.torques, found.identified.consistent_torques):
            away = np.sqrt(np.mean((torques(motion) - true[rows]) ** 2, axis=0))
            assert np.sqrt(1.0 + (away / noise) ** 2).max() < 1.1


def test_links_are_bodies_in_every_run_and_nearer_the_truth(worlds):
    known = known_arm().inertias.values[:, 0]
    before, after = [], []
    for built, found, _, _ in worlds:
        inertias = found.identified.inertias
        assert inertias.consistent
        true = robot_with_bodies(built).inertias.values[:, 0]
        before.append(np.log(known / true))
        after.append(np.log(inertias.values[:, 0] / true))
    # No motion tells single masses, but what it tells pulls them the right way in the mean.
    assert np.std(after) < np.std(before)


def test_the_prior_yields_to_the_torques(worlds):
    for _, found, _, _ in worlds:
        # A misfit of chi-square of 58 is what the noise alone would give if the truth were fitted.
        assert found.identified.consistent.misfit < 90.0


def test_breaking_loose_is_found():
    rng = np.random.default_rng(1)
    built = real_dynamics("ur5e", rng, stribeck=True)
    streams = [recorded(built, exercise(6, rng), rng) for exercise in (multi_sine, slow_sweep)]
    result = identify(known_arm(), streams, replace(PLAIN, stribeck=True)).identified
    humps, size = result.stribeck, result.base.rank
    assert humps.joints.tolist() == [0, 1, 2, 3, 4, 5]
    away = np.concatenate(
        [
            humps.hump_nm - built.gears.stribeck,
            np.log(humps.speed_rad_s / built.gears.stribeck_speed),
        ]
    )
    covariance = result.covariance[size:, size:]
    # Chance exceeds 33 with 12 degrees of freedom once in a thousand.
    assert away @ np.linalg.solve(covariance, away) < 33.0
    assert np.sqrt(np.diag(covariance)[6:]).max() < 0.05


def test_an_arm_without_humps_gets_none(worlds):
    built, _, _, _ = worlds[0]
    rng = np.random.default_rng(7)
    streams = [recorded(built, exercise(6, rng), rng) for exercise in (multi_sine, slow_sweep)]
    result = identify(known_arm(), streams, replace(PLAIN, stribeck=True)).identified
    # Each of six joints is taken for one with a hump once in a thousand cases.
    assert not len(result.stribeck.joints)


def test_joints_that_stand_still_are_named():
    rng = np.random.default_rng(8)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    for values in (done.q, done.dq, done.ddq):
        values[:, 3] = 0.0
    with pytest.raises(DegenerateError, match=r"joint 4 \(wrist_1_joint\) stands still") as told:
        identify(known_arm(), [recorded(built, done, rng)])
    assert "visioncal dynamics plan" in told.value.next_step


def test_torques_of_joints_at_rest_count_for_nothing():
    """Three seconds at rest, where friction holds the joints by torques that nothing foretells."""
    rng = np.random.default_rng(10)
    built, moved = real_dynamics("ur5e", rng), multi_sine(6, rng)
    rise = np.clip((moved.times_s - 3.0) / 2.0, 0.0, 1.0)[:, None]
    # A blend of fifth order, and its derivatives.
    blend = rise**3 * (10.0 - 15.0 * rise + 6.0 * rise**2)
    slope = 15.0 * rise**2 * (1.0 - rise) ** 2
    curve = 15.0 * rise * (1.0 - rise) * (1.0 - 2.0 * rise)
    away = moved.q - moved.q.mean(axis=0)
    done = replace(
        moved,
        q=moved.q.mean(axis=0) + blend * away,
        dq=slope * away + blend * moved.dq,
        ddq=curve * away + 2.0 * slope * moved.dq + blend * moved.ddq,
    )
    stream = record(built, done, rng)
    held = built.gears.coulomb * rng.uniform(-0.9, 0.9, 6)

    def hold(columns):
        for joint in range(6):
            columns[f"tau{joint + 1}_nm"][moved.times_s < 3.0] += held[joint]

    sound = condition(read_recorded(changed(stream, hold), "streams/robot.csv", 6))
    assert not sound.used[sound.times_s < 2.5].any()
    result = identify(known_arm(), [sound], PLAIN).identified
    off = result.values - true_base(result.base, built)
    # As for motions that never rest.
    assert off @ np.linalg.solve(result.covariance, off) / len(off) < 1.9


def test_motion_about_one_line_is_named():
    rng = np.random.default_rng(9)
    done = multi_sine(6, rng)
    for values in (done.q, done.dq, done.ddq):
        values[:, 1:] = values[:, :1] * np.array([1e-6, 0.0, 0.0, 0.0, 0.0])
    base = BaseModel.reduce(DynamicModel(known_arm(), TERMS))
    stream = recorded(real_dynamics("ur5e", rng), done, rng, Senses(q_rad=0.0))
    lost = [base.names[index] for index in null_space(base, [block_of(base, stream)])]
    assert "Fc4" in lost
    assert len(lost) > 20


def test_results_survive_the_disk(tmp_path, worlds):
    built, found, fresh, rng = worlds[0]
    stream = recorded(built, fresh, rng)
    prediction = predict(found.identified, stream, fit_friction_to_known(found))
    result = replace(found.identified, validation=validate(found.identified, prediction))
    result.save(tmp_path / "dynamics.json")
    again = Identified.load(tmp_path)
    motion = stream.pieces[0].measured.motion
    assert (again.torques(motion) == result.torques(motion)).all()
    assert (again.consistent_torques(motion) == result.consistent_torques(motion)).all()
    assert again.determined == result.determined
    assert (again.validation.known_rms_nm == result.validation.known_rms_nm).all()
    assert again.streams[0].label == "streams/robot.csv"


@pytest.mark.parametrize(("share", "doubted"), [(0.01, False), (0.05, True)])
def test_what_is_predicted_far_worse_than_fitted_is_doubted_where_it_matters(
    worlds, share, doubted
):
    result = worlds[0][1].identified
    # Ten times the noise in either case, but of quieter drives where it is a hundredth in all.
    range_nm = 10.0 * result.fitted_rms_nm / share
    seen = TorqueValidation("fresh", share * range_nm, range_nm, result.streams[0].noise_nm)
    judged = judge(replace(result, validation=seen))
    assert any("worse than they were fitted" in reason for reason in judged.reasons) is doubted


def test_what_the_maker_publishes_predicts_worse(worlds):
    built, found, fresh, rng = worlds[1]
    prediction = predict(
        found.identified, recorded(built, fresh, rng), fit_friction_to_known(found)
    )
    result = validate(found.identified, prediction)
    assert (result.rms_nm < result.known_rms_nm).all()
    assert (result.shares < 0.03).all()


@pytest.fixture(scope="module")
def panda():
    if not PANDA.is_dir():
        pytest.skip("the recording of a Franka Panda is not there")
    load = partial(np.loadtxt, dtype=float)
    q, dq, torques = (
        load(PANDA / f"{name}.txt").reshape(-1, 7) for name in ("positions", "velocity", "torques")
    )
    return RecordedSamples("streams/panda.csv", load(PANDA / "time.txt"), q, dq, torques)


def test_a_real_panda_is_predicted(panda):
    """First 70 % to train, last 30 % to test, 8 Hz; a plain script's errors are the limits."""
    train, test = condition(panda.part(0.0, 0.7), 8.0), condition(panda.part(0.7, 1.0), 8.0)
    found = identify(load_robot("panda"), [train])
    assert found.identified.base.rank == 64
    result = validate(
        found.identified, predict(found.identified, test, fit_friction_to_known(found))
    )
    limits = np.array([5.0, 1.5, 2.4, 4.9, 6.2, 3.4, 17.9])
    assert (100.0 * result.shares <= limits).all()
    assert found.identified.inertias.consistent
    assert (100.0 * result.consistent_rms_nm / result.torque_nm <= 1.15 * limits).all()
    assert (result.rms_nm < result.known_rms_nm).all()
