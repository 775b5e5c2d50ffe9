"""Exports of an aligned cell: any frame in any other, and all of them at once."""

import io
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support import placed
from support.aligned_cells import made_up_cell, with_cell

from visioncal.core.errors import DataError
from visioncal.core.files import write_json
from visioncal.core.transforms import adjoint, invert
from visioncal.interchange.exports import Selection, document, export
from visioncal.interchange.result_files import load_calibration, load_exportable
from visioncal.results import CameraResult, Verdict, to_document
from visioncal.session.selecting import Choice
from visioncal.simulation import fisheye_camera, wide_camera

CELL = made_up_cell(4)
POSE = {"rotation": ("x", "y", "z", "w"), "translation": ("x", "y", "z")}


def test_any_frame_is_written_in_any_other(tmp_path):
    write_json(tmp_path / "calibration.json", to_document(CELL))
    source = load_exportable(tmp_path)
    text = export(source, "text", Selection("base_b_from_cam_top"))
    expected = (
        invert(CELL.edges["cell_from_base_b"].matrix) @ CELL.edges["cell_from_cam_top"].matrix
    )
    # Numbers are written so that they read back as they are; the way takes a few roundings.
    assert np.allclose(np.loadtxt(io.StringIO(text)), expected, atol=1e-12)
    assert "aligned by visioncal from 'made up'" in text
    turned = export(source, "text", Selection("base_b_from_cam_top", inverse=True))
    assert np.allclose(np.loadtxt(io.StringIO(turned)) @ expected, np.eye(4), atol=1e-12)


FIXTURE = "base_b_from_jig"


@pytest.mark.parametrize(("name", "sign"), [("base_a_from_jig", 1), ("jig_from_base_a", -1)])
def test_a_fixture_of_one_robot_is_written_in_the_base_of_another(name, sign):
    jig = placed.frame(placed.BASE_FROM_FIXTURE, verdict=Verdict.of("bad", "It slips."))
    cell = replace(CELL, frames={FIXTURE: jig})
    far = CELL.between("base_a", "base_b").matrix @ jig.edge.matrix
    # The pieces are independent: each covariance goes through its own derivative.
    whole = np.zeros((6, 6))
    for edge, after in ((CELL.between("base_a", "base_b"), jig.edge.matrix), (jig.edge, np.eye(4))):
        slope = adjoint(invert(after) if sign > 0 else far @ invert(after))
        whole += slope @ edge.covariance @ slope.T
    found = cell.between(*name.split("_from_"))
    np.testing.assert_allclose(found.matrix, far if sign > 0 else invert(far), atol=1e-12)
    np.testing.assert_allclose(found.covariance, whole, atol=1e-12)
    text = export(cell, "text", Selection(name))
    assert np.allclose(np.loadtxt(io.StringIO(text)), found.matrix, atol=1e-12)
    assert "# verdict bad" in text


def test_a_fixture_without_rotation_says_whose_it_has_and_unknown_frames_list_it():
    jig = placed.frame(placed.BASE_FROM_FIXTURE, oriented=False)
    cell = replace(CELL, frames={FIXTURE: jig})
    text = export(cell, "text", Selection("cam_top_from_jig"))
    assert "rotation taken from base_b, not measured" in text
    with pytest.raises(DataError, match=r"no frame 'jog'.* jig") as caught:
        export(cell, "text", Selection("base_a_from_jog"))
    assert "Did you mean jig" in caught.value.next_step


def test_all_frames_are_one_tree():
    found = list(yaml.safe_load_all(export(CELL, "ros", Selection("all"))))
    hangs = {value["child_frame_id"]: value["header"]["frame_id"] for value in found}
    assert hangs == {
        name: on for name, on in CELL.cell.tree.items() if not name.startswith("flange")
    }
    robot = ElementTree.fromstring(export(CELL, "urdf", Selection("all")))
    links = [element.attrib["name"] for element in robot.findall("link")]
    assert sorted(links) == sorted(["cell", *hangs])
    joints = {
        element.find("child").attrib["link"]: element.find("parent").attrib["link"]
        for element in robot.findall("joint")
    }
    assert joints == hangs
    launch = export(CELL, "ros-launch", Selection("all"))
    assert launch.count("static_transform_publisher") == len(hangs)
    compile(launch, "launch", "exec")
    assert np.loadtxt(io.StringIO(export(CELL, "text", Selection("all")))).shape == (
        4 * len(hangs),
        4,
    )


def test_a_lens_is_that_of_the_camera_that_is_named():
    cameras = {
        "top": CameraResult(wide_camera(), False),
        "hand": CameraResult(fisheye_camera(), False),
    }
    cell = with_cell(CELL, cameras=cameras)
    for name, width in (("top", 1280), ("cam_hand", 1280)):
        info = yaml.safe_load(export(cell, "camera-info", Selection(camera=name)))
        assert info["image_width"] == width
    focal = {
        name: yaml.safe_load(export(cell, "camera-info", Selection(camera=name)))["camera_matrix"][
            "data"
        ][0]
        for name in ("top", "hand")
    }
    assert focal == {"top": 914.2, "hand": 563.0}
    with pytest.raises(DataError, match="holds one camera; this cell has cam_top, cam_hand"):
        export(cell, "camera-info")


@pytest.mark.parametrize(
    ("to", "selection", "words"),
    [
        ("ros", Selection(), r"and one is written.*--edge \w+_from_cam_\w+"),
        ("ros", Selection("base_a_from_target_plate"), "its pose is needed"),
        ("ros", Selection("base_a_from_cam_tpo"), "Did you mean cam_top"),
        ("ros", Selection("all", inverse=True), "--inverse, --parent and --child are of one"),
        ("opencv", Selection("all"), "opencv holds one transform"),
        ("camera-info", Selection(camera="tpo"), "no camera 'tpo'"),
        ("easy-handeye", Selection(), "holds the camera"),
        ("easy-handeye2", Selection(), "holds the camera"),
        ("robot-json", Selection(), "robot"),
        ("abb-tooldata", Selection(), "has no tool"),
    ],
)
def test_what_cannot_be_written_is_refused(to, selection, words):
    with pytest.raises(DataError, match=words):
        export(CELL, to, selection)


def test_the_transform_that_is_proposed_can_be_written():
    with pytest.raises(DataError) as caught:
        export(CELL, "text")
    (edge,) = re.findall(r"--edge (\w+)", caught.value.next_step)
    assert export(CELL, "text", Selection(edge))


def test_the_worst_verdict_counts():
    bad = replace(CELL, verdict=replace(CELL.verdict, status="bad"))
    assert document(bad, "ros", Selection("all")).verdict.status == "bad"
    assert not document(CELL, "ros", Selection("all")).warnings


def test_what_needs_one_camera_takes_the_only_one_that_fits(tmp_path):
    write_json(tmp_path / "calibration.json", to_document(CELL))
    for path in (tmp_path, tmp_path / "calibration.json"):
        found = load_calibration(path)
        expected = CELL.between("base_b", "cam_top")
        np.testing.assert_allclose(found.edges["base_from_cam"].matrix, expected.matrix)
    with pytest.raises(DataError, match="no one robot parts"):
        load_calibration(tmp_path, Choice("hand"))
