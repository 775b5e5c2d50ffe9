"""What an arm stands on, and what it carries: moved by posture, gravity and time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.marks import seeds
from support.small_cells import made, pose
from support.wrong_arms import GOOD

from visioncal.core.transforms import exp, invert, log
from visioncal.fit.candidates import effects_of_frames, scored
from visioncal.fit.processes import _boards, _errors_by_stop, _grid_of, judged
from visioncal.fit.score import added_by, of_effect, products
from visioncal.fit.solve import solve
from visioncal.model import read_cell
from visioncal.model.effects import (
    BaseCreeps,
    BaseSteps,
    BaseTilts,
    BracketBends,
    MountCreeps,
    MountSteps,
)
from visioncal.model.effects.posture import twists_of_frames
from visioncal.simulation import cell_session, simulate

MOUNTS = ("eye-in-hand", "eye-to-hand")
KINDS = {
    "tilts": BaseTilts,
    "bends": BracketBends,
    "creeps": BaseCreeps,
    "slips": MountCreeps,
    "steps": BaseSteps,
    "knocks": MountSteps,
}


def moving(kind, seed, size, stops=24):
    """A cell whose flange stands elsewhere than reported, by an effect of a size; and the effect.

    Its report is of the end of the session, or of the mean posture.
    """
    small = made(seed, stops, in_hand=seed % 2 == 0)
    arm, moments = small.cell.arms["flange"], small.cell.moments
    effect = (
        KINDS[kind]("flange", arm.poses) if kind in ("tilts", "bends") else KINDS[kind]("flange")
    )
    values = size * np.random.default_rng([seed, 11]).normal(size=effect.count)
    twists = effect.columns(moments, np.ones(stops)) @ values
    moved = arm.poses @ invert(np.array([exp(twist) for twist in twists]))
    arms = {"flange": replace(arm, poses=moved)}
    cell = replace(small.cell, arms=arms, moments=replace(moments, poses={"flange": moved}))
    return replace(small, cell=cell)


@pytest.mark.parametrize(("kind", "twists"), [("tilts", 6), ("bends", 12)])
def test_effects_of_posture_move_no_frame_at_the_mean_of_the_stops(kind, twists):
    """The base, and the flange where that bends: a base that tilts leaves it where it is."""
    cell = made(3, 20).cell
    poses = cell.arms["flange"].poses
    effect = KINDS[kind]("flange", poses)
    columns = effect.columns(cell.moments, np.ones(20))
    weights = np.repeat([0.5, 1.0], 3)[:, None]
    every = (weights * twists_of_frames(poses)).reshape(-1, 12)[:, :twists]
    left = every.T @ (weights * columns).reshape(-1, effect.count)
    assert np.abs(left).max() < 1e-9
    assert np.linalg.norm(columns) > 0.1


def test_effects_of_time_are_zero_at_the_end():
    cell = made(3, 20).cell
    for effect in (BaseCreeps("flange"), MountSteps("flange")):
        columns = effect.columns(cell.moments, np.ones(20))
        assert not columns[-1].any()
        assert np.abs(columns[0]).max() > 0.9


def test_scores_beside_no_process_are_those_of_independent_noise():
    fit = solve(made(1, 16).cell).fit
    for effect in effects_of_frames(fit, "flange"):
        each = products(fit, added_by(fit, effect), effect.count)
        by_stop = _errors_by_stop(fit, "flange", [each])
        grid, at_stops = _grid_of(fit, "flange", by_stop, creeps=True)
        white = at_stops(next(grid))
        # With boards held as the fit has them.
        _, pull, _ = judged(white, [], 0.0)
        left = white.total[len(pull) :, len(pull) :] - pull.T @ pull
        score = of_effect(fit, effect)
        scale = np.sqrt(np.diag(score.information)) + 1e-9 * np.abs(score.information).max() ** 0.5
        assert np.abs((left[:-1, :-1] - score.information) / np.outer(scale, scale)).max() < 1e-4
        assert np.abs((left[:-1, -1] - score.pull) / scale).max() < 1e-3
    assert len(_boards(fit)) == 1


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        *(("tilts", 3e-3), ("bends", 3e-4), ("creeps", 1.5e-3), ("slips", 1.5e-3)),
        *(("steps", 1.5e-3), ("knocks", 1.5e-3)),
    ],
)
@pytest.mark.parametrize("draws", seeds(1, 4))
def test_a_frame_that_moves_is_opened_and_its_result_is_fair(kind, size, draws):
    squares, found = [], 0
    for seed in draws:
        small = moving(kind, seed, size)
        fit = solve(small.cell).fit
        names = {effect.name for effect in fit.unknowns.effects} - fit.unknowns.closed
        found += KINDS[kind].kind + " flange" in names
        # A growing lens looks like a frame that creeps to one camera.
        assert "lens grows cam" not in names
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away) / 6)
    assert found > 0.6 * len(draws)
    assert np.mean(squares) < 2.5


@pytest.mark.parametrize("draws", seeds(1, 4))
def test_sound_arms_and_arms_of_other_errors_open_no_effect(draws):
    rng = np.random.default_rng(5)
    for seed in draws:
        small = made(seed, 20)
        fit = solve(small.cell).fit
        assert not [one for one in scored(fit, effects_of_frames(fit, "flange"), "flange")
                    if 2.0 * one.gain > 13.8]  # fmt: skip
        arm = small.cell.arms["flange"]
        steps = 3.0 * rng.normal(size=(20, 2, 3)) * np.array([2e-4, 1e-4])[:, None]
        moved = np.array([at @ pose(*step) for at, step in zip(arm.poses, steps, strict=True)])
        arms = {"flange": replace(arm, poses=moved)}
        cell = replace(small.cell, arms=arms)
        other = solve(replace(cell, moments=replace(cell.moments, poses={"flange": moved}))).fit
        assert not any(effect.frame == "flange" for effect in other.unknowns.effects)


def slow(seed, kinds=(), walks=False):
    """A cell of an arm with joints, that is moved by effects, or that walks from stop to stop."""
    made, rng = (
        simulate(replace(GOOD, seed=seed, mount=MOUNTS[seed % 2])),
        np.random.default_rng([seed, 13]),
    )
    session = cell_session(made, "arm", seen="corners")
    cell = read_cell(session, session.corners)
    arm, moments = cell.arms["flange"], cell.moments
    poses, count = arm.poses, len(moments)
    for kind in kinds:
        effect = KINDS[kind]("flange", float(rng.choice([0.0, 3.0])))
        twists = effect.columns(moments, np.ones(count)) @ (1e-3 * rng.normal(size=6))
        poses = poses @ invert(np.array([exp(twist) for twist in twists]))
    if walks:
        steps = rng.normal(size=(count, 6)) * np.repeat([3e-4, 2e-4], 3)
        away = np.cumsum(steps, axis=0)
        poses = poses @ np.array([exp(twist) for twist in away - away.mean(axis=0)])
    arms = {"flange": replace(arm, poses=poses)}
    moved = replace(cell, arms=arms, moments=replace(moments, poses={"flange": poses}))
    return moved, {name.split("_from_")[1]: at for name, at in made.transforms.items()}


@pytest.mark.parametrize(
    ("kinds", "walks"),
    [
        pytest.param(("creeps",), False, marks=pytest.mark.slow),
        pytest.param(("creeps", "slips"), False, marks=pytest.mark.slow),
        ((), True),
    ],
)
@pytest.mark.parametrize("draws", seeds(1, 6))
def test_slow_motion_is_separated_from_errors_that_last_where_joints_are_known(kinds, walks, draws):
    squares, named = [], 0
    for seed in draws:
        cell, truth = slow(50 + seed, kinds, walks)
        fit = solve(cell).fit
        names = {effect.name for effect in fit.unknowns.effects} - fit.unknowns.closed
        named += names == {f"{KINDS[kind].kind} flange" for kind in kinds}
        # What creeps is stated of the end of the session, what walks of its mean.
        away = log(invert(truth["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away) / 6)
    assert named >= 0.8 * len(draws)
    # A walk is what it does beyond its mean: the covariance is that of sessions to come.
    low, high = chi2.ppf([0.001, 0.999], 6 * len(draws)) / (6 * len(draws))
    assert np.mean(squares) < high
    assert walks or np.mean(squares) > low
