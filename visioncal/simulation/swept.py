"""A camera of a simulated cell that takes frames while a robot moves, by a clock of its own."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.interpolate import CubicSpline

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert
from visioncal.core.types import Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.simulation.arms import forward
from visioncal.simulation.boards import corners_m, found_in_part
from visioncal.simulation.layout import CELL, Swept
from visioncal.simulation.observed_points import Network, Sight, camera_named, sheet_named
from visioncal.simulation.optics import project, sees
from visioncal.simulation.standing import Stream, stream
from visioncal.simulation.sweep import SweepOptions, in_turn, recorded

# A frame that shows less of the board, or shows it more askew, is not recorded.
_FEWEST_CORNERS, _FACING, _EDGE_PX = 12, 0.5, 2.0
# When a row is taken depends on where its corner is then: settled after three or four rounds.
_ROUNDS = 5


def sweep_network(
    cell: Network, swept: Swept, transforms: Mapping[str, FloatArray], first_view: int
) -> tuple[list[Sight], Recorded]:
    """The frames of one camera while one robot goes through its stops, and the robot's stream.

    Args:
        cell: The cell at its stops.
        swept: What moves, and what is seen.
        transforms: (4, 4) where each frame hangs in its parent, once all is pushed.
        first_view: The first frame's number.

    Raises:
        DataError: There is no such thing, or that robot does not move the one before the other.
    """
    options, how = (
        cell.options,
        SweepOptions(
            swept.stops, swept.pace_s, frames_hz=swept.frames_hz, readout_s=swept.readout_s
        ),
    )
    seen_from = _chain(cell, swept, transforms)
    at = [it.name for it in options.robots].index(swept.robot)
    robot, rng = options.robots[at], stream(options, Stream.SWEEP, at)
    stops = in_turn(cell.joints[swept.robot][: how.stops])
    way = CubicSpline(how.pace_s * np.arange(len(stops)), stops, bc_type="clamped")
    end_s = how.pace_s * (len(stops) - 1)
    robot_s = np.arange(0.0, end_s, 1.0 / how.robot_hz)
    reported = way(robot_s)
    reported = reported + how.encoder_sigma_rad * rng.standard_normal(reported.shape)
    sigma = np.repeat([robot.sigma_rad, robot.sigma_m], 3)
    optics, sheet = camera_named(options, swept.camera).camera, sheet_named(options, swept.target)
    corners = corners_m(sheet)
    fewest = _FEWEST_CORNERS if found_in_part(sheet.target) else len(corners)
    sights: list[Sight] = []
    for taken_s in np.arange(0.5 / how.frames_hz, end_s, 1.0 / how.frames_hz).tolist():
        off, late_s = exp(sigma * rng.standard_normal((1, 6))), np.zeros(len(corners))
        for _ in range(_ROUNDS if how.readout_s else 1):
            flanges = forward(cell.true_arms[swept.robot], way(taken_s + late_s)) @ off
            poses = seen_from(flanges)
            points = (poses[:, :3, :3] @ corners[:, :, None])[:, :, 0] + poses[:, :3, 3]
            rows = project(optics, points)[:, 1]
            late_s = how.readout_s * (rows / (optics.resolution[1] - 1) - 0.5)
        middle = seen_from(forward(cell.true_arms[swept.robot], way([taken_s])) @ off)[0]
        ids = np.flatnonzero(sees(optics, points, _EDGE_PX)).astype(np.int64)
        if len(ids) < fewest or middle[2, 2] < _FACING:
            continue
        view = first_view + len(sights)
        exact = Corners(view, ids, project(optics, points[ids]), 0.7)
        noise = options.pixel_sigma_px * rng.standard_normal(exact.px.shape)
        found = Corners(view, ids, exact.px + noise, 0.7)
        stamp_s = taken_s + swept.camera_minus_robot_s
        names = swept.camera, swept.target
        sights.append(Sight(view, -1, *names, middle, exact, found, stamp_s=stamp_s))
    return sights, recorded(robot_s, reported, forward(cell.arms[swept.robot], reported))


def _chain(
    cell: Network, swept: Swept, transforms: Mapping[str, FloatArray]
) -> Callable[[FloatArray], FloatArray]:
    """Where the target (k, 4, 4) is before the camera, by (k, 4, 4) `base_from_flange`."""
    there = {
        "robot": [it.name for it in cell.options.robots],
        "camera": [it.name for it in cell.options.cameras],
        "target": [it.name for it in cell.options.boards],
    }
    for kind, name in (("robot", swept.robot), ("camera", swept.camera), ("target", swept.target)):
        if name not in there[kind]:
            raise DataError(
                f"simulation: a sweep is of {kind} {name!r}; there are {', '.join(there[kind])}."
            )
    flange = frame_name("flange", swept.robot)
    ends = frame_name("camera", swept.camera), frame_name("target", swept.target)
    on = [cell.parents[it] for it in ends]
    if sorted(on) != sorted((CELL, flange)):
        raise DataError(
            f"simulation: of camera {swept.camera} and target {swept.target} of a sweep, one has "
            f"to be on robot {swept.robot} and the other in the cell."
        )
    base = transforms[frame_name("base", swept.robot)]

    def seen_from(flanges: FloatArray) -> FloatArray:
        cam, target = (
            base @ flanges @ transforms[end] if parent == flange else transforms[end]
            for end, parent in zip(ends, on, strict=True)
        )
        return np.asarray(invert(cam) @ target)

    return seen_from
