"""The maker of a robot is kept: what goes in as its pendant shows it comes out so, everywhere."""

import csv
import json
import re
import shlex
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support import readers
from support.aligned_cells import made_up_cell
from support.commands import turned_poses, visioncal, write_poses, write_table
from support.makers import BY_FORM, MAKERS, NUMBER, pose_of, shown, written
from support.marks import slow
from support.refusals import raised
from support.rotations import CASES

from visioncal.core.choices import POSE_FORMS
from visioncal.core.conventions import controller_form
from visioncal.core.documents.pendants import pendant_words, read_pose
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.interchange.formats.foreign import ImportOptions, PoseImportOptions
from visioncal.interchange.formats.touches import read_touches
from visioncal.present.recording.notes import verdict_markdown
from visioncal.results import Calibration, RobotResult, to_document
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE
from visioncal.simulation import CellOptions, cell_session, simulate

# One in metres and one in millimetres, where what is done with a pose is the subject, not its form.
FEW = [maker if maker in ("kuka", "ur") else slow(maker) for maker in MAKERS]


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A simulated session of pose pairs."""
    folder = tmp_path_factory.mktemp("cell") / "cell"
    visioncal("simulate", folder, "--views", 14, "--no-images").good()
    return Session.load(folder)


def poses_of(session):
    return [view.base_from_flange().as_matrix() for view in session.views]


def table_of(session, maker, path):
    """The session as a table of its maker, with the measured poses of the target."""
    names = MAKERS[maker][0].split(",")
    rows = [[*map(repr, written(maker, pose))] for pose in poses_of(session)]
    seen = {
        name: [view.cell(name) for view in session.views] for name in ("view", *MEASURED_CAM_POSE)
    }
    return write_table(path, names, rows, seen)


def converted(cell, maker, folder, *more):
    """Such a table as a session."""
    source = table_of(cell, maker, folder / f"{maker}.csv")
    words = ("--robot-form", maker, "--mount", "eye-in-hand", *more)
    visioncal("convert", source, folder / "session", *words).good()
    return folder / "session"


def calibrated(session, out):
    return visioncal("calibrate", session, "-o", out, "--no-report", "--no-recording").good()


def in_words(maker, name, text):
    """A transform that the console prints: its place [mm], and its rotation in a maker's form."""
    place = re.search(rf"{name}: \(([^)]*)\) mm", text)[1]
    turn = re.search(rf"{name}: .*\n.*{maker.upper()} [^(]*\(([^)]*)\)", text)[1]
    return pose_of(maker, [*place.split(","), *turn.split(",")], 1e-3)


@pytest.mark.parametrize("maker", BY_FORM)
def test_the_maker_is_kept_from_the_table_to_the_export(cell, maker, tmp_path):
    session, out = converted(cell, maker, tmp_path), tmp_path / "out"
    assert tomllib.loads((session / "session.toml").read_text())["robot"] == {"form": maker}
    read = poses_of(Session.load(session))
    # To the rounding of SciPy.
    assert np.abs(np.array(read) - poses_of(cell)).max() < 1e-9
    said = calibrated(session, out).out
    assert json.loads((out / "calibration.json").read_text())["robot"] == {"form": maker}
    found = Calibration.load(out)
    assert found.robot is None
    assert found.controller().name == maker
    for name, edge in found.edges.items():
        # Half of the last digits that are printed: 5 um, and 5e-5 deg or 5e-7.
        assert np.abs(in_words(maker, name, said)[:3, 3] - edge.matrix[:3, 3]).max() < 5.1e-6
        assert np.abs(in_words(maker, name, said)[:3, :3] - edge.matrix[:3, :3]).max() < 3e-6
    command = next(line for line in said.splitlines() if "visioncal export" in line)
    exported = visioncal(*shlex.split(command)[1:]).good().out
    camera = found.edges["flange_from_cam"].matrix
    assert np.abs(readers.READERS[maker](exported) - camera).max() < 1e-9


def test_a_recording_keeps_the_form_and_digests_do_not_depend_on_it(cell, tmp_path):
    session, recording = converted(cell, "fanuc", tmp_path), tmp_path / "session.rrd"
    visioncal("convert", session, recording).good()
    visioncal("convert", recording, tmp_path / "back").good()
    for path in (recording, tmp_path / "back"):
        assert Session.load(path).robots[""].form == "fanuc"
        assert Session.load(path).digest() == Session.load(session).digest()
    calibrated(recording, tmp_path / "out")
    assert Calibration.load(tmp_path / "out").controller().name == "fanuc"
    # What was recorded is the same, whoever made the robot.
    plain = Session.load(session)
    of_nobody = {name: value for name, value in plain.document.items() if name != "robot"}
    assert plain.with_content(document=of_nobody).digest() == plain.digest()
    named = {"robot": {"model": "ur10e"}}
    digests = {
        plain.with_content(document={**of_nobody, **named}).digest(),
        plain.with_content(
            document={**of_nobody, "robot": {"model": "ur10e", "form": "ur"}}
        ).digest(),
    }
    assert len(digests) == 1
    assert plain.digest() not in digests


@pytest.mark.parametrize("maker", ["kuka", "doosan", "ur", "yaskawa", "staubli"])
def test_lines_of_a_pendant_are_read_by_the_names_or_as_stated(cell, maker, tmp_path):
    # Doosan's names are KUKA's, and three makers have Rx, Ry, Rz.
    names, lines = MAKERS[maker][0].split(","), []
    (tmp_path / "images").mkdir()
    for view, pose in zip(cell.views, poses_of(cell), strict=True):
        units = [*["m" if maker == "ur" else "mm"] * 3, *["rad" if maker == "ur" else "deg"] * 3]
        cells = zip(names, written(maker, pose), units, strict=True)
        line = " ".join(f"{name} {value:.9f} {unit}" for name, value, unit in cells)
        lines.append(f"{line} {view.number:03d}.png")
        (tmp_path / "images" / f"{view.number:03d}.png").write_bytes(b"")
    source = tmp_path / "poses.txt"
    source.write_text("\n".join(lines))
    words = ("--target", "charuco_9x6_30mm", "--mount", "eye-in-hand", "--resolution", "1280,800")
    stated = () if maker == "kuka" else ("--robot-form", maker)
    visioncal("convert", source, tmp_path / "session", *words, *stated).good()
    session = Session.load(tmp_path / "session")
    assert session.robots[""].form == maker
    # Nine decimals of a metre, or of a degree at a metre.
    assert np.abs(np.array(poses_of(session)) - poses_of(cell)).max() < 1e-8
    other = visioncal("convert", source, tmp_path / "no", *words, "--robot-form", "fanuc")
    other.refused("not of 'fanuc'")


@pytest.mark.parametrize("unit", ["", " rad"])
def test_lines_in_degrees_by_their_names_may_be_in_radians(cell, unit, tmp_path):
    """A log of a program with KUKA's names; in degrees the flange would hardly turn."""
    lines = []
    for at, pose in enumerate(poses_of(cell)):
        x, y, z, *angles = written("kuka", pose)
        cells = zip("ABC", np.deg2rad(angles), strict=True)
        turns = " ".join(f"{name}:{value:.9f}{unit}" for name, value in cells)
        lines.append(f"[{at + 1}] point x:{x:.9f} y:{y:.9f} z:{z:.9f} {turns}")
    (tmp_path / "log.txt").write_text("\n".join(lines))
    rows = read_touches(tmp_path / "log.txt", ImportOptions())
    assert np.abs(rows.base_from_flange - poses_of(cell)).max() < 1e-8
    notes = " ".join(rows.notes)
    assert ("they are taken for radians" in notes) == (not unit)
    # A form that is stated says its unit.
    stated = ImportOptions(robot=PoseImportOptions(form="kuka"))
    rows = read_touches(tmp_path / "log.txt", stated)
    turns = rows.base_from_flange[:, :3, :3]
    assert (np.abs(turns - np.eye(3)).max() < 0.2) == (not unit)
    assert not rows.notes
    said = visioncal("tcp", tmp_path / "log.txt", "-o", tmp_path / "tool.json").err
    assert ("say --robot-form kuka" in said) == (not unit)


def test_names_of_columns_say_whose_poses_they_are_once_their_turns_are_found(cell, tmp_path):
    for maker, form in (("kuka", "kuka"), ("fanuc", "fanuc"), ("yaskawa", None)):
        source = table_of(cell, maker, tmp_path / "log.csv")
        folder = tmp_path / f"cell of {maker}"
        done = visioncal("convert", source, folder, "--mount", "eye-in-hand").good()
        session = Session.load(folder)
        # Rx, Ry, Rz are also a Techman's, and a program's.
        assert ("Robots that write so: fanuc, yaskawa" in done.err) == (form is None)
        assert (session.robots[""].form, session.name) == (form, folder.name)


def test_a_table_by_hand_in_a_maker_s_columns_keeps_the_maker(cell, tmp_path):
    cell.save(tmp_path / "cell")
    source = table_of(cell, "fanuc", tmp_path / "t.csv")
    shutil.copy(source, tmp_path / "cell/views.csv")
    visioncal("calibrate", tmp_path / "cell").refused("poses are in X,Y,Z,W,P,R", "--guess --yes")
    visioncal("convert", tmp_path / "cell", tmp_path / "read", "--guess", "--yes").good()
    assert Session.load(tmp_path / "read").robots[""].form == "fanuc"


def test_views_about_one_axis_are_asked_for_tilts_before_a_form(tmp_path):
    options = CellOptions(views=10, motion="one_axis", seed=4)
    turned = cell_session(simulate(options), "cell", seen="poses")
    source = table_of(turned, "kuka", tmp_path / "log.csv")
    refused = visioncal("convert", source, tmp_path / "cell", "--mount", "eye-in-hand")
    refused.refused("All views turn about one axis", "First add 3 or more views")
    assert "--robot-form kuka, as the columns' names suggest, or" in refused.err


def test_a_form_of_a_library_is_no_maker_s(cell, tmp_path):
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = [[view.cell(name) for name in ("x_m", "y_m", "z_m", *names[3:])] for view in cell.views]
    seen = {name: [view.cell(name) for view in cell.views] for name in MEASURED_CAM_POSE}
    source = write_table(tmp_path / "t.csv", names, rows, seen)
    words = ("--robot-form", "ros", "--mount", "eye-in-hand")
    visioncal("convert", source, tmp_path / "session", *words).good()
    assert "robot" not in Session.load(tmp_path / "session").document


def test_another_reading_of_the_rotations_takes_the_maker_away(cell, tmp_path):
    # W, P, R that are said to be KUKA's.
    source = table_of(cell, "fanuc", tmp_path / "t.csv")
    words = ("--robot-form", "kuka", "--mount", "eye-in-hand", "--guess", "--yes")
    columns = ("--robot-columns", "X,Y,Z,W,P,R")
    done = visioncal("convert", source, tmp_path / "session", *words, *columns).good()
    session = Session.load(tmp_path / "session")
    assert np.abs(np.array(poses_of(session)) - poses_of(cell)).max() < 1e-9, done.said
    assert session.robots[""].form is None


@pytest.mark.parametrize(
    ("form", "words"),
    [
        ('"kuak"', ("robot.form is 'kuak'", *map('"{}"'.format, POSE_FORMS), "Did you mean kuka?")),
        ('"zzzzz"', ("robot.form is 'zzzzz'", *map('"{}"'.format, POSE_FORMS))),
        ("3", ("robot.form is 3",)),
    ],
)
def test_a_form_that_is_not_known_is_refused(cell, tmp_path, form, words):
    cell.save(tmp_path / "cell")
    toml = tmp_path / "cell" / "session.toml"
    toml.write_text(toml.read_text().replace("[robot]", f"[robot]\nform = {form}"))
    visioncal("calibrate", tmp_path / "cell", "-o", tmp_path / "out").refused(*words)


def test_a_stated_form_precedes_that_of_the_model():
    assert controller_form("kuka_kr6").name == "kuka"
    assert controller_form("ur10e", "kuka").name == "kuka"
    assert controller_form("somebody") is None
    raised(DataError, "Did you mean fanuc", controller_form, "ur10e", "fanucc")
    ur = RobotResult(load_robot("ur10e"))
    assert (ur.controller.name, replace(ur, form="abb").controller.name) == ("ur", "abb")


def test_each_robot_of_a_cell_has_its_own_form(tmp_path):
    cell = made_up_cell(1)
    robots = {"a": RobotResult(form="kuka"), "b": RobotResult(load_robot("lrmate200id"))}
    result = replace(cell, cell=replace(cell.cell, robots=robots))
    result.save(tmp_path / "calibration.json")
    result = Calibration.load(tmp_path)
    assert to_document(result)["robots"]["a"] == {"form": "kuka"}
    whose = {"cell_from_base_b": "kuka", "cell_from_cam_top": "kuka"}
    whose |= {"flange_a_from_cam_hand": "kuka", "flange_b_from_target_plate": "fanuc"}
    notes = verdict_markdown(result).replace("\\", "")
    for name, edge in result.edges.items():
        maker = whose[name]
        words = result.rotation_words(name, edge)
        assert f"{maker.upper()} {MAKERS[maker][0][6:].replace(',', ', ')}" in words
        assert words in notes
        numbers = re.findall(NUMBER, words.partition(maker.upper())[2])[-3:]
        turn = pose_of(maker, [0, 0, 0, *numbers])
        # Half of a tenth of a millidegree about each axis.
        assert np.abs(turn[:3, :3] - edge.matrix[:3, :3]).max() < 3e-6
    assert result.controller("cam_top", "target_plate") is None
    assert result.of(camera="top", robot="b", target="plate").controller().name == "fanuc"


# --- At work: everything that is typed or shown is in the form of the calibration's robot.

GAUGE = ("--tool", "none", "--clearance-mm", 150)
# Three decimals of a millimetre, and four of a degree or six of a radian or a quaternion: half of
# the last digits, of three angles.
SHOWN = 3e-6


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A calibrated arm that errs, and the folder of a later look at its board."""
    folder = tmp_path_factory.mktemp("work")
    options = replace(CellOptions(), seed=21, offset_sigma_rad=1e-3, branches=True)
    for name, each in (
        ("fit", replace(options, views=25)),
        ("look", replace(options, views=3, recording=1)),
    ):
        cell_session(simulate(each), name, seen="corners").save(folder / name)
    calibrated(folder / "fit", folder / "out")
    return folder, Calibration.load(folder / "out")


@pytest.fixture
def of_maker(work, tmp_path):
    """Its result as that of an arm of some maker."""

    def saved(maker):
        out = tmp_path / f"of {maker}"
        out.mkdir(exist_ok=True)
        replace(work[1], robot_form=maker).save(out / "calibration.json")
        return out

    return saved


@pytest.mark.parametrize("maker", MAKERS)
def test_a_shown_pose_is_the_pose_and_is_read_again(maker):
    rng = np.random.default_rng(5)
    for rotations in CASES.values():
        for pose in compose(np.array(rotations), rng.uniform(-2, 2, (len(rotations), 3))):
            line = pendant_words(pose, POSE_FORMS[maker])
            assert np.abs(shown(maker, line) - pose).max() < SHOWN
            assert np.abs(read_pose(line, "the line", maker).pose - pose).max() < SHOWN


@pytest.mark.parametrize("maker", FEW)
def test_the_touch_test_sends_the_robot_by_its_own_form(work, of_maker, maker):
    words = ("touch-test", work[0] / "look", "-c", of_maker(maker), *GAUGE)
    said = visioncal(*words).good().out
    assert POSE_FORMS[maker].words in said.splitlines()[0]
    points = json.loads(visioncal(*words, "--json").good().out)["points"]
    for what in ("hover", "touch"):
        lines = re.findall(rf"^  {what}: (.*)$", said, re.MULTILINE)
        assert len(lines) == len(points) == 5
        for line, point in zip(lines, points, strict=True):
            turn = Rotation.from_rotvec(point[what][3:])
            target = RigidTransform.from_components(point[what][:3], turn).as_matrix()
            assert np.abs(shown(maker, line) - target).max() < SHOWN
            assert point[f"{what}_{maker}"] == line


def test_the_form_is_that_of_the_model_s_maker_or_as_typed(work):
    words = ("touch-test", work[0] / "look", "-c", work[0] / "out", *GAUGE)
    assert "Universal Robots" in visioncal(*words).good().out.splitlines()[0]
    said = visioncal(*words, "--robot-form", "abb").good().out
    assert "q1, q2, q3, q4" in said.splitlines()[0]
    visioncal(*words, "--robot-form", "kuak").refused("Did you mean kuka?")


def test_poses_of_no_known_maker_are_nobody_s(work, tmp_path):
    replace(work[1], robot=None, arm=None, robot_form=None).save(tmp_path / "calibration.json")
    done = visioncal("touch-test", work[0] / "look", "-c", tmp_path, *GAUGE, "--force").good()
    assert "Universal" not in done.said
    assert "--robot-form (ur, kuka, fanuc, abb ...)" in done.err
    assert "qw" in done.out


def touches(maker, poses, path, columns):
    """A table of touches, as its maker writes poses, with a controller's digits and more."""
    rows = [[f"{value:.9f}" for value in written(maker, pose)] for pose in poses]
    return write_table(path, MAKERS[maker][0].split(","), rows, columns)


def printed(maker, name, text):
    """The transform that tcp or fixture prints."""
    place = re.search(rf"{name}: \(([^)]*)\) mm", text)[1]
    turn = re.search(rf"{name}: .*{maker.upper()} [^(]*\(([^)]*)\)", text)[1]
    return pose_of(maker, [*place.split(","), *turn.split(",")], 1e-3)


TIP, PIVOT = np.array([0.01, -0.02, 0.16]), np.tile([0.5, -0.1, 0.2], (8, 1))


@pytest.fixture(scope="module")
def tool(work):
    """The file of a tool with that tip."""
    poses = turned_poses(np.random.default_rng(2), PIVOT, TIP, np.eye(3))
    touched = write_poses(work[0] / "pivot.csv", poses)
    visioncal("tcp", touched, "-o", work[0] / "tool.json").good()
    return work[0] / "tool.json"


@pytest.mark.parametrize("maker", FEW)
def test_touches_are_read_and_frames_are_printed_in_the_robot_s_form(
    of_maker, tool, maker, tmp_path
):
    rng = np.random.default_rng(2)
    poses = turned_poses(rng, PIVOT, TIP, np.eye(3))
    drawn = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.15, 0], [0, 0.15, 0], [0.1, 0.1, 0.05]])
    jig = RigidTransform.from_components([0.4, -0.3, 0.1], Rotation.from_rotvec([0.3, 0.1, 1.2]))
    onto = turned_poses(rng, jig.apply(drawn), TIP, np.eye(3))
    names = [f"P{at}" for at in range(len(drawn))]
    cad = write_table(tmp_path / "cad.csv", ("x_m", "y_m", "z_m"), drawn.tolist(), {"point": names})
    tip = np.eye(4)
    tip[:3, 3] = TIP
    made = {
        "tcp": (poses, tip, {}, ()),
        "fixture": (onto, jig.as_matrix(), {"point": names}, ("--cad", cad, "--tool", tool)),
    }
    for command, (flanges, true, columns, more) in made.items():
        sources = [touches(maker, flanges, tmp_path / "typed.csv", columns)]
        # Our own columns are the same with any maker's form.
        if maker in ("kuka", "ur"):
            sources.append(write_poses(tmp_path / "ours.csv", flanges, columns))
        for source in sources:
            out = of_maker(maker)
            done = visioncal(command, source, "-c", out, *more, "--force").good()
            ((name, frame),) = Calibration.load(out).frames.items()
            # A tenth of a micrometre, and 1e-9 of a quaternion, as our own table has.
            assert np.abs(frame.edge.matrix - true).max() < 1e-6
            if frame.oriented:
                assert np.abs(printed(maker, name, done.out) - frame.edge.matrix).max() < SHOWN


@pytest.mark.slow
def test_touches_of_another_maker_are_refused_until_the_maker_is_stated(of_maker, tmp_path):
    poses = turned_poses(
        np.random.default_rng(2), np.tile([0.5, -0.1, 0.2], (8, 1)), np.ones(3) / 10, np.eye(3)
    )
    table = touches("kuka", poses, tmp_path / "t.csv", {})
    done = visioncal("tcp", table, "-c", of_maker("fanuc")).refused(
        "are not FANUC X, Y, Z, W, P, R"
    )
    assert "--robot-form kuka" in done.err
    visioncal("tcp", table, "-c", of_maker("fanuc"), "--robot-form", "kuka").good()
    lines = tmp_path / "lines.txt"
    lines.write_text("\n".join(pendant_words(pose, POSE_FORMS["staubli"]) for pose in poses))
    visioncal("tcp", lines, "-c", of_maker("kuka")).refused("not of 'kuka'")
    # Rx, Ry, Rz are of three makers, and the calibration says of which.
    visioncal("tcp", lines, "-c", of_maker("staubli"), "--name", "tip").good()
    tip = Calibration.load(tmp_path / "of staubli").frames
    assert np.abs(tip["flange_from_tip"].edge.matrix[:3, 3] - 0.1).max() < 1e-5


@pytest.mark.parametrize("maker", BY_FORM)
def test_targets_are_typed_and_sent_in_the_robot_s_form(work, of_maker, maker, tmp_path):
    poses = poses_of(Session.load(work[0] / "fit"))[:6]
    labels = {"what": [f"pick {at}" for at in range(len(poses))]}
    ours = write_poses(tmp_path / "ours.csv", np.array(poses), labels)
    typed = touches(maker, poses, tmp_path / "typed.csv", labels)
    names, out, sent = MAKERS[maker][0].split(","), of_maker(maker), {}
    for name, source in (("ours", ours), ("typed", typed)):
        file = tmp_path / f"{name}-sent.csv"
        visioncal("correct", source, "-c", out, "-o", file).good()
        with file.open() as rows:
            sent[name] = list(csv.DictReader(rows))
    columns = [f"{maker}_{name.lower()}" for name in names]
    assert list(sent["typed"][0])[: 1 + len(names)] == ["what", *names]
    for row, standard in zip(sent["typed"], sent["ours"], strict=True):
        place = [float(standard[name]) for name in POSE]
        target = RigidTransform.from_components(place[:3], Rotation.from_quat(place[3:]))
        # The tables differ by what a controller's digits leave.
        for pose in (
            pose_of(maker, [row[name] for name in names]),
            pose_of(maker, [standard[name] for name in columns]),
        ):
            assert np.abs(pose - target.as_matrix()).max() < 1e-6
        assert float(row["moved_mm"]) > 0.1


def test_targets_that_no_form_explains_are_refused(work, of_maker, tmp_path):
    poses = poses_of(Session.load(work[0] / "fit"))[:6]
    fanuc = touches("fanuc", poses, tmp_path / "t.csv", {})
    visioncal("correct", fanuc, "-c", of_maker("kuka")).refused("--robot-form fanuc")
    visioncal("correct", fanuc, "-c", of_maker("kuka"), "--robot-form", "fanuc").good()
    nobody = replace(work[1].robot, name="mine")
    out = tmp_path / "nobody"
    out.mkdir()
    document = {**nobody.document, "name": "mine"}
    replace(work[1], robot=type(nobody).from_document(document)).save(out / "calibration.json")
    done = visioncal("correct", fanuc, "-c", out).refused("x_m, y_m, z_m", "--robot-form")
    assert done.out == ""


@pytest.mark.parametrize("maker", BY_FORM)
def test_a_pixel_is_placed_from_a_pose_as_the_pendant_shows_it(work, of_maker, maker):
    pose = poses_of(Session.load(work[0] / "fit"))[0]
    words = ("locate", "-c", of_maker(maker), "--pixel", "640,400", "--plane", "z=0", "--json")
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    ours = ",".join(f"{value:.9f}" for value in (*pose[:3, 3], *turn))
    found = [
        json.loads(visioncal(*words, "--pose", typed).good().out)[0]["p_base_m"]
        for typed in (ours, pendant_words(pose, POSE_FORMS[maker]))
    ]
    # Half a metre from the camera, seen at up to 45 degrees.
    assert np.abs(np.subtract(*found)).max() < 5 * SHOWN
    visioncal(*words, "--pose", "X 1 Y 2").refused("must be a pose in a known form")
