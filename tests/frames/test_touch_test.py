"""The touch test: what the camera locates, touched by a simulated arm that knows the truth."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.pages import Page
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.frames.touch_test import (
    evaluate_gaps,
    flange_extent_m,
    touch_targets,
    touch_test_finding,
)
from visioncal.frames.touches import Tool
from visioncal.interchange.result_files import rewrite_result
from visioncal.results import Calibration, Edge
from visioncal.results.frame import Frame
from visioncal.robot.collision import camera_body
from visioncal.session import Session
from visioncal.simulation import CellOptions, cell_session, simulate, write_session
from visioncal.vision.targets import corner_positions

# Longer than the camera reaches beyond the flange.
GAUGE = ("--tool", "none", "--clearance-mm", 150)
CELL = replace(CellOptions(), views=12, seed=21)


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    """A calibrated cell, new images of its board, and where its corners really are."""
    folder = tmp_path_factory.mktemp("touched")
    session = write_session(simulate(CELL), folder / "session")
    assert visioncal("calibrate", session, "-o", folder / "out").status == 0
    later = simulate(replace(CELL, views=3, recording=1))
    look = write_session(later, folder / "look")
    place = later.transforms["base_from_target"]
    corners = corner_positions(CELL.target) @ place[:3, :3].T + place[:3, 3]
    return folder, look, corners


@pytest.fixture(scope="module")
def known(proved):
    return Calibration.load(proved[0] / "out")


@pytest.fixture(scope="module")
def located(proved, known):
    """The points to touch by a gauge of 150 mm, longer than the camera on the flange reaches."""
    return touch_targets(Session.load(proved[1]), known, clearance_m=0.15)


def test_the_tip_comes_as_near_as_predicted(proved, located):
    corners, points = proved[2], located.points
    assert len(points) == 5
    away_mm = [
        1e3 * np.linalg.norm(point.base_m - corners[int(point.name.split()[1])]) for point in points
    ]
    # A ball of 95 % holds five points that share the camera's error, nineteen times of twenty.
    assert max(away_mm) < max(point.radius95_mm for point in points)
    for point in points:
        # The gauge stands on the point, the flange's z into the board; above it, along that z.
        tip_m = (point.base_from_flange @ [0.0, 0.0, 0.15, 1.0])[:3]
        np.testing.assert_allclose(tip_m, point.base_m)
        step = invert(point.base_from_flange) @ located.above(point, 0.05)
        np.testing.assert_allclose(step[:3, 3], [0.0, 0.0, -0.05], atol=1e-12)
    assert evaluate_gaps(points, away_mm).passed
    assert not evaluate_gaps(points, [5.0] * 5).passed
    raised(DataError, "5 of 0 mm and more", evaluate_gaps, points, [0.1])


def test_no_target_brings_what_the_flange_carries_into_the_board(proved, known):
    look = Session.load(proved[1])
    extent_m, flange_from_cam = flange_extent_m(known), known.transforms["flange_from_cam"]
    box_m = camera_body(0, flange_from_cam.as_matrix()).corners()
    corners_m, lens_m = np.vstack([np.zeros(3), box_m]), flange_from_cam.translation[2]
    # The lens, and what is before its centre: the box of a camera is 0.1 m long, 0.03 behind it.
    assert lens_m < extent_m < lens_m + 0.1
    raised(DataError, "which tool touches is not known", touch_targets, look, known)
    for clearance_m in (0.0, extent_m - 1e-3):
        with pytest.raises(DataError, match="would be in the board"):
            touch_targets(look, known, clearance_m=clearance_m)
    short = Edge(compose(np.eye(3), np.array([0.0, 0.0, 0.5 * extent_m])), np.zeros((6, 6)))
    with pytest.raises(DataError, match="would be in the board"):
        touch_targets(look, known, Tool("flange_from_stub", short, True, known.verdict))
    lowest = touch_targets(look, known, clearance_m=extent_m)
    board = lowest.board.edge.matrix
    for point in lowest.points:
        flange = point.base_from_flange
        carried_m = corners_m @ flange[:3, :3].T + flange[:3, 3]
        heights_m = (board[:3, 3] - carried_m) @ board[:3, 2]
        # By rounding alone is anything in the board.
        assert heights_m.min() > -1e-9


@pytest.mark.parametrize(("ratio", "passed"), [(1.2, True), (2.0, False), (200.0, False)])
def test_one_gap_may_exceed_its_prediction_by_chance_but_not_by_much(located, ratio, passed):
    points = located.points
    gaps_mm = [0.1, 0.1, 0.1, ratio * points[3].radius95_mm, 0.1]
    test = evaluate_gaps(points, gaps_mm)
    assert test.passed == passed
    assert (f"The gap at {points[3].name} (" in touch_test_finding(test).words) != passed


def test_targets_are_printed_and_gaps_join_the_result(proved):
    folder, look, _ = proved
    out = folder / "out"
    done = visioncal("touch-test", look, "-c", out, *GAUGE).good()
    assert done.out.count("hover:") == done.out.count("touch:") == 5
    targets = json.loads(visioncal("touch-test", look, "-c", out, *GAUGE, "--json").out)["points"]
    lifted = np.array(targets[0]["hover"][:3]) - targets[0]["touch"][:3]
    assert np.linalg.norm(lifted) == pytest.approx(0.05)
    visioncal("touch-test", look, "-c", out, *GAUGE, "--gaps-mm", "0.1,0,0.1,0.1,0.05").good()
    known = Calibration.load(out)
    assert known.touch_test.passed
    assert [point.gap_mm for point in known.touch_test.points] == [0.1, 0.0, 0.1, 0.1, 0.05]
    words = Page((out / "report.html").read_text("utf-8")).words
    assert "Touch test Passed, with flange" in words

    done = visioncal("touch-test", look, "-c", out, *GAUGE, "--gaps-mm", "3,3,3,3,3")
    assert done.status == 3
    assert "Measure the tool's tip anew" in done.out
    assert not Calibration.load(out).touch_test.passed
    visioncal("touch-test", look, "-c", out, "--tool", "gripper").refused(
        "the calibration has no tool", f"visioncal tcp TOUCHES -c {out} --name gripper"
    )


def test_points_out_of_reach_of_a_calibrated_arm_are_refused(tmp_path):
    options = replace(CELL, views=25, offset_sigma_rad=1e-3, branches=True)
    for name, each in (("fit", options), ("look", replace(options, views=3, recording=1))):
        cell_session(simulate(each), name, seen="corners").save(tmp_path / name)
    visioncal("calibrate", tmp_path / "fit", "-o", tmp_path / "out", "--no-report").good()
    words = ("touch-test", tmp_path / "look", "-c", tmp_path / "out", *GAUGE, "--height-mm")
    assert visioncal(*words, 50).status == 0
    # A metre above a board that lies 0.7 m beside the base, an arm of 1.3 m cannot hover.
    visioncal(*words, 1000).refused("is out of reach within the joints' limits")


def test_what_touches_is_the_only_tool_or_the_flange(proved):
    folder, look, _ = proved
    known = Calibration.load(folder / "out")
    grip = compose(np.eye(3), np.array([0.0, 0.0, 0.12]))
    edge = Edge(grip, np.diag([1e-6] * 3 + [1e-9] * 3))
    tool = Frame(edge, True, "stated", "", known.created, 0.0, 0.0, (), known.verdict)
    held = folder / "held"
    shutil.copytree(folder / "out", held)
    rewrite_result(held, replace(known, frames={"flange_from_grip": tool}))

    def first(*said):
        done = visioncal("touch-test", look, "-c", held, "--json", *said)
        return np.array(json.loads(done.out)["points"][0]["touch"][:3])

    # The flange stays behind by the tool's length.
    assert np.linalg.norm(first() - first(*GAUGE)) == pytest.approx(0.03)
    np.testing.assert_array_equal(first(), first("--tool", "grip"))
    refused = visioncal("touch-test", look, "-c", held, "--tool", "grib")
    assert "no tool 'grib'; it has flange_from_grip" in refused.err
