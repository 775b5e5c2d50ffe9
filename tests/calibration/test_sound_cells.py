"""Odd but sound cells are accused of nothing, by `calibrate` and by `doctor`.

Each cell errs as good cells do: 0.03 mm and 0.03 mrad of the robot, 0.1 px of the corners. Odd is
how its stops were chosen, how its parts are mounted, or how its rows are written.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import slow

from visioncal import calibrate, doctor
from visioncal.calibration.suspects import rounded_poses
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import Camera
from visioncal.core.verdict import LEAST_LIKELY
from visioncal.session import Session
from visioncal.vision.targets import corner_positions, load_target

BOARD = load_target("charuco_9x6_30mm")
POINTS = corner_positions(BOARD)
# Of the flange, by a radian and metres; of a corner.
ROBOT, CORNER_PX = np.repeat([3e-5, 3e-5], 3), 0.1
COUNT = 20


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell with a camera on the flange."""

    lens: Camera = field(
        default_factory=lambda: Camera(
            "brown",
            (1280, 960),
            np.array([1180.0, 1182.0, 644.0, 475.0]),
            np.array([-0.1, 0.05, 3e-4, -2e-4, 0.0]),
        )
    )
    flange_from_cam: np.ndarray = field(
        default_factory=lambda: compose(
            Rotation.from_euler("xyz", [4, -3, 88], degrees=True).as_matrix(),
            np.array([0.03, -0.06, 0.08]),
        )
    )
    base_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))


def stops(cell, count=COUNT, spread=0.12, seed=5):
    """Commanded poses of the flange from which the camera looks at the board, in the base."""
    rng = np.random.default_rng(seed)
    middle, found = POINTS.mean(axis=0), []
    for _ in range(count):
        tilt = Rotation.from_euler(
            "xyz", [*rng.uniform(-28, 28, 2), rng.uniform(-70, 70)], degrees=True
        )
        away = np.array([*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.42, 0.42 + 2 * spread)])
        target_from_cam = compose(tilt.as_matrix(), np.zeros(3))
        target_from_cam[:3, 3] = middle - target_from_cam[:3, :3] @ away
        found.append(cell.base_from_world @ WORLD_FROM_BOARD @ target_from_cam)
    return np.array(found) @ invert(cell.flange_from_cam)


WORLD_FROM_BOARD = compose(
    Rotation.from_euler("xyz", [2, -1, 31], degrees=True).as_matrix(), np.array([0.52, -0.13, 0.05])
)


def session_of(cell, commanded, seed=1):
    """The session of its corners, and of the commanded poses that the robot reports."""
    rng = np.random.default_rng(seed)
    true = commanded @ exp(rng.normal(size=(len(commanded), 6)) * ROBOT)
    corners = []
    for pose in true:
        base_from_board = cell.base_from_world @ WORLD_FROM_BOARD
        cam_from_board = invert(pose @ cell.flange_from_cam) @ base_from_board
        turn = cv2.Rodrigues(cam_from_board[:3, :3])[0]
        fx, fy, cx, cy = cell.lens.matrix
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        px = cv2.projectPoints(POINTS, turn, cam_from_board[:3, 3], matrix, cell.lens.distortion)[0]
        px = px[:, 0] + rng.normal(0.0, CORNER_PX, (len(POINTS), 2))
        ids = np.flatnonzero(((px > 5) & (px < np.array(cell.lens.resolution) - 6)).all(axis=1))
        corners.append((ids, px[ids]))
    return Session.from_corners(
        corners, commanded, BOARD, cell.lens.resolution, mount="eye-in-hand", camera=cell.lens
    )


def rounded_to(poses, mm, deg, form="euler-ZYX-deg"):
    """Poses as someone types them: whole millimetres, and angles of a maker's form."""
    found = poses.copy()
    found[:, :3, 3] = np.round(1e3 * poses[:, :3, 3] / mm) * mm / 1e3
    angles = ROTATION_FORMS[form].write(poses[:, :3, :3])
    found[:, :3, :3] = ROTATION_FORMS[form].read(np.round(angles / deg) * deg)
    return found


def accused(session):
    """Kinds of causes that a verdict finds likely, and all that doctor finds."""
    verdict = calibrate(session).verdict
    likely = {
        found.kind
        for found in verdict.findings
        if found.probability >= LEAST_LIKELY and not found.is_share
    }
    return likely | {found.kind for found in doctor(session).findings}


USUAL = Cell()
HANGING = replace(
    USUAL,
    base_from_world=compose(
        Rotation.from_euler("xyz", [180, 0, 20], degrees=True).as_matrix(),
        np.array([6.0, -4.0, 2.5]),
    ),
)
TURNED = replace(
    USUAL,
    flange_from_cam=compose(
        Rotation.from_euler("xyz", [0, 0, 180], degrees=True).as_matrix(), np.array([0.0, 0.0, 0.2])
    ),
)
OFF_CENTRE = replace(
    USUAL, lens=replace(USUAL.lens, matrix=np.array([1180.0, 1120.0, 540.0, 560.0]))
)
CELLS = {
    "whole millimetres": lambda: (USUAL, rounded_to(stops(USUAL), 1.0, 0.1)),
    "whole degrees": lambda: (USUAL, rounded_to(stops(USUAL), 5.0, 1.0)),
    "whole degrees of ABB's or FANUC's angles": lambda: (
        USUAL,
        rounded_to(stops(USUAL), 10.0, 1.0, "euler-xyz-deg"),
    ),
    "one distance": lambda: (USUAL, stops(USUAL, spread=0.0)),
    "each stop twice": lambda: (USUAL, np.repeat(stops(USUAL, 12), 2, axis=0)),
    "there and back": lambda: (USUAL, np.concatenate([stops(USUAL, 12), stops(USUAL, 12)[::-1]])),
    "a robot that hangs, far from its world's origin": lambda: (HANGING, stops(HANGING)),
    "a camera that is mounted turned": lambda: (TURNED, stops(TURNED)),
    "a lens off the sensor's centre, with other pixels": lambda: (OFF_CENTRE, stops(OFF_CENTRE)),
    "twelve stops": lambda: (USUAL, stops(USUAL, 12)),
}


# Those that looked most like a mistake.
QUICK = {"whole millimetres"}


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in CELLS])
def test_an_odd_but_sound_cell_is_accused_of_nothing(name):
    assert not accused(session_of(*CELLS[name]()))


@pytest.mark.parametrize("seed", [1, 5])
def test_an_exact_lens_that_is_held_within_its_sigma_is_not_accused(seed):
    """The noise by which lens and frames were found is not that by which the lens is tested."""
    session = session_of(USUAL, stops(USUAL, seed=seed), seed)
    camera = {**session.document["camera"], "intrinsics": "hold", "matrix_sigma_px": 1.0}
    cells = [[view.cell(name) for name in session.columns] for view in session.views]
    held = session.with_content(document={**session.document, "camera": camera}, cells=cells)
    found = calibrate(held)
    assert not [finding for finding in found.verdict.findings if finding.kind == "lens"]


@pytest.mark.slow
def test_an_accusation_of_a_sound_cell_is_found(monkeypatch):
    # Round numbers alone, whatever the residuals show.
    monkeypatch.setattr(rounded_poses, "_SHOWN", 1e-9)
    assert "rounded_poses" in accused(session_of(*CELLS["whole millimetres"]()))


@pytest.mark.parametrize(("mended", "step"), [(0, 1.0), (3, 1.0), (10, 0.0)])
def test_poses_are_rounded_where_most_rows_are(mended, step):
    """A copy from whose rows a tool was taken off has many digits in these."""
    numbers = np.round(np.random.default_rng(3).uniform(-500.0, 500.0, (18, 3)))
    numbers[:mended] += 0.1234
    assert rounded_poses._step(numbers) == step
