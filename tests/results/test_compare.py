"""Two calibrations of one cell: noise stays noise, and what moved is found and named."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.aligned_cells import made_up_cell
from support.cells import reporting
from support.commands import visioncal
from support.marks import slow
from support.picks import calibration_of
from support.samples import made_up

from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Camera
from visioncal.core.verdict import Verdict
from visioncal.results import Calibration, CameraResult, Edge, Frame, ViewResult
from visioncal.results.compare import FALSE_ALARMS, _findings, compare, to_document
from visioncal.simulation import CellOptions, SimulatedCell, simulate


def moved(cell: SimulatedCell, camera=(0.0,) * 6, board=(0.0,) * 6) -> SimulatedCell:
    """The cell with its edges moved on the right by twists (6,), its images as they were.

    The robot stands where the camera sees again what it saw before.
    """
    x, z = cell.transforms.values()
    new_x, new_z = x @ exp(np.array(camera)), z @ exp(np.array(board))
    flanges = cell.robot.base_from_flange
    if cell.options.mount == "eye-in-hand":
        flanges = new_z @ invert(z) @ flanges @ x @ invert(new_x)
    else:
        flanges = new_x @ invert(x) @ flanges @ z @ invert(new_z)
    mountings = {"cam": new_x, "target": new_z}
    return replace(reporting(cell, base_from_flange=flanges), mountings=mountings)


SHIFT = np.array([0.0, 0.0, 0.0, 0.6, -0.64, 0.48])


@cache
def cells(mount):
    """Two cells with the same mountings, with a lens that is to be estimated."""
    cell = simulate(CellOptions(mount=mount, views=24, seed=0, state_intrinsics=False))
    return cell.only(range(12)), cell.only(range(12, 24))


@cache
def pair(mount):
    first, second = cells(mount)
    return calibration_of(first), calibration_of(second)


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand")])
def test_a_moved_board_is_no_moved_camera(mount):
    second = calibration_of(moved(cells(mount)[1], board=2e-3 * SHIFT))
    comparison = compare(pair(mount)[0], second)
    assert [edge.is_change for edge in comparison.edges] == [False, True]
    assert comparison.findings[0].startswith("The board was moved")
    assert "its calibration still holds" in comparison.findings[0]


def test_a_tool_that_was_exchanged_is_no_equal_result():
    first = pair("eye-in-hand")[0]
    tip = np.eye(4)
    frames = {}
    for name, length_m in (("short", 0.15), ("long", 0.155)):
        tip[2, 3] = length_m
        edge = Edge(tip.copy(), 1e-10 * np.eye(6))
        frames[name] = Frame(edge, True, "pivot", "touches", "", 0.1, 0.1, (), Verdict("good"))
    short, long = (
        replace(first, frames={"flange_from_gripper": frames[name]}) for name in ("short", "long")
    )
    comparison = compare(short, long)
    assert not comparison.is_equal
    assert [edge.name for edge in comparison.edges if edge.is_change] == ["flange_from_gripper"]
    assert comparison.edges[-1].moved_mm == pytest.approx(5.0)
    assert any(words.startswith("flange_from_gripper changed") for words in comparison.findings)
    assert compare(short, short).is_equal
    assert compare(first, short).only_in_b == ("flange_from_gripper",)


def test_cells_without_a_common_frame_are_not_called_the_same():
    cell = made_up_cell(4)
    other = replace(cell, session_sha256="0" * 64)
    assert [*_findings(cell, other, [], None)] == [
        "No frame is in both cells: nothing was compared."
    ]


def test_a_change_of_the_lens_is_found():
    first, second = pair("eye-in-hand")
    assert second.camera is not None
    camera = second.camera.camera
    longer = replace(camera, matrix=camera.matrix * [1.01, 1.01, 1.0, 1.0])
    comparison = compare(first, replace(second, camera=replace(second.camera, camera=longer)))
    assert comparison.lens is not None
    assert comparison.lens.is_change
    assert "The intrinsics differ: another camera, focus or zoom." in comparison.findings
    same = compare(first, second).lens
    assert same is not None
    assert same.names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    assert not same.is_change


def test_given_lenses_are_compared_as_they_stand():
    calibration = replace(made_up(4).calibration)
    assert calibration.camera is not None
    camera = calibration.camera.camera
    given = replace(calibration, camera=CameraResult(camera, estimated=False))
    other = replace(camera, matrix=camera.matrix + 1e-9)
    changed = replace(calibration, camera=CameraResult(other, estimated=False))
    of_other_size = Camera("brown", (320, 200), camera.matrix, camera.distortion)
    small = replace(calibration, camera=CameraResult(of_other_size, estimated=False))
    assert not compare(given, given).is_change
    assert compare(given, changed).is_change
    assert compare(given, small).lens is None
    assert any("model or resolution" in finding for finding in compare(given, small).findings)


def test_covariances_are_added_in_one_tangent_space():
    """Against sampling, where the two poses are a radian and a third of a metre apart."""
    rng = np.random.default_rng(5)
    spreads = []
    for _ in range(2):
        root = rng.normal(size=(6, 6)) * np.repeat([1e-3, 3e-4], 3)[:, None]
        spreads.append(root @ root.T)
    first = exp(np.array([0.3, -0.2, 1.1, 0.1, 0.2, 0.3]))
    second = first @ exp(np.array([0.7, -0.6, 0.4, 0.2, -0.2, 0.15]))
    noise = [
        rng.multivariate_normal(np.zeros(6), covariance, size=40_000) for covariance in spreads
    ]
    sampled = log(invert(first @ exp(noise[0])) @ (second @ exp(noise[1])))
    (edge, _) = compare(with_edge(first, spreads[0]), with_edge(second, spreads[1])).edges
    # 40000 samples show a variance to 0.7 %; the nonlinear rest is a thousandth.
    sigmas = np.sqrt(np.diag(edge.covariance))
    away = (np.cov(sampled.T) - edge.covariance) / np.outer(sigmas, sigmas)
    assert np.abs(away).max() < 0.03


def with_edge(pose, covariance, views=20):
    """The sample's calibration with another first edge and number of views."""
    calibration = made_up(4).calibration
    edge = Edge(pose, covariance)
    edges = {**calibration.edges, "flange_from_cam": edge}
    used = tuple(ViewResult(view, used=True) for view in range(views))
    return replace(calibration, edges=edges, views=used, camera=None)


def test_few_views_make_the_same_difference_less_sure():
    covariance = 1e-8 * np.eye(6)
    away = exp(np.array([0.0, 0.0, 0.0, 5e-4, 0.0, 0.0]))
    p_values = [
        compare(with_edge(np.eye(4), covariance, views), with_edge(away, covariance, views))
        .edges[0]
        .translation.p_value
        for views in (4, 10, 1000)
    ]
    assert p_values[0] > 2 * p_values[1]
    assert p_values[1] > 1.5 * p_values[2]
    # Very many views: chi-square of 12.5 with three degrees of freedom, by its table 0.00585.
    assert p_values[2] == pytest.approx(0.00585, rel=0.02)


def test_a_calibration_does_not_differ_from_itself():
    calibration = made_up(4).calibration
    comparison = compare(calibration, calibration)
    assert comparison.same_session
    assert comparison.is_equal
    assert not comparison.is_change
    assert "share its noise" in comparison.findings[0]
    # Exact data has no spread: rounding is no change either.
    exact = with_edge(np.eye(4), np.zeros((6, 6)))
    rounded = with_edge(exp(np.full(6, 1e-13)), np.zeros((6, 6)))
    assert not compare(exact, rounded).is_change


def test_command_prints_to_stdout_and_ends_well_either_way(tmp_path):
    first, second = pair("eye-in-hand")
    first.save(tmp_path / "calibration.json")
    bumped = calibration_of(moved(cells("eye-in-hand")[1], camera=2e-3 * SHIFT))
    bumped.save(tmp_path / "moved.json")
    second.save(tmp_path / "same.json")
    for name, words in (("same", "No transform changed"), ("moved", "The camera moved")):
        done = visioncal("diff", tmp_path, tmp_path / f"{name}.json").good()
        assert done.err == ""
        assert words in done.out
    printed = visioncal("diff", tmp_path, tmp_path / "moved.json", "--json").out
    files = (Calibration.load(tmp_path), Calibration.load(tmp_path / "moved.json"))
    assert json.loads(printed) == to_document(compare(*files))
    assert "null" not in printed
    assert json.loads(printed)["transforms"]["flange_from_cam"]["translation"]["limit"] == (
        FALSE_ALARMS / 5
    )
