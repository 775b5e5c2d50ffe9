"""A sweep: the robot moves without a rest, and camera and controller stamp by clocks of their own.

The flange goes through a cell's stops on a smooth way, with joints of continuous acceleration. The
camera takes frames at its rate, wherever the robot is; the controller reports its joints and poses
at a higher one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.session import Stream as Recorded
from visioncal.simulation.arms import forward
from visioncal.simulation.boards import corners_m
from visioncal.simulation.cell import (
    EDGE_PX,
    Cell,
    Stream,
    before_camera,
    detected,
    simulate,
    stream,
)
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CellOptions
from visioncal.simulation.second import Shown, chains

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
# A frame that shows less of the board gives no pose.
_FEWEST_CORNERS = 8
# In which row a corner is depends on when it is taken: by a few thousandths of itself each time.
_ROUNDS = 4


@dataclass(frozen=True)
class SweepOptions:
    """How a sweep is made.

    Attributes:
        stops: Through how many postures it goes.
        pace_s: How long it takes from one to the next [s].
        robot_hz: Samples of the controller in a second.
        frames_hz: Frames of the camera in a second.
        readout_s: How long after the image's first row the last is taken, the stamp being that of
            the middle [s]; 0 for a global shutter.
        camera_minus_robot_s: What the camera's stamps are ahead of the controller's [s].
        jitter_s: Noise of the camera's stamps, as a standard deviation [s].
        encoder_sigma_rad: Noise of the joint angles that the controller reports [rad].
    """

    stops: int = 12
    pace_s: float = 1.7
    robot_hz: float = 125.0
    frames_hz: float = 30.0
    readout_s: float = 0.0
    camera_minus_robot_s: float = 0.0
    jitter_s: float = 0.0
    encoder_sigma_rad: float = 2e-6

    def __post_init__(self) -> None:
        if self.stops < 2 or min(self.pace_s, self.robot_hz, self.frames_hz) <= 0.0:
            raise DataError("simulation: a sweep needs two stops, and times and rates above 0.")


@dataclass(frozen=True, eq=False)
class Sweep:
    """A simulated sweep.

    Attributes:
        options: How it was made.
        cell: The cell at the m frames, each of them a view.
        frames_s: (m,) when they were taken, by the camera's clock [s].
        robot: What the controller reported: `stamp_s` by its own clock, poses and joints.
    """

    options: SweepOptions
    cell: Cell
    frames_s: FloatArray
    robot: Recorded


def sweep(options: CellOptions, how: SweepOptions | None = None) -> Sweep:
    """Sweeps a cell's robot through as many of its stops as are asked for.

    Args:
        options: The cell; `views` is set by the sweep.
        how: How it is swept.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).joints
    way = CubicSpline(how.pace_s * np.arange(how.stops), in_turn(stops), bc_type="clamped")
    end_s = how.pace_s * (how.stops - 1)
    robot_s = np.arange(0.0, end_s, 1.0 / how.robot_hz)
    taken_s = np.arange(0.5 / how.frames_hz, end_s, 1.0 / how.frames_hz)
    options = replace(options, views=len(taken_s), wrong_views=0)
    frames = simulate(options, way(taken_s))
    if how.readout_s:
        frames = _by_rows(frames, way, taken_s, how.readout_s)
    seen = [at for at, it in enumerate(frames.exact_corners) if len(it.ids) >= _FEWEST_CORNERS]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = taken_s[seen]
    rng = stream(options, Stream.SWEEP)
    reported = way(robot_s) + how.encoder_sigma_rad * rng.standard_normal(
        (len(robot_s), stops.shape[1])
    )
    ahead_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    return Sweep(
        how,
        _only(frames, seen),
        taken_s + ahead_s,
        recorded(robot_s, reported, forward(frames.arm, reported)),
    )


def _by_rows(cell: Cell, way: CubicSpline, taken_s: FloatArray, readout_s: float) -> Cell:
    """The cell with every corner where it was when its row was taken."""
    options, height = cell.options, cell.options.camera.resolution[1]
    jitter = invert(cell.flange_at(cell.joints)) @ cell.true_base_from_flange
    shown, boards = cell.shown, [*chains(cell.transforms)]
    exact = list(cell.exact_corners)
    for at, (stop, board) in enumerate(zip(shown.stops, shown.boards, strict=True)):
        points = corners_m(cell.sheets[board])
        middle = points @ cell.cam_from_target[at, :3, :3].T + cell.cam_from_target[at, :3, 3]
        px = project(options.camera, middle)
        for _ in range(_ROUNDS):
            late_s = readout_s * (px[:, 1] / (height - 1) - 0.5)
            flange = cell.flange_at(way(taken_s[stop] + late_s)) @ jitter[at]
            poses = before_camera(boards[board], flange)
            seen = (poses[:, :3, :3] @ points[:, :, None])[:, :, 0] + poses[:, :3, 3]
            px = project(options.camera, seen)
        ids = np.flatnonzero(sees(options.camera, seen, EDGE_PX))
        exact[at] = replace(exact[at], ids=ids.astype(np.int64), px=px[ids])
    return replace(cell, exact_corners=tuple(exact), corners=detected(options, tuple(exact)))


def _only(cell: Cell, seen: Sequence[int]) -> Cell:
    """The cell with some of its views, numbered anew."""
    exact, found = (
        tuple(replace(corners[at], view=view) for view, at in enumerate(seen))
        for corners in (cell.exact_corners, cell.corners)
    )
    return replace(
        cell,
        options=replace(cell.options, views=len(seen)),
        joints=cell.joints[seen],
        base_from_flange=cell.base_from_flange[seen],
        true_base_from_flange=cell.true_base_from_flange[seen],
        cam_from_target=cell.cam_from_target[seen],
        exact_corners=exact,
        corners=found,
        shown=Shown(np.arange(len(seen)), cell.shown.boards[seen]),
    )


def in_turn(stops: FloatArray) -> FloatArray:
    """Orders postures so that each is the nearest to the one before of those that are left."""
    left = list(range(1, len(stops)))
    order = [0]
    while left:
        away = [float(np.abs(stops[at] - stops[order[-1]]).max()) for at in left]
        order.append(left.pop(int(np.argmin(away))))
    return stops[order]


def recorded(stamps_s: FloatArray, joints: FloatArray, poses: FloatArray) -> Recorded:
    """The controller's stream; a quaternion does not jump to its negative."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    quaternions[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    names = [f"q{at + 1}_rad" for at in range(joints.shape[1])]
    values = np.hstack([stamps_s[:, None], poses[:, :3, 3], quaternions, joints])
    return Recorded(("stamp_s", *POSE, *names), values)
