"""Made-up results of aligning a cell of two robots."""

import numpy as np

from visioncal.core.transforms import exp
from visioncal.results import Alignment, CameraResult, Edge, Sight, Verdict
from visioncal.simulation import wide_camera

FRAMES = {
    "base_a": "cell",
    "flange_a": "base_a",
    "base_b": "cell",
    "flange_b": "base_b",
    "cam_top": "cell",
    "cam_hand": "flange_a",
    "target_plate": "flange_b",
}
ROBOTS = {"flange_a": "a", "flange_b": "b"}


def made_up_cell(seed: int) -> Alignment:
    """A cell with edges and a covariance of chance."""
    rng = np.random.default_rng(seed)
    names = [frame for frame in FRAMES if frame != "base_a" and frame not in ROBOTS]
    root = 1e-4 * rng.standard_normal((6 * len(names), 6 * len(names)))
    covariance = root @ root.T
    edges = {}
    for at, name in enumerate(names):
        mine = slice(6 * at, 6 * at + 6)
        edge = Edge(exp(rng.normal(0.0, 0.7, 6)), covariance[mine, mine])
        edges[f"{FRAMES[name]}_from_{name}"] = edge
    return Alignment(
        session_name="made up",
        session_sha256="00",
        created="2026-11-20T12:00:00+00:00",
        reference="base_a",
        frames=FRAMES,
        robots=ROBOTS,
        edges=edges,
        joint_covariance=covariance,
        cameras={"cam_top": CameraResult(wide_camera(), False)},
        noise={"a": {"translation_mm": 0.03}, "cam_top": {"pixel_px": 0.05}},
        sights=(
            Sight(0, 3, "cam_top", "target_plate", True, "", 0.1, 0.01),
            Sight(1, 4, "cam_hand", "target_plate", False, "blurred"),
        ),
        moved=(),
        untied=(),
        weakest="target_plate is the least known.",
        verdict=Verdict.of("good", "It fits."),
    )
