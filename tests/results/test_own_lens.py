"""A transform that holds with its own lens only, and in the frame of its centre ray with any."""

import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from support.beyond import an_error, moved, with_error, with_field
from support.cells import calibrated, showing
from support.commands import visioncal
from support.samples import made_up

from visioncal.calibration.pipeline.result import result_of
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.interchange.exports import Selection, document
from visioncal.interchange.exports.registry import EXPORT_FORMATS, select
from visioncal.present.report.page import write_certificate
from visioncal.results import Calibration, Edge, to_document
from visioncal.results.compare import compare
from visioncal.results.lens import ray_frame, sensor_tilt
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.boards import corners_m
from visioncal.vision.camera import matrix_3x3

NAME = "flange_from_cam"
# A sensor tilted by a degree about each of its axes, behind a lens that is not decentred.
TILT_DEG = np.array([1.0, 1.0])
ORDINARY = CellOptions(
    views=20, state_intrinsics=False, pixel_sigma_px=0.05, robot_sigma_m=5e-5, robot_sigma_rad=1e-4
)
TEXT = next(form for form in EXPORT_FORMATS if form.name == "text")


def tilted_lens(camera):
    """OpenCV's 14 coefficients of the lens without decentring, before a tilted sensor."""
    coefficients = np.zeros(14)
    coefficients[:5] = camera.distortion[:5]
    coefficients[2:4] = 0.0
    coefficients[12:] = np.deg2rad(TILT_DEG)
    return coefficients


def behind_tilted_sensor(cell):
    """The cell, and the corners that its camera shows with a tilted sensor."""
    rng = np.random.default_rng(cell.options.seed)
    camera = cell.options.camera
    board = corners_m(cell.board())
    shown = []
    for pose, corners in zip(cell.cam_from_target, cell.corners, strict=True):
        points = board[corners.ids] @ pose[:3, :3].T + pose[:3, 3]
        px, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), matrix_3x3(camera), tilted_lens(camera)
        )
        noise = rng.normal(0.0, cell.options.pixel_sigma_px, (len(points), 2))
        shown.append(replace(corners, px=px[:, 0] + noise))
    return showing(cell, shown)


def write_lens(path, camera, coefficients):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.resolution[0])
    storage.write("image_height", camera.resolution[1])
    storage.write("camera_matrix", matrix_3x3(camera))
    storage.write("distortion_coefficients", coefficients[None])
    storage.release()
    return path


@pytest.fixture(scope="module")
def cell():
    return behind_tilted_sensor(simulate(replace(ORDINARY, seed=1)))


@pytest.fixture(scope="module")
def result(cell):
    return result_of(calibrated(cell, joints=False))


def test_a_tilted_sensor_is_a_condition_with_its_size(cell, result):
    (condition,) = result.conditions
    assert condition.kind == "own-lens"
    error_deg = np.rad2deg(
        np.linalg.norm(log(invert(result.edges[NAME].matrix) @ cell.transforms[NAME])[:3])
    )
    assert error_deg == pytest.approx(np.linalg.norm(TILT_DEG), rel=0.1)
    assert error_deg > 10.0 * result.edges[NAME].sigma_deg
    tilt = sensor_tilt(result.camera)
    # The noise, and a tenth for the orders of distortion that decentring does not follow.
    within = 3.0 * tilt.sigma_rad + 0.1 * np.deg2rad(error_deg)
    assert tilt.rad == pytest.approx(np.deg2rad(error_deg), abs=within)


def test_every_output_carries_it_but_where_no_lens_counts(result, tmp_path):
    (condition,) = result.conditions
    write_certificate(tmp_path / "page.html", result, None, {})
    assert "own lens" in (tmp_path / "page.html").read_text()
    assert "own lens" in result._repr_html_()
    for name in ("ur", "kuka", "urdf", "easy-handeye", "zivid"):
        assert condition.words in document(result, name).warnings, name
    # OpenCV's file holds the lens; the board's place is seen by any lens at the same place.
    assert condition.words not in document(result, "opencv").warnings
    assert document(result, "ur", Selection(edge="base_from_target")).warnings == ()


@pytest.mark.slow
def test_for_the_true_lens_the_transform_is_right_within_its_sigma(tmp_path):
    squared, turns_deg = [], []
    seeds = range(2, 10)
    for seed in seeds:
        cell = behind_tilted_sensor(simulate(replace(ORDINARY, seed=seed)))
        result = result_of(calibrated(cell, joints=False))
        camera = cell.options.camera
        path = write_lens(tmp_path / f"{seed}.yaml", camera, tilted_lens(camera))
        edge = select(result, Selection(lens=path), TEXT).edge
        error = log(invert(edge.matrix) @ cell.transforms[NAME])
        squared.append(error @ np.linalg.solve(edge.covariance, error))
        turns_deg.append(np.rad2deg(np.linalg.norm(error[:3])))
    # Neither end of the distribution is reached by chance in one of ten thousand.
    assert chi2.ppf(1e-4, 6 * len(seeds)) < sum(squared) < chi2.isf(1e-4, 6 * len(seeds))
    assert max(turns_deg) < 0.05 * np.linalg.norm(TILT_DEG)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_an_ordinary_lens_has_no_condition(seed):
    """Its decentring is that of the simulated wide lens, which is significant."""
    result = result_of(calibrated(simulate(replace(ORDINARY, seed=seed)), joints=False))
    assert np.abs(result.camera.camera.distortion[2:4]).max() > 1e-4
    assert result.conditions == ()


def test_for_its_own_lens_the_transform_is_as_it_was(result, tmp_path):
    plain = replace(result, camera=replace(result.camera, field=None))
    camera = plain.camera.camera
    path = write_lens(tmp_path / "own.yaml", camera, camera.distortion)
    edge = select(plain, Selection(lens=path), TEXT).edge
    # Both lenses are inverted to 1e-9 of the plane.
    np.testing.assert_allclose(edge.matrix, plain.edges[NAME].matrix, atol=1e-8)


def test_the_command_writes_it_and_names_the_lens(result, cell, tmp_path):
    result.save(tmp_path / "calibration.json")
    camera = cell.options.camera
    path = write_lens(tmp_path / "theirs.yaml", camera, tilted_lens(camera))
    done = visioncal("export", tmp_path / "calibration.json", "--to", "text", "--lens", path)
    found = np.loadtxt(io.StringIO(done.out))
    np.testing.assert_allclose(
        found, select(result, Selection(lens=path), TEXT).edge.matrix, atol=1e-12
    )
    assert "theirs.yaml" in done.out
    opencv = document(result, "opencv", Selection(lens=path)).text
    assert "distortion_coefficients" not in opencv


SAMPLE = made_up(4).calibration


def test_its_covariance_agrees_with_central_differences():
    calibration = with_field(SAMPLE)
    error = an_error(calibration, seed=1)
    found = with_error(calibration, error).ray_frame.transform
    ahead, behind = (
        moved(calibration, sign * 1e-3 * error).ray_frame.transform.matrix for sign in (1, -1)
    )
    slope = log(invert(behind) @ ahead) / 2e-3
    # Truncation of second order in a step of a thousandth, relative; and the field's columns follow
    # the intrinsics, to which they are orthogonal, by a thousandth.
    expected = np.outer(slope, slope)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-3 * slope @ slope)


def test_z_runs_along_the_ray_that_the_whole_lens_has():
    calibration = with_field(SAMPLE)
    found, lens = calibration.ray_frame, calibration.camera
    ray = found.cam_from_ray[:3, 2]
    x, y = ray[:2] / ray[2]
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = lens.camera.distortion
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    plane = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ]
    shown = lens.camera.matrix[:2] * plane + lens.camera.matrix[2:]
    beyond = lens.displacements(found.px[None])[0] @ lens.field.coefficients
    np.testing.assert_allclose(shown + beyond, found.px, atol=1e-9)
    np.testing.assert_array_equal(found.px, (np.array(lens.camera.resolution) - 1.0) / 2.0)


def test_two_lenses_of_one_camera_are_no_move():
    """A lens that is taken for a turned one turns the camera's transform, and no ray."""
    lens = SAMPLE.camera
    shifted = replace(lens.camera, matrix=lens.camera.matrix + np.array([0.0, 0.0, 25.0, -18.0]))
    other = replace(lens, camera=shifted)
    edge = SAMPLE.edges[NAME]
    turns = [ray_frame(NAME, edge, camera_result).cam_from_ray for camera_result in (lens, other)]
    edges = {**SAMPLE.edges, NAME: Edge(edge.matrix @ turns[0] @ invert(turns[1]), edge.covariance)}
    again = replace(SAMPLE, edges=edges, camera=other, session_sha256="0" * 64)
    assert np.abs(log(invert(edge.matrix) @ edges[NAME].matrix)[:3]).max() > 1e-2
    (camera, _) = compare(SAMPLE, again).edges
    assert not camera.is_change
    assert camera.moved_deg < 1e-6
    turned = {**SAMPLE.edges, NAME: Edge(edge.matrix @ exp(np.eye(6)[0] * 2e-2), edge.covariance)}
    assert compare(SAMPLE, replace(SAMPLE, edges=turned)).edges[0].rotation.is_change


def test_a_field_comes_back_from_its_file():
    calibration = with_field(SAMPLE)
    document = json.loads(json.dumps(to_document(calibration)))
    found = Calibration.from_json(json.dumps(document), "calibration.json")
    px = np.array([[100.0, 40.0], [300.0, 220.0]])
    for distance_m in (None, 0.8):
        np.testing.assert_array_equal(
            found.camera.in_model(px, distance_m), calibration.camera.in_model(px, distance_m)
        )
    written = document["ray_frame"]
    assert written["name"] == "flange_from_ray"
    np.testing.assert_allclose(written["transform"]["matrix"], found.ray_frame.transform.matrix)
    document["camera"]["field"]["coefficients"].pop()
    with pytest.raises(DataError, match=r"camera: field.coefficients has \d+ rows"):
        Calibration.from_json(json.dumps(document), "calibration.json")
