"""What a session says of the moments of its stops: motion, loads, sides of approach, times."""

from dataclasses import replace

import numpy as np
import pytest
from support.core_worker import on_one_clock

from visioncal.core.transforms import invert, log
from visioncal.model import Arm, read_cell
from visioncal.robot import Loads
from visioncal.simulation import CellOptions, Payload, SweepOptions, cell_session, simulate, sweep

CARRIED = (Payload(), Payload(5.0, (0.0, 0.02, 0.1), (0.0, 0.0, -20.0)))


def test_loads_and_sides_are_those_of_the_rows():
    options = CellOptions(views=6, payloads=CARRIED, backlash_rad=(1e-3,) * 6, pixel_sigma_px=0.1)
    made = simulate(options)
    session = cell_session(made, "carrying", seen="corners")
    cell = read_cell(session, session.corners)
    loads, sides = cell.moments.loads["flange"], cell.moments.sides["flange"]
    assert loads.payload_kg.tolist() == [0.0, 5.0] * 3
    assert loads.payload_m[1] == pytest.approx([0.0, 0.02, 0.1])
    assert loads.force_n[3] == pytest.approx([0.0, 0.0, -20.0])
    assert sides.tolist() == np.repeat(made.robot.approach[:, None], 6, axis=1).tolist()
    some = cell.moments.take(np.array([3, 0]))
    assert some.loads["flange"].payload_kg.tolist() == [5.0, 0.0]
    assert some.sides["flange"].tolist() == sides[[3, 0]].tolist()


def test_joints_come_from_where_they_moved_last():
    joints = np.array([[0.0, 0.5], [0.1, 0.4], [0.1 + 1e-6, 0.3], [0.0, 0.0], [-0.2, 0.6]])
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[3] = np.nan
    arm = Arm("flange", poses, joints)
    # From below where it rose; nothing is known of the first stop, nor of one without a pose.
    assert arm.sides.tolist() == [[0, 0], [-1, 1], [-1, 1], [0, 0], [1, -1]]
    stated = replace(Loads.none(5), side=np.array([1.0, -1.0, 0.0, 0.0, 1.0]))
    loaded = replace(arm, loads=stated)
    assert loaded.sides[:, 1].tolist() == [1, -1, 0, 0, 1]


def test_a_sweep_has_rates_that_move_the_flange_from_one_time_to_another():
    made = sweep(CellOptions(pixel_sigma_px=0.1), SweepOptions(stops=4, camera_minus_robot_s=0.04))
    raw = cell_session(made, "swept", seen="corners")
    session, (swept,) = on_one_clock(raw)
    cell = read_cell(session, raw.corners, (swept,))
    rates = cell.moments.rates["cam", "flange"]
    assert 0.05 < np.linalg.norm(rates[:, 3:], axis=1).max() < 2.0
    assert not np.isnan(cell.moments.stamps_s).any()
    # By the controller's own samples on both sides of each image, at 125 Hz.
    (stream,) = raw.streams.values()
    at_s, poses = stream.poses()
    before = np.searchsorted(at_s, cell.moments.stamps_s - 0.04) - 1
    moved = log(invert(poses[before]) @ poses[before + 1])
    # Rates are means over 40 ms: of accelerations up to 4 rad/s^2, at one end of a sample.
    assert rates == pytest.approx(moved / np.diff(at_s)[before][:, None], abs=0.03)
