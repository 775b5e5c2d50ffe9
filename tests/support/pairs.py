"""Pairs of calibrations of one simulated cell, with poses and noise of their own."""

from dataclasses import replace

import numpy as np
from support.cells import calibrated, reporting

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.transforms import exp, invert
from visioncal.estimation.chain import edge_names
from visioncal.results import Calibration, Edge, Rms, Validation, Verdict, ViewResult
from visioncal.simulation import SimulatedCell


def halves(cell: SimulatedCell) -> tuple[SimulatedCell, SimulatedCell]:
    """Two cells with the same mountings: the first half of the views, and the second."""
    middle = len(cell.corners) // 2
    return cell.only(range(middle)), cell.only(range(middle, 2 * middle))


def with_moved_camera(cell: SimulatedCell, twist: np.ndarray) -> SimulatedCell:
    """The cell with its camera's edge moved on the right, its images as they were.

    The robot stands where the moved camera sees what the camera saw before.
    """
    x, z = cell.transforms.values()
    moved = x @ exp(twist)
    if cell.options.mount == "eye-in-hand":
        flanges = cell.robot.base_from_flange @ x @ invert(moved)
    else:
        flanges = moved @ invert(x) @ cell.robot.base_from_flange
    return replace(reporting(cell, base_from_flange=flanges), mountings={"cam": moved, "target": z})


def with_moved_board(cell: SimulatedCell, twist: np.ndarray) -> SimulatedCell:
    """The cell with its target's edge moved on the right, its images as they were."""
    x, z = cell.transforms.values()
    moved = z @ exp(twist)
    if cell.options.mount == "eye-in-hand":
        flanges = moved @ invert(z) @ cell.robot.base_from_flange
    else:
        flanges = cell.robot.base_from_flange @ z @ invert(moved)
    return replace(reporting(cell, base_from_flange=flanges), mountings={"cam": x, "target": moved})


def calibration_of(known: RunState, name: str = "cell") -> Calibration:
    """A calibration with what a comparison looks at."""
    result = known.assessment
    covariance = result.covariance
    names = edge_names(known.session.mount)
    return Calibration(
        session_name=name,
        session_sha256=f"{known.base_from_flange[0].tobytes().hex()}",
        created="2026-11-20T10:11:12+00:00",
        mount=known.session.mount,
        edges={
            edge: Edge(pose, covariance[part, part])
            for edge, pose, part in zip(
                names,
                result.state.edges,
                (slice(0, 6), slice(6, 12)),
                strict=True,
            )
        },
        joint_covariance=covariance[:12, :12],
        solvers={},
        noise={"pixel_px": known.pixel_px or 0.0},
        views=tuple(ViewResult(view, view in known.used) for view in known.base_from_flange),
        rms=Rms(0.1, 0.01),
        validation=Validation("none", Rms(0.1, 0.01)),
        verdict=Verdict("good"),
        camera=known.camera,
    )


def calibrated_cell(cell: SimulatedCell) -> Calibration:
    """The calibration of a cell."""
    return calibration_of(calibrated(cell))
