"""The simulated cell and arm: is its truth true, and do its pictures show it where it says?"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cells import exact
from support.marks import slow
from support.moved_arms import robot_with_bodies

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log, rotation_angle
from visioncal.robot.torques import body_regressor, joint_torques
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    BoardAt,
    CameraAt,
    CellOptions,
    Moved,
    NetworkOptions,
    Payload,
    RobotAt,
    Second,
    cell_session,
    forward,
    measured_poses,
    prepare_scene,
    project,
    rays,
    read_truth,
    render,
    simulate,
    write_session,
)
from visioncal.simulation.dynamics import (
    LinkBody,
    drive_torques,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)
from visioncal.vision.boards.charuco import charuco_board
from visioncal.vision.camera import matrix_3x3

MOUNTS = ("eye-in-hand", "eye-to-hand")
SMALL = replace(
    CAMERAS["wide"], resolution=(640, 400), matrix=np.array([457.1, 456.8, 322.4, 198.2])
)
RATIONAL = replace(
    CAMERAS["wide"], distortion=np.array([0.31, -0.12, 4e-4, -3e-4, 0.01, 0.42, -0.1, 0.02])
)


def base_from_target_chain(cell, base_from_flange):
    """(m, 4, 4) the board's pose through the arm and the camera, or on its way through the arm."""
    if cell.options.mount == "eye-in-hand":
        return base_from_flange @ cell.transforms["flange_from_cam"] @ cell.cam_from_target
    return base_from_flange @ cell.transforms["flange_from_target"]


def base_from_target(cell):
    """The same without the arm."""
    if cell.options.mount == "eye-in-hand":
        return cell.transforms["base_from_target"]
    return cell.transforms["base_from_cam"] @ cell.cam_from_target


def cv_project(camera, points):
    matrix = matrix_3x3(camera)
    zero = np.zeros(3)
    if camera.model == "fisheye":
        px, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, camera.distortion)
    else:
        px, _ = cv2.projectPoints(points[:, None], zero, zero, matrix, camera.distortion)
    return px.reshape(-1, 2)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("robot", ["ur3e", "ur5e", "ur10e"])
def test_exact_chain_closes(mount, robot):
    cell = simulate(exact(CellOptions(mount=mount, robot=robot, views=8, seed=4)))
    # A dozen products of matrices of order one: a few units in the last place each.
    np.testing.assert_allclose(
        base_from_target_chain(cell, cell.robot.base_from_flange),
        np.broadcast_to(base_from_target(cell), (8, 4, 4)),
        atol=1e-12,
    )
    np.testing.assert_array_equal(
        cell.robot.base_from_flange, forward(cell.robot.arm, cell.robot.joints)
    )


def test_noisy_chain_closes_on_the_truth_only():
    cell = simulate(CellOptions(views=6, dh_sigma_m=3e-4, dh_sigma_rad=5e-4, wrong_views=1))
    truth = base_from_target_chain(cell, cell.robot.true_base_from_flange) - base_from_target(cell)
    report = base_from_target_chain(cell, cell.robot.base_from_flange) - base_from_target(cell)
    assert np.abs(truth).max() < 1e-12  # Rounding, as above.
    # Arm errors of 0.3 mm and 0.5 mrad at a metre cannot leave any report within 0.01 mm.
    assert np.linalg.norm(report[:, :3, 3], axis=1).min() > 1e-5


@pytest.mark.parametrize("camera", [CAMERAS["wide"], RATIONAL, CAMERAS["fine"], CAMERAS["fisheye"]])
def test_rays_invert_the_projection(camera):
    rng = np.random.default_rng(3)
    px = rng.uniform(0.0, 1.0, (500, 2)) * np.array(camera.resolution)
    points = rays(camera, px) * rng.uniform(0.2, 3.0, (500, 1))
    # Pixels of order a thousand, in double precision.
    np.testing.assert_allclose(project(camera, points), px, atol=1e-9)


@pytest.mark.parametrize("mount", MOUNTS)
def test_corners_are_the_projected_board(mount):
    options = CellOptions(mount=mount, views=3, pixel_sigma_px=0.2, board_scale=1.002)
    cell = simulate(options)
    side, found = 0.030 * 1.002, cell.exact_corners[1]
    column, row = found.ids % 8 + 1, found.ids // 8 + 1
    points = np.stack([column * side, row * side, 0 * side * row], axis=1)
    pose = cell.cam_from_target[1]
    # The same numbers through OpenCV's code.
    expected = cv_project(options.camera, points @ pose[:3, :3].T + pose[:3, 3])
    np.testing.assert_allclose(found.px, expected, atol=1e-9)
    pairs = zip(cell.corners, cell.exact_corners, strict=True)
    noise = np.concatenate([noisy.px - true.px for noisy, true in pairs])
    # Some 200 draws give their spread to 5 %.
    assert noise.std() == pytest.approx(0.2, rel=0.2)


def test_same_seed_same_cell_and_each_option_has_its_own_randomness():
    options = CellOptions(views=4, seed=11)
    once, again = simulate(options), simulate(options)
    np.testing.assert_array_equal(once.cam_from_target, again.cam_from_target)
    np.testing.assert_array_equal(once.corners[2].px, again.corners[2].px)
    np.testing.assert_array_equal(render(prepare_scene(once), 0), render(prepare_scene(again), 0))
    shaken = simulate(replace(options, robot_sigma_m=1e-3, pixel_sigma_px=0.5))
    np.testing.assert_array_equal(shaken.robot.joints, once.robot.joints)
    assert not np.array_equal(shaken.cam_from_target, once.cam_from_target)
    other = simulate(replace(options, seed=12))
    assert np.abs(other.robot.joints - once.robot.joints).max() > 0.1


def test_wrong_views_are_as_wrong_as_promised():
    cell = simulate(replace(exact(CellOptions(views=30, seed=5)), wrong_views=9))
    error = invert(cell.robot.true_base_from_flange) @ cell.robot.base_from_flange
    shift, turn = np.linalg.norm(error[:, :3, 3], axis=1), np.rad2deg(rotation_angle(error))
    wrong = np.isin(np.arange(30), cell.wrong_views)
    assert wrong.sum() == 9
    # The inverse kinematics ends within 1e-9 of what was drawn.
    assert np.all((shift[wrong] > 0.005 - 1e-8) & (shift[wrong] < 0.030 + 1e-8))
    assert np.all((turn[wrong] > 1.0 - 1e-6) & (turn[wrong] < 5.0 + 1e-6))
    assert shift[~wrong].max() < 1e-12  # Rounding.
    assert np.ptp(shift[wrong]) > 0.005


@pytest.mark.parametrize("mount", MOUNTS)
def test_poor_motions_are_as_poor_as_named(mount):
    shifted = simulate(exact(CellOptions(mount=mount, views=6, motion="translation")))
    relative = invert(shifted.robot.base_from_flange[:1]) @ shifted.robot.base_from_flange[1:]
    # The inverse kinematics ends at machine precision or a little above it.
    assert rotation_angle(relative).max() < 1e-8
    assert np.linalg.norm(relative[:, :3, 3], axis=1).min() > 0.005
    turned = simulate(exact(CellOptions(mount=mount, views=6, motion="one_axis")))
    turns = log(invert(turned.robot.base_from_flange[:1]) @ turned.robot.base_from_flange[1:])
    angles = np.linalg.norm(turns[:, :3], axis=1)
    assert angles.max() > 0.3
    axes = turns[:, :3] / angles[:, None]
    cosines = np.abs(axes @ axes[0])
    assert cosines.min() > 1.0 - 1e-10  # An angle of 1e-5 rad, for the smallest turns drawn.


def found_corners(target, image):
    """Ids and pixels of the corners that OpenCV finds."""
    if target.kind == "charuco":
        px, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(target)).detectBoard(image)
        return ids.ravel(), px.reshape(-1, 2)
    size = (target.columns, target.rows)
    done, px = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
    assert done
    # OpenCV starts such a board at its light side.
    return np.arange(len(px))[::-1], px.reshape(-1, 2)


def detection_errors(options):
    """(n, 2) found minus true corners [px], half of the pictures taken upside down."""
    cell = simulate(options)
    scene = prepare_scene(cell)
    errors = []
    for view in range(options.views):
        image = render(scene, view)
        true = cell.exact_corners[view]
        # Upside down for a detector that has a bias of its own: there its sign changes.
        ids, px = found_corners(options.target, image)
        _, found_rows, true_rows = np.intersect1d(ids, true.ids, return_indices=True)
        errors.append(px[found_rows] - true.px[true_rows])
        ids, px = found_corners(options.target, np.ascontiguousarray(image[::-1, ::-1]))
        _, found_rows, true_rows = np.intersect1d(ids, true.ids, return_indices=True)
        errors.append(np.array(image.shape[::-1]) - 1.0 - px[found_rows] - true.px[true_rows])
    return np.concatenate(errors)


@pytest.mark.parametrize(
    "options",
    [
        CellOptions(),
        slow(CellOptions(camera=CAMERAS["fisheye"], tilt_rad=(0.1, 0.5))),
        slow(CellOptions(target=BOARDS["checkerboard"], blur_px=1.0)),
        CellOptions(target=replace(BOARDS["charuco"], legacy=True)),
        slow(CellOptions(board_scale=1.01, board_bow_m=0.003)),
        CellOptions(mount="eye-to-hand", distance_m=(0.5, 0.8)),
    ],
    ids=["charuco", "fisheye", "checkerboard", "legacy", "bowed", "to-hand"],
)
def test_pictures_show_the_corners_where_they_are(options):
    errors = detection_errors(replace(options, views=2, seed=2))
    assert len(errors) > 120
    # Half a pixel's shift, or a third of one from the sub-pixels, would stand out. Some 150
    # corners at 0.04 px give their mean to 0.003 px.
    assert np.abs(errors.mean(axis=0)).max() < 0.02
    assert np.sqrt((errors**2).mean()) < 0.08  # What the detectors reach at this blur and noise.


def test_noise_blur_and_vignetting_are_in_the_picture():
    plain = exact(CellOptions(views=1, camera=SMALL, vignetting=0.0, seed=1))
    clean = render(prepare_scene(simulate(plain)), 0).astype(float)
    noisy = render(prepare_scene(simulate(replace(plain, image_noise=3.0))), 0) - clean
    # 256,000 draws; rounding to grey levels adds 0.4 to 3.0 in squares.
    assert noisy.std() == pytest.approx(3.0, rel=0.05)
    dark = render(prepare_scene(simulate(replace(plain, vignetting=0.4))), 0)
    # The outermost pixels are a little inside the corner, and the black level stays.
    ratio = (dark[:8, :8].mean() - 4.0) / (clean[:8, :8].mean() - 4.0)
    assert ratio == pytest.approx(0.6, abs=0.03)
    soft = render(prepare_scene(simulate(replace(plain, blur_px=2.0))), 0)
    sharpness = [cv2.Laplacian(np.float32(image), cv2.CV_32F).std() for image in (clean, soft)]
    # A Laplacian of sigma 0.7 against 2.0 px: its response falls with the square of the sigma.
    assert sharpness[1] < 0.4 * sharpness[0]


@pytest.mark.parametrize("quality", [None, 90])
def test_written_session_loads_and_its_truth_lies_beside_it(tmp_path, quality):
    target = replace(BOARDS["charuco"], name="own", square_m=0.025, marker_m=0.018)
    options = CellOptions(
        views=2, camera=SMALL, target=target, jpeg_quality=quality, wrong_views=1, seed=3
    )
    cell = simulate(options)
    shares = []
    folder = write_session(cell, tmp_path / "cell", shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    session = Session.load(folder)
    assert session.warnings == ()
    assert replace(session.target, name="own") == target
    np.testing.assert_array_equal(session.camera.matrix, SMALL.matrix)
    for view in session.views:
        np.testing.assert_array_equal(view.joints_rad, cell.robot.joints[view.number])
        # Through a quaternion and back: rounding.
        reported = view.base_from_flange().as_matrix()
        np.testing.assert_allclose(reported, cell.robot.base_from_flange[view.number], atol=1e-12)
        data = np.frombuffer(session.images.read(view.image), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED).astype(float)
        # JPEG at 90 keeps grey levels to a few; PNG keeps them all.
        difference = image - render(prepare_scene(cell), view.number)
        assert np.abs(difference).mean() < (1e-12 if quality is None else 3.0)
    assert not list(folder.rglob("*truth*"))
    truth = read_truth(folder)
    for name, matrix in cell.transforms.items():
        np.testing.assert_array_equal(truth.transforms[name], matrix)
    np.testing.assert_array_equal(truth.cam_from_target, cell.cam_from_target)
    assert truth.wrong_views == cell.wrong_views
    assert truth.options["robot_sigma_m"] == options.robot_sigma_m
    np.testing.assert_array_equal(truth.camera.distortion, SMALL.distortion)


@pytest.mark.parametrize(
    ("key", "value"),
    [("transforms", []), ("camera", None), ("wrong_views", 3), ("arm", {"a": [{}]})],
)
def test_a_truth_of_other_types_is_refused_by_its_key(key, value, tmp_path):
    write_session(simulate(CellOptions(views=3)), tmp_path / "cell", images=False)
    path = tmp_path / "cell.truth.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(DataError, match=f"cell.truth.json.{key}"):
        read_truth(path)


def test_pose_pairs_spread_as_pnp_on_the_noisy_corners_does():
    options = CellOptions(views=60, pixel_sigma_px=0.3)
    cell = simulate(options)
    matrix = matrix_3x3(options.camera)
    solved = []
    for found, pose in zip(cell.corners, cell.cam_from_target, strict=True):
        points = 0.030 * np.stack([found.ids % 8 + 1, found.ids // 8 + 1, 0 * found.ids], axis=1)
        start = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
        distortion = options.camera.distortion
        _, turn, shift = cv2.solvePnP(points, found.px, matrix, distortion, *start, True)
        guess = np.eye(4)
        guess[:3, :3], guess[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        solved.append(guess)
    drawn = log(invert(cell.cam_from_target) @ measured_poses(cell))
    fitted = log(invert(cell.cam_from_target) @ np.array(solved))
    # Two spreads from 60 draws each: their ratio is known to 13 %, so 40 % is three sigmas.
    np.testing.assert_allclose(drawn.std(axis=0) / fitted.std(axis=0), 1.0, atol=0.4)


def states(seed=0):
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (3, 20, 6))


@pytest.mark.parametrize("name", ["ur5e", "ur10e"])
def test_two_recursions_agree(name):
    built = nominal_dynamics(name)
    robot = robot_with_bodies(built)
    ours = joint_torques(robot, robot.inertias, *states())
    # Two ways through the same sums: rounding on torques of up to 300 N m.
    assert drive_torques(built, *states()) == pytest.approx(ours, abs=1e-10)


def test_a_load_adds_what_a_body_on_the_flange_does():
    built = nominal_dynamics("ur10e")
    load = LinkBody(2.8, np.array([0.02, -0.01, 0.09]), np.diag([0.01, 0.012, 0.006]))
    robot = robot_with_bodies(built)
    kg, (x, y, z) = load.kg, load.centre_m
    about = load.inertia_kg_m2 + kg * (load.centre_m @ load.centre_m * np.eye(3))
    about -= kg * np.outer(load.centre_m, load.centre_m)
    six = about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    parameters = np.array([kg, kg * x, kg * y, kg * z, *six])
    added = drive_torques(built.carrying(load), *states()) - drive_torques(built, *states())
    assert added == pytest.approx(body_regressor(robot, *states()) @ parameters, abs=1e-10)


@pytest.mark.parametrize("motion", [multi_sine, slow_sweep])
def test_motions_are_their_own_derivatives(motion):
    done = motion(6, np.random.default_rng(2), seconds=10.0)
    step = done.times_s[1] - done.times_s[0]
    for value, slope in ((done.q, done.dq), (done.dq, done.ddq)):
        by_differences = (value[2:] - value[:-2]) / (2.0 * step)
        # Central differences over 2 ms of at most 0.5 Hz: a third derivative's 1e-5.
        assert by_differences == pytest.approx(slope[1:-1], abs=3e-5)


def test_recordings_have_the_noise_that_they_are_asked_for():
    rng = np.random.default_rng(3)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    stream = record(built, done, rng)
    true = drive_torques(built, done.q, done.dq, done.ddq)
    torques = np.stack([stream[f"tau{index}_nm"] for index in range(1, 7)], axis=1)
    noise = np.std(torques - true, axis=0) / np.sqrt(np.mean(true**2, axis=0))
    # The standard deviation of 10,000 draws is known to 0.7 %.
    assert noise == pytest.approx(np.full(6, 0.03), rel=0.03)


def test_mistaken_intrinsics_are_off_by_what_was_asked_for():
    for camera in (CAMERAS["wide"], CAMERAS["fine"], CAMERAS["fisheye"]):
        cell = simulate(CellOptions(views=1, camera=camera, lens_mismatch_px=0.3))
        px = np.random.default_rng(5).uniform(0.0, 1.0, (500, 2)) * np.array(camera.resolution)
        away = project(cell.stated[""], rays(camera, px)) - px
        # 500 random pixels against the grid that the size is set on: the edge counts most, a
        # fisheye's above all.
        assert np.sqrt(np.mean(np.sum(away**2, axis=1))) == pytest.approx(0.3, rel=0.25)


STOPS = 8
ONE_ARM = NetworkOptions(
    robots=(RobotAt("a", (-0.6, 0.0, 0.0)),), boards=(BoardAt("plate", "a"),), stops=STOPS
)


def test_faults_are_where_the_truth_says():
    options = NetworkOptions(stops=STOPS)
    moves = (Moved("target_plate_b"), Moved("cam_left", 6, 0.02))
    cell = simulate(options)
    faulty = simulate(replace(options, swapped_rows=1, stray_images=2, moved=moves))
    assert len(faulty.wrong_views) == 4
    other = {
        new.view
        for old, new in zip(cell.sights, faulty.sights, strict=False)
        if old.view == new.view and not np.allclose(old.cam_from_target, new.cam_from_target)
    }
    moved = {
        sight.view
        for sight in cell.sights
        if (sight.board == "plate_b" and sight.stop >= 4)
        or (sight.camera == "left" and sight.stop >= 6)
    }
    # A push may take a board out of an image: then rows are numbered otherwise from there on.
    early = {sight.view for sight in cell.sights if 0 <= sight.stop < 4}
    assert other & early == set(faulty.wrong_views) & early
    assert other & moved & {sight.view for sight in cell.sights if sight.stop == 4}


def test_a_whole_cell_is_written_with_pictures_of_its_stops_and_of_its_lens(tmp_path):
    low = CameraAt("low", place_m=(0.0, -0.5, 0.7), state_intrinsics=False)
    cell = simulate(replace(ONE_ARM, cameras=(low,), stops=1, lens_views=1))
    session = Session.load(write_session(cell, tmp_path / "cell"))
    assert session.digest() == cell_session(cell, "cell").digest()
    assert all(session.images.exists(view.image) for view in session.views)
    of_lens = [view.image for view in session.views if view.is_of_lens]
    assert of_lens == [f"lens_low/{cell.sights[-1].view:04d}.png"]
    assert session.cameras["low"].matrix is None


def test_robots_of_a_whole_cell_give_way_and_carry_what_rows_say():
    loads = (Payload(), Payload(5.0, (0.0, 0.0, 0.1)))
    soft = RobotAt(
        "a",
        (-0.6, 0.0, 0.0),
        robot_sigma_m=0.0,
        robot_sigma_rad=0.0,
        compliance_rad_per_nm=(1e-5,) * 6,
        backlash_rad=(0.0, 1e-3, 0.0, 0.0, 0.0, 0.0),
        payloads=loads,
    )
    cell = simulate(replace(ONE_ARM, robots=(soft,)))
    for robot in (soft, replace(soft, payloads=())):
        expected = robot.flange_at(
            cell.robots["a"].true_arm,
            cell.robots["a"].joints,
            robot.loads(STOPS),
            np.resize([-1.0, 1.0], STOPS),
        )
        away = np.abs(expected - cell.robots["a"].true_base_from_flange).max(axis=(1, 2))
        # The second load of 5 kg bends the arm by some tenths of a millimetre.
        assert (away[::2] < 1e-12).all()
        assert (away[1::2] > 1e-5).all() == (not robot.payloads)
    for view in cell_session(cell, "cell", seen="corners").views:
        if view.text.get("robot"):
            assert view.numbers["payload_kg"] == loads[view.stop % 2].kg
            assert view.text["approach"] == "-+"[view.stop % 2]


def test_one_robot_with_one_camera_is_a_cell_whose_things_have_no_names():
    single = simulate(CellOptions(views=4, second=Second()))
    assert single.robot_of("cam") == ""
    assert single.robot_of("target_first") is None
    for sight in single.sights:
        board = single.mountings[f"target_{sight.board}"]
        flange = single.robot.true_base_from_flange[sight.stop]
        seen = invert(flange @ single.mountings["cam"]) @ board
        # A product of matrices of order one.
        np.testing.assert_allclose(seen, sight.cam_from_target, atol=1e-12)
