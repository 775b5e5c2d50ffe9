"""Tools and fixtures placed by what images show: the frame, what is left out, what is refused."""

import re
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from support.cells import exact
from support.imaged import Shot, calibrated_cell, session_of, shots
from support.marks import seeds
from support.misfits import misfit
from support.picks import calibration_of, really, seen_corners
from support.refusals import raised
from support.slopes import twists

from visioncal.core.errors import DataError
from visioncal.core.limits import ImageFrameLimits
from visioncal.core.transforms import compose, exp, invert, skew
from visioncal.core.types import Target
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.frame_from_images import depends_on_camera, seen_frame
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.frames.target_pose import Sight, candidate_places, place_seen
from visioncal.results import Verdict
from visioncal.robot import load_robot
from visioncal.session import MemoryImages
from visioncal.simulation import BOARDS, CellOptions, simulate
from visioncal.vision.camera import intrinsics, with_intrinsics

BOARD = BOARDS["charuco"]
MARKER = Target("marker", "marker", 1, 1, 0.03, 3e-5, dictionary="DICT_5X5_100", marker_id=3)
IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"


def cell_of(mount, **options):
    return simulate(CellOptions(mount=mount, **{"views": 12, "pixel_sigma_px": 0.1} | options))


@lru_cache
def calibrated(mount, seed):
    made = cell_of(mount, seed=seed)
    return made, calibration_of(made)


@pytest.fixture(scope="module", params=[IN_HAND, TO_HAND])
def cell(request):
    return calibrated(request.param, 2)


def place_of(cell, parent, rng):
    """A place (4, 4) in the parent where the camera sees the target about as at calibration."""
    x, z = cell.transforms.values()
    near = exp(rng.normal(0.0, np.repeat([0.05, 0.005], 3)))
    if (cell.options.mount == IN_HAND) == (parent == "base"):
        return z @ near
    return x @ cell.cam_from_target[1] @ near


def sights_of(cell, parent, place, rng, count=6, target=BOARD):
    """Images of a target that sits at a place of the parent, at stops of the calibration."""
    x, sights = next(iter(cell.transforms.values())), []
    for at in range(count):
        reported = cell.robot.base_from_flange[at]
        flange = really(cell, reported, rng)
        base_from_cam = flange @ x if cell.options.mount == IN_HAND else x
        base_from_target = flange @ place if parent == "flange" else place
        corners = seen_corners(cell, invert(base_from_cam) @ base_from_target, target, rng)
        sights.append(Sight(f"image {at}", corners, reported))
    return sights


@pytest.mark.slow
@pytest.mark.parametrize(("mount", "parent"), [(IN_HAND, "base"), (TO_HAND, "flange")])
def test_jacobians_of_a_sight_agree_with_central_differences(mount, parent):
    cell = simulate(exact(CellOptions(mount=mount, views=8, seed=1)))
    eye, rng = CalibratedCamera.of(calibration_of(cell)), np.random.default_rng(0)
    place = place_of(cell, parent, rng)
    (sight,) = sights_of(cell, parent, place, rng, count=1)

    def placed(eye=eye, sight=sight, target=BOARD):
        seen = target_pose_candidates(eye, sight.seen, target, "image", 0.1)
        return candidate_places(eye, sight, seen, parent)[0]

    def with_step(by):
        step = by * steps
        camera = with_intrinsics(eye.camera, intrinsics(eye.camera) + step[6:])
        edge = eye.edge @ exp(step[:6])
        return placed(replace(eye, edge=edge, lens=replace(eye.lens, camera=camera))).matrix

    def of_size(by):
        return placed(target=replace(BOARD, square_m=BOARD.square_m * (1 + by[0]))).matrix

    def standing(twist):
        flange = sight.base_from_flange @ exp(twist)
        return placed(sight=replace(sight, base_from_flange=flange)).matrix

    sighted = placed()
    np.testing.assert_allclose(sighted.matrix, place, atol=1e-8)
    steps = 1e-2 * np.array([*[1e-3] * 6, *[1.0] * 4, *[1e-3] * 5])
    # The fit of a pose stops at steps of 1e-6, whose next ones are a hundred times smaller.
    moved = twists(with_step, 15, 1.0)
    np.testing.assert_allclose(sighted.by_common[:, :15] * steps, moved, atol=3e-8)
    by_size = sighted.by_common[:, len(eye.covariance)]
    np.testing.assert_allclose(by_size, twists(of_size, 1, 1e-4)[:, 0], atol=1e-4)
    np.testing.assert_allclose(sighted.flange_jacobian, twists(standing, 6, 1e-4), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("draws", seeds(2, 5))
def test_places_follow_their_stated_covariance(draws):
    surprises = []
    for seed in draws:
        cell, calibration = calibrated(IN_HAND, seed)
        rng = np.random.default_rng(seed)
        place = place_of(cell, "base", rng)
        found = place_seen(calibration, sights_of(cell, "base", place, rng), BOARD, "base")
        assert found.inliers.all()
        surprises.append(misfit(found, place) / 6)
    # Five of six degrees of freedom: sqrt(2 / 30) = 0.26; the target is of the exact size, which
    # counts as known to 0.1 %, and takes one of the six.
    assert 0.4 < np.mean(surprises) < 2.0


@pytest.mark.parametrize("draws", seeds(3, 8))
def test_views_from_several_sides_show_the_size_of_a_target(draws):
    surprises, sigmas = [], []
    for seed in draws:
        cell, calibration = calibrated(IN_HAND, seed % 4)
        rng = np.random.default_rng(seed)
        # As unsure as a label that is measured with a ruler.
        stated = replace(BOARD, square_sigma_m=3e-3 * BOARD.square_m)
        true = replace(stated, square_m=BOARD.square_m + stated.square_sigma_m * rng.normal())
        place = place_of(cell, "base", rng)
        found = place_seen(
            calibration, sights_of(cell, "base", place, rng, 8, true), stated, "base"
        )
        surprises.append(misfit(found, place) / 6)
        sigmas.append(found.edge.sigma_mm)
    # At 0.6 m, the size alone would leave 1.8 mm in an image.
    assert np.median(sigmas) < 0.2
    # Of 48 degrees of freedom: sqrt(2 / 48) = 0.2; of 18 they are two sigma.
    assert 0.5 < np.mean(surprises) < 1.6


@pytest.mark.parametrize("share", [0.01, -0.008])
def test_a_board_of_another_size_than_stated_is_named_by_images_from_several_sides(share):
    cell, calibration = calibrated(IN_HAND, 0)
    rng = np.random.default_rng(3)
    place, side = place_of(cell, "base", rng), BOARD.square_m * (1 + share)
    sights = sights_of(cell, "base", place, rng, 8, replace(BOARD, square_m=side))
    words = place_seen(calibration, sights, BOARD, "base").warnings[0]
    found = re.search(r"the board is ([\d.]+) % (larger|smaller) than stated", words)
    sign = {"larger": 0.01, "smaller": -0.01}[found[2]]
    # Eight images at half a metre place the board to 0.1 mm each, 0.01 % of their distance.
    assert sign * float(found[1]) == pytest.approx(share, abs=3e-4)
    moved = sights_of(cell, "base", place, rng, 8)
    # A fixture that was moved between the images is of no other size.
    moved[:4] = sights_of(cell, "base", place @ exp(np.array([0, 0, 0.01, 0.01, 0, 0])), rng, 4)
    found = place_seen(calibration, moved, BOARD, "base")
    assert found.warnings
    assert not any("if the board" in warning for warning in found.warnings)


def test_an_error_of_all_images_is_no_scatter_and_one_of_a_single_image_leaves_it_out():
    cell, calibration = calibrated(IN_HAND, 0)
    rng, name = np.random.default_rng(0), "flange_from_cam"
    place, edge = place_of(cell, "base", rng), calibration.edges[name]
    sights = sights_of(cell, "base", place, rng)
    # The camera is off by what its transform allows: by 3 mm or 1 mm, otherwise at every stop.
    for off in np.outer([1.0, 0.3], [4e-3, -3e-3, 5e-3, 2e-3, 1e-3, -2e-3]):
        covariance = edge.covariance + np.diag(off**2)
        unsure = replace(edge, matrix=edge.matrix @ exp(off), covariance=covariance)
        loose = replace(calibration, edges={**calibration.edges, name: unsure})
        found = place_seen(loose, sights, BOARD, "base")
        assert found.away_mm.max() > 1.0
        assert found.inliers.all()
        assert found.scatter == 1.0
    # Levels of noise that are known by eight degrees of freedom put the limit at 11 sigma, 0.4 mm;
    # an image that is not yet left out widens it by what the six scatter.
    for off_mm, agrees in ((0.45, True), (0.7, False)):
        moved = sights[2].base_from_flange @ exp(np.array([0.0, 0.0, 0.0, 1e-3 * off_mm, 0.0, 0.0]))
        others = [*sights[:2], replace(sights[2], base_from_flange=moved), *sights[3:]]
        assert place_seen(calibration, others, BOARD, "base").inliers[2] == agrees


def test_images_of_one_stop_share_the_robots_error(cell):
    made, calibration = cell
    parent = "base" if made.options.mount == IN_HAND else "flange"
    rng = np.random.default_rng(9)
    (sight,) = sights_of(made, parent, place_of(made, parent, rng), rng, count=1)
    eye = CalibratedCamera.of(calibration)
    (place, *_) = candidate_places(
        eye, sight, target_pose_candidates(eye, sight.seen, BOARD, "image", 0.1), parent
    )
    robot = place.flange_jacobian @ eye.flange_noise @ place.flange_jacobian.T
    same = [replace(sight, label=f"image {at}") for at in range(4)]
    found = place_seen(calibration, same, BOARD, parent, sigma_px=0.1)
    # The pixels' noise is averaged, that of the one stop is not.
    np.testing.assert_allclose(found.independent, place.pixels / 4 + robot, rtol=1e-6, atol=1e-20)
    assert "of one stop of the robot" in found.warnings[0]
    # Poses that were read anew differ a little: the stop's number tells that it is one.
    moved = sight.base_from_flange @ exp(np.full(6, 1e-6))
    numbered = [replace(value, stop=5) for value in same[:3]]
    numbered.append(replace(same[3], base_from_flange=moved, stop=5))
    found = place_seen(calibration, numbered, BOARD, parent, sigma_px=0.1)
    # To the share of a micrometre in a lever of half a metre.
    np.testing.assert_allclose(found.independent, place.pixels / 4 + robot, rtol=1e-4, atol=1e-16)


def test_a_marker_seen_flat_on_may_be_tilted_the_other_way():
    cell = cell_of(TO_HAND, seed=6, pixel_sigma_px=0.3, views=8)
    calibration, rng = calibration_of(cell), np.random.default_rng(6)
    x = cell.transforms["base_from_cam"]
    turn = exp(np.array([0.15, 0.1, 0.0, 0.0, 0.0, 0.0]))[:3, :3]
    place = x @ compose(turn, np.array([0.0, 0.0, 0.9]))
    sight = Sight("flat", seen_corners(cell, invert(x) @ place, MARKER, rng))
    flat = place_seen(calibration, [sight], MARKER, "base")
    assert any("tilted the other way" in warning for warning in flat.warnings)


def test_a_symmetric_board_may_be_turned(cell):
    made, calibration = cell
    parent = "base" if made.options.mount == IN_HAND else "flange"
    board = replace(BOARDS["checkerboard"], columns=7, rows=5)
    rng = np.random.default_rng(7)
    place = place_of(made, parent, rng)
    sights = sights_of(made, parent, place, rng, 3, board)
    turned = sights[1].seen
    last = board.columns * board.rows - 1
    # A detector begins at either end.
    sights[1] = replace(
        sights[1], seen=replace(turned, ids=last - turned.ids[::-1], px=turned.px[::-1])
    )
    found = place_seen(calibration, sights, board, parent)
    assert found.inliers.all()
    assert any("the same when it is turned" in warning for warning in found.warnings)
    # The first image's numbering is kept.
    assert 1e3 * np.linalg.norm((invert(place) @ found.matrix)[:3, 3]) < 3.0


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
    # Six degrees of freedom at 99.9 %: 22.5. The board has its exact size, which only helps.
    assert misfit(frame.edge, true_place(mount, kind)) < 22.5
    assert frame.edge.sigma_mm < 1.0
    assert frame.oriented
    assert frame.verdict.status == "good", frame.verdict.reasons
    assert frame.method == "ChArUco board charuco_9x6_30mm seen in 5 images"
    assert [int(observation.name) for observation in frame.observations] == [*range(30, 35)]
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
    assert misfit(frame.edge, true_place(IN_HAND, "fixture")) < 22.5


def test_images_of_other_poses_precede_the_sigmas_that_follow_of_them():
    cell, calibration = calibrated_cell(IN_HAND)
    rows = shots(cell, 4)
    others = [replace(row, base_from_flange=cell.robot.base_from_flange[at])
              for row, at in zip(rows, (9, 3, 1, 7), strict=True)]  # fmt: skip
    verdict = seen_frame(session_of(cell, others), calibration, "fixture").verdict
    assert verdict.status == "bad"
    assert "images disagree" in verdict.findings[0].words
    assert verdict.next_steps[0].command == "visioncal doctor SESSION"


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
    (words,) = (reason for reason in frame.verdict.reasons if "views were not used" in reason)
    assert words.startswith("3 of 7 views")


def test_one_image_or_one_stop_is_no_check():
    cell, calibration = calibrated_cell(IN_HAND)
    single = seen_frame(session_of(cell, shots(cell, 1)), calibration, "fixture")
    assert single.verdict.status == "check"
    assert "nothing checks it" in single.verdict.reasons[0]
    assert single.noise_mm > 0.0
    same = seen_frame(session_of(cell, [shots(cell, 1)[0]] * 4), calibration, "fixture")
    assert "of one stop of the robot" in same.verdict.reasons[0]
    moved = [
        replace(shots(cell, 1)[0], base_from_flange=value)
        for value in cell.robot.base_from_flange[:4]
    ]
    numbered = session_of(cell, shots(cell, 4), stop=["1", "1", "2", "2"])
    raised(DataError, "the rows of stop 1", seen_frame, numbered, calibration, "fixture")
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
    caught = raised(DataError, on, seen_frame, session_of(cell, shots(cell, 4)), calibration, kind)
    assert command in caught.next_step


def test_sessions_of_another_camera_are_refused():
    cell, calibration = calibrated_cell(IN_HAND)
    session = session_of(cell, shots(cell, 2))
    other = replace(session, document={**session.document, "mount": TO_HAND})
    with pytest.raises(DataError, match=r"eye-to-hand, and the calibration .* eye-in-hand"):
        seen_frame(other, calibration, "fixture")
    small = replace(calibration.camera.camera, resolution=(640, 400))
    camera = replace(calibration.camera, camera=small)
    with pytest.raises(DataError, match="1280 x 800 pixels, and the calibrated camera has 640"):
        seen_frame(session, replace(calibration, camera=camera), "fixture")
    with pytest.raises(DataError, match="holds no camera"):
        seen_frame(session, replace(calibration, camera=None), "fixture")
    held = session_of(cell, shots(cell, 2), role=["holdout"] * 2)
    caught = raised(DataError, "no view of 0 serves", seen_frame, held, calibration, "fixture")
    assert "role = holdout" in caught.next_step
    other = replace(session, robot_document=dict(load_robot("ur3e").document))
    raised(DataError, "another robot, or another tip", seen_frame, other, calibration, "fixture")
    with pytest.raises(DataError, match="names no target"):
        seen_frame(replace(session, target=None), calibration, "fixture")
    raised(DataError, "millimetres", seen_frame, session, calibration, "fixture", (0.0, 0.0, 120.0))


def test_doubts_of_calibration_and_sigma_are_reported():
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
    assert "from other sides" in frame.verdict.reasons[0]
    # A fixed camera sees a fixture from one side only: the board's size, known to 0.1 %, counts.
    cell, calibration = calibrated_cell(TO_HAND)
    session = session_of(cell, rows_of(TO_HAND, "fixture", 3))
    frame = seen_frame(session, calibration, "fixture", options=strict)
    assert "more images do not" in frame.verdict.reasons[0]
