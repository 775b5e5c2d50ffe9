"""A plan: which stops the robot takes, in which order, what is predicted of them; next stops."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.arguments import typed
from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg, percent, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray, Need, Progress
from visioncal.estimation.armmodel import block_size
from visioncal.live.planning.accuracy import OPEN_SIGMA, Accuracy, Wish
from visioncal.live.planning.candidates import Candidates, candidates
from visioncal.live.planning.cell import Box, PlanCell
from visioncal.live.planning.design import Design, chosen, shortfall
from visioncal.live.planning.information import WORLDS, World, place_sigmas, worlds_of
from visioncal.live.planning.needed import NeedPlanned, Picking, check_need, need_planned, words_of
from visioncal.live.planning.path import Route, ordered
from visioncal.live.planning.purposes import Purpose
from visioncal.live.planning.recorded import Begun
from visioncal.robot import Robot

# Stops without a safe way to them are chosen anew so often: an arm that folds far back needs up to
# six rounds for 8 to 30 stops.
_ROUNDS = 12

# A direction this close to the optical axis is called by it; another axis is named besides where
# the direction has this share of it.
_NEARLY_AXIS, _ASIDE = 0.95, 0.4
# Smaller turns from a stop that is there are no new direction [rad].
_TURN_RAD = 0.17
# What takes less than a hundredth off an error gets no figure.
_LITTLE_SHARE = 0.99
# What a rotation counts beside an offset: its effect at this distance [m].
_LEVER_M = 0.5


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
    planning = _Planning(cells, request, found, worlds, begun)
    design, route, in_the_way = planning.with_a_way(progress)
    map_m, map_sigma_m = planning.mapped(design)
    needed = None
    if request.need is not None:
        picking = Picking(cells, worlds, found.q, request.need)
        needed = need_planned(picking, design.rows, request.count)
    missing = [] if request.wish is None else [shortfall(design, request.wish, request.count)]
    missing += [] if needed is None else [needed.limits]
    return Plan(
        cell,
        request,
        planning.stops(design, route),
        design,
        route.length_rad,
        begun,
        len(found),
        found.lost,
        in_the_way,
        " ".join(name for name in missing if name),
        map_m,
        map_sigma_m,
        needed,
    )


@dataclass(frozen=True, eq=False)
class _Planning:
    """By what stops are chosen.

    Attributes:
        cells: The cell as it is guessed to be, and some of what else it may be.
        request: What is asked.
        found: The candidates.
        worlds: Their information in each of the cells.
        begun: What was recorded already; None for nothing.
    """

    cells: tuple[PlanCell, ...]
    request: PlanRequest
    found: Candidates
    worlds: tuple[World, ...]
    begun: Begun | None

    @property
    def recorded(self) -> int:
        """How many stops were recorded already."""
        return 0 if self.begun is None else len(self.begun.views)

    def with_a_way(self, progress: Progress) -> tuple[Design, Route, tuple[str, ...]]:
        """Chooses stops that can be driven to one after the other.

        Returns:
            The design, the way through it, and what kept stops from being driven to.
        """
        left = np.arange(len(self.found.q))
        given_up: list[str] = []
        for turn in range(_ROUNDS):
            design = self._enough(left)
            progress("path", turn, _ROUNDS)
            q = self.found.q[design.rows]
            route = ordered(self.cells[0], self.request.start_q, q, self.request.seed)
            if not route.unreachable:
                return design, route, tuple(given_up)
            given_up += route.unreachable.values()
            lost = design.rows[list(route.unreachable)]
            reached = np.setdiff1d(design.rows, lost)
            if turn and len(reached):
                # One by one they would be exchanged for others of the same part of the workspace.
                lost = self._nearer(left, lost, reached)
            left = np.setdiff1d(left, lost)
        obstacles = tuple(dict.fromkeys(given_up))
        raise DataError(
            f"plan: no safe way through {self.request.count} stops was found in {_ROUNDS} choices; "
            f"in the way were {some_of(list(obstacles))}.",
            culprits=obstacles,
            next_step="Make room around the arm, lower the clearance, or ask for fewer stops.",
        )

    def _nearer(self, left: IntArray, lost: IntArray, reached: IntArray) -> IntArray:
        """The candidates, of some, whose joints are nearer to lost stops than to any reached."""
        to_lost, to_reached = (
            np.linalg.norm(self.found.q[left][:, None] - self.found.q[rows], axis=2).min(axis=1)
            for rows in (lost, reached)
        )
        return np.asarray(left[to_lost < to_reached])

    def _enough(self, left: IntArray) -> Design:
        """The fewest of some candidates that meet wish and need, or as many as are allowed."""
        request, needed_stops = self.request, CalibrationLimits.stops[0]
        worlds = tuple(
            replace(world, factors=world.factors[left], misfit=world.misfit[left])
            for world in self.worlds
        )

        def of(count: int) -> Design:
            return chosen(worlds, count, criterion=request.criterion, wish=request.wish)

        design = of(request.count)
        if not len(design.rows):
            raise _needless(design)
        if request.need is not None:
            picking = Picking(self.cells, worlds, self.found.q[left], request.need)
            fewest, share = picking.fewest(design.rows), picking.share_of(design.rows)
            if fewest == 0 and self.recorded >= needed_stops:
                raise _met(request.need, picking.chance(design.rows[:0]))
            # Few stops tell what they determine, and not whether one of them is wrong.
            fewest = max(fewest, needed_stops - self.recorded)
            # The first of many stops are not the best of few, which may be enough where one less
            # is not.
            for count in range(max(fewest - 1, 1), len(design.rows)):
                smaller = of(count)
                enough = count >= needed_stops - self.recorded
                if enough and picking.chance(smaller.rows) >= share:
                    design = smaller
                    break
        return replace(design, rows=left[design.rows])

    def stops(self, design: Design, route: Route) -> tuple[PlannedStop, ...]:
        """The stops in driving order."""
        cell, found, begun = self.cells[0], self.found, self.begun
        first = 1 if begun is None else 1 + max(begun.views)
        numbers = np.empty(len(design.rows), dtype=np.int64)
        numbers[list(route.order)] = first + np.arange(len(design.rows))
        names = [f"view {number}" for number in numbers]
        purpose, world = self.request.purpose, self.worlds[0]
        said = tuple(helps(cell, purpose, found.q, world, design, names, begun=begun))
        q = found.q[design.rows]
        flange = cell.robot.base_from_flange(q)
        segments = route.segments
        if len(segments) < len(route.order):
            segments = (np.zeros((0, q.shape[1])), *segments)
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

    def mapped(self, design: Design) -> tuple[FloatArray, FloatArray]:
        """Places (w, 3) all over the workspace, and (w,) their sigmas, if these count [m]."""
        request = self.request
        if request.purpose.judged != "workspace" or design.predicted.is_open:
            return np.zeros((0, 3)), np.zeros(0)
        covariance = self.worlds[0].covariance(design.rows)
        return place_sigmas(self.cells[0], request.purpose, covariance, request.workspace)


def _met(need: Need, before: float) -> DataError:
    return DataError(
        f"plan: by what was recorded, {percent(before)} of picks land within {words_of(need)}; "
        "no stop needs to be added.",
        next_step="Need less than that, or leave the need out to see what stops would give.",
    )


def _needless(design: Design) -> DataError:
    found = design.before
    return DataError(
        "plan: the wish is met by what was recorded, which predicts "
        f"{mm_and_deg(found.mm, found.deg)}; no stop needs to be added.",
        next_step="Wish for more, or leave the wish out to see what further stops would give.",
    )


def _silent(_: str, __: int, ___: int) -> None:
    """Tells nobody."""


def helps(
    cell: PlanCell,
    purpose: Purpose,
    q: FloatArray,
    world: World,
    design: Design,
    names: Sequence[str],
    *,
    begun: Begun | None = None,
) -> Iterator[str]:
    """Says what each chosen stop is good for, those before it being taken.

    Args:
        cell: The cell as it is guessed to be.
        purpose: What the stops are for.
        q: (k, n) joint angles of the candidates [rad].
        world: The candidates' information if the guesses are right.
        design: Which of them are chosen.
        names: What to call the chosen ones, in their order.
        begun: What was recorded already; None for nothing.
    """
    there, known = np.zeros((0, 4, 4)), []
    if begun is not None:
        there = next(iter(begun.recorded.problem.poses.values()))
        known = [f"view {view}" for view in begun.views]
    poses = cell.robot.base_from_flange(q[design.rows])
    before = world.covariance([])
    for place in range(len(design.rows)):
        after = world.covariance(design.rows[: place + 1])
        motion = _motion(cell, there, poses[place], known)
        effect = _effect(cell, purpose, before, after, design.history[place : place + 2])
        yield f"{motion}: {effect}"
        there = np.concatenate([there, poses[place][None]])
        known = [*known, names[place]]
        before = after


def _motion(cell: PlanCell, there: FloatArray, pose: FloatArray, names: Sequence[str]) -> str:
    """How a stop differs from the one whose direction is nearest."""
    if not len(there):
        return "begin here"
    turns = Rotation.from_matrix((invert(there) @ pose)[:, :3, :3]).as_rotvec()
    angles = np.linalg.norm(turns, axis=1)
    nearest = int(np.argmin(angles))
    if angles[nearest] < _TURN_RAD:
        shift = 1e2 * float(np.linalg.norm(pose[:3, 3] - there[nearest, :3, 3]))
        return f"shift by {shift:.0f} cm from {names[nearest]}"
    axis = turns[nearest] / angles[nearest]
    degrees = f"by {np.rad2deg(angles[nearest]):.0f} deg from {names[nearest]}"
    flange_from_cam = cell.x
    if cell.mount == "eye-to-hand":
        flange_from_cam = invert(there[nearest]) @ cell.x
    if abs(axis @ flange_from_cam[:3, 2]) > _NEARLY_AXIS:
        return f"turn about the optical axis {degrees}"
    verb = "turn" if abs(axis[2]) > np.linalg.norm(axis[:2]) else "tilt"
    return f"{verb} about the tool's {_axes(axis)} {degrees}"


def _effect(
    cell: PlanCell,
    purpose: Purpose,
    before: FloatArray,
    after: FloatArray,
    history: Sequence[Accuracy],
) -> str:
    """What a stop helps: `history` is the accuracy without it and with it."""
    if purpose.judged == "sight":
        return _edge_effect(before, after)
    then, now = (1e-3 * accuracy.mm for accuracy in history)
    joint = _joint_determined(cell.robot, purpose, np.diag(before - after))
    change = _change("the error over the workspace", then, now, is_rotation=False)
    return f"{change}; most information on {joint}"


def _joint_determined(robot: Robot, purpose: Purpose, drops: FloatArray) -> str:
    """Which joint's errors (p,) lessened variances are of."""
    count = robot.joint_count
    by_joint, left = np.zeros(count), drops
    for name in reversed(tuple(purpose.blocks)):
        left, block = np.split(left, [len(left) - block_size(name, count)])
        # Links have six values each, one after the other; of functions, each joint has one.
        whole = block.reshape(count, -1) if name == "links" else block.reshape(-1, count).T
        by_joint += whole.sum(axis=1)
    return robot.joint_names[int(np.argmax(by_joint))]


def _edge_effect(before: FloatArray, after: FloatArray) -> str:
    """The component of x that a stop helps most, along or about the camera's axes."""
    drops = np.diag(before - after)[:6] * np.repeat([_LEVER_M**2, 1.0], 3)
    at = int(np.argmax(drops))
    axis = ("the image's x", "the image's y", "the optical axis")[at % 3]
    words = f"the error {'about' if at < 3 else 'along'} {axis}"
    then, now = (float(np.sqrt(array[at, at])) for array in (before, after))
    return _change(words, then, now, is_rotation=at < 3)


def _change(what: str, then: float, now: float, *, is_rotation: bool) -> str:
    """Says how a sigma [m or rad] falls."""
    unit, scale = ("deg", float(np.rad2deg(1.0))) if is_rotation else ("mm", 1e3)
    if now > OPEN_SIGMA:
        return f"a beginning; {what} is not determined yet"
    if then > OPEN_SIGMA:
        return f"determines what was open; {what} is now {figure(now * scale)} {unit}"
    figures = f"({figure(then * scale)} -> {figure(now * scale)} {unit})"
    share = now / then
    if share > _LITTLE_SHARE:
        return f"takes little off {what} {figures}"
    if share > 0.72:
        return f"takes {100 * (1 - share):.0f} % off {what} {figures}"
    for least, verb in (
        (0.58, "takes a third off {}"),
        (0.42, "halves {}"),
        (0.28, "cuts {} to a third"),
        (0.2, "cuts {} to a quarter"),
    ):
        if share > least:
            return f"{verb.format(what)} {figures}"
    return f"cuts {what} {1 / share:.0f}-fold {figures}"


def _axes(axis: FloatArray) -> str:
    """Names a unit vector by one axis, or by the two that it lies between."""
    first, second = np.argsort(-np.abs(axis))[:2].tolist()
    return "xyz"[first] + (f" and {'xyz'[second]}" if abs(axis[second]) > _ASIDE else "")
