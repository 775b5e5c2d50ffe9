"""How likely picks land within a need after a plan, and what is in the way where they do not.

A pick as the verdict has it (`calibration.stages.need`): the camera looks at a thing as a stop
looks at its target, and the robot goes there. Counted are the camera's pose and the noise of the
flange at the look, where it carries the camera, and at the pick. The error of detecting the thing
is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, IntArray, Need
from visioncal.estimation.tolerance_probability import chance_within
from visioncal.live.planning.cell import PlanCell
from visioncal.live.planning.information import World
from visioncal.vision.targets import corner_positions

# So many of all candidates stand for the places where things are looked at.
_LOOKS = 40
# Stops that add less to the chance in all are not worth taking.
_NEARLY = 0.01


@dataclass(frozen=True, eq=False)
class Picking:
    """The candidates of a plan, as far as picks depend on them.

    Attributes:
        cells: The cell as it is guessed to be, and as it may be.
        worlds: The candidates' information in each of these.
        q: (k, n) their joint angles [rad].
        need: How near picks have to come.
    """

    cells: Sequence[PlanCell]
    worlds: Sequence[World]
    q: FloatArray
    need: Need

    def chance(self, rows: IntArray, *, without: str = "") -> float:
        """The chance that a pick lands within the need, calibrated from some candidates.

        Args:
            rows: (m,) the candidates.
            without: What is taken for exact: `looks` (lens and board), `arm` (errors with its
                posture) or `noise` (of the robot at look and pick).
        """
        turn_rad = np.inf if self.need.deg is None else float(np.deg2rad(self.need.deg))
        shift_m = np.inf if self.need.mm is None else 1e-3 * self.need.mm
        q = self.q[np.linspace(0, len(self.q) - 1, min(_LOOKS, len(self.q))).astype(np.int64)]
        found = []
        for cell, world in zip(self.cells, self.worlds, strict=True):
            known = {"looks": world.with_known_looks, "arm": world.without_misfit}
            sure = known.get(without, lambda world=world: world)()
            noise = np.repeat(cell.noise.robots[0], 3) ** 2 * (without != "noise")
            spreads = _spreads(cell, sure.covariance(rows)[:6, :6], noise, q)
            found.append(chance_within(spreads, turn_rad, shift_m))
        return float(np.mean(found))

    def fewest(self, rows: IntArray) -> int:
        """How many of some candidates in their order are enough, or nearly as good as all."""
        share = self.share_of(rows)
        # Each stop tells more: the least number is found by halves.
        least, most = 0, len(rows)
        while least < most:
            middle = (least + most) // 2
            if self.chance(rows[:middle]) >= share:
                most = middle
            else:
                least = middle + 1
        return least

    def share_of(self, rows: IntArray) -> float:
        """The chance that is to be reached: what is needed, or nearly what some candidates give."""
        return min(NeedLimits.probability[0], self.chance(rows) - _NEARLY)


@dataclass(frozen=True)
class NeedPlanned:
    """What is predicted of picks.

    Attributes:
        need: How near they have to come.
        before: The chance that one does without the planned stops.
        probability: The same with them.
        best: The same with all candidates.
        limits: What is in the way, in words; empty where the need is met.
    """

    need: Need
    before: float
    probability: float
    best: float
    limits: str

    @property
    def met(self) -> bool:
        """Whether they come as near as they have to."""
        return self.probability >= NeedLimits.probability[0]


def need_planned(picking: Picking, rows: IntArray, count: int) -> NeedPlanned:
    """Predicts picks after a plan, and says what is in the way.

    Args:
        picking: The candidates.
        rows: (m,) those that were chosen.
        count: How many stops were allowed.
    """
    every, least = np.arange(len(picking.q)), NeedLimits.probability[0]
    probability, best = picking.chance(rows), picking.chance(every)
    words = ""
    if probability < least:
        stops = f"{len(rows)} stops predict that {percent(probability)} of picks land within "
        words = f"{stops}{words_of(picking.need)}; {percent(least)} are needed. "
        if best >= least:
            words += f"More than {count} stops are needed: all candidates give {percent(best)}."
        else:
            words += f"All candidates together give {percent(best)}. {_in_the_way(picking, every)}"
    return NeedPlanned(picking.need, picking.chance(rows[:0]), probability, best, words)


def words_of(need: Need) -> str:
    """A need in words: `0.3 mm and 0.1 deg`."""
    return " and ".join(
        f"{figure(value)} {unit}"
        for value, unit in ((need.mm, "mm"), (need.deg, "deg"))
        if value is not None
    )


def check_need(need: Need, judged: str) -> None:
    """Refuses a need that a plan cannot be made for.

    Raises:
        DataError: A number is not above zero, or stops are not to determine the camera's pose.
    """
    for name, value in (("mm", need.mm), ("deg", need.deg)):
        if value is not None and not 0.0 < value < np.inf:
            raise DataError(
                f"the need is {value} {name}; a number above zero is needed.",
                culprits=[f"need_{name}"],
            )
    if judged != "sight":
        raise DataError(
            "a need is of picks by what the camera sees, and these stops are for the arm.",
            culprits=["need"],
            next_step="Plan for hand-eye, or wish for a sigma: --wish-mm.",
        )


def _spreads(
    cell: PlanCell, covariance: FloatArray, noise: FloatArray, q: FloatArray
) -> FloatArray:
    """(k, 6, 6) of picks of things where the target is seen at (k, n) postures.

    All in the axes of what carries the camera: the flange, or the base.

    Args:
        cell: The cell.
        covariance: (6, 6) of the camera's pose, a right perturbation.
        noise: (6,) variances of the flange.
        q: The postures [rad].
    """
    middle = corner_positions(cell.target).mean(axis=0)
    seen = (cell.cam_from_target(q) @ [*middle, 1.0])[:, :3]
    turn = cell.x[:3, :3]
    by_camera = _levers(seen)
    by_camera[:, :3], by_camera[:, 3:] = turn @ by_camera[:, :3], turn @ by_camera[:, 3:]
    spreads = by_camera @ covariance @ np.swapaxes(by_camera, 1, 2) + np.diag(noise)
    if cell.mount == "eye-in-hand":
        by_flange = _levers(seen @ turn.T + cell.x[:3, 3])
        spreads = spreads + (by_flange * noise) @ np.swapaxes(by_flange, 1, 2)
    return np.asarray(spreads)


def _levers(points: FloatArray) -> FloatArray:
    """(k, 6, 6) how things at (k, 3) points turn and move with the frame they are given in."""
    found = np.tile(np.eye(6), (len(points), 1, 1))
    found[:, 3:, :3] = -skew(points)
    return found


# What may be in the way, and what helps.
_WAYS_OUT = {
    "looks": (
        "the uncertainty of the board's size and the lens",
        "measure the print over many squares, and state its square_sigma_m",
    ),
    "arm": (
        "errors of the arm that go with its posture",
        "record joint angles (q1_rad ...) with all views, and they are calibrated",
    ),
    "noise": (
        "the robot's own noise at look and pick",
        "let it come to rest, look from nearer, or state its noise if it is less (--noise-mm, "
        "--noise-deg)",
    ),
}


def _in_the_way(picking: Picking, every: IntArray) -> str:
    """What would help most, and whether that would be enough."""
    without = {name: picking.chance(every, without=name) for name in _WAYS_OUT}
    most = max(without, key=lambda index: without[index])
    cause, advice = _WAYS_OUT[most]
    words = f"is {cause} ({percent(without[most])} without it): {advice}."
    if without[most] >= NeedLimits.probability[0]:
        return f"In the way {words}"
    return f"The most of what is in the way {words} A larger board or a nearer camera helps, too."
