"""A cell's second board: where it is, and which stops of the robot show which board."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.simulation.boards import Sheet, centre_m, corners_m, found_in_part
from visioncal.simulation.optics import sees
from visioncal.simulation.options import CellOptions, Second
from visioncal.simulation.poses import LEAST_SHARE, MARGIN_PX

# What a session calls the boards where there are two.
NAMES = ("first", "second")
# A board is not looked at from farther aside.
_LEAST_COSINE = 0.5
# How far aside the flange carries its second board [m].
_ASIDE_M = 0.10


@dataclass(frozen=True, eq=False)
class Shown:
    """The views of a cell, one for each board that a stop of the robot shows.

    Attributes:
        stops: (m,) the stop of each view, ascending.
        boards: (m,) the board that it shows.
    """

    stops: IntArray
    boards: IntArray


def sheets_of(options: CellOptions) -> tuple[Sheet, ...]:
    """The boards as they were printed."""
    first = Sheet(target=options.target, scale=options.board_scale, bow_m=options.board_bow_m)
    return (first,) if options.second is None else (first, options.second)


def with_second(
    transforms: Mapping[str, FloatArray], sheets: Sequence[Sheet], second: Second
) -> dict[str, FloatArray]:
    """Adds the second board to the two edges of a cell, and names both boards' edges."""
    (x_name, x), (z_name, z) = transforms.items()
    first, further = (centre_m(sheet) for sheet in sheets)
    middle = z[:3, :3] @ first + z[:3, 3]
    around = Rotation.from_euler("z", second.turn_rad).as_matrix()
    if x_name == "flange_from_cam":
        place = around @ middle
        lean = np.cross([0.0, 0.0, 1.0], place / np.linalg.norm(place))
        # The print faces the base, as the arm comes from there.
        turn = Rotation.from_rotvec(-second.tilt_rad * lean).as_matrix() @ around @ z[:3, :3]
    else:
        aside = around @ np.array([1.0, 0.0, 0.0])
        place = middle + _ASIDE_M * aside
        lean = np.cross([0.0, 0.0, 1.0], aside)
        turn = Rotation.from_rotvec(second.tilt_rad * lean).as_matrix() @ z[:3, :3]
    return {
        x_name: x,
        f"{z_name}_{NAMES[0]}": z,
        f"{z_name}_{NAMES[1]}": compose(turn, place - turn @ further),
    }


def chains(transforms: Mapping[str, FloatArray]) -> Iterator[dict[str, FloatArray]]:
    """Both edges of each board's chain, under the names of a cell with one board."""
    (x_name, x), *boards = transforms.items()
    z_name = "base_from_target" if x_name == "flange_from_cam" else "flange_from_target"
    for _, z in boards:
        yield {x_name: x, z_name: z}


def shown_at(options: CellOptions, sheets: Sequence[Sheet], poses: Sequence[FloatArray]) -> Shown:
    """Finds which boards each of the stops shows.

    Args:
        options: The cell.
        sheets: Its boards.
        poses: (s, 4, 4) `cam_from_target` of each board at all stops.
    """
    count = len(poses[0])
    if len(sheets) == 1:
        return Shown(np.arange(count), np.zeros(count, dtype=np.int64))
    seen = [looks_at(options.camera, *pair) for pair in zip(sheets, poses, strict=True)]
    # What a stop was made for is in view.
    aimed = np.arange(count) % len(sheets)
    visible = np.array(seen).T
    visible[np.arange(count), aimed] = True
    stops, boards = np.nonzero(visible)
    return Shown(stops, boards)


def looks_at(camera: Camera, sheet: Sheet, cam_from_target: FloatArray) -> Mask:
    """(s,) in which of the stops a board is in view, not too much from the side."""
    points = corners_m(sheet) @ np.swapaxes(cam_from_target[:, :3, :3], 1, 2)
    points = points + cam_from_target[:, None, :3, 3]
    towards = points / np.linalg.norm(points, axis=2, keepdims=True)
    facing = np.einsum("mni,mi->mn", towards, cam_from_target[:, :3, 2]) > _LEAST_COSINE
    looks = facing.all(axis=1) & (towards[:, :, 2] > _LEAST_COSINE).all(axis=1)
    if not looks.any():
        return np.asarray(looks)
    share = sees(camera, points[looks], MARGIN_PX).mean(axis=1)
    looks[looks] = share >= (LEAST_SHARE if found_in_part(sheet.target) else 1.0)
    return np.asarray(looks)
