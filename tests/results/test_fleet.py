"""What stands out of a fleet, from made-up rows."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.results.fleet import FleetRow, with_outliers


def row(robot, week, rng, **changes):
    """A session of a sound robot; levels of noise from some twenty stops differ by a sixth."""
    levels = np.exp(rng.normal(0.0, 0.16, 4)).tolist()
    made = FleetRow(
        name=f"robot_{robot}/week_{week:02d}",
        session="",
        state="done",
        verdict="good",
        robot="ur10e",
        camera="1280 x 800",
        views=20,
        used=20,
        noise_mm=0.03 * levels[0],
        noise_deg=0.003 * levels[1],
        noise_px=0.1 * levels[2],
        residual_mm=0.06 * levels[3],
        focal_px=914.0 * float(np.exp(rng.normal(0.0, 0.003))),
    )
    return replace(made, **changes)


def fleet(seed):
    rng = np.random.default_rng(seed)
    return [row(robot, week, rng) for robot in range(10) for week in range(20)]


def test_of_a_sound_fleet_few_sessions_stand_out():
    """Six figures of 200 sessions; one in a thousand lies beyond 3.5 spreads of 0.2 by chance."""
    standing = [
        outlier
        for seed in range(5)
        for outlier in with_outliers(fleet(seed))
        if outlier.score > 0.0
    ]
    assert len(standing) <= 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise_mm": 0.15, "residual_mm": 0.3}, "noise of the robot 0.15 mm, where 0.03 mm"),
        ({"arm_mm": 0.9}, "errors of the arm 0.9 mm, where 0.2 mm is usual"),
        ({"focal_px": 870.0}, "focal length 870 px, where 914 px is usual"),
        ({"drift_mm": 0.4}, "drift of the arm 0.4 mm, where 0.05 mm is usual"),
    ],
)
def test_the_odd_robot_comes_first(changes, words):
    rows = [replace(item, arm_mm=0.2, drift_mm=0.05) for item in fleet(1)]
    rows = [replace(item, **changes) if item.group == "robot_7" else item for item in rows]
    found = with_outliers(rows)
    assert {item.group for item in found[:20]} == {"robot_7"}
    assert all(words in item.stands_out for item in found[:20])
    # What is better than usual, or of another camera, is no fault.
    quiet = [
        replace(item, noise_mm=0.001) if item.group == "robot_7" else item for item in fleet(1)
    ]
    assert not any("noise" in outlier.stands_out for outlier in with_outliers(quiet))
    wide = {"camera": "640 x 480", "focal_px": 457.0}
    other = [replace(item, **wide) if item.group == "robot_7" else item for item in fleet(1)]
    assert not any("focal" in outlier.stands_out for outlier in with_outliers(other))
