"""The pick: where a feature lies in the base, what is open about that, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.beyond import an_error, moved, with_error, with_field
from support.cells import exact, session_of
from support.later import ANYHOW, FITTED, lot
from support.marks import slow
from support.picks import (
    before_camera,
    calibration_of,
    pick_by_plane,
    pick_by_target,
    seen_corners,
    seen_point,
    stand,
)

import visioncal
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.frames.camera_chain import Plane
from visioncal.frames.locate import Located, locate, locate_target
from visioncal.results import Calibration, Edge, Verdict, to_document
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CellOptions,
    project,
    read_truth,
    simulate,
    wide_camera,
    write_session,
)
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.camera import intrinsics

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


def agrees_with_differences(part, ahead, behind, step, *, beyond=False):
    slope = (ahead.p_base - behind.p_base) / (2 * step)
    # Truncation of second order in a step of a thousandth, relative; rounding is less. A lens that
    # breathes by a thousandth moves with its centre and the distance by as much less.
    share = 5e-3 if beyond else 1e-4
    np.testing.assert_allclose(part, np.outer(slope, slope), atol=share * slope @ slope)


@pytest.mark.parametrize("beyond", [False, True], ids=["model", "field"])
def test_what_moves_a_ray_agrees_with_central_differences(exact_cell, beyond):
    (cell, calibration), seed = exact_cell, 0
    calibration = with_field(calibration) if beyond else calibration
    rng = np.random.default_rng(seed)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    plane = Plane.through(-at.base_from_cam[:3, 2] + 0.3 * rng.standard_normal(3), place)
    error = an_error(calibration, seed)
    (found,) = locate(with_error(calibration, error), px, plane, at.base_from_flange, sigma_px=1.0)
    step = 1e-3
    ahead, behind = (
        locate(moved(calibration, sign * step * error), px, plane, at.base_from_flange)[0]
        for sign in (1, -1)
    )
    agrees_with_differences(found.parts["calibration"], ahead, behind, step, beyond=beyond)
    pixels = [
        [locate(calibration, px + sign * shift, plane, at.base_from_flange)[0] for sign in (1, -1)]
        for shift in 0.1 * np.eye(2)
    ]
    jacobian = np.array([(a.p_base - b.p_base) / 0.2 for a, b in pixels]).T
    # Truncation: a tenth of a pixel in a thousand, squared. The field is taken for flat where a
    # pixel errs: by up to 0.3 px in a fifth of 1280.
    apart = (1e-2 if beyond else 1e-5) * np.trace(jacobian @ jacobian.T)
    np.testing.assert_allclose(found.parts["pixels"], jacobian @ jacobian.T, atol=apart)


@pytest.mark.parametrize("beyond", [False, True], ids=["model", "field"])
def test_what_moves_a_target_agrees_with_central_differences(exact_cell, beyond):
    (cell, calibration), seed = exact_cell, 0
    rng = np.random.default_rng(seed)
    at, point = stand(cell, rng), np.array([0.1, 0.05, 0.02])
    corners = seen_corners(cell, before_camera(cell, BOARD, rng), BOARD, rng)
    if beyond:
        calibration = with_field(calibration)
        # What the field displaces is seen so.
        lens = calibration.camera
        away = corners.px - lens.in_model(corners.px, 0.5)
        corners = replace(corners, px=corners.px + away)
    error = an_error(calibration, seed)
    # Corners that fit the pose exactly move it with the lens as the normal equations say.
    found = locate_target(
        with_error(calibration, error), corners, BOARD, at.base_from_flange, point, sigma_px=0.1
    )
    step = 1e-3
    ahead, behind = (
        locate_target(
            moved(calibration, sign * step * error), corners, BOARD, at.base_from_flange, point
        )
        for sign in (1, -1)
    )
    agrees_with_differences(found.parts["calibration"], ahead, behind, step, beyond=beyond)
    larger, smaller = (
        locate_target(
            calibration,
            corners,
            replace(BOARD, square_m=(1 + sign * step) * BOARD.square_m),
            at.base_from_flange,
            point,
        )
        for sign in (1, -1)
    )
    slope = (larger.p_base - smaller.p_base) / (2 * step)
    sigma = BOARD.square_sigma_m / BOARD.square_m
    expected = sigma**2 * np.outer(slope, slope)
    # Corners that a field of another distance displaced fit no pose exactly.
    share = 1e-2 if beyond else 1e-4
    np.testing.assert_allclose(found.parts["target"], expected, atol=share * np.trace(expected))


def test_the_robots_noise_at_the_stop_agrees_with_central_differences(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(1)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    plane = Plane.through(-at.base_from_cam[:3, 2], place)
    (found,) = locate(calibration, px, plane, at.base_from_flange)
    sigma = np.repeat(
        [
            np.deg2rad(calibration.noise["robot_rotation_deg"]),
            1e-3 * calibration.noise["robot_translation_mm"],
        ],
        3,
    )
    step = 1e-4
    jacobian = np.array(
        [
            locate(calibration, px, plane, at.base_from_flange @ exp(twist))[0].p_base
            - locate(calibration, px, plane, at.base_from_flange @ exp(-twist))[0].p_base
            for twist in step * np.eye(6)
        ]
    ).T / (2 * step)
    expected = jacobian @ np.diag(sigma**2) @ jacobian.T
    # Truncation: 1e-4 squared, relative.
    np.testing.assert_allclose(
        found.parts["robot"], expected, atol=1e-6 * float(np.trace(expected))
    )


def test_an_uncertain_frames_plane_agrees_with_central_differences(in_hand):
    cell, calibration = in_hand
    rng = np.random.default_rng(2)
    at = stand(cell, rng)
    place, px = seen_point(cell, at, rng)
    # The z axis of the fixture looks up to the camera, and the point lies 0.1 m beside its origin.
    turn = at.base_from_cam @ exp(np.array([np.pi - 0.2, 0.1, 0.0, 0.0, 0.0, 0.0]))
    fixture = np.eye(4)
    fixture[:3, :3] = turn[:3, :3]
    fixture[:3, 3] = place - turn[:3, :3] @ np.array([0.1, -0.05, 0.02])
    error = 1e-3 * rng.standard_normal(6)
    plane = Plane.of_frame(Edge(fixture, np.outer(error, error)), 0.02)
    (found,) = locate(calibration, px, plane, at.base_from_flange)
    step = 1e-3
    ahead, behind = (
        locate(
            calibration,
            px,
            Plane.of_frame(Edge(fixture @ exp(sign * step * error), np.zeros((6, 6))), 0.02),
            at.base_from_flange,
        )[0]
        for sign in (1, -1)
    )
    agrees_with_differences(found.parts["plane"], ahead, behind, step)


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
@pytest.mark.parametrize(
    "options",
    [
        CellOptions(views=10, robot_sigma_m=3e-4, robot_sigma_rad=5e-4, pixel_sigma_px=0.1),
        slow(
            CellOptions(views=10, mount="eye-to-hand", pixel_sigma_px=0.1, state_intrinsics=False)
        ),
    ],
    ids=MOUNTS,
)
def test_the_region_holds_the_true_place(options):
    plane, target = [], []
    for seed in range(8):
        cell = simulate(replace(options, seed=seed))
        calibration = calibration_of(cell)
        rng = np.random.default_rng(seed)
        plane += [pick_by_plane(cell, calibration, rng) for _ in range(10)]
        target += [pick_by_target(cell, calibration, BOARD, rng) for _ in range(10)]
    for picks in (plane, target):
        held = np.mean([pick.located.holds(pick.truth) for pick in picks])
        near = [
            1e3 * np.linalg.norm(pick.truth - pick.located.p_base) <= pick.located.radius95_mm
            for pick in picks
        ]
        # Of 80 picks 95 %, with a standard deviation of 2.4 %; picks of one cell share its
        # calibration, so that they count for fewer: four times that. A region that was too wide by
        # half would hold every one of them.
        assert held == pytest.approx(0.95, abs=0.1)
        assert np.mean(near) == pytest.approx(0.95, abs=0.1)


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


@pytest.mark.slow
def test_lens_and_edge_have_one_covariance():
    surprises, together = [], []
    for seed in range(12):
        cell = simulate(
            CellOptions(views=12, pixel_sigma_px=0.1, seed=seed, state_intrinsics=False)
        )
        calibration = calibration_of(cell)
        camera = calibration.camera
        between = camera.edge_covariance
        joint = np.block([[calibration.joint_covariance, between.T], [between, camera.covariance]])
        scale = 1 / np.sqrt(np.diag(joint))
        # Correlations: rounding leaves 1e-12 of ones.
        assert np.linalg.eigvalsh(joint * np.outer(scale, scale))[0] > -1e-10
        true = next(iter(cell.transforms.values()))
        error = np.concatenate(
            [
                log(invert(true) @ calibration.edges["flange_from_cam"].matrix),
                intrinsics(camera.camera) - intrinsics(cell.options.camera),
            ]
        )
        rows = np.r_[0:6, 12 : len(joint)]
        covariance = joint[np.ix_(rows, rows)] * np.outer(scale[rows], scale[rows])
        white = error * scale[rows]
        surprises.append(white @ np.linalg.solve(covariance, white) / len(error))
        together.append(np.abs(covariance[:6, 6:]).max())
    # 12 runs of 15 degrees of freedom: sqrt(2 / 180) = 0.11; the noise is estimated, too.
    assert np.mean(surprises) == pytest.approx(1.0, abs=0.4)
    # What makes this a test of the cross block: centre and rotation err almost as one, and a wrong
    # block would let their difference surprise by many sigmas.
    assert min(together) > 0.8


def test_given_intrinsics_of_a_stated_sigma_are_fitted_within_it():
    camera = wide_camera()
    cell = simulate(CellOptions(views=12, seed=1, camera=camera, pixel_sigma_px=0.1))
    session = session_of(cell)
    session.document["camera"]["matrix_sigma_px"] = 1.0
    found = calibration_of(cell, session=session).camera
    # One of four is beyond two sigma once in six cells.
    assert np.all(np.abs(found.camera.matrix - camera.matrix) < 2.0)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert np.all((sigmas[:4] > 0) & (sigmas[:4] <= 1.0))
    assert np.all(sigmas[4:] == 0.0)
    assert found.edge_covariance.shape == (9, 12)


def test_a_place_tells_where_its_uncertainty_is_from():
    parts = {"pixels": np.diag([1e-8, 4e-8, 0.0]), "robot": np.diag([3e-8, 0.0, 0.0])}
    found = Located(np.zeros(3), parts, np.inf)
    np.testing.assert_allclose(found.sigma_mm, [0.2, 0.2, 0.0], atol=1e-12)
    assert found.budget_mm["total"] == pytest.approx(np.hypot(0.2, 0.2))
    assert found.budget_mm["robot"] == pytest.approx(1e3 * np.sqrt(3e-8))
    # Two directions of 0.2 mm: chi-square's 95 % quantile of two is 5.991.
    assert found.radius95_mm == pytest.approx(0.2 * np.sqrt(5.991), rel=1e-3)
    assert found.holds(np.array([0.2e-3 * 2.44, 0.0, 0.0]))
    assert not found.holds(np.array([0.2e-3 * 2.46, 0.0, 0.0]))
    # Off an exactly known plane there is nothing, however near.
    assert not found.holds(np.array([0.0, 0.0, 1e-6]))
    # With the noise from few residuals, the region is wider.
    assert Located(np.zeros(3), parts, 8.0).radius95_mm > 1.15 * found.radius95_mm


def test_what_cannot_be_located_is_refused_by_name(in_hand):
    cell, calibration = in_hand
    at = stand(cell, np.random.default_rng(4))
    middle, flange = np.array([[640.0, 400.0]]), at.base_from_flange
    base_from_cam = flange @ calibration.edges["flange_from_cam"].matrix
    origin, right, forward = (base_from_cam[:3, name] for name in (3, 0, 2))
    level, behind, beside = (
        Plane.through(forward, origin + forward),
        Plane.through(forward, origin - forward),
        Plane.through(right, origin + right),
    )
    with pytest.raises(DataError, match=r"eye-in-hand.*robot's pose"):
        locate(calibration, middle, level)
    with pytest.raises(DataError, match=r"pixel \(1290.0, 400.0\) is outside .* 1280 x 800"):
        locate(calibration, np.array([[1290.0, 400.0]]), level, flange)
    with pytest.raises(DataError, match="outside"):
        locate(calibration, np.array([[np.nan, 400.0]]), level, flange)
    with pytest.raises(DataError, match="parallel to the plane"):
        locate(calibration, np.array([calibration.camera.camera.matrix[2:]]), beside, flange)
    with pytest.raises(DataError, match=r"runs away from the plane: .* behind the camera"):
        locate(calibration, middle, behind, flange)
    with pytest.raises(DataError, match="millimetres"):
        locate(calibration, middle, level, with_offset(flange, 1e3))
    with pytest.raises(DataError, match="rigid"):
        locate(calibration, middle, level, 2.0 * flange)
    with pytest.raises(DataError, match="metres"):
        Plane.horizontal(250.0)
    with pytest.raises(DataError, match="no direction"):
        Plane.through(np.zeros(3), np.zeros(3))
    with pytest.raises(DataError, match="sigma_px"):
        locate(calibration, middle, level, flange, sigma_px=-1.0)
    with pytest.raises(DataError, match="holds no camera"):
        locate(replace(calibration, camera=None), middle, level, flange)


@pytest.mark.parametrize(
    ("point", "words"),
    [
        (np.zeros((800, 1280, 3)), r"point_target_m has the shape \(800, 1280, 3\); three metres"),
        ([0.0, np.nan, 0.0], "three metres are needed"),
        ([120.0, 40.0, 0.0], "looks like millimetres"),
    ],
)
def test_a_point_that_is_none_is_no_fault_of_the_images(in_hand, point, words):
    cell, calibration = in_hand
    session = session_of(cell)
    with pytest.raises(DataError, match=words) as refused:
        visioncal.locate_views(session, calibration, point)
    assert str(refused.value).startswith("point_target_m")


def with_offset(pose, factor):
    other = pose.copy()
    other[:3, 3] *= factor
    return other


def test_what_may_mislead_is_told(in_hand):
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
    corners = seen_corners(cell, before_camera(cell, BOARD, rng), BOARD, rng)

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
    with pytest.raises(DataError, match="do not determine its pose"):
        look(corners.px[:3], corners.ids[:3])
    with pytest.raises(DataError, match="corners 60 to"):
        look(corners.px, corners.ids + 60 - corners.ids[0])
    empty = np.full((800, 1280), 128, np.uint8)
    with pytest.raises(DataError, match=r"image: target charuco_9x6_30mm: .*uniform"):
        locate_target(calibration, empty, BOARD, at.base_from_flange)
    with pytest.raises(DataError, match="640 x 480 pixels, and the calibrated camera has 1280"):
        locate_target(calibration, empty[:480, :640], BOARD, at.base_from_flange)


def test_a_board_in_a_rendered_image_lies_where_it_stands(rendered):
    session = visioncal.Session.load(rendered)
    calibration, truth = visioncal.calibrate(session), read_truth(rendered)
    at = 4
    image = decode_image(session.images.read(session.views[at].image))
    reported = session.views[at].base_from_flange()
    point = np.array([0.135, 0.09, 0.0])
    found = visioncal.locate_target(calibration, image, session.target, reported, point)
    by_matrix = locate_target(calibration, image, session.target, reported.as_matrix(), point)
    np.testing.assert_array_equal(by_matrix.p_base, found.p_base)
    # What stands still is the board, and what the view saw of it is in cam_from_target.
    flange_from_cam = truth.transforms["flange_from_cam"]
    pose = truth.base_from_flange[at] @ flange_from_cam @ truth.cam_from_target[at]
    place = pose[:3, :3] @ point + pose[:3, 3]
    # Half as far again as 95 % of places: rendered corners are not exactly Gaussian.
    assert 1e3 * np.linalg.norm(found.p_base - place) < 1.5 * found.radius95_mm
    assert found.radius95_mm < 2.0
    assert not found.warnings


@pytest.mark.parametrize("target", [True, False], ids=["target named", "no target"])
def test_a_camera_that_was_stated_beside_measured_poses_looks(tmp_path, target):
    cell = simulate(CellOptions(views=12))
    told = Session.load(write_session(cell, tmp_path / "session", images=False))
    table = {"camera": session_of(cell).document["camera"]}
    if target:
        table["target"] = cell.options.target.name
        told = replace(told, target=cell.options.target)
    calibration = visioncal.calibrate(replace(told, document=told.document | table))
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
    assert found.holds(expected)
    assert found.radius95_mm < 1.0
