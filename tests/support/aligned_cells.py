"""Made-up results of a cell of two robots."""

from dataclasses import replace

import numpy as np

from visioncal.core.transforms import exp
from visioncal.results import Calibration, CameraResult, CellResult, Edge, Verdict, ViewResult
from visioncal.results.sections import CellDetails
from visioncal.results.views import Validation, rms_of
from visioncal.simulation import CAMERAS

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


def made_up_cell(seed: int) -> Calibration:
    """A cell with edges and a covariance of chance."""
    rng = np.random.default_rng(seed)
    names = [frame for frame in FRAMES if frame != "base_a" and frame not in ROBOTS]
    root = 1e-4 * rng.standard_normal((6 * len(names), 6 * len(names)))
    covariance = root @ root.T
    edges = {}
    for at, name in enumerate(names):
        columns = slice(6 * at, 6 * at + 6)
        edge = Edge(exp(rng.normal(0.0, 0.7, 6)), covariance[columns, columns])
        edges[f"{FRAMES[name]}_from_{name}"] = edge
    return cell_result(
        edges,
        covariance,
        (
            ViewResult(0, True, "", None, None, 0.1, 0.01, "cam_top", "target_plate", 3),
            ViewResult(1, False, "blurred", seer="cam_hand", seen="target_plate", stop=4),
        ),
        tree=FRAMES,
        cameras={"top": CameraResult(CAMERAS["wide"], False)},
        noise={"a": {"translation_mm": 0.03}, "cam_top": {"pixel_px": 0.05}},
        weakest="target_plate is the least known.",
    )


def cell_result(edges, covariance, views, **known) -> Calibration:
    """A result of a whole cell with some sections of it."""
    nothing = {"cameras": {}, "robots": {}, "targets": {}, "noise": {}, "weakest": ""}
    cell = CellResult(
        reference="base_a", moved=(), untied=(), details=CellDetails(), **(nothing | known)
    )
    return Calibration(
        session_name="made up",
        session_sha256="00",
        created="2026-11-20T12:00:00+00:00",
        mount=cell.mount,
        edges=edges,
        joint_covariance=covariance,
        solvers={},
        noise={},
        views=views,
        rms=rms_of(views),
        validation=Validation.of("", views),
        verdict=Verdict.of("good", "It fits."),
        cell=cell,
    )


def with_cell(found: Calibration, **changes) -> Calibration:
    """The same with other sections of the whole cell."""
    return replace(found, cell=replace(found.cell, **changes))
