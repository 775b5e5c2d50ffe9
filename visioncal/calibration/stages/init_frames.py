"""Initial poses of all frames, and the choice among each view's candidate poses.

The mirrored solutions of a planar target, and the turns of a board with a rotational symmetry, look
alike in one image; the robots' motion separates them.

Every pair of frames of which one saw the other is a chain of segments with robots between, each
segment a constant transform between two frames of one body (what stands in the cell, what a flange
carries). A consensus of the pair's earliest views, as what moves later has not moved yet, gives one
unknown segment directly, two by a hand-eye calibration, three by hand-eye calibrations in turn.
Frames are joined by the best transforms first (Kruskal 1956), which makes more segments known. A
board that looks the same turned is tried in every orientation, and all views together decide.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np

from visioncal.calibration.stages.pairwise import (
    AGREE_M,
    WORST_M,
    Candidates,
    between_arms,
    common_transform,
    hand_eye,
    partial_hand_eye,
    settled_distances,
)
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DegenerateError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_STOPS, FEWEST_VIEWS
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection, Target
from visioncal.estimation.outliers import EARLY_SHARE
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.estimation.problem import Problem
from visioncal.estimation.procrustes import align, spreads
from visioncal.estimation.tree import PathStep, Tree
from visioncal.vision.targets import rotation_transforms

# Most orientations of boards that are tried.
_MOST_TRIED = 256


@dataclass(frozen=True, eq=False)
class InitialFrames:
    """Initial poses of the frames, and one pose of each view."""

    # (4, 4) `parent_from_frame` of the unknown frames that are connected.
    edges: Mapping[str, FloatArray]
    untied: tuple[str, ...]  # The unknown frames that are not.
    # Frames that are connected only through boards that look the same turned, so that other poses
    # fit as well.
    ambiguous: tuple[str, ...]
    # The unambiguous views, with one pose each; where a turned pose was chosen, the corners are
    # renumbered to match.
    views: tuple[ViewPoses, ...] = ()
    rejections: tuple[Rejection, ...] = ()  # The ambiguous views.


@dataclass(frozen=True, eq=False)
class _Relation:
    """A transform `first_from_second` between two frames of one body."""

    first: str
    second: str
    # (t, 4, 4), several where a board that looks the same turned leaves several.
    matrices: FloatArray
    sigma_m: float  # With rotations on a lever.


@dataclass(frozen=True, eq=False)
class _Joined:
    """The frames of a tree, joined to components of its bodies."""

    component: Mapping[str, str]  # Of each frame; its body's name where it is placed in that.
    poses: Mapping[str, FloatArray]  # (4, 4) of each frame in its component.

    @classmethod
    def apart(cls, tree: Tree) -> Self:
        """Every frame by itself."""
        frames = (tree.root, *tree.branches)
        return cls({frame: frame for frame in frames}, dict.fromkeys(frames, np.eye(4)))

    def between(self, first: str, second: str) -> FloatArray | None:
        """(4, 4) `first_from_second`; None where they are not joined."""
        if self.component[first] != self.component[second]:
            return None
        return np.asarray(invert(self.poses[first]) @ self.poses[second])

    def is_alone(self, frame: str) -> bool:
        return [*self.component.values()].count(self.component[frame]) == 1

    def with_joined(self, kept: str, moved: str, kept_from_moved: FloatArray) -> Self:
        """The frames with the component of one of two joined to that of the other."""
        change = self.poses[kept] @ kept_from_moved @ invert(self.poses[moved])
        frames = [name for name, at in self.component.items() if at == self.component[moved]]
        poses = {name: change @ self.poses[name] for name in frames}
        components = dict.fromkeys(frames, self.component[kept])
        return replace(
            self, component={**self.component, **components}, poses={**self.poses, **poses}
        )


@dataclass(frozen=True, eq=False)
class _Pair:
    """The views of a pair of frames, and their chain `seer_from_seen`."""

    seer: str
    seen: str
    rows: IntArray  # All observations, in the order of time.
    early: IntArray  # The earliest of them.
    robots: tuple[PathStep, ...]  # The robots between.
    segments: tuple[tuple[str, str], ...]  # The frames at the ends of what is between the robots.


def init_network(
    problem: Problem, candidates: Candidates, symmetries: Mapping[str, FloatArray]
) -> InitialFrames:
    """Finds initial poses of the frames; the root's body is placed by known edges.

    Args:
        problem: The observations.
        candidates: Their poses.
        symmetries: (t, 4, 4) turns after which a target looks the same, the identity first, by the
            frame of a target that has them.
    """
    growth, branches = _Growth.of(problem, candidates, symmetries), problem.tree.branches
    joined, ambiguous = growth.best()
    edges = {
        name: edge
        for name in problem.tree.unknown
        if growth.is_placed(joined, name)
        and (edge := joined.between(branches[name].parent, name)) is not None
    }
    untied = tuple(name for name in problem.tree.unknown if name not in edges)
    return InitialFrames(edges, untied, ambiguous)


@dataclass(frozen=True, eq=False)
class _Growth:
    """Growth of the components of a tree."""

    problem: Problem
    candidates: Candidates
    symmetries: Mapping[str, FloatArray]
    oriented: Sequence[_Pair]  # The pairs whose rotations were measured, too.
    pointed: Sequence[_Pair]  # The pairs of which positions alone were read.

    @classmethod
    def of(
        cls, problem: Problem, candidates: Candidates, symmetries: Mapping[str, FloatArray]
    ) -> Self:
        """Collects the observations by pairs of frames."""
        seen, rows = problem.observations, dict[tuple[str, str], list[int]]()
        for at in np.argsort(seen.stops, kind="stable").tolist():
            rows.setdefault((seen.observers[at], seen.observed[at]), []).append(at)
        pairs: tuple[list[_Pair], list[_Pair]] = [], []
        for (seer, target), numbers in rows.items():
            every, last_stop = np.array(numbers), EARLY_SHARE * float(seen.stops.max())
            count = int(np.searchsorted(seen.stops[every], last_stop, side="right"))
            robots = tuple(step for step in problem.tree.path(seer, target) if step.robot)
            # Of places alone, the chain is that between the bodies of both.
            is_oriented = bool(seen.has_rotation[every[0]])
            frames = [seer if is_oriented else problem.tree.body(seer)]
            for step in robots:
                ends = step.frame, problem.tree.branches[step.frame].parent
                frames += ends if step.is_up else ends[::-1]
            frames.append(target if is_oriented else problem.tree.body(target))
            segments = tuple(zip(frames[::2], frames[1::2], strict=True))
            early = every[: max(count, FEWEST_STOPS)]
            pair = _Pair(seer, target, every, early, robots, segments)
            pairs[not is_oriented].append(pair)
        return cls(problem, candidates, symmetries, *pairs)

    def best(self) -> tuple[_Joined, tuple[str, ...]]:
        """Joins all frames, by the orientations of boards that fit the views.

        Returns:
            The frames, and those that depend on the unknown orientation of a board.
        """
        known = [*self._known(), *self._mounted_points()]
        apart = _Joined.apart(self.problem.tree)
        for pair in self.oriented:
            if len(pair.segments) <= 2:
                known += self._solved(apart, pair, len(pair.segments))
        joined, by_turn, counts = self._grown(known, ())
        if not by_turn:
            return joined, ()
        while np.prod(counts, dtype=float) > _MOST_TRIED:
            counts[counts.index(max(counts))] = 1
        tried = []
        for choice in product(*map(range, counts)):
            joined, by_turn, _ = self._grown(known, choice)
            tried.append((self._score(joined), choice, joined, by_turn))
        tried.sort(key=lambda item: item[0])
        score, chosen, joined, by_turn = tried[0]
        ambiguous = {
            name
            for value, rival, _, _ in tried[1:]
            if value < CLEAR_RATIO * score
            for name, own, other in zip(by_turn, chosen, rival, strict=False)
            if own != other
        }
        return joined, tuple(name for name in self.problem.tree.branches if name in ambiguous)

    def _grown(
        self, known: Sequence[_Relation], chosen: Sequence[int]
    ) -> tuple[_Joined, list[str], list[int]]:
        """The joined frames; those joined by a turned board, and the number of its turns."""
        joined, relations = _Joined.apart(self.problem.tree), [*known]
        by_turn: list[str] = []
        counts: list[int] = []
        while True:
            options = [
                (relation, self._matrices(joined, relation))
                for relation in relations
                if joined.component[relation.first] != joined.component[relation.second]
            ]
            if not options:
                if not (found := self._found(joined)):
                    return joined, by_turn, counts
                relations += found
                continue
            # Pairs of several transforms come last: others may be reached unambiguously.
            relation, matrices = min(options, key=lambda item: (len(item[1]), item[0].sigma_m))
            first, second, choice = relation.first, relation.second, 0
            is_placed = self.is_placed(joined, second)
            if len(matrices) > 1:
                choice = chosen[len(by_turn)] if len(by_turn) < len(chosen) else 0
                by_turn.append(first if is_placed else second)
                counts.append(len(matrices))
            if is_placed:
                joined = joined.with_joined(second, first, invert(matrices[choice]))
            else:
                joined = joined.with_joined(first, second, matrices[choice])

    def _matrices(self, joined: _Joined, relation: _Relation) -> FloatArray:
        """The transforms of a relation that differ by more than the axes of a board by itself."""
        is_free = relation.second in self.symmetries and joined.is_alone(relation.second)
        return relation.matrices[:1] if is_free else relation.matrices

    def is_placed(self, joined: _Joined, frame: str) -> bool:
        """Whether a frame is placed in its body."""
        tree = self.problem.tree
        return joined.component[frame] in {tree.root, *tree.flanges.values()}

    def _found(self, joined: _Joined) -> list[_Relation]:
        """More relations, by what is joined."""
        for count in (1, 2, 3):
            found = [one for pair in self.oriented for one in self._solved(joined, pair, count)]
            if count == 1:
                found = found or [*self._by_points(joined)]
            if found:
                return found
        return [*self._partly_solved(joined)]

    def _known(self) -> Iterator[_Relation]:
        """The stated transforms."""
        for name, branch in self.problem.tree.branches.items():
            if branch.known is not None:
                yield _Relation(branch.parent, name, branch.known[None], 0.0)
        for prior in self.problem.priors:
            if prior.matrix is not None:
                yield _Relation(prior.first, prior.second, prior.matrix[None], prior.sigma_m)

    def _parts(
        self, joined: _Joined, pair: _Pair, rows: IntArray
    ) -> tuple[list[tuple[str, str]], list[FloatArray]]:
        """The unknown segments of a chain, and the (m or 1, 4, 4) products beside and between."""
        unknown, parts = [], [np.eye(4)[None]]
        for at, segment in enumerate(pair.segments):
            if at:
                parts[-1] = parts[-1] @ _robot_part(self.problem, pair.robots[at - 1], rows)
            if (known := joined.between(*segment)) is not None:
                parts[-1] = parts[-1] @ known
            else:
                unknown.append(segment)
                parts.append(np.eye(4)[None])
        return unknown, parts

    def _solved(self, joined: _Joined, pair: _Pair, count: int) -> Iterator[_Relation]:
        """The relations by a pair with a number of unknown segments."""
        turns = self.symmetries.get(pair.seen, np.eye(4)[None])
        # Where the earliest views do not agree by half, all may.
        for rows in (pair.early, pair.rows) if len(pair.early) < len(pair.rows) else (pair.early,):
            unknown, parts = self._parts(joined, pair, rows)
            if len(unknown) != count:
                return
            candidates = self.candidates.take(rows).carried(invert(parts[0]), invert(parts[-1]))
            if count == 1:
                fits = [common_transform(candidates, turn) for turn in range(len(turns))]
                matrices = np.array([matrix for matrix, _ in fits])
                yield _Relation(*unknown[0], matrices, fits[0][1])
                return
            if len(rows) < FEWEST_VIEWS:
                continue
            if count == 2 and (edges := hand_eye(invert(parts[1]), candidates)) is not None:
                yield _Relation(*unknown[0], invert(edges.x)[None], edges.sigmas_m[0])
                matrices = edges.z @ turns if unknown[1][1] == pair.seen else edges.z[None]
                yield _Relation(*unknown[1], matrices, edges.sigmas_m[1])
                return
            if count == 3 and (found := between_arms(parts[1], parts[2], candidates)) is not None:
                yield _Relation(*unknown[1], found[0][None], found[1])
                return

    def _partly_solved(self, joined: _Joined) -> Iterator[_Relation]:
        """Relations where the motion determines them in part, and a prior may the rest.

        Where nothing else is placed, whether the motion determines it is checked later.
        """
        is_first = not any(self.is_placed(joined, name) for name in self.problem.tree.unknown)
        priors = _with_priors(self.problem)
        for pair in sorted(self.oriented, key=lambda value: -len(value.rows)):
            rows = pair.rows if is_first else pair.early
            unknown, parts = self._parts(joined, pair, rows)
            if len(unknown) != 2 or len(rows) < FEWEST_VIEWS:
                continue
            ends = {end for segment in unknown for end in segment}
            has_prior = any(not self.is_placed(joined, end) for end in priors & ends)
            candidates = self.candidates.take(rows).carried(invert(parts[0]), invert(parts[-1]))
            edges, typical_m = partial_hand_eye(invert(parts[1]), candidates)
            if is_first or (has_prior and typical_m <= AGREE_M):
                yield _Relation(*unknown[0], invert(edges.x)[None], np.inf)
                yield _Relation(*unknown[1], edges.z[None], np.inf)
                return

    def _mounted_points(self) -> Iterator[_Relation]:
        """Relations from an instrument that reads points on a robot's flange, to both."""
        groups: dict[tuple[str, str], list[_Pair]] = {}
        for pair in self.pointed:
            if len(pair.robots) == 1 and not pair.robots[0].is_up:
                groups.setdefault((pair.seer, pair.robots[0].frame), []).append(pair)
        for (seer, flange), pairs in groups.items():
            branch = self.problem.tree.branches[flange]
            rows = np.concatenate([pair.rows for pair in pairs])
            stops = self.problem.observations.stops[rows]
            if len(np.unique(stops)) <= FEWEST_VIEWS:
                continue
            problem = mounting_problem(
                self.problem.poses[branch.robot][stops],
                self.candidates.poses[rows, 0, :3, 3],
                np.repeat(np.arange(len(pairs)), [len(pair.rows) for pair in pairs]),
            )
            mounting, errors = find_mounting(problem, np.unique(stops, return_inverse=True)[1])
            sigma_m = float(np.median(np.linalg.norm(errors, axis=1))) + AGREE_M
            yield _Relation(branch.parent, seer, mounting.frame[None], sigma_m)
            for pair, point in zip(pairs, mounting.points, strict=True):
                yield _Relation(flange, pair.seen, compose(np.eye(3), point)[None], sigma_m)

    def _by_points(self, joined: _Joined) -> Iterator[_Relation]:
        """Points that a placed instrument read, and instruments that read placed points."""
        readings: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
        for pair in self.pointed:
            unknown, (body, *_) = self._parts(joined, pair, pair.rows)
            of_seer, of_seen = pair.segments[0][0], pair.segments[-1][1]
            seer, seen = joined.between(of_seer, pair.seer), joined.between(of_seen, pair.seen)
            read = self.candidates.poses[pair.rows, 0, :3, 3]
            if unknown or (seer is None) == (seen is None):
                continue
            if seer is not None:
                places = apply(invert(body), apply(seer[None], read[:, None]))
                point = np.median(places[:, 0], axis=0)
                yield _Relation(of_seen, pair.seen, compose(np.eye(3), point)[None], AGREE_M)
            elif seen is not None:
                points = apply(body, np.broadcast_to(seen[:3, 3], (len(read), 1, 3)))
                readings.setdefault(pair.seer, []).append((points[:, 0], read))
        for name, parts in readings.items():
            points, read = (np.concatenate(pair) for pair in zip(*parts, strict=True))
            if len(read) >= FEWEST_VIEWS and spreads(points)[0][1] > AGREE_M:
                of_seer = self.problem.tree.body(name)
                yield _Relation(of_seer, name, align(points, read)[None], AGREE_M)

    def _score(self, joined: _Joined) -> float:
        """Mean distance [m] of the early views from their predictions."""
        capped = [np.zeros(0)]
        for pair in self.oriented:
            unknown, parts = self._parts(joined, pair, pair.early)
            if not unknown:
                distances = self.candidates.take(pair.early).distances(parts[0]).min(axis=1)
                capped.append(np.minimum(distances, WORST_M))
        every = np.concatenate(capped)
        return float(every.mean()) if len(every) else 0.0


def _robot_part(problem: Problem, step: PathStep, rows: IntArray) -> FloatArray:
    """The robot's part (m, 4, 4) of a chain, in some observations."""
    robot = problem.poses[step.robot][problem.observations.stops[rows]]
    return invert(robot) if step.is_up else robot


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
    return replace(tied, views=tuple(chosen), rejections=rejections)


def _distances(problem: Problem, candidates: Candidates, tied: InitialFrames) -> FloatArray:
    """(n, k) distances of the views' candidates from their predictions [m]."""
    # The distances of views of unconnected frames have no meaning.
    frames = {name: tied.edges.get(name, np.eye(4)) for name in problem.unknown}
    distances = candidates.distances(problem.predicted(problem.start(frames)))
    for group in problem.groups:
        rows, robots = group.rows, [step for step in group.path if step.robot]
        is_enough = max(FEWEST_VIEWS, len(distances) / 2) <= len(rows)
        if is_enough and len(robots) == 1 and candidates.valid[rows, 1:].any():
            # A fit to most views is more precise than one to the earliest.
            picks, robot = distances[rows].argmin(axis=1), _robot_part(problem, robots[0], rows)
            distances[rows] = settled_distances(invert(robot), candidates.take(rows), picks)
    return distances


def _is_ambiguous(
    problem: Problem, candidates: Candidates, tied: InitialFrames, distances: FloatArray
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
    problem: Problem, tied: InitialFrames, picks: IntArray, symmetries: Mapping[str, FloatArray]
) -> tuple[InitialFrames, IntArray]:
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
