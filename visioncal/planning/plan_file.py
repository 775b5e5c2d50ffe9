"""Files of a plan: table of stops, program for a UR controller, and plan.json with its reader."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from visioncal.core.choices import PLAN_ACCELERATION, PLAN_SPEED
from visioncal.core.codec import Key, Vector, read, reading, write
from visioncal.core.conventions import PoseForm
from visioncal.core.documents.jsons import check_schema, parse_stored
from visioncal.core.documents.pendants import pendant_words
from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError
from visioncal.core.files import one_line, read_text, sha256
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.planning.cell import PlanCell
from visioncal.planning.plan import ACCURACY, Plan, PlannedStop, PlanRequest, Stop, StoredPurpose
from visioncal.robot import Robot
from visioncal.robot.conversion import has_ur_axes
from visioncal.session.columns import POSE, pose_row

_FILE, _SCHEMA = "plan.json", 1


def stops_table(plan: Plan, form: PoseForm | None = None) -> str:
    """Writes the stops as a views.csv, with poses by the robot's model and names for the images.

    Beside metres and radians stand degrees, and the poses in the maker's form where it is known.
    """
    joints = [f"q{index + 1}_rad" for index in range(plan.cell.robot.joint_count)]
    shown = ["joints_deg"] + ([] if form is None else [f"pose_{form.name}"])
    rows: list[list[object]] = [["view", "image", *joints, *POSE, "why", *shown]]
    for stop in plan.stops:
        numbers = [*stop.q.tolist(), *pose_row(stop.base_from_flange).values()]
        cells = [f"{number:.9f}" for number in numbers]
        words = [joints_in_degrees(stop.q)]
        words += [] if form is None else [pendant_words(stop.base_from_flange, form)]
        rows.append([stop.view, _image_of(stop), *cells, stop.words, *words])
    return csv_text(rows)


def joints_in_degrees(q: FloatArray) -> str:
    """(n,) joint angles [rad] as a pendant shows them."""
    return " ".join(f"{angle:.3f}" for angle in np.rad2deg(q))


def _image_of(stop: Stop) -> str:
    """Name of the image to be taken at a stop."""
    return f"images/{stop.view:03d}.png"


def plan_document(plan: Plan, source: Mapping[str, str]) -> dict[str, Any]:
    """Builds the content of plan.json; `source` says where the cell comes from."""
    request, design, need = plan.request, plan.design, plan.need
    inputs: dict[str, Any] = {"cell": write(PlanCell, plan.cell)}
    inputs["request"] = write(PlanRequest, request)
    predicted = {"after": ACCURACY.write(design.predicted)}
    predicted["all_candidates"] = ACCURACY.write(design.best)
    if plan.start is not None:
        inputs["recorded_views"] = list(plan.start.views)
        predicted["before"] = ACCURACY.write(design.before)
    document: dict[str, Any] = {
        "schema": _SCHEMA,
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": dict(source),
        "inputs_sha256": sha256(json.dumps(inputs, sort_keys=True).encode()),
        "purpose": request.purpose.name,
        "judged": request.purpose.errors,
        "predicted": predicted,
        "criterion": {"name": request.criterion, "value": design.sigma_mm},
        "stops": [write(PlannedStop, stop) for stop in plan.stops],
        "joints": list(plan.cell.robot.joint_names),
        "path_rad": plan.length_rad,
        "candidates": {"found": plan.candidate_count, "lost_to": dict(plan.lost)},
        **inputs,
    }
    if plan.start is not None and plan.start.refusal:
        document["refusal_before"] = plan.start.refusal
    if need is not None:
        document["need"] = inputs["request"]["need"] | {
            "probability": need.probability,
            "probability_before": need.before,
            "probability_of_all_candidates": need.best,
        }
        if need.limits:
            document["shortfall"] = need.limits
        if need.condition:
            document["condition"] = need.condition
    if plan.in_the_way:
        document["exchanged_because_of"] = list(plan.in_the_way)
    return document


def program_of(plan: Plan) -> str:
    """Writes a program that drives a UR to the stops and waits at each; empty for other arms."""
    cell = plan.cell
    named = f"Robot {cell.robot.name}, {cell.mount}, board {cell.target.name}."
    begins = plan.request.start_q is not None
    return ur_program(
        cell.robot, plan.request.purpose.name, named, plan.stops, _image_taken, begins=begins
    )


def _image_taken(stop: Stop) -> str:
    return f"take {_image_of(stop)}"


def ur_program(
    robot: Robot,
    purpose: str,
    named: str,
    stops: Sequence[Stop],
    act: Callable[[Stop], str],
    *,
    begins: bool,
) -> str:
    """Writes a program that drives a UR to stops and waits at each; empty for other arms.

    Between postures it moves straight in joint space, without blending: the path that was checked.

    Args:
        robot: The arm.
        purpose: What the stops are for.
        named: A sentence that names the cell.
        stops: The stops in driving order.
        act: Says what a person does at a stop.
        begins: Whether the way from where the arm stands was checked.
    """
    start: tuple[str, ...] = ()
    if not has_ur_axes(robot):
        return ""
    if not begins:
        start = (
            "# The way from where the arm stands now to the first stop was not checked: bring it",
            "# there by hand first.",
        )
    lines = [
        f"# visioncal {__version__}: {len(stops)} stops for {purpose}",
        f"# {one_line(named).encode('ascii', 'replace').decode()}",
        "# Look at plan.rrd first, then run it at reduced speed, with a hand on the stop button.",
        "# The ways were checked with capsules for the arm and with what was declared of the",
        "# cell: floor, boxes, board, camera. Cables, grippers and people are not known to it.",
        *start,
        "# At each stop the program waits: do what it asks for, write down the pose.",
        "def visioncal_plan():",
        f"  speed = {PLAN_SPEED}          # rad/s",
        f"  acceleration = {PLAN_ACCELERATION}   # rad/s^2",
        "  settling = 0.5       # s",
    ]
    for stop in stops:
        words = ["on the way"] * len(stop.via) + [f"view {stop.view}"]
        for posture, word in zip((*stop.via, stop.q), words, strict=True):
            joints = ", ".join(f"{value:.6f}" for value in posture)
            lines.append(f"  movej([{joints}], a=acceleration, v=speed)  # {word}")
        lines.append("  sleep(settling)")
        lines.append(
            f'  popup("View {stop.view}: {act(stop)}, then continue.", '
            'title="visioncal", blocking=True)'
        )
    lines.append('  popup("All stops are done.", title="visioncal", blocking=True)')
    return "\n".join([*lines, "end", "", "visioncal_plan()", ""])


@dataclass(frozen=True, eq=False)
class PlanFile:
    """A plan read from its file."""

    cell: PlanCell
    purpose: StoredPurpose
    stops: tuple[Stop, ...]  # In driving order.
    digest: Annotated[str, Key("inputs_sha256")]  # SHA-256 of the plan's inputs.
    # (n,) joint angles before the first stop [rad]; None where they were not stated, and the path
    # to the first stop was not checked.
    start_q: Vector | None = None


def read_plan(path: Path | str) -> PlanFile:
    """Reads a plan from its plan.json, or from the folder of it; raises DataError."""
    path = Path(path)
    file = path / _FILE if path.is_dir() else path
    document = parse_stored(read_text(file), str(file))
    with reading(str(file), "a plan", "Make one with visioncal plan -o FOLDER."):
        check_schema(document, _SCHEMA, "Make one with visioncal plan -o FOLDER.")
        request = document["request"]
        start = {"start_q": request["start_q"]} if "start_q" in request else {}
        plan = read(PlanFile, document | start, "")
        cell, count = plan.cell, plan.cell.robot.joint_count
        if "floor_m" not in document["cell"]["limits"]:
            # None is not written, whereas the default is a floor at height zero.
            cell = replace(cell, limits=replace(cell.limits, floor_m=None))
        stops = tuple(replace(stop, via=stop.via.reshape(-1, count)) for stop in plan.stops)
        postures = [stop.q for stop in stops] + ([] if plan.start_q is None else [plan.start_q])
        if any(len(q) != count for q in postures):
            raise DataError(f"a posture has not {count} joint angles.", culprits=["stops"])
        return replace(plan, cell=cell, stops=stops)
