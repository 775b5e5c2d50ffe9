"""What stands in the way of a planned motion, as it is drawn."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import colours, paths
from visioncal.present.recording.arm import placed

# A piece of floor is drawn, so many times as wide as the cell.
_FLOOR = 1.3
# And a little lower, so that a board on it is seen [m].
_BELOW_M = 0.004


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Something in the way: its centre's frame in the base (4, 4) and its lengths (3,) [m]."""

    name: str
    base_from_box: FloatArray
    size_m: FloatArray


def log_obstacles(
    stream: rr.RecordingStream, obstacles: Sequence[Obstacle], floor_m: float | None, size_m: float
) -> None:
    """Draws the floor around the cell's centre, and the declared boxes.

    Args:
        stream: Where to.
        obstacles: The boxes.
        floor_m: Height of the floor in the base [m]; None for none.
        size_m: Of the cell [m].
    """
    frame = rr.CoordinateFrame(paths.BASE_FRAME)
    if floor_m is not None:
        half = _FLOOR * size_m
        floor = rr.Boxes3D(
            centers=[[0.0, 0.0, floor_m - _BELOW_M]],
            half_sizes=[[half, half, 0.0]],
            colors=colours.GRID,
        )
        stream.log(f"{paths.OBSTACLES}/floor", frame, floor, static=True)
    for at, box in enumerate(obstacles):
        drawn = rr.Boxes3D(
            centers=[np.zeros(3)],
            half_sizes=[0.5 * np.asarray(box.size_m)],
            colors=[(*colours.REJECTED, 90)],
            labels=[box.name],
            fill_mode="solid",
        )
        name = f"box_{at + 1}"
        pose = placed(box.base_from_box, paths.BASE_FRAME, name)
        entity = f"{paths.OBSTACLES}/{name}"
        stream.log(entity, pose, rr.CoordinateFrame(name), drawn, static=True)
