"""From recorded samples to motions and torques: filters, clocks, lags, mistaken samples."""

from dataclasses import replace

import numpy as np
import pytest
from support.moved_arms import changed, robot_with_bodies
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import LowPass, condition
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.identify import Options, find_lag
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.reading import read_recorded
from visioncal.session import Stream
from visioncal.simulation.dynamics import (
    Senses,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)

RATE_HZ = 500.0


@pytest.fixture(scope="module")
def moved():
    rng = np.random.default_rng(5)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    return done, record(built, done, rng)


def conditioned(stream, **more):
    return condition(read_recorded(stream, "streams/robot.csv", 6), **more)


def test_the_filter_passes_its_band_and_shifts_nothing():
    lowpass, times_s = LowPass.of(8.0, RATE_HZ), np.arange(4000) / RATE_HZ
    for hz, wanted in ((0.0, 1.0), (3.5, 1.0), (8.0, 0.5), (13.0, 0.0)):
        out = lowpass(np.cos(2.0 * np.pi * hz * times_s))
        at = times_s[lowpass.half :: lowpass.step][: len(out)]
        # 60 dB of attenuation and a ripple as small; half at the cut-off by symmetry.
        assert out == pytest.approx(wanted * np.cos(2.0 * np.pi * hz * at), abs=4e-3)


def test_the_filter_knows_what_it_leaves_of_white_noise():
    lowpass = LowPass.of(8.0, RATE_HZ)
    out = lowpass(np.random.default_rng(1).standard_normal(1_500_000))
    seen = [float(out[lag:] @ out[:-lag] / (out @ out)) for lag in (1, 2, 3)]
    # A correlation of 48,000 samples is known to 0.005.
    assert seen == pytest.approx(lowpass.correlation[:3], abs=0.02)


@pytest.mark.parametrize("senses", [Senses(), Senses(q_rad=1e-4, dq_rad_s=None)])
def test_motions_are_recovered(senses):
    rng = np.random.default_rng(6)
    done = multi_sine(6, rng)
    found = conditioned(record(real_dynamics("ur5e", rng), done, rng, senses))
    motion = found.pieces[0].measured.motion
    begin = int(np.searchsorted(done.times_s, motion.times_s[0] - 1e-6))
    rows = slice(begin, begin + len(motion))
    # Noise of 1e-5 rad at 500 Hz, smoothed over a third of a second, leaves a few 1e-4 of speeds
    # and accelerations that range to 2; ten times the noise leaves ten times as much.
    size = max(senses.q_rad / 1e-5, 1.0)
    for got, true, most in (
        (motion.q, done.q, 3e-6 * size),
        (motion.dq, done.dq, 4e-4 * size),
        (motion.ddq, done.ddq, 1e-3 * size),
    ):
        assert np.sqrt(np.mean((got - true[rows]) ** 2)) < most


def test_a_clock_that_jitters_is_evened():
    rng = np.random.default_rng(7)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    true = record(built, done, rng, Senses(q_rad=0.0, torque_share=0.0, dq_rad_s=None))
    uneven = np.sort(done.times_s + rng.uniform(-0.4, 0.4, len(done.times_s)) / RATE_HZ)
    values = [np.interp(uneven, true.stamps_s, true[name]) for name in true.columns[1:]]
    stream = Stream(true.columns, np.column_stack([uneven, *values]))
    found = conditioned(stream)
    motion = found.pieces[0].measured.motion
    ddq = np.stack(
        [np.interp(motion.times_s, done.times_s, column) for column in done.ddq.T], axis=1
    )
    # Straight lines between samples 2 ms apart bend by 2e-6 rad at 4 rad/s^2.
    assert np.abs(motion.ddq - ddq).max() < 0.02


def test_nothing_is_interpolated_across_gaps(moved):
    _, stream = moved
    rows = np.ones(len(stream), dtype=bool)
    rows[4000:4200] = False
    found = conditioned(Stream(stream.columns, stream.values[rows]))
    assert len(found.pieces) == 2
    assert "samples are missing for up to 0.402 s behind 8.00 s" in found.notes[0]
    gap = (found.times_s > 7.998) & (found.times_s < 8.4)
    assert not gap.any()


def test_torques_of_joints_at_rest_are_not_used():
    resolved_rad = 1e-4
    rng = np.random.default_rng(12)
    built, done = real_dynamics("ur5e", rng), slow_sweep(6, rng)
    # To rest and off again, from 20 s to 23 s, with as much as a controller's own ramps take.
    way = np.interp(done.times_s, [0.0, 20.0, 23.0, 60.0], [0.0, 20.0, 20.0, 57.0])
    way = np.convolve(np.pad(way, 50, mode="edge"), np.ones(101) / 101.0, mode="valid")

    def round_off(columns):
        for joint in range(1, 7):
            angles = np.interp(way, done.times_s, columns[f"q{joint}_rad"])
            columns[f"q{joint}_rad"] = np.round(angles / resolved_rad) * resolved_rad

    stream = record(built, done, rng, Senses(q_rad=0.0, dq_rad_s=None))
    found = conditioned(changed(stream, round_off))
    # Friction holds a joint at rest by torques that nothing foretells.
    assert not found.used[(found.times_s > 20.8) & (found.times_s < 22.2)].any()


def test_saturated_torques_are_named_and_left_out(moved):
    _, stream = moved

    def cut_off(columns):
        columns["tau2_nm"] = np.clip(columns["tau2_nm"], None, 40.0)

    found = conditioned(changed(stream, cut_off))
    assert "tau2" in found.notes[0]
    assert "saturated" in found.notes[0]
    used = found.used.mean(axis=0)
    assert used[1] < 0.95
    assert (used[[0, 2, 3, 4, 5]] == 1.0).all()
    at_limit = conditioned(stream, limits_nm=np.array([150.0, 60.0, 150.0, 28.0, 28.0, 28.0]))
    assert 0.5 < at_limit.used[:, 1].mean() < 0.95
    # Beyond a limit nearly all the time: that is another unit, which is named elsewhere.
    in_thousandths = conditioned(stream, limits_nm=np.full(6, 0.15))
    assert in_thousandths.used.all()


def test_speeds_that_are_none_of_the_angles_are_left_out(moved):
    _, stream = moved

    def degrees(columns):
        for joint in range(1, 7):
            columns[f"dq{joint}_rad_s"] *= 180.0 / np.pi

    found = conditioned(changed(stream, degrees))
    assert "dq1_rad_s ... are not the speeds" in found.notes[0]
    assert np.abs(found.pieces[0].measured.motion.dq).max() < 2.1


def without(*names):
    def change(columns):
        for name in names:
            del columns[name]

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("tau4_nm"), "lacks tau4_nm: the robot has 6 joints"),
        (without("q6_rad", "tau6_nm"), "lacks q6_rad, tau6_nm"),
        (lambda value: value.update(q7_rad=value["q1_rad"]), "has q7_rad, but the robot has 6"),
    ],
)
def test_missing_and_surplus_joints_are_named(moved, change, words):
    raised(DataError, words, conditioned, changed(moved[1], change))


def test_stamps_of_another_unit_are_refused(moved):
    def scale(columns):
        columns["stamp_s"] *= 1e3

    told = raised(DataError, "its samples are 2 s apart", conditioned, changed(moved[1], scale))
    assert "divide by 1000" in told.next_step


def test_short_recordings_are_refused(moved):
    _, stream = moved
    short = Stream(stream.columns, stream.values[:400])
    with pytest.raises(DataError, match=r"the longest part without gaps lasts 0\.8 s"):
        conditioned(short, cutoff_hz=4.0)


TORQUE, ANGLE, SPEED = "tau{}_nm", "q{}_rad", "dq{}_rad_s"
ALL = range(1, 7)


def check(stream, name="ur5e", *, with_inertias=True):
    robot = robot_with_bodies(nominal_dynamics(name))
    robot = robot if with_inertias else replace(robot, inertias=None)
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms()))
    check_recording(base, [condition(read_recorded(stream, "streams/robot.csv", 6))])


def swapped(one, other, *groups):
    def change(columns):
        for group in groups:
            first, second = group.format(one), group.format(other)
            columns[first], columns[second] = columns[second].copy(), columns[first].copy()

    return change


def scaled(by, joints, *groups):
    def change(columns):
        for name in (group.format(joint) for group in groups for joint in joints):
            columns[name] *= by

    return change


@pytest.fixture(scope="module")
def stream():
    rng = np.random.default_rng(1)
    return record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (swapped(1, 2, TORQUE), "the torques of joints 1 and 2 are swapped"),
        (swapped(3, 4, ANGLE, SPEED), "the angles of joints 3 and 4 are swapped"),
        (swapped(5, 6, TORQUE, ANGLE, SPEED), "joints 5 and 6 are swapped, with angles"),
        (scaled(-1.0, [2], TORQUE), "the torque of joint 2 has the other sign"),
        (scaled(-1.0, [3], ANGLE, SPEED), "the angle of joint 3 has the other sign"),
        (scaled(-1.0, ALL, TORQUE), "all torques have the other sign"),
        (scaled(57.2958, ALL, ANGLE, SPEED), "angles are in degrees"),
        (scaled(1000.0, ALL, TORQUE), "times what .* need; are they mN m, or mA for A"),
        (scaled(1000.0, [3], TORQUE), "the torques of joint 3 are .* mN m, or mA for A"),
        (scaled(0.01, ALL, TORQUE), "of the motors, before gears of a ratio of about (9|10)"),
    ],
)
def test_mistakes_are_named(stream, change, words):
    raised(DataError, words, check, changed(stream, change))


def test_mistakes_are_named_without_inertias(stream):
    """No inertias at all explain them: only a scale of all torques is open."""
    degrees = changed(stream, scaled(57.2958, ALL, ANGLE, SPEED))
    raised(DataError, "angles are in degrees", check, degrees, with_inertias=False)


@pytest.mark.parametrize(
    ("seed", "motion", "with_inertias"), [(0, multi_sine, False), (1, slow_sweep, True)]
)
def test_right_recordings_pass(seed, motion, with_inertias):
    name = "ur10e" if seed % 2 else "ur5e"
    rng = np.random.default_rng(10 + seed)
    stream = record(real_dynamics(name, rng, stribeck=True), motion(6, rng), rng)
    check(stream, name, with_inertias=with_inertias)


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


def lag_of(stream, name="ur5e"):
    rows = read_recorded(stream, "streams/robot.csv", 6)
    return find_lag(robot_with_bodies(nominal_dynamics(name)), [condition(rows)], TERMS)


@pytest.mark.parametrize(("lag_s", "whole"), [(-0.03, False), (0.2, True)])
def test_lags_are_found_to_their_sigmas(lag_s, whole):
    away = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stream = record(real_dynamics("ur5e", rng), multi_sine(6, rng, rate_hz=250.0), rng)
        lag = lag_of(late(stream, lag_s) if whole else some_of(late(stream, lag_s), rng))
        away.append((lag.seconds - lag_s) / lag.sigma_s)
        # Three in a hundred of noise, and dry friction that turns within milliseconds.
        assert lag.sigma_s < 4e-4
        # Motions of 0.1 to 0.25 Hz turn by 0.6 to 1.6 rad a second; dry friction adds its jumps.
        assert 0.5 * abs(lag_s) < lag.share < 4.0 * abs(lag_s)
    # Chance does it once in 150,000 draws; sigmas know nothing of the noise that angles leave in
    # the regressor.
    assert np.abs(away).max() < 4.5


def test_torques_in_time_have_none():
    rng = np.random.default_rng(4)
    built = real_dynamics("ur5e", rng, stribeck=True)
    assert lag_of(record(built, multi_sine(6, rng), rng)) is None


def test_what_no_lag_mends_has_none():
    rng = np.random.default_rng(5)
    stream = late(record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng), 0.08)
    turned = [column for column in stream.columns if column.startswith("tau")]

    def shuffle(columns):
        kept = {name: columns[name] for name in turned}
        for name, other in zip(turned, [*turned[1:], turned[0]], strict=True):
            columns[name] = kept[other]

    assert lag_of(changed(stream, shuffle)) is None
