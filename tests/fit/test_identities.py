"""Identities of the one likelihood: gradients, the dense likelihood, sightings left out, truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.marks import seeds, slow
from support.small_cells import TABLE, made
from support.without_poses import without_poses

from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import IntArray
from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.lens_field import fields_of_lengths
from visioncal.fit.linearise import linearised
from visioncal.fit.pairs import pairs_of
from visioncal.fit.solve import solve, state_of, unknowns_of
from visioncal.fit.start import start_of
from visioncal.fit.unknowns import State, lens_field
from visioncal.model import MeasuredPlace, MeasuredPose, Sighting
from visioncal.model.effects import Clock, Effect, Rolling, Size


class Tilt(Effect):
    """An effect on an edge, to be differentiated."""

    @property
    def name(self):
        """See `Effect`."""
        return f"tilt {self.frame}"

    @property
    def size(self):
        """See `Effect`."""
        return Size(self.name, 1e-3, 1e-7, 0.1)

    @property
    def count(self):
        """See `Effect`."""
        return 2

    def columns(self, moments, distances):
        """See `Effect`."""
        del distances
        columns = np.zeros((len(moments), 6, 2))
        columns[:, :2] = np.eye(2) * moments.progress[:, None, None]
        columns[:, 4, 1] = 0.3
        return columns


class Breath(Tilt):
    """An effect on a lens."""

    place = "lens"

    @property
    def name(self):
        """See `Effect`."""
        return f"breath {self.frame}"

    def columns(self, moments, distances):
        """See `Effect`."""
        columns = np.zeros((len(moments), 9, 2))
        columns[:, 0, 0] = columns[:, 1, 0] = 1000.0 * (distances - 1.0)
        columns[:, 2, 1] = moments.progress
        return columns


def measured(cell):
    """The cell with a measured pose and a measured place beside its corners."""
    rng = np.random.default_rng(4)
    added = [
        Sighting(90, 1, "cam", "target", MeasuredPose(exp(rng.normal(0, 0.2, 6)), (2e-3, 1e-3))),
        Sighting(91, 2, "cam", "target", MeasuredPlace(np.array([0.1, 0.0, 0.5]), 1e-3)),
    ]
    return cell.with_sightings([*cell.sightings, *added])


def somewhere(cell, effects=()):
    """Unknowns of a cell, and a state at which everything differs from the start."""
    rng = np.random.default_rng(3)
    start = start_of(cell)
    unknowns, state = unknowns_of(start, effects), state_of(start, effects)
    step = 1e-3 * rng.normal(size=unknowns.count)
    errors = {name: 1e-2 * rng.normal(size=at.shape) for name, at in state.errors.items()}
    moved = unknowns.moved(State(state.values, errors), step, {})
    return start.cell, unknowns, moved


CLOCK, ROLLING = Clock("flange", "cam", 0.01), Rolling("cam", 1024)
EFFECTS = (Tilt("flange"), Tilt("cam"), Breath("cam"), CLOCK, ROLLING)


def with_field(unknowns, state, pairs):
    """A field of the lens, that is zero: where it is not, it moves with the pixels."""
    px = np.concatenate([pair.px for pair in pairs if pair.corners])
    (field,) = fields_of_lengths(TABLE.resolution[0], px, (0.4,))
    field = field.shown(px, 0.5).orthogonal_to(unknowns.lenses["cam"], px)
    assert 4 < field.count < 40
    member = lens_field("cam", field, 0.1)
    unknowns = replace(unknowns.with_members(member), fields={"cam": field})
    values = {**state.values, member.key: np.zeros(field.count)}
    return unknowns, State(values, state.errors)


def pulled(gram, logs):
    """(k, c) products of the residual with errors and unknowns, sighting by sighting."""
    weights = np.append(np.exp(-2.0 * logs), 1.0)
    pulls = sum(weights[part.size] * part.pulls for part in gram.parts)
    local = np.concatenate([gram.heads(logs)[:, :, -1], pulls], axis=1)
    return gram.by_unknowns(local[:, None])[:, 0]


@pytest.mark.parametrize("in_hand", [True, False])
def test_rows_have_the_slopes_that_differences_show(in_hand):
    small = made(stops=7, in_hand=in_hand).cell
    rates = {("cam", "flange"): np.random.default_rng(6).normal(0, 0.5, (7, 6))}
    small = replace(small, moments=replace(small.moments, rates=rates))
    cell, unknowns, state = somewhere(small, EFFECTS)
    # Slopes leave out that distances and motion, on which these depend, depend on the pose.
    still = {("effect", "breath cam"): np.zeros(2), ("effect", ROLLING.name): np.zeros(1)}
    state = replace(state, values=state.values | still)
    cell = measured(cell)
    pairs = pairs_of(cell)
    unknowns, state = with_field(unknowns, state, pairs)
    logs = np.zeros(len(unknowns.sizes))

    def costs(at):
        return [gram.squares(logs) for gram in linearised(cell, unknowns, at, pairs)]

    grams = linearised(cell, unknowns, state, pairs)
    assert unknowns.count > 6 * 2 + 9 + 10
    slopes = [pulled(gram, logs) for gram in grams]
    for column in range(unknowns.count):
        step = np.zeros(unknowns.count)
        # In the columns' units, all of which change the residuals alike.
        step[column] = 1e-6
        ahead, behind = (costs(unknowns.moved(state, sign * step, {})) for sign in (1, -1))
        for gram, slope, a, b in zip(grams, slopes, ahead, behind, strict=True):
            at = np.flatnonzero(gram.columns == column)
            expected = slope[:, 6 * len(gram.flanges) + at].sum(axis=1)
            found = -(a - b) / 4e-6
            # Rounding of costs up to 1e9 in differences of a millionth.
            assert found == pytest.approx(expected, rel=2e-4, abs=1e-6 * a.max() + 1e-2)
    for axis in range(6):
        step = np.zeros((len(cell.moments), 6))
        step[:, axis] = 1e-7
        ahead, behind = (
            costs(replace(state, errors={"flange": state.errors["flange"] + sign * step}))
            for sign in (1, -1)
        )
        for slope, a, b in zip(slopes, ahead, behind, strict=True):
            found = -(a - b) / 4e-7
            assert found == pytest.approx(slope[:, axis], rel=2e-4, abs=1e-5 * a.max() + 1e-2)


def linear(cell):
    """A linearised cell, with a field: a fit at the sizes where a search begins."""
    cell, unknowns, state = somewhere(cell)
    unknowns, state = with_field(unknowns, state, pairs_of(cell))
    grams, used = (
        linearised(cell, unknowns, state, pairs_of(cell)),
        np.ones(len(cell.sightings), bool),
    )
    mixed = mixed_model(cell, unknowns, state, grams, used)
    return Fit(cell, unknowns, state, grams, used, mixed, mixed.at(unknowns.starts()))


def model(cell):
    found = linear(cell)
    return found.mixed, found.unknowns


def test_the_likelihood_has_the_gradient_that_differences_show():
    mixed, unknowns = model(made(stops=8, cameras=2).cell)
    logs = unknowns.starts()
    found = mixed.at(logs)
    for size in range(len(logs)):
        step = np.zeros(len(logs))
        step[size] = 1e-4
        ahead, behind = (mixed.at(logs + sign * step).value for sign in (1, -1))
        # A second-order difference of values around 1e4 to 1e7.
        assert (ahead - behind) / 2e-4 == pytest.approx(found.gradient[size], rel=1e-3, abs=0.05)


def test_the_curvature_is_the_mean_of_observed_and_expected_information():
    mixed, unknowns = model(made(stops=7).cell)
    logs, dense = unknowns.starts(), Dense(mixed)
    found = mixed.at(logs)
    step, observed = 1e-4, np.zeros((len(logs), len(logs)))
    for size in range(len(logs)):
        move = step * (np.arange(len(logs)) == size)
        ahead, behind = (mixed.at(logs + sign * move).gradient for sign in (1, -1))
        observed[size] = (ahead - behind) / (2 * step)
    expected = dense.expected_information(logs)
    expected += mixed.at(logs).curvature - replace(mixed, prior=None).at(logs).curvature
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((observed + expected) / 2 - found.curvature).max() < 1e-3 * scale.max()


class Dense:
    """The same rows without elimination: one matrix of information for all errors and unknowns."""

    def __init__(self, mixed):
        self.mixed, p = mixed, mixed.count
        starts = np.cumsum([p, *(body.stops.size * body.width for body in mixed.bodies)])
        self.count = int(starts[-1])
        self.grams = []
        for term in mixed.terms:
            gram = np.zeros((self.count + 1, self.count + 1))
            common = np.append(term.columns, self.count)
            gram[np.ix_(common, common)] += term.common
            for part in term.parts:
                width = mixed.bodies[part.body].width
                for unit in range(len(mixed.bodies[part.body].stops)):
                    places: IntArray = starts[part.body] + width * unit + np.arange(width)
                    at = np.append(part.columns, self.count)
                    gram[np.ix_(places, places)] += part.errors[unit]
                    gram[np.ix_(places, at)] += part.cross[unit]
                    gram[np.ix_(at, places)] += part.cross[unit].T
            self.grams.append(gram)

    def information(self, logs):
        """See `Mixed`."""
        weights = np.append(np.exp(-2 * logs), 1.0)
        pairs = zip(self.mixed.terms, self.grams, strict=True)
        return sum(weights[term.size] * gram for term, gram in pairs)

    def value(self, logs):
        """See `Mixed`."""
        full = self.information(logs)
        inner, right = full[:-1, :-1], full[:-1, -1]
        solved = np.linalg.solve(inner, right)
        counts = sum(2 * t.count * logs[t.size] for t in self.mixed.terms if t.size >= 0)
        value = counts + full[-1, -1] - right @ solved + np.linalg.slogdet(inner)[1]
        return value + 2.0 * self.mixed.prior.at(logs).value

    def expected_information(self, logs):
        """2 tr(P V_t P V_s) of the log sizes: 4 (n - 2 c) on the diagonal, and 4 T."""
        inverse = np.linalg.inv(self.information(logs)[:-1, :-1])
        found = np.zeros((len(logs), len(logs)))
        hats = {}
        for term, gram in zip(self.mixed.terms, self.grams, strict=True):
            if term.size >= 0:
                hats[term.size] = np.exp(-2 * logs[term.size]) * inverse @ gram[:-1, :-1]
                found[term.size, term.size] += 4 * (term.count - 2 * np.trace(hats[term.size]))
        for a, first in hats.items():
            for b, second in hats.items():
                found[a, b] += 4 * np.sum(first * second.T)
        return found


def test_the_likelihood_is_that_of_all_unknowns_at_once():
    mixed, unknowns = model(made(stops=8, cameras=2).cell)
    dense, logs = Dense(mixed), unknowns.starts()
    differ = logs - 0.7 * np.arange(len(logs)) % 1.0
    # Differences are compared: both leave out the same constant.
    found = mixed.at(logs, is_sloped=False).value - mixed.at(differ, is_sloped=False).value
    assert found == pytest.approx(dense.value(logs) - dense.value(differ), rel=1e-6)
    inner = dense.information(logs)[:-1, :-1]
    covariance = np.linalg.inv(inner)[: mixed.count, : mixed.count]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.abs((mixed.at(logs).covariance - covariance) / scale).max() < 1e-5


def test_a_sighting_left_out_is_predicted_as_by_a_refit():
    small = made(stops=8, cameras=2, seed=5).cell
    solved = solve(small)
    assert_left_out_as_by_refits(solved.fit, solved.left_out)
    fit = linear(small)
    assert_left_out_as_by_refits(fit, fit.left_out())


def assert_left_out_as_by_refits(fit, left_out):
    """Of some sightings."""
    for row in (0, 5, 11):
        rows = np.arange(len(fit.used)) == row
        refit = without_poses(fit, rows).left_out()
        sigma = np.sqrt(np.diagonal(left_out.measured[row]))
        assert left_out.away[row] == pytest.approx(refit.away[row], abs=1e-3 * sigma.min())
        assert left_out.squares[row] == pytest.approx(refit.squares[row], rel=1e-3)


@pytest.mark.parametrize(("given", "in_hand"), [(True, True), slow(False, True), slow(True, False)])
@pytest.mark.parametrize("draws", seeds(2, 60))
def test_errors_are_as_large_as_the_covariance_says(given, in_hand, draws):
    squares = []
    for seed in draws:
        small = made(seed, stops=12, given=given, in_hand=in_hand)
        # Errors that last, which these arms do not have, would add to it.
        fit = replace(solve(small.cell).fit, considered=None, shift=None)
        assert fit.used.all() or fit.used.sum() >= 11
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away))
    # Means of six degrees, but that noise levels of 12 stops are known to a sixth only: a t
    # distribution of 60 degrees of freedom or more, a share of 1.04.
    low, high = chi2.ppf([0.001, 0.999], 6 * len(draws)) / len(draws)
    assert low < np.mean(squares) / 1.04 < high


@pytest.mark.slow
@pytest.mark.parametrize("in_hand", [True, False])
def test_errors_of_200_cells_scatter_as_the_covariance_says_in_every_direction(in_hand):
    whitened = []
    for seed in range(1000, 1200):
        small = made(seed, stops=12, in_hand=in_hand)
        # Errors that last, which these arms do not have, would add to it.
        fit = replace(solve(small.cell).fit, considered=None, shift=None)
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        root = np.linalg.cholesky(fit.covariance(("edge", "cam")))
        whitened.append(np.linalg.solve(root, away))
    scatter, mean = np.cov(np.array(whitened).T), np.mean(whitened, axis=0)
    # As of 200 draws of six normal numbers, each as uncertain as noise of 12 stops: 1.04.
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 199) / 199
    assert (np.diag(scatter) > low).all()
    assert (np.diag(scatter) / 1.04 < high).all()
    assert np.sum(mean**2) * 200 / 1.04 < chi2.ppf(0.9999, 6)
    between = scatter / np.sqrt(np.outer(np.diag(scatter), np.diag(scatter)))
    # 15 correlations of 200 draws, of which four sigma are one in ten thousand.
    assert np.abs(between - np.eye(6)).max() < 4.0 / np.sqrt(200)


@pytest.mark.parametrize("draws", seeds(2, 40))
def test_predictions_err_as_much_as_stated(draws):
    squares = []
    for seed in draws:
        small = made(seed, stops=12)
        fit = solve(small.cell).fit
        moments = small.cell.moments.take(np.arange(3))
        found = fit.predict("base", "cam", moments)
        true = moments.poses["flange"] @ small.edges["cam"]
        away = log(invert(true) @ found.poses)
        each = np.linalg.solve(found.calibration, away[:, :, None])[:, :, 0]
        squares.append(np.sum(away * each, axis=1).mean())
        assert (np.trace(found.noise, axis1=1, axis2=2) > 0.0).all()
    # Three sigma of so many cells.
    assert np.mean(squares) / 6 == pytest.approx(1.0, abs=2.2 / np.sqrt(len(draws)))
