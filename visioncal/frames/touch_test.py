"""Touch test: measured gaps between the tool's tip and points that the camera locates.

The gaps contain the errors of the complete chain from pixels to the tip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, listed, rounded_up
from visioncal.core.prediction import point_jacobian, through
from visioncal.core.quantiles import FALSE_REJECTION, chi2_limit, radius95
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.frames.frame_from_images import seen_frame
from visioncal.frames.touches import Tool, robot_noise
from visioncal.results import Calibration, Edge, Frame
from visioncal.results.boards import shape_seen
from visioncal.results.sections import TouchedPoint, TouchTest
from visioncal.robot.collision import camera_body
from visioncal.session import Session
from visioncal.vision.board_shape import shaped_corners

# Least gap that is read [mm].
_LEAST_READ_MM = 0.01
# Greatest one [mm]: ten times what the verdict calls bad. Beyond it the unit is another, or the
# clearance was not taken off.
_LARGEST_MM = 100.0


@dataclass(frozen=True, eq=False)
class TouchPoint:
    """Point of a board to be touched."""

    name: str  # The point's name on the board.
    base_m: FloatArray  # (3,) position in the base by the camera [m].
    # (4, 4) flange pose with the tip on it and the tool's z into the board.
    base_from_flange: FloatArray
    radius95_mm: float  # Predicted gap that 95 % do not exceed [mm].


@dataclass(frozen=True, eq=False)
class TouchTargets:
    """Points of a board, and what the flange carries to them."""

    points: tuple[TouchPoint, ...]
    board: Frame  # The board in the base, its z into it.

    def above(self, point: TouchPoint, height_m: float) -> FloatArray:
        """(4, 4) flange pose with the tip `height_m` above a point along the board's normal."""
        lifted = point.base_from_flange.copy()
        lifted[:3, 3] -= height_m * self.board.edge.matrix[:3, 2]
        return lifted


def flange_extent_m(calibration: Calibration, tool: Tool | None = None) -> float:
    """How far the camera and the tool reach beyond the flange, along its z or the tool's [m].

    Without a tool, any tool of the calibration may be mounted.
    """
    frames = calibration.frames.items()
    tools = [frame.edge for name, frame in frames if name.startswith("flange_from_")]
    tips = tools if tool is None else [tool.edge]
    parts = [np.zeros((1, 3)), *(tip.matrix[None, :3, 3] for tip in tips)]
    if calibration.mount == "eye-in-hand":
        parts.append(camera_body(0, calibration.edges["flange_from_cam"].matrix).corners())
    direction = np.array([0.0, 0.0, 1.0]) if tool is None else tool.edge.matrix[:3, 2]
    return float((np.vstack(parts) @ direction).max())


def touch_targets(
    session: Session,
    calibration: Calibration,
    tool: Tool | None = None,
    clearance_m: float | None = None,
) -> TouchTargets:
    """Locates five points of a session's board, with the flange poses that bring the tip onto each.

    Without a tool, the tip is `clearance_m` before the flange along its z: a gauge of that length
    closes the gap, and the flange comes no nearer.

    Raises:
        DataError: No image is usable; there is neither a tool nor a clearance; or something that is
            known on the flange would be in the board when the tip touches it.
    """
    extent_m = flange_extent_m(calibration, tool)
    if tool is None and clearance_m is None:
        raise DataError(
            "touch-test: which tool touches is not known, and without one the flange itself, with "
            "all that it carries, would be sent onto the board.",
            culprits=["--tool"],
            next_step="Find the tip first (visioncal tcp TOUCHES -c OUT --name gripper), or keep "
            "the flange away by more than all that it carries: --tool none --clearance-mm "
            f"{np.ceil(1e3 * extent_m):.0f} or more; so far are the parts that are known.",
        )
    pin = compose(np.eye(3), np.array([0.0, 0.0, clearance_m or 0.0]))
    tip = Edge(pin, np.zeros((6, 6))) if tool is None else tool.edge
    reach_m = float(tip.matrix[:3, 3] @ tip.matrix[:3, 2])
    if reach_m < extent_m:
        named = "--clearance-mm" if tool is None else tool.name
        raise DataError(
            f"touch-test: {named} is {1e3 * reach_m:.0f} mm before the flange, and what it carries "
            f"(the camera and tools) reaches to {1e3 * extent_m:.0f} mm: it would be in the board.",
            culprits=[named],
            next_step="Touch with a longer tool, or with a gauge: --tool none --clearance-mm "
            f"{np.ceil(1e3 * extent_m):.0f} or more.",
        )
    board = next(iter(session.boards.values()), None)
    if board is None:
        raise DataError(
            f"session {session.name!r} names no board to touch.",
            culprits=["session.toml: target"],
            next_step="Name it in session.toml.",
        )
    frame = seen_frame(session, calibration, "fixture")
    turn_rad, shift_m = robot_noise(calibration).robots[0]
    # The robot's noise at the stop and the tip's covariance.
    variance = shift_m**2 + (turn_rad * np.linalg.norm(tip.matrix[:3, 3])) ** 2
    independent = variance * np.eye(3) + tip.covariance[3:, 3:]
    rotation = frame.edge.matrix[:3, :3]
    points = []
    # The four outermost corners, and the one nearest to the middle.
    places = shaped_corners(board, shape_seen(calibration, board))
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    chosen = [int(np.argmax((places - middle)[:, :2] @ sign)) for sign in signs]
    chosen.append(int(np.argmin(np.linalg.norm(places - middle, axis=1))))
    for name, at in {f"corner {index}": places[index] for index in dict.fromkeys(chosen)}.items():
        placed = frame.edge.matrix @ compose(np.eye(3), at)
        located = through(point_jacobian(frame.edge.matrix, at), frame.edge.covariance)
        covariance = located + through(rotation, independent)
        flange = placed @ invert(tip.matrix)
        # Rounded up: no gap as large as the stated limit exceeds it. Reading error of a gap, by a
        # feeler gauge or by eye over a tip [mm].
        radius_mm = rounded_up(float(np.hypot(1e3 * radius95(covariance), 0.1)))
        points.append(TouchPoint(name, placed[:3, 3], flange, radius_mm))
    return TouchTargets(tuple(points), frame)


def evaluate_gaps(
    points: Sequence[TouchPoint], gaps_mm: Sequence[float], tool: Tool | None = None
) -> TouchTest:
    """Compares measured distances from tip to point [mm], in the points' order, with predictions.

    Raises:
        DataError: The number of gaps is not that of the points, or one is no length.
    """
    if len(gaps_mm) != len(points) or not all(0.0 <= gap <= _LARGEST_MM for gap in gaps_mm):
        raise DataError(
            f"touch-test: the gaps are {', '.join(f'{gap:g}' for gap in gaps_mm)} mm, but must be "
            f"{len(points)} from 0 to {_LARGEST_MM:g} mm, one per point.",
            culprits=["--gaps-mm"],
            next_step="Give them in the order of the points, without sign (149.9 mm beside a block "
            "of 150 mm are 0.1), as --gaps-mm 0.2,0.1,0.3,0.2,0.2.",
        )
    if 0.0 < max(gaps_mm) < _LEAST_READ_MM:
        raise DataError(
            f"touch-test: the gaps are in metres, most likely: the largest is {max(gaps_mm):g} mm, "
            f"and a tip over a point is read to {_LEAST_READ_MM:g} mm at best.",
            culprits=["--gaps-mm"],
            next_step="Give millimetres: --gaps-mm "
            f"{','.join(f'{1e3 * gap:g}' for gap in gaps_mm)}. A gap that cannot be seen is 0.",
        )
    touched = tuple(
        TouchedPoint(
            name=point.name, base_m=point.base_m, radius95_mm=point.radius95_mm, gap_mm=float(gap)
        )
        for point, gap in zip(points, gaps_mm, strict=True)
    )
    beyond = sum(point.gap_mm > point.radius95_mm for point in touched)
    # Errors along one direction have the longest tail for their 95 % radius.
    limits = chi2_limit(np.array([FALSE_REJECTION / len(points), 0.05]), 1)
    by_chance = np.sqrt(limits[0] / limits[1])
    far = any(point.gap_mm > by_chance * point.radius95_mm for point in touched)
    # One of five gaps may exceed its 95 % prediction by chance.
    passed = beyond <= 1 and not far
    return TouchTest(
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        tool="flange" if tool is None else tool.name.removeprefix("flange_from_"),
        passed=passed,
        points=touched,
    )


def touch_test_finding(test: TouchTest) -> Finding:
    """Finding of a touch test, with the remedy."""
    gaps = [point.gap_mm for point in test.points]
    radius = max(point.radius95_mm for point in test.points)
    words = (
        f"Touched with {test.named_tool}, {len(gaps)} points have gaps of {figure(min(gaps))} to "
        f"{figure(max(gaps))} mm; 95 % were predicted within {figure(radius)} mm."
    )
    if test.passed:
        return Finding("touch_test", f"{words} The gaps are as predicted.")
    beyond = [point for point in test.points if point.gap_mm > point.radius95_mm]
    named = listed([f"{point.name} ({figure(point.gap_mm)} mm)" for point in beyond])
    if len(beyond) == 1:
        words = f"{words} The gap at {named} is not explained by chance."
        step = Remedy(
            f"Touch {beyond[0].name} again. If its gap remains while the others are as predicted, "
            "look whether the tip met another corner, or the board is bent there."
        )
    else:
        words = f"{words} More than predicted: {named}."
        first = "" if test.tool == "flange" else "Measure the tool's tip anew, then l"
        step = Remedy(f"{first or 'L'}ook whether the camera or the robot was moved.")
    return Finding("touch_test", words, step, is_fatal=True)
