"""A plan: which stops the robot takes, in which order, and what is predicted of them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.types import FloatArray, IntArray, Need, Progress
from visioncal.live.planning.accuracy import Accuracy, Wish
from visioncal.live.planning.candidates import Candidates, candidates
from visioncal.live.planning.cell import Box, PlanCell
from visioncal.live.planning.design import Design, chosen, shortfall
from visioncal.live.planning.improving import helps
from visioncal.live.planning.information import WORLDS, World, place_sigmas, worlds_of
from visioncal.live.planning.needed import (
    NeedPlanned,
    Picking,
    check_need,
    need_planned,
    words_of,
)
from visioncal.live.planning.path import Route, ordered
from visioncal.live.planning.purposes import Purpose
from visioncal.live.planning.recorded import Begun

# Stops without a safe way to them are chosen anew so often; then a plan goes without them.
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """What is asked of a plan.

    Attributes:
        purpose: What the stops are for.
        count: The most stops.
        criterion: What makes stops good.
        wish: The accuracy at which fewer are enough; None for none.
        need: How near picks have to come, at which fewer are enough; None for none.
        candidates: From how many possible stops they are chosen.
        workspace: Where the arm's place counts; None for all of its reach.
        start_q: (n,) joint angles where the arm stands now [rad]; None where that is not known, and
            the way to the first stop is not looked at.
        seed: Of everything random.
    """

    purpose: Purpose
    count: int
    criterion: Criterion = "I"
    wish: Wish | None = None
    candidates: int = 1500
    workspace: Box | None = None
    start_q: FloatArray | None = None
    seed: int = 0
    need: Need | None = None


@dataclass(frozen=True, eq=False)
class PlannedStop:
    """One stop.

    Attributes:
        view: The number of the view to be taken there.
        q: (n,) joint angles [rad].
        via: (j, n) postures between the stop before and this one, each reached on a straight way
            in joint space [rad].
        base_from_flange: (4, 4) where the flange is, by the robot's model [m].
        cam_from_target: (4, 4) how the board is seen if the guesses are right [m].
        seen: In which share of what the cell may be the whole board is in the image.
        rank: 1 for the most informative stop, 2 for the most informative besides it, ...
        words: What it is good for.
        before: What is predicted of the stops of lower rank, and of what was recorded.
        after: The same with this one.
    """

    view: int
    q: FloatArray
    via: FloatArray
    base_from_flange: FloatArray
    cam_from_target: FloatArray
    seen: float
    rank: int
    words: str
    before: Accuracy
    after: Accuracy


@dataclass(frozen=True, eq=False)
class Plan:
    """Stops in the order in which the robot drives to them.

    Attributes:
        cell: What they are planned for.
        request: What was asked.
        stops: The stops.
        design: What is predicted of them.
        length_rad: How far the joints travel in all, as the sum of the ways' norms [rad].
        begun: What was recorded already; None for nothing.
        found: How many possible stops they were chosen from.
        lost: What kept how many tries from being possible.
        in_the_way: What kept stops from being driven to, one for each that was exchanged for
            another.
        shortfall: Why the wished accuracy, or the need, is not met, in words; empty where it is or
            none was wished.
        need: What is predicted of picks; None where nothing is needed.
        map_m: (w, 3) places all over the workspace, in the base [m]; empty where the purpose does
            not judge it.
        map_sigma_m: (w,) predicted standard deviations there [m].
    """

    cell: PlanCell
    request: PlanRequest
    stops: tuple[PlannedStop, ...]
    design: Design
    length_rad: float
    begun: Begun | None
    found: int
    lost: Mapping[str, int]
    in_the_way: tuple[str, ...]
    shortfall: str
    map_m: FloatArray
    map_sigma_m: FloatArray
    need: NeedPlanned | None = None


@typed
def make_plan(
    cell: PlanCell,
    request: PlanRequest,
    *,
    begun: Begun | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Chooses stops, orders them, and says what each is good for.

    Args:
        cell: The cell as it is guessed to be.
        request: What is asked.
        begun: What was recorded already, to which the stops are added; its cell is `cell`.
        progress: Told of long work.

    Raises:
        DataError: The cell allows too few stops, or none has a safe way to another.
    """
    progress = progress or _silent
    if request.need is not None:
        check_need(request.need, request.purpose.judged)
    # Where a recorded cell allows few stops, as before a fixed camera, these are the ones to add.
    least = None if begun is None else min(request.count, request.candidates)
    found = candidates(cell, request.candidates, request.seed, progress, least=least)
    progress("information", 0, 1)
    cells = (cell, *cell.guesses(WORLDS - 1, request.seed))
    worlds = worlds_of(
        cells,
        request.purpose,
        found.q,
        recorded=None if begun is None else begun.recorded,
        workspace=request.workspace,
    )
    progress("choice", 0, 1)
    chosen_stops = _with_a_way(cells, request, found.q, worlds, begun, progress)
    world, route = worlds[0], chosen_stops.route
    design = chosen_stops.design
    first = 1 if begun is None else 1 + max(begun.views)
    numbers = np.empty(len(design.rows), dtype=np.int64)
    numbers[list(route.order)] = first + np.arange(len(design.rows))
    stops = _stops(cell, request, found, world, chosen_stops, numbers, begun)
    map_m, map_sigma_m = np.zeros((0, 3)), np.zeros(0)
    if request.purpose.judged == "workspace" and not design.predicted.is_open:
        covariance = world.covariance(design.rows)
        map_m, map_sigma_m = place_sigmas(cell, request.purpose, covariance, request.workspace)
    wish, needed = request.wish, None
    if request.need is not None:
        picking = Picking(cells, worlds, found.q, request.need)
        needed = need_planned(picking, design.rows, request.count)
    missing = [] if wish is None else [shortfall(design, wish, request.count)]
    missing += [] if needed is None else [needed.limits]
    return Plan(
        cell,
        request,
        stops,
        design,
        route.length_rad,
        begun,
        len(found),
        found.lost,
        chosen_stops.in_the_way,
        " ".join(name for name in missing if name),
        map_m,
        map_sigma_m,
        needed,
    )


@dataclass(frozen=True, eq=False)
class _Chosen:
    """A design whose rows are those of all candidates, and the way through it."""

    design: Design
    route: Route
    in_the_way: tuple[str, ...]


def _with_a_way(
    cells: tuple[PlanCell, ...],
    request: PlanRequest,
    q: FloatArray,
    worlds: tuple[World, ...],
    begun: Begun | None,
    progress: Progress,
) -> _Chosen:
    """Chooses stops that can be driven to one after the other."""
    left = np.arange(len(q))
    given_up: list[str] = []
    for turn in range(_ROUNDS):
        few = tuple(
            replace(world, factors=world.factors[left], misfit=world.misfit[left])
            for world in worlds
        )
        design = _enough(cells, request, q[left], few, begun)
        design = replace(design, rows=left[design.rows])
        progress("path", turn, _ROUNDS)
        route = ordered(cells[0], request.start_q, q[design.rows], request.seed)
        if not route.unreachable:
            return _Chosen(design, route, tuple(given_up))
        given_up += route.unreachable.values()
        left = np.setdiff1d(left, design.rows[list(route.unreachable)])
    raise DataError(
        f"plan: no safe way through {request.count} stops was found in {_ROUNDS} choices; in the "
        f"way were {some_of(list(dict.fromkeys(given_up)))}.",
        culprits=tuple(dict.fromkeys(given_up)),
        next_step="Make room around the arm, lower the clearance, or ask for fewer stops.",
    )


def _enough(
    cells: tuple[PlanCell, ...],
    request: PlanRequest,
    q: FloatArray,
    worlds: tuple[World, ...],
    begun: Begun | None,
) -> Design:
    """Chooses the fewest stops that meet what is wished and needed, or as many as are allowed."""

    def of(count: int) -> Design:
        return chosen(worlds, count, criterion=request.criterion, wish=request.wish)

    design = of(request.count)
    if not len(design.rows):
        raise _needless(design)
    if request.need is None:
        return design
    picking = Picking(cells, worlds, q, request.need)
    fewest, share = picking.fewest(design.rows), picking.share_of(design.rows)
    recorded = 0 if begun is None else len(begun.views)
    if fewest == 0 and recorded >= CalibrationLimits.stops[0]:
        before = percent(picking.chance(design.rows[:0]))
        raise DataError(
            f"plan: by what was recorded, {before} of picks land within {words_of(request.need)}; "
            "no stop needs to be added.",
            next_step="Need less than that, or leave the need out to see what stops would give.",
        )
    # Few stops tell what they determine, and not whether one of them is wrong.
    fewest = max(fewest, CalibrationLimits.stops[0] - recorded)
    # The first of many stops are not the best of few, which may be enough where one less is not.
    for count in range(max(fewest - 1, 1), len(design.rows)):
        smaller = of(count)
        if count >= CalibrationLimits.stops[0] - recorded and picking.chance(smaller.rows) >= share:
            return smaller
    return design


def _needless(design: Design) -> DataError:
    found = design.before
    return DataError(
        f"plan: the wish is met by what was recorded, which predicts {figure(found.mm)} mm and "
        f"{figure(found.deg)} deg; no stop needs to be added.",
        next_step="Wish for more, or leave the wish out to see what further stops would give.",
    )


def _stops(
    cell: PlanCell,
    request: PlanRequest,
    found: Candidates,
    world: World,
    taken: _Chosen,
    numbers: IntArray,
    begun: Begun | None,
) -> tuple[PlannedStop, ...]:
    """The stops in driving order; `numbers` are their views' in the order of the design."""
    design, route = taken.design, taken.route
    names = [f"view {number}" for number in numbers]
    said = tuple(helps(cell, request.purpose, found.q, world, design, names, begun=begun))
    q = found.q[design.rows]
    flange = cell.robot.base_from_flange(q)
    still = np.zeros((0, q.shape[1]))
    segments = route.segments
    if len(segments) < len(route.order):
        segments = (still, *segments)
    return tuple(
        PlannedStop(
            int(numbers[at]),
            q[at],
            via,
            flange[at],
            found.cam_from_target[design.rows[at]],
            float(found.seen[design.rows[at]]),
            at + 1,
            said[at],
            design.history[at],
            design.history[at + 1],
        )
        for at, via in zip(route.order, segments, strict=True)
    )


def _silent(_: str, __: int, ___: int) -> None:
    """Tells nobody."""
