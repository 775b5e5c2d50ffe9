"""The pick, and its proof: where a feature lies, what is open about that, and touches of it."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.beyond import an_error, moved, with_error, with_field
from support.cells import exact, session_of
from support.commands import visioncal
from support.imaged import Shot, calibrated_cell, picture, shots
from support.imaged import session_of as pictured
from support.later import ANYHOW, FITTED, lot
from support.pages import Page
from support.picks import before_camera, calibration_of, seen_corners, seen_point, stand
from support.refusals import raised
from support.samples import fixture_frame
from support.slopes import jacobian

from visioncal import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import Corners
from visioncal.frames.camera_chain import Plane
from visioncal.frames.locate import locate, locate_by_depth, locate_target
from visioncal.frames.located import Located
from visioncal.frames.touch_test import (
    evaluate_gaps,
    flange_extent_m,
    touch_targets,
    touch_test_finding,
)
from visioncal.frames.touches import Tool
from visioncal.interchange.result_files import rewrite_result
from visioncal.results import Calibration, Edge, FrameFile, Verdict, to_document
from visioncal.results.frame import Frame
from visioncal.robot.collision import camera_body
from visioncal.session import Session
from visioncal.simulation import BOARDS, CellOptions, cell_session, project, simulate, write_session
from visioncal.vision.targets import corner_positions

MOUNTS = ("eye-in-hand", "eye-to-hand")
BOARD = BOARDS["charuco"]


@pytest.fixture(scope="module", params=MOUNTS)
def exact_cell(request):
    cell = simulate(exact(CellOptions(mount=request.param, views=10, seed=3)))
    return cell, calibration_of(cell)


@pytest.fixture(scope="module")
def in_hand():
    cell = simulate(CellOptions(views=12, pixel_sigma_px=0.1, seed=5, state_intrinsics=False))
    return cell, calibration_of(cell)


def slopes(place, size=1, step=1e-3):
    """Central differences (size, 3) of a place, a function of steps."""
    return jacobian(lambda by: place(by).p_base, size, step).T


# Truncation is of second order in a step of a thousandth, relative; rounding is less. A lens that
# breathes by a thousandth moves with its centre and the distance by as much less.
PLAIN, BREATHING = 1e-4, 5e-3


def agrees(part, by, share=PLAIN):
    """A part of a covariance is that of these slopes."""
    np.testing.assert_allclose(part, by.T @ by, atol=share * np.sum(by**2))


@pytest.mark.parametrize("beyond", [False, True], ids=["model", "field"])
def test_jacobians_of_a_ray_agree_with_central_differences(exact_cell, beyond):
    (cell, calibration), rng = exact_cell, np.random.default_rng(0)
    calibration = with_field(calibration) if beyond else calibration
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    plane = Plane.through(-at.base_from_cam[:3, 2] + 0.3 * rng.standard_normal(3), place)
    error = an_error(calibration, 0)

    def found(calibration, px=px, **noise):
        return locate(calibration, px, plane, at.base_from_flange, **noise)[0]

    parts = found(with_error(calibration, error), sigma_px=1.0).parts
    by_error = slopes(lambda by: found(moved(calibration, by[0] * error)))
    agrees(parts["calibration"], by_error, BREATHING if beyond else PLAIN)
    by_px = slopes(lambda by: found(calibration, px + by), 2)
    # The field is taken for flat where a pixel errs: by up to 0.3 px in a fifth of 1280.
    apart = (1e-2 if beyond else 1e-5) * np.sum(by_px**2)
    np.testing.assert_allclose(parts["pixels"], by_px.T @ by_px, atol=apart)


def test_a_focus_that_varies_counts_on_planes_and_by_depth(exact_cell):
    (cell, calibration), rng, share = exact_cell, np.random.default_rng(2), 2e-3
    at, centre = stand(cell, rng), calibration.camera.camera.matrix[2:]
    place, px = seen_point(cell, at, rng)
    field = replace(with_field(calibration).camera.field, coefficients=np.zeros(0), jitter=share)
    field = replace(field, field_px=0.0, breathing=0.0, root=np.zeros((0, 0)))
    field = replace(
        field, intrinsics_covariance=np.zeros((0, 9)), edge_covariance=np.zeros((0, 12))
    )
    varying = replace(calibration, camera=replace(calibration.camera, field=field))
    depth_m = float((invert(at.base_from_cam) @ [*place, 1.0])[2])
    plane = Plane.through(at.base_from_cam[:3, 2], place)
    by_depth, on_plane = (
        lambda of, px: locate_by_depth(of, px, depth_m, at.base_from_flange)[0],
        lambda of, px: locate(of, px, plane, at.base_from_flange)[0],
    )
    for found in (by_depth, on_plane):
        by_focus = slopes(lambda by, of=found: of(calibration, centre + (1 + by) * (px - centre)))
        agrees(found(varying, px).parts["focus"] / share**2, by_focus)


@pytest.mark.parametrize("beyond", [False, True], ids=["model", "field"])
def test_jacobians_of_a_target_agree_with_central_differences(exact_cell, beyond):
    (cell, calibration), rng = exact_cell, np.random.default_rng(0)
    at, point = stand(cell, rng), np.array([0.1, 0.05, 0.02])
    corners = seen_corners(cell, before_camera(cell, BOARD, rng), BOARD, rng)
    if beyond:
        calibration = with_field(calibration)
        # What the field displaces is seen so.
        away = corners.px - calibration.camera.in_model(corners.px, 0.5)
        corners = replace(corners, px=corners.px + away)
    error = an_error(calibration, 0)

    def found(calibration, board=BOARD, **noise):
        return locate_target(calibration, corners, board, at.base_from_flange, point, **noise)

    # Corners that fit the pose exactly move it with the lens as the normal equations say.
    parts = found(with_error(calibration, error), sigma_px=0.1).parts
    by_error = slopes(lambda by: found(moved(calibration, by[0] * error)))
    agrees(parts["calibration"], by_error, BREATHING if beyond else PLAIN)

    def of_size(by):
        return found(calibration, replace(BOARD, square_m=(1 + by[0]) * BOARD.square_m))

    by_size = slopes(of_size)
    expected = (BOARD.square_sigma_m / BOARD.square_m) ** 2 * by_size.T @ by_size
    # Corners that a field of another distance displaced fit no pose exactly.
    share = 1e-2 if beyond else 1e-4
    np.testing.assert_allclose(parts["target"], expected, atol=share * np.trace(expected))


def test_the_robots_noise_at_the_stop_agrees_with_central_differences(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(1)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    plane = Plane.through(-at.base_from_cam[:3, 2], place)

    def found(twist):
        return locate(calibration, px, plane, at.base_from_flange @ exp(twist))[0]

    noise = calibration.noise
    sigma = [np.deg2rad(noise["robot_rotation_deg"]), 1e-3 * noise["robot_translation_mm"]]
    by_twist = np.repeat(sigma, 3)[:, None] * slopes(found, 6, 1e-4)
    # Truncation: 1e-4 squared, relative.
    agrees(found(np.zeros(6)).parts["robot"], by_twist, 1e-6)


def test_an_uncertain_frames_plane_agrees_with_central_differences(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(2)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    # The z axis of the fixture looks up to the camera, and the point lies 0.1 m beside its origin.
    turn = (at.base_from_cam @ exp(np.array([np.pi - 0.2, 0.1, 0.0, 0.0, 0.0, 0.0])))[:3, :3]
    fixture = compose(turn, place - turn @ np.array([0.1, -0.05, 0.02]))
    error = 1e-3 * rng.standard_normal(6)

    def found(edge):
        return locate(calibration, px, Plane.of_frame(edge, 0.02), at.base_from_flange)[0]

    by_error = slopes(lambda by: found(Edge(fixture @ exp(by[0] * error), np.zeros((6, 6)))))
    agrees(found(Edge(fixture, np.outer(error, error))).parts["plane"], by_error)


def test_exact_sights_give_exact_places(exact_cell):
    cell, calibration = exact_cell
    rng = np.random.default_rng(0)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    plane = Plane.horizontal(place[2]) if cell.options.mount == "eye-in-hand" else None
    plane = plane or Plane.through(np.array([1.0, 0.0, 0.2]), place)
    (found,) = locate(calibration, px, plane, at.base_from_flange)
    # The calibration of exact data is exact to 1e-9 m.
    np.testing.assert_allclose(found.p_base, place, atol=1e-8)
    cam_from_target = before_camera(cell, BOARD, rng)
    corners = seen_corners(cell, cam_from_target, BOARD, rng)
    centre = locate_target(calibration, corners, BOARD, at.base_from_flange)
    base_from_target = at.base_from_cam @ cam_from_target
    np.testing.assert_allclose(centre.p_base, base_from_target[:3, 3], atol=1e-8)


@pytest.mark.slow
def test_a_calibrated_arm_errs_by_what_its_calibration_left_open():
    point, surprises, shares = np.array([0.13, 0.09, 0.0]), [], []
    for seed in range(2):
        known = lot(replace(ANYHOW, seed=seed), 4)
        cell, calibration = known.cell, known.calibration
        base_from_target = cell.transforms["base_from_target"]
        truth = base_from_target[:3, :3] @ point + base_from_target[:3, 3]
        for at in range(FITTED, FITTED + 4):
            q = cell.robot.joints[at]
            look = (calibration, cell.corners[at], BOARD, calibration.standing(q[None])[0], point)
            by_pose, by_joints = locate_target(*look), locate_target(*look, joints_rad=q)
            assert "arm" in by_pose.budget_mm
            assert "arm" not in by_joints.budget_mm
            np.testing.assert_array_equal(by_joints.p_base, by_pose.p_base)
            shares.append(by_joints.budget_mm["total"] / by_pose.budget_mm["total"])
            error = by_joints.p_base - truth
            surprises.append(error @ np.linalg.solve(by_joints.covariance, error))
    # Chi-square of three degrees of freedom a cell, whose picks share its calibration: the mean of
    # two has a standard deviation of 1.7.
    assert np.mean(surprises) == pytest.approx(3.0, abs=3.4)
    assert np.median(shares) < 0.5


def test_a_place_states_the_sources_of_its_uncertainty():
    parts = {"pixels": np.diag([1e-8, 4e-8, 0.0]), "robot": np.diag([3e-8, 0.0, 0.0])}
    found = Located(np.zeros(3), parts, np.inf)
    np.testing.assert_allclose(found.sigma_mm, [0.2, 0.2, 0.0], atol=1e-12)
    assert found.budget_mm["total"] == pytest.approx(np.hypot(0.2, 0.2))
    assert found.budget_mm["robot"] == pytest.approx(1e3 * np.sqrt(3e-8))
    # Two directions of 0.2 mm: chi-square's 95 % quantile of two is 5.991.
    assert found.radius95_mm == pytest.approx(0.2 * np.sqrt(5.991), rel=1e-3)
    # With the noise from few residuals, the region is wider.
    assert Located(np.zeros(3), parts, 8.0).radius95_mm > 1.15 * found.radius95_mm


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("is_stated", [True, False], ids=["stated lens", "estimated lens"])
def test_the_budget_is_that_of_places_where_the_views_looked(mount, is_stated):
    options = CellOptions(mount=mount, views=10, state_intrinsics=is_stated, cut_views=0.0, seed=2)
    cell = simulate(options)
    calibration, corners = calibration_of(cell), corner_positions(BOARD)
    squares = []
    for at, pose in enumerate(cell.cam_from_target):
        px = project(options.camera, corners @ pose[:3, :3].T + pose[:3, 3])
        flange = None if mount == "eye-to-hand" else cell.robot.base_from_flange[at]
        seen, middle = Corners(0, np.arange(len(px)), px, 0.7), corners.mean(axis=0)
        place = locate_target(calibration, seen, BOARD, flange, middle, sigma_px=0.01)
        squares.append(place.budget_mm["calibration"] ** 2)
    # Noise moves the views of the fit by a ten thousandth of their distance.
    assert calibration.uncertainty.total_mm == pytest.approx(np.sqrt(np.mean(squares)), rel=2e-3)


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_calibrations_own_board_has_the_size_that_was_found(mount):
    size = 1.004
    cell = simulate(CellOptions(mount=mount, views=20, board_scale=size, cut_views=0.0, seed=2))
    calibration, corners = calibration_of(cell), size * corner_positions(BOARD)
    assert calibration.board.values[0] == pytest.approx(size - 1.0, abs=5e-4)
    away_mm = []
    for at, pose in enumerate(cell.cam_from_target):
        px = project(cell.options.camera, corners @ pose[:3, :3].T + pose[:3, 3])
        flange = np.eye(4) if mount == "eye-to-hand" else cell.robot.base_from_flange[at]
        seen = Corners(0, np.arange(len(px)), px, 0.7)
        place = locate_target(calibration, seen, BOARD, flange)
        edge = next(iter(cell.transforms.values()))
        away_mm.append(1e3 * np.linalg.norm(place.p_base - (flange @ edge @ pose)[:3, 3]))
    # As stated the board would be 0.4 % of half a metre nearer.
    assert np.sqrt(np.mean(np.square(away_mm))) < 0.5


def test_a_place_that_cannot_be_located_is_refused_by_name(in_hand):
    cell, calibration = in_hand
    at = stand(cell, np.random.default_rng(4))
    middle, flange = np.array([[640.0, 400.0]]), at.base_from_flange
    base_from_cam = flange @ calibration.edges["flange_from_cam"].matrix
    origin, right, forward = (base_from_cam[:3, name] for name in (3, 0, 2))
    level, behind, parallel = (
        Plane.through(forward, origin + forward),
        Plane.through(forward, origin - forward),
        Plane.through(right, origin + right),
    )
    centre = np.array([calibration.camera.camera.matrix[2:]])
    for words, px, plane, pose in (
        (r"eye-in-hand.*robot's pose", middle, level, None),
        (r"pixel \(1290.0, 400.0\) is outside .* 1280 x 800", [[1290.0, 400.0]], level, flange),
        ("outside", [[np.nan, 400.0]], level, flange),
        ("parallel to the plane", centre, parallel, flange),
        (r"runs away from the plane: .* behind the camera", middle, behind, flange),
        ("millimetres", middle, level, compose(flange[:3, :3], 1e3 * flange[:3, 3])),
        ("rigid", middle, level, 2.0 * flange),
    ):
        raised(DataError, words, locate, calibration, np.array(px), plane, pose)
    with pytest.raises(DataError, match="holds no camera"):
        locate(replace(calibration, camera=None), middle, level, flange)


def test_a_place_that_may_mislead_has_a_warning(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(6)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    straight = Plane.through(at.base_from_cam[:3, 2], place)
    assert not locate(calibration, px, straight, at.base_from_flange)[0].warnings
    along = place - at.base_from_cam[:3, 3]
    across = np.cross(along, [0.3, 0.5, 0.7])
    grazing = Plane.through(across / np.linalg.norm(across) + 1e-2 * along, place)
    (found,) = locate(calibration, px, grazing, at.base_from_flange)
    assert "limit 5" in found.warnings[0]
    assert found.sigma_mm.max() > 2.0
    bad = replace(calibration, verdict=Verdict.of("bad", "The views disagree."))
    (found,) = locate(bad, px, straight, at.base_from_flange)
    assert "verdict is bad: The views disagree." in found.warnings[0]
    least_m, most_m = calibration.budget.distances_m
    ahead = at.base_from_cam[:3, 2]
    far = Plane.through(ahead, at.base_from_cam[:3, 3] + 3.0 * most_m * ahead)
    (found,) = locate(calibration, px, far, at.base_from_flange)
    assert f"from {least_m:.2f} to {most_m:.2f} m" in found.warnings[0]


def test_corners_that_do_not_fit_are_left_out_refused_or_counted(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(7)
    at = stand(cell, rng)
    shown = before_camera(cell, BOARD, rng)
    corners = seen_corners(cell, shown, BOARD, rng)
    exact = replace(cell, options=replace(cell.options, pixel_sigma_px=0.0))
    sound_px = seen_corners(exact, shown, BOARD, rng).px

    def look(px, ids=corners.ids):
        seen = replace(corners, px=px, ids=ids)
        return locate_target(calibration, seen, BOARD, at.base_from_flange)

    sound = look(corners.px)
    assert not sound.warnings
    one_off = corners.px.copy()
    one_off[3] += 20.0
    # One wrong corner of forty is found, and moves nothing beyond the noise.
    assert 1e3 * np.linalg.norm(look(one_off).p_base - sound.p_base) < sound.radius95_mm
    noisy = look(corners.px + rng.normal(0.0, 1.0, corners.px.shape))
    assert "scatter by" in noisy.warnings[0]
    assert noisy.budget_mm["pixels"] > 5 * sound.budget_mm["pixels"]
    # By the template corners of sharp images err by so much where light or tilt are others.
    for sigma_px, is_said in ((0.012, False), (0.05, True)):
        few = (corners.px - sound_px) / 0.1 * sigma_px
        sharp = replace(corners, px=sound_px + few, stated_px=0.004)
        found = locate_target(calibration, sharp, BOARD, at.base_from_flange)
        assert bool(found.warnings) is is_said
    raised(DataError, "do not determine its pose", look, corners.px[:3], corners.ids[:3])
    raised(DataError, "corners 60 to", look, corners.px, corners.ids + 60 - corners.ids[0])
    empty = np.full((800, 1280), 128, np.uint8)
    with pytest.raises(DataError, match=r"image: target charuco_9x6_30mm: .*uniform"):
        locate_target(calibration, empty, BOARD, at.base_from_flange)
    with pytest.raises(DataError, match="640 x 480 pixels, and the calibrated camera has 1280"):
        locate_target(calibration, empty[:480, :640], BOARD, at.base_from_flange)


def test_a_stated_camera_beside_measured_poses_locates(tmp_path):
    cell = simulate(CellOptions(views=12))
    session = Session.load(write_session(cell, tmp_path / "session", images=False))
    table = {"camera": session_of(cell).document["camera"]}
    calibration = calibrate(replace(session, document=session.document | table))
    stated = cell.options.camera
    np.testing.assert_array_equal(calibration.camera.camera.matrix, stated.matrix)
    assert not calibration.camera.estimated
    again = Calibration.from_json(json.dumps(to_document(calibration)), "calibration.json")
    point = np.array([0.1, 0.1, 0.0])
    in_cam = cell.cam_from_target[0][:3, :3] @ point + cell.cam_from_target[0][:3, 3]
    base_from_target = cell.transforms["base_from_target"]
    expected = base_from_target[:3, :3] @ point + base_from_target[:3, 3]
    plane = Plane.through(base_from_target[:3, 2], expected)
    px = project(stated, in_cam[None])
    (found,) = locate(again, px, plane, cell.robot.base_from_flange[0], sigma_px=0.1)
    assert 1e3 * np.linalg.norm(found.p_base - expected) < found.radius95_mm < 1.0


IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
PIXEL = "700,350"


# Options whose names have a unit.
NAMES = {"plane_sigma": "plane-sigma-mm", "point": "point-mm", "touch_noise": "touch-noise-mm"}


def run(command, source=None, *flags, **options):
    """Runs a command with options by their names; None for those that are not given."""
    words = [*flags] if source is None else [source, *flags]
    for name, given in options.items():
        values = given if isinstance(given, list) else [given]
        words += [f"--{NAMES.get(name, name)}={value}" for value in values if value is not None]
    return visioncal(command, *words)


def done(*words, **options):
    """What a command prints."""
    ended = run(*words, **options).good()
    return ended.out


def refused(expected, *words, **options):
    """Checks that a command ends with status 2 and a message, and returns what it says."""
    ended = run(*words, **options).refused()
    assert re.search(expected, ended.err), ended.err
    return ended.err


@pytest.fixture(scope="module", params=[IN_HAND, TO_HAND])
def cell(request, tmp_path_factory):
    """A cell, the file of its calibration with a fixture, and a session of three images."""
    made, calibration = calibrated_cell(request.param)
    folder = tmp_path_factory.mktemp("the cell, größer")
    frame = fixture_frame()
    level = Edge(np.eye(4), np.diag([1e-7] * 3 + [1e-7] * 3))
    frames = {"base_from_jig": replace(frame, edge=level, verdict=Verdict("good"))}
    frames["base_from_loose"] = replace(
        frames["base_from_jig"], verdict=Verdict.of("bad", "Loose.")
    )
    replace(calibration, frames=frames).save(folder / "calibration.json")
    pictured(made, [*shots(made, 3), Shot(3, None)]).save(folder / "part")
    return made, folder / "calibration.json", folder / "part"


def shown(source=None, **options):
    """What `locate --json` prints."""
    return json.loads(done("locate", source, "--json", **options))


def pose_words(pose):
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return ",".join(repr(float(value)) for value in [*pose[:3, 3], *turn])


def test_every_view_states_the_pose_of_the_target(cell):
    made, calibration, session = cell
    to_hand = made.options.mount == TO_HAND
    point = np.array([0.135, 0.09, 0.0])
    places = shown(source=session, calibration=calibration, point="135,90,0")
    # A camera that stands still needs no pose of the robot.
    assert [place["view"] for place in places] == [30, 31, 32, *([33] if to_hand else [])]
    for place in places:
        at = place["view"] - 30
        x, z = made.transforms.values()
        base_from_target = x @ made.cam_from_target[at] if to_hand else z
        true = base_from_target[:3, :3] @ point + base_from_target[:3, 3]
        error = np.array(place["p_base_m"]) - true
        # Half as far again as 95 % of places: rendered corners are not exactly Gaussian.
        assert 1e3 * np.linalg.norm(error) < 1.5 * place["radius95_mm"]
        np.testing.assert_allclose(
            place["sigma_mm"], 1e3 * np.sqrt(np.diag(place["covariance"])), rtol=1e-12
        )
        assert place["budget_mm"]["total"] < 2.0
        assert place["warnings"] == []
    printed = done("locate", session, calibration=calibration, view=31)
    assert printed.startswith("view 31: (")
    assert "95 % within" in printed
    assert printed.count("\n") == 1
    lost = run("locate", session, calibration=calibration).err
    assert ("view 33: no pose of the robot" in lost) == (not to_hand)


def test_one_image_needs_a_target_and_a_pose(cell, tmp_path):
    made, calibration, session = cell
    image = tmp_path / "shot.png"
    image.write_bytes(picture(made.options.mount, 1))
    pose = None if made.options.mount == TO_HAND else pose_words(made.robot.base_from_flange[1])
    wanted = {"source": image, "calibration": calibration, "target": "charuco_9x6_30mm"}
    (found,) = shown(**wanted, pose=pose)
    (same,) = shown(source=session, calibration=calibration, view=31)
    assert found["image"] == "shot.png"
    np.testing.assert_allclose(found["p_base_m"], same["p_base_m"], atol=1e-9)
    # The calibration knows one board, which is then looked for.
    board = {"source": image, "calibration": calibration, "pose": pose}
    assert shown(**board) == [found]
    assert "--target names another" in run("locate", **board).err
    other = wanted | {"target": "aprilgrid_6x4_32mm"}
    refused(r"shot\.png: target aprilgrid", "locate", **other, pose=pose)
    if pose is None:
        refused("--pose: the camera is fixed", "locate", **wanted, pose="0,0,0,0,0,0,1")
    else:
        assert "--pose" in refused("robot's pose at the image is missing", "locate", **wanted)


def test_pixels_are_placed_on_planes(cell):
    made, file, session = cell
    at = None if made.options.mount == TO_HAND else made.robot.base_from_flange[1]
    given = {"calibration": file, "pose": None if at is None else pose_words(at)}
    plane = Plane.horizontal(-0.05, 2e-4)
    (expected,) = locate(Calibration.load(file), np.array([[700.0, 350.0]]), plane, at)
    forms = ["z=-50", "0,0,2,-100", "0,0,-1,50"]
    for words in forms:
        (found,) = shown(pixel=[PIXEL], plane=words, plane_sigma=0.2, **given)
        assert found["pixel"] == [700.0, 350.0]
        np.testing.assert_allclose(found["p_base_m"], expected.p_base, atol=1e-12)
        np.testing.assert_allclose(found["covariance"], expected.covariance, atol=1e-18)
    places = shown(pixel=[PIXEL, "600,500"], plane="z=-50", **given)
    assert [value["pixel"] for value in places] == [[700.0, 350.0], [600.0, 500.0]]
    assert "plane" not in places[0]["budget_mm"]
    # The jig's frame is the base's own, and not known exactly.
    for words in ("jig:z=-50", "base_from_jig:z=-50"):
        (found,) = shown(pixel=[PIXEL], plane=words, **given)
        np.testing.assert_allclose(found["p_base_m"], expected.p_base, atol=1e-12)
        assert found["budget_mm"]["plane"] > 0.1
    (found,) = shown(pixel=[PIXEL], plane="loose", **given)
    assert "The verdict of base_from_loose is bad: Loose." in found["warnings"]
    if at is not None:
        wanted = {"source": session, "calibration": file, "pixel": [PIXEL], "plane": "z=-50"}
        (found,) = shown(**wanted, view=31)
        np.testing.assert_allclose(found["p_base_m"], expected.p_base, atol=1e-9)
        refused(r"4 views, .* name one with --view", "locate", **wanted)
        refused(r"view 33 .* has no pose of the robot", "locate", **wanted, view=33)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"calibration": "nowhere"}, "nowhere"),
        ({}, "needs a session, an image or a pixel"),
        ({"source": "part", "plane": "z=1"}, "--plane: it is for --pixel"),
        ({"source": "part", "pose": "0,0,0,0,0,0,1"}, "--pose: the session has the poses"),
        ({"source": "part", "view": 99}, "view 99: .* it has 30, 31, 32, 33"),
        ({"source": "part", "point": "1,2"}, "--point-mm is '1,2', but must be x,y,z"),
        ({"source": "part", "point": "0,0,99000"}, "farther than 20 m"),
        ({"source": "part", "target": "charuco"}, "There is no target 'charuco'"),
        ({"source": "part/views.csv", "target": "charuco_9x6_30mm"}, "cannot be decoded"),
        ({"pixel": ["1"], "plane": "z=0"}, "--pixel is '1', but must be u,v"),
        ({"pixel": ["1,2"], "plane": "z=low"}, "--plane z is 'low'"),
        (
            {"pixel": ["1,2"], "plane": "gig"},
            "'gig', but must be a frame .*: .*base_from_jig",
        ),
        ({"pixel": ["1,2"], "plane": "base_from_cam"}, "must be a frame in the base"),
        ({"pixel": ["1,2"], "plane": "0,0,0,5"}, "has no direction"),
        ({"pixel": ["1,2"], "plane": "z=0", "plane_sigma": -1.0}, "standard deviation"),
        ({"pixel": ["1,2"], "plane": "z=0", "pose": "0,0,0,0,0,0,2"}, "not a quaternion"),
    ],
)
def test_mistakes_are_named(cell, options, words):
    _, calibration, session = cell
    options = {"calibration": calibration} | options
    if "source" in options:
        options["source"] = session.parent / options["source"]
    if options["calibration"] == "nowhere":
        options["calibration"] = session.parent / "nowhere"
    refused(words, "locate", **options)


def test_a_frame_from_images_joins_the_calibration(tmp_path):
    cell, calibration = calibrated_cell(TO_HAND)
    calibration.save(tmp_path / "calibration.json")
    pictured(cell, shots(cell, 4)).save(tmp_path / "part")
    at = {"calibration": tmp_path}
    printed = done("tcp", tmp_path / "part", **at, name="gripper", point="0,0,-120")
    assert printed.startswith("good  flange_from_gripper")
    assert "its point (0, 0, -120) mm" in printed
    kept = Calibration.load(tmp_path).frames["flange_from_gripper"]
    true = cell.transforms["flange_from_target"]
    tip = true[:3, 3] - 0.12 * true[:3, 2]
    # Four sigmas of all three axes together.
    assert 1e3 * np.linalg.norm(kept.edge.matrix[:3, 3] - tip) < 4 * kept.edge.sigma_mm
    assert "flange_from_gripper" in (tmp_path / "report.html").read_text(encoding="utf-8")
    file = tmp_path / "frames.json"
    printed = done("tcp", tmp_path / "part", "--json", **at, out=file)
    assert json.loads(printed).keys() == {"flange_from_tool"}
    assert FrameFile.load(file).frames.keys() == {"flange_from_tool"}


# Longer than the camera reaches beyond the flange.
GAUGE = ("--tool", "none", "--clearance-mm", 150)
CELL = replace(CellOptions(), views=12, seed=21)


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    """A calibrated cell, new images of its board, and where its corners really are."""
    folder = tmp_path_factory.mktemp("touched")
    cell_session(simulate(CELL), "session", seen="corners").save(folder / "session")
    assert visioncal("calibrate", folder / "session", "-o", folder / "out").status == 0
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
    raised(DataError, "5 from 0 to 100 mm", evaluate_gaps, points, [0.1])
    # Beside a block of 150 mm, whose length was not taken off.
    raised(DataError, "5 from 0 to 100 mm", evaluate_gaps, points, [150.2] * 5)
    metres = [2e-4, 0.0, 5e-3, 0.0, 0.0]
    in_metres = raised(DataError, "in metres, most likely", evaluate_gaps, points, metres)
    assert "--gaps-mm 0.2,0,5,0,0" in in_metres.next_step
    assert evaluate_gaps(points, [0.0] * 5).passed


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
    # Without a tool there is none to be measured anew.
    assert "tool" not in touch_test_finding(evaluate_gaps(points, [9.0] * 5)).do.words


def test_images_that_disagree_are_named_before_their_wide_targets(proved, tmp_path):
    folder, look, _ = proved
    session = Session.load(look)
    first, *others = session.views
    pushed = replace(first, numbers=first.numbers | {"x_m": first.numbers["x_m"] + 2e-3})
    for name, views in (("sound", (first, *others)), ("pushed", (pushed, *others[:1]))):
        replace(session, views=views).save(tmp_path / name)
    sound = visioncal("touch-test", tmp_path / "sound", "-c", folder / "out", *GAUGE).good()
    assert "in doubt" not in sound.err
    done = visioncal("touch-test", tmp_path / "pushed", "-c", folder / "out", *GAUGE).good()
    assert "Where the board lies is in doubt: The images disagree" in done.err


@pytest.mark.slow
def test_targets_are_printed_and_gaps_join_the_result(proved):
    folder, look, _ = proved
    out = folder / "out"
    visioncal("touch-test", look, "-c", out, *GAUGE[2:]).refused("Give --tool none, too")
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
    assert "Look whether the camera or the robot was moved" in done.out
    assert not Calibration.load(out).touch_test.passed
    visioncal("touch-test", look, "-c", out, "--tool", "gripper").refused(
        "the calibration has no tool", f"visioncal tcp TOUCHES -c {out} --name gripper"
    )


@pytest.mark.slow
def test_points_out_of_reach_of_a_calibrated_arm_are_refused(tmp_path):
    options = replace(CELL, views=25, offset_sigma_rad=1e-3, branches=True)
    for name, each in (("fit", options), ("look", replace(options, views=3, recording=1))):
        cell_session(simulate(each), name, seen="corners").save(tmp_path / name)
    visioncal("calibrate", tmp_path / "fit", "-o", tmp_path / "out", "--no-report").good()
    words = ("touch-test", tmp_path / "look", "-c", tmp_path / "out", *GAUGE, "--height-mm")
    assert visioncal(*words, 50).status == 0
    # A metre above a board that lies 0.7 m beside the base, an arm of 1.3 m cannot hover.
    visioncal(*words, 1000).refused("is out of reach within the joints' limits")


@pytest.mark.slow
def test_one_image_of_a_camera_that_stands_still_shows_where_to_touch(tmp_path):
    options = CellOptions(mount="eye-to-hand", views=12, seed=5)
    cell_session(simulate(options), "fit", seen="corners").save(tmp_path / "fit")
    visioncal("calibrate", tmp_path / "fit", "-o", tmp_path / "out", "--no-report").good()
    look = simulate(replace(options, views=1, recording=1))
    cell_session(look, "look").save(tmp_path / "look")
    image = next((tmp_path / "look/images").iterdir())
    words = ("touch-test", "-c", tmp_path / "out", *GAUGE, "--json")
    points = json.loads(visioncal(*words, image).good().out)["points"]
    board = look.transforms["base_from_cam"] @ look.cam_from_target[0]
    places_m = corner_positions(options.target) @ board[:3, :3].T + board[:3, 3]
    for point in points:
        away_m = np.subtract(point["base_m"], places_m[int(point["name"].split()[1])])
        assert 1e3 * np.linalg.norm(away_m) < point["radius95_mm"]


@pytest.mark.slow
def test_the_only_tool_touches_or_else_the_flange(proved):
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


def test_a_path_in_place_of_a_calibration_is_refused_with_the_call_that_loads_it():
    words = "calibration is text .'calibration.json'., but must be a Calibration"
    error = raised(DataError, words, locate, "calibration.json", np.zeros((1, 2)), None)
    assert error.next_step == "Load it first: visioncal.Calibration.load('calibration.json')."
