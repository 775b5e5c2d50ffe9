"""Columns of the robot's poses whose numbers stand rows apart from the others of their pose."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import STARTS, Fit, robust_fits
from visioncal.calibration.guess.readings import shifted
from visioncal.calibration.guess.recording import CLEAR, EVIDENCE, FEWEST_ROWS
from visioncal.calibration.pipeline.guess_inputs import alike_turning
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import counted, listed
from visioncal.core.transforms import compose, robot_part
from visioncal.core.types import MOUNTS, FloatArray, IntArray
from visioncal.core.verdict import Finding, calibrating

_SHIFTS = (1, -1, 2, -2, 3, -3)
# Position by axis, and rotation; all four together are rows that are apart.
_PARTS = "xyzR"
_NAMES = dict(zip(_PARTS, ("x_m", "y_m", "z_m", "qx to qw"), strict=True))


def of_other_rows(run: RunState, rival_score: float) -> Iterator[Finding]:
    """The finding that some columns close the chain with the numbers of rows before or after.

    The chain closes clearly better by these than by another reading, whose score is `rival_score`.
    """
    if run.mount not in MOUNTS:
        return
    seen = alike_turning(run.base_from_flange, run.poses_of_one_board, run.mount)
    views = [view.number for view in run.session.views]
    known = (run.base_from_flange.get(view, np.full((4, 4), np.nan)) for view in views)
    flanges = np.array([*known]).reshape(-1, 4, 4)
    rows = np.array([at for at, view in enumerate(views) if view in seen], dtype=int)
    if len(rows) <= FEWEST_ROWS:
        return
    camera = np.array([seen[views[at]] for at in rows])

    def fitted(choices: Sequence[str], by: int) -> Iterator[tuple[Fit, str, int]]:
        """The fits of choices of columns whose numbers stand so many rows apart, all at once."""
        order = shifted(by, len(views))
        moved = np.array([_moved(flanges, parts, order)[rows] for parts in choices])
        # A row has no other one, whichever of its columns are moved.
        is_complete = np.isfinite(moved).all(axis=(0, 2, 3))
        if is_complete.sum() > FEWEST_ROWS:
            robot = robot_part(moved[:, is_complete], run.session.mount)
            fits = robust_fits(robot, np.broadcast_to(camera[is_complete], robot.shape), STARTS)
            for fit, parts in zip(fits, choices, strict=True):
                yield replace(fit, lost=int(np.sum(~is_complete))), parts, by

    choices = ["".join(some) for size in (1, 2, 3) for some in combinations(_PARTS, size)]
    found = [each for by in _SHIFTS for each in fitted(choices, by)]
    declared = next(fitted([""], 0), None)
    if declared is None or not found:
        return
    best, parts, by = max(found, key=lambda item: item[0].log_likelihood)
    first = declared[0]
    odds = EVIDENCE * (best.log_likelihood - first.log_likelihood)
    odds -= np.log(len(choices) * len(_SHIFTS))
    # Moved, rows at an end have no other one: the rest may agree without them, as switched frames
    # leave it, and no nearer in what was moved.
    sides = [side for side, some in enumerate(("xyz", "R")) if {*some} & {*parts}]
    is_nearer = all(CLEAR_RATIO * best.rms[side] < first.rms[side] for side in sides)
    is_clear = best.closes and odds >= 2.0 * CLEAR and CLEAR_RATIO * best.score <= rival_score
    if not is_clear or not is_nearer:
        return
    names, apart = listed([_NAMES[part] for part in parts]), counted(abs(by), "row")
    stand, where = ("later", "up") if by > 0 else ("earlier", "down")
    yield Finding(
        "misread_poses",
        f"In views.csv, the numbers of {names} stand {apart} {stand} than the others of their "
        f"pose, as where cells were pasted into other rows: moved, robot and camera agree to "
        f"{best.figures}; as first read, to {first.figures}.",
        calibrating(
            f"In views.csv, move the cells of {names} {where} by {apart}, delete the rows that "
            "have none then, and"
        ),
    )


def _moved(flanges: FloatArray, parts: str, rows: IntArray) -> FloatArray:
    """(n, 4, 4) poses with some parts of other rows; NaN where there is none (-1)."""
    other = np.where((rows < 0)[:, None, None], np.nan, flanges[rows])
    rotations = (other if "R" in parts else flanges)[:, :3, :3]
    taken = [other if axis in parts else flanges for axis in "xyz"]
    positions = np.stack([each[:, at, 3] for at, each in enumerate(taken)], axis=1)
    return compose(rotations, positions)
