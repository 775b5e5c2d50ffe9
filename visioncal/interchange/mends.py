"""Options that mend what was recorded wrongly."""

from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from visioncal.core.options import option
from visioncal.core.parsing import pairs_in, places_in, scale_in, shift_in, tool_in, turn_in

mend_option = partial(option, panel="Poses that may be misread, of a session as well")
# A sum of columns: their factors and names.
Sum: TypeAlias = tuple[tuple[float, str], ...]


@dataclass(frozen=True, kw_only=True)
class Mends:
    """Mends of rows, boards and images, whether of a session or of a foreign recording."""

    mirror_poses: bool = mend_option(
        "Mirror left-handed poses.", "--mirror-poses", default=False, needs="guess"
    )
    exchange: tuple[int, ...] | None = mend_option(
        "Pairs of views whose images are exchanged, one after the other: 8,17,9,16.", parse=pairs_in
    )
    # Earlier where negative.
    shift: tuple[tuple[int, ...], int, bool] | None = mend_option(
        "Views whose poses stand so many rows later: 12-24:2. Of a cell, 12-24:2:images gives "
        "these images to other stops, and leaves the robot's poses there.",
        parse=shift_in,
    )
    turned: tuple[tuple[int, ...], tuple[float, ...]] | None = mend_option(
        "Views whose board is read turned, by degrees about a point in mm: 3,7:180,80,60; or, by 0 "
        "degrees, shifted to it. By degrees alone: whose pictures are turned.",
        parse=turn_in,
    )
    positions: tuple[tuple[int, ...], tuple[tuple[tuple[float, str], ...], ...]] | None = (
        mend_option(
            "Views whose positions are made of other columns: 0,4-6:x,-y,z+rail_m.", parse=places_in
        )
    )
    without_tool: tuple[tuple[int, ...], tuple[float, ...]] | None = mend_option(
        "Views whose poses are of a tool's tip, and the tool, in mm and by a rotation vector in "
        "degrees: 3,7:0,0,140,0,0,30. It is taken off them.",
        parse=tool_in,
    )
    board_scale: tuple[str, float] | None = mend_option(
        "True over stated size of the board: 1.01, or, of several, left:1.01. Poses that were "
        "measured by it are scaled along.",
        parse=scale_in,
    )
    by_joints: bool = mend_option(
        "Take the poses of the joint angles, not the reported ones.", "--by-joints", default=False
    )
    mend_images: bool = mend_option(
        "Mirror, turn and scale images back.", "--mend-images", default=False
    )
