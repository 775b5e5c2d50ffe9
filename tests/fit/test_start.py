"""Starts in spite of what is wrong: rows that are shifted from one on, lenses without a start."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.marks import slow
from support.small_cells import TABLE, made, pose, seen_at

from visioncal.core.quantiles import f_limit
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Target
from visioncal.fit.consensus import Candidates, hand_eye
from visioncal.fit.solve import solve
from visioncal.fit.start import start_of
from visioncal.model import Arm, Cell, MeasuredPose, Moments, Sighting
from visioncal.model.arm import even_progress
from visioncal.session.tree import Branch, Tree
from visioncal.vision.targets import rotation_transforms, rotations


def with_poses(cell, poses):
    """The cell whose arm reports other (s, 4, 4) poses."""
    arms = {"flange": replace(cell.arms["flange"], poses=poses)}
    return replace(cell, arms=arms, moments=Moments.of(arms, even_progress(len(poses))))


def shifted(cell, start, by):
    """The cell whose rows have the poses of others from one on."""
    poses = cell.arms["flange"].poses
    stops = np.arange(len(poses))
    rows = np.where(stops >= start, np.clip(stops + by, 0, len(poses) - 1), stops)
    return with_poses(cell, poses[rows]), rows != stops


@pytest.mark.parametrize("by", [slow(1), -1, slow(3)])
@pytest.mark.parametrize("in_hand", [True, slow(False)])
def test_rows_that_are_shifted_from_one_on_are_left_out(by, in_hand):
    for seed in range(2):
        small = made(seed, stops=18, in_hand=in_hand)
        cell, wrong = shifted(small.cell, 6 + seed % 3, by)
        fit = solve(cell).fit
        assert fit.used.tolist() == (~wrong).tolist()
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        square = away @ np.linalg.solve(fit.covariance(("edge", "cam")), away)
        # Six to eight stops tell the flange's noise by some twenty degrees of freedom.
        assert square / 6 < f_limit(1e-4, 6, 20)


def test_cameras_beside_each_other_lose_the_same_rows():
    small = made(5, stops=16, cameras=2)
    cell, wrong = shifted(small.cell, 6, 1)
    fit = solve(cell).fit
    assert fit.used.tolist() == (~np.repeat(wrong, 2)).tolist()


def test_a_sound_start_takes_no_row_for_another():
    for seed in range(10):
        start = start_of(made(seed, stops=12).cell)
        assert start.sound.all()


def test_poses_at_random_are_not_taken_for_shifted():
    small = made(3, stops=16)
    poses, rng = small.cell.arms["flange"].poses.copy(), np.random.default_rng(8)
    rows = rng.permutation(16)[:7]
    poses[rows] = poses[np.roll(rows, 2)]
    cell = with_poses(small.cell, poses)
    assert start_of(cell).sound.all()
    assert np.flatnonzero(~solve(cell).fit.used).tolist() == sorted(rows.tolist())


def test_a_parked_robot_counts_once_for_its_hand_eye_calibration():
    """Half of the views have one pose of it, and agree with any edges beside their product."""
    rng = np.random.default_rng(62)
    x, z = pose([0.1, 0.4, -0.2], [0.03, -0.05, 0.09]), pose([0.3, 0.1, 1.0], [0.5, 0.1, 0.2])
    robot = np.array([pose(*rng.normal(0, [[0.6], [0.3]], (2, 3))) for _ in range(5)])
    robot = np.concatenate([robot[:1].repeat(6, axis=0), robot[1:]])
    robot = robot @ exp(rng.normal(0, 1e-4, (len(robot), 6)))
    seen = Candidates.of((invert(robot @ x) @ z)[:, None], [[0]] * len(robot))
    edges = hand_eye(robot, seen)
    assert edges is not None
    assert np.abs(log(invert(edges.x) @ x)).max() < 1e-6
    assert edges.residuals.max() < 1e-6


@pytest.mark.slow
def test_a_chain_over_two_arms_is_within_the_stated_sigma():
    """A camera on one arm sees a board on the other, whose base is unknown, too."""
    squares = []
    for seed in range(6):
        rng, stops = np.random.default_rng([seed, 61]), 20
        edges = {
            "cam": pose(rng.normal(0, 0.2, 3), [0.03, -0.05, 0.09]),
            "base_b": pose(rng.normal(0, 1.0, 3), [1.2, 0.3, 0.0]),
            "target": pose(rng.normal(0, 0.4, 3), [0.0, 0.02, 0.1]),
        }
        seen = np.array([seen_at(rng) for _ in range(stops)])
        a = np.array([pose(*rng.normal(0, [[0.6], [0.3]], (2, 3))) for _ in range(stops)])
        b = invert(edges["base_b"]) @ a @ edges["cam"] @ seen @ invert(edges["target"])
        noise = rng.normal(size=(2, stops, 6)) * np.repeat([2e-4, 1e-4], 3)
        arms = {
            name: Arm(name, at @ exp(twists))
            for name, at, twists in zip(("flange_a", "flange_b"), (a, b), noise, strict=True)
        }
        branches = {
            "base_a": Branch("cell", known=np.eye(4)),
            "flange_a": Branch("base_a", robot="flange_a"),
            "cam": Branch("flange_a"),
            "base_b": Branch("cell"),
            "flange_b": Branch("base_b", robot="flange_b"),
            "target": Branch("flange_b"),
        }
        measured = (MeasuredPose(at, (2e-4, 1e-4)) for at in seen)
        sightings = [Sighting(at, at, "cam", "target", one) for at, one in enumerate(measured)]
        moments = Moments.of(arms, even_progress(stops))
        fit = solve(Cell(Tree("cell", branches), arms, {}, {}, tuple(sightings), moments)).fit
        assert fit.used.all()
        away = np.concatenate([log(invert(true) @ fit.edge(name)) for name, true in edges.items()])
        covariance = fit.covariance(*(("edge", name) for name in edges))
        squares.append(away @ np.linalg.solve(covariance, away) / len(away))
    # The mean of 108 squares by 12 levels of noise: 1 with a standard deviation of 0.15.
    assert 0.5 < np.mean(squares) < 1.6


@pytest.mark.slow
def test_far_boards_determine_a_lens_by_the_robots_motion(monkeypatch):
    def far(rng):
        found = seen_at(rng)
        found[:3, 3] += np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(2.2, 2.8)])
        found[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.25, 3)).as_matrix()
        return found

    monkeypatch.setattr("support.small_cells.seen_at", far)
    for seed in range(2):
        small = made(seed, stops=16, given=False)
        # By corners alone, focal lengths are hundreds of widths, or differ.
        fx, fy = start_of(small.cell).lenses["cam"].matrix[:2]
        assert fx == pytest.approx(fy, rel=0.06)
        assert fx == pytest.approx(1150.0, rel=0.3)
        fit = solve(small.cell).fit
        assert fit.used.sum() >= 14
        for key, true in (("edge", small.edges["cam"]), ("lens", TABLE.matrix)):
            covariance = fit.covariance((key, "cam"))
            if key == "edge":
                away = log(invert(true) @ fit.edge("cam"))
            else:
                away, covariance = fit.camera("cam").matrix - true, covariance[:4, :4]
            square = away @ np.linalg.solve(covariance, away)
            assert square / len(away) < f_limit(1e-4, len(away), 40)


def test_cameras_keep_the_order_of_their_sightings():
    # By the order in which five names are hashed, one run of 120 would keep it.
    cell = made(cameras=5).cell
    assert list(start_of(cell).lenses) == [sighting.seer for sighting in cell.sightings[:5]]


@pytest.mark.parametrize("turned_first", [False, True])
def test_a_symmetric_board_is_numbered_as_its_first_view(monkeypatch, turned_first):
    """Views that a detector numbered from the other end are turned, and not the result."""
    board = Target("board", "checkerboard", 5, 3, 0.04, 4e-6)
    monkeypatch.setattr("support.small_cells.BOARD", board)
    half = rotations(board)[1]
    for seed in range(3):
        small = made(seed, stops=12)
        sightings = list(small.cell.sightings)
        for at in [*range(0 if turned_first else 1, 12, 2)]:
            corners = sightings[at].corners
            sightings[at] = replace(sightings[at], evidence=replace(corners, ids=half[corners.ids]))
        fit = solve(small.cell.with_sightings(sightings)).fit
        assert fit.used.all()
        first = sightings[0].corners.ids
        assert np.array_equal(fit.cell.sightings[0].corners.ids, first)
        turn = rotation_transforms(board)[1] if turned_first else np.eye(4)
        away = log(invert(small.edges["target"] @ turn) @ fit.edge("target"))
        assert np.linalg.norm(away) < 2e-3
