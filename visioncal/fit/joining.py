"""Frames of a cell joined pair by pair, the surest first: poses from which a fit starts.

Every pair of frames of which one saw the other is a chain of segments with robots between, each
segment a constant transform between two frames of one body (what stands in the cell, what a flange
carries). A consensus of the pair's views gives one unknown segment directly, two by a hand-eye
calibration, three by hand-eye calibrations in turn. Frames are joined by the best transforms first
(Kruskal 1956), which makes more segments known. A board that looks the same turned is tried in
every orientation, and all views together decide.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Self

import numpy as np

from visioncal.core.limits import CLEAR_RATIO, FEWEST_STOPS, FEWEST_VIEWS
from visioncal.core.procrustes import align, spreads
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.fit.consensus import (
    AGREE_M,
    WORST_M,
    Candidates,
    PairEdges,
    between_arms,
    common_transform,
    hand_eye,
    partial_hand_eye,
)
from visioncal.session.tree import PathStep, Tree

# Rows by which poses may be shifted; a row is wrong from this multiple of the typical distance on;
# larger distances than this [m] may be those of wrong rows.
_SHIFTS, _FAR, _NEAR_M = (1, -1, 2, -2, 3, -3), 6.0, 0.002


@dataclass(frozen=True, eq=False)
class Relation:
    """A transform `first_from_second` between two frames of one body."""

    first: str
    second: str
    # (t, 4, 4), several where a board that looks the same turned leaves several.
    matrices: FloatArray
    sigma_m: float  # With rotations on a lever.
    misplaced: Mask | None = None  # (n,) rows that have the robot's pose of a row nearby.

    @property
    def is_sure(self) -> bool:
        """Whether views agree on it, and not so few that any would."""
        return self.sigma_m <= AGREE_M


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
class Connected:
    """Poses of the frames that are connected."""

    tree: Tree
    edges: Mapping[str, FloatArray]  # (4, 4) `parent_from_frame` of the unknown frames.
    untied: tuple[str, ...]  # The unknown frames that are not connected.
    # Frames that are connected only through boards that look the same turned, so that other poses
    # fit as well.
    ambiguous: tuple[str, ...]
    misplaced: Mask  # (n,) rows that have the robot's pose of a row nearby.

    @cached_property
    def _parent_from(self) -> Mapping[str, FloatArray]:
        """The edges, with those that are known."""
        branches = self.tree.branches.items()
        known = {name: branch.known for name, branch in branches if branch.known is not None}
        return {**known, **self.edges}

    def ties(self, seer: str, seen: str) -> bool:
        """Whether all between two frames is known."""
        return not any(step.frame in self.untied for step in self.tree.path(seer, seen))

    def predicted(self, seer: str, seen: str, poses: Mapping[str, FloatArray]) -> FloatArray:
        """`seer_from_seen` (..., 4, 4) by (..., 4, 4) poses of the robots between."""
        found = np.eye(4)
        for step in self.tree.path(seer, seen):
            edge = poses[step.robot] if step.robot else self._parent_from[step.frame]
            found = found @ (invert(edge) if step.is_up else edge)
        return found


@dataclass(frozen=True, eq=False)
class _Pair:
    """The views of a pair of frames, and their chain `seer_from_seen`."""

    seer: str
    seen: str
    rows: IntArray  # All observations, in the order of time.
    early: IntArray  # The earliest of them.
    robots: tuple[PathStep, ...]  # The robots between.
    segments: tuple[tuple[str, str], ...]  # The frames at the ends of what is between the robots.


@dataclass(frozen=True, eq=False)
class Network:
    """Observations of frames, by which these are joined; the root's body is placed by known edges.

    Of n rows, each is an observation of one frame in another.
    """

    tree: Tree
    poses: Mapping[str, FloatArray]  # (s, 4, 4) `base_from_flange` of each robot, by stop.
    seers: Sequence[str]  # (n,) the frames that saw.
    seen: Sequence[str]  # (n,) the frames that were seen.
    stops: IntArray  # (n,)
    has_rotation: Mask  # (n,) whether a pose was seen, not a place alone.
    candidates: Candidates  # Of the n rows.
    # (t, 4, 4) turns after which a target looks the same, the identity first, by the frame of a
    # target that has them.
    symmetries: Mapping[str, FloatArray] = field(default_factory=dict)
    stated: tuple[Relation, ...] = ()  # Priors that state a whole pose.
    priors: frozenset[str] = frozenset()  # Frames about which any prior states something.
    # Share of the earliest stops of which consensus is sought first: later, frames may have moved.
    early: float = 1.0

    def connected(self) -> Connected:
        """Joins the frames."""
        joined, ambiguous, relations = self._best()
        branches = self.tree.branches
        edges = {
            name: edge
            for name in self.tree.unknown
            if self.is_placed(joined, name)
            and (edge := joined.between(branches[name].parent, name)) is not None
        }
        untied = tuple(name for name in self.tree.unknown if name not in edges)
        wrong = [one.misplaced for one in relations if one.misplaced is not None]
        misplaced = np.any(wrong, axis=0) if wrong else np.zeros(len(self.stops), dtype=bool)
        return Connected(self.tree, edges, untied, ambiguous, misplaced)

    @cached_property
    def pairs(self) -> tuple[_Pair, ...]:
        """The observations by pairs of frames."""
        rows, last = (
            dict[tuple[str, str], list[int]](),
            self.early * float(self.stops.max(initial=0)),
        )
        for at in np.argsort(self.stops, kind="stable").tolist():
            rows.setdefault((self.seers[at], self.seen[at]), []).append(at)
        pairs = []
        for (seer, target), numbers in rows.items():
            every = np.array(numbers)
            count = int(np.searchsorted(self.stops[every], last, side="right"))
            robots = tuple(step for step in self.tree.path(seer, target) if step.robot)
            # Of places alone, the chain is that between the bodies of both.
            is_oriented = bool(self.has_rotation[every[0]])
            frames = [seer if is_oriented else self.tree.body(seer)]
            for step in robots:
                ends = step.frame, self.tree.branches[step.frame].parent
                frames += ends if step.is_up else ends[::-1]
            frames.append(target if is_oriented else self.tree.body(target))
            segments = tuple(zip(frames[::2], frames[1::2], strict=True))
            early = every[: max(count, FEWEST_STOPS)]
            pairs.append(_Pair(seer, target, every, early, robots, segments))
        return tuple(pairs)

    @cached_property
    def oriented(self) -> list[_Pair]:
        """The pairs whose rotations were measured, too."""
        return [pair for pair in self.pairs if self.has_rotation[pair.rows[0]]]

    @cached_property
    def pointed(self) -> list[_Pair]:
        """The pairs of which positions alone were read."""
        return [pair for pair in self.pairs if not self.has_rotation[pair.rows[0]]]

    def _best(self) -> tuple[_Joined, tuple[str, ...], Sequence[Relation]]:
        """Joins all frames, by the orientations of boards that fit the views.

        Returns:
            The frames; those that depend on the unknown orientation of a board; what joined them.
        """
        known = [
            Relation(branch.parent, name, branch.known[None], 0.0)
            for name, branch in self.tree.branches.items()
            if branch.known is not None
        ]
        known += [*self.stated, *self._mounted_points()]
        apart = _Joined.apart(self.tree)
        for pair in self.oriented:
            if len(pair.segments) <= 2:
                known += self._solved(apart, pair, len(pair.segments))
        joined, relations, by_turn, counts = self._grown(known, ())
        if not by_turn:
            return joined, (), relations
        # Most orientations of boards that are tried.
        while np.prod(counts, dtype=float) > 256:
            counts[counts.index(max(counts))] = 1
        tried = []
        for choice in product(*map(range, counts)):
            joined, relations, by_turn, _ = self._grown(known, choice)
            tried.append((self._score(joined), choice, joined, by_turn, relations))
        tried.sort(key=lambda item: item[0])
        score, chosen, joined, by_turn, relations = tried[0]
        ambiguous = {
            name
            for value, rival, *_ in tried[1:]
            if value < CLEAR_RATIO * score
            for name, turn, other in zip(by_turn, chosen, rival, strict=False)
            if turn != other
        }
        names = tuple(name for name in self.tree.branches if name in ambiguous)
        return joined, names, relations

    def _grown(
        self, known: Sequence[Relation], chosen: Sequence[int]
    ) -> tuple[_Joined, list[Relation], list[str], list[int]]:
        """The joined frames; what joined them; those by a turned board, and the number of turns."""
        joined, relations, used = _Joined.apart(self.tree), [*known], list[Relation]()
        by_turn: list[str] = []
        counts: list[int] = []
        while True:
            options = [
                (relation, self._matrices(joined, relation))
                for relation in relations
                if joined.component[relation.first] != joined.component[relation.second]
            ]
            if not any(relation.is_sure for relation, _ in options):
                found = self._found(joined)
                if not options and not found:
                    return joined, used, by_turn, counts
                # By what is joined, more views may show a transform than the few of a pair.
                relations += [one for one in found if one.is_sure or not options]
                if not options or any(one.is_sure for one in found):
                    continue
            # Pairs of several transforms come last: others may be reached unambiguously.
            relation, matrices = min(options, key=lambda item: (len(item[1]), item[0].sigma_m))
            first, second, choice = relation.first, relation.second, 0
            used.append(relation)
            is_placed = self.is_placed(joined, second)
            if len(matrices) > 1:
                choice = chosen[len(by_turn)] if len(by_turn) < len(chosen) else 0
                by_turn.append(first if is_placed else second)
                counts.append(len(matrices))
            if is_placed:
                joined = joined.with_joined(second, first, invert(matrices[choice]))
            else:
                joined = joined.with_joined(first, second, matrices[choice])

    def _matrices(self, joined: _Joined, relation: Relation) -> FloatArray:
        """The transforms of a relation that differ by more than the axes of a board by itself."""
        is_free = relation.second in self.symmetries and joined.is_alone(relation.second)
        return relation.matrices[:1] if is_free else relation.matrices

    def is_placed(self, joined: _Joined, frame: str) -> bool:
        """Whether a frame is placed in its body."""
        tree = self.tree
        return joined.component[frame] in {tree.root, *tree.flanges.values()}

    def _found(self, joined: _Joined) -> list[Relation]:
        """More relations, by what is joined."""
        for count in (1, 2, 3):
            found = [one for pair in self.oriented for one in self._solved(joined, pair, count)]
            if count == 1:
                found = found or [*self._by_points(joined)]
            if found:
                return found
        return [*self._partly_solved(joined)]

    def _parts(
        self, joined: _Joined, pair: _Pair, rows: IntArray, shift: int = 0
    ) -> tuple[list[tuple[str, str]], list[FloatArray]]:
        """The unknown segments of a chain, and the (m or 1, 4, 4) products beside and between.

        The robots stand where they do so many stops later.
        """
        unknown, parts, stops = [], [np.eye(4)[None]], self.stops[rows] + shift
        for at, segment in enumerate(pair.segments):
            if at:
                step = pair.robots[at - 1]
                robot = self.poses[step.robot][stops]
                parts[-1] = parts[-1] @ (invert(robot) if step.is_up else robot)
            if (known := joined.between(*segment)) is not None:
                parts[-1] = parts[-1] @ known
            else:
                unknown.append(segment)
                parts.append(np.eye(4)[None])
        return unknown, parts

    def _solved(self, joined: _Joined, pair: _Pair, count: int) -> Iterator[Relation]:
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
                # A view agrees with itself.
                sigma_m = fits[0][1] if len(rows) >= FEWEST_VIEWS else np.inf
                yield Relation(*unknown[0], matrices, sigma_m)
                return
            if len(rows) < FEWEST_VIEWS:
                continue
            edges, wrong = None, None
            if count == 2:
                edges, wrong = self._hand_eye(joined, pair, rows, parts[1], candidates)
            if edges is not None:
                yield Relation(*unknown[0], invert(edges.x)[None], edges.sigmas_m[0], wrong)
                matrices = edges.z @ turns if unknown[1][1] == pair.seen else edges.z[None]
                yield Relation(*unknown[1], matrices, edges.sigmas_m[1], wrong)
                return
            if count == 3 and (found := between_arms(parts[1], parts[2], candidates)) is not None:
                yield Relation(*unknown[1], found[0][None], found[1])
                return

    def _hand_eye(
        self, joined: _Joined, pair: _Pair, rows: IntArray, between: FloatArray, seen: Candidates
    ) -> tuple[PairEdges | None, Mask | None]:
        """Both unknown edges of a chain, and (n,) rows that have the pose of a row nearby.

        `between` (m, 4, 4) is the part between them, and `seen` what else is left of the views.
        Where rows are shifted from one on, fewer than half may be right; those shifted back have
        the same edges, and both together have more.
        """
        stops, half = self.stops[rows], len(rows) // 2 + 1
        best, wrong = hand_eye(invert(between), seen), None
        least = np.full(len(rows), AGREE_M) if best is None else best.residuals.min(axis=1)
        if not _is_doubtful(least):
            return best, None
        for shift in _SHIFTS:
            last = len(next(iter(self.poses.values())))
            in_range = np.flatnonzero((stops + shift >= 0) & (stops + shift < last))
            robots = [self.poses[step.robot][stops[in_range] + shift] for step in pair.robots]
            in_range = in_range[np.isfinite(robots).all(axis=(0, 2, 3))]
            if len(in_range) < max(half, FEWEST_VIEWS):
                continue
            _, (before, moved, after) = self._parts(joined, pair, rows[in_range], shift)
            shifted = self.candidates.take(rows[in_range]).carried(invert(before), invert(after))
            edges = hand_eye(invert(moved), shifted)
            if edges is None:
                continue
            near = seen.distances(invert(edges.x) @ between @ edges.z).min(axis=1)
            by_shift = np.full(len(rows), np.inf)
            by_shift[in_range] = edges.residuals.min(axis=1)
            either = np.minimum(near, by_shift)
            limit = _FAR * np.sort(either)[:half].mean()
            is_better = 4.0 * np.sort(either)[:half].sum() < np.sort(least)[:half].sum()
            if is_better and (near <= limit).sum() > FEWEST_VIEWS:
                is_wrong = (near > limit) & (by_shift <= limit)
                best, least = edges, either
                # Others at a stop have its pose, too.
                gone = np.setdiff1d(stops[is_wrong], stops[~is_wrong])
                wrong = np.isin(self.stops, gone)
                wrong[rows[is_wrong]] = True
        return best, wrong

    def _partly_solved(self, joined: _Joined) -> Iterator[Relation]:
        """Relations where the motion determines them in part, and a prior may the rest.

        Where nothing else is placed, whether the motion determines it is checked later.
        """
        is_first = not any(self.is_placed(joined, name) for name in self.tree.unknown)
        for pair in sorted(self.oriented, key=lambda value: -len(value.rows)):
            rows = pair.rows if is_first else pair.early
            unknown, parts = self._parts(joined, pair, rows)
            if len(unknown) != 2 or len(rows) < FEWEST_VIEWS:
                continue
            ends = {end for segment in unknown for end in segment}
            has_prior = any(not self.is_placed(joined, end) for end in self.priors & ends)
            candidates = self.candidates.take(rows).carried(invert(parts[0]), invert(parts[-1]))
            edges, typical_m = partial_hand_eye(invert(parts[1]), candidates)
            if is_first or (has_prior and typical_m <= AGREE_M):
                yield Relation(*unknown[0], invert(edges.x)[None], np.inf)
                yield Relation(*unknown[1], edges.z[None], np.inf)
                return

    def _mounted_points(self) -> Iterator[Relation]:
        """Relations of frames that read points moving before them, and of these points.

        An instrument in the cell reads points on a flange; a tool's tip on it touches points in the
        cell.
        """
        groups: dict[tuple[str, PathStep], list[_Pair]] = {}
        for pair in self.pointed:
            if len(pair.robots) == 1:
                groups.setdefault((pair.seer, pair.robots[0]), []).append(pair)
        for (seer, step), pairs in groups.items():
            rows = np.concatenate([pair.rows for pair in pairs])
            stops = self.stops[rows]
            if len(np.unique(stops)) <= FEWEST_VIEWS:
                continue
            ends = step.frame, self.tree.branches[step.frame].parent
            instrument_frame, carrier = ends if step.is_up else ends[::-1]
            robot = self.poses[step.robot][stops]
            problem = mounting_problem(
                invert(robot) if step.is_up else robot,
                self.candidates.poses[rows, 0, :3, 3],
                np.repeat(np.arange(len(pairs)), [len(pair.rows) for pair in pairs]),
            )
            mounting, errors = find_mounting(problem, np.unique(stops, return_inverse=True)[1])
            sigma_m = float(np.median(np.linalg.norm(errors, axis=1))) + AGREE_M
            yield Relation(instrument_frame, seer, mounting.frame[None], sigma_m)
            for pair, point in zip(pairs, mounting.points, strict=True):
                yield Relation(carrier, pair.seen, compose(np.eye(3), point)[None], sigma_m)

    def _by_points(self, joined: _Joined) -> Iterator[Relation]:
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
                yield Relation(of_seen, pair.seen, compose(np.eye(3), point)[None], AGREE_M)
            elif seen is not None:
                points = apply(body, np.broadcast_to(seen[:3, 3], (len(read), 1, 3)))
                readings.setdefault(pair.seer, []).append((points[:, 0], read))
        for name, parts in readings.items():
            points, read = (np.concatenate(pair) for pair in zip(*parts, strict=True))
            if len(read) >= FEWEST_VIEWS and spreads(points)[0][1] > AGREE_M:
                of_seer = self.tree.body(name)
                yield Relation(of_seer, name, align(points, read)[None], AGREE_M)

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


def _is_doubtful(least: FloatArray) -> bool:
    """Whether (m,) distances are not those of noise for two thirds of the rows [m]."""
    typical = np.sort(least)[: max(2 * len(least) // 5, 1)].mean()
    return bool(typical > _NEAR_M or np.mean(least > _FAR * typical) > 1 / 3)
