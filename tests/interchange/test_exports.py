"""Exports: what others read is the transform that was calibrated, whoever reads it."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from support import readers
from support.beyond import with_field
from support.commands import started, visioncal
from support.placed import fixture, tool
from support.readers import FIXTURE_READERS, READERS, TOOL_READERS
from support.refusals import raised
from support.rotations import CASES
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import Camera
from visioncal.interchange.exports import EXPORT_FORMATS, Selection, document, export
from visioncal.results import CameraResult, Edge
from visioncal.vision.camera import normalise, project_with_jacobian

NAMES = [export_format.name for export_format in EXPORT_FORMATS]
EDGE_NAMES = [name for name in NAMES if name not in readers.ARM_FORMATS]
ANGLES = {"urdf", "kuka", "fanuc", "yaskawa", "staubli", "doosan"}
LENSES = {"camera-info", "kalibr"}
RNG = np.random.default_rng(3)
SAMPLE = made_up(5).calibration


def poses(kind):
    rotations = np.array(CASES[kind])
    return compose(rotations, RNG.uniform(-2, 2, (len(rotations), 3)))


def calibration(matrix, mount="eye-in-hand", **changes):
    name = "flange_from_cam" if mount == "eye-in-hand" else "base_from_cam"
    other = "base_from_target" if mount == "eye-in-hand" else "flange_from_target"
    edges = {
        name: Edge(matrix, SAMPLE.edges["flange_from_cam"].covariance),
        other: SAMPLE.edges["base_from_target"],
    }
    return replace(SAMPLE, mount=mount, edges=edges, **changes)


def with_lens(model, distortion, estimated=False):
    camera = Camera(model, (1280, 800), np.array([801.1, 802.2, 640.3, 1 / 3]), distortion)
    return replace(SAMPLE, camera=CameraResult(camera, estimated=estimated))


def off(document, name, matrix):
    return float(np.abs(READERS[name](document) - matrix).max())


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("name", READERS)
def test_what_is_read_back_is_the_transform(name, kind):
    # A robot's form is written to the nanometre and to 1e-8 deg; other numbers to the last digit.
    tolerance = 1e-9
    if (kind == "near a pitch of 90" and name in ANGLES) or (kind, name) == ("tiny", "doosan"):
        # Within 1e-7 rad of its singularity an Euler triple is taken to be singular: twice that.
        tolerance = 2.1e-7
    for at, matrix in enumerate(poses(kind)):
        mount = ("eye-in-hand", "eye-to-hand")[at % 2]
        # What a lens would be warned of takes longer than all else.
        found = calibration(matrix, mount, camera=None)
        assert off(export(found, name), name, matrix) < tolerance


@pytest.mark.parametrize("name", sorted(set(READERS) - {"easy-handeye", "easy-handeye2"}))
@pytest.mark.parametrize("edge", ["flange_from_cam", "base_from_target"])
def test_any_edge_and_its_inverse(name, edge):
    matrix = SAMPLE.edges[edge].matrix
    # As above.
    assert off(export(SAMPLE, name, Selection(edge)), name, matrix) < 1e-9
    inverse = export(SAMPLE, name, Selection(edge, inverse=True))
    assert off(inverse, name, invert(matrix)) < 1e-9


def test_every_format_is_read_by_a_test_and_has_a_name_of_its_own():
    known = set(READERS) | set(TOOL_READERS) | set(FIXTURE_READERS) | LENSES
    assert set(NAMES) == known | set(readers.ARM_FORMATS)
    assert len(set(NAMES)) == len(NAMES)


def test_the_inverse_carries_the_covariance_along():
    # Seen from the board, a rotation error of the board moves the base by the lever arm.
    name = "base_from_target"
    edge = SAMPLE.edges[name]
    noise = RNG.multivariate_normal(np.zeros(6), edge.covariance, 20_000)
    moved = log(edge.matrix @ invert(edge.matrix @ exp(noise)))
    sampled_mm = 1e3 * np.sqrt(np.trace(np.cov(moved[:, 3:].T)))
    worth = export(SAMPLE, "text", Selection(name, inverse=True)).splitlines()[1]
    stated_mm = float(worth.partition("sigma ")[2].split()[0])
    # 20,000 samples know a standard deviation to half a percent, and two digits are stated.
    assert abs(stated_mm / sampled_mm - 1) < 0.05
    assert abs(edge.sigma_mm / sampled_mm - 1) > 0.1


def test_frames_stand_where_their_readers_look():
    chosen = Selection(parent="arm/tool-1", child="cam.2")
    transform = yaml.safe_load(export(SAMPLE, "ros", chosen))
    assert transform["header"]["frame_id"] == "arm/tool-1"
    assert transform["child_frame_id"] == "cam.2"
    options = readers.launch_arguments(export(SAMPLE, "ros-launch", chosen))
    assert (options["--frame-id"], options["--child-frame-id"]) == ("arm/tool-1", "cam.2")
    robot = ET.fromstring(export(SAMPLE, "urdf", chosen))
    assert robot.find("link").get("name") == "cam.2"
    joint = robot.find("joint")
    assert joint.get("type") == "fixed"
    assert (joint.find("parent").get("link"), joint.find("child").get("link")) == (
        "arm/tool-1",
        "cam.2",
    )


@pytest.mark.parametrize(
    ("mount", "kind", "base", "effector"),
    [
        ("eye-in-hand", "eye_in_hand", "base", "mine"),
        ("eye-to-hand", "eye_on_base", "mine", "tool0"),
    ],
)
def test_easy_handeye_has_all_fields_that_its_readers_take(mount, kind, base, effector):
    chosen = Selection(parent="mine", child="eye")
    document = yaml.safe_load(export(calibration(np.eye(4), mount), "easy-handeye2", chosen))
    assert document["parameters"] == {
        "name": "visioncal",
        "calibration_type": kind,
        "robot_base_frame": base,
        "robot_effector_frame": effector,
        "tracking_base_frame": "eye",
        "tracking_marker_frame": "target",
        "freehand_robot_movement": True,
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    first = yaml.safe_load(export(calibration(np.eye(4), mount), "easy-handeye", chosen))
    # Its reader takes these by name, and refuses any other.
    assert first["parameters"] == {
        "namespace": "/visioncal/",
        "eye_on_hand": mount == "eye-in-hand",
        "robot_base_frame": base,
        "robot_effector_frame": effector,
        "tracking_base_frame": "eye",
        "tracking_marker_frame": "target",
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }


BAD_NAMES = ['tool"0', "a b", "-x", "/world", "x\nimport os", "x'", "größe", "a<b", "${x}", "."]


@pytest.mark.parametrize("bad", BAD_NAMES)
def test_a_frame_name_that_could_end_its_quotes_is_refused(bad):
    placed = replace(SAMPLE, frames=tool() | fixture())
    for name in EDGE_NAMES:
        raised(DataError, "frame's name", export, placed, name, Selection(child=bad))


@pytest.mark.parametrize("name", sorted(READERS))
@pytest.mark.parametrize(
    "hostile",
    [
        "x\nimport os\n--> ]]> <a/> --- \u2028 \x85",
        'y """ coding: utf-7 +AAo-raise SystemExit',
        "größer {#} */ ; ! -",
    ],
)
def test_no_session_name_leaves_its_comment(name, hostile):
    named = calibration(poses("any")[0], session_name=hostile)
    plain = calibration(named.edges["flange_from_cam"].matrix)
    # The same text is read whatever stands in the comments.
    assert np.array_equal(READERS[name](export(named, name)), READERS[name](export(plain, name)))


LENS_CASES = [
    ("brown", np.array([0.1, -0.02, 1e-5, 1 / 3, 0.7]), "plumb_bob"),
    ("brown", np.array([0.1, -0.02, 1e-5, -2e-3, 0.7, 0.01, 1e-17, 3.0]), "rational_polynomial"),
    ("fisheye", np.array([0.1, -0.02, 1e-5, 1 / 7]), "equidistant"),
]


@pytest.mark.parametrize(("model", "distortion", "ros_model"), LENS_CASES)
def test_camera_info_holds_the_lens(model, distortion, ros_model):
    document = yaml.safe_load(export(with_lens(model, distortion), "camera-info"))

    def array(key):
        entry = document[key]
        return np.array(entry["data"]).reshape(entry["rows"], entry["cols"])

    k = np.array([[801.1, 0, 640.3], [0, 802.2, 1 / 3], [0, 0, 1]])
    assert (document["image_width"], document["image_height"]) == (1280, 800)
    assert document["camera_name"] == "camera"
    assert document["distortion_model"] == ros_model
    assert np.array_equal(array("camera_matrix"), k)
    assert np.array_equal(array("distortion_coefficients"), distortion[None])
    assert np.array_equal(array("rectification_matrix"), np.eye(3))
    assert np.array_equal(array("projection_matrix"), np.hstack([k, np.zeros((3, 1))]))


@pytest.mark.parametrize(
    ("model", "distortion", "kalibr_model"),
    [
        ("brown", np.array([0.1, -0.02, 1e-5, 1 / 3, 0.0]), "radtan"),
        ("brown", np.array([0.1, -0.02, 1e-5, 1 / 3, 0.0, 0.0, 0.0, 0.0]), "radtan"),
        ("fisheye", np.array([0.1, -0.02, 1e-5, 1 / 7]), "equidistant"),
    ],
)
def test_kalibr_holds_the_lens(model, distortion, kalibr_model):
    text = export(with_lens(model, distortion), "kalibr", Selection(child="left"))
    assert yaml.safe_load(text) == {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": [801.1, 802.2, 640.3, 1 / 3],
            "distortion_model": kalibr_model,
            "distortion_coeffs": distortion[:4].tolist(),
            "resolution": [1280, 800],
            "rostopic": "/left/image_raw",
        }
    }


@pytest.mark.parametrize(
    ("distortion", "words"),
    [([0.1, 0, 0, 0, 1e-9], "1 more"), ([0.1, 0, 0, 0, 0, 0.2, 0.3, 0], "2 more")],
)
def test_kalibr_refuses_what_radtan_cannot_hold(distortion, words):
    with pytest.raises(DataError, match=f"{words}.*camera-info"):
        export(with_lens("brown", np.array(distortion, float)), "kalibr")


@pytest.mark.parametrize(("model", "distortion"), [case[:2] for case in LENS_CASES])
def test_opencv_holds_the_lens_beside_the_transform(model, distortion):
    text = export(with_lens(model, distortion), "opencv")
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert np.array_equal(storage.getNode("distortion_coefficients").mat(), distortion[None])
    assert storage.getNode("camera_matrix").mat()[1, 2] == 1 / 3
    assert storage.getNode("distortion_model").string() == model
    assert storage.getNode("image_width").real() == 1280


def test_a_field_is_told_beside_the_coefficients_that_come_nearest_to_the_lens():
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


def exporting(*arguments):
    return visioncal("export", *arguments)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with a calibration.json."""
    folder = tmp_path_factory.mktemp("result, größer")
    SAMPLE.save(folder / "calibration.json")
    return folder


def test_the_command_prints_the_document_and_nothing_else(saved):
    done = started("export", saved, "--to", "ros")
    assert (done.status, done.err) == (0, "")
    assert done.out == export(SAMPLE, "ros")


def test_the_command_writes_a_file_once(saved, tmp_path):
    out = tmp_path / "camera.urdf"
    chosen = ["--edge", "base_from_target", "--inverse", "--parent", "board", "--child", "world"]
    done = exporting(saved / "calibration.json", "--to", "urdf", "-o", out, *chosen)
    assert (done.status, done.out) == (0, ""), done.err
    written = out.read_text(encoding="utf-8")
    # Written with all digits.
    assert off(written, "urdf", invert(SAMPLE.edges["base_from_target"].matrix)) < 1e-9
    exporting(saved, "--to", "text", "-o", out).refused("--force")
    assert out.read_text(encoding="utf-8") == written
    assert exporting(saved, "--to", "text", "-o", out, "--force").status == 0
    assert np.array_equal(readers.plain(out.read_text()), SAMPLE.edges["flange_from_cam"].matrix)


@pytest.mark.parametrize("name", ["", "session.toml"])
def test_a_session_is_to_be_calibrated_first(tmp_path, name):
    (tmp_path / "session.toml").write_text("schema = 1\n", encoding="utf-8")
    done = exporting(tmp_path / name, "--to", "ur")
    assert (done.status, done.out) == (2, "")
    assert f"Run visioncal calibrate {tmp_path}" in done.err
