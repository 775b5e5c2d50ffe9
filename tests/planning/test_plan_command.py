"""`visioncal plan`, as a user runs it: what it proposes, what it writes, what it refuses."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from support.commands import visioncal
from support.marks import slow

from visioncal.core.documents.pendants import read_pose
from visioncal.core.transforms import exp
from visioncal.results import Calibration
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.session.table import parse_csv, read_views
from visioncal.simulation import (
    BoardAt,
    CameraAt,
    CellOptions,
    InstrumentAt,
    NetworkOptions,
    PointAt,
    RobotAt,
    cell_session,
    simulate,
    write_session,
)

pytestmark = pytest.mark.usefixtures("strict_rerun")

FILES = {"stops.csv", "plan.json", "plan.script", "plan.rrd"}
CELL = {
    "--target": "charuco_9x6_30mm",
    "--camera": "1000,1000,640,400",
    "--resolution": "1280,800",
    "--cam": "0 -60 60 0 0 0",
    "--board": "500 0 5 180 0 0",
    "--guess-deg": "2",
    "--candidates": "60",
}


def plan(source, out, *more, **cell):
    options = CELL | {f"--{name}": value for name, value in cell.items()}
    return visioncal(
        "plan", source, "-o", out, *more, *(name for two in options.items() for name in two)
    )


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned") / "größer"
    plan("ur5e", folder, "--stops", 6, "--box", "post:400,600,300:100,100,600").good()
    return folder


@pytest.fixture(scope="module")
def document(planned):
    return json.loads((planned / "plan.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def one_axis(tmp_path_factory):
    options = CellOptions(robot="ur5e", views=5, motion="one_axis", seed=1)
    folder = tmp_path_factory.mktemp("sessions") / "one axis"
    cell_session(simulate(options), "one axis", seen="corners").save(folder)
    return folder


def test_a_plan_has_a_table_a_program_a_preview_and_all_of_it_as_json(planned, document):
    assert {path.name for path in planned.iterdir()} == FILES
    assert document["purpose"] == "hand-eye"
    assert len(document["stops"]) == 6
    assert sorted(value["rank"] for value in document["stops"]) == [1, 2, 3, 4, 5, 6]
    assert document["cell"]["limits"]["clearance_m"] == 0.03
    assert document["cell"]["boxes"][0]["name"] == "post"
    assert re.fullmatch("[0-9a-f]{64}", document["inputs_sha256"])
    # Six stops with the board filling the image know the camera's place to well under 1 mm.
    assert 0.0 < document["predicted"]["after"]["sigma_mm"] < 1.0
    by_rank = sorted(document["stops"], key=lambda pair: pair["rank"])
    sigmas = [value["after"]["sigma_mm"] for value in by_rank if "sigma_mm" in value["after"]]
    assert sigmas == sorted(sigmas, reverse=True)


def test_the_table_opens_as_views_with_the_models_poses(planned, document):
    table = parse_csv((planned / "stops.csv").read_text(encoding="utf-8"), "stops.csv")
    views = read_views(table)
    robot = load_robot("ur5e")
    for view, stop in zip(views, document["stops"], strict=True):
        assert view.number == stop["view"]
        assert view.image == f"images/{view.number:03d}.png"
        pose = robot.base_from_flange(view.joints_rad[None])[0]
        # Nine decimals of joints of an arm of 1 m: a nanometre or two.
        np.testing.assert_allclose(view.base_from_flange().as_matrix(), pose, atol=1e-8)
        np.testing.assert_allclose(view.joints_rad, stop["q"], atol=1e-9)
        assert view.text["why"] == stop["why"]
        # Half of the last digits of a pendant: 5 um with 5e-7 rad, and of a degree.
        shown = read_pose(view.text["pose_ur"], "the table", "ur").pose
        np.testing.assert_allclose(shown, pose, atol=6e-7)
        degrees = np.array(view.text["joints_deg"].split(), dtype=float)
        np.testing.assert_allclose(np.deg2rad(degrees), view.joints_rad, atol=1e-5)


def test_the_program_drives_to_each_stop_by_way_of_what_lies_between(planned, document):
    text = (planned / "plan.script").read_text(encoding="ascii")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert lines[0] == "def visioncal_plan():"
    # One function, closed before it is called; inside it nothing but assignments and calls.
    assert [line for line in lines if line and not line.startswith("  ")] == [
        "def visioncal_plan():",
        "end",
        "visioncal_plan()",
    ]
    inside = [line.strip() for line in lines if line.startswith("  ")]
    call = r'(movej\(\[.*\], a=acceleration, v=speed\)|sleep\(settling\)|popup\(".*", title=".*", '
    call += r"blocking=True\))"
    assert all(re.match(rf"({call}|[a-z]+ = [0-9.]+)( *#.*)?$", value) for value in inside)
    moves = [
        json.loads(value.partition("(")[2].partition("]")[0] + "]")
        for value in inside
        if "movej" in value
    ]
    wanted = [q for value in document["stops"] for q in (*value.get("via_q", []), value["q"])]
    # Six decimals.
    np.testing.assert_allclose(moves, wanted, atol=1e-6)
    assert sum("popup" in value and "take images/" in value for value in inside) == 6


@pytest.mark.slow
def test_a_session_about_one_axis_is_pointed_here_and_gets_its_missing_stops(one_axis, tmp_path):
    refused = visioncal("calibrate", one_axis, "-o", tmp_path / "out")
    # An arm of six axes is not told of those that cannot tilt.
    command = f"about one axis of the tool. Run: visioncal plan '{one_axis}' --add 5"
    refused.refused(f"tilted by 20 to 40 degrees about different axes, not only {command}")
    out = tmp_path / "plan"
    done = visioncal("plan", one_axis, "--add", 2, "-o", out, "--candidates", 60).good()
    assert "not determined before" in done.out
    found = json.loads((out / "plan.json").read_text())
    assert found["predicted"]["before"] == {"open": True}
    # The noise of a sound arm, by two stops that turn the camera otherwise.
    assert found["predicted"]["after"]["sigma_mm"] < 0.5
    assert "not determined at all" in found["refusal_before"]
    numbers = [view.number for view in Session.load(one_axis).views]
    assert [value["view"] for value in found["stops"]] == [max(numbers) + 1, max(numbers) + 2]
    first = min(found["stops"], key=lambda pair: pair["rank"])
    assert "determines what was open" in first["why"]


def test_stops_are_added_to_a_cell_whose_tracker_reads_a_point(tmp_path):
    """Of a point no rotation is known, nor needed."""
    options = NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)),),
        cameras=(CameraAt("top", place_m=(0.0, -1.0, 1.1)),),
        boards=(BoardAt("plate", on="a"),),
        instruments=(InstrumentAt("tracker", (2.5, -1.0, 0.4)),),
        points=(PointAt("ball", "a", (0.03, -0.02, 0.12)),),
        stops=12,
    )
    cell_session(simulate(options), "cell", seen="corners").save(tmp_path / "cell")
    said = visioncal(
        *("plan", tmp_path / "cell", "--add", 2, "-o", tmp_path / "plan", "--candidates", 60)
    )
    assert "hand-eye: 2 stops to add" in said.good().out


@pytest.mark.parametrize(
    ("source", "cell", "more", "words"),
    [
        ("ur55e", {}, (), "Did you mean ur5e"),
        ("ur5e", {"cam": "1 2 3"}, (), "--cam is '1,2,3', but must be x,y,z,rx,ry,rz"),
        ("ur5e", {"resolution": "1280"}, (), "--resolution"),
        slow("ur5e", {}, ("--box", "cage:500,0,400:900,900,700"), "Look whether the boxes are"),
        ("ur5e", {}, ("--for", "handeye"), "Did you mean hand-eye"),
        ("ur5e", {}, ("--add", "3"), "holds no recorded session"),
        ("ur5e", {}, ("--need-mm", "-1"), "above zero"),
        ("ur5e", {}, ("--need-mm", "0.2", "--for", "offsets"), "these stops are for the arm"),
    ],
)
def test_a_source_that_cannot_be_planned_is_refused_by_name(source, cell, more, words, tmp_path):
    assert "Traceback" not in plan(source, tmp_path / "out", *more, **cell).refused(words).err
    assert not (tmp_path / "out").exists()


def test_a_cell_without_a_camera_says_all_that_is_missing(tmp_path):
    done = visioncal("plan", "ur5e", "-o", tmp_path / "out").refused()
    for option in ("--target", "--camera", "--cam", "--board"):
        assert option in done.err


def test_stops_are_planned_until_a_need_is_met_in_prediction(tmp_path):
    done = plan("ur5e", tmp_path / "met", "--need-mm", "0.4")
    met = json.loads((tmp_path / "met/plan.json").read_text(encoding="utf-8"))
    assert met["need"]["probability"] >= 0.95
    # Fewer stops show no outlier.
    assert 10 <= len(met["stops"]) < 40
    assert "that meets the need" in done.out
    # The default print is as large as stated to 0.1 % only.
    assert "as long as the board is as large as stated to 0.0" in met["condition"]
    assert met["condition"] in done.out
    assert met["need"]["mm"] == met["request"]["need"]["mm"] == 0.4
    few = ("--need-mm", "0.4", "--stops", "4")
    done = plan("ur5e", tmp_path / "few", *few)
    short = json.loads((tmp_path / "few/plan.json").read_text(encoding="utf-8"))
    assert len(short["stops"]) <= 4
    assert short["need"]["probability"] <= met["need"]["probability"]
    # The noise of the robot at a pick is beyond that, however many stops there are.
    done = plan("ur5e", tmp_path / "never", "--need-mm", "0.1")
    assert "More stops cannot reach it: all candidates together give" in done.out
    assert "a robot without noise at the pick helps most, and would give" in done.out


@pytest.mark.slow
def test_arms_that_no_ur_program_drives_get_no_program(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "plan.script").write_text("of an earlier plan")
    plan("panda", out, "--stops", 3, board="450 0 5 180 0 0").good()
    assert {path.name for path in out.iterdir()} == FILES - {"plan.script"}
    header = (out / "stops.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert header[:9] == ["view", "image", *(f"q{index}_rad" for index in range(1, 8))]


@pytest.mark.slow
def test_calibrated_stops_that_a_check_repeats_are_far_apart(tmp_path):
    session = write_session(
        simulate(CellOptions(views=14, seed=8)), tmp_path / "cell", images=False
    )
    assert visioncal("calibrate", session, "-o", tmp_path / "out").status == 0
    done = visioncal("plan", tmp_path / "out", "--verify", "-o", tmp_path / "plan").good()
    assert f"visioncal verify monday --against {tmp_path / 'out'}" in done.out
    # Measured poses do not say which board they are of: the stops are told, and no way to them.
    assert {file.name for file in (tmp_path / "plan").iterdir()} == {"stops.csv"}
    rows = (tmp_path / "plan" / "stops.csv").read_text().splitlines()[1:]
    stops = Calibration.load(tmp_path / "out").joint_fit.stops
    chosen = [int(row.partition(",")[0]) for row in rows]
    assert len(set(chosen)) == 5
    poses = exp(stops.poses)[:, :3].reshape(len(stops.views), 12)
    apart = pdist(poses[[stops.views.index(view) for view in chosen]])
    assert apart.min() > 2.0 * pdist(poses).min()
    visioncal("plan", session, "--verify", "-o", tmp_path / "plan").refused("must be a calibration")
