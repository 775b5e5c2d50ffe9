"""Arms that warm up: growth and drift are found, and in arms that do not follow they are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.marks import seeds

from visioncal.core.transforms import invert, log
from visioncal.fit.solve import solve
from visioncal.model import Moments, read_cell
from visioncal.model.effects import Heat
from visioncal.robot import load_robot
from visioncal.robot.thermal import Inputs
from visioncal.simulation import CellOptions, Round, WarmUpOptions, cell_session, simulate_warm_up
from visioncal.simulation import heat as simulated
from visioncal.simulation.optics import CAMERAS

OPTIONS = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1, branches=True, roll_rad=np.pi)
ROBOT = load_robot("ur5e")


def warmed(seed, *, temperatures=True, **heat):
    """An arm that warms up for 100 minutes, and its cell as it is recorded."""
    how = WarmUpOptions(replace(OPTIONS, seed=seed), temperatures=temperatures)
    how = replace(how, heat=replace(how.heats, **heat))
    made = simulate_warm_up(how)
    session = cell_session(made, "warm", seen="corners")
    return how, made, read_cell(session, session.corners)


def inputs(kind):
    stamps_s, rng = np.arange(0.0, 7200.0, 40.0), np.random.default_rng(0)
    values = 4.0 + 20.0 * (1.0 - np.exp(-stamps_s / 2000.0))[:, None] + rng.uniform(0, 2, (180, 6))
    return Inputs(kind, stamps_s, values, 21.0 + np.sin(stamps_s / 3000.0))


def moments_at(stamps_s):
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (7, 6))
    poses = {"flange": ROBOT.base_from_flange(q)}
    stops = np.full(7, -1)
    return Moments(poses, {"flange": q}, np.zeros(7), stops, stamps_s=stamps_s)


@pytest.mark.parametrize("kind", ["temperatures", "currents"])
def test_slopes_are_those_of_differences(kind):
    heat = Heat("flange", ROBOT, inputs(kind))
    moments = moments_at(np.linspace(100.0, 7000.0, 7))
    values = np.random.default_rng(1).normal(size=heat.count)
    slopes = heat.slopes(moments, values)
    for column, step in enumerate(np.eye(heat.count) * 1e-4):
        found = heat.twists(moments, values + step) - heat.twists(moments, values - step)
        # Twists of a milliradian at rounding, over the step.
        assert slopes[:, :, column] == pytest.approx(found / 2e-4, abs=1e-9)


def test_moments_without_a_time_are_as_warm_as_the_last_sample():
    heat, values = Heat("flange", ROBOT, inputs("temperatures")), np.zeros(18)
    last = heat.twists(moments_at(np.full(7, heat.inputs.stamps_s[-1])), values)
    assert np.abs(last).max() > 1e-5
    for unknown in (None, np.full(7, np.nan)):
        assert heat.twists(moments_at(unknown), values) == pytest.approx(last)
    cold = heat.twists(moments_at(np.full(7, heat.inputs.stamps_s[0])), values)
    assert np.abs(cold).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("temperatures", [True, False])
@pytest.mark.parametrize("draws", seeds(1, 8))
def test_growth_and_drift_are_found_within_their_covariance(temperatures, draws):
    squares = []
    for seed in draws:
        # By currents there is one time constant a joint: links follow their joints at once.
        lag_s = 240.0 if temperatures else 1.0
        how, made, cell = warmed(seed, temperatures=temperatures, lag_s=lag_s)
        fit = solve(cell).fit
        assert fit.used.mean() > 0.95
        (heat,) = (effect for effect in fit.unknowns.effects if effect.kind == "heat")
        values, covariance = (
            fit.state.values["effect", heat.name],
            fit.covariance(("effect", heat.name)),
        )
        arm, units = heat.arm(values), np.repeat([5.5e-6, 1e-5], 6)
        sigmas = np.sqrt(np.diag(covariance))[:12] * units
        found = np.concatenate([arm.growth_per_k, arm.drift_rad_per_k])
        true = np.concatenate([how.heats.growth_per_k, how.heats.drift_rad_per_k])
        keys = [("edge", "cam"), ("edge", "target")]
        truth = [made.transforms["flange_from_cam"], made.transforms["base_from_target"]]
        pairs = zip(truth, keys, strict=True)
        away = np.concatenate([log(invert(at) @ fit.edge(key[1])) for at, key in pairs])
        squares.append([
            away @ np.linalg.solve(fit.covariance(*keys), away),
            np.sum(((found - true) / sigmas) ** 2),
        ])  # fmt: skip
    # Of twelve degrees of freedom a seed, one in a thousand beyond; what the views do not show of
    # drift stays within what arms do, and that is drawn narrower here.
    edges, values = np.sum(squares, axis=0)
    assert max(edges, values) < chi2.ppf(0.999, 12 * len(draws))


@pytest.mark.parametrize("draws", seeds(1, 8))
def test_arms_that_do_not_follow_their_temperature_have_no_drift(draws):
    for seed in draws:
        _, _, cell = warmed(seed, growth_per_k=np.zeros(6), drift_rad_per_k=np.zeros(6))
        assert Heat("flange", cell.arms["flange"].model, cell.arms["flange"].heat).is_shown(
            cell.moments
        )
        assert {effect.kind for effect in solve(cell).fit.unknowns.effects} == {"links", "zeros"}


def test_an_arm_that_does_not_warm_up_and_times_that_are_not_covered_show_nothing():
    still = replace(simulated.Heat.drawn(0), k_per_a2=np.zeros(6), ambient_swing_k=0.0)
    how = WarmUpOptions(OPTIONS, still, Round(minutes=30.0), hours=0.6)
    session = cell_session(simulate_warm_up(how), "cold", seen="poses")
    cell = read_cell(session, {})
    arm = cell.arms["flange"]
    assert not Heat("flange", arm.model, arm.heat).is_shown(cell.moments)
    warm = Heat("flange", ROBOT, inputs("temperatures"))
    assert warm.is_shown(moments_at(np.linspace(0.0, 7000.0, 7)))
    for beyond in (None, np.full(7, np.nan), np.linspace(0.0, 8000.0, 7)):
        assert not warm.is_shown(moments_at(beyond))
    without = replace(session, streams={})
    assert read_cell(without, {}).arms["flange"].heat is None
