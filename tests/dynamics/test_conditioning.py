"""From recorded samples to motions and torques: filters, clocks, and what is wrong with samples."""

import numpy as np
import pytest
from support.moved_arms import changed

from visioncal.core.errors import DataError
from visioncal.dynamics.conditioning import LowPass, condition
from visioncal.dynamics.reading import read_recorded
from visioncal.session import Stream
from visioncal.simulation.dynamics import (
    Senses,
    drive_torques,
    multi_sine,
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


def test_the_band_is_the_highest_harmonic(moved):
    _, stream = moved
    found = conditioned(stream)
    # Five harmonics of 0.05 Hz; a window of 20 s blurs a line by 0.05 Hz to either side.
    assert 0.2 <= found.band_hz <= 0.35
    assert found.rate_hz == pytest.approx(RATE_HZ)
    assert not found.notes


@pytest.mark.parametrize("senses", [Senses(), Senses(dq_rad_s=None), Senses(q_rad=1e-4)])
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
        (motion.dq, done.dq, 4e-4),
        (motion.ddq, done.ddq, 1e-3 * size),
    ):
        assert np.sqrt(np.mean((got - true[rows]) ** 2)) < most


def test_a_clock_that_jitters_is_named_and_evened():
    rng = np.random.default_rng(7)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    true = record(built, done, rng, Senses(q_rad=0.0, torque_share=0.0, dq_rad_s=None))
    uneven = np.sort(done.times_s + rng.uniform(-0.4, 0.4, len(done.times_s)) / RATE_HZ)
    values = [np.interp(uneven, true.stamps_s, true[name]) for name in true.columns[1:]]
    stream = Stream(true.columns, np.column_stack([uneven, *values]))
    found = conditioned(stream)
    assert "steps of its clock differ by" in found.notes[0]
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


@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_angles_are_interpolated_where_few_samples_are_lost_and_torques_are_not(rate_hz):
    rng = np.random.default_rng(11)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng, rate_hz=rate_hz)
    stream = record(built, done, rng, Senses(q_rad=0.0, torque_share=0.0, dq_rad_s=None))
    kept = np.sort(rng.permutation(len(stream))[: 4 * len(stream) // 5])
    whole, found = conditioned(stream), conditioned(Stream(stream.columns, stream.values[kept]))
    (note,) = found.notes
    assert "20 % of its samples are missing here and there" in note
    assert found.band_hz == pytest.approx(whole.band_hz, abs=0.06)
    assert len(found.pieces) == 1
    assert found.used.all()
    assert found.rate_hz == pytest.approx(rate_hz)

    def true(motion):
        return drive_torques(built, motion.q, motion.dq, motion.ddq)

    away = np.sqrt(np.mean((found.torques_nm - found.filtered(true)) ** 2, axis=0))
    # Both are sums over the same samples. What is left is of speeds that turn their sign a little
    # early or late, in the whole stream as in this one.
    before = np.sqrt(np.mean((whole.torques_nm - whole.filtered(true)) ** 2, axis=0))
    assert (away < 1.5 * before + 1e-3 * np.std(found.torques_nm, axis=0)).all()


def test_rows_with_frozen_angles_are_named_and_left_out(moved):
    _, stream = moved

    def freeze(columns):
        for joint in (2, 5):
            columns[f"q{joint}_rad"][4000:4300] = columns[f"q{joint}_rad"][4000]

    found = conditioned(changed(stream, freeze))
    assert "angles are frozen for up to 0.6 s behind 8.00 s" in found.notes[0]
    assert "these 299 rows are left out" in found.notes[0]
    assert len(found.pieces) == 2
    assert not ((found.times_s > 8.0) & (found.times_s < 8.6)).any()


@pytest.mark.parametrize("resolved_rad", [1e-6, 1e-4, 1e-3])
def test_joints_that_turn_round_or_rest_are_not_frozen(resolved_rad):
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
    assert not any("frozen" in note for note in conditioned(changed(stream, round_off)).notes)


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


def test_slips_of_single_samples_are_mended_and_counted(moved):
    _, stream = moved

    def slip(columns):
        columns["tau3_nm"][[1000, 2000, 7000]] += 300.0

    found, plain = conditioned(changed(stream, slip)), conditioned(stream)
    assert "tau3 (3 times)" in found.notes[0]
    # A sample becomes the median of its neighbours: off by the noise, of which the filter takes
    # one part in a hundred.
    noise = 0.03 * float(np.sqrt(np.mean(stream["tau3_nm"] ** 2)))
    assert np.abs(found.torques_nm - plain.torques_nm).max() < 0.05 * noise


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
        (
            lambda value: value.update(q7_rad=value["q1_rad"]),
            "has q7_rad, but the robot has 6 joints",
        ),
    ],
)
def test_missing_and_surplus_joints_are_named(moved, change, words):
    with pytest.raises(DataError, match=words):
        conditioned(changed(moved[1], change))


@pytest.mark.parametrize(
    ("per_s", "words", "step"),
    [
        (1e3, r"2 s apart, which looks like milliseconds \(500 samples a second\)", "by 1000."),
        (1e6, r"2000 s apart, which looks like microseconds \(500 samples", "by 1000000."),
        (1e9, r"2e\+06 s apart, which looks like nanoseconds \(500 samples", "by 1000000000."),
        (1e15, r"which looks like no time in seconds", "stamp_s is in seconds."),
    ],
)
def test_stamps_of_another_unit_are_named(moved, per_s, words, step):
    def scale(columns):
        columns["stamp_s"] *= per_s

    with pytest.raises(DataError, match=words) as told:
        conditioned(changed(moved[1], scale))
    assert told.value.next_step.endswith(step)


def test_currents_need_gains():
    rng = np.random.default_rng(8)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    gains = (10.0, 10.0, 9.0, 7.0, 7.0, 7.0)
    stream = record(built, done, rng, Senses(gains_nm_a=gains))
    with pytest.raises(DataError, match="currents and no torques; 6 gains"):
        read_recorded(stream, "streams/robot.csv", 6)
    found = read_recorded(stream, "streams/robot.csv", 6, gains)
    assert found.of_currents
    assert found.torques_nm[:, 3] == pytest.approx(7.0 * stream["current4_a"])


def test_short_recordings_are_refused(moved):
    _, stream = moved
    short = Stream(stream.columns, stream.values[:400])
    with pytest.raises(DataError, match=r"the longest part without gaps lasts 0\.8 s"):
        conditioned(short, cutoff_hz=4.0)
