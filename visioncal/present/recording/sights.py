"""What the views of a result saw: targets as each view places them, sight lines, the network."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray
from visioncal.present.network_layout import pairs, sigma_words
from visioncal.present.recording import board, colours, paths
from visioncal.present.recording.overlays import image_frames, log_image_frames
from visioncal.present.recording.scene import Scene
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.frames import frames_of_kind

# Length of the cell's axes, as a share of its size.
_CELL_AXIS = 0.24


def log_seen_targets(
    stream: rr.RecordingStream,
    scene: Scene,
    session: Session,
    calibration: Calibration,
    seen: Sequence[ViewEvidence],
) -> None:
    """Draws the target's outline as each view alone places it, in the order of the session."""
    # A part without strips clears those of the previous view.
    strips: dict[int, list[FloatArray]] = {}
    boards = session.boards if any(view.cam_from_target is not None for view in seen) else {}
    outlines = {name: board.closed_outline(target) for name, target in boards.items()}
    seers = {view.view: view.seer or paths.CAM_FRAME for view in calibration.views}
    cameras = frames_of_kind(seers.values(), "camera")
    for row, (view, view_seen) in enumerate(zip(session.views, seen, strict=True)):
        if (name := session.board_of(view)) not in boards:
            continue
        strips[row] = []
        if view_seen.cam_from_target is None or seers.get(view_seen.view) not in cameras:
            continue
        cell_from_cam = scene.in_cell(seers[view_seen.view], view_seen.view)
        if cell_from_cam is not None:
            pose = cell_from_cam @ view_seen.cam_from_target
            strips[row] = [outlines[name] @ pose[:3, :3].T + pose[:3, 3]]
    rejected = {row: seen[row].view in scene.rejected for row in strips}
    scene.log_lines(stream, paths.SEEN_TARGET, strips, rejected)


def log_sights(
    stream: rr.RecordingStream, scene: Scene, session: Session, calibration: Calibration
) -> None:
    """Draws a line from seer to seen in each view of a cell."""
    sights = {view.view: view for view in calibration.views}
    strips: dict[int, list[FloatArray]] = {}
    rejected: dict[int, bool] = {}
    for row, view in enumerate(session.views):
        sight, strips[row] = sights.get(view.number), []
        rejected[row] = sight is None or not sight.used
        if sight is None:
            continue
        ends = [scene.in_cell(name, view.number) for name in (sight.seer, sight.seen)]
        if ends[0] is not None and ends[1] is not None:
            target = scene.boards.get(sight.seen)
            middle = np.zeros(3) if target is None else board.outline(target).mean(axis=0)
            strips[row] = [np.array([ends[0][:3, 3], apply(ends[1], middle[None])[0]])]
    scene.log_lines(stream, paths.SIGHT_LINE, strips, rejected, 2.0)
    log_image_frames(stream, paths.IMAGE, image_frames(session, calibration))


def log_network(stream: rr.RecordingStream, scene: Scene, calibration: Calibration) -> None:
    """Draws the frame of a cell, and its network as a graph: frames, sigmas, and who saw whom."""
    axes = rr.TransformAxes3D(_CELL_AXIS * scene.size_m, show_frame=False)
    stream.log(paths.CELL, rr.CoordinateFrame(paths.CELL_FRAME), axes, static=True)
    tree = calibration.tree
    nodes = [paths.CELL_FRAME, *(frame for frame in tree.last if frame != paths.CELL_FRAME)]
    captions = {flange: f"robot {robot}" for flange, robot in tree.flanges.items()}
    captions[paths.CELL_FRAME] = f"the frame of {tree.reference}"
    labels = [f"{node}\n{captions.get(node) or sigma_words(tree, node)}" for node in nodes]
    bodies = {paths.CELL_FRAME, *tree.flanges}
    seen = [(pair.seer, pair.seen) for pair in pairs(calibration.views) if pair.used]
    hangs = [(tree.parents[node], node) for node in nodes if node != paths.CELL_FRAME]
    stream.log(
        paths.NETWORK,
        rr.GraphNodes(
            nodes,
            labels=labels,
            colors=[colours.LINK if node in bodies else colours.USED for node in nodes],
        ),
        rr.GraphEdges([*hangs, *seen], graph_type="undirected"),
        static=True,
    )
