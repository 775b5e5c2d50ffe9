"""MuJoCo sees through the exported camera what the calibrated one sees."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from support.readers import of_quaternion
from support.samples import made_up

from visioncal.interchange.exports import Selection, document

SAMPLE = made_up(5).calibration
POINTS_M = np.array([[0.1, -0.05, 0.6], [-0.2, 0.1, 0.9], [0.0, 0.0, 0.5]])


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_point_falls_on_its_pixel(mount):
    name = {"eye-in-hand": "flange_from_cam", "eye-to-hand": "base_from_cam"}[mount]
    edge = SAMPLE.edges["flange_from_cam"]
    written = document(replace(SAMPLE, mount=mount, edges={name: edge}), "mujoco")
    body = ET.fromstring(written.text).find("worldbody/body")
    parent = name.partition("_from_")[0]
    assert (body.get("name"), body.find("site").get("name")) == (parent, parent)
    camera = body.find("camera")
    # MuJoCo: w first; x to the right, y up, looking along -z; the middle of the image ahead.
    w, *vector = (float(word) for word in camera.get("quat").split())
    rotation = of_quaternion(*vector, w)
    position = np.array([float(word) for word in camera.get("pos").split()])
    width, height = (int(word) for word in camera.get("resolution").split())
    focal_px = height / 2.0 / np.tan(np.deg2rad(float(camera.get("fovy"))) / 2.0)
    in_parent = POINTS_M @ edge.matrix[:3, :3].T + edge.matrix[:3, 3]
    x, y, z = ((in_parent - position) @ rotation).T
    seen = np.column_stack([focal_px * x / -z, -focal_px * y / -z])
    lens = SAMPLE.camera.camera
    assert (width, height) == lens.resolution
    ours = lens.matrix[1] * POINTS_M[:, :2] / POINTS_M[:, 2:]
    np.testing.assert_allclose(seen, ours, atol=1e-8)
    assert "distortion" in written.warnings[0]


def test_any_other_frame_is_a_site():
    body = ET.fromstring(document(SAMPLE, "mujoco", Selection("base_from_target")).text)
    sites = [site.get("name") for site in body.iter("site")]
    assert sites == ["base", "target"]
    assert body.find(".//camera") is None
