"""Ground truth of a simulated session, in a file beside its folder."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import decode_text, read_bytes, write_atomically
from visioncal.core.types import Camera, FloatArray
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.layout import CellOptions


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a simulated session."""

    transforms: Mapping[str, FloatArray]  # True edges by their names in results, each (4, 4).
    camera: Camera  # True intrinsics.
    base_from_flange: FloatArray  # (m, 4, 4) true flange poses.
    cam_from_target: FloatArray  # (m, 4, 4) true board poses.
    wrong_views: tuple[int, ...]  # Views with a wrong report.
    # Real arm: Denavit-Hartenberg parameters by name; a, d [m], alpha, beta, offset [rad], each
    # (n,).
    arm: Mapping[str, FloatArray]
    options: Mapping[str, Any]  # Options of the cell as plain values, including noise levels.


def truth_path(folder: Path | str) -> Path:
    """Path of a simulated session's ground truth: beside its folder, never inside."""
    folder = Path(folder)
    return folder.with_name(f"{folder.name}.truth.json")


def read_truth(path: Path | str) -> Truth:
    """Reads the ground truth of a simulated session.

    Args:
        path: Folder of the session, or its `.truth.json`.

    Raises:
        DataError: The file is missing or has other content.
    """
    path = Path(path)
    if path.suffix != ".json":
        path = truth_path(path)
    text = decode_text(read_bytes(path), str(path))
    try:
        content = json.loads(text)
        camera = content["camera"]
        width, height = camera["resolution"]
        return Truth(
            transforms={key: np.array(value) for key, value in content["transforms"].items()},
            camera=Camera(
                "fisheye" if camera["model"] == "fisheye" else "brown",
                (int(width), int(height)),
                np.array(camera["matrix"], dtype=float),
                np.array(camera["distortion"], dtype=float),
            ),
            base_from_flange=np.array(content["base_from_flange"]),
            cam_from_target=np.array(content["cam_from_target"]),
            wrong_views=tuple(content["wrong_views"]),
            arm={key: np.array(value) for key, value in content["arm"].items()},
            options=content["options"],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is not the truth of a simulated session: {error!r}.", culprits=[str(path)]
        ) from error


def truth_of(cell: SimulatedCell) -> dict[str, Any]:
    """Content of a cell's ground truth file: view by view of one robot, else stop by stop."""
    content: dict[str, Any] = {"schema": 1, "wrong_views": cell.wrong_views}
    if isinstance(cell.options, CellOptions):
        options, arm = asdict(cell.options), asdict(cell.robot.true_arm)
        stops = [sight.stop for sight in cell.sights]
        content |= {
            "transforms": cell.transforms,
            "camera": options.pop("camera"),
            "options": options,
            "arm": {key: value for key, value in arm.items() if key != "name"},
            "base_from_flange": cell.robot.true_base_from_flange[stops],
            "cam_from_target": cell.cam_from_target,
        }
        return content | dict(cell.facts)
    layout, robots = cell.layout, cell.robots
    content |= {
        "parents": cell.parents,
        "transforms": dict(cell.mountings),
        "wrong_stops": {name: robot.wrong_stops for name, robot in robots.items()},
        "moved": [
            {"frame": move.frame, "from_stop": layout.first_pushed(move)} for move in layout.moved
        ],
        "options": asdict(cell.options),
        "arms": {name: asdict(robot.true_arm) for name, robot in robots.items()},
        "base_from_flange": {name: robot.true_base_from_flange for name, robot in robots.items()},
    }
    return content | dict(cell.facts)


def write_truth(folder: Path, content: Mapping[str, Any]) -> None:
    """Writes the ground truth of a session beside its folder; arrays as lists."""
    text = json.dumps(content, indent=1, default=np.ndarray.tolist)
    write_atomically(truth_path(folder), text + "\n")
