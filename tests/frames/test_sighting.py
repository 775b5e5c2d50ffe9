"""Tools and fixtures from a session's images: the frame, what is left out, what is refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.imaged import Shot, calibrated_cell, session_of, shots
from support.plates import CENTRES, CLEAR, marked_plate, plate_session

from visioncal.core.errors import DataError
from visioncal.core.limits import ImageFrameLimits
from visioncal.core.transforms import invert, log, skew
from visioncal.frames.fixture_from_markers import fixture_from_marker_images
from visioncal.frames.frame_from_images import depends_on_camera, seen_frame
from visioncal.frames.touches import NominalPoints
from visioncal.results import Verdict
from visioncal.robot import load_robot
from visioncal.session import MemoryImages

IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
VIEWS = 5


def true_place(mount, kind):
    """Where the board really is: of the pictures of `rows`."""
    cell = calibrated_cell(mount)[0]
    x, z = cell.transforms.values()
    moves = (mount == IN_HAND) == (kind == "fixture")
    return z if moves else x @ cell.cam_from_target[0]


def rows_of(mount, kind, count=VIEWS):
    """Pictures of a board on the tool or on the fixture.

    Where neither camera nor board moves against the parent, all pictures are one and the same, at
    whatever pose of the robot.
    """
    rows = shots(calibrated_cell(mount)[0], count)
    moves = (mount == IN_HAND) == (kind == "fixture")
    return rows if moves else [replace(row, picture=0) for row in rows]


@pytest.mark.parametrize("kind", ["tool", "fixture"])
@pytest.mark.parametrize("mount", [IN_HAND, TO_HAND])
def test_a_board_in_images_is_where_it_stands(mount, kind):
    cell, calibration = calibrated_cell(mount)
    frame = seen_frame(session_of(cell, rows_of(mount, kind)), calibration, kind)
    error = log(invert(true_place(mount, kind)) @ frame.edge.matrix)
    # Six degrees of freedom at 99.9 %: 22.5. The board has its exact size, which only helps.
    assert error @ np.linalg.solve(frame.edge.covariance, error) < 22.5
    assert frame.edge.sigma_mm < 1.0
    assert frame.oriented
    assert frame.verdict.status == "good", frame.verdict.reasons
    assert frame.method == "ChArUco board charuco_9x6_30mm seen in 5 images"
    assert [observation.name for observation in frame.observations] == [
        "30",
        "31",
        "32",
        "33",
        "34",
    ]
    assert all(observation.used and not observation.reason for observation in frame.observations)
    assert frame.source == "the part"
    assert depends_on_camera(frame)
    assert frame.details["camera_calibrated"] == calibration.created


def test_the_tools_point_may_lie_beside_the_board():
    cell, calibration = calibrated_cell(TO_HAND)
    session, point = session_of(cell, rows_of(TO_HAND, "tool")), np.array([0.1, -0.05, 0.2])
    board = seen_frame(session, calibration, "tool").edge
    tip = seen_frame(session, calibration, "tool", point).edge
    turn = board.matrix[:3, :3]
    np.testing.assert_allclose(tip.matrix[:3, :3], turn, atol=1e-12)
    np.testing.assert_allclose(tip.matrix[:3, 3], turn @ point + board.matrix[:3, 3], atol=1e-12)
    # What the flange sees of the point's error, by either of the two frames.
    by_board = turn @ np.hstack([-skew(point), np.eye(3)])
    expected = by_board @ board.covariance @ by_board.T
    np.testing.assert_allclose(turn @ tip.covariance[3:, 3:] @ turn.T, expected, atol=1e-15)


def test_a_moved_board_is_left_out_and_named():
    cell, calibration = calibrated_cell(IN_HAND)
    rows = shots(cell, 6)
    rows[2] = replace(rows[2], base_from_flange=cell.robot.base_from_flange[9])
    frame = seen_frame(session_of(cell, rows), calibration, "fixture")
    wrong = frame.observations[2]
    assert not wrong.used
    assert "from where the others do" in wrong.reason
    assert wrong.residual_mm > 10.0
    assert sum(observation.used for observation in frame.observations) == 5
    assert frame.verdict.status == "check"
    assert frame.verdict.reasons[0].startswith("view 32 puts the target")
    error = log(invert(true_place(IN_HAND, "fixture")) @ frame.edge.matrix)
    assert error @ np.linalg.solve(frame.edge.covariance, error) < 22.5


def test_views_that_show_nothing_are_named():
    cell, calibration = calibrated_cell(IN_HAND)
    session = session_of(cell, [*shots(cell, 6), Shot(6, None)], role=[""] * 5 + ["holdout", ""])
    empty = cv2.imencode(".png", np.full((800, 1280), 128, np.uint8))[1].tobytes()
    files = {f"{at}.png": session.images.read(f"{at}.png") for at in (0, 1, 2, 5, 6)}
    session = replace(session, images=MemoryImages(files | {"3.png": empty}))
    frame = seen_frame(session, calibration, "fixture")
    reasons = {
        observation.name: observation.reason
        for observation in frame.observations
        if not observation.used
    }
    assert reasons.keys() == {"33", "34", "35", "36"}
    assert "uniform" in reasons["33"]
    assert reasons["34"] == "4.png is missing"
    assert "role = holdout" in reasons["35"]
    assert "no pose of the robot" in reasons["36"]
    # What is held back on purpose is no loss.
    (told,) = (reason for reason in frame.verdict.reasons if "views were not used" in reason)
    assert told.startswith("3 of 7 views")


def test_one_image_or_one_stop_checks_nothing():
    cell, calibration = calibrated_cell(IN_HAND)
    alone = seen_frame(session_of(cell, shots(cell, 1)), calibration, "fixture")
    assert alone.verdict.status == "check"
    assert "nothing checks it" in alone.verdict.reasons[0]
    assert alone.noise_mm > 0.0
    same = seen_frame(session_of(cell, [shots(cell, 1)[0]] * 4), calibration, "fixture")
    assert "of one stop of the robot" in same.verdict.reasons[0]
    moved = [
        replace(shots(cell, 1)[0], base_from_flange=value)
        for value in cell.robot.base_from_flange[:4]
    ]
    numbered = session_of(cell, shots(cell, 4), stop=["1", "1", "2", "2"])
    with pytest.raises(DataError, match="the rows of stop 1"):
        seen_frame(numbered, calibration, "fixture")
    # A tool before a camera on the flange: the robot has no part in it.
    tool = seen_frame(session_of(cell, moved), calibration, "tool")
    assert tool.verdict.status == "good"


def test_joints_lead_to_the_flange_where_poses_are_missing():
    cell, calibration = calibrated_cell(IN_HAND)
    robot = load_robot("ur10e")
    columns = {
        f"q{at + 1}_rad": [repr(float(q[at])) for q in cell.robot.joints[:3]] for at in range(6)
    }
    session = session_of(cell, [Shot(at, None) for at in range(3)], **columns)
    known = replace(calibration, robot=robot)
    by_joints = seen_frame(session, known, "fixture")
    by_poses = seen_frame(session_of(cell, shots(cell, 3)), known, "fixture")
    # The simulation's arm and the model agree to the rounding of their tables.
    np.testing.assert_allclose(by_joints.edge.matrix, by_poses.edge.matrix, atol=1e-8)
    with pytest.raises(DataError, match="no view of 3 serves") as caught:
        seen_frame(session, replace(calibration, robot=None), "fixture")
    assert "no known robot" in caught.value.culprits[0]


@pytest.mark.parametrize(
    ("mount", "kind", "on", "command"),
    [
        (IN_HAND, "tool", "on a fixture", "visioncal fixture"),
        (TO_HAND, "fixture", "on a tool", "visioncal tcp"),
    ],
)
def test_a_board_that_is_elsewhere_is_refused(mount, kind, on, command):
    cell, calibration = calibrated_cell(mount)
    with pytest.raises(DataError, match=on) as caught:
        seen_frame(session_of(cell, shots(cell, 4)), calibration, kind)
    assert command in caught.value.next_step


def test_sessions_of_another_camera_are_refused():
    cell, calibration = calibrated_cell(IN_HAND)
    session = session_of(cell, shots(cell, 2))
    other = replace(session, document={**session.document, "mount": TO_HAND})
    with pytest.raises(DataError, match=r"eye-to-hand, and the calibration .* eye-in-hand"):
        seen_frame(other, calibration, "fixture")
    camera = replace(calibration.camera, camera=replace(CLEAR, resolution=(640, 400)))
    with pytest.raises(DataError, match="1280 x 800 pixels, and the calibrated camera has 640"):
        seen_frame(session, replace(calibration, camera=camera), "fixture")
    with pytest.raises(DataError, match="holds no camera"):
        seen_frame(session, replace(calibration, camera=None), "fixture")
    held = session_of(cell, shots(cell, 2), role=["holdout"] * 2)
    with pytest.raises(DataError, match="no view of 0 serves") as caught:
        seen_frame(held, calibration, "fixture")
    assert "role = holdout" in caught.value.next_step
    other = replace(session, robot_document=dict(load_robot("ur3e").document))
    with pytest.raises(DataError, match="another robot, or another tip"):
        seen_frame(other, calibration, "fixture")
    with pytest.raises(DataError, match="names no target"):
        seen_frame(replace(session, target=None), calibration, "fixture")
    with pytest.raises(DataError, match="millimetres"):
        seen_frame(session, calibration, "fixture", (0.0, 0.0, 120.0))


def test_doubts_of_calibration_and_sigma_are_told():
    cell, calibration = calibrated_cell(IN_HAND)
    session = session_of(cell, shots(cell, 3))
    bad = replace(calibration, verdict=Verdict.of("bad", "The views disagree."))
    frame = seen_frame(session, bad, "fixture")
    assert frame.verdict.status == "bad"
    assert "The views disagree." in frame.verdict.reasons[0]
    other = {**session.document["camera"], "matrix": [600.0, 600.0, 640.0, 400.0]}
    other["distortion"] = [0.0] * 5
    stated = replace(session, document={**session.document, "camera": other})
    frame = seen_frame(stated, calibration, "fixture")
    assert any("fx 600" in reason and "same camera?" in reason for reason in frame.verdict.reasons)
    strict = ImageFrameLimits(sigma_mm=(1e-3, 10.0))
    frame = seen_frame(session, calibration, "fixture", options=strict)
    assert frame.verdict.status == "check"
    # The board's size, known to 0.1 %, is what most of it is from.
    assert "more images do not" in frame.verdict.reasons[0]


@pytest.fixture(scope="module")
def plate():
    return marked_plate()


def drawing(places):
    positions = np.array([[x, y, 0.0] for x, y in places.values()])
    return NominalPoints("plate.csv", tuple(map(str, places)), positions, np.zeros(len(places)))


def test_markers_place_a_fixture_by_its_drawing(plate):
    calibration, base_from_plate, sights = plate
    spare = {**CENTRES, 44: (0.0, 0.2)}
    frame = fixture_from_marker_images(plate_session(sights), calibration, drawing(spare))
    error = log(invert(base_from_plate) @ frame.edge.matrix)
    # Six degrees of freedom at 99.9 %: 22.5. The calibration's own error is left out here.
    assert error @ np.linalg.solve(frame.edge.covariance, error) < 22.5
    assert {observation.name for observation in frame.observations} == {"0", "7", "21", "30"}
    assert frame.details["spare_points"] == ["44"]
    assert frame.details["seen_in"] == {"0": 4, "7": 4, "21": 4, "30": 4}
    assert depends_on_camera(frame)
    assert "4 points to plate.csv" in frame.method
    # What the markers share does not fall out of a fit to them.
    common = calibration.edges["flange_from_cam"].sigma_mm
    assert frame.edge.sigma_mm > 0.5 * common


def test_markers_that_do_not_fit_are_named(plate):
    calibration, _, sights = plate
    session = plate_session(sights)
    places = list(CENTRES.values())
    swapped = dict(zip(CENTRES, [places[1], places[0], *places[2:]], strict=True))
    with pytest.raises(DataError, match=r"in another order to .*0.*7"):
        fixture_from_marker_images(session, calibration, drawing(swapped))
    strangers = {0: places[0], 7: places[1], 50: (0.0, 0.0), 51: (0.1, 0.1)}
    with pytest.raises(DataError, match=r"2 drawn markers .*\(0, 7\).* not drawn \(21, 30\)"):
        fixture_from_marker_images(session, calibration, drawing(strangers))
    named = replace(drawing(CENTRES), names=("0", "7", "21", "hole"))
    with pytest.raises(DataError, match="point 'hole' is no marker's id"):
        fixture_from_marker_images(session, calibration, named)
    board = {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.03}
    with pytest.raises(DataError, match="a checkerboard; beside a drawing"):
        fixture_from_marker_images(plate_session(sights, board), calibration, drawing(CENTRES))
