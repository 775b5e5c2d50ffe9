"""Whole cells in plain arrays: the linearisation, the fit, its start, and what moved."""

from dataclasses import replace

import numpy as np
import pytest
from networks import ROBOT_SIGMAS, away, moved, observed, true_state, world

from visioncal.estimator.linalg import covariance
from visioncal.estimator.networkagree import agree, settle
from visioncal.estimator.networkfit import (
    equations_by_stop,
    fit_network,
    network_information,
    normal_equations,
    posterior,
)
from visioncal.estimator.sightings import Common, Noise, State
from visioncal.stages.choose import Candidates
from visioncal.stages.sighted import Sighted
from visioncal.stages.tie import tie

MOVABLE = ("cam_left", "cam_right", "target_floor", "target_a", "target_b")
NOISE = Noise(np.array([ROBOT_SIGMAS["a"], ROBOT_SIGMAS["b"]]), np.zeros(0))


def network_of(seed, stops=20, seen=0.7, **more):
    rng = np.random.default_rng(seed)
    cell = world(rng, stops, seen)
    return cell, observed(cell, rng, **more)


def sighted(network, **turned):
    seen = network.sightings
    count = len(seen)
    return Sighted(
        seen.seers,
        seen.seen,
        seen.stops,
        Candidates(seen.measured[:, None], np.ones((count, 1), dtype=bool)),
        np.zeros((count, 1), dtype=np.int64),
        turned,
        ~seen.turned,
    )


def started(network):
    tied = tie(network.tree, network.poses, sighted(network))
    assert not tied.untied
    return State(np.array([tied.edges[it] for it in network.unknown]), np.zeros(0))


def with_places_alone(network, rows):
    """The network in which some rows read places without rotations."""
    turned = network.sightings.turned.copy()
    turned[rows] = False
    return replace(network, sightings=replace(network.sightings, turned=turned))


def with_shared(network, rng):
    """The network with two values that all observations share."""
    by_shared = rng.normal(size=(len(network), 6, 2)) * 1e-3
    common = Common(np.eye(2), np.zeros(2))
    return replace(
        network, sightings=replace(network.sightings, by_shared=by_shared), common=common
    )


@pytest.mark.parametrize("kind", ["poses", "places", "shared"])
def test_derivatives_are_those_of_central_differences(kind):
    cell, network = network_of(1, stops=3, seen=1.0)
    if kind == "places":
        network = with_places_alone(network, slice(0, 5))
    if kind == "shared":
        network = with_shared(network, np.random.default_rng(2))
    state = true_state(cell, network.tree)
    state = State(state.edges, np.full(network.size - 6 * len(state.edges), 0.3))
    found, step = network.linear(state).jacobian, 1e-6
    for at, column in enumerate(np.eye(network.size) * step):
        ends = [network.linear(state.moved(it)).residuals for it in (column, -column)]
        # Differences of 1e-6 are exact to 1e-9. Of a place alone, a turn of the frame that it is
        # in counts by the place's own error, 0.1 mm, which is left out; and what is shared moves
        # as its last step does, which is its own square, 1e-6, off.
        away_by = np.abs((ends[0] - ends[1]) / (2 * step) - found[:, :, at]).max()
        assert away_by < {"poses": 1e-8, "places": 5e-4, "shared": 5e-6}[kind]


def test_flanges_move_as_central_differences_have_it():
    cell, network = network_of(1, stops=2, seen=1.0)
    state, step = true_state(cell, network.tree), 1e-6
    found = network.linear(state).slack
    of, members = network.units
    for robot, name in enumerate(network.robots):
        for at in range(6):
            ends = []
            for sign in (step, -step):
                twist = np.zeros(6)
                twist[at] = sign
                poses = np.array([moved(it, twist) for it in network.poses[name]])
                other = replace(network, poses={**network.poses, name: poses})
                ends.append(other.linear(state).residuals)
            slope = (ends[0] - ends[1]) / (2 * step)
            mine = [row for row, unit in enumerate(of) if unit >= 0 and members[unit, 0] == robot]
            assert mine
            np.testing.assert_allclose(found[mine, :, at], slope[mine], atol=1e-8)


def dense_information(network, state):
    """The information with every flange's error as an unknown of its own."""
    linear = network.linear(state, ideal=True)
    weights = np.linalg.inv(network.sightings.covariance)
    of, members = network.units
    size = network.size
    whole = np.zeros((size + 6 * len(members), size + 6 * len(members)))
    for row, unit in enumerate(of):
        slope = np.zeros((6, len(whole)))
        slope[:, :size] = linear.jacobian[row]
        if unit >= 0:
            slope[:, size + 6 * unit : size + 6 * unit + 6] = linear.slack[row]
        whole += slope.T @ weights[row] @ slope
    for unit, (robot,) in enumerate(members):
        at = size + 6 * unit + np.arange(6)
        whole[at, at] += np.repeat(NOISE.robots[robot], 3) ** -2.0
    return whole


def test_taking_the_flanges_out_loses_nothing():
    cell, network = network_of(3, stops=6)
    state = true_state(cell, network.tree)
    dense = np.linalg.inv(dense_information(network, state))[: network.size, : network.size]
    found = covariance(network_information(network, state, NOISE))
    # The same to rounding, for matrices of a condition of 1e6.
    np.testing.assert_allclose(found, dense, atol=1e-7 * np.abs(dense).max())


def test_equations_by_stop_add_up_to_those_of_all():
    cell, network = network_of(4, stops=6)
    fit = fit_network(network, true_state(cell, network.tree))
    parts = equations_by_stop(network, fit)
    whole = normal_equations(network, fit.state, fit.noise)
    for part, total in zip(parts, whole, strict=True):
        np.testing.assert_allclose(part.sum(axis=0), total, atol=1e-9 * np.abs(parts[0]).max())


def test_the_fit_is_as_good_as_its_covariance_says():
    squares, levels = [], []
    for seed in range(6):
        cell, network = network_of(seed)
        fit = fit_network(network, true_state(cell, network.tree))
        assert fit.settled
        spread = covariance(network_information(network, fit.state, fit.noise))
        error = away(cell, network, fit.state)
        squares.append(error @ np.linalg.solve(spread, error) / len(error))
        levels.append(fit.noise.robots[:, 1])
    # Chi-square of 6 x 36: a standard deviation of 0.1; the levels' own errors add some.
    assert 0.7 < np.mean(squares) < 1.5
    # Twenty stops tell a flange's error to 15 % each.
    np.testing.assert_allclose(np.mean(levels, axis=0), [3e-5, 8e-5], rtol=0.35)


def test_what_is_left_of_the_observations_is_their_redundancy():
    cell, network = network_of(5)
    fit = fit_network(network, true_state(cell, network.tree))
    squares, left = posterior(network, fit.state, fit.noise)
    # Chi-square of some 300: a standard deviation of 8 %.
    assert left.sum() > 200
    assert squares.sum() == pytest.approx(left.sum(), rel=0.3)


def test_the_level_of_a_sensor_is_found():
    cell, network = network_of(6)
    sensors = np.array([0 if it == "cam_left" else -1 for it in network.sightings.seers])
    # What cam_left says of its own noise is three times too little.
    spread = network.sightings.covariance / np.where(sensors == 0, 9.0, 1.0)[:, None, None]
    network = replace(
        network, sightings=replace(network.sightings, sensors=sensors, covariance=spread)
    )
    fit = fit_network(network, true_state(cell, network.tree))
    # Some 150 residuals tell it to 6 %.
    assert fit.noise.sensors[0] == pytest.approx(3.0, rel=0.2)


def test_the_start_is_near_the_truth():
    cell, network = network_of(7)
    off = away(cell, network, started(network)).reshape(-1, 2, 3)
    # Closed forms of 8 to 16 views: far inside the 50 mm and 5 degrees that the fit needs.
    assert np.abs(off[:, 0]).max() < 0.02
    assert np.abs(off[:, 1]).max() < 0.02


def test_a_sound_cell_has_nothing_left_out_and_nothing_moved():
    _, network = network_of(8)
    found = settle(agree(network, started(network), MOVABLE), MOVABLE)
    assert found.used.all()
    assert not found.moves


def pushed(cell, frame, stop, twist, stops=20):
    edge = moved(cell.truth[frame], np.array(twist))
    return {(frame, at): edge for at in range(stop, stops)}


def test_a_board_that_slips_and_a_camera_that_is_bumped_are_two_frames_each():
    rng = np.random.default_rng(9)
    cell = world(rng, 20, 0.9)
    changed = pushed(cell, "target_b", 9, (0.004, 0, 0, 0.003, 0, 0.004))
    changed |= pushed(cell, "cam_right", 12, (0, -0.006, 0, 0, 0.005, 0))
    network = observed(cell, rng, changed)
    found = settle(agree(network, started(network), MOVABLE), MOVABLE)
    assert {(it.frame, it.stop) for it in found.moves} == {("target_b", 9), ("cam_right", 12)}
    assert found.used.all()
    plain = [it for it in found.network.unknown if "@" not in it]
    edges = dict(zip(found.network.unknown, found.fit.state.edges, strict=True))
    was = np.linalg.inv(cell.truth["base_b"]) @ edges["base_b"]
    assert len(plain) == 6
    # The base is as near as without: to some 0.1 mm.
    assert np.linalg.norm(was[:3, 3]) < 4e-4


def test_a_slip_that_hides_in_the_noise_of_single_views_is_found():
    rng = np.random.default_rng(10)
    cell = world(rng, 40, 1.0)
    # 0.12 mm: one sigma of a single view along its axis.
    network = observed(cell, rng, pushed(cell, "target_floor", 20, (0, 0, 0, 1e-4, 6e-5, 0), 40))
    found = settle(agree(network, started(network), MOVABLE), MOVABLE)
    (move,) = found.moves
    assert move.frame == "target_floor"
    assert abs(move.stop - 20) <= 2
    assert found.used.all()


def test_wrong_images_are_left_out_and_nothing_else():
    _, network = network_of(11, stops=25)
    measured = network.sightings.measured.copy()
    pairs = list(zip(network.sightings.seers, network.sightings.seen, strict=True))
    rows = [at for at, pair in enumerate(pairs) if pair == ("cam_left", "target_a")]
    wrong = rows[3:6]
    measured[wrong] = network.sightings.measured[rows[8:11]]
    network = replace(network, sightings=replace(network.sightings, measured=measured))
    found = settle(agree(network, started(network), MOVABLE), MOVABLE)
    assert np.flatnonzero(~found.used).tolist() == wrong
    assert not found.moves


def test_a_camera_on_one_arm_and_a_board_on_the_other_tie_both_bases():
    rng = np.random.default_rng(12)
    cell = world(rng, 25)
    parents = {it: on for it, on in cell.parents.items() if it[:3] not in ("cam", "tar")}
    parents |= {"cam_a": "flange_a", "target_b": "flange_b"}
    truth = {**cell.truth, "cam_a": cell.truth["target_a"]}
    pairs = [("cam_a", "target_b", stop) for stop in range(25)]
    cell = replace(cell, parents=parents, truth=truth, pairs=pairs)
    network = observed(cell, rng)
    fit = fit_network(network, started(network))
    off = away(cell, network, fit.state).reshape(-1, 2, 3)
    # Twenty-five views of 0.1 mm and 0.3 mrad over levers of a metre.
    assert np.abs(off[:, 1]).max() < 1e-3
