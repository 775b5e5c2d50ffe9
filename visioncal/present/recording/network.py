"""The network of a whole cell's frames as a graph: what hangs on what, and who saw whom."""

import rerun as rr

from visioncal.present.cellmap import pairs, places, sigma_words, spans
from visioncal.present.recording import colours, paths
from visioncal.results import Calibration

# The height of the bodies' names, and the drawing's units [px].
_BODY_HEIGHT, _ACROSS_PX, _DOWN_PX = 3.6, 110.0, 120.0


def log_network(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Draws the network as a graph: frames with their sigmas, and who saw whom."""
    nodes: dict[str, tuple[float, float]] = {}
    tree = calibration.tree
    for body, (left, right) in spans(tree).items():
        nodes[body] = (0.5 * (left + right), _BODY_HEIGHT)
    nodes |= places(tree)
    words = {flange: f"robot {robot}" for flange, robot in tree.flanges.items()}
    words[paths.CELL_FRAME] = f"the frame of {tree.reference}"
    labels = [f"{node}\n{words.get(node) or sigma_words(tree, node)}" for node in nodes]
    bodies = {paths.CELL_FRAME, *tree.flanges}
    seen = [(pair.seer, pair.seen) for pair in pairs(calibration.views) if pair.used]
    hangs = [(tree.parents[node], node) for node in nodes if node != paths.CELL_FRAME]
    stream.log(
        paths.NETWORK,
        rr.GraphNodes(
            list(nodes),
            positions=[(_ACROSS_PX * x, -_DOWN_PX * y) for x, y in nodes.values()],
            labels=labels,
            colors=[colours.LINK if node in bodies else colours.USED for node in nodes],
        ),
        rr.GraphEdges([*hangs, *seen], graph_type="undirected"),
        static=True,
    )
