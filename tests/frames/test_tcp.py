"""Tools from touches: what the command finds, names, refuses and writes."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support.commands import visioncal, write_poses, write_table
from support.touched import TIP, Job, error_of, relabelled, slipped, touched

from visioncal.calibration.run import run
from visioncal.core.transforms import invert
from visioncal.interchange.outputs import write_outputs
from visioncal.present.recording import read_calibration
from visioncal.results import Calibration, FrameFile
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session

# Ten touches, 45 degrees, 0.1 mm: the tip is known to some 0.05 mm per axis.
NEAR_MM = 0.3


def file_of(path, touches, **columns):
    more = {"view": range(1, len(touches) + 1), "kind": touches.kinds}
    if len(touches.names) > 1:
        more["point"] = [touches.names[index] for index in touches.points]
    return write_poses(path, touches.base_from_flange, more | columns)


def tcp(folder, touches, *more):
    return visioncal("tcp", file_of(folder / "touches.csv", touches), *more)


def _meeting(robot, rng):
    """Joint angles (8, 6) at which the tip is at one point, each another way."""
    home = np.array([0.4, -1.3, 1.5, -1.75, -1.57, 0.3])

    def tip(joints):
        return robot.base_from_flange(joints[None])[0, :3] @ np.append(TIP, 1.0)

    point = tip(home)
    starts = home + rng.uniform(-0.4, 0.4, (8, 6))
    return np.array([least_squares(lambda value: tip(value) - point, start).x for start in starts])


def found(done):
    assert done.status == 0, done.err
    return next(iter(json.loads(done.out).values()))


def off_mm(document):
    return 1e3 * np.linalg.norm(np.array(document["translation_m"]) - TIP)


# --- What it finds.


def test_five_real_touches(real_data):
    done = visioncal("tcp", real_data / "tcp_pivot_rvbust/poses.csv", "--json")
    tool = found(done)
    # Figures of a plain linear fit by others, as they round them.
    assert 1e3 * np.array(tool["translation_m"]) == pytest.approx([33.78, 0.97, 76.79], abs=0.006)
    assert tool["rms_mm"] == pytest.approx(0.219, abs=0.001)
    # Each axis is known to about 0.1 mm by five touches of 0.16 mm per axis.
    assert tool["sigma_mm"] == pytest.approx(0.18, abs=0.02)
    assert tool["verdict"]["status"] == "good"
    assert not tool["oriented"]


def test_the_tip_and_its_rotation(tmp_path):
    made = touched(Job(axes=3), 1)
    done = tcp(tmp_path, made.touches, "--json")
    tool = found(done)
    assert tool["oriented"]
    assert tool["verdict"]["status"] == "good"
    error = error_of(np.array(tool["matrix"]))
    # 0.1 mm over levers of 100 mm, with three touches of each kind.
    assert np.linalg.norm(error[:3]) < 4 * np.deg2rad(tool["sigma_deg"]) < np.deg2rad(0.5)
    assert 1e3 * np.linalg.norm(error[3:]) < NEAR_MM
    assert tool["method"] == (
        "pivot of 10 touches of one point; rotation from 3 along z and 3 in the xz plane"
    )
    assert {value["kind"] for value in tool["observations"]} == {"point", "z", "xz"}


def test_poses_of_a_tool_that_was_active_are_doubted(tmp_path):
    made = touched(Job(), 1)
    of_tip = made.touches.base_from_flange.copy()
    of_tip[:, :3, 3] += of_tip[:, :3, :3] @ TIP
    tool = found(tcp(tmp_path, replace(made.touches, base_from_flange=of_tip), "--json"))
    assert tool["verdict"]["status"] == "check"
    assert "active in the controller" in tool["verdict"]["reasons"][0]


def test_several_points_need_fewer_touches_of_each(tmp_path):
    tool = found(tcp(tmp_path, touched(Job(tips=4, points=3), 2).touches, "--json"))
    assert off_mm(tool) < NEAR_MM
    assert set(tool["details"]["points_m"]) == {"A", "B", "C"}


def test_poses_in_other_forms(tmp_path):
    poses = touched(Job(), 3).touches.base_from_flange
    turns = Rotation.from_matrix(poses[:, :3, :3])
    path, mm = tmp_path / "touches.csv", 1e3 * poses[:, :3, 3]
    kuka = np.hstack([mm, turns.as_euler("ZYX", degrees=True)])
    write_table(path, ("X", "Y", "Z", "A", "B", "C"), kuka.tolist())
    assert off_mm(found(visioncal("tcp", path, "--robot-form", "kuka", "--json"))) < NEAR_MM
    abb = np.hstack([mm, np.roll(turns.as_quat(), 1, axis=1)])
    write_table(path, ("x", "y", "z", "q1", "q2", "q3", "q4"), abb.tolist())
    assert off_mm(found(visioncal("tcp", path, "--robot-unit", "mm", "--json"))) < NEAR_MM
    back = invert(poses)
    write_poses(path, back)
    done = visioncal("tcp", path)
    assert "--robot-inverse" in done.out
    assert done.out.startswith("check")
    assert off_mm(found(visioncal("tcp", path, "--robot-inverse", "--json"))) < NEAR_MM


def test_joint_angles_go_through_the_robots_model(tmp_path):
    robot, rng = load_robot("ur10e"), np.random.default_rng(4)
    joints = _meeting(robot, rng)
    names = [f"q{index}_rad" for index in range(1, 7)]
    path = write_table(tmp_path / "touches.csv", names, joints.tolist())
    done = visioncal("tcp", path, "--robot-model", "ur10e", "--json")
    # Exact touches, but for the digits of the joints' angles.
    assert off_mm(found(done)) < 1e-3
    done = visioncal("tcp", path)
    assert done.status == 2
    assert "--robot-model" in done.err
    degrees = write_table(tmp_path / "deg.csv", names, np.rad2deg(joints).tolist())
    done = visioncal("tcp", degrees, "--robot-model", "ur10e")
    assert done.status == 2
    assert "--joint-unit deg" in done.err
    done = visioncal("tcp", degrees, "--robot-model", "ur10e", "--joint-unit", "deg", "--json")
    assert off_mm(found(done)) < 1e-3
    done = visioncal("tcp", path, "--robot-model", "panda")
    assert done.status == 2
    assert "6 joint angles, but" in done.err


def test_the_rows_of_a_session_are_touches(tmp_path):
    touches = touched(Job(), 12).touches
    head = 'schema = 1\nname = "touches"\nmount = "eye-in-hand"\n'
    (tmp_path / "session.toml").write_text(head)
    columns = {"view": range(20, 30), "point": ["A"] * 10}
    write_poses(tmp_path / "views.csv", touches.base_from_flange, columns)
    tool = found(visioncal("tcp", tmp_path, "--json"))
    assert off_mm(tool) < NEAR_MM
    assert [value["name"] for value in tool["observations"]] == [
        str(index) for index in range(20, 30)
    ]
    assert tool["source"] == "touches"


# --- What is wrong is named.


def test_one_wrong_touch_in_ten_is_named(tmp_path):
    made = touched(Job(), 5)
    wrong = slipped(made.touches, 3, np.array([0.0012, -0.0009, 0.0]))
    done = tcp(tmp_path, wrong, "--json")
    tool = found(done)
    (reason,) = tool["verdict"]["reasons"]
    assert reason.startswith("Touch 4 (touches.csv, line 5) was left out: 1.")
    assert "the tip had slipped" in reason
    assert tool["verdict"]["status"] == "check"
    assert [value["name"] for value in tool["observations"] if not value["used"]] == ["4"]
    assert off_mm(tool) < NEAR_MM


def test_an_exchanged_name_is_left_out(tmp_path):
    made = touched(Job(tips=5, points=2), 6)
    tool = found(tcp(tmp_path, relabelled(made.touches, 2, 1), "--json"))
    (reason,) = tool["verdict"]["reasons"]
    assert "Touch 3 " in reason
    assert "it is of another point" in reason


def test_few_or_noisy_touches_are_doubted(tmp_path):
    words = tcp(tmp_path, touched(Job(tips=3), 7).touches).out
    assert "Only 3 touches of a point are used" in words
    noisy = tcp(tmp_path, touched(Job(tips=12, contact_m=1e-3), 8).touches).out
    assert "mm only (per axis; doubt begins at 0.5)" in noisy
    flat = tcp(tmp_path, touched(Job(cone_deg=4.0), 9).touches).out
    assert "Add touches tilted by 30 to 45 degrees" in flat
    stated = tcp(tmp_path, touched(Job(), 10).touches, "--touch-noise-mm", "0.02").out
    assert "scatter by more than they are stated to" in stated


def test_another_order_of_the_quaternion_is_a_bad_tool(tmp_path):
    poses = touched(Job(), 11).touches.base_from_flange
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.hstack([poses[:, :3, 3], np.roll(turns, 1, axis=1)]).tolist()
    path = write_table(
        tmp_path / "touches.csv", ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"), rows
    )
    done = visioncal("tcp", path)
    assert done.status == 3
    assert "poses that are read wrongly (--robot-form, --robot-inverse)" in done.out


# --- What cannot be is refused.


def refused(done, *words):
    assert done.status == 2
    for word in words:
        assert word in done.err


def test_too_few_touches_are_refused(tmp_path):
    done = tcp(tmp_path, touched(Job(tips=2), 1).touches, "-o", tmp_path / "frames.json")
    refused(done, "2 touches of kind point", "at least 3 of one point", "tilted by 20 to 45")
    assert not (tmp_path / "frames.json").exists()


def test_touches_from_one_orientation_are_refused(tmp_path):
    poses = touched(Job(), 1).touches.base_from_flange.copy()
    poses[:, :3, :3] = poses[0, :3, :3]
    # Where the robot stands is told to 1 mm, so that no two are copies.
    poses[:, :3, 3] = poses[0, :3, 3] + 1e-3 * np.random.default_rng(1).normal(size=(10, 3))
    done = visioncal("tcp", write_poses(tmp_path / "touches.csv", poses))
    refused(
        done, "the tip's offset from the flange is not determined at all", "differ in position only"
    )


def test_touches_that_turn_about_one_axis_name_what_is_open(tmp_path):
    poses = touched(Job(), 1).touches.base_from_flange.copy()
    spins = Rotation.from_rotvec(np.outer(np.linspace(-1.5, 1.5, 10), [0, 0, 1.0])).as_matrix()
    met = poses[0, :3, :3] @ TIP + poses[0, :3, 3]
    poses[:, :3, :3] = poses[0, :3, :3] @ spins
    poses[:, :3, 3] = met - poses[:, :3, :3] @ TIP
    done = visioncal("tcp", write_poses(tmp_path / "touches.csv", poses))
    refused(done, "the tip's offset along the flange's z is not determined at all")


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1000.0, "these look like millimetres"), (1e-3, "metres read as millimetres")],
)
def test_other_units_are_refused(tmp_path, scale, words):
    poses = touched(Job(), 1).touches.base_from_flange.copy()
    poses[:, :3, 3] *= scale
    refused(visioncal("tcp", write_poses(tmp_path / "touches.csv", poses)), words, "--robot-unit")


def test_degrees_for_radians_are_refused(tmp_path):
    poses = touched(Job(), 1).touches.base_from_flange
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(degrees=True)
    rows = np.hstack([poses[:, :3, 3], turns]).tolist()
    path = write_table(tmp_path / "touches.csv", ("x", "y", "z", "rx", "ry", "rz"), rows)
    done = visioncal("tcp", path)
    refused(done, "too large for radians", "rotation-vector-deg")
    refused(visioncal("tcp", path, "--robot-form", "ur"), "too large for radians")
    tool = found(visioncal("tcp", path, "--robot-form", "rotation-vector-deg", "--json"))
    assert off_mm(tool) < NEAR_MM


def test_wrong_rows_are_refused_by_their_place(tmp_path):
    touches = touched(Job(), 1).touches
    path = file_of(tmp_path / "touches.csv", touches)
    lines = path.read_text().splitlines()

    def run(text):
        path.write_text(text)
        return visioncal("tcp", path)

    copied = run("\n".join([*lines, lines[3].replace("3,", "11,", 1)]))
    refused(copied, "touches.csv, line 4 and touches.csv, line 12 have the very same pose")
    kind = run("\n".join(lines).replace("2,point", "2,pint"))
    refused(kind, "touches.csv, line 3: kind is 'pint'", "Did you mean point?")
    fixture = run("\n".join(lines).replace("2,point", "2,origin"))
    refused(fixture, "kind is 'origin'", "point, z, xz or nothing")
    without = run("\n".join(lines).replace(lines[2].split("point")[1], "," * 7))
    refused(without, "touches.csv, line 3: no pose of the robot")
    refused(run("x,y\n1,2\n"), "which of its fields are the robot's poses is not known")
    refused(visioncal("tcp", tmp_path / "nowhere.csv"), "nowhere.csv does not exist")


def test_wrong_options_are_refused(tmp_path):
    touches = touched(Job(), 1).touches
    for more, words in (
        (("--touch-noise-mm", "0"), "greater than or equal to 0.0001"),
        (("--name", "My tool"), "cannot name a tool"),
        (("--name", "flange"), "every cell has a frame of that name"),
        (("--robot-unit", "mn"), "There is no unit of length named 'mn'"),
        (("--robot-form", "kuko"), "Did you mean kuka"),
        (("-c", tmp_path), "calibration.json does not exist"),
        (("-o", tmp_path / "no" / "frames.json"), "cannot be written"),
    ):
        refused(tcp(tmp_path, touches, *more), words)


# --- What it writes.


def test_a_file_of_frames_is_made_extended_and_kept(tmp_path):
    touches, path = touched(Job(), 1).touches, tmp_path / "frames.json"
    done = tcp(tmp_path, touches, "-o", path)
    assert done.status == 0
    assert f"wrote {path}" in done.err
    first = FrameFile.load(path).frames["flange_from_tool"]
    assert tcp(tmp_path, touches, "-o", path, "--name", "gripper").status == 0
    assert list(FrameFile.load(path).frames) == ["flange_from_tool", "flange_from_gripper"]
    other = touched(Job(), 2).touches
    refused(tcp(tmp_path, other, "-o", path), "already has flange_from_tool", "--force")
    kept = FrameFile.load(path).frames["flange_from_tool"]
    assert np.array_equal(kept.edge.matrix, first.edge.matrix)
    assert tcp(tmp_path, other, "-o", path, "--force").status == 0
    replaced = FrameFile.load(path).frames["flange_from_tool"]
    assert not np.array_equal(replaced.edge.matrix, first.edge.matrix)
    path.write_text("{}")
    refused(tcp(tmp_path, touches, "-o", path), "not frames that this version can read")


def test_nothing_is_written_unless_it_is_said_where(tmp_path):
    done = tcp(tmp_path, touched(Job(), 1).touches)
    assert "nothing was written" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["touches.csv"]


def test_json_is_the_frame_alone(tmp_path):
    path = tmp_path / "frames.json"
    done = tcp(tmp_path, touched(Job(), 1).touches, "-o", path, "--json")
    assert json.loads(done.out) == json.loads(path.read_text())["frames"]
    assert done.err == ""
    refused = visioncal("tcp", tmp_path / "nowhere.csv", "--json")
    assert refused.status == 2
    assert json.loads(refused.out)["error"]["message"] in refused.err


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    write_session(simulate(CellOptions(views=10, seed=3)), folder / "cell", images=False)
    session = Session.load(folder / "cell")
    write_outputs(folder / "out", session, run(session))
    return folder / "out"


@pytest.fixture
def out(calibrated, tmp_path):
    return Path(shutil.copytree(calibrated, tmp_path / "out"))


def test_a_tool_joins_its_calibration(out, tmp_path):
    before = Calibration.load(out)
    touches = touched(Job(axes=3), 1).touches
    done = tcp(tmp_path, touches, "-c", out, "--name", "gripper")
    assert done.status == 0
    assert all(f"wrote {out / name}" in done.err for name in ("calibration.json", "recording.rrd"))
    after = Calibration.load(out)
    assert list(after.frames) == ["flange_from_gripper"]
    for name, edge in before.edges.items():
        assert np.array_equal(after.edges[name].matrix, edge.matrix)
    assert "flange_from_gripper" in (out / "report.html").read_text(encoding="utf-8")
    recorded = read_calibration(out / "recording.rrd").frames["flange_from_gripper"]
    matrix = after.frames["flange_from_gripper"].edge.matrix
    assert np.array_equal(recorded.edge.matrix, matrix)
    exported = visioncal("export", out, "--to", "ur-tcp")
    assert exported.status == 0
    numbers = exported.out.partition("set_tcp(p[")[2].partition("]")[0].split(",")
    # Nanometres are written.
    assert np.array(numbers[:3], dtype=float) == pytest.approx(matrix[:3, 3], abs=1e-8)
    refused(tcp(tmp_path, touches, "-c", out, "--name", "gripper"), "already has")
    again = tcp(tmp_path, touches, "-c", out, "--name", "gripper", "--force")
    assert "it replaces the one of" in again.err
    # A fixture of the same name would hang the frame in two places.
    taken = visioncal("fixture", tmp_path / "touches.csv", "-c", out, "--name", "gripper")
    refused(taken, "'gripper' is taken: flange_from_gripper is there already")
    whole = (out / "calibration.json").read_bytes()
    refused(tcp(tmp_path, touches, "-o", out / "calibration.json"), "is a calibration", "-c")
    assert (out / "calibration.json").read_bytes() == whole
    elsewhere = tmp_path / "frames.json"
    assert tcp(tmp_path, touches, "-c", out, "-o", elsewhere).status == 0
    assert list(Calibration.load(out).frames) == ["flange_from_gripper"]


def test_a_fixture_is_touched_with_the_calibrations_tool(out, tmp_path):
    touches = touched(Job(axes=3), 1).touches
    path = file_of(tmp_path / "touches.csv", touches)
    refused(visioncal("fixture", path, "-c", out), "The calibration has no tool", "--tool none")
    assert tcp(tmp_path, touches, "-c", out).status == 0
    kinds = ["origin", "x", "xy"] * 2
    poses = np.tile(touches.base_from_flange[0], (6, 1, 1))
    poses[:, :2, 3] += [[0, 0], [0.2, 0], [0.1, 0.2], [0.0, 1e-4], [0.3, 0], [0.0, 0.3]]
    path = write_poses(tmp_path / "fixture.csv", poses, {"kind": kinds})
    done = visioncal("fixture", path, "-c", out)
    assert done.status == 0, done.err
    fixture = Calibration.load(out).frames["base_from_fixture"]
    assert fixture.details["tool"]["name"] == "flange_from_tool"
    # Along the base's axes by construction, to 0.1 mm over 0.3 m.
    assert np.abs(fixture.edge.matrix[:3, :3] - np.eye(3)).max() < 1e-3
    assert "base_from_fixture" in (out / "report.html").read_text(encoding="utf-8")
    exported = visioncal("export", out, "--to", "abb-wobjdata")
    assert exported.status == 0
    assert "PERS wobjdata" in exported.out


def test_a_bad_tool_is_shown_and_does_not_join(out, tmp_path):
    before = (out / "calibration.json").read_bytes()
    touches = touched(Job(), 1).touches
    # Of anything else: the flange is anywhere within centimetres.
    scattered = replace(
        touches, base_from_flange=touches.base_from_flange + _shifted(len(touches), 0.03)
    )
    done = tcp(tmp_path, scattered, "-c", out, "--name", "gripper")
    assert done.status == 3
    assert done.out.startswith("bad")
    assert "does not join" in done.err
    assert tcp(tmp_path, scattered, "-c", out, "--name", "gripper", "--json").status == 3
    assert (out / "calibration.json").read_bytes() == before
    # A file of frames keeps it, and what would use it refuses.
    file = tmp_path / "frames.json"
    assert tcp(tmp_path, scattered, "-o", file, "--name", "gripper").status == 3
    assert visioncal("export", file, "--to", "ur-tcp").status == 3
    assert visioncal("export", file, "--to", "ur-tcp", "--force").status == 0


def _shifted(count, sigma_m):
    shifts = np.zeros((count, 4, 4))
    shifts[:, :3, 3] = sigma_m * np.random.default_rng(3).standard_normal((count, 3))
    return shifts


def test_a_tool_is_removed_by_its_name(out, tmp_path):
    touches = touched(Job(axes=3), 1).touches
    for name in ("gripper", "needle"):
        assert tcp(tmp_path, touches, "-c", out, "--name", name).status == 0
    refused(visioncal("export", out, "--to", "ur-tcp"), "flange_from_needle")
    done = visioncal("tcp", "-c", out, "--remove", "needle")
    assert done.status == 0
    assert list(Calibration.load(out).frames) == ["flange_from_gripper"]
    assert list(read_calibration(out / "recording.rrd").frames) == ["flange_from_gripper"]
    assert visioncal("export", out, "--to", "ur-tcp").status == 0
    refused(visioncal("tcp", "-c", out, "--remove", "needle"), "has no tool 'needle'")
    refused(visioncal("fixture", "-c", out, "--remove", "gripper"), "has no fixture 'gripper'")
    refused(visioncal("tcp", "-c", out), "touches of it")
    refused(visioncal("tcp", "--remove", "gripper"), "from where")
    both = visioncal("tcp", tmp_path / "touches.csv", "-c", out, "--remove", "gripper")
    refused(both, "--remove measures nothing")
    file = tmp_path / "frames.json"
    assert tcp(tmp_path, touches, "-o", file, "--name", "gripper").status == 0
    assert visioncal("tcp", "-o", file, "--remove", "gripper").status == 0
    assert not FrameFile.load(file).frames
