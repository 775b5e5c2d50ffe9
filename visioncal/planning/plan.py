"""A plan: the chosen stops, their order, and the accuracy predicted after each."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.choices import Criterion
from visioncal.core.codec import Key, Matrix, Vector, WrittenForm
from visioncal.core.errors import DataError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, percent, some_of
from visioncal.core.types import FloatArray, IntArray, Need, Progress
from visioncal.planning.candidates import Candidates, candidates
from visioncal.planning.cell import PlanCell
from visioncal.planning.design import Accuracy, Design, choose_stops
from visioncal.planning.information import WORLDS, World, predict_worlds
from visioncal.planning.path import ROUNDS, Route, left_candidates, order_stops
from visioncal.planning.pick_probability import (
    NeedPlanned,
    Picking,
    check_need,
    need_planned,
    words_of,
)
from visioncal.planning.purposes import Purpose, purpose_of
from visioncal.planning.recorded import SessionStart

StoredPurpose = Annotated[
    Purpose, WrittenForm(lambda purpose: purpose.name, lambda name, _: purpose_of(name))
]
# A need in plan.json: its tolerances alone.
_NEED = WrittenForm(
    lambda need: {
        name: value for name, value in (("mm", need.mm), ("deg", need.deg)) if value is not None
    },
    lambda document, _: Need(**document),
)


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """Request for a plan."""

    purpose: StoredPurpose
    count: Annotated[int, Key("stops")]  # Most stops.
    candidates: int = 1500
    # (n,) present joint angles of the arm [rad]; None where they are not known, and the path to the
    # first stop is not checked.
    start_q: Vector | None = None
    seed: int = 0
    # Tolerance of picks at which fewer are enough; None for none.
    need: Annotated[Need, _NEED] | None = None
    criterion: Criterion = "I"  # The criterion that the stops minimise; see `choose_stops`.


# An accuracy in plan.json; open where a direction is not determined.
ACCURACY = WrittenForm(
    lambda known: (
        {"open": True} if known.is_open else {"sigma_mm": known.mm, "sigma_deg": known.deg}
    ),
    lambda document, _: Accuracy(document["sigma_mm"], document["sigma_deg"]),
)


@dataclass(frozen=True, eq=False)
class Stop:
    """A stop to drive to."""

    view: int  # Number of the view to be taken there.
    q: Vector  # (n,) joint angles [rad].
    # (j, n) via postures after the previous stop, connected straight in joint space [rad].
    via: Annotated[Matrix, Key("via_q")]
    words: Annotated[str, Key("why")]  # The stop's contribution.


@dataclass(frozen=True, eq=False)
class PlannedStop(Stop):
    """A stop with what is predicted of it."""

    base_from_flange: Matrix  # (4, 4) flange, by the robot's model [m].
    cam_from_target: Matrix  # (4, 4) board in the camera if the guesses are right [m].
    # Share of the uncertain cell's draws in which the whole board is in the image.
    seen: Annotated[float, Key("seen_share")]
    rank: int  # 1 for the most informative stop, 2 for the next, ...
    # Accuracy predicted with the recorded stops and those of lower rank number.
    before: Annotated[Accuracy, ACCURACY]
    after: Annotated[Accuracy, ACCURACY]  # The same with this one.


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan."""

    cell: PlanCell
    request: PlanRequest
    stops: tuple[PlannedStop, ...]
    design: Design  # The chosen candidates and the accuracy predicted with them.
    length_rad: float  # Length of the path, as the sum of its segments' norms [rad].
    start: SessionStart | None  # The session to which the stops are added; None for none.
    candidate_count: int  # Number of candidates.
    lost: Mapping[str, int]  # Number of tries that each limit rejected.
    in_the_way: tuple[str, ...]  # Obstacles to stops that were replaced, one entry for each.
    need: NeedPlanned | None = None  # Prediction for picks; None where there is no need.


@typed
def make_plan(
    cell: PlanCell,
    request: PlanRequest,
    *,
    begun: SessionStart | None = None,
    postures: FloatArray | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Chooses stops, orders them, and states what each contributes.

    Args:
        cell: The cell, as guessed.
        request: The request.
        begun: Session to which the stops are added; its cell is `cell`.
        postures: (k, n) joint angles of the only candidates [rad]; None to draw candidates.
        progress: Called during long work.

    Raises:
        DataError: The cell allows too few stops, or none has a safe path to another.
    """
    progress = progress or (lambda *_: None)
    if request.need is not None:
        check_need(request.need, request.purpose.judged)
    # A recorded cell may allow few stops, such as one with a fixed camera; these are added.
    least = None if begun is None else min(request.count, request.candidates)
    if postures is None:
        stops = candidates(cell, request.candidates, request.seed, progress, least=least)
    else:
        stops = Candidates(postures, cell.cam_from_target(postures), np.ones(len(postures)), {})
    progress("information", 0, 1)
    cells = (cell, *cell.guesses(WORLDS - 1, request.seed))
    recorded = None if begun is None else begun.recorded
    # A need is judged by the calibration, which determines the lens, too.
    worlds = predict_worlds(
        *(cells, request.purpose, stops.q),
        recorded=recorded,
        estimates_lens=request.need is not None,
    )
    progress("choice", 0, 1)
    planning = _Planning(cells, request, stops, worlds, begun)
    design, route, in_the_way = planning.drivable_design(progress)
    need = None
    if request.need is not None:
        picking = Picking(cells, worlds, stops.q, request.need, recorded)
        need = need_planned(picking, design.rows, request.count)
    return Plan(
        cell,
        request,
        planning.stops(design, route),
        design,
        route.length_rad,
        begun,
        len(stops),
        stops.lost,
        in_the_way,
        need,
    )


@dataclass(frozen=True, eq=False)
class _Planning:
    """Inputs of the choice of stops."""

    cells: tuple[PlanCell, ...]  # The guessed cell, and draws from its uncertainty.
    request: PlanRequest
    found: Candidates  # The candidates.
    worlds: tuple[World, ...]  # Their information in each of the cells.
    begun: SessionStart | None  # Session to which the stops are added; None for none.

    def drivable_design(self, progress: Progress) -> tuple[Design, Route, tuple[str, ...]]:
        """Stops that a safe path connects, the path, and what blocked the stops left out for it."""
        remaining = np.arange(len(self.found.q))
        blockers: list[str] = []
        for attempt in range(ROUNDS):
            design = self._smallest_design(remaining)
            progress("path", attempt, ROUNDS)
            q = self.found.q[design.rows]
            route = order_stops(self.cells[0], self.request.start_q, q, self.request.seed)
            if not route.unreachable:
                return design, route, tuple(blockers)
            blockers += route.unreachable.values()
            remaining = left_candidates(
                self.found.q, remaining, design.rows, route, missed_only=not attempt
            )
        obstacles = tuple(dict.fromkeys(blockers))
        raise DataError(
            f"plan: no safe way through {self.request.count} stops was found in {ROUNDS} choices; "
            f"in the way were {some_of(list(obstacles))}.",
            culprits=obstacles,
            next_step="Make room around the arm, lower the clearance, or ask for fewer stops.",
        )

    def _smallest_design(self, rows: IntArray) -> Design:
        """Design with the fewest stops that meet the need, or as many as are allowed."""
        request, recorded = self.request, () if self.begun is None else self.begun.views
        needed_stops = CalibrationLimits.stops[0] - len(recorded)
        worlds = tuple(world.of_candidates(rows) for world in self.worlds)
        design = choose_stops(worlds, request.count, request.criterion)
        if request.need is not None:
            so_far = None if self.begun is None else self.begun.recorded
            picking = Picking(self.cells, worlds, self.found.q[rows], request.need, so_far)
            fewest, share = picking.fewest(design.rows)
            if fewest == 0 and needed_stops <= 0:
                chance = percent(picking.chance(design.rows[:0]))
                raise DataError(
                    f"plan: by what was recorded, {chance} of picks land within "
                    f"{words_of(request.need)}; no stop needs to be added.",
                    next_step="State a smaller need, or leave it out to see what stops would give.",
                )
            # Fewer stops may be informative enough, but would not reveal an outlier among them.
            fewest = max(fewest, needed_stops)
            # The first stops of a large design are not the best small design, which may need one
            # stop less.
            for count in range(max(fewest - 1, 1), len(design.rows)):
                smaller = choose_stops(worlds, count, request.criterion)
                if count >= needed_stops and picking.chance(smaller.rows) >= share:
                    design = smaller
                    break
        return replace(design, rows=rows[design.rows])

    def stops(self, design: Design, route: Route) -> tuple[PlannedStop, ...]:
        """The stops in driving order."""
        cell, found, begun = self.cells[0], self.found, self.begun
        first = 1 if begun is None else 1 + max(begun.views)
        numbers = np.empty(len(design.rows), dtype=np.int64)
        numbers[list(route.order)] = first + np.arange(len(design.rows))
        q = found.q[design.rows]
        flange = cell.robot.base_from_flange(q)
        segments = route.segments
        if len(segments) < len(route.order):
            segments = (np.zeros((0, q.shape[1])), *segments)
        stops = []
        for row, via in zip(route.order, segments, strict=True):
            before, after = design.history[row : row + 2]
            words = "a beginning; not all is determined yet"
            if before.is_open and not after.is_open:
                words = f"determines what was open; the error is now {figure(after.mm)} mm"
            elif not after.is_open:
                less = 100.0 * (1.0 - after.mm / before.mm)
                words = f"takes {f'{less:.0f} %' if less >= 1.0 else 'little'} off the error "
                words += f"({figure(before.mm)} -> {figure(after.mm)} mm)"
            stops.append(
                PlannedStop(
                    int(numbers[row]),
                    q[row],
                    via,
                    words,
                    flange[row],
                    found.cam_from_target[design.rows[row]],
                    float(found.seen[design.rows[row]]),
                    row + 1,
                    before,
                    after,
                )
            )
        return tuple(stops)
