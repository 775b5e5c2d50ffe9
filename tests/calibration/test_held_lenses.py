"""A whole cell whose stated lenses are held and wrong: its cameras disagree about every stop."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import initial_state
from visioncal.calibration.pipeline.solving import initial_inliers
from visioncal.calibration.pipeline.starting import find_start
from visioncal.calibration.run import STAGES, read_cell
from visioncal.simulation import (
    BOARDS,
    BoardAt,
    CameraAt,
    NetworkOptions,
    RobotAt,
    cell_session,
    simulate,
)

OPTIONS = NetworkOptions(
    robots=(RobotAt("a", (-0.6, 0.0, 0.0), wrong_stops=2),),
    cameras=(
        CameraAt("left", place_m=(0.0, -1.0, 1.1)),
        CameraAt("right", place_m=(0.15, 0.95, 1.25)),
        CameraAt("front", place_m=(0.9, -0.5, 1.2)),
    ),
    boards=(BoardAt("plate", "a", target=BOARDS["checkerboard"]),),
    stops=24,
)
# Shares by which the stated focal lengths are wrong, alike in no two cameras.
WRONG = (0.03, -0.03, 0.05)


def test_a_board_does_not_shrink_until_cameras_with_wrong_lenses_agree():
    cell = simulate(OPTIONS)
    session = cell_session(cell, "held", seen="corners")
    cameras = {
        name: {
            **camera,
            "matrix": [*(value * (1.0 + share) for value in camera["matrix"][:2]),
                       *camera["matrix"][2:]],
            "intrinsics": "hold",
        }
        for (name, camera), share in zip(session.document["cameras"].items(), WRONG, strict=True)
    }  # fmt: skip
    session = replace(session, document={**session.document, "cameras": cameras})
    state = initial_state(session, threads=1)
    for stage in STAGES:
        if stage.name == "solve":
            break
        state = stage.run(state)
    start = find_start(read_cell(state), state)
    inliers = initial_inliers(start)
    left_out = {start.cell.rows[row].view for row in np.flatnonzero(~inliers.used)}
    assert set(cell.wrong_views) <= left_out
    assert inliers.used.mean() > 0.75
