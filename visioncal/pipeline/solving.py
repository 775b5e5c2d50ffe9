"""From what was seen to the fit of the whole cell: start, agreement, lenses and boards."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.estimation.effects.lenses import LENSES, Looks, Seen
from visioncal.estimation.joint import Fitted
from visioncal.estimation.joint import settle as settle_looks
from visioncal.estimation.outliers import Agreed, agree, settle
from visioncal.estimation.parts import Effect, Observations, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import covariance_of, fit_problem
from visioncal.pipeline.robots import arms_of, with_drifts, with_errors
from visioncal.pipeline.ties import ambiguous_error, untied_robots
from visioncal.stages.arms import RobotArm, check_arms, effects_of
from visioncal.stages.cell import Cell
from visioncal.stages.clocks import clock_effects
from visioncal.stages.found import found_of_looks
from visioncal.stages.observed import Observed
from visioncal.stages.place import place
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.priors import most_contradicted
from visioncal.stages.refine import refined
from visioncal.stages.side import FramesSide
from visioncal.stages.validate import chain_rms_px
from visioncal.types import FloatArray, IntArray, Target

# Arms are linearised anew so often, or until their errors move by less, which is far below any
# arm's repeatability.
_ROUNDS, _AT_REST_RAD = 4, 1e-7
# Covariance of a pose that was given without one, but for its level [rad^2, m^2].
_NOMINAL = np.diag(np.repeat([1e-3, 5e-4], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Solved:
    """The fit of a whole cell.

    Attributes:
        cell: The cell; its rows are the observations in the fit's order.
        agreed: The fit, what it uses, and what moved.
        seen: What all corners say of lenses and boards; None without images.
        poses: Each row's one pose.
        untied: Frames that nothing ties to the rest.
        arms: The robots' arms, as far as they were calibrated.
        asked: How far that was to be.
        late: The errors of clocks, as effects.
    """

    cell: Cell
    agreed: Agreed
    seen: Seen | None
    poses: tuple[ViewPoses, ...]
    untied: tuple[str, ...]
    arms: Mapping[str, RobotArm]
    asked: str
    late: tuple[Effect, ...]

    def found_of_looks(self) -> Iterator[tuple[str, bool]]:
        """Says what was found of lenses and boards; see `stages.found`."""
        if self.seen is not None:
            part = self.agreed.problem.subset(self.agreed.used)
            side = _side(self.cell, self.agreed, self.arms, self.late)
            yield from found_of_looks(side, Fitted(self.seen, part, self.agreed.fit))

    @property
    def looks(self) -> Looks | None:
        """Lenses and boards as they were found; None without images."""
        return self.looks_at(self.agreed.fit.state)

    def looks_at(self, state: State) -> Looks | None:
        """Lenses and boards as some state has them; None without images."""
        if self.seen is None:
            return None
        found = self.agreed.problem.values_of(LENSES, state)
        return self.seen.looks.with_values(self.seen.free, found)

    def chain_px(self, rows: IntArray, state: State) -> FloatArray:
        """Reprojection errors (m,) [px] of some observations through the chain; NaN for none.

        Args:
            rows: (m,) the observations.
            state: The unknowns of the fit, or those of another one to a part of them.
        """
        looks, chosen = self.looks_at(state), np.isin(np.arange(len(self.cell.rows)), rows)
        if looks is None:
            return np.full(len(rows), np.nan)
        poses = self.agreed.problem.subset(chosen).predicted(state)
        lenses = {it: looks.camera(it) for it in looks.problems}
        seen = [self.poses[it].corners for it in rows]
        cameras = [lenses.get(self.cell.rows[it].seer) for it in rows]
        return chain_rms_px(seen, poses, cameras, np.concatenate(looks.corners))

    def columns_of(self, places: IntArray) -> IntArray:
        """The problem's columns of free values of lenses and boards, by their places."""
        first = self.agreed.problem.effect_columns[LENSES].start
        free = np.zeros(0) if self.seen is None else self.seen.free
        return np.asarray(first + np.searchsorted(free, places))


def solve(cell: Cell, looked: Observed, asked: str = "auto") -> Solved:
    """Solves a whole cell.

    Args:
        cell: The cell.
        looked: What was observed in it.
        asked: How far the robots' arms are to be calibrated; see `stages.kinematics.check_level`.

    Raises:
        DegenerateError: A robot is tied to nothing, or a frame may be in two places.
    """
    missing = {
        it.view: looked.reasons.get(it.view, "nothing was found in its image")
        for it in cell.rows
        if it.view not in looked.poses
    }
    cell = cell.without(missing)
    cell, lost = _tied_part(cell)
    views = [looked.poses[it.view] for it in cell.rows]
    cell, views, problem, state, unplaced = _started(cell, views)
    agreed = agree(problem, state, _movable(problem))
    arms: Mapping[str, RobotArm] = arms_of(cell, looked.robots)
    check_arms(arms, asked)
    late = clock_effects(cell, looked.clocks)
    agreed, seen, arms = _with_looks(cell, looked, views, agreed, arms, late)
    arms = with_drifts(arms, agreed.problem.subset(agreed.used), agreed.fit, asked)
    if any(it.drift is not None for it in arms.values()):
        agreed, seen, arms = _with_looks(cell, looked, views, agreed, arms, late)
    agreed = _levelled(cell, views, agreed)
    if asked != "hand-eye":
        arms = _levels(cell, agreed, arms, asked)
        erring = [name for name, it in arms.items() if it.frees_errors()]
        late = clock_effects(cell, looked.clocks, erring)
        agreed, seen, arms = _at_rest(cell, agreed, seen, arms, late)
    agreed = _without_contradicted(settle(agreed, _movable(agreed.problem)))
    agreed, seen, arms = _at_rest(cell, agreed, seen, arms, late)
    agreed = _with_repeats(agreed)
    return Solved(cell, agreed, seen, tuple(views), (*lost, *unplaced), arms, asked, late)


def _with_looks(
    cell: Cell,
    looked: Observed,
    views: Sequence[ViewPoses],
    agreed: Agreed,
    arms: Mapping[str, RobotArm],
    late: Sequence[Effect],
) -> tuple[Agreed, Seen | None, Mapping[str, RobotArm]]:
    """Fits lenses, boards and frames, with errors of the arms sought anew beside their drift."""
    arms = {name: it.erring(None) for name, it in arms.items()}
    poses = {**agreed.problem.poses, **{name: it.poses for name, it in arms.items()}}
    agreed = replace(agreed, problem=replace(agreed.problem, poses=poses))
    if looked.scenes:
        side = _side(cell, agreed, arms, late)
        looks = side.looks(looked.scenes, _views_by_camera(looked, views))
        fitted, side = refined(side, looks, _frames(agreed))
        return _settled(agreed, side, fitted), fitted.seen, side.arms
    drifts = tuple(effects_of(arms))
    agreed = _with_effects(agreed, drifts) if drifts else agreed
    arms = with_errors(arms, agreed.problem.subset(agreed.used), agreed.fit)
    others = (*late, *effects_of(arms))
    return _with_effects(agreed, others) if others else agreed, None, arms


def _levels(
    cell: Cell, agreed: Agreed, arms: Mapping[str, RobotArm], asked: str
) -> dict[str, RobotArm]:
    """Chooses how far each arm is calibrated, beside the errors of the others."""
    problem, chosen = agreed.problem.subset(agreed.used), dict(arms)
    views = [cell.rows[it].view for it in np.flatnonzero(agreed.used)]
    for name, arm in arms.items():
        stated = arm.without_errors(problem)
        start = State(agreed.fit.state.edges, stated.start_values)
        chosen[name] = arm.with_level(stated, start, asked, views, agreed.fit.noise)
        problem = chosen[name].put_into(problem)
    return chosen


def _at_rest(
    cell: Cell,
    agreed: Agreed,
    seen: Seen | None,
    arms: Mapping[str, RobotArm],
    late: Sequence[Effect],
) -> tuple[Agreed, Seen | None, Mapping[str, RobotArm]]:
    """Fits with calibrated arms that are linearised anew until they stay."""
    for _ in range(_ROUNDS if any(it.model is not None for it in arms.values()) else 0):
        poses = {**agreed.problem.poses, **{name: it.poses for name, it in arms.items()}}
        agreed = replace(agreed, problem=replace(agreed.problem, poses=poses))
        if seen is None:
            agreed = _with_effects(agreed, (*late, *effects_of(arms)))
        else:
            side = _side(cell, agreed, arms, late)
            fitted = settle_looks(seen.looks, side, seen.moving, _frames(agreed))
            agreed, seen = _settled(agreed, side, fitted), fitted.seen
        moved = {name: it.moved(agreed.problem, agreed.fit.state) for name, it in arms.items()}
        arms = {name: arm for name, (arm, _) in moved.items()}
        if max(step for _, step in moved.values()) < _AT_REST_RAD:
            break
    return agreed, seen, arms


def _side(
    cell: Cell, agreed: Agreed, arms: Mapping[str, RobotArm], late: Sequence[Effect]
) -> FramesSide:
    views = [it.view for it in cell.rows]
    return FramesSide(agreed.problem, agreed.used, views, arms, late, agreed.fit.noise)


def _frames(agreed: Agreed) -> dict[str, FloatArray]:
    """Where the unknown frames are."""
    return dict(zip(agreed.problem.unknown, agreed.fit.state.edges, strict=True))


def _settled(agreed: Agreed, side: FramesSide, fitted: Fitted) -> Agreed:
    return replace(agreed, problem=side.whole(fitted.seen), fit=fitted.fit)


def _views_by_camera(looked: Observed, views: Sequence[ViewPoses]) -> dict[str, list[ViewPoses]]:
    """The views of each camera's images that some fit may use, each with its one pose."""
    known = {**looked.poses, **{it.view: it for it in views}}
    return {
        frame: [known[it] for it in look.corners if it in known and it not in looked.held_back]
        for frame, look in looked.cameras.items()
    }


def _with_repeats(agreed: Agreed) -> Agreed:
    """Fits once more, repeated views of still boards by still cameras sharing an error.

    What moved was looked for without it: their differences do not share it.
    """
    problem = replace(agreed.problem, with_repeats=True)
    fit = fit_problem(problem.subset(agreed.used), agreed.fit.state, agreed.fit.noise)
    return replace(agreed, problem=problem, fit=fit)


def _without_contradicted(agreed: Agreed) -> Agreed:
    """Leaves out priors that the observations contradict, the worst first: it misleads the rest."""
    for _ in agreed.problem.priors:
        part = agreed.problem.subset(agreed.used)
        worst = most_contradicted(part, agreed.fit.state, covariance_of(part, agreed.fit))
        if worst is None:
            break
        kept = tuple(it for it in agreed.problem.priors if it is not worst)
        problem = replace(agreed.problem, priors=kept)
        agreed = settle(replace(agreed, problem=problem), _movable(problem))
    return agreed


def _levelled(cell: Cell, views: Sequence[ViewPoses], agreed: Agreed) -> Agreed:
    """Asks for the noise level of cameras, too, now that what is wrong is out.

    Corners of one image may err alike, as those of small squares do: poses then scatter by more
    than corners do about them, but never by less.
    """
    sensors = sensors_of(cell, views)
    frames = tuple(dict.fromkeys((*sensors, *(it.seer for it in cell.rows))))
    places = {it: at for at, it in enumerate(frames)}
    problem = agreed.problem
    observations = replace(
        problem.observations,
        sensors=np.array([places[it.seer] for it in cell.rows], dtype=np.int64),
    )
    more = np.ones(len(frames) - len(sensors))
    noise = agreed.fit.noise
    return replace(
        agreed,
        problem=replace(
            problem,
            observations=observations,
            least_levels=np.concatenate([np.zeros(len(sensors)), more]),
        ),
        fit=replace(
            agreed.fit, noise=replace(noise, sensors=np.concatenate([noise.sensors, more]))
        ),
    )


def _with_effects(agreed: Agreed, effects: Sequence[Effect]) -> Agreed:
    problem = agreed.problem.with_effects(effects)
    state = State(agreed.fit.state.edges, problem.start_values)
    fit = fit_problem(problem.subset(agreed.used), state, agreed.fit.noise)
    return replace(agreed, problem=problem, fit=fit)


def _movable(problem: Problem) -> tuple[str, ...]:
    """What may be bumped or slip: all that is unknown but bases."""
    bases = {branch.parent for branch in problem.tree.branches.values() if branch.robot}
    return tuple(it for it in problem.tree.unknown if it not in bases)


def _tied_part(cell: Cell) -> tuple[Cell, tuple[str, ...]]:
    """The part of a cell that observations tie together, and the frames outside."""
    tied = cell.tied()
    lost = tuple(it for it in cell.tree.branches if it not in tied)
    untied_robots(cell, lost)
    return _without_frames(cell, lost), tuple(it for it in lost if not _is_flange(cell, it))


def _is_flange(cell: Cell, frame: str) -> bool:
    return bool(cell.tree.branches[frame].robot)


def _without_frames(cell: Cell, frames: Sequence[str]) -> Cell:
    tree = cell.tree.without(frames)
    reasons = {
        it.view: f"nothing ties {it.seer if it.seer in frames else it.seen} to the rest of the cell"
        for it in cell.rows
        if it.seer not in tree.branches or it.seen not in tree.branches
    }
    robots = set(tree.robots)
    poses = {name: it for name, it in cell.poses.items() if name in robots}
    priors = tuple(
        it for it in cell.priors if it.first in tree.branches and it.second in tree.branches
    )
    return replace(cell.without(reasons), tree=tree, poses=poses, priors=priors)


def _started(
    cell: Cell, views: Sequence[ViewPoses]
) -> tuple[Cell, list[ViewPoses], Problem, State, tuple[str, ...]]:
    """Finds a start, and gives each view its one pose by it."""
    placed = place(problem_of(cell, views), views, targets_of(cell))
    tied, clear = placed.tied, {it.view: it for it in placed.views}
    if tied.untied:
        untied_robots(cell, tied.untied, seen=True)
        cell = _without_frames(cell, tied.untied)
    if tied.ambiguous:
        raise ambiguous_error(cell, tied.ambiguous)
    cell, lost = _tied_part(cell.without({it.view: it.reason for it in placed.rejections}))
    views = [clear[it.view] for it in cell.rows]
    problem = problem_of(cell, views)
    return cell, views, problem, problem.start(tied.edges), (*tied.untied, *lost)


def targets_of(cell: Cell) -> dict[str, Target]:
    """The printed targets by their frames."""
    return {f"target_{name}" if name else "target": it for name, it in cell.session.plates.items()}


def problem_of(cell: Cell, views: Sequence[ViewPoses]) -> Problem:
    """The problem of views with one pose each, lenses and boards as they are taken to be."""
    given = np.array([not it.covariance.any() for it in views])
    levels = {it: at for at, it in enumerate(sensors_of(cell, views))}
    sensors = [
        levels[row.seer] if is_sensed(row.seer, view) else -1
        for row, view in zip(cell.rows, views, strict=True)
    ]
    spread = np.array([it.covariance[0] for it in views])
    places = np.array([it.is_place for it in cell.rows], dtype=bool)
    spread[given] = _NOMINAL
    turned = {row.seen for row, place in zip(cell.rows, places.tolist(), strict=True) if not place}
    return Problem(
        cell.tree,
        cell.poses,
        Observations(
            tuple(it.seer for it in cell.rows),
            tuple(it.seen for it in cell.rows),
            np.array([it.station for it in cell.rows]),
            np.array(sensors, dtype=np.int64),
            np.array([it.cam_from_target[0] for it in views]),
            spread,
            ~places,
        ),
        priors=cell.priors,
        points=frozenset(it.seen for it in cell.rows) - turned,
    )


def is_sensed(seer: str, view: ViewPoses) -> bool:
    """Whether an observation's noise is known up to a level: those of corners is known."""
    return seer.startswith("instrument") or not view.covariance.any()


def sensors_of(cell: Cell, views: Sequence[ViewPoses]) -> tuple[str, ...]:
    """The frames whose observations' noise is known up to a level; other cameras come behind."""
    pairs = zip(cell.rows, views, strict=True)
    return tuple(dict.fromkeys(row.seer for row, view in pairs if is_sensed(row.seer, view)))
