"""Exports: what others read is the transform that was calibrated, or the tool, or the fixture."""

import json
import re
import shlex
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation
from support import placed, readers
from support.beyond import with_field
from support.commands import visioncal
from support.placed import BASE_FROM_FIXTURE, FIXTURE, FLANGE_FROM_TOOL, TOOL, fixture, tool
from support.readers import FIXTURE_READERS, READERS, TOOL_READERS
from support.refusals import raised
from support.rotations import CASES
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import Camera
from visioncal.interchange.exports import EXPORT_FORMATS, Selection, document, export
from visioncal.interchange.result_files import load_calibration, load_result_or_frames
from visioncal.results import Calibration, CameraResult, Edge, FrameFile, Verdict
from visioncal.results.depth import DepthCamera, DepthResult
from visioncal.vision.camera import (
    intrinsics,
    normalise,
    project,
    project_with_jacobian,
    with_intrinsics,
)

FORMATS = {export_format.name: export_format for export_format in EXPORT_FORMATS}
FRAME_READERS = TOOL_READERS | FIXTURE_READERS
NUMBERED = ("fanuc-utool", "fanuc-uframe")
# Those of easy_handeye hold the camera alone.
ANY_EDGE = sorted(set(READERS) - {"easy-handeye", "easy-handeye2"})
ANGLES = {"urdf", "kuka", "fanuc", "yaskawa", "staubli", "doosan", "kuka-tool", "kuka-base"}
ANGLES |= {*NUMBERED}
ANGLES |= {"halcon"}
ANGLES |= {"xarm", "mecademic", "kawasaki", "comau", "realman", "techman", "epson"}
# With the axes of its first and last angles nearly along each other.
TINY = {("tiny", name) for name in ("doosan", "kawasaki", "comau")}
RNG = np.random.default_rng(3)
SAMPLE = replace(made_up(5).calibration, frames={})
CELL = replace(SAMPLE, frames=tool() | fixture(source="points.csv"))
ALONE = placed.frame_file(tool(), fixture())


def calibration(matrix, mount="eye-in-hand", **changes):
    name = "flange_from_cam" if mount == "eye-in-hand" else "base_from_cam"
    other = "base_from_target" if mount == "eye-in-hand" else "flange_from_target"
    edges = {
        name: Edge(matrix, SAMPLE.edges["flange_from_cam"].covariance),
        other: SAMPLE.edges["base_from_target"],
    }
    return replace(SAMPLE, mount=mount, edges=edges, **changes)


def wanted(name, edge=None, **chosen):
    """The selection of a frame; FANUC's formats want to know which number they set."""
    return Selection(edge=edge, number=7 if name in NUMBERED else None, **chosen)


def off(name, text, matrix):
    return float(np.abs((READERS | FRAME_READERS)[name](text) - matrix).max())


@pytest.mark.parametrize("name", READERS | FRAME_READERS)
def test_the_exported_transform_is_read_back(name):
    for kind, rotations in CASES.items():
        # Robots' forms are written to the nanometre and to 1e-8 deg; others to the last digit.
        # FANUC's programs have 1e-6 deg, half of which may be cut from each of three angles.
        tolerance = 3e-8 if name in NUMBERED else 1e-9
        if (kind == "near a pitch of 90" and name in ANGLES) or (kind, name) in TINY:
            # Within 1e-7 rad of its singularity an Euler triple is taken to be singular: twice it.
            tolerance += 2.1e-7
        shifts = RNG.uniform(-2, 2, (len(rotations), 3))
        for at, matrix in enumerate(compose(np.array(rotations), shifts)):
            # What a lens would be warned of takes longer than all else.
            found = calibration(matrix, ("eye-in-hand", "eye-to-hand")[at % 2], camera=None)
            if name in FRAME_READERS:
                found = placed.frame_file(tool(matrix) if name in TOOL_READERS else fixture(matrix))
            assert off(name, export(found, name, wanted(name)), matrix) < tolerance, kind


@pytest.mark.parametrize("name", ANY_EDGE)
def test_any_edge_and_frame_and_its_inverse_are_exported(name):
    edges = {edge: found.matrix for edge, found in SAMPLE.edges.items()}
    frames = {TOOL: FLANGE_FROM_TOOL, FIXTURE: BASE_FROM_FIXTURE}
    for source, matrices in ((SAMPLE, edges), (CELL, frames), (ALONE, frames)):
        for edge, matrix in matrices.items():
            # As above.
            assert off(name, export(source, name, Selection(edge=edge)), matrix) < 1e-9
            inverse = export(source, name, Selection(edge=edge, inverse=True))
            assert off(name, inverse, invert(matrix)) < 1e-9


def test_the_depth_camera_is_a_frame_of_the_tree():
    depth_pose = compose(
        exp(np.array([0.01, -0.03, 0.005, 0, 0, 0]))[:3, :3], np.array([0.05, 0, 0.01])
    )
    lens = SAMPLE.camera.camera
    depth = DepthResult(
        scale=1.0, offset_m=0.0, tilt_m=(0.0, 0.0), bowl_m=0.0, covariance=np.eye(5) * 1e-8,
        noise_m=(0.0, 1e-3), view_m=0.0, distances_m=(0.3, 1.0),
        by=DepthCamera(**vars(lens), cam_from_depth=depth_pose, sigmas=(1e-3, 2e-4)),
    )  # fmt: skip
    source = replace(SAMPLE, camera=replace(SAMPLE.camera, depth=depth))
    x = SAMPLE.edges["flange_from_cam"].matrix
    for name, matrix in (
        ("cam_from_depth", depth_pose),
        ("flange_from_depth", x @ depth_pose),
    ):
        for to in ("ros", "urdf", "kuka", "text"):
            assert off(to, export(source, to, Selection(edge=name)), matrix) < 1e-9
    stated = yaml.safe_load(export(source, "ros", Selection(edge="cam_from_depth")))
    assert stated["header"]["frame_id"] == "camera_optical_frame"
    assert stated["child_frame_id"] == "camera_depth_optical_frame"
    text = export(source, "text", Selection(edge="flange_from_depth"))
    sigma_mm = float(text.partition("sigma ")[2].split()[0])
    spread = log(invert(x @ depth_pose) @ x @ exp(RNG.multivariate_normal(
        np.zeros(6), SAMPLE.edges["flange_from_cam"].covariance, 20_000)) @ depth_pose)  # fmt: skip
    spread = spread + RNG.standard_normal(spread.shape) * np.repeat([1e-3, 2e-4], 3)
    worth = 1e3 * np.sqrt(np.trace(np.cov(spread[:, 3:].T)))
    assert sigma_mm == pytest.approx(worth, rel=0.06)  # of two digits
    # In the tree each frame has one parent.
    joints = ET.fromstring(export(source, "urdf", Selection(edge="all"))).findall("joint")
    ends = {(one.find("child").get("link"), one.find("parent").get("link")) for one in joints}
    assert ("camera_depth_optical_frame", "camera_optical_frame") in ends
    assert ("camera_optical_frame", "tool0") in ends
    assert len({child for child, _ in ends}) == len(joints)
    with pytest.raises(DataError, match="frame of a camera's body"):
        export(source, "ros", Selection(edge="flange_from_depth", child="camera_depth_frame"))


def test_every_format_is_read_by_a_test_and_has_a_name_of_its_own():
    known = {*READERS, *FRAME_READERS, *readers.ARM_FORMATS, "camera-info", "kalibr", "oak"}
    known |= {"halcon-camera"}
    assert FORMATS.keys() == known
    assert len(EXPORT_FORMATS) == len(known)


def test_the_inverse_carries_the_covariance_along():
    # Seen from the board, a rotation error of the board moves the base by the lever arm.
    name = "base_from_target"
    edge = SAMPLE.edges[name]
    noise = RNG.multivariate_normal(np.zeros(6), edge.covariance, 20_000)
    moved = log(edge.matrix @ invert(edge.matrix @ exp(noise)))
    sampled_mm = 1e3 * np.sqrt(np.trace(np.cov(moved[:, 3:].T)))
    worth = export(SAMPLE, "text", Selection(edge=name, inverse=True)).splitlines()[1]
    stated_mm = float(worth.partition("sigma ")[2].split()[0])
    # 20,000 samples know a standard deviation to half a percent, and two digits are stated.
    assert abs(stated_mm / sampled_mm - 1) < 0.05
    assert abs(edge.sigma_mm / sampled_mm - 1) > 0.1


# The optical frame of a RealSense in its camera_link: 15 mm to the left, and z forward (REP 103).
BODY = RigidTransform.from_components([0.0, 0.015, 0.0], Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]))


def stated(body_from_cam):
    return (*body_from_cam.translation, *body_from_cam.rotation.as_quat(canonical=True))


def of_the_body(body_from_cam, **changes):
    return Selection(child="camera_link", child_from_cam=stated(body_from_cam), **changes)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_frame_beside_the_optical_one_stands_where_the_camera_has_it(name, mount):
    for rotation in Rotation.random(4, rng=RNG):
        body = RigidTransform.from_components(RNG.uniform(-0.1, 0.1, 3), rotation)
        camera = RigidTransform.from_components(RNG.uniform(-1, 1, 3), Rotation.random(rng=RNG))
        wanted = camera * body.inv()
        found = calibration(camera.as_matrix(), mount)
        # As for the optical frame itself.
        assert off(name, export(found, name, of_the_body(body)), wanted.as_matrix()) < 1e-9
        if name in ANY_EDGE:
            back = Selection(parent="camera_link", child_from_cam=stated(body), inverse=True)
            assert off(name, export(found, name, back), wanted.inv().as_matrix()) < 1e-9


def test_the_covariance_goes_to_the_frame_beside_the_optical_one():
    # Far beside the camera its rotation error is mostly one of place.
    edge, rng = SAMPLE.edges["flange_from_cam"], np.random.default_rng(3)
    body = RigidTransform.from_components([2.8, -2.0, 1.5], Rotation.random(rng=rng))
    away = body.inv().as_matrix()
    noise = rng.multivariate_normal(np.zeros(6), edge.covariance, 20_000)
    moved = log(invert(edge.matrix @ away) @ edge.matrix @ exp(noise) @ away)
    text = export(SAMPLE, "text", of_the_body(body))
    sampled_mm = 1e3 * np.sqrt(np.trace(np.cov(moved[:, 3:].T)))
    stated_mm = float(text.partition("sigma ")[2].split()[0])
    # As of the inverse.
    assert abs(stated_mm / sampled_mm - 1) < 0.05
    assert edge.sigma_mm < 0.5 * sampled_mm


def test_a_frame_of_a_cameras_body_keeps_its_lens():
    for name in ("ros", "mujoco", "text"):
        text = export(SAMPLE, name, of_the_body(BODY))
        assert "goes with the lens" in text
        assert "stands in it at (0, 0.015, 0, -0.5, 0.5, -0.5, 0.5)" in text
        assert "camera_link: the camera's optical frame" not in text
    site = ET.fromstring(export(SAMPLE, "mujoco", of_the_body(BODY))).findall(".//site")[1]
    assert site.get("name") == "camera_link"
    # A lens's name is no frame's.
    assert export(SAMPLE, "camera-info", Selection(child="camera_link"))


BODIES = ("camera_link", "arm/wrist_camera_link", "link", "camera_depth_frame", "rs_Color_frame")


@pytest.mark.parametrize("name", READERS)
def test_the_optical_pose_is_not_written_under_the_name_of_a_body(name):
    for body in BODIES:
        raised(DataError, f"{body}.*optical", export, SAMPLE, name, Selection(child=body))
    back = Selection(edge="flange_from_cam", inverse=True, parent="camera_link")
    if name in ANY_EDGE:
        raised(DataError, "camera_link.*optical", export, SAMPLE, name, back)
        assert export(SAMPLE, name, Selection(edge="base_from_target", child="board_link"))
    for optical in ("camera_color_optical_frame", "camera", "linked", "link_cam"):
        assert export(SAMPLE, name, Selection(child=optical))


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (
            Selection(child_from_cam=stated(BODY)),
            "without a name.*--child camera_link.*--inverse.*--parent",
        ),
        (
            Selection(edge="base_from_target", child="a", child_from_cam=stated(BODY)),
            "for target under",
        ),
        (Selection(child="a", child_from_cam=(0, 15, 0, 0, 0, 0, 1)), "0, 15, 0.*at most 3 m"),
        (Selection(child="a", child_from_cam=(0, 0, np.nan, 0, 0, 0, 1)), "missing"),
        (Selection(child="a", child_from_cam=(0, 0, 0, 0, 0, np.nan, 1)), "missing"),
        (Selection(child="a", child_from_cam=(0, 0, 0, 0, 0, 1)), "has 4"),
        (Selection(child="a", child_from_cam=(0, 0, 0, 0, 0, 0, 2)), "not a quaternion"),
    ],
)
def test_where_the_optical_frame_is_must_be_a_pose_of_a_named_frame(chosen, words):
    raised(DataError, words, export, SAMPLE, "ros", chosen)


def test_frames_stand_where_their_readers_look():
    chosen = Selection(parent="arm/tool-1", child="cam.2")
    transform = yaml.safe_load(export(SAMPLE, "ros", chosen))
    options = readers.launch_arguments(export(SAMPLE, "ros-launch", chosen))
    robot = ET.fromstring(export(SAMPLE, "urdf", chosen))
    joint = robot.find("joint")
    for found in (
        (transform["header"]["frame_id"], transform["child_frame_id"]),
        (options["--frame-id"], options["--child-frame-id"]),
        (joint.find("parent").get("link"), joint.find("child").get("link")),
    ):
        assert found == ("arm/tool-1", "cam.2")
    assert (robot.find("link").get("name"), joint.get("type")) == ("cam.2", "fixed")


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_easy_handeye_has_all_fields_that_its_readers_take(mount):
    in_hand = mount == "eye-in-hand"
    # Its reader takes these by name, and refuses any other.
    common = {
        "robot_base_frame": "base" if in_hand else "mine",
        "robot_effector_frame": "mine" if in_hand else "tool0",
        "tracking_base_frame": "eye",
        "tracking_marker_frame": "target",
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    fields = {
        "easy-handeye": {"namespace": "/visioncal/", "eye_on_hand": in_hand},
        "easy-handeye2": {
            "name": "visioncal",
            "calibration_type": "eye_in_hand" if in_hand else "eye_on_base",
            "freehand_robot_movement": True,
        },
    }
    for name, more in fields.items():
        text = export(calibration(np.eye(4), mount), name, Selection(parent="mine", child="eye"))
        assert yaml.safe_load(text)["parameters"] == common | more


def test_a_point_falls_on_its_pixel_in_mujoco():
    edge, lens = SAMPLE.edges["flange_from_cam"], SAMPLE.camera.camera
    written = document(SAMPLE, "mujoco")
    camera = ET.fromstring(written.text).find("worldbody/body/camera")
    # MuJoCo: w first; x to the right, y up, looking along -z; the middle of the image ahead.
    w, *vector = map(float, camera.get("quat").split())
    position = np.array(camera.get("pos").split(), dtype=float)
    width, height = map(int, camera.get("resolution").split())
    assert (width, height) == lens.resolution
    focal_px = height / 2.0 / np.tan(np.deg2rad(float(camera.get("fovy"))) / 2.0)
    points_m = np.array([[0.1, -0.05, 0.6], [-0.2, 0.1, 0.9], [0.0, 0.0, 0.5]])
    in_parent = points_m @ edge.matrix[:3, :3].T + edge.matrix[:3, 3]
    x, y, z = ((in_parent - position) @ readers.of_quaternion(*vector, w)).T
    seen = np.column_stack([focal_px * x / -z, -focal_px * y / -z])
    ours = lens.matrix[1] * points_m[:, :2] / points_m[:, 2:]
    np.testing.assert_allclose(seen, ours, atol=1e-8)
    assert "distortion" in written.warnings[0]


# --- Names.

BAD_NAMES = ['tool"0', "a b", "-x", "/world", "x\nimport os", "x'", "größe", "a<b", "${x}", "."]
NOT_RAPID = ["2nd", "_tool", "tool.1", "a-b", "a/b", "tool0", "WOBJ0", "Test", "x" * 33]


def test_a_name_that_its_format_does_not_take_is_refused():
    edges = [name for name in FORMATS if name not in readers.ARM_FORMATS]
    cases = [(edges, BAD_NAMES, "frame's name")]
    cases += [(["abb-tooldata", "abb-wobjdata"], NOT_RAPID, r"RAPID.*--child")]
    cases += [(["ur-feature"], ["2nd", "a.b", "a-b", "end", "True"], r"URScript.*--child")]
    for names, bad_names, words in cases:
        for name in names:
            for bad in bad_names:
                raised(DataError, words, export, CELL, name, Selection(child=bad))
    assert export(CELL, "abb-tooldata", Selection(child="x" * 32))
    # A call of set_tcp has no name in it.
    assert export(CELL, "ur-tcp", Selection(child="end"))


@pytest.mark.parametrize(
    "hostile",
    [
        "x\nimport os\n--> ]]> <a/> --- \u2028 \x85",
        'y """ coding: utf-7 +AAo-raise SystemExit',
        "größer {#} */ ; ! -",
        'x\nset_tcp(p[0])\r\nENDMODULE ; } !\u2028"',
    ],
)
def test_no_name_of_a_session_or_source_leaves_its_comment(hostile):
    frames = tool(source=hostile) | fixture(source=hostile)
    named = replace(CELL, session_name=hostile, frames=frames)
    for name, read in (READERS | FRAME_READERS).items():
        # The same is read whatever stands in the comments.
        ours, theirs = (export(source, name, wanted(name)) for source in (named, CELL))
        assert np.array_equal(read(ours), read(theirs)), name


# --- Lenses.


def with_lens(model, distortion, estimated=False):
    lens = np.array(distortion, dtype=float)
    camera = Camera(model, (1280, 800), np.array([801.1, 802.2, 640.3, 1 / 3]), lens)
    return replace(SAMPLE, camera=CameraResult(camera, estimated=estimated))


@pytest.mark.parametrize(
    ("model", "distortion", "ros_model", "kalibr_model"),
    [
        ("brown", [0.1, -0.02, 1e-5, 1 / 3, 0.7], "plumb_bob", ""),
        ("brown", [0.1, -0.02, 1e-5, -2e-3, 0.7, 0.01, 1e-17, 3.0], "rational_polynomial", ""),
        ("brown", [0.1, -0.02, 1e-5, 1 / 3, 0.0, 0.0, 0.0, 0.0], "rational_polynomial", "radtan"),
        ("fisheye", [0.1, -0.02, 1e-5, 1 / 7], "equidistant", "equidistant"),
    ],
)
def test_lenses_are_written_to_the_last_digit(model, distortion, ros_model, kalibr_model):
    source = with_lens(model, distortion)
    info = yaml.safe_load(export(source, "camera-info"))
    k = np.array([[801.1, 0, 640.3], [0, 802.2, 1 / 3], [0, 0, 1]])
    assert (info["image_width"], info["image_height"]) == (1280, 800)
    assert (info["camera_name"], info["distortion_model"]) == ("camera", ros_model)
    for key, expected in (
        ("camera_matrix", k),
        ("distortion_coefficients", [distortion]),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", np.hstack([k, np.zeros((3, 1))])),
    ):
        entry = info[key]
        found = np.array(entry["data"]).reshape(entry["rows"], entry["cols"])
        assert np.array_equal(found, expected)
    flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    stored = cv2.FileStorage(export(source, "opencv"), flags)
    assert np.array_equal(stored.getNode("distortion_coefficients").mat(), [distortion])
    assert stored.getNode("camera_matrix").mat()[1, 2] == 1 / 3
    assert stored.getNode("distortion_model").string() == model
    assert stored.getNode("image_width").real() == 1280
    if not kalibr_model:
        raised(DataError, r"[14] more.*--lens radtan", export, source, "kalibr")
        return
    assert yaml.safe_load(export(source, "kalibr", Selection(child="left")))["cam0"] == {
        "camera_model": "pinhole",
        "intrinsics": [801.1, 802.2, 640.3, 1 / 3],
        "distortion_model": kalibr_model,
        "distortion_coeffs": distortion[:4],
        "resolution": [1280, 800],
        "rostopic": "/left/image_raw",
    }


@pytest.mark.parametrize(
    ("model", "distortion", "most_px"),
    [
        # Its polynomial is of the inverse: what it cannot hold grows with the distortion.
        ("brown", [-0.01, 0.0, 1e-5, -2e-5, 0.0], 1e-3),
        ("brown", [-0.3, 0.12, 5e-4, -1e-3, -0.02], 0.5),
        ("fisheye", [0.02, -0.01, 0.004, -0.001], 0.01),
    ],
)
def test_halcon_undistorts_its_lens_as_opencv_does(model, distortion, most_px):
    camera = Camera(
        model, (1280, 800), np.array([1400.1, 1402.2, 640.3, 395.2]), np.array(distortion)
    )
    source = replace(SAMPLE, camera=CameraResult(camera, estimated=True))
    written = document(source, "halcon-camera")
    found = readers.halcon_camera(written.text)
    assert (found["ImageWidth"], found["ImageHeight"]) == camera.resolution
    axes = (np.linspace(0, side - 1, 13) for side in camera.resolution)
    px = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    # MVTec, calibrate_cameras: distorted places u, v of the image plane to undistorted ones.
    u, v = (px.T - [[found["Cx"]], [found["Cy"]]]) * [[found["Sx"]], [found["Sy"]]]
    k1, k2, k3, p1, p2 = (found[f"Poly{at}"] for at in range(1, 6))
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    plane = [
        u * radial + p1 * (r2 + 2 * u * u) + 2 * p2 * u * v,
        v * radial + 2 * p1 * u * v + p2 * (r2 + 2 * v * v),
    ]
    matrix = np.array([[1400.1, 0, 640.3], [0, 1402.2, 395.2], [0, 0, 1]])
    if model == "fisheye":
        rays = cv2.fisheye.undistortPoints(px[:, None], matrix, camera.distortion)[:, 0]
    else:
        # To its end: by default it stops after five steps.
        ends = (cv2.TERM_CRITERIA_COUNT, 100, 0.0)
        none = (np.eye(3), np.eye(3))
        rays = cv2.undistortPointsIter(px[:, None], matrix, camera.distortion, *none, ends)[:, 0]
    off_px = np.abs(1400.1 * (np.array(plane).T / found["Focus"] - rays)).max()
    assert off_px < most_px
    stated_px = float(re.search(r"leaves at most (?:under )?(\S+) px", written.text)[1])
    assert off_px <= stated_px
    assert any("HALCON" in words for words in written.warnings) == (stated_px > 0.05)


def test_halcon_holds_no_rays_beside_the_plane():
    source = with_lens("fisheye", [-0.05, 0.0, 0.0, 0.0])
    wide = replace(source.camera.camera, matrix=np.array([300.0, 300.0, 640.0, 400.0]))
    source = replace(source, camera=replace(source.camera, camera=wide))
    raised(DataError, r"80 degrees.*camera-info", export, source, "halcon-camera")


@pytest.mark.parametrize("name", ["pinhole", "radtan", "plumb_bob"])
@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("brown", [-0.1, 0.05, 5e-4, -1e-3, 0.0, 0.2, 0.1, 0.05]),
        ("fisheye", [0.02, -0.01, 0.004, -0.001]),
    ],
)
def test_a_poorer_lens_sees_the_same_rays_as_near_as_stated(name, model, distortion):
    camera = Camera(
        model, (1280, 800), np.array([1400.1, 1402.2, 640.3, 395.2]), np.array(distortion)
    )
    source = replace(SAMPLE, camera=CameraResult(camera, estimated=True))
    written = document(source, "opencv", Selection(lens=name))
    storage = cv2.FileStorage(written.text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    matrix, flat = (
        storage.getNode(node).mat() for node in ("camera_matrix", "distortion_coefficients")
    )
    numbers = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    found = Camera("brown", camera.resolution, numbers, flat.ravel())
    # What a model is without is zero.
    assert np.count_nonzero(found.distortion) == {"pinhole": 0, "radtan": 4, "plumb_bob": 5}[name]
    axes = (np.linspace(0, side - 1, 31) for side in camera.resolution)
    px = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    rays = np.column_stack([normalise(camera, px), np.ones(len(px))])
    off_px = np.linalg.norm(project(found, rays) - px, axis=1)
    (words,) = (words for words in written.warnings if "--lens" in words)
    number = r"(?:under )?(\S+) px"
    rms_px, most_px = map(float, re.search(rf"leaves {number} rms .*, {number} at", words).groups())
    # As they are printed, by two digits; small ones as a bound.
    found_px = float(np.sqrt(np.mean(off_px**2)))
    assert found_px < 1.05 * rms_px
    assert off_px.max() <= most_px
    assert "under" in words or (rms_px < 1.05 * found_px and most_px < 1.1 * off_px.max())
    # No neighbouring lens of this model is nearer.
    for at, step in enumerate((1.0, 1.0, 1.0, 1.0, *[1e-3] * np.count_nonzero(found.distortion))):
        for sign in (-step, step):
            moved = with_intrinsics(found, intrinsics(found) + sign * np.eye(9)[at])
            assert np.sum((project(moved, rays) - px) ** 2) > np.sum(off_px**2)


def test_a_lens_within_a_poorer_model_stays_as_it_is():
    source = with_lens("brown", [0.1, -0.02, 1e-3, 1e-4, 0.0])
    written = document(source, "kalibr", Selection(lens="radtan"))
    found = yaml.safe_load(written.text)["cam0"]
    np.testing.assert_allclose(found["distortion_coeffs"], [0.1, -0.02, 1e-3, 1e-4], atol=1e-9)
    raised(
        DataError, "kuka has no place for --lens", export, SAMPLE, "kuka", Selection(lens="radtan")
    )
    raised(DataError, "pinhole", export, source, "kalibr", Selection(lens="pinehole"))


def test_a_field_is_reported_beside_the_coefficients_that_come_nearest_to_the_lens():
    result = with_field(SAMPLE)
    found = document(result, "opencv")
    said = found.warnings[0]
    assert said.startswith("the lens departs from its model")
    assert said.rstrip(".") in found.text
    camera = result.camera.camera
    axes = (np.linspace(20.0, side - 20.0, 15) for side in camera.resolution)
    px = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = normalise(camera, result.camera.in_model(px))
    projected = project_with_jacobian(camera, np.column_stack([rays, np.ones(len(px))]))
    left = px - projected.px
    rms_px, most_px = (float(value) for value in re.findall(r"([\d.]+) px", said))
    # The weights are those of what is known, a little larger in the middle.
    assert rms_px == pytest.approx(np.sqrt(np.mean(left**2)), rel=0.15)
    assert rms_px < most_px < 5 * rms_px
    # The field is orthogonal to the intrinsics over the image: no others leave less.
    columns = projected.jacobian_intrinsics.reshape(2 * len(px), -1)
    taken = columns @ np.linalg.lstsq(columns, left.ravel(), rcond=None)[0]
    assert np.linalg.norm(taken) < 0.45 * np.linalg.norm(left)


# --- What makers themselves have published of tools and fixtures.

# ABB, RAPID reference manual, data types, tooldata and wobjdata: "Examples".
GRIPPER = """PERS tooldata gripper := [ TRUE, [[97.4, 0, 223.1], [0.924, 0, 0.383 ,0]],
[5, [23, 0, 75], [1, 0, 0, 0], 0, 0, 0]];"""
WOBJ2 = """PERS wobjdata wobj2 :=[ FALSE, TRUE, "", [ [300, 600, 200], [1, 0, 0 ,0] ],
[ [0, 200, 30], [1, 0, 0 ,0] ] ];"""
# Universal Robots, script manual, `set_tcp` and `pose_trans`: "Example command".
SET_TCP = "set_tcp(p[0.,.2,.3,0.,3.14,0.])"
POSE = "p[.2,.5,.1,1.57,0,0]"
# A KR 210 R2700-2's own $CONFIG.DAT (github.com/HugoDanielson/ChinaMilling, KRC/R1/System).
TOOL_DATA = "TOOL_DATA[3]={X 409.434326,Y 3.01155138,Z 166.257782,A -90.0000,B 0.0,C 90.0000}"
BASE_DATA = (
    "BASE_DATA[1]={X 924.139893,Y 1099.00952,Z 527.833740,"
    "A -89.7931595,B 0.238999218,C -0.0562113412}"
)


def rounded(text, mark):
    """A document without comments and spaces, its numbers with three decimals alike."""
    plain = re.sub(r"\s", "", readers.code(text, mark))
    return re.sub(r"-?(\d+\.?\d*|\.\d+)", lambda pair: f"{float(pair[0]):.3f}", plain)


def test_the_gripper_of_abbs_manual_is_written_as_printed():
    # In the manual's words: turned by 45 deg, 223.1 mm straight out and 97.4 mm along x, 5 kg.
    matrix = readers.transform(readers.ry(np.pi / 4), [0.0974, 0, 0.2231])
    # The manual's quaternion has three digits, by which a matrix is off by up to four times that.
    assert off("abb-tooldata", GRIPPER, matrix) < 2e-3
    chosen = Selection(child="gripper", mass_kg=5.0, cog_mm=(23.0, 0.0, 75.0))
    ours = export(placed.frame_file(tool(matrix)), "abb-tooldata", chosen)
    kind, name, (held, (position, quaternion), load) = readers.rapid(ours)
    assert (kind, name) == readers.rapid(GRIPPER)[:2]
    theirs = readers.rapid(GRIPPER)[2]
    assert [held, position, load] == [theirs[0], theirs[1][0], theirs[2]]
    # Their three digits.
    assert np.abs(np.subtract(quaternion, theirs[1][1])).max() < 5e-4


def test_the_work_object_of_abbs_manual_is_written_as_printed():
    # Rounding of doubles.
    assert off("abb-wobjdata", WOBJ2, readers.transform(np.eye(3), [0.3, 0.8, 0.23])) < 1e-12
    user = readers.transform(np.eye(3), [0.3, 0.6, 0.2])
    ours = export(placed.frame_file(fixture(user)), "abb-wobjdata", Selection(child="wobj2"))
    kind, name, value = readers.rapid(WOBJ2)
    # All of the fixture goes into the user frame; the object's own is left where it is.
    assert readers.rapid(ours) == (kind, name, [*value[:4], [[0, 0, 0], [1, 0, 0, 0]]])


def test_tool_and_pose_of_urs_script_manual_are_written_as_printed():
    matrix = readers.transform(readers.of_rotation_vector(0, 3.14, 0), [0, 0.2, 0.3])
    # Rounding of doubles.
    assert off("ur-tcp", SET_TCP, matrix) < 1e-12
    assert rounded(export(placed.frame_file(tool(matrix)), "ur-tcp"), "#") == rounded(SET_TCP, "#")
    pose = readers.transform(readers.rx(1.57), [0.2, 0.5, 0.1])
    assert np.abs(readers.urscript_pose(POSE) - pose).max() < 1e-12
    ours = export(placed.frame_file(fixture(pose)), "ur-feature", Selection(child="p_from"))
    assert rounded(ours, "#") == rounded(f"globalp_from={POSE}", "#")


@pytest.mark.parametrize(
    ("name", "theirs", "number"), [("kuka-tool", TOOL_DATA, 3), ("kuka-base", BASE_DATA, 1)]
)
def test_kuka_frames_of_a_controllers_file_are_written_as_there(name, theirs, number):
    matrix = FRAME_READERS[name](theirs)
    frames = tool(matrix) if name == "kuka-tool" else fixture(matrix)
    ours = export(placed.frame_file(frames), name, Selection(number=number))
    assert rounded(ours, ";") == rounded(theirs, ";")
    active = export(placed.frame_file(frames), name)
    assert readers.kuka_named(active)[0] == ("$TOOL" if name == "kuka-tool" else "$BASE")


# A frame in the form in which ROBOGUIDE prints a program; as an example of that form served
# maketp/results/SETUP_FRAMES.printtp.LS of github.com/LeroyDu56/CrossArm.
SETUP_FRAMES = """/PROG  SETUP_FRAMES
/ATTR
OWNER\t\t= MNEDITOR;
COMMENT\t\t= "frames";
PROG_SIZE\t= 875;
CREATE\t\t= DATE 26-10-06  TIME 16:17:00;
MODIFIED\t= DATE 26-10-06  TIME 16:17:00;
FILE_NAME\t= ;
VERSION\t\t= 0;
LINE_COUNT\t= 3;
MEMORY_SIZE\t= 1191;
PROTECT\t\t= READ_WRITE;
TCD:  STACK_SIZE\t= 0,
      TASK_PRIORITY\t= 50,
      TIME_SLICE\t= 0,
      BUSY_LAMP_OFF\t= 0,
      ABORT_REQUEST\t= 0,
      PAUSE_REQUEST\t= 0;
DEFAULT_GROUP\t= 1,*,*,*,*;
CONTROL_CODE\t= 00000000 00000000;
/MN
   1:  !a tool ;
   2:  PR[100]=P[1]    ;
   3:  UTOOL[2]=PR[100] ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX =     0.000  mm,\tY =     0.000  mm,\tZ =   150.000  mm,
\tW =     0.000 deg,\tP =     0.000 deg,\tR =     0.000 deg
};
/END
"""


def test_fanuc_frames_of_a_controllers_program_are_written_as_there():
    theirs = readers.fanuc_program(SETUP_FRAMES)
    assert theirs["UTOOL[2]"][:3, 3].tolist() == [0, 0, 0.15]
    long = placed.frame(theirs["UTOOL[2]"], oriented=False)
    frames = {"flange_from_a_tool_with_a_very_long_name": long}
    text = export(placed.frame_file(frames), "fanuc-utool", Selection(number=2))
    assert np.array_equal(readers.fanuc_program(text)["UTOOL[2]"], theirs["UTOOL[2]"])
    assert text.startswith("/PROG  SET_UT2\r\n")

    def plain(line):
        return re.sub(r" +", " ", re.sub(r"^ *\d+:", "", line).replace(".000000", ".000"))

    # Every line but remarks, names and sizes stands in theirs as well.
    kept = {plain(line) for line in SETUP_FRAMES.splitlines()}
    others = [line for line in text.splitlines() if plain(line) not in kept and "!" not in line]
    words = ["/PROG", "COMMENT", "PROG_SIZE", "LINE_COUNT", "MEMORY_SIZE"]
    assert [other.split()[0] for other in others] == words
    remarks = re.findall(r"^ *\d+:  (!.*) ;\r?$", text, re.M)
    assert max(map(len, remarks)) == 32
    assert any(remark.endswith("no rotation") for remark in remarks)


# A device's own calibration as depthai 3.12 writes it, shortened to what is read and to a board.
OAK = {
    "boardName": "BW1098OBC",
    "cameraData": [
        [0, {"cameraType": 1, "distortionCoeff": [0.0] * 14, "height": 2160, "width": 3840}],
        [1, {"cameraType": 0, "extrinsics": {"toCameraSocket": 0}, "height": 800, "width": 1280}],
    ],
}


def test_a_lens_goes_into_an_oak_s_own_calibration_and_all_else_is_kept():
    lens = replace(SAMPLE.camera.camera, resolution=(1280, 800))
    source = replace(SAMPLE, camera=replace(SAMPLE.camera, camera=lens))
    text = export(source, "oak", Selection(onto=json.dumps(OAK)))
    (_, ours), other = json.loads(text)["cameraData"]
    assert (json.loads(text)["boardName"], other) == (OAK["boardName"], OAK["cameraData"][1])
    assert (ours["width"], ours["height"], ours["cameraType"]) == (3840, 2160, 0)
    # The sensor of 3840 x 2160 is scaled to cover 800 rows, and cropped to 1280 columns.
    scale, matrix = 800 / 2160, np.array(ours["intrinsicMatrix"])
    assert np.allclose(matrix[[0, 1], [0, 1]] * scale, lens.matrix[:2])
    crop = np.array([(3840 * scale - 1280) / 2, 0.0])
    assert np.allclose(matrix[:2, 2] * scale - crop, lens.matrix[2:])
    assert np.allclose(ours["distortionCoeff"][: len(lens.distortion)], lens.distortion)
    assert len(ours["distortionCoeff"]) == 14
    square = replace(source.camera, camera=replace(lens, resolution=(1280, 960)))
    with pytest.raises(DataError, match="another part of the sensor"):
        export(replace(source, camera=square), "oak", Selection(onto=json.dumps(OAK)))


# --- What is taken, and what is refused.


@pytest.mark.parametrize("name", FRAME_READERS)
def test_the_only_frame_of_its_kind_is_taken_and_none_of_the_other(name):
    edge, other = (TOOL, FIXTURE) if name in TOOL_READERS else (FIXTURE, TOOL)
    for source in (CELL, ALONE):
        assert export(source, name, wanted(name)) == export(source, name, wanted(name, edge))
    raised(DataError, f"{other} is none.*--to ", export, CELL, name, wanted(name, other))


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_options_that_a_format_cannot_hold_are_refused(name):
    load = {"mass_kg": 1.0, "cog_mm": (0.0, 0.0, 1.0)}
    given = {"number": {"number": 2}, "mass_kg": load}
    for what, chosen in given.items():
        if what not in FORMATS[name].takes:
            raised(DataError, "no place for", export, CELL, name, Selection(**chosen))


TWO = replace(SAMPLE, frames=tool() | {"flange_from_tool_2": placed.frame(FLANGE_FROM_TOOL)})


@pytest.mark.parametrize(
    ("source", "name", "chosen", "words"),
    [
        (SAMPLE, "rso", Selection(), "Did you mean ros"),
        (SAMPLE, "ros", Selection(edge="flange_from_cm"), "Did you mean flange_from_cam"),
        (SAMPLE, "ros", Selection(edge="cam_from_flange"), "--edge flange_from_cam --inverse"),
        (SAMPLE, "ros", Selection(parent="a", child="a"), "two frames"),
        (SAMPLE, "ur-tcp", Selection(), "visioncal tcp"),
        (replace(SAMPLE, camera=None), "camera-info", Selection(), "no camera"),
        (CELL, "kuka-tool", Selection(number=0), "from 1"),
        (CELL, "fanuc-utool", Selection(), "--number"),
        (CELL, "oak", Selection(), "eepromToJsonFile"),
        (CELL, "oak", Selection(onto="{}"), "is none of it"),
        (CELL, "oak", Selection(child="cam"), "CAM_A, CAM_B"),
        (CELL, "abb-tooldata", Selection(mass_kg=0.0, cog_mm=(0, 0, 1)), "mass above 0"),
        (CELL, "ur-tcp", Selection(inverse=True), "the inverse of"),
        (TWO, "ur-tcp", Selection(), "flange_from_tool, flange_from_tool_2"),
        (ALONE, "text", Selection(), "flange_from_tool, base_from_fixture"),
        (FrameFile({}), "text", Selection(), "no frames"),
    ],
)
def test_a_result_that_cannot_be_exported_is_refused(source, name, chosen, words):
    with pytest.raises(DataError) as caught:
        export(source, name, chosen)
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["camera-info", "kalibr"])
def test_an_absent_lens_is_named_with_the_possible_exports(name):
    refused = raised(DataError, "measured poses", export, replace(SAMPLE, camera=None), name)
    assert refused.culprits == ("calibration.json: camera",)
    (can,) = re.findall("--to ([a-z]+)", refused.next_step)
    assert export(replace(SAMPLE, camera=None), can)


def test_a_frame_has_its_own_origin_sigma_and_verdict():
    # The calibration itself comes from another file, of another day, with another verdict.
    bad = Verdict.of("bad", "Touch 4 is off by 7 mm.")
    frames = tool(verdict=bad) | fixture(source="points.csv", verdict=Verdict("good"))
    cell = replace(SAMPLE, frames=frames, verdict=Verdict.of("bad", "The views disagree."))
    notes = export(cell, "text", Selection(edge=FIXTURE)).splitlines()
    origin = f"# calibrated by visioncal from 'points.csv', {placed.CREATED}: pivot over 10 touches"
    edge = frames[FIXTURE].edge
    quality = f"# verdict good; sigma {edge.sigma_mm:.2g} mm and {edge.sigma_deg:.2g} deg"
    assert notes[:2] == [origin, quality]
    assert SAMPLE.session_name in export(cell, "text")
    assert document(cell, "ur-tcp").verdict == bad
    assert document(cell, "ur-feature").verdict == frames[FIXTURE].verdict
    assert document(cell, "ros").verdict == cell.verdict


# --- Files and the command.


def test_a_file_of_frames_is_known_by_its_content(tmp_path):
    file = tmp_path / "any name"
    ALONE.save(file)
    assert isinstance(load_result_or_frames(file), FrameFile)
    raised(DataError, "no calibration", load_calibration, file)
    SAMPLE.save(tmp_path / "calibration.json")
    CELL.save(tmp_path / "frames.json")
    # The calibration of a folder comes before the frames beside it.
    assert load_result_or_frames(tmp_path).frames == {}
    for name in ("calibration.json", "frames.json"):
        assert isinstance(load_result_or_frames(tmp_path / name), Calibration)


def exporting(*arguments):
    return visioncal("export", *arguments)


def test_the_command_takes_a_load_and_warns_without_one(tmp_path):
    CELL.save(tmp_path / "calibration.json")
    load = ["--mass-kg", "5", "--cog-mm", "23", "0", "-75.5"]
    done = exporting(tmp_path, "--to", "abb-tooldata", *load)
    assert (done.status, done.err) == (0, "")
    assert readers.rapid(done.out)[2][2][:2] == [5, [23, 0, -75.5]]
    done = exporting(tmp_path, "--to", "abb-tooldata").good()
    assert readers.rapid(done.out)[2][2] == [-1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]
    for words in ("warning:", "LoadIdentify", "--mass-kg"):
        assert words in done.err
    assert exporting(tmp_path, "--to", "abb-tooldata", *load[:2]).refused("--cog-mm").out == ""


def test_the_command_prints_the_document_or_writes_it_once(tmp_path):
    folder, out = tmp_path / "result, größer", tmp_path / "camera.urdf"
    folder.mkdir()
    SAMPLE.save(folder / "calibration.json")
    done = exporting(folder, "--to", "ros")
    assert (done.status, done.out, done.err) == (0, export(SAMPLE, "ros"), "")
    chosen = ["--edge", "base_from_target", "--inverse", "--parent", "board", "--child", "world"]
    done = exporting(folder / "calibration.json", "--to", "urdf", "-o", out, *chosen)
    assert (done.status, done.out) == (0, ""), done.err
    written = out.read_text(encoding="utf-8")
    # Written with all digits.
    assert off("urdf", written, invert(SAMPLE.edges["base_from_target"].matrix)) < 1e-9
    exporting(folder, "--to", "text", "-o", out).refused("--force")
    assert out.read_text(encoding="utf-8") == written
    assert exporting(folder, "--to", "text", "-o", out, "--force").status == 0
    assert np.array_equal(readers.plain(out.read_text()), SAMPLE.edges["flange_from_cam"].matrix)


def test_the_heading_and_the_doubt_go_along_with_every_format(tmp_path):
    doubted = replace(SAMPLE, verdict=Verdict.of("check", "View 7 was left out.", "Others agree."))
    doubted.save(tmp_path / "calibration.json")
    for name in ANY_EDGE:
        done = exporting(tmp_path, "--to", name).good()
        printed = done.out + done.err
        for words in (SAMPLE.created, "verdict check; sigma", "p_parent = R p_child + t", "lens"):
            assert printed.count(words) == 1 or words == "lens" in printed, (name, words)
        assert printed.count("View 7 was left out.") == 1
        assert "Others agree" not in printed
        # A controller that knows no comments is sent none.
        assert off(name, done.out, SAMPLE.edges["flange_from_cam"].matrix) < 1e-9


def test_the_command_for_a_body_is_printed_and_runs(tmp_path):
    SAMPLE.save(tmp_path / "calibration.json")
    camera = RigidTransform.from_matrix(SAMPLE.edges["flange_from_cam"].matrix)
    done = exporting(tmp_path, "--to", "ros", "--child", "camera_link").refused("optical frame")
    assert done.out == ""
    typed = shlex.split(done.err.rpartition("Run: ")[2])
    text = exporting(*typed[2:]).good().out
    turned = RigidTransform.from_rotation(BODY.rotation)
    assert yaml.safe_load(text)["child_frame_id"] == "camera_link"
    assert off("ros", text, (camera * turned.inv()).as_matrix()) < 1e-9


CASE = Path(__file__).parents[3] / "shared/data/field/cases/camera-link-export/case.md"


@pytest.mark.skipif(not CASE.is_file(), reason="the case is not beside this checkout")
def test_cases_of_public_threads_are_answered(tmp_path):
    SAMPLE.save(tmp_path / "calibration.json")
    thread = CASE.read_text(encoding="utf-8")
    xyz, rpy = (
        list(map(float, re.search(rf"{word} \(([^)]*)\)", thread)[1].split(",")))
        for word in ("xyz", "rpy")
    )
    # As a URDF has them: about fixed x, y, z.
    body = RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy, degrees=True))
    words = ",".join(map(repr, map(float, stated(body))))
    chosen = ("--child", "camera_link", "--child-from-cam", words)
    camera = RigidTransform.from_matrix(SAMPLE.edges["flange_from_cam"].matrix)
    for name in ("ros", "ros-launch", "urdf", "easy-handeye", "easy-handeye2"):
        text = exporting(tmp_path, "--to", name, *chosen).good().out
        assert off(name, text, (camera * body.inv()).as_matrix()) < 1e-9


@pytest.mark.parametrize("name", ["", "session.toml"])
def test_a_session_is_to_be_calibrated_first(tmp_path, name):
    (tmp_path / "session.toml").write_text("schema = 1\n", encoding="utf-8")
    done = exporting(tmp_path / name, "--to", "ur").refused(f"Run visioncal calibrate {tmp_path}")
    assert done.out == ""
