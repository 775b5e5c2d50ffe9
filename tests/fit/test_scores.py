"""What more columns would explain, beside what they do explain once they are there."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_cells import TABLE, made

from visioncal.fit.assemble import mixed_model
from visioncal.fit.candidates import effects_of_lenses
from visioncal.fit.lens_field import fields_of_lengths, waves
from visioncal.fit.linearise import linearised
from visioncal.fit.pairs import pairs_of
from visioncal.fit.score import of_effect, of_waves
from visioncal.fit.solve import solve
from visioncal.fit.unknowns import State, lens_field, random_effect
from visioncal.model.effects import SIGNIFICANT, FocusJitter


def gain_with(fit, member, size, **changes):
    """-2 log L of a fit with more unknowns of one size, less that with a size of next to none."""
    unknowns = replace(fit.unknowns.with_members(member), **changes)
    values = {**fit.linearised.values, member.key: np.zeros(member.count)}
    state = State(values, fit.linearised.errors)
    grams = linearised(fit.cell, unknowns, state, pairs_of(fit.cell))
    mixed = mixed_model(fit.cell, unknowns, state, grams, fit.used)
    logs = unknowns.starts()
    for name, value in fit.sizes.items():
        logs[unknowns.size_of(name)] = np.log(value)
    found = []
    for one in (size, 1e-6 * size):
        logs[unknowns.size_of(member.priors[0].size.name)] = np.log(one)
        found.append(mixed.at(logs, is_sloped=False).value)
    return found[1] - found[0]


def expected(score, sigmas):
    within = np.eye(len(sigmas)) + np.outer(sigmas, sigmas) * score.information
    pull = sigmas * score.pull
    return pull @ np.linalg.solve(within, pull) - np.linalg.slogdet(within)[1]


@pytest.fixture(scope="module")
def fit():
    return solve(made(stops=10, cameras=2).cell).fit


def test_a_score_is_the_likelihood_that_an_effect_gains(fit):
    effects = list(effects_of_lenses(fit))
    assert {effect.name for effect in effects} >= {"breathing cam", "focus jitter cam_1"}
    for effect in effects:
        score = of_effect(fit, effect)
        changes = {"effects": (*fit.unknowns.effects, effect)}
        for size in (1e-4, 2e-3):
            found = gain_with(fit, random_effect(effect), size, **changes)
            sizes = np.full(effect.count, size)
            # Values of 1e4, in whose difference 1e-10 of each is rounding.
            assert found == pytest.approx(expected(score, sizes), rel=1e-3, abs=2e-3)


def test_a_score_is_the_likelihood_that_a_field_gains(fit):
    pairs = pairs_of(fit.cell)
    px = np.concatenate([pair.px for pair in pairs if pair.names[0] == "cam"])
    (field,) = fields_of_lengths(TABLE.resolution[0], px, (0.4,))
    score = of_waves(fit, pairs, "cam")
    for size in (0.02, 0.2):
        found = gain_with(fit, lens_field("cam", field, size), size, fields={"cam": field})
        wanted = expected(score, size * np.tile(field.sigmas, 2))
        assert found == pytest.approx(wanted, rel=1e-3, abs=2e-3)


def test_functions_that_corners_do_not_show_are_in_no_likelihood(fit):
    pairs = pairs_of(fit.cell)
    px = np.concatenate([pair.px for pair in pairs if pair.names[0] == "cam"])
    (field,) = fields_of_lengths(TABLE.resolution[0], px, (0.27,))
    size, sigma = 0.1, fit.sizes["px cam"]
    # Of each function that is left out, all corners together have an information below this.
    shown = field.shown(px, 1e-3 * (sigma / size) ** 2)
    assert shown.count < field.count / 3
    whole, part = (
        gain_with(fit, lens_field("cam", at, size), size, fields={"cam": at})
        for at in (field, shown)
    )
    # A function changes a likelihood by about its information.
    assert part == pytest.approx(whole, abs=1e-3 * (field.count - shown.count))
    # At corners nothing is left out; beyond the image, all that a field may be.
    assert shown.variance(px).max() < 0.02
    assert shown.variance(np.array([[-300.0, -300.0]])) > 0.5


def test_a_score_finds_the_size_that_the_likelihood_has(fit):
    grows = next(e for e in effects_of_lenses(fit) if e.name == "lens grows cam")
    score = of_effect(fit, grows)
    size, _ = score.best(np.ones(grows.count), 1e-7, 0.1)
    around = [expected(score, np.full(grows.count, size * factor)) for factor in (0.4, 1.0, 2.5)]
    assert around[1] >= max(around[0], around[2]) - 0.2  # sizes are tried in steps of e^0.5


def test_waves_have_the_covariance_of_a_smooth_field():
    rng = np.random.default_rng(0)
    px = rng.uniform([0, 0], TABLE.resolution, (300, 2))
    (field,) = fields_of_lengths(TABLE.resolution[0], px, (0.18,))
    each = waves(px, field.width, field.orders) * field.sigmas
    found = each @ each.T
    squared = np.sum((px[:, None] - px) ** 2, axis=2) / (0.18 * TABLE.resolution[0]) ** 2
    kernel = np.exp(-0.5 * squared)
    # Waves end a fifth of the width beyond the image, where they have no slope: as if the field had
    # a mirror image there, 0.4 widths from its margin, with a covariance of exp(-0.4^2 / 2 0.18^2).
    assert np.abs(found - kernel).max() < 0.12
    middle = np.abs(px / TABLE.resolution - 0.5).max(axis=1) < 0.3
    assert np.abs(found - kernel)[np.ix_(middle, middle)].max() < 0.03


def test_a_lens_that_breathes_is_likely_to_scatter():
    fit = solve(made(stops=10).cell).fit
    (sole,) = [one for one in effects_of_lenses(fit) if one.kind == "focus jitter"]
    breathing = next(one for one in effects_of_lenses(fit) if one.kind == "breathing")
    unknowns = fit.unknowns.with_members(random_effect(breathing))
    unknowns = replace(unknowns, effects=(*unknowns.effects, breathing))
    logs = np.append(fit.estimate.logs, np.log(1e-3))
    wider = replace(fit, unknowns=unknowns, estimate=replace(fit.estimate, logs=logs))
    joint = [one for one in effects_of_lenses(wider) if one.kind == "focus jitter"]
    assert [one.size.limit < sole.size.limit for one in joint] == [True]
    # A size that is held at its bound is none.
    closed = replace(wider, unknowns=unknowns.closing({breathing.name}))
    assert not any(one.size.limit < SIGNIFICANT for one in effects_of_lenses(closed))


def test_a_stated_lens_that_breathes_was_focused_somewhere():
    cell = made(stops=10).cell
    fit = solve(cell).fit
    effect = next(one for one in effects_of_lenses(fit) if one.kind == "breathing")
    columns = effect.columns(cell.moments, np.full(10, 2.0 * effect.reference_m))
    # At twice the distance, it has grown by twice what it may be off by where it was stated.
    assert np.allclose(columns[:, :2, 0], 2.0 * columns[:, :2, 1])
    assert np.allclose(columns[:, :2, 0], TABLE.matrix[:2])
    free = solve(made(stops=20, given=False).cell).fit
    counts = {one.kind: one.count for one in effects_of_lenses(free)}
    assert counts["breathing"] == 1


def test_many_sightings_are_processed_in_parts(fit):
    """Results are those of all at once; no array has rows of more corners than those of some."""
    few, all_at_once = pairs_of(fit.cell, 3), pairs_of(fit.cell, 10**6)
    assert len(few) == 8
    assert len(all_at_once) == 2
    grams = [
        linearised(fit.cell, fit.unknowns, fit.linearised, pairs) for pairs in (few, all_at_once)
    ]
    values = [
        mixed_model(fit.cell, fit.unknowns, fit.linearised, some, fit.used).at(fit.estimate.logs)
        for some in grams
    ]
    assert values[0].value == pytest.approx(values[1].value, rel=1e-9)
    assert values[0].values == pytest.approx(values[1].values, rel=1e-5, abs=1e-9)


def test_jitter_of_many_images_is_judged_by_some(fit):
    stops = np.arange(1000)
    jitter = FocusJitter("cam", fit.unknowns.lenses["cam"], stops)
    assert jitter.typical.count == 150
    few = replace(jitter, stops=np.arange(10))
    columns = few.columns(fit.cell.moments, np.ones(10))
    assert np.array_equal(columns[:, 0], fit.unknowns.lenses["cam"].matrix[0] * np.eye(10))
    one = replace(jitter, stops=np.array([4]))
    assert np.flatnonzero(one.columns(fit.cell.moments, np.ones(10))[:, 0, 0]).tolist() == [4]
