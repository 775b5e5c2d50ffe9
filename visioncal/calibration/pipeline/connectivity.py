"""Messages on the connectivity of a cell: unconnected frames, and observations to connect them."""

from collections.abc import Collection, Sequence

import numpy as np

from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.core.directions import Turning
from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import counted, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import IntArray


def refuse_unconnected_robots(cell: Cell, lost: Collection[str]) -> None:
    """Refuses a cell with a robot that is not connected to the rest.

    Raises:
        DegenerateError: A robot's base is among the unconnected frames.
    """
    # Where no row is left, the robot of the reference base is unconnected, too.
    none_left = all(row.seer in lost or row.seen in lost for row in cell.rows)
    bases = [base for base in cell.tree.bases.values() if base in lost or none_left]
    if not bases:
        return
    untied = [base for base in bases if base in lost] or [*lost]
    moves = [robot_motion(cell, base, _stations(cell, base)) for base in bases]
    how = ", tilted by 20 to 40 degrees about different axes"
    advice = [connection_advice(base, how) for base in bases]
    raise DegenerateError(
        f"cell: nothing ties {some_of(untied)} to {cell.reference}: the observations that link "
        f"{'this robot' if len(bases) == 1 else 'these robots'} to the rest of the cell are too "
        "few, too much alike, or wrong (it takes 3 stops or more, turned about two axes): "
        f"{'; '.join(moves)}.",
        culprits=untied,
        next_step=" ".join(advice),
    )


def robot_motion(cell: Cell, base: str, stations: IntArray) -> str:
    """Describes a robot's motion over some stations, and why it determines little."""
    robot = next(robot for robot, name in cell.tree.bases.items() if name == base)
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


def connection_advice(frame: str, how: str = "") -> str:
    """Advice on observations that would connect a frame to the rest, in a sentence.

    `how` is what else the stops of a robot must be like, as the end of the sentence.
    """
    if frame.startswith(("instrument", "point")):
        return (
            f"To tie {frame}: let an instrument read points on a robot's flange at 5 stops or "
            "more, or three points that an instrument reads which is tied."
        )
    look = (
        f"a camera see a board, one of the two on {frame} or on its robot and the other one tied,"
    )
    if frame.startswith("cam"):
        look = "it see a board that is tied,"
    elif frame.startswith("target"):
        look = "a camera that is tied see it,"
    return f"To tie {frame}: let {look} at 5 stops or more{how}."


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
