"""Mistakes of a record of readings, each named with what mends it; sound ones accused of none."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import crossed, slow
from support.refusals import raised

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert
from visioncal.interchange.formats.mending import shift_views
from visioncal.session import Session
from visioncal.simulation.instrument_session import InstrumentOptions, session_of, tracked

WRONG = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}
POINT = InstrumentOptions(**WRONG)
PROBE = InstrumentOptions(poses=True, **WRONG)
AWAY = exp(np.array([0.2, -0.1, 0.3, 0.5, -0.8, 0.2]))


def of_rows(shop, readings) -> Session:
    """The session of a shop with other readings, by row."""
    rows = tuple((*row[:2], pose) for row, pose in zip(shop.rows, readings, strict=True))
    return session_of(replace(shop, rows=rows))


def read(options) -> tuple:
    """A shop, and what its instrument read by row."""
    shop = tracked(options)
    return shop, np.array([row[2] for row in shop.rows])


def turned(q, signs=(1.0,) * 6, order=range(6), zero=0.0):
    """Joint angles with other signs, in another order, and with another zero of the third."""
    return (q * signs)[:, list(order)] + zero * np.eye(6)[2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: turned(q, (1, 1, -1, 1, 1, 1)), "q3_rad of the opposite sign"),
        (lambda q: turned(q, order=(0, 1, 2, 3, 5, 4)), "the columns q5_rad and q6_rad exchanged"),
        (np.rad2deg, "the angles in degrees"),
        (
            lambda q: turned(q, zero=0.5 * np.pi),
            r"the zero of \w+ \(q3_rad\) moved by -90\.\d+ deg",
        ),
    ],
)
def test_joints_that_are_read_otherwise_are_named_by_one_point_alone(change, words):
    shop = tracked(POINT)
    session = session_of(replace(shop, joints=change(shop.joints)))
    raised(DataError, f"With {words}, they fit what the instrument reads", calibrate, session)


def mirrored(poses):
    return compose(poses[:, :3, :3], poses[:, [0, 2, 1], 3])


def of_other_order(poses):
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return compose(Rotation.from_quat(quaternions).as_matrix(), poses[:, :3, 3])


@pytest.mark.parametrize(
    ("options", "change", "words"),
    [
        (POINT, mirrored, "The instrument's readings are in a left-handed frame"),
        slow(PROBE, mirrored, "The instrument's readings are in a left-handed frame"),
        slow(PROBE, invert, "With the instrument's poses inverse, robot and instrument agree"),
        (PROBE, of_other_order, "With the instrument's rotations as a quaternion w, x, y, z"),
    ],
)
def test_readings_in_another_form_are_named_instead_of_the_arm(options, change, words):
    shop, poses = read(options)
    verdict = calibrate(of_rows(shop, change(poses))).verdict
    assert verdict.status == "bad"
    assert verdict.causes[0].kind == "misread_readings"
    assert verdict.causes[0].words.startswith(words)
    assert "arm_errors" not in {found.kind for found in verdict.findings}


@pytest.mark.slow
@pytest.mark.parametrize(("options", "first"), [(POINT, 0), (POINT, 15), (PROBE, 12)])
def test_readings_one_row_apart_are_named_and_shifted_back(options, first):
    shop, poses = read(options)
    sound = calibrate(session_of(shop))
    shifted = of_rows(shop, np.concatenate([poses[:first], np.roll(poses[first:], 1, axis=0)]))
    cause = calibrate(shifted).verdict.causes[0]
    assert cause.kind == "shifted_rows"
    when = f"From view {first} on" if first else "In all views"
    assert cause.words.startswith(f"{when}, readings and poses are 1 row apart")
    last = len(poses) - 1
    assert f"--shift {first}-{last}:-1" in cause.do.command
    mended = calibrate(shift_views(shifted, range(first, last + 1), -1))
    assert mended.verdict.status == sound.verdict.status == "good"
    away = invert(sound.edges["base_from_instrument"].matrix)
    away = away @ mended.edges["base_from_instrument"].matrix
    # One view of thirty is lost, and the others are the same.
    sigma_m = np.sqrt(np.trace(sound.covariance("base_from_instrument")[3:, 3:]))
    assert np.linalg.norm(away[:3, 3]) < sigma_m


def moved(poses):
    return np.concatenate([poses[:18], AWAY @ poses[18:]])


def in_another_nest(poses):
    nest = compose(np.eye(3), np.array([0.0, 0.05, 0.0]))
    return np.where(np.isin(np.arange(len(poses)), [4, 11, 23])[:, None, None], poses @ nest, poses)


def stale(poses):
    return poses[np.where(np.isin(np.arange(len(poses)), [7, 20]), -1, 0) + np.arange(len(poses))]


CHANGES = [
    (moved, "something_moved", r"from view 18 on, the instrument .* was another one"),
    (in_another_nest, "something_moved", r"in all of these, the probe .*: the probe by 50 mm"),
    (stale, "copied_poses", r"Views 7, 20 have the reading of the row before once more"),
]


@pytest.mark.parametrize(("named", "options"), crossed(CHANGES, [POINT, PROBE]))
def test_groups_of_readings_that_agree_with_one_change_are_named(options, named):
    (change, kind, words), (shop, poses) = named, read(options)
    verdict = calibrate(of_rows(shop, change(poses))).verdict
    assert verdict.causes[0].kind == kind
    assert re.search(words, verdict.causes[0].words)


@pytest.mark.slow
def test_a_calibrated_arm_that_scatters_by_more_than_it_repeats_is_not_good():
    """A load that no column states, or play, leaves a noise that no calibration removes."""
    shaky = replace(POINT, dh_sigma_m=1e-3, dh_sigma_rad=2e-3, robot_sigma_m=6e-4, stops=40)
    verdict = calibrate(session_of(tracked(shaky))).verdict
    assert verdict.status != "good"
    words = " ".join(found.words for found in verdict.findings)
    assert "The arm was calibrated along" in words
    assert "from stop to stop; such arms repeat" in words
