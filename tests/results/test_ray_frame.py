"""The camera's transform in the frame of its centre ray holds with any lens."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.beyond import an_error, moved, with_error, with_field
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.results import Calibration, Edge, to_document
from visioncal.results.compare import compare
from visioncal.results.lens import ray_frame

NAME = "flange_from_cam"
SAMPLE = made_up(4).calibration


def test_covariance_of_the_ray_frame_agrees_with_central_differences():
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
