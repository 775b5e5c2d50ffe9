"""Sessions with images of simulated cells, kept in memory, for a camera that is calibrated."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from support.picks import calibration_of

from visioncal.core.types import FloatArray, Mount
from visioncal.results import Calibration
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import CellOptions, SimulatedCell, prepare_scene, render, simulate
from visioncal.simulation.render import encode
from visioncal.vision.targets import target_document


@dataclass(frozen=True, eq=False)
class Shot:
    """One row of a session: which of the cell's views is its picture, and where the flange was."""

    picture: int
    base_from_flange: FloatArray | None


@lru_cache
def calibrated_cell(mount: Mount, views: int = 14) -> tuple[SimulatedCell, Calibration]:
    """A good cell, and what its corners give: no image is rendered for that."""
    cell = simulate(CellOptions(mount=mount, views=views, seed=21, pixel_sigma_px=0.05))
    return cell, calibration_of(cell)


@lru_cache
def picture(mount: Mount, index: int) -> bytes:
    """A rendered view of the calibrated cell, as a file."""
    return encode(render(_scene(mount), index), None)


@lru_cache
def _scene(mount: Mount):
    return prepare_scene(calibrated_cell(mount)[0])


def shots(cell: SimulatedCell, count: int) -> list[Shot]:
    """The cell's first views as they were taken."""
    return [Shot(at, cell.robot.base_from_flange[at]) for at in range(count)]


def session_of(cell: SimulatedCell, rows: Sequence[Shot], **more: Sequence[str]) -> Session:
    """A session of such shots, numbered from 30; `more` are further columns by their names."""
    mount, target, camera = cell.options.mount, cell.options.target, cell.options.camera
    document = {
        "schema": 1,
        "name": "the part",
        "mount": mount,
        "target": f"{target.name}.toml",
        "camera": {"resolution": list(camera.resolution)},
    }
    cells = []
    for at, row in enumerate(rows):
        pose = row.base_from_flange
        numbers = [""] * len(POSE) if pose is None else map(repr, pose_row(pose).values())
        cells.append([str(30 + at), f"{at}.png", *numbers, *(group[at] for group in more.values())])
    images = MemoryImages({f"{at}.png": picture(mount, row.picture) for at, row in enumerate(rows)})
    columns = ("view", "image", *POSE, *more)
    return Session.assemble(
        document, columns, cells, images, target_document=target_document(target)
    )
