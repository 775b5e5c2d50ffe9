"""Writers of a plan: table of stops, JSON, and program for a UR controller."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.choices import PLAN_ACCELERATION, PLAN_SPEED
from visioncal.core.files import one_line, sha256
from visioncal.core.types import FloatArray, Need
from visioncal.core.version import __version__
from visioncal.estimation.chain import edge_names
from visioncal.live.planning.cell import Box, PlanCell
from visioncal.live.planning.design import Accuracy, Wish
from visioncal.live.planning.plan import Plan, PlannedStop, PlanRequest
from visioncal.robot import has_ur_axes
from visioncal.session.columns import POSE
from visioncal.vision.targets import target_document

SCHEMA = 1
# Time for vibrations to decay before an image is taken [s].
_SETTLING_S = 0.5


def stops_table(plan: Plan) -> str:
    """Writes the stops as a views.csv, with poses by the robot's model and names for the images."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    joints = [f"q{index + 1}_rad" for index in range(plan.cell.robot.joint_count)]
    writer.writerow(["view", "image", *joints, *POSE, "why"])
    for stop in plan.stops:
        pose = stop.base_from_flange
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = [*stop.q.tolist(), *pose[:3, 3].tolist(), *turn.tolist()]
        cells = [f"{number:.9f}" for number in numbers]
        writer.writerow([stop.view, image_of(stop), *cells, stop.words])
    return text.getvalue()


def image_of(stop: PlannedStop) -> str:
    """Name of the image to be taken at a stop."""
    return f"images/{stop.view:03d}.png"


def plan_document(plan: Plan, source: Mapping[str, str]) -> dict[str, Any]:
    """Builds the content of plan.json; `source` tells the reader where the cell comes from."""
    request, design = plan.request, plan.design
    inputs: dict[str, Any] = {
        "cell": _cell_document(plan.cell),
        "request": _request_document(request),
    }
    if plan.start is not None:
        inputs["recorded_views"] = list(plan.start.views)
    document: dict[str, Any] = {
        "schema": SCHEMA,
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
    if design.met is not None:
        document["wish_met"] = design.met
    if plan.need is not None:
        document["need"] = {
            **_stated_values(plan.need.need),
            "probability": plan.need.probability,
            **({} if plan.start is None else {"probability_before": plan.need.before}),
            "probability_of_all_candidates": plan.need.best,
        }
    if plan.shortfall:
        document["shortfall"] = plan.shortfall
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


def program_of(plan: Plan) -> str:
    """Writes a program that drives a UR to the stops and waits at each; empty for other arms.

    Between postures it moves straight in joint space, without blending: the path that was checked.
    """
    robot = plan.cell.robot
    if not has_ur_axes(robot):
        return ""
    lines = [
        *(f"# {name}" for name in _heading(plan)),
        "def visioncal_plan():",
        f"  speed = {PLAN_SPEED}          # rad/s",
        f"  acceleration = {PLAN_ACCELERATION}   # rad/s^2",
        f"  settling = {_SETTLING_S}       # s",
        *(f"  {line}" for stop in plan.stops for line in _stop_lines(stop)),
        '  popup("All stops are done.", title="visioncal", blocking=True)',
        "end",
        "",
        "visioncal_plan()",
        "",
    ]
    return "\n".join(lines)


def _heading(plan: Plan) -> Iterator[str]:
    cell = plan.cell
    yield f"visioncal {__version__}: {len(plan.stops)} stops for {plan.request.purpose.name}"
    heading = one_line(f"Robot {cell.robot.name}, {cell.mount}, board {cell.target.name}.")
    yield heading.encode("ascii", "replace").decode()
    yield "Look at plan.rrd first, then run it at reduced speed, with a hand on the stop button."
    yield "The ways were looked at with capsules for the arm and with what was declared of the"
    yield "cell: floor, boxes, board, camera. Cables, grippers and people are not known to it."
    if plan.request.start_q is None:
        yield "The way from where the arm stands now to the first stop was not looked at: bring it"
        yield "there by hand first."
    yield "At each stop the program waits: take the image that it names, write down the pose."


def _stop_lines(stop: PlannedStop) -> Iterator[str]:
    for posture in stop.via:
        yield _move(posture, "on the way")
    yield _move(stop.q, f"view {stop.view}")
    yield "sleep(settling)"
    yield (
        f'popup("View {stop.view}: take {image_of(stop)}, then continue.", title="visioncal", '
        "blocking=True)"
    )


def _move(q: FloatArray, words: str) -> str:
    joints = ", ".join(f"{value:.6f}" for value in q)
    return f"movej([{joints}], a=acceleration, v=speed)  # {words}"


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


def _stated_values(wish: Wish | Need) -> dict[str, float]:
    return {name: getattr(wish, name) for name in ("mm", "deg") if getattr(wish, name) is not None}


def _request_document(request: PlanRequest) -> dict[str, Any]:
    wish = request.wish
    document: dict[str, Any] = {
        "purpose": request.purpose.name,
        "stops": request.count,
        "candidates": request.candidates,
        "seed": request.seed,
    }
    if wish is not None:
        document["wish"] = _stated_values(wish)
    if request.need is not None:
        document["need"] = _stated_values(request.need)
    if request.workspace is not None:
        document["workspace"] = _box_document(request.workspace)
    if request.start_q is not None:
        document["start_q"] = request.start_q.tolist()
    return document
