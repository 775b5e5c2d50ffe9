"""The calibration of one camera, one robot and one target out of that of a whole cell."""

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.codec import entries
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Verdict
from visioncal.results.arm import ArmSections
from visioncal.results.cell import CellResult
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.results.parts import RobotResult
from visioncal.results.sections import ClockResult, JointFit, NoiseIntervals
from visioncal.results.tree import FrameTree
from visioncal.results.views import Rms, Validation, rms_of
from visioncal.session.choosing import PARTS, Choice, Chosen, Part, choose
from visioncal.session.frames import frames_of_kind, robots_between, thing_name

if TYPE_CHECKING:
    from visioncal.results.result import Calibration


def selected_fields(
    whole: "Calibration", cell: CellResult, choice: Choice, needs: Collection[Part]
) -> dict[str, Any]:
    """The fields in which the calibration of one camera, robot and target is another.

    Args:
        whole: That of the whole cell.
        cell: What it has by name.
        choice: See `Calibration.chosen`.
        needs: Likewise.

    Raises:
        DataError: There is no such thing, several are meant, or no robot parts these.
    """
    chosen = _chosen(whole, choice, needs)
    chain = _chain(whole.tree, chosen)
    nothing = np.zeros((0, len(whole.joint_covariance)))
    jacobian = np.concatenate([nothing, *(pair[1] for pair in chain.values())])
    covariance = jacobian @ whole.joint_covariance @ jacobian.T
    arm = cell.robots.get(chosen.robot or "robot", RobotResult())
    views = [
        view
        for view in whole.views
        if chosen.camera in ("", view.seer) and chosen.target in ("", view.seen)
    ]
    method = whole.validation.method if whole.validation.is_of_unseen else ""
    rms, target = rms_of(views), thing_name(chosen.target, "target")
    camera = cell.lenses.get(chosen.camera)
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
        "verdict": _verdict(whole.verdict, cell),
        "camera": None if camera is None else camera.carried(jacobian),
        "robot": arm.model,
        "frames": _placed(whole.tree, chosen),
        **{entry.name: getattr(arm, entry.name) for entry in entries(ArmSections)},
        "clock": _clock(cell, chosen),
        "uncertainty": _intervals(cell, chosen),
        "board": whole.boards.get(target),
        "boards": {},
        "rig": whole.rigs.get(target),
        "rigs": {},
        "joint_fit": _joint_fit(cell, chosen, jacobian),
        "cell": None,
        "need": None if whole.need is None else whole.need.of(*_pair(chosen)),
        "further": {},
    }


def placed_name(whole: "Calibration", choice: Choice, needs: Collection[Part], name: str) -> str:
    """What a transform of the smaller calibration is called in the whole cell's."""
    if whole.cell is None:
        return name
    chosen = _chosen(whole, choice, needs)
    parent, _, child = name.partition("_from_")
    frames = {"flange": chosen.flange, "base": chosen.base}
    return f"{frames[parent]}_from_{child}"


def boards_before(whole: "Calibration", choice: Choice, needs: Collection[Part]) -> dict[str, Edge]:
    """The targets that stand still before a robot's base in a cell: `base_from_target_floor`."""
    if whole.cell is None:
        return {}
    base, tree = _chosen(whole, choice, needs).base, whole.tree
    return {
        f"base_from_{name}": tree.between(base, name)
        for name in frames_of_kind(tree.parents, "target")
        if not robots_between(tree.parents, base, name)
    }


def _chosen(whole: "Calibration", choice: Choice, needs: Collection[Part]) -> Chosen:
    """What is meant, where all stood last; of what is neither needed nor named, nothing."""
    chosen = choose(whole.tree.last, choice, needs, label=f"the cell {whole.session_name!r}")
    kept = {*needs, *(part for part in PARTS if choice.of(part))}
    return replace(
        chosen,
        camera=chosen.camera if "camera" in kept else "",
        target=chosen.target if "target" in kept else "",
    )


def _pair(chosen: Chosen) -> tuple[str, str]:
    """Camera and robot by the names of their tables."""
    return thing_name(chosen.camera, "camera"), chosen.robot or "robot"


def _chain(tree: FrameTree, chosen: Chosen) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Both transforms by name, as far as they are there, each with its slopes by all edges."""
    in_hand = chosen.mount == "eye-in-hand"
    of_camera, of_target = ("flange", "base") if in_hand else ("base", "flange")
    frames = {"flange": chosen.flange, "base": chosen.base}
    ends = {
        f"{of_camera}_from_cam": (frames[of_camera], chosen.camera),
        f"{of_target}_from_target": (frames[of_target], chosen.target),
    }
    return {name: tree.way(*pair) for name, pair in ends.items() if pair[1]}


def _noise(cell: CellResult, chosen: Chosen, rms: Rms) -> dict[str, float]:
    """The noise of corners and of the robot."""
    # Of poses that were measured without corners, that of camera and robot together is as this pair
    # scatters: the camera's own level is a mean over all that it sees, near and far.
    robot, camera = (cell.noise.get(name, {}) for name in (chosen.robot or "robot", chosen.camera))
    found = {"pixel_px": camera["pixel_px"]} if "pixel_px" in camera else {}
    names = ("translation_mm", "rotation_deg")
    found |= {f"robot_{name}": robot[name] for name in names if name in robot}
    if chosen.camera and chosen.target and "pixel_px" not in camera:
        each = (rms.mm, rms.deg or 0.0)
        found |= {
            f"combined_{name}": value / np.sqrt(3.0)
            for name, value in zip(names, each, strict=True)
        }
    return found


def _verdict(verdict: Verdict, cell: CellResult) -> Verdict:
    if "arms" not in cell.details.further:
        return verdict
    found = Finding(
        "arm_left_out",
        "The whole cell was fitted with errors of its arms, which this part of it does not have: "
        "by the poses as they are reported it is off by as much.",
    )
    status = "check" if verdict.status == "good" else verdict.status
    return replace(verdict, status=status, findings=(found, *verdict.findings))


def _placed(tree: FrameTree, chosen: Chosen) -> dict[str, Frame]:
    """Tools and fixtures of the robot, and in its base the fixtures of others beside it."""
    found: dict[str, Frame] = {}
    for name, frame in tree.placed.items():
        parent, _, child = name.partition("_from_")
        if parent == chosen.flange:
            found[f"flange_from_{child}"] = frame
        elif parent == chosen.base:
            found[f"base_from_{child}"] = frame
        elif parent.startswith("base") and not robots_between(tree.parents, chosen.base, parent):
            found[f"base_from_{child}"] = replace(frame, edge=tree.between(chosen.base, child))
    return found


def _clock(cell: CellResult, chosen: Chosen) -> ClockResult | None:
    """How far the camera's clock is ahead of the robot's."""
    return cell.details.clocks.get(f"{chosen.camera} and robot {chosen.robot or 'robot'}")


def _intervals(cell: CellResult, chosen: Chosen) -> NoiseIntervals | None:
    """How well the robot's noise is known."""
    known = {} if cell.uncertainty is None else cell.uncertainty.noise_95
    found = known.get(chosen.robot or "robot", {})
    named = {f"robot_{name}": pair for name, pair in found.items()}
    return NoiseIntervals(noise_95=named) if named else None


def _joint_fit(cell: CellResult, chosen: Chosen, jacobian: FloatArray) -> JointFit | None:
    """What `verify` predicts with: both edges, lens and board as far as they are free, the arm."""
    fit = cell.joint_fit
    if fit is None or not chosen.camera:
        return None
    target = thing_name(chosen.target, "target") if chosen.target else ""
    camera = thing_name(chosen.camera, "camera")
    lens_count = 0
    if (known := cell.lenses.get(chosen.camera)) is not None:
        lens_count = 4 + len(known.camera.distortion)
    looks: list[int] = []
    columns: list[int] = []
    at = jacobian.shape[1]
    for part, name, first in ((fit.cameras, camera, 0), (fit.targets, target, lens_count)):
        for word, places in part.items():
            if word == name:
                looks += [first + place for place in places]
                columns += range(at, at + len(places))
            at += len(places)
    own = chosen.robot or "robot"
    for word, arm in fit.arms.items():
        if word == own:
            columns += range(at, at + len(arm.values))
        at += len(arm.values)
    carried = block_diag(jacobian, np.eye(at)[columns][:, jacobian.shape[1] :])
    return JointFit(
        targets={"": cell.targets[target]} if target in cell.targets else {},
        boards=("",) if chosen.target else (),
        looks=tuple(looks),
        arm=fit.arms.get(own),
        covariance=carried @ fit.covariance @ carried.T,
    )
