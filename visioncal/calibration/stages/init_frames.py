"""Initial poses of all frames, and the choice among each view's candidate poses.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.

Every pair of frames of which one saw the other at several stops is solved by itself, by a consensus
of its earliest views: what moves later has not moved yet. A pair with no robot between gives one
transform; with one robot between it gives two, by a hand-eye calibration. Each body of frames (what
stands in the cell, what a flange carries) is grown by the best transforms first (Prim 1957); frames
that these do not reach are placed by views in which all else is placed. A board that looks the same
turned is tried in every orientation, and all views together decide.

Where one arm looks at a board in the hand of another, views give `u * first * v * second * w =
seen` with both arms' poses and three unknown transforms. With one of them known, the other two are
a hand-eye calibration: these are solved in turn (as Wu, Wang, Qi and Ren 2016 iterate), from starts
with v in 24 orientations.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.calibration.stages.pairwise import (
    AGREE_M,
    FEWEST,
    Candidates,
    PairEdges,
    common_transform,
    hand_eye,
    partial_hand_eye,
    settled_distances,
)
from visioncal.calibration.stages.pnp import ViewPoses, distances_m
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection, Target
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.estimation.problem import Problem
from visioncal.estimation.procrustes import align, spreads
from visioncal.estimation.tree import PathStep
from visioncal.vision.targets import rotation_transforms

# A rival within this ratio of the chosen candidate's distance is as likely.
CLEAR_RATIO = 3.0
# Share of the stops, and fewest views of a pair, that initial poses are estimated from.
_EARLY_SHARE, _FEWEST_EARLY = 0.4, 8
# Distances of views are capped here in a start's score [m]; most orientations that are tried.
_CAPPED_M, _MOST_TRIED = 0.1, 256
# Between two arms: fewest views, rounds of a start, number of starts that are continued, their
# rounds, and the largest median distance of the views in the end [m].
_FEWEST_VIEWS, _FIRST_ROUNDS, _FOLLOWED, _LONG, _NEAR_M = 5, 6, 4, 40, 0.02
# Fewest stops at which points are read to determine them and the instrument; fewest points that
# place an instrument, and their least extent in the second direction [m].
_FEWEST_STOPS, _FEWEST_POINTS, _SPREAD_M = 4, 3, 0.02
# Assumed sigma of these starts [m].
_ROUGH_M = 1e-2

# (4, 4) `body_from_frame` by name; and a frame with (t, 4, 4) candidate poses and a sigma [m].
_Placed: TypeAlias = Mapping[str, FloatArray]
_Option: TypeAlias = tuple[str, FloatArray, float]


@dataclass(frozen=True, eq=False)
class ConnectedFrames:
    """Initial poses of the frames that are connected to the tree."""

    # (4, 4) `parent_from_frame` of the unknown frames that are connected.
    edges: Mapping[str, FloatArray]
    untied: tuple[str, ...]  # The unknown frames that are not.
    # Frames that are connected only through boards that look the same turned, so that other poses
    # fit as well.
    ambiguous: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class InitialFrames:
    """Initial poses of the frames, and one pose of each view."""

    connected: ConnectedFrames  # The frames.
    # The unambiguous views, with one pose each; where a turned pose was chosen, the corners are
    # renumbered to match.
    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]  # The ambiguous views.


@dataclass(frozen=True, eq=False)
class _Relation:
    """A transform `first_from_second` (4, 4) between two frames of one body.

    `turns` (t, 4, 4) are symmetries by which the second frame may have been seen turned.
    """

    first: str
    second: str
    matrix: FloatArray
    sigma_m: float  # With rotations on a lever.
    turns: FloatArray = field(default_factory=lambda: np.eye(4)[None])


@dataclass(frozen=True, eq=False)
class _Factor:
    """A factor of a chain: a frame's pose in its body, or a robot's poses (m, 4, 4)."""

    frame: str  # Empty for a robot.
    robot: FloatArray
    is_inverse: bool


@dataclass(frozen=True, eq=False)
class _Pair:
    """The views of a pair of frames, and their chain `seer_from_seen`."""

    seer: str
    seen: str
    rows: IntArray  # All observations, in the order of time.
    early: IntArray  # The earliest of them; all, where positions alone were read.
    robots: tuple[PathStep, ...]  # The robots between.
    factors: tuple[_Factor, ...]  # The chain, of the earliest observations.
    candidates: Candidates  # Their poses.

    def unplaced(self, placed: _Placed) -> list[int]:
        """The factors that are frames still to place."""
        frames = [(at, factor.frame) for at, factor in enumerate(self.factors)]
        return [at for at, frame in frames if frame and frame not in placed]


def _product(factors: Sequence[_Factor], placed: _Placed) -> FloatArray:
    """Product (m, 4, 4) of factors with placed frames; (1, 4, 4) without a robot."""
    result = np.eye(4)[None]
    for factor in factors:
        matrix = factor.robot @ placed[factor.frame] if factor.frame else factor.robot
        result = result @ (invert(matrix) if factor.is_inverse else matrix)
    return result


def init_network(
    problem: Problem, candidates: Candidates, symmetries: Mapping[str, FloatArray]
) -> ConnectedFrames:
    """Finds initial poses of the frames; the root's body is placed by known edges.

    Args:
        problem: The observations.
        candidates: Their poses.
        symmetries: (t, 4, 4) turns after which a target looks the same, the identity first, by the
            frame of a target that has them.
    """
    growth, tree = _Growth.of(problem, candidates, symmetries), problem.tree
    relations = [*growth.known_relations(), *growth.mounted_points()]
    for pair in growth.oriented:
        relations += growth.relations_of(pair)
    growth = replace(growth, relations=relations)
    placed, ambiguous = growth.best()
    if not placed.keys() & {*tree.unknown}:
        # Whether the motion determines them is checked later.
        growth = replace(growth, relations=[*relations, *growth.weak_relations()])
        placed, ambiguous = growth.best()
    edges = {
        name: invert(placed[tree.branches[name].parent]) @ placed[name]
        for name in tree.unknown
        if name in placed and tree.branches[name].parent in placed
    }
    untied = tuple(name for name in tree.unknown if name not in edges)
    return ConnectedFrames(edges, untied, ambiguous)


@dataclass(frozen=True, eq=False)
class _Growth:
    """Growth of the tree."""

    problem: Problem
    candidates: Candidates
    symmetries: Mapping[str, FloatArray]
    oriented: Sequence[_Pair]  # The pairs whose rotations were measured, too.
    pointed: Sequence[_Pair]  # The pairs of which positions alone were read.
    relations: Sequence[_Relation] = ()  # Transforms that pairs determine by themselves.

    @classmethod
    def of(
        cls, problem: Problem, candidates: Candidates, symmetries: Mapping[str, FloatArray]
    ) -> "_Growth":
        """Collects the observations by pairs of frames."""
        seen, rows = problem.observations, dict[tuple[str, str], list[int]]()
        for at in np.argsort(seen.stops, kind="stable").tolist():
            rows.setdefault((seen.observers[at], seen.observed[at]), []).append(at)
        pairs: tuple[list[_Pair], list[_Pair]] = [], []
        for (seer, target), numbers in rows.items():
            every = np.array(numbers)
            is_oriented = bool(seen.has_rotation[every[0]])
            early, last_stop = every, _EARLY_SHARE * float(seen.stops.max())
            if is_oriented:
                count = int(np.searchsorted(seen.stops[every], last_stop, side="right"))
                early = every[: max(count, _FEWEST_EARLY)]
            robots = tuple(step for step in problem.tree.path(seer, target) if step.robot)
            identity = np.broadcast_to(np.eye(4), (len(early), 4, 4))
            factors = [_Factor(seer, identity, True)]
            for step in robots:
                flange = _Factor("", problem.poses[step.robot][seen.stops[early]], step.is_up)
                base = _Factor(problem.tree.branches[step.frame].parent, identity, step.is_up)
                factors += [flange, base] if step.is_up else [base, flange]
            factors.append(_Factor(target, identity, False))
            chosen = candidates.take(early)
            pair = _Pair(seer, target, every, early, robots, tuple(factors), chosen)
            pairs[not is_oriented].append(pair)
        return cls(problem, candidates, symmetries, *pairs)

    def turns_of(self, frame: str) -> FloatArray:
        """The turns (t, 4, 4) after which a frame looks the same, the identity first."""
        return self.symmetries.get(frame, np.eye(4)[None])

    def known_relations(self) -> Iterator[_Relation]:
        """The stated transforms."""
        for name, branch in self.problem.tree.branches.items():
            if branch.known is not None:
                yield _Relation(branch.parent, name, branch.known, 0.0)
        for prior in self.problem.priors:
            if prior.matrix is not None:
                yield _Relation(prior.first, prior.second, prior.matrix, prior.sigma_m)

    def relations_of(self, pair: _Pair) -> Iterator[_Relation]:
        """The relations that one pair determines by itself."""
        if not pair.robots:
            turns = self.turns_of(pair.seen)
            yield _Relation(pair.seer, pair.seen, *common_transform(pair.candidates), turns)
        if len(pair.robots) != 1:
            return
        # Where the earliest views do not agree by half, all may.
        for rows in (pair.early, pair.rows) if len(pair.early) < len(pair.rows) else (pair.early,):
            if len(rows) < FEWEST:
                continue
            parts = self._robot_and_candidates(pair, rows)
            if (edges := hand_eye(*parts, is_up=pair.robots[0].is_up)) is not None:
                yield from self._edges_of_robot(pair, edges)
                return

    def weak_relations(self) -> Iterator[_Relation]:
        """The relations of the pair with the most views, even if partly determined."""
        one_robot = [item for item in self.oriented if len(item.robots) == 1]
        if pairs := [pair for pair in one_robot if len(pair.rows) >= FEWEST]:
            pair = max(pairs, key=lambda value: len(value.rows))
            edges, _ = partial_hand_eye(*self._robot_and_candidates(pair, pair.rows))
            yield from self._edges_of_robot(pair, edges)

    def _edges_of_robot(self, pair: _Pair, edges: PairEdges) -> Iterator[_Relation]:
        """The transforms on both sides of the robot that is between a pair."""
        (step,) = pair.robots
        flange, base = step.frame, self.problem.tree.branches[step.frame].parent
        near, far = (flange, base) if step.is_up else (base, flange)
        yield _Relation(near, pair.seer, edges.x, edges.sigmas_m[0])
        yield _Relation(far, pair.seen, edges.z, edges.sigmas_m[1], self.turns_of(pair.seen))

    def _robot_and_candidates(self, pair: _Pair, rows: IntArray) -> tuple[FloatArray, Candidates]:
        """The robot's part of the chain (m, 4, 4) in some views of a pair, and their candidates."""
        robot = _robot_part(self.problem, pair.robots[0], rows)
        return robot, self.candidates.take(rows)

    def mounted_points(self) -> Iterator[_Relation]:
        """Relations from an instrument that reads points on a robot's flange, to both."""
        groups: dict[tuple[str, str], list[_Pair]] = {}
        for pair in self.pointed:
            if len(pair.robots) == 1 and not pair.robots[0].is_up:
                groups.setdefault((pair.seer, pair.robots[0].frame), []).append(pair)
        for (seer, flange), pairs in groups.items():
            branch = self.problem.tree.branches[flange]
            rows = np.concatenate([pair.rows for pair in pairs])
            stops = self.problem.observations.stops[rows]
            if len(np.unique(stops)) < _FEWEST_STOPS:
                continue
            problem = mounting_problem(
                self.problem.poses[branch.robot][stops],
                self.candidates.poses[rows, 0, :3, 3],
                np.repeat(np.arange(len(pairs)), [len(pair.rows) for pair in pairs]),
            )
            mounting, errors = find_mounting(problem, np.unique(stops, return_inverse=True)[1])
            sigma_m = float(np.median(np.linalg.norm(errors, axis=1))) + _ROUGH_M
            yield _Relation(branch.parent, seer, mounting.frame, sigma_m)
            for pair, point in zip(pairs, mounting.points, strict=True):
                yield _Relation(flange, pair.seen, compose(np.eye(3), point), sigma_m)

    def best(self) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
        """Places all frames in their bodies, by the orientations of boards that fit the views.

        Returns:
            (4, 4) `body_from_frame` by name, and the frames that depend on the unknown orientation
            of a board.
        """
        placed, by_turn, counts = self._grown(())
        if not by_turn:
            return placed, ()
        while np.prod(counts, dtype=float) > _MOST_TRIED:
            counts[counts.index(max(counts))] = 1
        tried = []
        for choice in product(*map(range, counts)):
            placed, by_turn, _ = self._grown(choice)
            tried.append((self._score(placed), choice, placed, by_turn))
        tried.sort(key=lambda item: item[0])
        score, chosen, placed, by_turn = tried[0]
        ambiguous = {
            name
            for value, rival, _, _ in tried[1:]
            if value < CLEAR_RATIO * score
            for name, own, other in zip(by_turn, chosen, rival, strict=False)
            if own != other
        }
        return placed, tuple(name for name in placed if name in ambiguous)

    def _grown(self, chosen: Sequence[int]) -> tuple[dict[str, FloatArray], list[str], list[int]]:
        """Frames (4, 4) in their bodies; those placed by a turned board, and their options."""
        tree = self.problem.tree
        placed = dict.fromkeys((tree.root, *tree.flanges.values()), np.eye(4))
        by_turn: list[str] = []
        counts: list[int] = []
        while options := (
            [*self._related(placed)]
            or [*self._completed(placed)]
            or [*self._placed_by_points(placed)]
            or [*self._by_hand_eye(placed)]
            or [*self._by_partial_hand_eye(placed)]
        ):
            # Frames with several candidates come last: others may be reached unambiguously.
            name, matrices, _ = min(options, key=lambda pair: (len(pair[1]), pair[2]))
            choice = 0
            if len(matrices) > 1:
                choice = chosen[len(by_turn)] if len(by_turn) < len(chosen) else 0
                by_turn.append(name)
                counts.append(len(matrices))
            placed[name] = matrices[choice]
        return placed, by_turn, counts

    def _score(self, placed: _Placed) -> float:
        """Mean distance [m] of the early views from their predictions."""
        capped = [
            np.minimum(pair.candidates.distances(_product(pair.factors, placed)).min(1), _CAPPED_M)
            for pair in self.oriented
            if not pair.unplaced(placed)
        ]
        return float(np.concatenate(capped).mean()) if capped else 0.0

    def _related(self, placed: _Placed) -> Iterator[_Option]:
        """Frames that a relation places."""
        for relation in self.relations:
            first, second = relation.first, relation.second
            if first in placed and second not in placed:
                yield second, (placed[first] @ relation.matrix)[None], relation.sigma_m
            elif second in placed and first not in placed:
                poses = placed[second] @ invert(relation.matrix @ relation.turns)
                yield first, poses, relation.sigma_m

    def _completed(self, placed: _Placed) -> Iterator[_Option]:
        """Frames that are the only unplaced one in the chain of some views."""
        for pair in self.oriented:
            unplaced = pair.unplaced(placed)
            if len(unplaced) != 1:
                continue
            factor, candidates = pair.factors[unplaced[0]], self._between(pair, unplaced, placed)[0]
            if factor.is_inverse:
                candidates = replace(candidates, poses=invert(candidates.poses))
            # A board's own frame may be in any orientation: that of its first view is taken.
            count = 1 if factor.frame == pair.seen else len(self.turns_of(pair.seen))
            fits = [common_transform(candidates, turn) for turn in range(count)]
            yield factor.frame, np.array([matrix for matrix, _ in fits]), fits[0][1]

    def _placed_by_points(self, placed: _Placed) -> Iterator[_Option]:
        """Points that a placed instrument read, and instruments that read placed points."""
        unplaced_seers: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
        for pair in self.pointed:
            inner = pair.factors[1:-1]
            if not all(factor.frame in placed for factor in inner if factor.frame):
                continue
            read, body = pair.candidates.poses[:, 0, :3, 3], _product(inner, placed)
            if pair.seer in placed and pair.seen not in placed:
                seen = apply(invert(body), apply(placed[pair.seer][None], read[:, None]))
                point = np.median(seen[:, 0], axis=0)
                yield pair.seen, compose(np.eye(3), point)[None], _ROUGH_M
            elif pair.seer not in placed and pair.seen in placed:
                points = apply(body, np.broadcast_to(placed[pair.seen][:3, 3], (len(read), 1, 3)))
                unplaced_seers.setdefault(pair.seer, []).append((points[:, 0], read))
        for seer, parts in unplaced_seers.items():
            points, read = (np.concatenate(pair) for pair in zip(*parts, strict=True))
            if len(read) >= _FEWEST_POINTS and spreads(points)[0][1] > _SPREAD_M:
                yield seer, align(points, read)[None], _ROUGH_M

    def _between(
        self, pair: _Pair, unplaced: Sequence[int], placed: _Placed
    ) -> tuple[Candidates, list[FloatArray]]:
        """The candidates carried to the outer unplaced frames, and the products between these."""
        bounds = [-1, *unplaced, len(pair.factors)]
        parts = [_product(pair.factors[begin + 1 : end], placed) for begin, end in pairwise(bounds)]
        return pair.candidates.carried(invert(parts[0]), invert(parts[-1])), parts[1:-1]

    def _open_pairs(self, placed: _Placed) -> Iterator[tuple[_Pair, list[int]]]:
        """Pairs with two or three unplaced frames, and robots between each two of these."""
        for pair in self.oriented:
            unplaced = pair.unplaced(placed)
            # Unknowns without a robot between cannot be distinguished.
            between = [pair.factors[begin + 1 : end] for begin, end in pairwise(unplaced)]
            is_separated = all(any(not factor.frame for factor in part) for part in between)
            if len(pair.early) >= FEWEST and len(unplaced) in (2, 3) and is_separated:
                yield pair, unplaced

    def _by_hand_eye(self, placed: _Placed) -> Iterator[_Option]:
        """Frames that are one of two unplaced ones, with a robot between, or of three."""
        # Views give `u * between * v = seen` with unknown u and v: a hand-eye calibration with
        # `between^-1` as the robot. With three unknowns, two arms are between them.
        for pair, unplaced in self._open_pairs(placed):
            candidates, robots = self._between(pair, unplaced, placed)
            if len(unplaced) == 2:
                edges = hand_eye(invert(robots[0]), candidates, is_up=True)
                if edges is not None:
                    yield from _both_options(pair, unplaced, edges)
            elif (found := _between_arms(robots[0], robots[1], candidates)) is not None:
                yield _option(pair.factors[unplaced[1]], *found)

    def _by_partial_hand_eye(self, placed: _Placed) -> Iterator[_Option]:
        """The same where the motion determines them in part, and a prior may the rest."""
        priors = _with_priors(self.problem)
        for pair, unplaced in self._open_pairs(placed):
            path = {step.frame for step in self.problem.tree.path(pair.seer, pair.seen)}
            if len(unplaced) == 2 and priors & (path - placed.keys()):
                candidates, robots = self._between(pair, unplaced, placed)
                edges, typical_m = partial_hand_eye(invert(robots[0]), candidates)
                if typical_m <= AGREE_M:
                    yield from _both_options(pair, unplaced, edges)


def _robot_part(problem: Problem, step: PathStep, rows: IntArray) -> FloatArray:
    """The robot's part (m, 4, 4) of a chain with one robot, in some observations."""
    robot = problem.poses[step.robot][problem.observations.stops[rows]]
    return robot if step.is_up else invert(robot)


def _both_options(pair: _Pair, unplaced: Sequence[int], edges: PairEdges) -> Iterator[_Option]:
    yield _option(pair.factors[unplaced[0]], invert(edges.x), edges.sigmas_m[0])
    yield _option(pair.factors[unplaced[1]], edges.z, edges.sigmas_m[1])


def _option(factor: _Factor, matrix: FloatArray, sigma_m: float) -> _Option:
    return factor.frame, (invert(matrix) if factor.is_inverse else matrix)[None], sigma_m


def _between_arms(
    first: FloatArray, second: FloatArray, candidates: Candidates
) -> tuple[FloatArray, float] | None:
    """Finds the transform v between two arms, and the views' median distance [m]."""
    if len(first) < _FEWEST_VIEWS or candidates.turns.max(initial=0) > 0:
        return None
    seen = candidates.poses[:, 0]

    def alternated(middle: FloatArray, rounds: int) -> tuple[FloatArray, float]:
        median = np.inf
        for _ in range(rounds):
            # u and w for given v; then v and w for given u; then u and v for given w.
            u_inverse, w = park(invert(first @ middle @ second), seen)
            _, w = park(invert(second), invert(first) @ u_inverse @ seen)
            u_inverse, middle = park(invert(first), seen @ invert(w) @ invert(second))
            predicted = invert(u_inverse) @ first @ middle @ second @ w
            median = float(np.median(distances_m(seen, predicted)))
        return middle, median

    def park(robot: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
        solution = SOLVERS["park"](robot, camera)
        return solution.x, solution.z

    starts = compose(Rotation.create_group("O").as_matrix(), np.zeros(3))
    tried = sorted((alternated(start, _FIRST_ROUNDS) for start in starts), key=lambda at: at[1])
    followed = [alternated(start, _LONG) for start, _ in tried[:_FOLLOWED]]
    middle, median = min(followed, key=lambda pair: pair[1])
    return (middle, median) if median < _NEAR_M else None


def init_frames(
    problem: Problem, views: Sequence[ViewPoses], targets: Mapping[str, Target]
) -> InitialFrames:
    """Finds initial poses of the frames, and the pose of each view that fits them.

    Args:
        problem: The observations, one a view, each by any of its poses.
        views: The views with their candidates.
        targets: The printed targets by their frames.

    Raises:
        DegenerateError: The motion leaves most views ambiguous.
    """
    candidates = Candidates.of(views)
    turns_of = {frame: rotation_transforms(target) for frame, target in targets.items()}
    symmetries = {frame: turns for frame, turns in turns_of.items() if len(turns) > 1}
    tied = init_network(problem, candidates, symmetries)
    distances = _distances(problem, candidates, tied)
    ambiguous = _is_ambiguous(problem, candidates, tied, distances)
    tied, picks = _numbered_as_first(problem, tied, distances.argmin(axis=1), symmetries)
    clear, unclear = np.flatnonzero(~ambiguous).tolist(), np.flatnonzero(ambiguous).tolist()
    if len(unclear) > len(views) / 2:
        raise DegenerateError(
            f"pnp: {len(unclear)} of {len(views)} views allow two poses of the target that the "
            "robot's motion cannot distinguish.",
            culprits=[f"view {views[at].view}" for at in unclear],
            next_step="Add views tilted about different axes, or use a board without symmetry "
            "(ChArUco, or an odd sum of columns and rows).",
        )
    why = "ambiguous: two poses of the target fit image and motion alike"
    seen = problem.observations.observed
    chosen = (views[at].chosen(int(picks[at]), targets.get(seen[at])) for at in clear)
    rejections = tuple(Rejection(views[at].view, why) for at in unclear)
    return InitialFrames(tied, tuple(chosen), rejections)


def _distances(problem: Problem, candidates: Candidates, tied: ConnectedFrames) -> FloatArray:
    """(n, k) distances of the views' candidates from their predictions [m]."""
    # The distances of views of unconnected frames have no meaning.
    frames = {name: tied.edges.get(name, np.eye(4)) for name in problem.unknown}
    distances = candidates.distances(problem.predicted(problem.start(frames)))
    for group in problem.groups:
        rows, robots = group.rows, [step for step in group.path if step.robot]
        is_enough = max(FEWEST, len(distances) / 2) <= len(rows)
        if is_enough and len(robots) == 1 and candidates.valid[rows, 1:].any():
            # A fit to most views is more precise than one to the earliest.
            picks, robot = distances[rows].argmin(axis=1), _robot_part(problem, robots[0], rows)
            distances[rows] = settled_distances(robot, candidates.take(rows), picks)
    return distances


def _is_ambiguous(
    problem: Problem, candidates: Candidates, tied: ConnectedFrames, distances: FloatArray
) -> Mask:
    """(n,) whether another candidate is as likely as the nearest."""
    ordered, ambiguous = np.sort(distances, axis=1), np.zeros(len(distances), dtype=bool)
    best, second = ordered[:, 0], ordered[:, 1:].min(axis=1, initial=np.inf)
    for group in problem.groups:
        if not any(step.frame in tied.untied for step in group.path):
            typical_m = max(float(np.median(best[group.rows])), float(np.median(best)))
            # Views that are far with any candidate are outliers.
            is_near = best < CLEAR_RATIO**2 * typical_m
            has_rival = second < CLEAR_RATIO * np.maximum(best, typical_m)
            ambiguous[group.rows] = (is_near & has_rival)[group.rows]
    poses = (candidates.valid & (candidates.turns == 0)).sum(axis=1)
    for frame in tied.edges.keys() - _with_priors(problem):
        rows = problem.observations.involves(frame)
        # Nothing else decides between the poses of a frame's only view.
        ambiguous |= rows & (rows.sum() == 1) & (poses > 1)
    return ambiguous


def _numbered_as_first(
    problem: Problem, tied: ConnectedFrames, picks: IntArray, symmetries: Mapping[str, FloatArray]
) -> tuple[ConnectedFrames, IntArray]:
    """Turns symmetric boards so that first views keep their corner numbers."""
    # Frames with priors are left as they are.
    edges, picks = dict(tied.edges), picks.copy()
    for frame in edges.keys() & symmetries.keys() - _with_priors(problem):
        rows, turns = problem.observations.involves(frame), symmetries[frame]
        # A target's turns are powers of the first, and candidates come in blocks of all turns.
        planar, turned = np.divmod(picks[rows], len(turns))
        picks[rows] = planar * len(turns) + (turned - turned[0]) % len(turns)
        edges[frame] = edges[frame] @ invert(turns[turned[0]])
    return replace(tied, edges=edges), picks


def _with_priors(problem: Problem) -> set[str]:
    return {name for prior in problem.priors for name in (prior.first, prior.second)}
