"""Columns of the robot's poses whose numbers stand rows apart from the others of their pose."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from visioncal.calibration.guess.fit import STARTS, Fit, robust_fits
from visioncal.calibration.guess.readings import shifted
from visioncal.calibration.guess.recording import CLEAR, EVIDENCE, FEWEST_ROWS
from visioncal.calibration.pipeline.guess_inputs import alike_turning
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import counted, listed
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.chain import robot_part

_SHIFTS = (1, -1, 2, -2, 3, -3)
# Position by axis, and rotation; all four together are rows that are apart.
_PARTS = "xyzR"
_NAMES = dict(zip(_PARTS, ("x_m", "y_m", "z_m", "qx to qw"), strict=True))


def of_other_rows(run: RunState, beside: float) -> Iterator[Finding]:
    """The finding that some columns close the chain with the numbers of rows before or after.

    It does so clearly better than another reading, whose score is `beside`.
    """
    if run.mount is None or run.mount == "instrument":
        return
    seen = alike_turning(run.base_from_flange, run.poses_of_one_board, run.mount)
    views = [view.number for view in run.session.views]
    known = (run.base_from_flange.get(view, np.full((4, 4), np.nan)) for view in views)
    flanges = np.array([*known]).reshape(-1, 4, 4)
    rows = np.array([at for at, view in enumerate(views) if view in seen], dtype=int)
    if len(rows) <= FEWEST_ROWS:
        return
    camera = np.array([seen[views[at]] for at in rows])

    def fitted(parts: str, by: int) -> Fit | None:
        moved = _moved(flanges, parts, shifted(by, len(views)))[rows]
        there = np.isfinite(moved).all(axis=(1, 2))
        if there.sum() <= FEWEST_ROWS:
            return None
        sides = robot_part(moved[there], run.mount or "eye-in-hand")[None], camera[there][None]
        return replace(robust_fits(*sides, STARTS)[0], lost=int(np.sum(~there)))

    choices = ["".join(some) for size in (1, 2, 3) for some in combinations(_PARTS, size)]
    tried = [*product(choices, _SHIFTS)]
    fits = ((fitted(*each), *each) for each in tried)
    found = [(fit, parts, by) for fit, parts, by in fits if fit is not None]
    declared = fitted("", 0)
    if declared is None or not found:
        return
    best, parts, by = max(found, key=lambda item: item[0].log_likelihood)
    odds = EVIDENCE * (best.log_likelihood - declared.log_likelihood) - np.log(len(tried))
    if not best.closes or odds < 2.0 * CLEAR or CLEAR_RATIO * best.score > beside:
        return
    names, apart = listed([_NAMES[part] for part in parts]), counted(abs(by), "row")
    stand, where = ("later", "up") if by > 0 else ("earlier", "down")
    yield Finding(
        "misread_poses",
        f"In views.csv, the numbers of {names} stand {apart} {stand} than the others of their "
        f"pose, as where cells were pasted into other rows: moved, robot and camera agree to "
        f"{best.figures}; as first read, to {declared.figures}.",
        Remedy(
            f"In views.csv, move the cells of {names} {where} by {apart}, delete the rows that "
            "have none then, and calibrate again.",
            CALIBRATE,
        ),
    )


def _moved(flanges: FloatArray, parts: str, rows: IntArray) -> FloatArray:
    """(n, 4, 4) poses with some parts of other rows; NaN where there is none (-1)."""
    other = np.where((rows < 0)[:, None, None], np.nan, flanges[rows])
    rotations = (other if "R" in parts else flanges)[:, :3, :3]
    taken = [other if axis in parts else flanges for axis in "xyz"]
    positions = np.stack([each[:, at, 3] for at, each in enumerate(taken)], axis=1)
    return compose(rotations, positions)
