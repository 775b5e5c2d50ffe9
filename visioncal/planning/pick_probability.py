"""Predicted probability that picks land within a tolerance after a plan, and what limits it.

A pick is that of the verdict (`calibration.stages.need`): the camera observes an object as a stop
observes its target, and the robot goes there. Included are the errors of the camera's pose and the
noise of the flange at the pick, and at the observation where the flange carries the camera. The
error of detecting the object is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.tolerance_probability import chance_within
from visioncal.core.transforms import adjoint, compose
from visioncal.core.types import FloatArray, IntArray, Need
from visioncal.planning.cell import PlanCell
from visioncal.planning.information import World
from visioncal.vision.targets import corner_positions


@dataclass(frozen=True, eq=False)
class Picking:
    """Picks after a calibration from some candidates of a plan."""

    cells: Sequence[PlanCell]  # The guessed cell, and draws from its uncertainty.
    worlds: Sequence[World]  # The candidates' information in each of these.
    q: FloatArray  # (k, n) joint angles of the candidates [rad].
    need: Need  # Tolerance of the picks.

    def chance(self, rows: IntArray) -> float:
        """Probability that a pick lands within tolerance, calibrated from (m,) candidates."""
        turn_rad = np.inf if self.need.deg is None else float(np.deg2rad(self.need.deg))
        shift_m = np.inf if self.need.mm is None else 1e-3 * self.need.mm
        q = self.q[np.linspace(0, len(self.q) - 1, min(40, len(self.q))).astype(np.int64)]
        chances = []
        for cell, world in zip(self.cells, self.worlds, strict=True):
            # Covariances of picks at the target are in the axes of what carries the camera: the
            # flange, or the base; that of the camera's pose is of a right perturbation.
            noise = np.repeat(cell.noise.robots[0], 3) ** 2
            middle = corner_positions(cell.target).mean(axis=0)
            points = (cell.cam_from_target(q) @ [*middle, 1.0])[:, :3]
            turn = cell.x[:3, :3]
            # Poses at points move with the frame that these are in.
            jacobian = block_diag(turn, turn) @ adjoint(compose(np.eye(3), -points))
            covariances = jacobian @ world.covariance(rows)[:6, :6] @ np.swapaxes(jacobian, 1, 2)
            covariances = covariances + np.diag(noise)
            if cell.mount == "eye-in-hand":
                by_flange = adjoint(compose(np.eye(3), -(points @ turn.T + cell.x[:3, 3])))
                covariances += (by_flange * noise) @ np.swapaxes(by_flange, 1, 2)
            chances.append(chance_within(covariances, turn_rad, shift_m))
        return float(np.mean(chances))

    def fewest(self, rows: IntArray) -> tuple[int, float]:
        """Least number of the first candidates that are enough, and the probability to reach.

        This is the required one, or nearly that of all of them.
        """
        # Stops that together add less to the probability are left out.
        share = min(NeedLimits.probability[0], self.chance(rows) - 0.01)
        # The probability rises with each stop: bisection.
        least, most = 0, len(rows)
        while least < most:
            middle = (least + most) // 2
            if self.chance(rows[:middle]) >= share:
                most = middle
            else:
                least = middle + 1
        return least, share


@dataclass(frozen=True)
class NeedPlanned:
    """Predicted probability that picks land within tolerance."""

    need: Need
    before: float  # Probability without the planned stops.
    probability: float  # The same with them.
    best: float  # The same with all candidates.
    limits: str  # Its limit, in words; empty where the need is met.

    @property
    def met(self) -> bool:
        """Whether the probability is high enough."""
        return self.probability >= NeedLimits.probability[0]


def need_planned(picking: Picking, rows: IntArray, count: int) -> NeedPlanned:
    """Predicts picks after a plan of at most `count` stops (m,), and states what limits them."""
    every, least = np.arange(len(picking.q)), NeedLimits.probability[0]
    probability, best = picking.chance(rows), picking.chance(every)
    words = ""
    if probability < least:
        stops = f"{len(rows)} stops predict that {percent(probability)} of picks land within "
        words = f"{stops}{words_of(picking.need)}, but must predict {percent(least)}. "
    if words and best >= least:
        words += f"More than {count} stops are needed: all candidates give {percent(best)}."
    elif words:
        words += (
            f"All candidates together give {percent(best)}: a larger board or a nearer camera "
            "helps, a square_sigma_m that is measured better, or less noise of the robot."
        )
    return NeedPlanned(picking.need, picking.chance(rows[:0]), probability, best, words)


def words_of(need: Need) -> str:
    """States a tolerance in words: `0.3 mm and 0.1 deg`."""
    return " and ".join(
        f"{figure(value)} {unit}"
        for value, unit in ((need.mm, "mm"), (need.deg, "deg"))
        if value is not None
    )


def check_need(need: Need, judged: str) -> None:
    """Refuses a need that a plan cannot be made for; raises DataError."""
    for name, value in (("mm", need.mm), ("deg", need.deg)):
        if value is not None and not 0.0 < value < np.inf:
            raise DataError(
                f"the need is {value} {name}, but must be a number above zero.",
                culprits=[f"need_{name}"],
            )
    if judged != "sight":
        raise DataError(
            "a need is of picks by the camera, and these stops are for the arm.",
            culprits=["need"],
            next_step="Plan for hand-eye, or leave the need out.",
        )
