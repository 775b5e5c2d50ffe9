"""Files of a plan: table of stops, program for a UR controller, and plan.json with its reader."""

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from visioncal.core.choices import PLAN_ACCELERATION, PLAN_SPEED
from visioncal.core.documents.jsons import parse_json
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, one_line, read_text, sha256
from visioncal.core.types import MOUNTS, Camera, CameraKind, FloatArray, Mount, Need
from visioncal.core.version import __version__
from visioncal.estimation.chain import edge_names
from visioncal.estimation.problem_parts import Noise
from visioncal.live.planning.cell import Box, Limits, PlanCell
from visioncal.live.planning.design import Accuracy
from visioncal.live.planning.plan import Plan, PlannedStop, PlanRequest, Stop
from visioncal.live.planning.purposes import Purpose, purpose_of
from visioncal.robot import Robot, has_ur_axes
from visioncal.session.columns import POSE, pose_row
from visioncal.vision.targets import (
    load_target,
    target_document,
    target_from_document,
    target_names,
)

_FILE, _SCHEMA = "plan.json", 1
# Time for vibrations to decay before an image is taken [s].
_SETTLING_S = 0.5


def stops_table(plan: Plan) -> str:
    """Writes the stops as a views.csv, with poses by the robot's model and names for the images."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    joints = [f"q{index + 1}_rad" for index in range(plan.cell.robot.joint_count)]
    writer.writerow(["view", "image", *joints, *POSE, "why"])
    for stop in plan.stops:
        numbers = [*stop.q.tolist(), *pose_row(stop.base_from_flange).values()]
        cells = [f"{number:.9f}" for number in numbers]
        writer.writerow([stop.view, _image_of(stop), *cells, stop.words])
    return text.getvalue()


def _image_of(stop: PlannedStop) -> str:
    """Name of the image to be taken at a stop."""
    return f"images/{stop.view:03d}.png"


def plan_document(plan: Plan, source: Mapping[str, str]) -> dict[str, Any]:
    """Builds the content of plan.json; `source` tells the reader where the cell comes from."""
    request, design = plan.request, plan.design
    inputs: dict[str, Any] = {
        "cell": _cell_document(plan.cell),
        "request": _request_document(plan.request),
    }
    if plan.start is not None:
        inputs["recorded_views"] = list(plan.start.views)
    document: dict[str, Any] = {
        "schema": _SCHEMA,
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": dict(source),
        "inputs_sha256": sha256(json.dumps(inputs, sort_keys=True).encode()),
        "purpose": request.purpose.name,
        "judged": request.purpose.errors,
        "predicted": {
            **({} if plan.start is None else {"before": _accuracy(design.before)}),
            "after": _accuracy(design.predicted),
            "all_candidates": _accuracy(design.best),
        },
        "criterion": {"name": "I", "value": design.sigma_mm},
    }
    if plan.start is not None and plan.start.refusal:
        document["refusal_before"] = plan.start.refusal
    if plan.need is not None:
        document["need"] = {
            **_stated_values(plan.need.need),
            "probability": plan.need.probability,
            **({} if plan.start is None else {"probability_before": plan.need.before}),
            "probability_of_all_candidates": plan.need.best,
        }
    if plan.need is not None and plan.need.limits:
        document["shortfall"] = plan.need.limits
    document |= {
        "stops": [_stop_document(stop) for stop in plan.stops],
        "joints": list(plan.cell.robot.joint_names),
        "path_rad": plan.length_rad,
        "candidates": {"found": plan.candidate_count, "lost_to": dict(plan.lost)},
        **inputs,
    }
    if plan.in_the_way:
        document["exchanged_because_of"] = list(plan.in_the_way)
    return document


def _request_document(request: PlanRequest) -> dict[str, Any]:
    document: dict[str, Any] = {
        "purpose": request.purpose.name,
        "stops": request.count,
        "candidates": request.candidates,
        "seed": request.seed,
    }
    if request.need is not None:
        document["need"] = _stated_values(request.need)
    if request.start_q is not None:
        document["start_q"] = request.start_q.tolist()
    return document


def program_of(plan: Plan) -> str:
    """Writes a program that drives a UR to the stops and waits at each; empty for other arms.

    Between postures it moves straight in joint space, without blending: the path that was checked.
    """
    cell = plan.cell
    start: tuple[str, ...] = ()
    if not has_ur_axes(cell.robot):
        return ""
    named = one_line(f"Robot {cell.robot.name}, {cell.mount}, board {cell.target.name}.")
    if plan.request.start_q is None:
        start = (
            "# The way from where the arm stands now to the first stop was not looked at: bring it",
            "# there by hand first.",
        )
    lines = [
        f"# visioncal {__version__}: {len(plan.stops)} stops for {plan.request.purpose.name}",
        f"# {named.encode('ascii', 'replace').decode()}",
        "# Look at plan.rrd first, then run it at reduced speed, with a hand on the stop button.",
        "# The ways were looked at with capsules for the arm and with what was declared of the",
        "# cell: floor, boxes, board, camera. Cables, grippers and people are not known to it.",
        *start,
        "# At each stop the program waits: take the image that it names, write down the pose.",
        "def visioncal_plan():",
        f"  speed = {PLAN_SPEED}          # rad/s",
        f"  acceleration = {PLAN_ACCELERATION}   # rad/s^2",
        f"  settling = {_SETTLING_S}       # s",
    ]
    for stop in plan.stops:
        words = ["on the way"] * len(stop.via) + [f"view {stop.view}"]
        for posture, word in zip((*stop.via, stop.q), words, strict=True):
            joints = ", ".join(f"{value:.6f}" for value in posture)
            lines.append(f"  movej([{joints}], a=acceleration, v=speed)  # {word}")
        lines.append("  sleep(settling)")
        lines.append(
            f'  popup("View {stop.view}: take {_image_of(stop)}, then continue.", '
            'title="visioncal", blocking=True)'
        )
    lines.append('  popup("All stops are done.", title="visioncal", blocking=True)')
    return "\n".join([*lines, "end", "", "visioncal_plan()", ""])


def _accuracy(accuracy: Accuracy) -> dict[str, Any]:
    if accuracy.is_open:
        return {"open": True}
    return {"sigma_mm": accuracy.mm, "sigma_deg": accuracy.deg}


def _stop_document(stop: PlannedStop) -> dict[str, Any]:
    return {
        "view": stop.view,
        "q": stop.q.tolist(),
        **({"via_q": stop.via.tolist()} if len(stop.via) else {}),
        "base_from_flange": stop.base_from_flange.tolist(),
        "cam_from_target": stop.cam_from_target.tolist(),
        "seen_share": stop.seen,
        "rank": stop.rank,
        "why": stop.words,
        "before": _accuracy(stop.before),
        "after": _accuracy(stop.after),
    }


def _cell_document(cell: PlanCell) -> dict[str, Any]:
    x, z = edge_names(cell.mount)
    camera = cell.camera
    document: dict[str, Any] = {
        "mount": cell.mount,
        "robot": dict(cell.robot.document),
        "target": target_document(cell.target),
        "camera": {
            "model": camera.model,
            "resolution": list(camera.resolution),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
        },
        "guesses": {
            x: cell.x.tolist(),
            z: cell.z.tolist(),
            "sigma_m": cell.sigma_m,
            "sigma_rad": cell.sigma_rad,
        },
        "noise": {
            "pixel_px": cell.pixel_px,
            "robot_translation_m": float(cell.noise.robots[0, 1]),
            "robot_rotation_rad": float(cell.noise.robots[0, 0]),
        },
        "limits": {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in vars(cell.limits).items()
            if value is not None
        },
        "boxes": [_box_document(box) for box in cell.boxes],
    }
    if cell.covariance is not None:
        document["guesses"]["covariance"] = cell.covariance.tolist()
    return document


def _box_document(box: Box) -> dict[str, Any]:
    return {
        "name": box.name,
        "base_from_box": np.asarray(box.base_from_box).tolist(),
        "size_m": np.asarray(box.size_m).tolist(),
    }


def _stated_values(need: Need) -> dict[str, float]:
    return {name: getattr(need, name) for name in ("mm", "deg") if getattr(need, name) is not None}


@dataclass(frozen=True, eq=False)
class PlanFile:
    """A plan read from its file."""

    cell: PlanCell
    purpose: Purpose
    stops: tuple[Stop, ...]  # In driving order.
    # (n,) joint angles before the first stop [rad]; None where they were not stated, and the path
    # to the first stop was not checked.
    start_q: FloatArray | None
    digest: str  # SHA-256 of the plan's inputs.


def read_plan(path: Path | str) -> PlanFile:
    """Reads a plan from its plan.json, or from the folder of it.

    Raises:
        DataError: There is none, or it is not a valid plan.
    """
    path = Path(path)
    file = path / _FILE if path.is_dir() else path
    text = read_text(file)
    document = parse_json(text, str(file))
    if not isinstance(document, dict) or "stops" not in document or "cell" not in document:
        raise DataError(
            f"{file} is no plan: it has no stops and cell.",
            culprits=[str(file)],
            next_step="Make one with visioncal plan -o FOLDER.",
        )
    DocumentTable(document, str(file)).integer("schema", _SCHEMA, _SCHEMA)
    try:
        return _plan(document)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{file} is damaged: {error!r} where a plan is read.",
            culprits=[str(file)],
            next_step="Make it anew with visioncal plan.",
        ) from error


def _plan(document: Mapping[str, Any]) -> PlanFile:
    cell = _cell(document["cell"])
    joints = cell.robot.joint_count
    start = document["request"].get("start_q")
    return PlanFile(
        cell,
        purpose_of(document["purpose"]),
        tuple(
            Stop(
                int(value["view"]),
                _array(value["q"], (joints,)),
                _array(value.get("via_q") or np.zeros((0, joints)), (-1, joints)),
                str(value.get("why", "")),
            )
            for value in document["stops"]
        ),
        None if start is None else _array(start, (joints,)),
        str(document["inputs_sha256"]),
    )


def _cell(content: Mapping[str, Any]) -> PlanCell:
    mount = content["mount"]
    if mount not in MOUNTS:
        raise ValueError(f"mount {mount!r}")
    guesses, noise, lens = content["guesses"], content["noise"], content["camera"]
    x, z = edge_names(mount)
    limits: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in content["limits"].items()
    }
    # A cell without a floor has no entry for it, whereas the default is a floor at height zero.
    limits.setdefault("floor_m", None)
    covariance = guesses.get("covariance")
    width, height = lens["resolution"]
    kind = DocumentTable(lens, "plan.json: camera").choice("model", ("brown", "fisheye"))
    camera = Camera(
        cast("CameraKind", kind),
        (int(width), int(height)),
        _array(lens["matrix"], (4,)),
        np.array(lens["distortion"], dtype=float),
    )
    # A board that comes with visioncal gets its name.
    target = target_from_document(content["target"], "board")
    shipped = (load_target(name) for name in target_names())
    is_it = (one for one in shipped if target_document(one) == target_document(target))
    return PlanCell(
        cast("Mount", mount),
        Robot.from_document(content["robot"]),
        camera,
        next(is_it, target),
        _array(guesses[x], (4, 4)),
        _array(guesses[z], (4, 4)),
        float(guesses["sigma_rad"]),
        float(guesses["sigma_m"]),
        Noise.of_robot(float(noise["robot_rotation_rad"]), float(noise["robot_translation_m"])),
        float(noise["pixel_px"]),
        Limits(**limits),
        tuple(
            Box(
                value["name"], _array(value["base_from_box"], (4, 4)), _array(value["size_m"], (3,))
            )
            for value in content["boxes"]
        ),
        None if covariance is None else _array(covariance, (12, 12)),
    )


def _array(values: object, shape: tuple[int, ...]) -> FloatArray:
    """Checked array of finite numbers in a shape; -1 for any length."""
    array = np.array(values, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError("a number that is not finite")
    if array.ndim != len(shape) or any(
        want not in (-1, has) for want, has in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"an array of shape {array.shape} for {shape}")
    return array
