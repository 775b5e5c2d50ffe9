"""What may be wrong with a record: hypotheses, all scored against the same alternative.

One hypothesis adds columns (a frame moved, a board of another size): its Bayes factor comes from
the factorisation alone, with the sightings that were rejected without it. Another undoes a mistake
of the record (a board read upside down, exchanged rows): what the sound sightings predict is seen
then. The alternative is that the rejected sightings are wrong for no known reason, each with a pose
of its own.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import Corners, FloatArray, IntArray
from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.linearise import Gram, corner_rows, pairs_of, predicted
from visioncal.fit.score import Score, of_unknown
from visioncal.fit.solve import CellFit
from visioncal.fit.unknowns import Key
from visioncal.vision.targets import corner_positions

# Log-density of a wrong sighting's pose: over two radians and 0.3 m, an axis.
_WRONG = -3.0 * float(np.log(2.0 * 0.3))
# Prior probability of each kind of hypothesis.
_RARE = 0.05


@dataclass(frozen=True)
class Case:
    """One case of a hypothesis, as a frame that moved at one stop."""

    kind: str
    frame: str  # What it is about.
    views: tuple[int, ...]  # The views that it starts at, or those that it undoes.
    odds: float  # Log-odds against sightings that are wrong for no known reason, with its prior.


class Hypothesis(ABC):
    """A kind of thing that may be wrong."""

    kind: str

    @abstractmethod
    def cases(self, seen: "Examined") -> Iterator[Case]:
        """Its cases, with their odds."""


@dataclass(frozen=True, eq=False)
class Examined:
    """A fit, and what rejected sightings say beside it."""

    solved: CellFit

    @property
    def fit(self) -> Fit:
        """The fit of the sightings that agree."""
        return self.solved.fit

    @cached_property
    def rejected(self) -> IntArray:
        """(r,) rows of the sightings that do not."""
        return np.flatnonzero(~self.fit.used)

    @cached_property
    def stops(self) -> IntArray:
        """(s,) stops that have sightings."""
        return np.unique([sighting.stop for sighting in self.fit.cell.sightings])

    @cached_property
    def whole(self) -> Fit:
        """The fit of all sightings, at the same sizes and linearisation."""
        fit, every = self.fit, np.ones(len(self.fit.used), bool)
        mixed = mixed_model(fit.cell, fit.unknowns, fit.linearised, fit.grams, every)
        estimate = mixed.at(fit.estimate.logs, is_sloped=False)
        return replace(fit, used=every, mixed=mixed, estimate=estimate, considered=None, shift=None)

    @cached_property
    def all_sound(self) -> float:
        """Log-odds that all sightings are sound, without any hypothesis."""
        if not len(self.rejected):
            return 0.0
        sound = self.fit.mixed.at(self.fit.estimate.logs, is_sloped=False)
        alone = sum(self._alone(row) + _WRONG for row in self.rejected.tolist())
        return -0.5 * (self.whole.estimate.value - sound.value) - alone

    def _alone(self, row: int) -> float:
        """Log-density of a sighting's rows with the best pose of its own."""
        gram, at = self._gram(row)
        logs = self.fit.estimate.logs
        full, square = gram.heads(logs)[at], float(gram.squares(logs)[at])
        information = full[:6, :6] + 1e-9 * np.diag(np.diag(full)[:6])
        least = square - full[:6, -1] @ np.linalg.solve(information, full[:6, -1])
        logs = np.append(logs, 0.0)
        counts = sum(float(part.counts[at]) * logs[part.size] for part in gram.parts)
        _, log_det = np.linalg.slogdet(information)
        return float(-0.5 * least - counts + 0.5 * (6.0 * np.log(2.0 * np.pi) - log_det))

    def _gram(self, row: int) -> tuple[Gram, int]:
        gram = next(gram for gram in self.fit.grams if row in gram.rows)
        return gram, int(np.flatnonzero(gram.rows == row)[0])

    @cached_property
    def predicted(self) -> FloatArray:
        """(n, 6, 6) covariance of each sighting's pose as the sound ones predict it."""
        return self.fit.left_out().predicted

    def expected(self, row: int, stop: int | None = None) -> FloatArray:
        """(4, 4) pose of a sighting as predicted, at another stop's poses of the arms if given."""
        fit, sighting = self.fit, self.fit.cell.sightings[row]
        at = np.array([sighting.stop if stop is None else stop])
        path, moments = fit.cell.tree.path(*sighting.pair), fit.cell.moments.take(at)
        found = predicted(fit.cell, fit.unknowns, fit.state, path, moments, {})
        return np.asarray(found.poses[0])

    def poses(self, row: int) -> list[tuple[FloatArray, FloatArray]]:
        """Poses (4, 4) that a sighting may have by itself, with their covariances (6, 6)."""
        found = self._poses.get(row)
        if found is None:
            rivals = self.solved.start.rivals[row]
            found = self._poses[row] = [self._refined(row, rival) for rival in rivals]
        return found

    @cached_property
    def _poses(self) -> dict[int, list[tuple[FloatArray, FloatArray]]]:
        return {}

    def _refined(self, row: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A sighting's pose by its corners alone, near one, with the fit's lens and board."""
        fit, sighting = self.fit, self.fit.cell.sightings[row]
        if not isinstance(sighting.evidence, Corners):
            gram, at = self._gram(row)
            own = gram.heads(fit.estimate.logs)[at, :6, :6]
            return pose, np.asarray(np.linalg.pinv(own, hermitian=True), dtype=float)
        (pair,) = pairs_of(fit.cell.with_sightings([sighting]))
        gram, at = self._gram(row)
        twists = pair.twists({name: slope[[at]] for name, slope in gram.by_effects.items()})
        information = np.eye(6)
        for _ in range(8):
            rows = corner_rows(fit.unknowns, fit.state, pair, pose[None], twists)
            by_pose, residual = rows.head[:, :, :6].reshape(-1, 6), rows.residual.ravel()
            information = by_pose.T @ by_pose
            information += 1e-9 * np.diag(np.diag(information))
            step = np.linalg.solve(information, by_pose.T @ residual)
            pose = pose @ exp(np.clip(step, -0.3, 0.3))
        sigma = fit.sizes.get(f"px {sighting.seer}", 1.0)
        return pose, np.asarray(sigma**2 * np.linalg.inv(information), dtype=float)

    def gain(self, row: int, pose: tuple[FloatArray, FloatArray], expected: FloatArray) -> float:
        """Log-odds that a rejected sighting has a pose that is expected, against a wrong one."""
        seen, own = pose
        away, covariance = log(invert(expected) @ seen), self.predicted[row] + own
        square = float(away @ np.linalg.solve(covariance, away))
        value = -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * covariance)[1])
        # One that the undoing does not explain at all is as good as any such.
        return float(max(value - _WRONG, -50.0))


@dataclass(frozen=True)
class Moved(Hypothesis):
    """A frame stands elsewhere from some stop on."""

    # Sizes of steps [rad], [m].
    step: tuple[float, float] = (5e-3, 3e-3)
    kind = "moved"

    def cases(self, seen: Examined) -> Iterator[Case]:
        """See `Hypothesis`."""
        stops, sigmas = seen.stops, np.repeat(self.step, 3)
        onsets, edges = stops[2:-1], seen.fit.cell.unknown
        views = {s.stop: s.view for s in reversed(seen.fit.cell.sightings)}
        for name in edges:
            score = by_onset(seen.whole, ("edge", name), stops)
            for at, onset in enumerate(onsets.tolist()):
                gain = part_of(score, 6, at).gain(sigmas)
                odds = gain + seen.all_sound - np.log(len(onsets) * len(edges))
                yield Case(self.kind, name, (views[onset],), float(odds))


def by_onset(fit: Fit, key: Key, stops: IntArray) -> Score:
    """The score of an unknown that differs from the third stop on, from the fourth on, ..."""
    onsets, count = stops[2:-1], fit.unknowns[key].count
    maps = np.zeros((len(fit.cell.moments), count, count * len(onsets)))
    for at, onset in enumerate(onsets.tolist()):
        maps[onset:, np.arange(count), count * at + np.arange(count)] = 1.0
    return of_unknown(fit, key, maps)


def part_of(score: Score, count: int, at: int) -> Score:
    """The score of the columns of one onset."""
    own = slice(count * at, count * at + count)
    return Score(score.pull[own], score.information[own, own], score.freedom)


@dataclass(frozen=True)
class Turned(Hypothesis):
    """A board was read as if it were turned by half, in some views."""

    kind = "turned"

    def cases(self, seen: Examined) -> Iterator[Case]:
        """See `Hypothesis`."""
        gains = dict[str, list[tuple[int, float]]]()
        for row in seen.rejected.tolist():
            sighting = seen.fit.cell.sightings[row]
            if sighting.corners is None:
                continue
            points = corner_positions(seen.fit.cell.boards[sighting.seen])
            middle = (points.min(axis=0) + points.max(axis=0)) * [1.0, 1.0, 0.0]
            half = compose(np.diag([-1.0, -1.0, 1.0]), middle)
            pose, own = seen.poses(row)[0]
            gain = seen.gain(row, (pose @ half, own), seen.expected(row))
            gains.setdefault(sighting.seen, []).append((sighting.view, gain))
        for board, found in gains.items():
            among = float(np.log(len(seen.stops)))
            right = [(view, gain - among) for view, gain in found if gain > among]
            if right:
                views = tuple(view for view, _ in right)
                yield Case(self.kind, board, views, sum(gain for _, gain in right))


@dataclass(frozen=True)
class Exchanged(Hypothesis):
    """The poses of the arms at two stops were exchanged."""

    kind = "exchanged"

    def cases(self, seen: Examined) -> Iterator[Case]:
        """See `Hypothesis`."""
        rows_of = dict[int, list[int]]()
        for row in seen.rejected.tolist():
            rows_of.setdefault(seen.fit.cell.sightings[row].stop, []).append(row)
        stops = sorted(rows_of)
        for at, first in enumerate(stops):
            for second in stops[at + 1 :]:
                gain = 0.0
                for own, other in ((first, second), (second, first)):
                    for row in rows_of[own]:
                        expected = seen.expected(row, other)
                        gain += max(seen.gain(row, pose, expected) for pose in seen.poses(row))
                rows = rows_of[first] + rows_of[second]
                views = tuple(seen.fit.cell.sightings[row].view for row in rows)
                among = 2.0 * np.log(len(seen.stops))
                yield Case(self.kind, "", views, float(gain - among))


def ranked(solved: CellFit, hypotheses: Iterable[Hypothesis]) -> Sequence[tuple[Case, float]]:
    """All cases with their probabilities, the likeliest first; what is left is that none is so."""
    seen = Examined(solved)
    cases = [case for hypothesis in hypotheses for case in hypothesis.cases(seen)]
    logs = np.array([0.0, *(case.odds + np.log(_RARE) for case in cases)])
    shares = np.exp(logs - np.logaddexp.reduce(logs))[1:]
    order = np.argsort(-shares, kind="stable")
    return [(cases[at], float(shares[at])) for at in order]
