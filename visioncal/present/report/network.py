"""The network of a cell's frames: parents, who saw whom, and the sigma of each."""

from collections.abc import Iterator

from visioncal.core.number_format import counted, significant
from visioncal.present.facts import DEGREE
from visioncal.present.tables import Table
from visioncal.results.tree import FrameTree
from visioncal.session.frames import CELL

_KINDS = {
    "robot": "flange",
    "camera": "cam",
    "board": "target",
    "instrument": "instrument",
    "point": "point",
}


def kinds(tree: FrameTree) -> str:
    """Number of robots, cameras, boards and the like, in words."""
    words = []
    for kind, start in _KINDS.items():
        count = sum(name.startswith(start) for name in tree.last)
        if count:
            words.append(counted(count, kind))
    return ", ".join(words)


def known_in_each_other(tree: FrameTree) -> Iterator[Table]:
    """Sigmas between frames of one body, the cell or a flange [mm, deg]."""
    for body in (CELL, *tree.flanges):
        carried = [
            name
            for name, parent in tree.last.items()
            if parent == body and name not in tree.flanges
        ]
        frames = carried if body == CELL else [body, *carried]
        if len(frames) > 1:
            # Nothing has a position in a point's frame, whose axes are arbitrary.
            oriented = [frame for frame in frames if _is_oriented(tree, frame)]
            rows = [(a, *(_between(tree, a, b) for b in frames)) for a in oriented]
            yield Table.of(("the cell" if body == CELL else body, *frames), rows)


def _between(tree: FrameTree, first: str, second: str) -> str:
    if first == second:
        return ""
    edge = tree.between(first, second)
    degrees = f", {significant(edge.sigma_deg)}{DEGREE}" if _is_oriented(tree, second) else ""
    return f"{significant(edge.sigma_mm)} mm{degrees}"


def _is_oriented(tree: FrameTree, frame: str) -> bool:
    """Whether a frame's rotation was measured, or is a reference for others."""
    return frame in (*tree.flanges, tree.reference) or tree.edge_of(frame).oriented
