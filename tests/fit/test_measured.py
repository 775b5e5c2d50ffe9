"""Poses and places that were measured as such: what they determine, and how surely."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from support import small_cells
from support.marks import seeds
from support.small_cells import BOARD, PX, ROBOT_M, ROBOT_RAD, TABLE, made, pose

from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Target
from visioncal.fit.inliers import Search, nearest
from visioncal.fit.linearise import linearised
from visioncal.fit.pairs import pairs_of
from visioncal.fit.solve import solve, state_of, unknowns_of
from visioncal.fit.start import start_of
from visioncal.fit.unknowns import State, printed_board
from visioncal.model import Arm, Cell, MeasuredPlace, MeasuredPose, Moments, Sighting, read_cell
from visioncal.model.arm import even_progress
from visioncal.session import Session
from visioncal.session.tree import Branch, Tree
from visioncal.vision.targets import corner_positions

TRACKER_M, TRACKER_RAD = 2e-5, 5e-5


def poses_by_opencv(small, size=1.0):
    """The cell as other software saw it: poses by OpenCV, of a board `size` as large as it is."""
    fx, fy, cx, cy = TABLE.matrix
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    points, found = corner_positions(BOARD) * size, []
    for sighting in small.cell.sightings:
        lens = np.array(TABLE.distortion)
        _, turn, place = cv2.solvePnP(points, sighting.corners.px, matrix, lens)
        measured = MeasuredPose(pose(turn.ravel(), place.ravel()))
        found.append(replace(sighting, evidence=measured))
    return small.cell.with_sightings(found)


def tracked(
    seed, stops=14, points=1, *, are_poses=False, is_touch=False, sigma_rad=TRACKER_RAD,
    sigma_m=TRACKER_M,
):  # fmt: skip
    """An arm whose points, or whose probe, a tracker measures, or whose tip touches points.

    Returns the cell, and the true edges of the tracker (or tip) and the points.
    """
    rng = np.random.default_rng([seed, 61])
    names = [f"point_{at}" for at in range(points)]
    on_flange = {name: pose(rng.normal(0, 0.5, 3), rng.normal(0, 0.1, 3)) for name in names}
    seer = pose(rng.normal(0, 0.5, 3), [2.0, -1.0, 0.4])
    arm = [pose(rng.normal(0, 1.0, 3), rng.uniform(-0.5, 0.5, 3)) for _ in range(stops)]
    if is_touch:
        seer = pose([0, 0, 0], [0.02, -0.03, 0.2])
        on_flange = {name: pose([0, 0, 0], rng.uniform(-0.3, 0.3, 3)) for name in names}
        tips = [
            on_flange[names[stop % points]]
            @ pose(rng.normal(0, 0.7, 3), TRACKER_M * rng.normal(size=3))
            for stop in range(stops)
        ]
        arm = [tip @ invert(seer) for tip in tips]
    noise = rng.normal(size=(stops, 2, 3)) * np.array([ROBOT_RAD, ROBOT_M])[:, None]
    reported = np.array([at @ pose(*step) for at, step in zip(arm, noise, strict=True)])
    sightings = []
    for stop, flange in enumerate(arm):
        for at, name in enumerate(names):
            if is_touch:
                if at == stop % points:
                    touch = MeasuredPlace(np.zeros(3), TRACKER_M)
                    sightings.append(Sighting(stop, stop, "tip", name, touch))
                continue
            step = rng.normal(size=6) * np.repeat([TRACKER_RAD, TRACKER_M], 3)
            read = invert(seer) @ flange @ on_flange[name] @ exp(step)
            evidence = (
                MeasuredPose(read, (sigma_rad, TRACKER_M))
                if are_poses
                else MeasuredPlace(read[:3, 3], sigma_m)
            )
            sightings.append(Sighting(len(sightings), stop, "tracker", name, evidence))
    branches = {"flange": Branch("base", robot="flange"), "base": Branch("cell", known=np.eye(4))}
    device = "tip" if is_touch else "tracker"
    branches |= {device: Branch("flange" if is_touch else "cell")}
    branches |= {name: Branch("base" if is_touch else "flange") for name in names}
    arms = {"flange": Arm("flange", reported)}
    moments = Moments.of(arms, even_progress(stops))
    cell = Cell(Tree("cell", branches), arms, {}, {}, tuple(sightings), moments)
    return cell, {device: seer, **on_flange}


def is_fair(squares, degrees):
    """Whether squared errors are what covariances say, but for one of a thousand on either side.

    Below, down to 0.7 of it: errors of arms may last from stop to stop, and count though they do
    not here.
    """
    low, high = chi2.ppf([0.001, 0.999], degrees * len(squares))
    return 0.7 * low < np.sum(squares) < high


@pytest.mark.parametrize("draws", seeds(1, 12))
@pytest.mark.parametrize(("in_hand", "is_declared"), [(True, True), (True, False), (False, True)])
def test_poses_by_other_software_are_within_the_stated_sigma(in_hand, is_declared, draws):
    squares = []
    for seed in draws:
        small = made(seed, 14, in_hand=in_hand)
        sigma = 1e-4 if is_declared else 1e-3
        size = 1.0 + sigma * np.random.default_rng(seed).normal()
        cell = poses_by_opencv(small, size)
        fit = solve(cell if is_declared else replace(cell, boards={})).fit
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away))
    assert is_fair(squares, 6)


@pytest.mark.parametrize("draws", seeds(1, 6))
def test_corners_of_a_single_tag_are_within_the_stated_sigma(monkeypatch, draws):
    tag = Target("tag", "marker", 1, 1, 0.05, 5e-5, dictionary="DICT_4X4_50", marker_id=0)
    monkeypatch.setattr(small_cells, "BOARD", tag)
    monkeypatch.setattr(small_cells, "PX", 0.3)
    squares, noise = [], []
    for seed in draws:
        small = made(seed, 20)
        solved = solve(small.cell)
        # Of eight degrees of freedom a pose takes six, and both poses of a tag fit nearly alike.
        assert solved.used.all()
        away = log(invert(small.edges["cam"]) @ solved.fit.edge("cam"))
        squares.append(away @ np.linalg.solve(solved.fit.covariance(("edge", "cam")), away))
        noise.append(solved.fit.sizes["px cam"])
    assert is_fair(squares, 6)
    # Forty degrees of freedom each: three sigma.
    assert np.mean(noise) == pytest.approx(0.3, rel=3.0 / np.sqrt(80 * len(noise)))


def test_distance_and_tilt_are_noisier_in_an_image_than_the_rest():
    fit = solve(poses_by_opencv(made(3, 30))).fit
    # A board of 0.16 m at 0.55 m: tilt is told by the second order of what it does to distances.
    assert fit.sizes["rad cam"] > 2 * fit.sizes["roll cam"]
    assert PX / TABLE.matrix[0] / 20 < fit.sizes["roll cam"] < 20 * PX / TABLE.matrix[0]


def test_a_board_of_another_size_is_found_by_an_arm_whose_errors_are_separated():
    small = made(2, 20)
    cell = poses_by_opencv(small, 0.99)
    start = start_of(cell)
    unknowns = unknowns_of(start, ())
    board = printed_board("target", cell.boards.get("target"), has_shape=False, is_sized=True)
    search = Search.of(cell, unknowns.with_members(board))
    fit, _ = search.run(state_of(start, ()), nearest(start))
    sigma = float(np.sqrt(fit.covariance(("shape", "target"))[0, 0]))
    found = fit.state.values["shape", "target"][0]
    # Poses by a board 1 % too small: the real one is larger by that.
    assert abs(found - (1 / 0.99 - 1)) < 4 * sigma
    assert sigma < 1e-3


def test_measured_rows_have_the_slopes_that_differences_show():
    small = made(5, 6)
    cell = poses_by_opencv(small, 1.02)
    stated = [
        Sighting(-1, 5, "flange", "cam", MeasuredPlace(np.array([0, 0, 0.1]), 1e-3, (2,))),
        Sighting(-2, 5, "flange", "cam", MeasuredPose(exp(np.full(6, 0.1)), (1e-2, np.inf))),
    ]
    cell = cell.with_sightings([*cell.sightings, *stated])
    start = start_of(cell)
    unknowns, state = unknowns_of(start, ()), state_of(start, ())
    rng = np.random.default_rng(1)
    errors = {name: 1e-2 * rng.normal(size=at.shape) for name, at in state.errors.items()}
    state = unknowns.moved(State(state.values, errors), 1e-2 * rng.normal(size=unknowns.count), {})
    logs, pairs = np.zeros(len(unknowns.sizes)), pairs_of(cell)
    grams = linearised(cell, unknowns, state, pairs)
    counts = [sum(part.counts.sum() for part in gram.parts) for gram in grams]
    assert counts == [36, 1, 3]
    for column in range(unknowns.count):
        step = 1e-6 * (np.arange(unknowns.count) == column)
        ahead, behind = (
            [gram.squares(logs) for gram in linearised(cell, unknowns, at, pairs)]
            for at in (unknowns.moved(state, sign * step, {}) for sign in (1, -1))
        )
        for gram, a, b in zip(grams, ahead, behind, strict=True):
            at = np.flatnonzero(gram.columns == column)
            slope = gram.by_unknowns(gram.heads(logs)[:, None, :, -1])[:, 0]
            expected = slope[:, 6 * len(gram.flanges) + at].sum(axis=1)
            assert -(a - b) / 4e-6 == pytest.approx(expected, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("draws", seeds(1, 12))
@pytest.mark.parametrize(
    "kind", ["place", "places", "places of unknown noise", "pose", "pose of unknown rotation"]
)
def test_readings_of_a_tracker_are_as_accurate_as_stated(kind, draws):
    squares, turned = [], kind.startswith("pose")
    for seed in draws:
        cell, edges = tracked(
            seed, points=3 if "places" in kind else 1, are_poses=turned,
            sigma_rad=None if "unknown" in kind else TRACKER_RAD,
            sigma_m=None if "noise" in kind else TRACKER_M,
        )  # fmt: skip
        fit = solve(cell).fit
        assert fit.used.sum() >= len(fit.used) - 1
        away = log(invert(edges["tracker"]) @ fit.edge("tracker"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "tracker")), away))
    assert is_fair(squares, 6)


@pytest.mark.parametrize("draws", seeds(1, 12))
def test_points_that_a_tip_touched_are_within_the_stated_sigma(draws):
    squares = []
    for seed in draws:
        cell, edges = tracked(seed, stops=24, points=3, is_touch=True)
        fit = solve(cell).fit
        away = fit.edge("tip")[:3, 3] - edges["tip"][:3, 3]
        turn = fit.edge("tip")[:3, :3]
        covariance = turn @ fit.covariance(("edge", "tip"))[3:, 3:] @ turn.T
        squares.append(away @ np.linalg.solve(covariance, away))
    assert is_fair(squares, 3)


def test_a_wrong_reading_is_left_out_and_a_held_one_is_predicted():
    cell, edges = tracked(4, stops=20)
    sightings = list(cell.sightings)
    wrong = sightings[7].evidence.place_m + np.array([0.01, 0, 0])
    sightings[7] = replace(sightings[7], evidence=MeasuredPlace(wrong, TRACKER_M))
    for row in (2, 3, 4, 5):
        sightings[row] = replace(sightings[row], is_held=True)
    solved = solve(cell.with_sightings(sightings))
    held = [2, 3, 4, 5]
    assert np.flatnonzero(~solved.used).tolist() == [2, 3, 4, 5, 7]
    # 0.999 of twelve degrees of freedom.
    assert 0.3 < solved.left_out.squares[held].sum() < 33
    assert np.linalg.norm(fit_error(solved, edges)) < 5e-4


def fit_error(solved, edges):
    return solved.fit.edge("tracker")[:3, 3] - edges["tracker"][:3, 3]


def test_held_rows_of_a_real_tracker_err_as_much_as_stated(real_data):
    session = Session.load(real_data / "sessions" / "ur10_tracker_series_c")
    solved = solve(read_cell(session, {}))
    held = solved.start.cell.held
    assert held.sum() == 75
    assert np.array_equal(solved.used, ~held)
    # Mean of 75 of six degrees, a tenth either way, and what an arm errs by beyond its links.
    assert 0.6 < solved.left_out.squares[held].mean() / 6 < 1.6
