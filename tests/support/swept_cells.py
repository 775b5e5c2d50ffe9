"""Whole cells of which one camera sees a robot's board while it moves, by clocks of their own."""

from dataclasses import replace

from visioncal.simulation import CameraAt, NetworkOptions, SimulatedCell, Swept, simulate

AHEAD_S = 0.037
# At its stops it takes no image.
SIDE = CameraAt("side", place_m=(0.9, 0.1, 1.3), at_stops=False)
HOW = Swept("side", "b", "plate_b", camera_minus_robot_s=AHEAD_S, frames_hz=20.0)


def cell_of(options: NetworkOptions, how: Swept = HOW) -> SimulatedCell:
    """A cell with one more camera, at the side, which sees a board on a moving flange."""
    return simulate(replace(options, cameras=(*options.cameras, SIDE), sweeps=(how,)))
