"""Two cameras at one robot: faults that a single pair shows are named, and their commands mend."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.edited import Rows, edit_rows
from support.following import judged
from support.marks import slow

import visioncal
from visioncal.core.number_format import ranges
from visioncal.core.transforms import invert, log
from visioncal.interchange.formats.mending import shift_views
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.session.columns import POSE
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, RobotAt, cell_session, simulate
from visioncal.simulation.layout import CELL

# Chi-square of six exceeds this in one case of a thousand.
MOST = 22.5
MIDWAY = 12
AXIS_M = np.random.default_rng(5).uniform(-0.3, 0.3, 24)


def stereo(
    folder: Path,
    *,
    in_hand: bool = True,
    scale: float = 1.0,
    stops: int = 24,
    more: tuple[BoardAt, ...] = (),
):
    """Two cameras on a flange and a board before them, or a board in hand before two cameras.

    The table has no joint angles, as most recordings.
    """
    on, board_on = ("a", CELL) if in_hand else (CELL, "a")
    options = NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)),),
        cameras=(
            CameraAt("left", on, place_m=(0.0, -1.0, 1.1)),
            CameraAt("right", on, place_m=(0.0, 1.0, 1.2)),
        ),
        boards=(BoardAt("board", board_on, place_m=(0.0, 0.0, 0.05), scale=scale), *more),
        stops=stops,
        seed=1,
    )
    cell = simulate(options)
    cell_session(cell, "cell", seen="corners").save(folder)

    def without_joints(rows: Rows) -> Rows:
        return [{name: row[name] for name in row if not name.endswith("_rad")} for row in rows]

    edit_rows(folder, without_joints)
    return cell


def with_tool(folder: Path, is_active):
    """Poses of some stops are those of a tool's tip, at (10, 20, 150) mm and turned by 30 deg."""

    def change(rows: Rows) -> Rows:
        for row in rows:
            if row["robot"] == "a" and row["x_m"] and is_active(int(row["stop"])):
                numbers = np.array([float(row[name]) for name in POSE])
                turn = Rotation.from_quat(numbers[3:])
                place = numbers[:3] + turn.apply([0.01, 0.02, 0.15])
                turn = turn * Rotation.from_euler("z", 30.0, degrees=True)
                pose = [*place.tolist(), *turn.as_quat().tolist()]
                row |= dict(zip(POSE, map(repr, pose), strict=True))
        return rows

    edit_rows(folder, change)


def turned(folder: Path, camera: str, is_one=bool):
    """All corners in a camera's rows, or in some, are numbered from the other end of the board."""
    with (folder / "views.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["camera"] == camera]
    views = {row["view"] for row in rows if is_one(row)}
    path = folder / "corners.csv"
    with path.open(encoding="utf-8") as file:
        rows = [*csv.DictReader(file)]
    last = max(int(row["point"]) for row in rows)
    for row in rows:
        if row["view"] in views:
            row["point"] = str(last - int(row["point"]))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0]])
        writer.writeheader()
        writer.writerows(rows)


def on_a_rail(rows: Rows) -> Rows:
    """Positions without a rail along x, which has a column of its own."""
    for row in rows:
        along = float(AXIS_M[int(row["stop"])])
        row |= {"x_m": repr(float(row["x_m"]) - along), "rail_m": repr(along)}
    return rows


def followed():
    """The result of the session in `cell`, unless it is refused, and the one once it is mended."""
    ended, found = judged("cell")
    assert ended.last.status == 0, ended.last.said
    return found[0], found[-1]


def mended(cell, found: Calibration) -> None:
    """A result is good and uses all views; cameras in hand are within its sigmas."""
    assert found.verdict.status == "good"
    assert all(view.used for view in found.views)
    for name, edge in found.edges.items():
        parent, _, frame = name.partition("_from_")
        if parent == "flange_a":
            away = log(invert(cell.mountings[frame]) @ edge.matrix)
            assert away @ np.linalg.solve(edge.covariance, away) < MOST


@pytest.mark.parametrize(
    # A switch midway is found of a board in hand before two cameras, too.
    "is_active",
    [lambda stop: stop % 4 == 1, slow(lambda stop: stop >= MIDWAY)],
)
def test_a_tool_that_was_active_at_some_stops_moves_all_cameras(tmp_path, monkeypatch, is_active):
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell")
    with_tool(tmp_path / "cell", is_active)
    first, last = followed()
    cause = first.verdict.causes[0]
    assert cause.kind == "something_moved"
    assert "and alike of cam_" in cause.words
    assert "--without-tool" in cause.do.command
    mended(cell, last)


def test_a_board_in_hand_moves_with_the_tool_that_was_switched(tmp_path, monkeypatch):
    """With ten views each, no camera shows it alone."""
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell", in_hand=False, stops=20)
    with_tool(tmp_path / "cell", lambda stop: stop >= MIDWAY)
    first, last = followed()
    cause = first.verdict.causes[0]
    assert (
        "the controller's tool is another one from stop 12 on, by (10, 20, 150) mm" in cause.words
    )
    mended(cell, last)


@pytest.mark.parametrize(
    ("first", "has_stops"),
    [(8, False), *(slow(*case) for case in ((8, True), (12, True), (12, False)))],
)
def test_the_tool_of_one_of_two_robots_is_taken_off_its_rows_alone(
    tmp_path, monkeypatch, first, has_stops
):
    """One camera may see most of its views before the switch, and the other one after it."""
    monkeypatch.chdir(tmp_path)
    cell_session(simulate(NetworkOptions(stops=20, seed=3)), "cell", seen="corners").save(
        tmp_path / "cell"
    )
    with_tool(tmp_path / "cell", lambda stop: stop >= first)
    late, early = list[int](), list[int]()

    def change(rows: Rows) -> Rows:
        for row in rows:
            if row["robot"] == "a" and row["x_m"]:
                (late if int(row["stop"]) >= first else early).append(int(row["view"]))
        kept = [name for name in rows[0] if not name.endswith("_rad")]
        kept = [name for name in kept if has_stops or name != "stop"]
        return [{name: row[name] for name in kept} for row in rows]

    edit_rows(tmp_path / "cell", change)
    first_result, last = followed()
    found = first_result.verdict.causes[0]
    assert "the controller's tool" in found.words
    # The tool off the later poses, or its inverse off the earlier ones.
    views = re.search(r"--without-tool (\S+?):", found.do.command)[1]
    assert views in (ranges(late), ranges(early))
    assert last.verdict.status == "good"


def test_a_pair_that_has_no_answer_does_not_cost_the_cells(tmp_path, monkeypatch):
    stereo(tmp_path / "cell")
    with_tool(tmp_path / "cell", lambda stop: stop >= MIDWAY)

    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("visioncal.calibration.run._of_pair", singular)
    assert visioncal.calibrate(tmp_path / "cell").verdict.status == "check"


def test_corners_of_one_camera_that_are_numbered_from_the_other_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell")
    turned(tmp_path / "cell", "right")
    ended, (found,) = judged("cell")
    refusal = ended.runs[0].refused("numbers the corners of target_board from the other end")
    assert re.search("cam_.* numbers the corners", refusal.err)
    assert ended.last.status == 0
    mended(cell, found)


def test_a_fixed_board_before_a_fixed_camera_that_some_rows_number_from_the_other_end(
    tmp_path, monkeypatch
):
    """No robot is between both."""
    monkeypatch.chdir(tmp_path)
    floor = BoardAt("floor", place_m=(0.0, 0.0, 0.05))
    cell = stereo(tmp_path / "cell", in_hand=False, more=(floor,))
    turned(
        tmp_path / "cell",
        "right",
        lambda row: row["target"] == "floor" and int(row["stop"]) % 5 == 2,
    )
    first, last = followed()
    cause = first.verdict.causes[0]
    assert cause.kind == "turned_board"
    assert "target_floor was read turned by 180 deg" in cause.words
    mended(cell, last)


def test_rows_that_are_shifted_are_counted_by_the_stops_of_their_robot(tmp_path, monkeypatch):
    """Each camera sees every other stop: two stops are one of its rows."""
    monkeypatch.chdir(tmp_path)
    stereo(tmp_path / "cell", in_hand=False, stops=20)

    def change(rows: Rows) -> Rows:
        shown = [{name: row[name] for name in POSE} for row in rows]
        return [
            row | (shown[min(at + 2, len(rows) - 1)] if at >= 8 else {})
            for at, row in enumerate(rows)
        ]

    edit_rows(tmp_path / "cell", change)
    cause = followed()[0].verdict.causes[0]
    assert cause.kind == "shifted_rows"
    assert re.search(r"--shift \d+-19:-2", cause.do.command)


@pytest.mark.slow
def test_a_rail_with_a_column_is_added_to_all_rows_of_its_robot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell")
    edit_rows(tmp_path / "cell", on_a_rail)
    first, last = followed()
    cause = first.verdict.causes[0]
    assert "lack a motion along x" in cause.words
    assert ":x+1*rail_m,y,z" in cause.do.command
    mended(cell, last)


def test_the_only_board_of_two_cameras_has_a_size(tmp_path):
    stereo(tmp_path / "cell", scale=0.95)
    found = visioncal.calibrate(tmp_path / "cell")
    assert [cause.kind for cause in found.verdict.causes[:1]] == ["board_size"]
    # By the robot's motion; its sigma is below a tenth of a percent.
    assert found.boards["board"].shape["scale"] == pytest.approx(-0.05, abs=1e-3)


def one_picture_lost(folder: Path, camera: str, first: int) -> None:
    """The pictures of a camera from one of its rows on are those of the rows after them."""
    with (folder / "views.csv").open(encoding="utf-8") as file:
        camera_views = [row["view"] for row in csv.DictReader(file) if row["camera"] == camera]
    of = dict(zip(camera_views[first + 1 :], camera_views[first:], strict=False))

    def change(rows: Rows) -> Rows:
        kept = (row for row in rows if row["view"] != camera_views[first])
        return [row | {"view": of.get(row["view"], row["view"])} for row in kept]

    edit_rows(folder, change, "corners.csv")
    edit_rows(folder, lambda rows: [row for row in rows if row["view"] != camera_views[-1]])


@pytest.mark.parametrize("first", [8, slow(0)])
def test_pictures_of_one_camera_that_are_apart_leave_the_robots_poses_to_the_other(
    tmp_path, monkeypatch, first
):
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell")
    one_picture_lost(tmp_path / "cell", "right", first)
    first_result, last = followed()
    cause = first_result.verdict.causes[0]
    assert "in its rows of cam_right and target_board" in cause.words
    assert ":1:images" in cause.do.command
    mended(cell, last)


def test_pictures_without_a_pose_are_given_to_the_stops_of_the_robot(tmp_path):
    stereo(tmp_path / "cell")

    def change(rows: Rows) -> Rows:
        for row in rows:
            row.update(dict.fromkeys((*POSE, "robot"), "") if row["camera"] == "right" else {})
        return rows

    edit_rows(tmp_path / "cell", change)
    session = Session.load(tmp_path / "cell")
    posed = {view.stop: view for view in session.views if view.base_from_flange() is not None}
    own = {view.number: view.stop for view in session.views if view.text.get("camera") == "right"}
    stops = sorted(posed)
    late = [number for number, stop in own.items() if stop > stops[3] and stop in stops]
    given = {view.number: view for view in shift_views(session, late, -1, True).views}
    moved = [number for number in late if number in given]
    assert len(moved) >= len(late) - 3
    for number in moved:
        before = stops[stops.index(own[number]) - 1]
        assert given[number].stop == before
        assert given[number].text["camera"] == "right"
        assert [given[number].cell(at) for at in POSE] == [posed[before].cell(at) for at in POSE]


def test_a_robot_whose_rows_are_all_apart_is_named_where_nothing_else_ties_it(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    options = NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)), RobotAt("b", (0.6, 0.0, 0.0))),
        cameras=(CameraAt("top", CELL, place_m=(0.0, -1.0, 1.1)),),
        boards=(BoardAt("one", "a"), BoardAt("other", "b")),
        stops=16,
        seed=1,
    )
    cell_session(simulate(options), "cell", seen="corners").save(tmp_path / "cell")

    def change(rows: Rows) -> Rows:
        own = [row for row in rows if row["robot"] == "b" and row["x_m"]]
        poses = [{name: row[name] for name in POSE} for row in own]
        for row, pose in zip(own[1:], poses, strict=False):
            row.update(pose)
        return [{name: row[name] for name in row if not name.endswith("_rad")} for row in rows]

    edit_rows(tmp_path / "cell", change)
    ended, _ = judged("cell")
    refusal = ended.runs[0].refused("nothing ties base_b")
    assert re.search(
        "Robot b, in its rows of cam_top and target_other: .* 1 row apart", refusal.err
    )
    assert ended.last.status == 0
