"""Views while a robot moves: clocks that differ, and images whose rows are not taken at once."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from support.core_worker import on_one_clock
from support.marks import seeds, slow
from support.small_cells import BOARD, PX, TABLE, made

from visioncal.core.transforms import exp, invert, log
from visioncal.fit.solve import solve
from visioncal.model import Swept, read_cell
from visioncal.simulation import CellOptions, SweepOptions, cell_session, sweep
from visioncal.vision.targets import corner_positions

SIGMA_S = 5e-3
FX, FY, CX, CY = TABLE.matrix
MATRIX, LENS = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]]), np.array(TABLE.distortion)


def moving(seed, ahead_s=0.0, readout_s=0.0, *, in_hand=True):
    """A cell whose camera looked while the arm moved, at poses of `ahead_s` later than was so.

    Each corner is where the board was when its own row was exposed.
    """
    small, rng = made(seed, stops=16, in_hand=in_hand), np.random.default_rng([seed, 13])
    rates = rng.normal(size=(16, 6)) * np.repeat([0.4, 0.15], 3)
    x, z = small.edges["cam"], small.edges["target"]
    sightings = []
    for sighting, robot, rate in zip(small.cell.sightings, small.robot, rates, strict=True):
        found = np.zeros((len(sighting.corners.px), 2))
        for corner, point in enumerate(corner_positions(BOARD)):
            row = 511.5
            for _ in range(5):
                flange = robot @ exp(readout_s * (row / 1023 - 0.5) * rate)
                seen = invert(flange @ x) @ z if in_hand else invert(x) @ flange @ z
                at = seen[:3, :3] @ point + seen[:3, 3]
                found[corner] = cv2.projectPoints(at[None], np.zeros(3), np.zeros(3), MATRIX, LENS)[
                    0
                ].ravel()
                row = found[corner, 1]
        noisy = found + PX * rng.normal(size=found.shape)
        sightings.append(replace(sighting, evidence=replace(sighting.corners, px=noisy)))
    arm = small.cell.arms["flange"]
    arm = replace(arm, poses=arm.poses @ exp(ahead_s * rates))
    moments = replace(
        small.cell.moments, poses={"flange": arm.poses}, rates={("cam", "flange"): rates}
    )
    cell = replace(
        small.cell, sightings=tuple(sightings), arms={"flange": arm}, moments=moments,
        sweeps=(Swept("cam", "flange", {}, SIGMA_S),),
    )  # fmt: skip
    return replace(small, cell=cell)


def squares_of(small, fit, values):
    """Squared errors of the camera's edge, and of effects, over their covariance."""
    away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
    found = [away @ np.linalg.solve(fit.covariance(("edge", "cam")), away)]
    for name, true in values.items():
        off = fit.state.values["effect", name][0] - true
        found.append(off**2 / fit.covariance(("effect", name))[0, 0])
    return found


@pytest.mark.parametrize("in_hand", [True, slow(False)])
@pytest.mark.parametrize("draws", seeds(1, 8))
def test_a_clock_and_a_readout_are_found_within_their_covariance(in_hand, draws):
    squares = []
    for seed in draws:
        small = moving(seed, ahead_s=4e-3, readout_s=0.012, in_hand=in_hand)
        fit = solve(small.cell).fit
        assert fit.used.sum() >= 15
        values = {"clock cam flange": 4e-3, "rolling cam": 0.012}
        squares.append(squares_of(small, fit, values))
        # They are known far better than before: a hundredth of a second, and as long as images are.
        assert fit.covariance(("effect", "clock cam flange"))[0, 0] < (0.1 * SIGMA_S) ** 2
        assert fit.covariance(("effect", "rolling cam"))[0, 0] < 1e-3**2
    edges, clocks, readouts = np.mean(squares, axis=0)
    # Means of six degrees of freedom a seed, and of one, one in a thousand beyond.
    count = len(draws)
    assert chi2.ppf(0.001, 6 * count) / count < edges < chi2.ppf(0.999, 6 * count) / count
    low, high = chi2.ppf([0.001, 0.999], count) / count
    assert low < clocks < high
    assert low < readouts < high


@pytest.mark.parametrize("draws", seeds(1, 8))
def test_a_shutter_that_opens_at_once_is_no_rolling_one(draws):
    for seed in draws:
        fit = solve(moving(seed).cell).fit
        assert "rolling cam" in fit.unknowns.closed
        assert [effect.kind for effect in fit.unknowns.effects] == ["clock", "rolling"]
        assert abs(fit.state.values["effect", "rolling cam"][0]) < 1e-5
        off = fit.state.values["effect", "clock cam flange"][0]
        assert abs(off) < 4.0 * np.sqrt(fit.covariance(("effect", "clock cam flange"))[0, 0])


def test_an_unknown_clock_moves_no_prediction_at_rest():
    small = moving(0)
    fit = solve(small.cell).fit
    still = replace(small.cell.moments, rates={})
    at = fit.unknowns.columns("effect", "clock cam flange")
    jacobians = [
        fit.predict("base", "cam", moments).jacobian[:, :, at]
        for moments in (small.cell.moments, still)
    ]
    assert np.abs(jacobians[0]).max() > 0.1
    assert not jacobians[1].any()


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_sweep_by_a_rolling_shutter_is_calibrated(mount):
    how = SweepOptions(stops=8, camera_minus_robot_s=0.037, readout_s=0.0124)
    cell = sweep(CellOptions(seed=1, mount=mount, pixel_sigma_px=0.1), how)
    raw = cell_session(cell, "swept", seen="corners")
    session, sweeps = on_one_clock(raw)
    fit = solve(read_cell(session, raw.corners, sweeps)).fit
    assert fit.used.sum() > 0.95 * len(fit.used)
    readout, sigma = (
        fit.state.values["effect", "rolling cam"][0],
        np.sqrt(fit.covariance(("effect", "rolling cam"))[0, 0]),
    )
    assert abs(readout - 0.0124) < 4.0 * sigma < 2e-3
    parent = "flange" if mount == "eye-in-hand" else "base"
    away = log(invert(cell.transforms[f"{parent}_from_cam"]) @ fit.edge("cam"))
    # Six degrees of freedom: one in ten thousand is beyond.
    assert away @ np.linalg.solve(fit.covariance(("edge", "cam")), away) < 27.9


def stopping(seed, share, *, onwards=False):
    """A cell whose arm stands beyond what it reports by a share of its last motion, or its next."""
    small = made(seed, stops=16)
    reported = small.cell.arms["flange"].poses.copy()
    for stop in range(14, -1, -1) if onwards else range(1, 16):
        first = stop if onwards else stop - 1
        motion = log(invert(reported[first]) @ reported[first + 1])
        # Its own share of the share is a ten-thousandth.
        reported[stop] = reported[stop] @ exp(-share * motion)
    arms = {"flange": replace(small.cell.arms["flange"], poses=reported)}
    moments = replace(small.cell.moments, poses={"flange": reported})
    return replace(small, cell=replace(small.cell, arms=arms, moments=moments))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stops short", "moves on"])
@pytest.mark.parametrize("draws", seeds(1, 8))
def test_an_arm_that_moves_between_pose_and_image_is_found_and_one_that_stands_does_not(
    kind, draws
):
    squares = []
    for seed in draws:
        small = stopping(seed, -0.01, onwards=kind == "moves on")
        fit = solve(small.cell).fit
        (short,) = (effect for effect in fit.unknowns.effects if effect.kind == kind)
        moved = short.twists(small.cell.moments, fit.state.values["effect", short.name])
        # Screws: the straight line, and how far a screw departs from it.
        by_line, _, by_screw, *_ = np.moveaxis(short.columns(small.cell.moments, np.ones(16)), 2, 0)
        true = -0.01 * (by_line + by_screw)
        # Motions of 0.3 m and more, where a tenth of a millimetre is noise.
        assert moved == pytest.approx(true, abs=6e-4)
        squares.append(squares_of(small, fit, {})[0])
        sound = solve(stopping(seed, 0.0).cell).fit
        assert kind not in {effect.kind for effect in sound.unknowns.effects}
    assert np.mean(squares) < chi2.ppf(0.999, 6 * len(draws)) / len(draws)
    other = replace(small.cell.moments, stops=np.full(16, -1))
    assert not short.columns(other, np.ones(16)).any()
