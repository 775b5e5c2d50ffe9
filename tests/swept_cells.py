"""Whole cells of which one camera sees a robot's board while it moves, by clocks of their own."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from visioncal.session import Session, View
from visioncal.simulation.arms import forward
from visioncal.simulation.boards import corners_m
from visioncal.simulation.layout import CameraAt, NetworkOptions
from visioncal.simulation.network import simulate_network
from visioncal.simulation.network_records import network_session
from visioncal.simulation.optics import project, sees
from visioncal.simulation.seen import Network, camera_named, sheet_named
from visioncal.simulation.sweep import SweepOptions, _in_turn, _recorded
from visioncal.transforms import exp, invert
from visioncal.types import Corners

AHEAD_S = 0.037
SIDE = CameraAt("side", place_m=(0.9, 0.1, 1.3))
HOW = SweepOptions(stops=10, camera_minus_robot_s=AHEAD_S)


def cell_of(options: NetworkOptions) -> Network:
    """A cell with one more camera at the side, which at its stops takes no image."""
    return simulate_network(replace(options, cameras=(*options.cameras, SIDE)))


def swept_session(
    cell: Network, how: SweepOptions = HOW, robot: str = "b", board: str = "plate_b"
) -> tuple[Session, dict[int, Corners]]:
    """The cell's session, in which the camera at the side sees a board on a moving flange."""
    session = network_session(cell, "swept", seen="names")
    corners = {it.view: it for it in cell.corners}
    views = [it for it in session.views if it.text.get("camera") != SIDE.name]
    told = {(it.stop, it.text.get("robot")) for it in views}
    lost = [it for it in session.views if it.text.get("camera") == SIDE.name]
    for it in lost:
        # What these rows told of robots is still needed by the others of their stop.
        if (it.stop, it.text.get("robot")) not in told:
            text = {"robot": it.text["robot"]} if "robot" in it.text else {}
            views.append(View(it.number, stop=it.stop, numbers=dict(it.numbers), text=text))
    rng = np.random.default_rng([31, cell.options.seed])
    stops = _in_turn(cell.joints[robot][: how.stops])
    way = CubicSpline(how.pace_s * np.arange(len(stops)), stops, bc_type="clamped")
    end_s = how.pace_s * (len(stops) - 1)
    robot_s = np.arange(0.0, end_s, 1.0 / how.robot_hz)
    told_q = way(robot_s) + how.encoder_sigma_rad * rng.standard_normal((len(robot_s), 6))
    stream = _recorded(robot_s, told_q, forward(cell.arms[robot], told_q))
    taken_s = np.arange(0.5 / how.frames_hz, end_s, 1.0 / how.frames_hz)
    (arm,) = [it for it in cell.options.robots if it.name == robot]
    sigma = np.repeat([arm.sigma_rad, arm.sigma_m], 3)
    jitter = exp(rng.standard_normal((len(taken_s), 6)) * sigma)
    seen_from = invert(cell.transforms[f"cam_{SIDE.name}"]) @ cell.transforms[f"base_{robot}"]
    optics, sheet = camera_named(cell.options, SIDE.name).camera, sheet_named(cell.options, board)
    number = 1 + max(it.number for it in session.views)
    for stamp_s, off in zip(taken_s.tolist(), jitter, strict=True):
        late_s = np.zeros(len(corners_m(sheet)))
        # When a row is taken depends on where its corner is then: settled after three or four.
        for _ in range(5 if how.readout_s else 1):
            flanges = forward(cell.true_arms[robot], way(stamp_s + late_s)) @ off
            poses = seen_from @ flanges @ cell.transforms[f"target_{board}"]
            points = (poses[:, :3, :3] @ corners_m(sheet)[:, :, None])[:, :, 0] + poses[:, :3, 3]
            rows = project(optics, points)[:, 1]
            late_s = how.readout_s * (rows / (optics.resolution[1] - 1) - 0.5)
        pose = poses[0]
        ids = np.flatnonzero(sees(optics, points, 2.0)).astype(np.int64)
        if len(ids) < 12 or pose[2, 2] < 0.5:
            continue
        px = project(optics, points[ids])
        px = px + cell.options.pixel_sigma_px * rng.standard_normal(px.shape)
        corners[number] = Corners(number, ids, px, 0.7)
        numbers = {"stamp_s": stamp_s + how.camera_minus_robot_s}
        text = {"camera": SIDE.name, "target": board}
        views.append(View(number, image=f"side/{number}.png", numbers=numbers, text=text))
        number += 1
    views.sort(key=lambda it: it.number)
    return replace(session, views=tuple(views)).with_streams({robot: stream}), corners
