"""Calibration of one camera, one robot and one target from that of a whole cell."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.codec import entries
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.results.arm import ArmSections
from visioncal.results.cell import CellResult
from visioncal.results.content import CalibrationContent
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.results.parts import RobotResult
from visioncal.results.sections import JointFit, NoiseIntervals
from visioncal.results.tree import FrameTree
from visioncal.results.views import Rms, Validation, rms_of
from visioncal.session.frames import frames_of_kind, object_name, robots_between
from visioncal.session.selecting import PARTS, Choice, Chosen, Part, choose

C = TypeVar("C", bound=CalibrationContent)


def selected(whole: C, choice: Choice, needs: Collection[Part] = PARTS) -> C:
    """Selects one camera, robot and target; see `Calibration.chosen`."""
    if whole.cell is not None:
        return replace(whole, **_selected_fields(whole, whole.cell, choice, needs))
    if not choice.is_any:
        raise DataError(
            f"calibration {whole.session_name!r} is of one camera and one robot, which have no "
            "names.",
            culprits=[f"--{part}" for part in PARTS if getattr(choice, part)],
            next_step="Leave their names out.",
        )
    return whole


def _selected_fields(
    whole: CalibrationContent, cell: CellResult, choice: Choice, needs: Collection[Part]
) -> dict[str, Any]:
    """Fields of the calibration of one camera, robot and target that differ from the cell's.

    Raises:
        DataError: See `Calibration.of`.
    """
    chosen = _chosen(whole, choice, needs)
    in_hand = chosen.mount == "eye-in-hand"
    on_camera, on_target = ("flange", "base") if in_hand else ("base", "flange")
    frames = {"flange": chosen.flange, "base": chosen.base}
    # Camera and target, each with its Jacobian by all edges.
    chain = {
        name: whole.tree.compose(frames[parent], child)
        for name, parent, child in (
            (f"{on_camera}_from_cam", on_camera, chosen.camera),
            (f"{on_target}_from_target", on_target, chosen.target),
        )
        if child
    }
    empty = np.zeros((0, len(whole.joint_covariance)))
    jacobian = np.concatenate([empty, *(pair[1] for pair in chain.values())])
    covariance = jacobian @ whole.joint_covariance @ jacobian.T
    camera_name, robot = object_name(chosen.camera, "camera"), chosen.robot or "robot"
    arm = cell.robots.get(robot, RobotResult())
    views = [
        view
        for view in whole.views
        if chosen.camera in ("", view.seer) and chosen.target in ("", view.seen)
    ]
    method = whole.validation.method if whole.validation.is_of_unseen else ""
    rms, target = rms_of(views), object_name(chosen.target, "target")
    camera = cell.lenses.get(chosen.camera)
    by_robot = {} if cell.uncertainty is None else cell.uncertainty.noise_95
    intervals = {f"robot_{name}": pair for name, pair in by_robot.get(robot, {}).items()}
    return {
        "mount": chosen.mount,
        "edges": {
            name: Edge(matrix, covariance[6 * at : 6 * at + 6, 6 * at : 6 * at + 6])
            for at, (name, (matrix, _)) in enumerate(chain.items())
        },
        "joint_covariance": covariance,
        "noise": _noise(cell, chosen, rms),
        "views": tuple(view.of_pair for view in views),
        "rms": rms,
        "validation": Validation.of(method, views),
        "verdict": whole.verdict,
        "camera": None if camera is None else camera.carried(jacobian),
        "robot": arm.model,
        "robot_form": arm.form,
        "frames": _frames(whole.tree, chosen),
        **{entry.name: getattr(arm, entry.name) for entry in entries(ArmSections)},
        "clock": cell.details.clocks.get(f"{chosen.camera} and robot {robot}"),
        "uncertainty": NoiseIntervals(noise_95=intervals) if intervals else None,
        "board": whole.boards.get(target),
        "boards": {},
        "rig": whole.rigs.get(target),
        "rigs": {},
        "joint_fit": _joint_fit(cell, chosen, jacobian),
        "cell": None,
        "need": None if whole.need is None else whole.need.of(camera_name, robot),
        "further": {},
    }


def transform_name_in_cell(
    whole: CalibrationContent, choice: Choice, needs: Collection[Part], name: str
) -> str:
    """Name in the whole cell of a transform of the selected calibration."""
    if whole.cell is None:
        return name
    chosen = _chosen(whole, choice, needs)
    parent, _, child = name.partition("_from_")
    frames = {"flange": chosen.flange, "base": chosen.base}
    return f"{frames[parent]}_from_{child}"


def targets_fixed_to_base(
    whole: CalibrationContent, choice: Choice, needs: Collection[Part]
) -> dict[str, Edge]:
    """Poses of the cell's targets that are fixed to a robot's base: `base_from_target_floor`."""
    if whole.cell is None:
        return {}
    base, tree = _chosen(whole, choice, needs).base, whole.tree
    return {
        f"base_from_{name}": tree.between(base, name)
        for name in frames_of_kind(tree.parents, "target")
        if not robots_between(tree.parents, base, name)
    }


def _chosen(whole: CalibrationContent, choice: Choice, needs: Collection[Part]) -> Chosen:
    """The chosen parts in the last poses; parts neither needed nor named are empty."""
    chosen = choose(whole.tree.last, choice, needs, label=f"the cell {whole.session_name!r}")
    kept = {*needs, *(part for part in PARTS if getattr(choice, part))}
    return replace(
        chosen,
        camera=chosen.camera if "camera" in kept else "",
        target=chosen.target if "target" in kept else "",
    )


def _noise(cell: CellResult, chosen: Chosen, rms: Rms) -> dict[str, float]:
    """Noise levels of corners and robot."""
    # For measured poses without corners, the combined noise is from this pair's scatter: the
    # camera's own level is a mean over all targets, near and far.
    robot, camera = (cell.noise.get(name, {}) for name in (chosen.robot or "robot", chosen.camera))
    levels = {"pixel_px": camera["pixel_px"]} if "pixel_px" in camera else {}
    names = ("translation_mm", "rotation_deg")
    levels |= {f"robot_{name}": robot[name] for name in names if name in robot}
    if chosen.camera and chosen.target and "pixel_px" not in camera:
        scatter = (rms.mm, rms.deg or 0.0)
        levels |= {
            f"combined_{name}": value / np.sqrt(3.0)
            for name, value in zip(names, scatter, strict=True)
        }
    return levels


def _frames(tree: FrameTree, chosen: Chosen) -> dict[str, Frame]:
    """Tools and fixtures of the robot, and fixtures of other bases that are fixed to its base."""
    frames: dict[str, Frame] = {}
    for name, frame in tree.placed.items():
        parent, _, child = name.partition("_from_")
        if parent == chosen.flange:
            frames[f"flange_from_{child}"] = frame
        elif parent == chosen.base:
            frames[f"base_from_{child}"] = frame
        elif parent.startswith("base") and not robots_between(tree.parents, chosen.base, parent):
            frames[f"base_from_{child}"] = replace(frame, edge=tree.between(chosen.base, child))
    return frames


def _joint_fit(cell: CellResult, chosen: Chosen, jacobian: FloatArray) -> JointFit | None:
    """Fit for `verify`: both edges, free parameters of lens and board, the arm's errors."""
    fit = cell.joint_fit
    if fit is None or not chosen.camera:
        return None
    target = object_name(chosen.target, "target") if chosen.target else ""
    camera = object_name(chosen.camera, "camera")
    lens = cell.lenses.get(chosen.camera)
    lens_count = 0 if lens is None else 4 + len(lens.camera.distortion)
    looks: list[int] = []
    columns: list[int] = []
    at = jacobian.shape[1]
    for parts, name, first in ((fit.cameras, camera, 0), (fit.targets, target, lens_count)):
        for part_name, indices in parts.items():
            if part_name == name:
                looks += [first + index for index in indices]
                columns += range(at, at + len(indices))
            at += len(indices)
    robot = chosen.robot or "robot"
    for part_name, arm in fit.arms.items():
        if part_name == robot:
            columns += range(at, at + len(arm.values))
        at += len(arm.values)
    selection = block_diag(jacobian, np.eye(at)[columns][:, jacobian.shape[1] :])
    return JointFit(
        targets={"": cell.targets[target]} if target in cell.targets else {},
        boards=("",) if chosen.target else (),
        looks=tuple(looks),
        arm=fit.arms.get(robot),
        covariance=selection @ fit.covariance @ selection.T,
    )
