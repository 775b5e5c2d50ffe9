"""Messages on the connectivity of a cell: unconnected frames, and observations to connect them."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import counted, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import IntArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.observability import FEWEST_VIEWS, Turning


def refuse_unconnected_robots(cell: Cell, lost: Collection[str], *, seen: bool = False) -> None:
    """Refuses a cell with a robot that is not connected to the rest.

    Args:
        cell: The cell.
        lost: The unconnected frames.
        seen: Whether there are observations that connect them, but too few or too poor.

    Raises:
        DegenerateError: A robot's base is among the unconnected frames.
    """
    branches = cell.tree.branches
    # Where no row is left, the robot of the reference base is unconnected, too.
    none_left = seen and all(row.seer in lost or row.seen in lost for row in cell.rows)
    flanges = [
        branch
        for branch in branches
        if branches[branch].robot and (branches[branch].parent in lost or none_left)
    ]
    if not flanges:
        return
    bases = [branches[flange].parent for flange in flanges]
    untied = [base for base in bases if base in lost] or [
        item for item in lost if not branches[item].robot
    ]
    advice = [connection_advice(cell, base) for base in bases]
    robots = "this robot" if len(bases) == 1 else "these robots"
    why = f"no observation links {robots} to the rest of the cell"
    parts = []
    if seen:
        moves = [robot_motion(cell, base, _stations(cell, base)) for base in bases]
        why = (
            f"the observations that link {robots} to the rest of the cell are too few, too much "
            f"alike, or wrong (it takes 3 stops or more, turned about two axes): {'; '.join(moves)}"
        )
        parts = [part for base in bases if base in lost and (part := _undetermined(cell, base))]
        if parts:
            why += f", which does not determine {' and '.join(parts)}"
        advice = [
            f"To tie {base}: {tilting}"
            if base in lost and (tilting := tilting_advice(cell, base))
            else other
            for base, other in zip(bases, advice, strict=True)
        ]
    raise DegenerateError(
        f"cell: nothing ties {some_of(untied)} to {cell.reference}: {why}.",
        culprits=parts or untied,
        next_step=" ".join(advice),
    )


def measuring_advice(cell: Cell, flange: str) -> str:
    """Advice to measure an offset that is undetermined if the arm cannot tilt; empty for none."""
    ends = (end for row in cell.rows for end in (row.seer, row.seen))
    carried = next((end for end in ends if cell.tree.body(end) == flange), "")
    if not carried:
        return ""
    return (
        f"Where the arm cannot tilt, measure how far {carried} is from {flange} along that axis, "
        f"for [prior.{flange}_from_{carried}]."
    )


def _undetermined(cell: Cell, base: str) -> str:
    """The undetermined offset, in words, where the robot on a base turns about one axis only."""
    stations = _stations(cell, base)
    if len(stations) < 2:
        return ""
    turning = Turning.of(invert(cell.poses[_robot_on(cell, base)][stations]))
    return turning.open_offset(base, base)


def tilting_advice(cell: Cell, base: str) -> str:
    """Advice to tilt a robot that was observed often, but never tilted; empty otherwise."""
    stations, robot = _stations(cell, base), _robot_on(cell, base)
    if len(stations) < FEWEST_VIEWS or Turning.of(invert(cell.poses[robot][stations])).is_enough:
        return ""
    flange = cell.tree.flanges[robot]
    words = (
        f"add {FEWEST_VIEWS} or more stops in which {flange} is tilted by 20 to 40 degrees about "
        "different axes, not only about one."
    )
    measured = measuring_advice(cell, flange) if _undetermined(cell, base) else ""
    return f"{words} {measured}".rstrip()


def _robot_on(cell: Cell, base: str) -> str:
    return next(robot for robot, name in cell.tree.bases.items() if name == base)


def robot_motion(cell: Cell, base: str, stations: IntArray) -> str:
    """Describes a robot's motion over some stations, and why it determines little."""
    robot = _robot_on(cell, base)
    poses, who = cell.poses[robot][stations], f"robot {robot}"
    if robot == robot_key(""):
        who = "the robot"
    if len(stations) < 2:
        return f"{who} was observed at {counted(len(stations), 'stop')}"
    return Turning.of(invert(poses)).words(poses, f"{len(stations)} stops of {who}", base)


def _stations(cell: Cell, base: str) -> IntArray:
    """The stations of observations whose chains contain the robot on a base."""
    stations = {
        row.station
        for row in cell.rows
        for step in cell.tree.path(row.seer, row.seen)
        if step.robot and cell.tree.branches[step.frame].parent == base
    }
    return np.array(sorted(stations), dtype=np.int64)


def sole_static_view(cell: Cell, frame: str) -> Finding | None:
    """The view of a fixed board by a fixed camera that alone connects a frame to the rest.

    It counts as one view, however often it is repeated. None where other views connect the frame.
    """
    tree = cell.tree
    moving = [row for row in cell.rows if any(step.robot for step in tree.path(row.seer, row.seen))]
    connected = replace(cell, rows=tuple(moving)).connected_frames()
    pairs = {
        (row.seer, row.seen)
        for row in cell.rows
        if (row.seer in connected) != (row.seen in connected)
    }
    pairs = {pair for pair in pairs if not any(step.robot for step in tree.path(*pair))}
    flange = next((name for name in tree.flanges.values() if name in connected), "")
    if frame in connected or len(pairs) != 1 or not flange:
        return None
    ((camera, board),) = pairs
    return Finding(
        "untied",
        f"{camera} sees {board} from one place alone, and that is one view however often it is "
        "repeated",
        Remedy(f"Let {camera} see a board on {flange} at 5 stops or more, too."),
    )


def connection_advice(cell: Cell, frame: str) -> str:
    """Advice on observations that would connect a frame to the rest, in a sentence."""
    tree = cell.tree
    carried = [name for name in tree.branches if frame in tree.above(name)]
    cameras = [name for name in carried if name.startswith("cam")]
    boards = [name for name in carried if name.startswith("target")]
    others = [name for name in cell.connected_frames() if name not in carried]
    seeing = [other for other in others if other.startswith("cam")]
    lying = [other for other in others if other.startswith("target")]
    ways = []
    if boards and seeing:
        ways.append(f"let {some_of(seeing)} see {some_of(boards)} at 5 stops or more")
    if cameras and lying:
        ways.append(f"let {some_of(cameras)} see {some_of(lying)} at 5 stops or more")
    flange = next(
        (flange for flange in tree.flanges.values() if tree.branches[flange].parent == frame), ""
    )
    if not ways and flange and seeing:
        ways.append(f"put a board on {flange} and let {some_of(seeing)} see it at 5 stops or more")
    if not ways and flange and lying:
        ways.append(f"put a camera on {flange} that sees {some_of(lying)} at 5 stops or more")
    if frame.startswith(("instrument", "point")):
        ways = [
            "let an instrument read points on a robot's flange at 5 stops or more, or three points "
            "that an instrument reads which is tied"
        ]
    if not ways:
        ways.append("let a camera that is tied see a board that hangs on it")
    return f"To tie {frame}: {', or '.join(ways)}."


def ambiguous_error(cell: Cell, frames: Sequence[str]) -> DegenerateError:
    """Error on frames that are connected only by boards with rotational symmetry."""
    boards = sorted({row.seen for row in cell.rows if row.seer in frames or row.seen in frames})
    return DegenerateError(
        f"cell: {some_of(frames)} may be in two places: {some_of(boards)} looks the same after "
        "half a turn, and no other observation shows which way round it was seen.",
        culprits=list(frames),
        next_step=f"Let {some_of(frames)} see a second board as well, or use a ChArUco board or a "
        "checkerboard with an odd and an even number of corners.",
    )
