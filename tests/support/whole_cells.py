"""A simulated cell of two arms, a fixed camera and one in a hand, recorded as corners."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from visioncal.core.transforms import invert
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    BoardAt,
    CameraAt,
    NetworkOptions,
    RobotAt,
    SimulatedCell,
    cell_session,
    simulate,
)

# Boards whose size is known: else it is most of what a target's place is uncertain by.
FLOOR = replace(BOARDS["charuco"], square_sigma_m=1e-7)
PLATE = replace(BOARDS["checkerboard"], square_sigma_m=1e-7)
OPTIONS = NetworkOptions(
    robots=(RobotAt("a", (-0.6, 0.0, 0.0)), RobotAt("b", (0.6, 0.05, 0.02))),
    cameras=(
        CameraAt("left", place_m=(0.0, -1.0, 1.1), camera=CAMERAS["fine"]),
        CameraAt("hand", on="a"),
    ),
    boards=(
        BoardAt("floor", place_m=(0.0, 0.0, 0.05), target=FLOOR),
        BoardAt("plate_a", on="a", target=FLOOR),
        BoardAt("plate_b", on="b", target=PLATE),
    ),
    stops=26,
)
# The stops from here on are kept for what comes after the calibration.
LATER = 20


def recorded(cell: SimulatedCell) -> Session:
    """The session of a cell, with its corners in the place of images."""
    return cell_session(cell, "two arms", seen="corners")


def part(session: Session, first: int, end: int) -> Session:
    """The rows of some stops, with their corners."""
    views = tuple(
        view for view in session.views if view.stop is not None and first <= view.stop < end
    )
    numbers = [view.number for view in views]
    return replace(session, views=views, corner_table=session.corner_table.of_views(numbers))


def saved(folder: Path, cell: SimulatedCell) -> tuple[Path, Path]:
    """Writes what is to be calibrated, and what comes later."""
    session = recorded(cell)
    part(session, 0, LATER).save(folder / "session")
    part(session, LATER, OPTIONS.stops).save(folder / "later")
    return folder / "session", folder / "later"


def simulated(seed: int = 0) -> SimulatedCell:
    return simulate(replace(OPTIONS, seed=seed))


def truth(cell: SimulatedCell, first: str, second: str):
    """Where a frame is in another of the same body: one of them may be a flange or a base."""
    of_first = np.eye(4) if first.startswith("flange") else cell.mountings[first]
    return invert(of_first) @ cell.mountings[second]
