"""Reader of the plan.json that `planning.written` writes: the stops and their cell."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from visioncal.core.documents.jsons import parse_json
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, read_text
from visioncal.core.types import MOUNTS, Camera, CameraKind, FloatArray, Mount, Target
from visioncal.estimation.chain import edge_names
from visioncal.estimation.problem_parts import Noise
from visioncal.live.planning.cell import Box, Limits, PlanCell
from visioncal.live.planning.purposes import Purpose, purpose_of
from visioncal.live.planning.written import SCHEMA
from visioncal.robot import Robot
from visioncal.vision.targets import (
    load_target,
    target_document,
    target_from_document,
    target_names,
)

_FILE = "plan.json"


@dataclass(frozen=True, eq=False)
class Stop:
    """A stop to drive to."""

    view: int  # Number of the view to be taken there.
    q: FloatArray  # (n,) joint angles [rad].
    via: FloatArray  # (j, n) via postures after the previous stop [rad].
    words: str = ""  # What it contributes.


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
    DocumentTable(document, str(file)).integer("schema", SCHEMA, SCHEMA)
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
    return PlanCell(
        cast("Mount", mount),
        Robot.from_document(content["robot"]),
        _camera(lens),
        _target(content["target"]),
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


def _camera(lens: Mapping[str, Any]) -> Camera:
    width, height = lens["resolution"]
    kind = DocumentTable(lens, "plan.json: camera").choice("model", ("brown", "fisheye"))
    return Camera(
        cast("CameraKind", kind),
        (int(width), int(height)),
        _array(lens["matrix"], (4,)),
        np.array(lens["distortion"], dtype=float),
    )


def _target(content: Mapping[str, Any]) -> Target:
    """Reads the board; one that comes with visioncal gets its name."""
    target = target_from_document(content, "board")
    for name in target_names():
        shipped = load_target(name)
        if target_document(shipped) == target_document(target):
            return shipped
    return target


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
