"""Cells of several arms, cameras and boards by the one likelihood."""

import numpy as np
import pytest
from scipy.stats import chi2
from support.marks import seeds
from support.small_cells import PX, ROBOT_RAD, made
from support.whole_cells import FLOOR, OPTIONS, PLATE, recorded

from visioncal.core.transforms import invert, log
from visioncal.fit.solve import solve
from visioncal.model import read_cell
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, RobotAt, simulate


@pytest.mark.slow
def test_a_cell_of_two_arms_is_found_within_its_covariance():
    simulated = simulate(OPTIONS)
    session = recorded(simulated)
    cell = read_cell(session, session.corners)
    assert cell.bodies == (("flange_a", "flange_b"),)
    fit = solve(cell).fit
    true = simulated.transforms
    base = true["cell_from_base_a"]
    for name in ("base_b", "cam_left", "cam_hand", "target_floor", "target_plate_a"):
        parent = cell.tree.branches[name].parent
        edge = true[f"{parent}_from_{name}"]
        edge = invert(base) @ edge if parent == "cell" else edge
        away = log(invert(edge) @ fit.edge(name))
        square = away @ np.linalg.solve(fit.covariance(("edge", name)), away)
        # One of a thousand sound cells has one of its five edges beyond this.
        assert square < chi2.isf(2e-4, 6), name
    # Seen from each other, an arm's hand and its own plate are not moved by the other arm.
    found = fit.predict("flange_a", "cam_hand", cell.moments.take(np.arange(1)))
    assert np.allclose(found.calibration[0], fit.covariance(("edge", "cam_hand")))
    assert not found.noise.any()


def test_arms_that_no_sighting_connects_are_eliminated_apart():
    simulated = simulate(OPTIONS)
    session = recorded(simulated)
    cell = read_cell(session, session.corners)
    sightings = [s for s in cell.sightings if s.pair == ("cam_left", "target_plate_b")]
    sightings += [s for s in cell.sightings if s.pair == ("cam_left", "target_plate_a")]
    apart = cell.with_sightings(sightings)
    assert sorted(apart.bodies) == [("flange_a",), ("flange_b",)]
    fit = solve(apart).fit
    assert [body.width for body in fit.mixed.bodies] == [6, 6]
    assert fit.used.mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("in_hand", [True, False])
def test_swaying_cameras_are_separated_from_corners_noise_and_from_the_arm(in_hand):
    squares, views, errors, used = [], [], [], []
    for seed in range(4):
        small = made(seed, 20, 3, in_hand=in_hand, sways=2e-3)
        fit = solve(small.cell).fit
        used.append(fit.used.mean())
        views.append([fit.sizes[f"view {name}"] / PX for name in ("cam", "cam_1", "cam_2")])
        errors.append(fit.sizes["rad flange"] / ROBOT_RAD)
        for name in ("cam", "cam_2"):
            away = log(invert(small.edges[name]) @ fit.edge(name))
            squares.append(away @ np.linalg.solve(fit.covariance(("edge", name)), away) / 6)
    # A mount that turns alone is further off in three directions than its size in six says: few of
    # its views are lost, where all were that were further off than corners' noise.
    assert np.mean(used) > 0.96
    steady, swaying = np.split(np.median(views, axis=0), [2])
    # A noise is known by 20 views to a tenth of it.
    assert steady == pytest.approx(np.ones(2), abs=0.2)
    assert swaying > 4.0
    assert np.median(errors) == pytest.approx(1.0, abs=0.2)
    # Of a mount that turns, two directions have thrice the variance of six equal ones: a variance
    # of one beside a third of a steady camera. The mean of four each has a sigma of 0.3.
    assert 0.1 < np.mean(squares) < 1.9


def ring(seed):
    """Two cameras before one arm that holds a board, and a board on the floor, at 20 stops."""
    return NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)),),
        cameras=(
            CameraAt("left", place_m=(0.0, -1.0, 1.1)),
            CameraAt("right", place_m=(0, 1, 1.2)),
        ),
        boards=(
            BoardAt("floor", place_m=(0.0, 0.0, 0.05), target=FLOOR),
            BoardAt("plate", on="a", target=PLATE),
        ),
        stops=20,
        seed=seed,
    )


@pytest.mark.parametrize("draws", seeds(1, 6))
def test_all_edges_of_a_rig_err_as_their_joint_covariance_says(draws):
    squares, count = [], len(draws)
    for seed in draws:
        simulated = simulate(ring(seed))
        session = recorded(simulated)
        fit = solve(read_cell(session, session.corners)).fit
        assert fit.used.mean() > 0.95
        names, at = fit.cell.unknown, simulated.mountings
        assert set(names) == {"cam_left", "cam_right", "target_floor", "target_plate"}
        base = invert(at["base_a"])
        true = [at[name] if name == "target_plate" else base @ at[name] for name in names]
        away = np.concatenate(
            [log(invert(t) @ fit.edge(name)) for name, t in zip(names, true, strict=True)]
        )
        covariance = fit.covariance(*(("edge", name) for name in names))
        scale = np.sqrt(np.diag(covariance))
        whitened = np.linalg.solve(covariance / np.outer(scale, scale), away / scale)
        squares.append(float(away / scale @ whitened))
    # Noise levels of 20 stops are known by 60 degrees of freedom each: a share of 1.04.
    low, high = chi2.ppf([0.001, 0.999], 24 * count) / count
    # Up to a fifth of it is of what these arms do not do, and others might: errors that last.
    assert 0.8 * low < np.mean(squares) / 1.04 < high
