"""The search: which sightings agree, the most likely sizes, and Gauss-Newton steps."""

from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.quantiles import FALSE_REJECTION, f_limit
from visioncal.core.types import FloatArray, Mask, chosen_rows
from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit, LeftOut
from visioncal.fit.linearise import Gram, linearised
from visioncal.fit.mixed import Mixed
from visioncal.fit.pairs import Pair, pairs_of
from visioncal.fit.sizes import Found, most_likely, significant
from visioncal.fit.start import Start
from visioncal.fit.unknowns import State, Unknowns
from visioncal.fit.weights import weighed
from visioncal.model import Cell

# Rounds in which sightings come back while the noise is scaled by what most have: the nearest half
# has less noise than all.
_SCALED, _WIDENED = 4, 6


@dataclass
class Effort:
    """The cost of a fit."""

    linearisations: int = 0
    likelihoods: int = 0


@dataclass(frozen=True, eq=False)
class Search:
    """A cell with the unknowns that are sought."""

    cell: Cell
    unknowns: Unknowns
    pairs: tuple[Pair, ...]
    sound: Mask  # (n,) sightings that may agree.
    effort: Effort = field(default_factory=Effort)

    @classmethod
    def of(cls, cell: Cell, unknowns: Unknowns, sound: Mask | None = None) -> "Search":
        """A search of some unknowns of a cell, of whose n sightings those in a mask may agree."""
        may = np.ones(len(cell.sightings), bool) if sound is None else sound
        return cls(cell, unknowns, pairs_of(cell), may)

    def with_unknowns(self, unknowns: Unknowns) -> "Search":
        """The search of others."""
        return replace(self, unknowns=unknowns)

    def run(self, state: State, used: Mask, known: Fit | None = None) -> tuple[Fit, LeftOut]:
        """The fit of the sightings that agree.

        Args:
            state: Where to start.
            used: (n,) first guess of the sightings that agree.
            known: A fit with other unknowns, whose sizes are the first ones.
        """
        before = used & self.sound
        fit, left_out = self._agreeing(self._sized(state, before, known))
        # Most linearisations.
        for _ in range(8):
            if np.array_equal(before, fit.used) and _is_settled(fit):
                break
            before = fit.used
            fit, left_out = self._agreeing(self._sized(fit.state, before, fit))
        return fit, left_out

    def with_all(self, fit: Fit) -> Fit:
        """The fit with all sightings that may agree, whether they do or not."""
        return self._refitted(fit, self.sound)

    def weighed(self, fit: Fit) -> "Search | None":
        """The search with corners judged by a fit; None where these are as sure as they were."""
        # Under the lens of a start, a sound view may have seemed none.
        judged = fit.used | ~(self.sound | self.cell.held)
        found = weighed(self.cell, fit.unknowns, fit.state, self.pairs, judged)
        sound = np.where(judged, found.sound, self.sound)
        if not found.changed and np.array_equal(sound, self.sound):
            return None
        return replace(self, cell=found.cell, pairs=pairs_of(found.cell), sound=sound)

    def _sized(self, state: State, used: Mask, last: Fit | None) -> Fit:
        """The fit at a linearisation, with the most likely sizes."""
        grams = linearised(self.cell, self.unknowns, state, self.pairs)
        self.effort.linearisations += 1
        mixed = mixed_model(self.cell, self.unknowns, state, grams, used)
        # The noise that other unknowns leave may show what it hid.
        is_again = last is not None and last.unknowns.members == self.unknowns.members
        known = {} if last is None else last.sizes
        closed = frozenset() if last is None else last.unknowns.closed
        unknowns = self.unknowns.closing(closed if is_again else ())
        starts, (low, high) = unknowns.starts(), unknowns.bounds()
        begin = starts.copy()
        for name, value in known.items():
            at = unknowns.size_of(name)
            if is_again or name not in closed:
                # Not from a bound: there, a size has no slope.
                begin[at] = np.clip(np.log(value), low[at] + 2.0, high[at])
        found = most_likely(mixed, begin, low, high)
        random = {size for size, *_ in unknowns.priors() if size >= 0}
        if is_again:
            # A size was tested at the last linearisation, and is again where its logarithm has
            # changed by more than this.
            moved = np.abs(found.estimate.logs - begin) > 0.2
            is_open = (high > low) & (found.estimate.logs > low)
            random -= set(np.flatnonzero(is_open & ~moved).tolist())
        tested = {at: unknowns.sizes[at] for at in sorted(random)}
        found, more = significant(mixed, found, starts, low, high, tested)
        names = {unknowns.sizes[size].name for size in more}
        return self._fit(
            state, grams, used, unknowns.closing(unknowns.closed | names), mixed, found
        )

    def _fit(
        self, state: State, grams: tuple[Gram, ...], used: Mask, unknowns: Unknowns, mixed: Mixed,
        found: Found,
    ) -> Fit:  # fmt: skip
        self.effort.likelihoods += found.evaluations
        return Fit(self.cell, unknowns, state, grams, used, mixed, found.estimate)

    def _agreeing(self, fit: Fit) -> tuple[Fit, LeftOut]:
        """The fit of the sightings within the reach of noise; steps at one linearisation."""
        count, fewest = len(fit.used), max(int(self.sound.sum()) // 2, 5)
        for turn in range(_WIDENED + count):
            left_out, beyond = self._left_out(fit)
            # The median of chi-square of six degrees is 5.35.
            middle = float(np.median(left_out.squares[fit.used])) / 5.35
            beyond /= max(middle, 1.0) if turn < _SCALED else 1.0
            reached = self.sound & ~fit.used & (beyond < 1.0)
            if turn < _WIDENED and reached.any():
                fit = self._refitted(fit, fit.used | reached)
                continue
            worst = int(np.argmax(np.where(fit.used, beyond, 0.0)))
            # Share of the limit from which sightings are tested again, by noise without them.
            if beyond[worst] < 0.4 or fit.used.sum() <= fewest:
                break
            # A sighting that is tested adds to no noise.
            without = self._refitted(fit, fit.used & (np.arange(count) != worst))
            if beyond[worst] < 1.0 and self._left_out(without, worst)[1][0] < 1.0:
                break
            fit = without
        return fit, left_out

    def _left_out(self, fit: Fit, row: int | None = None) -> tuple[LeftOut, FloatArray]:
        """Sightings left out, all or one, and their squares (n,) over the largest of noise."""
        count = len(fit.used)
        if row is None:
            left_out = fit.left_out()
        else:
            some = [gram.take(gram.rows == row) for gram in fit.grams if row in gram.rows]
            left_out = chosen_rows(fit.left_out(some), [row])
        freedom = max(3.0 * fit.used.sum() - 3.0 * len(self.cell.unknown), 6.0)
        limits = f_limit(FALSE_REJECTION / count, left_out.directions, freedom)
        return left_out, left_out.squares / (left_out.directions * limits)

    def _refitted(self, fit: Fit, used: Mask) -> Fit:
        """The same linearisation with other sightings."""
        mixed = mixed_model(self.cell, fit.unknowns, fit.linearised, fit.grams, used)
        low, high = fit.unknowns.bounds()
        found = most_likely(mixed, np.clip(fit.estimate.logs, low, high), low, high)
        return self._fit(fit.linearised, fit.grams, used, fit.unknowns, mixed, found)


def _is_settled(fit: Fit) -> bool:
    """Whether one more step would be a small share of every sigma.

    A step leaves a residual of second order: as much of it as frames turn, lenses zoom, and slopes
    of effects change, by it.
    """
    steps, kept = fit.estimate.values, fit.unknowns
    turns = [np.abs(steps[kept.columns("edge", name)]) for name in fit.cell.unknown]
    turns += [np.abs(errors).ravel() for errors in fit.errors.values()]
    for name, lens in kept.lenses.items():
        at = kept.columns("lens", name)[:2]
        turns.append(np.abs(steps[at] * kept.units[at]) / float(lens.matrix[0]))
    for effect in kept.effects:
        turns.append(effect.curvature * np.abs(steps[kept.columns("effect", effect.name)]))
    most = float(np.concatenate([np.zeros(1), *turns]).max())
    sigmas = np.sqrt(np.diag(fit.estimate.covariance))
    # A step under this share of every sigma is negligible. The rest after a step, over itself and
    # the most that anything turns by it.
    return bool(np.all(min(3.0 * most, 1.0) * np.abs(steps) < 0.02 * sigmas))


def nearest(start: Start) -> Mask:
    """(n,) the half of each pair of frames that is nearest to a start's prediction."""
    near = np.where(start.sound, start.distances, np.inf)
    used = np.zeros(len(near), bool)
    for rows in map(np.array, start.cell.pairs.values()):
        count = int(start.sound[rows].sum())
        used[rows[near[rows].argsort()][: min(count // 2 + 1, count)]] = True
    return used
