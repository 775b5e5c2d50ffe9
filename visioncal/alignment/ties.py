"""What ties the frames of a cell together, and in words what would where nothing does."""

from collections.abc import Collection, Iterator, Sequence

from visioncal.alignment.cell import Cell
from visioncal.errors import DegenerateError
from visioncal.files import some_of


def untied_robots(cell: Cell, lost: Collection[str], *, seen: bool = False) -> None:
    """Refuses a cell in which a robot is tied to nothing.

    Args:
        cell: The cell.
        lost: The frames that are tied to nothing.
        seen: Whether there are observations that would tie them, were they enough.

    Raises:
        DegenerateError: A robot's base is among the frames that are lost.
    """
    branches = cell.tree.branches
    flanges = [it for it in branches if branches[it].robot and branches[it].parent in lost]
    if not flanges:
        return
    bases = [branches[it].parent for it in flanges]
    words = [untied_words(cell, it) for it in bases]
    robots = "this robot" if len(bases) == 1 else "these robots"
    why = f"no observation links {robots} to the rest of the cell"
    if seen:
        stops = len({it.station for it in cell.rows})
        why = (
            f"the observations that link {robots} to the rest of the cell are too few, too much "
            f"alike, or wrong (it takes 3 stops or more, turned about two axes; {stops} have any)"
        )
    raise DegenerateError(
        f"align: nothing ties {some_of(bases)} to {cell.reference}: {why}.",
        culprits=bases,
        next_step=" ".join(words),
    )


def untied_words(cell: Cell, frame: str) -> str:
    """What would tie a frame to the rest, in a sentence."""
    carried = [*_carried(cell, frame)]
    cameras = [it for it in carried if it.startswith("cam")]
    boards = [it for it in carried if it.startswith("target")]
    others = [it for it in cell.tied() if it not in carried]
    seeing = [it for it in others if it.startswith("cam")]
    lying = [it for it in others if it.startswith("target")]
    ways = []
    if boards and seeing:
        ways.append(f"let {some_of(seeing)} see {some_of(boards)} at 5 stops or more")
    if cameras and lying:
        ways.append(f"let {some_of(cameras)} see {some_of(lying)} at 5 stops or more")
    flange = next(
        (it for it, up in cell.tree.branches.items() if up.parent == frame and up.robot), ""
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


def _carried(cell: Cell, frame: str) -> Iterator[str]:
    """A frame and all that hangs on it."""
    for name in cell.tree.branches:
        if frame in cell.tree.above(name):
            yield name


def ambiguous_error(cell: Cell, frames: Sequence[str]) -> DegenerateError:
    """Words that frames are tied by boards alone that look the same when turned."""
    boards = sorted({it.seen for it in cell.rows if it.seer in frames or it.seen in frames})
    return DegenerateError(
        f"align: {some_of(frames)} may be in two places: {some_of(boards)} looks the same after "
        "half a turn, and no other observation tells which way round it was seen.",
        culprits=list(frames),
        next_step=f"Let {some_of(frames)} see a second board as well, or use a ChArUco board or a "
        "checkerboard with an odd and an even number of corners.",
    )
