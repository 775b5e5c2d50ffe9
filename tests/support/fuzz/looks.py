"""Looks of a working cell, as lines for the guard, and what moves in them."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support.later import knock

from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import FloatArray
from visioncal.session.columns import MEASURED_CAM_POSE, POSE

COUNT = 30
# The kinds of what moves.
MOVED = ("camera", "target", "flange", "joint", "quaternions", "clock")


def write_looks(path: Path, session: Path) -> None:
    """Writes looks an hour apart, each at a view of a session."""
    with (session / "views.csv").open(encoding="utf-8") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    looks = [
        {
            "time_s": 3600.0 * at,
            "base_from_flange": [row[name] for name in POSE],
            "cam_from_target": [row[name] for name in MEASURED_CAM_POSE],
            "joints_rad": [value for name, value in row.items() if name.endswith("_rad")],
        }
        for at, row in zip(range(COUNT), rows * COUNT, strict=False)
    ]
    path.write_text("".join(f"{json.dumps(look)}\n" for look in looks))


def moved_looks(looks: list[dict[str, Any]], rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Looks in which something moves from one on, by 0.1 mm to 10 m and 0.001 to 180 deg."""
    kind, first = rng.choice(MOVED), int(rng.integers(len(looks)))
    twist = knock(rng, 10.0 ** rng.uniform(-1.0, 4.0), min(10.0 ** rng.uniform(-3.0, 2.5), 180.0))
    key = "base_from_flange" if kind == "flange" else "cam_from_target"
    for at, look in enumerate(looks):
        pose, joints = _pose(look[key]), list(look["joints_rad"])
        if at >= first and kind == "camera":
            pose = invert(exp(twist)) @ pose
        elif at >= first and kind in ("target", "flange"):
            pose = pose @ exp(twist)
        elif at >= first and kind == "joint":
            joints[at % 2] += float(np.linalg.norm(twist[:3]))
        sign = -1.0 if at >= first and kind == "quaternions" else 1.0
        numbers = [*pose[:3, 3], *(sign * Rotation.from_matrix(pose[:3, :3]).as_quat())]
        ahead_s = 1e6 * (at < first and kind == "clock")
        stamped = {"time_s": look["time_s"] + ahead_s, "joints_rad": joints}
        yield {**look, **stamped, key: [float(number) for number in numbers]}


def _pose(numbers: list[float]) -> FloatArray:
    return compose(Rotation.from_quat(numbers[3:]).as_matrix(), np.array(numbers[:3]))
