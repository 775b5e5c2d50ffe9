"""Session files of a live cell: constant facts, and the rows of its views."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomli_w

from visioncal.core.types import Camera, Mount, Target
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.protocols import ArmState
from visioncal.robot import Robot, load_robot, robot_file, robot_names
from visioncal.session import View
from visioncal.session.columns import pose_row
from visioncal.vision.targets import load_target, target_document, target_names

_TARGET_FILE = "target.toml"


@dataclass(frozen=True, eq=False)
class CaptureFacts:
    """Facts of a recording that are the same for all views."""

    name: str
    mount: Mount
    target: Target
    robot: Robot | None  # The arm's model; None where it is not known.
    arm: str  # The name that the arm reports.
    camera: str  # The name that the camera reports.
    resolution: tuple[int, int]  # (width, height) of its pictures [px].
    lens: Camera | None  # Intrinsics that it reports, to be refined; None to have them estimated.
    settings: Mapping[str, str | float]
    plan: str  # Digest of the plan that is driven; empty for none.

    def texts(self) -> dict[str, str]:
        """Files of the session besides its views, by name; session.toml is the last."""
        texts: dict[str, str] = {}
        document: dict[str, Any] = {"schema": 1, "name": self.name, "mount": self.mount}
        document["target"] = _shipped_target(self.target)
        if not document["target"]:
            document["target"] = _TARGET_FILE
            texts[_TARGET_FILE] = tomli_w.dumps(target_document(self.target))
        document["camera"] = self._camera_table()
        if self.robot is not None:
            model = _shipped_robot(self.robot)
            if not model:
                named = "robot.json" if "kind" in self.robot.document else ""
                model, text = robot_file(self.robot.document, named)
                texts[model] = text
            document["robot"] = {"model": model, "tip": self.robot.tip}
        texts["session.toml"] = tomli_w.dumps(document)
        return texts

    def provenance(self) -> dict[str, Any]:
        """Facts that a resumed recording must share with its beginning."""
        return {
            "arm": self.arm,
            "camera": self.camera,
            "resolution": list(self.resolution),
            "mount": self.mount,
            "target": target_document(self.target),
            "robot": "" if self.robot is None else self.robot.name,
            "plan": self.plan,
        }

    def _camera_table(self) -> dict[str, Any]:
        table: dict[str, Any] = {"name": self.camera, "resolution": list(self.resolution)}
        if self.lens is not None:
            table["model"] = self.lens.model
            table["matrix"] = self.lens.matrix.tolist()
            table["distortion"] = self.lens.distortion.tolist()
        return table


def view_of(
    number: int, image: str, taken: TakenView, facts: CaptureFacts, unix_offset_s: float
) -> View:
    """Builds the row of views.csv for a view; the offset is from monotonic to UNIX time [s]."""
    state, frame = taken.state, taken.frame
    numbers = {
        "stamp_s": round(frame.stamp_s + unix_offset_s, 6),
        **pose_row(state.base_from_flange),
    }
    for form, values in (
        ("q{}_rad", state.q),
        ("current{}_a", state.currents_a),
        ("temp{}_c", state.temperatures_c),
    ):
        if values is not None:
            numbers |= {form.format(at): float(value) for at, value in enumerate(values, start=1)}
    if state.payload_kg is not None:
        numbers["payload_kg"] = float(state.payload_kg)
    if state.payload_m is not None:
        numbers |= {
            f"payload_{name}_m": float(value)
            for name, value in zip("xyz", state.payload_m, strict=True)
        }
    return View(number, image=image, numbers=numbers, text=_texts(taken, state, facts))


def state_of(view: View) -> ArmState | None:
    """Joints and pose of a row; None where it has no pose."""
    pose = view.base_from_flange()
    if pose is None:
        return None
    return ArmState(view.stamp_s or 0.0, np.asarray(pose.as_matrix()), view.joints_rad)


def _texts(taken: TakenView, state: ArmState, facts: CaptureFacts) -> dict[str, str]:
    """Columns that calibration passes through: what the devices report."""
    texts = {
        "safety": state.safety,
        "blur_px": f"{taken.corners.blur_px:.2f}",
        "motion_px": f"{taken.motion_px:.3f}",
    }
    if state.flange_from_tool is not None:
        texts["tcp"] = " ".join(
            f"{value:.9g}" for value in pose_row(state.flange_from_tool).values()
        )
    if taken.frame.exposure_s is not None:
        texts["exposure_ms"] = f"{1e3 * taken.frame.exposure_s:.3f}"
    return texts | {f"device_{name}": str(value) for name, value in facts.settings.items()}


def _shipped_target(target: Target) -> str:
    """Name of a board that comes with visioncal; empty for another."""
    if target.name in target_names() and load_target(target.name) == target:
        return target.name
    return ""


def _shipped_robot(robot: Robot) -> str:
    """Name of an arm that comes with visioncal; empty for another."""
    for name in robot_names():
        shipped = load_robot(name)
        if shipped.name == robot.name and dict(shipped.document) == dict(robot.document):
            return name
    return ""
