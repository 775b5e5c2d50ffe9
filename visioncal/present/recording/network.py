"""The network of a whole cell's frames as a graph: what hangs on what, and who saw whom."""

import rerun as rr

from visioncal.core.number_format import significant
from visioncal.present.cellmap import pairs, places, spans
from visioncal.present.recording import colours, paths
from visioncal.results import Alignment

# The height of the bodies' names, and the drawing's units [px].
_BODY_HEIGHT, _ACROSS_PX, _DOWN_PX = 3.6, 110.0, 120.0


def log_network(stream: rr.RecordingStream, found: Alignment) -> None:
    """Draws the network as a graph: frames with their sigmas, and who saw whom."""
    nodes: dict[str, tuple[float, float]] = {}
    for body, (left, right) in spans(found).items():
        nodes[body] = (0.5 * (left + right), _BODY_HEIGHT)
    nodes |= places(found)
    labels = [f"{it}\n{_sigma(found, it)}" for it in nodes]
    bodies = {paths.CELL_FRAME, *found.robots}
    seen = [(it.seer, it.seen) for it in pairs(found) if it.used]
    hangs = [(found.frames[it], it) for it in nodes if it != paths.CELL_FRAME]
    stream.log(
        paths.NETWORK,
        rr.GraphNodes(
            list(nodes),
            positions=[(_ACROSS_PX * x, -_DOWN_PX * y) for x, y in nodes.values()],
            labels=labels,
            colors=[colours.LINK if it in bodies else colours.USED for it in nodes],
        ),
        rr.GraphEdges([*hangs, *seen], graph_type="undirected"),
        static=True,
    )


def _sigma(found: Alignment, frame: str) -> str:
    if frame in found.robots:
        return f"robot {found.robots[frame]}"
    if frame in (paths.CELL_FRAME, found.reference):
        return "the reference"
    return f"{significant(found.edge_of(frame).sigma_mm)} mm"
