"""Exports of tools and fixtures: what a controller reads is the frame, as its maker writes it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support import placed, readers
from support.commands import visioncal
from support.placed import BASE_FROM_FIXTURE, FIXTURE, FLANGE_FROM_TOOL, TOOL, fixture, tool
from support.readers import FIXTURE_READERS, READERS, TOOL_READERS
from support.refusals import raised
from support.rotations import CASES
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.interchange.exports import EXPORT_FORMATS, Load, Selection, document, export
from visioncal.interchange.result_files import load_calibration, load_result_or_frames
from visioncal.results import Calibration, FrameFile, Verdict

RNG = np.random.default_rng(6)
SAMPLE = replace(made_up(5).calibration, frames={})
CELL = replace(SAMPLE, frames=tool() | fixture(source="points.csv"))
ALONE = placed.alone(tool(), fixture())
FRAME_READERS = TOOL_READERS | FIXTURE_READERS
TAKES = {export_format.name: export_format.takes for export_format in EXPORT_FORMATS}


def of(name):
    """The transform that a format takes by itself."""
    return (TOOL, FLANGE_FROM_TOOL) if name in TOOL_READERS else (FIXTURE, BASE_FROM_FIXTURE)


def off(name, text, matrix):
    return float(np.abs(FRAME_READERS[name](text) - matrix).max())


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("name", FRAME_READERS)
def test_what_is_read_back_is_the_frame(name, kind):
    # Written to the nanometre and to 1e-8 deg.
    tolerance = 1e-9
    if kind == "near a pitch of 90" and not name.startswith(("ur", "abb")):
        # Within 1e-7 rad of its singularity an Euler triple is taken to be singular: twice that.
        tolerance = 2.1e-7 + tolerance
    rotations = np.array(CASES[kind])
    for matrix in compose(rotations, RNG.uniform(-2, 2, (len(rotations), 3))):
        source = placed.alone(tool(matrix) if name in TOOL_READERS else fixture(matrix))
        assert off(name, export(source, name), matrix) < tolerance


@pytest.mark.parametrize("name", sorted(set(READERS) - {"easy-handeye", "easy-handeye2"}))
@pytest.mark.parametrize(
    ("edge", "matrix"), [(TOOL, FLANGE_FROM_TOOL), (FIXTURE, BASE_FROM_FIXTURE)]
)
def test_a_frame_goes_out_as_any_transform(name, edge, matrix):
    for source in (CELL, ALONE):
        # As the tests of other transforms have it.
        text = export(source, name, Selection(edge))
        assert np.abs(READERS[name](text) - matrix).max() < 1e-9
        text = export(source, name, Selection(edge, inverse=True))
        assert np.abs(READERS[name](text) - invert(matrix)).max() < 1e-9


# --- What the makers themselves have published.

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


def test_abb_gripper_of_the_manual():
    # In the manual's words: turned by 45 deg, 223.1 mm straight out and 97.4 mm along x, 5 kg.
    matrix = readers.transform(readers.ry(np.pi / 4), [0.0974, 0, 0.2231])
    # The manual's quaternion has three digits, by which a matrix is off by up to four times that.
    assert np.abs(readers.abb_tooldata(GRIPPER) - matrix).max() < 2e-3
    ours = export(
        placed.alone(tool(matrix)),
        "abb-tooldata",
        Selection(child="gripper", load=Load(5.0, (23.0, 0.0, 75.0))),
    )
    kind, name, (held, (position, quaternion), load) = readers.rapid(ours)
    assert (kind, name) == readers.rapid(GRIPPER)[:2]
    theirs = readers.rapid(GRIPPER)[2]
    assert [held, position, load] == [theirs[0], theirs[1][0], theirs[2]]
    # Their three digits.
    assert np.abs(np.subtract(quaternion, theirs[1][1])).max() < 5e-4


def test_abb_work_object_of_the_manual():
    matrix = readers.transform(np.eye(3), [0.3, 0.8, 0.23])
    # Rounding of doubles.
    assert np.abs(readers.abb_wobjdata(WOBJ2) - matrix).max() < 1e-12
    user = readers.transform(np.eye(3), [0.3, 0.6, 0.2])
    ours = export(placed.alone(fixture(user)), "abb-wobjdata", Selection(child="wobj2"))
    kind, name, value = readers.rapid(WOBJ2)
    # All of the fixture goes into the user frame; the object's own is left where it is.
    assert readers.rapid(ours) == (kind, name, [*value[:4], [[0, 0, 0], [1, 0, 0, 0]]])


def test_ur_tool_and_pose_of_the_script_manual():
    matrix = readers.transform(readers.of_rotation_vector(0, 3.14, 0), [0, 0.2, 0.3])
    # Rounding of doubles.
    assert np.abs(readers.ur_tcp(SET_TCP) - matrix).max() < 1e-12
    assert rounded(export(placed.alone(tool(matrix)), "ur-tcp"), "#") == rounded(SET_TCP, "#")
    pose = readers.transform(readers.rx(1.57), [0.2, 0.5, 0.1])
    # As above.
    assert np.abs(readers.urscript_pose(POSE) - pose).max() < 1e-12
    ours = export(placed.alone(fixture(pose)), "ur-feature", Selection(child="p_from"))
    assert rounded(ours, "#") == rounded(f"globalp_from={POSE}", "#")


@pytest.mark.parametrize(
    ("name", "theirs", "number"), [("kuka-tool", TOOL_DATA, 3), ("kuka-base", BASE_DATA, 1)]
)
def test_kuka_frames_of_a_controllers_own_file(name, theirs, number):
    matrix = FRAME_READERS[name](theirs)
    frames = tool(matrix) if name == "kuka-tool" else fixture(matrix)
    ours = export(placed.alone(frames), name, Selection(number=number))
    assert rounded(ours, ";") == rounded(theirs, ";")
    active = export(placed.alone(frames), name)
    assert readers.kuka_named(active)[0] == ("$TOOL" if name == "kuka-tool" else "$BASE")


# --- What is taken, and what is refused.


@pytest.mark.parametrize("name", FRAME_READERS)
def test_the_only_frame_of_its_kind_is_taken(name):
    edge, matrix = of(name)
    for source in (CELL, ALONE):
        chosen = export(source, name)
        assert chosen == export(source, name, Selection(edge=edge))
        # As above.
        assert off(name, chosen, matrix) < 3e-8


@pytest.mark.parametrize("name", FRAME_READERS)
def test_the_wrong_kind_is_refused(name):
    wrong = FIXTURE if name in TOOL_READERS else TOOL
    raised(DataError, f"{wrong} is none.*--to ", export, CELL, name, Selection(edge=wrong))


@pytest.mark.parametrize("name", sorted(TAKES))
def test_what_a_format_has_no_place_for_is_refused(name):
    given = {"number": {"number": 2}, "load": {"load": Load(1.0, (0.0, 0.0, 1.0))}}
    for what, chosen in given.items():
        if what not in TAKES[name]:
            raised(DataError, "no place for", export, CELL, name, Selection(**chosen))


TWO = replace(SAMPLE, frames=tool() | {"flange_from_tool_2": placed.frame(FLANGE_FROM_TOOL)})


@pytest.mark.parametrize(
    ("source", "name", "chosen", "words"),
    [
        (SAMPLE, "rso", Selection(), "Did you mean ros"),
        (SAMPLE, "ros", Selection("flange_from_cm"), "Did you mean flange_from_cam"),
        (SAMPLE, "ros", Selection("cam_from_flange"), "--edge flange_from_cam --inverse"),
        (SAMPLE, "ros", Selection(parent="a", child="a"), "two frames"),
        (SAMPLE, "ur-tcp", Selection(), "visioncal tcp"),
        (replace(SAMPLE, camera=None), "camera-info", Selection(), "no camera"),
        (CELL, "kuka-tool", Selection(number=0), "from 1"),
        (CELL, "abb-tooldata", Selection(load=Load(0.0, (0, 0, 1))), "mass above 0"),
        (CELL, "ur-tcp", Selection(inverse=True), "the inverse of"),
        (TWO, "ur-tcp", Selection(), "flange_from_tool, flange_from_tool_2"),
        (ALONE, "text", Selection(), "flange_from_tool, base_from_fixture"),
        (FrameFile({}), "text", Selection(), "no frames"),
    ],
)
def test_what_cannot_be_exported_is_refused(source, name, chosen, words):
    with pytest.raises(DataError) as caught:
        export(source, name, chosen)
    assert words in str(caught.value)


def test_a_tool_without_a_load_is_marked_and_warned_of():
    written = document(CELL, "abb-tooldata")
    assert readers.rapid(written.text)[2][2] == [-1, [0, 0, 0], [1, 0, 0, 0], 0, 0, 0]
    assert ["--mass-kg" in warning for warning in written.warnings] == [True]
    loaded = document(CELL, "abb-tooldata", Selection(load=Load(1.25, (0.0, -1.5, 60.0))))
    assert readers.rapid(loaded.text)[2][2][:2] == [1.25, [0, -1.5, 60]]
    assert loaded.warnings == ()


@pytest.mark.parametrize("name", ["abb-tooldata", "abb-wobjdata"])
@pytest.mark.parametrize(
    "bad", ["2nd", "_tool", "tool.1", "a-b", "a/b", "tool0", "WOBJ0", "Test", "x" * 33]
)
def test_a_name_that_rapid_does_not_take_is_refused(name, bad):
    raised(DataError, r"RAPID.*--child", export, CELL, name, Selection(child=bad))
    assert export(CELL, name, Selection(child="x" * 32))


@pytest.mark.parametrize("bad", ["2nd", "a.b", "a-b", "end", "True"])
def test_a_name_that_urscript_does_not_take_is_refused(bad):
    raised(DataError, r"URScript.*--child", export, CELL, "ur-feature", Selection(child=bad))
    # A call of set_tcp has no name in it.
    assert export(CELL, "ur-tcp", Selection(child=bad))


# --- What is said of a frame.


def test_a_frame_has_its_own_origin_and_worth():
    # The calibration itself comes from another file, of another day, with another verdict.
    frames = fixture(source="points.csv", verdict=Verdict("good"))
    notes = export(replace(SAMPLE, frames=frames), "text", Selection(FIXTURE)).splitlines()[:3]
    assert notes[0] == (
        f"# calibrated by visioncal from 'points.csv', {placed.CREATED}: pivot over 10 touches"
    )
    edge = frames[FIXTURE].edge
    assert notes[1] == f"# verdict good; sigma {edge.sigma_mm:.2g} mm and {edge.sigma_deg:.2g} deg"
    assert SAMPLE.session_name in export(CELL, "text")


@pytest.mark.parametrize("name", sorted(FRAME_READERS))
def test_no_source_leaves_its_comment(name):
    hostile = 'x\nset_tcp(p[0])\r\nENDMODULE ; } !\u2028"'
    frames = tool(source=hostile) | fixture(source=hostile)
    text = export(FrameFile(frames), name)
    assert np.array_equal(FRAME_READERS[name](text), FRAME_READERS[name](export(CELL, name)))


# --- Files and the command.


def exporting(*arguments):
    return visioncal("export", *arguments)


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


def test_the_command_takes_a_load_and_warns_without_one(tmp_path):
    CELL.save(tmp_path / "calibration.json")
    load = ["--mass-kg", "5", "--cog-mm", "23", "0", "-75.5"]
    done = exporting(tmp_path, "--to", "abb-tooldata", *load)
    assert (done.status, done.err) == (0, "")
    assert readers.rapid(done.out)[2][2][:2] == [5, [23, 0, -75.5]]
    done = exporting(tmp_path, "--to", "abb-tooldata").good()
    assert "warning:" in done.err
    assert "LoadIdentify" in done.err
    done = exporting(tmp_path, "--to", "abb-tooldata", "--mass-kg", "5")
    assert (done.status, done.out) == (2, "")
    assert "--cog-mm" in done.err


def test_the_verdict_of_the_frame_is_what_counts():
    bad = Verdict.of("bad", "Touch 4 is off by 7 mm.")
    frames = tool(verdict=bad) | fixture()
    cell = replace(SAMPLE, frames=frames, verdict=Verdict.of("bad", "The views disagree."))
    assert document(cell, "ur-tcp").verdict == bad
    assert document(cell, "ur-feature").verdict == cell.frames["base_from_fixture"].verdict
    assert document(cell, "ros").verdict == cell.verdict
