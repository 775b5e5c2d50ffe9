"""`visioncal locate`, and `tcp` and `fixture` with images, as a user runs them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.imaged import Shot, calibrated_cell, picture, session_of, shots
from support.plates import CENTRES, marked_plate, plate_session
from support.samples import fixture_frame

from visioncal.frames.camera_chain import Plane
from visioncal.frames.locate import locate
from visioncal.results import Calibration, Edge, FrameFile, Verdict

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
    ended = run(*words, **options)
    assert ended.status == 0, ended.err
    return ended.out


def refused(expected, *words, **options):
    """Checks that a command ends with status 2 and a message, and returns what it says."""
    ended = run(*words, **options)
    assert ended.status == 2
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
    session_of(made, [*shots(made, 3), Shot(3, None)]).save(folder / "part")
    return made, folder / "calibration.json", folder / "part"


def shown(source=None, **options):
    """What `locate --json` prints."""
    return json.loads(done("locate", source, "--json", **options))


def pose_words(pose):
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return ",".join(repr(float(value)) for value in [*pose[:3, 3], *turn])


def test_every_view_tells_where_the_target_is(cell):
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
    told = done("locate", session, calibration=calibration, view=31)
    assert told.startswith("view 31: (")
    assert "95 % within" in told
    assert told.count("\n") == 1
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
    refused("--target is needed", "locate", image, calibration=calibration)
    other = wanted | {"target": "checkerboard_9x6_25mm"}
    refused(r"shot\.png: target checkerboard", "locate", **other, pose=pose)
    if pose is not None:
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
    both = shown(pixel=[PIXEL, "600,500"], plane="z=-50", **given)
    assert [value["pixel"] for value in both] == [[700.0, 350.0], [600.0, 500.0]]
    assert "plane" not in both[0]["budget_mm"]
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
        refused(r"4 views, .* --view is needed", "locate", **wanted)
        refused(r"view 33 .* has no pose of the robot", "locate", **wanted, view=33)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"calibration": None}, "Missing option '-c'"),
        ({"calibration": "nowhere"}, "nowhere"),
        ({}, "nothing to look for"),
        ({"source": "part", "plane": "z=1"}, "--plane: it is for --pixel"),
        ({"source": "part", "plane_sigma": 0.1}, "--plane-sigma-mm: it is for --pixel"),
        ({"source": "part", "pose": "0,0,0,0,0,0,1"}, "--pose: the session has the poses"),
        ({"source": "part", "view": 99}, "view 99: .* it has 30, 31, 32, 33"),
        ({"source": "part", "point": "1,2"}, "--point-mm is '1,2'; x,y,z is needed"),
        ({"source": "part", "point": "0,0,99000"}, "farther than 20 m"),
        ({"source": "part", "target": "charuco"}, "There is no target 'charuco'"),
        ({"source": "part/views.csv", "target": "charuco_9x6_30mm"}, "not an image"),
        ({"pixel": ["1,2"], "view": 3}, "--view: only a session has views"),
        ({"pixel": ["1,2"], "point": "1,2,3"}, "--point-mm: a pixel is placed by its plane"),
        ({"pixel": ["1,2"]}, r"shows no depth: the plane \(--plane\)"),
        ({"pixel": ["1"], "plane": "z=0"}, "--pixel is '1'; u,v is needed"),
        ({"pixel": ["1,nan"], "plane": "z=0"}, "--pixel is '1,nan'"),
        ({"pixel": ["1,2"], "plane": "z=low"}, "--plane z is 'low'"),
        ({"pixel": ["1,2"], "plane": "jig:5"}, "--plane ends in '5'"),
        ({"pixel": ["1,2"], "plane": "gig"}, "'gig', .* there are: .*base_from_jig"),
        ({"pixel": ["1,2"], "plane": "base_from_cam"}, "no frame in the base"),
        ({"pixel": ["1,2"], "plane": "0,0,0,5"}, "has no direction"),
        ({"pixel": ["1,2"], "plane": "z=99000"}, "farther than 20 m"),
        ({"pixel": ["1,2"], "plane": "z=0", "plane_sigma": -1.0}, "standard deviation"),
        ({"pixel": ["1,2"], "plane": "z=0", "pose": "0,0,0,0,0,0,2"}, "norm is 2"),
        ({"pixel": ["1,2"], "plane": "z=0", "pose": "0,0,0,1"}, "qx,qy,qz,qw is needed"),
        ({"pixel": ["9999,2"], "plane": "z=0", "pose": "0,0,1,1,0,0,0"}, "outside the camera"),
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
    session_of(cell, shots(cell, 4)).save(tmp_path / "part")
    at = {"calibration": tmp_path}
    told = done("tcp", tmp_path / "part", **at, name="gripper", point="0,0,-120")
    assert told.startswith("good  flange_from_gripper")
    assert "its point (0, 0, -120) mm" in told
    kept = Calibration.load(tmp_path).frames["flange_from_gripper"]
    true = cell.transforms["flange_from_target"]
    tip = true[:3, 3] - 0.12 * true[:3, 2]
    # Four sigmas of all three axes together.
    assert 1e3 * np.linalg.norm(kept.edge.matrix[:3, 3] - tip) < 4 * kept.edge.sigma_mm
    assert "flange_from_gripper" in (tmp_path / "report.html").read_text(encoding="utf-8")
    file = tmp_path / "frames.json"
    told = done("tcp", tmp_path / "part", "--json", **at, out=file)
    assert json.loads(told).keys() == {"flange_from_tool"}
    assert FrameFile.load(file).frames.keys() == {"flange_from_tool"}


def test_options_and_sources_that_do_not_fit_are_named(tmp_path):
    cell, calibration = calibrated_cell(TO_HAND)
    calibration.save(tmp_path / "calibration.json")
    part, both, table = tmp_path / "part", tmp_path / "both", tmp_path / "touches.csv"
    session_of(cell, shots(cell, 2)).save(part)
    session_of(cell, shots(cell, 2), kind=["", "point"]).save(both)
    table.write_text("x_m,y_m,z_m,qx,qy,qz,qw\n0,0,1,0,0,0,1\n", encoding="utf-8")
    at = {"calibration": tmp_path}
    refused(r"images \(view 30\) and touches \(.* view 31\)", "tcp", both, **at)
    refused(r"the camera's calibration \(-c\) is needed", "tcp", part)
    message = "--touch-noise-mm: session 'the part' has images"
    refused(message, "tcp", part, **at, touch_noise=0.1)
    refused("--tool: session 'the part' has images", "fixture", part, **at, tool="none")
    for command in ("tcp", "fixture"):
        refused("--point-mm: touches say", command, table, **at, point="1,2,3")
        refused("--point-mm is 'up'", command, part, **at, point="up")
    cad = tmp_path / "cad.csv"
    cad.write_text("point,x_mm,y_mm,z_mm\n1,0,0,0\n2,9,0,0\n3,0,9,0\n", encoding="utf-8")
    refused("a charuco; beside a drawing", "fixture", part, **at, cad=cad)
    message = "beside --cad the drawing's origin"
    refused(message, "fixture", part, **at, cad=cad, point="1,2,3")


@pytest.mark.slow
def test_markers_place_a_fixture_from_the_command_line(tmp_path):
    calibration, base_from_plate, sights = marked_plate()
    calibration.save(tmp_path / "calibration.json")
    plate_session(sights).save(tmp_path / "plate")
    cad = tmp_path / "cad.csv"
    lines = [f"{name},{x},{y},0.0" for name, (x, y) in CENTRES.items()]
    cad.write_text("\n".join(["point,x_m,y_m,z_m", *lines]), encoding="utf-8")
    told = done("fixture", tmp_path / "plate", calibration=tmp_path, cad=cad, name="plate")
    assert "best fit of 4 points to cad.csv" in told
    # Markers in one plane have no hand, and the drawing's z points into the plate.
    assert "the side that the camera looked from" in " ".join(told.split())
    frame = Calibration.load(tmp_path).frames["base_from_plate"]
    away = frame.edge.matrix[:3, 3] - base_from_plate[:3, 3]
    # Four sigmas of all three axes together.
    assert 1e3 * np.linalg.norm(away) < 4 * frame.edge.sigma_mm
