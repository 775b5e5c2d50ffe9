"""Mistakes of whole cells that one of their cameras, or one of their tables, shows."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.edited import Rows, changed, edit_rows
from support.following import judged
from support.marks import slow
from support.refusals import raised
from test_pairs_alone import followed, mended, stereo, turned

import visioncal
from visioncal.core.errors import DataError, DegenerateError
from visioncal.interchange.formats.mending import exchange_views
from visioncal.session import Session
from visioncal.session.columns import POSE
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, RobotAt, cell_session, simulate
from visioncal.simulation.layout import CELL


def without_joints(rows: Rows) -> Rows:
    return [{name: row[name] for name in row if not name.endswith("_rad")} for row in rows]


def saved(robots: tuple[RobotAt, ...], cameras: tuple[CameraAt, ...], boards: tuple[BoardAt, ...]):
    """A cell of 20 stops in the folder `cell`, without joint angles."""
    options = NetworkOptions(robots=robots, cameras=cameras, boards=boards, stops=20, seed=1)
    cell_session(simulate(options), "cell", seen="corners").save(Path("cell"))
    edit_rows(Path("cell"), without_joints)


ROBOTS = (RobotAt("a", (-0.6, 0.0, 0.0)), RobotAt("b", (0.6, 0.0, 0.0)))
TOP = CameraAt("top", CELL, place_m=(0.0, -1.0, 1.1))
FLOOR = BoardAt("floor", CELL, place_m=(0.0, 0.1, 0.0))


def zoomed(folder: Path, camera: str, first_stop: int, factor: float) -> None:
    """The corners of a camera lie farther from the middle of its pictures from a stop on."""
    session = Session.load(folder)
    width, height = session.cameras[camera].resolution
    late = {
        str(view.number)
        for view in session.views
        if view.text.get("camera") == camera and view.stop >= first_stop
    }

    def change(rows: Rows) -> Rows:
        for row in rows:
            for name, middle in (("u_px", width / 2), ("v_px", height / 2)):
                if row["view"] in late:
                    row[name] = repr(middle + factor * (float(row[name]) - middle))
        return rows

    edit_rows(folder, change, "corners.csv")


@pytest.mark.parametrize("factor", [1.004, slow(1.002), slow(1.01)])
def test_a_lens_that_was_refocused_is_no_camera_that_was_bumped(tmp_path, monkeypatch, factor):
    monkeypatch.chdir(tmp_path)
    stereo(tmp_path / "cell")
    zoomed(tmp_path / "cell", "right", 12, factor)
    cause = visioncal.calibrate("cell").verdict.causes[0]
    assert cause.kind == "focus"
    assert "cam_right" in cause.words


def test_a_camera_that_was_bumped_is_no_lens_that_was_refocused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = NetworkOptions(
        robots=ROBOTS[:1],
        cameras=(CameraAt("left", "a"), CameraAt("right", "a")),
        boards=(FLOOR,),
        stops=24,
        seed=1,
    )
    cell_session(simulate(options), "cell", seen="corners").save(tmp_path / "cell")
    edit_rows(tmp_path / "cell", without_joints)
    session = Session.load("cell")
    focal = session.cameras["right"].matrix[0]
    late = {
        str(view.number)
        for view in session.views
        if view.text.get("camera") == "right" and view.stop >= 12
    }

    def change(rows: Rows) -> Rows:
        # A turn of the camera by three milliradians.
        for row in rows:
            if row["view"] in late:
                row["u_px"] = repr(float(row["u_px"]) + 3e-3 * focal)
        return rows

    edit_rows(tmp_path / "cell", change, "corners.csv")
    assert visioncal.calibrate("cell").verdict.causes[0].kind in ("moved_frame", "image_shifted")


def test_an_arm_on_its_way_at_some_stops_is_named_for_all_of_its_cameras(tmp_path, monkeypatch):
    """One camera after the other takes its pictures."""
    monkeypatch.chdir(tmp_path)
    stereo(tmp_path / "cell", in_hand=False)
    moved = list[int]()

    def change(rows: Rows) -> Rows:
        rows.sort(key=lambda row: row["camera"])
        poses = np.array([[float(row[name]) for name in POSE] for row in rows])
        for at in (1, 4, 8, 14, 18, 21):
            turned = Slerp([0, 1], Rotation.from_quat(poses[at : at + 2, 3:]))(0.1)
            place = poses[at, :3] + 0.1 * (poses[at + 1, :3] - poses[at, :3])
            numbers = [*place.tolist(), *turned.as_quat().tolist()]
            rows[at].update(zip(POSE, map(repr, numbers), strict=True))
            moved.append(int(rows[at]["view"]))
        return [row | {"stop": str(at)} for at, row in enumerate(rows)]

    edit_rows(tmp_path / "cell", change)
    cause = visioncal.calibrate("cell").verdict.causes[0]
    assert cause.kind == "something_moved"
    assert "the arm moved between image and pose" in cause.words
    assert {*cause.views} == {*moved}


def test_pictures_exchanged_beside_corners_from_the_other_end_are_both_mended(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    stereo(tmp_path / "cell")
    turned(tmp_path / "cell", "left")
    own = [at.number for at in Session.load("cell").views if at.text.get("camera") == "right"]
    exchange_views(Session.load("cell"), own[2], own[9]).save(tmp_path / "both")
    ended, found = judged("both")
    ended.runs[0].refused("are exchanged")
    assert ended.last.status == 0
    assert found[-1].verdict.status == "good"


def test_poses_of_a_robot_that_are_exchanged_at_stops_of_two_cameras(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved(ROBOTS[:1], (TOP, CameraAt("hand", "a")), (FLOOR, BoardAt("plate", "a")))

    def alone(rows: Rows) -> Rows:
        """Each stop is seen by one camera, as where one is recorded after the other."""
        by = {"top": [], "hand": []}
        for row in rows:
            if row["x_m"] and (row["camera"], row["target"]) in (
                ("top", "plate"),
                ("hand", "floor"),
            ):
                by[row["camera"]].append(row)
        chosen = by["top"] + by["hand"]
        first, second = by["top"][2], by["hand"][5]
        taken = {name: (first[name], second[name]) for name in POSE}
        first.update({name: both[1] for name, both in taken.items()})
        second.update({name: both[0] for name, both in taken.items()})
        return [row | {"stop": str(at)} for at, row in enumerate(chosen)]

    edit_rows(tmp_path / "cell", alone)
    first_result, found = followed()
    cause = first_result.verdict.causes[0]
    assert cause.kind == "exchanged_views"
    assert len(cause.views) == 2
    assert found.verdict.status == "good"
    assert all(view.used for view in found.views)


def test_columns_of_one_camera_that_are_exchanged_are_exchanged_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cell = stereo(tmp_path / "cell", in_hand=False)
    right = {
        str(at.number) for at in Session.load("cell").views if at.text.get("camera") == "right"
    }

    def change(rows: Rows) -> Rows:
        for row in rows:
            if row["view"] in right:
                row["u_px"], row["v_px"] = row["v_px"], row["u_px"]
        return rows

    edit_rows(tmp_path / "cell", change, "corners.csv")
    mended(cell, followed()[1])


def test_rows_that_state_another_robot_than_the_frames_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved(ROBOTS, (TOP,), (BoardAt("one", "a"), BoardAt("other", "b")))

    def change(rows: Rows) -> Rows:
        kept = [row for row in rows if row["x_m"]]
        names = {"a": "b", "b": "a"}
        return [
            row | {"robot": names[row["robot"]], "stop": str(at)} for at, row in enumerate(kept)
        ]

    edit_rows(tmp_path / "cell", change)
    words = "target_one is on robot a as .frames. declares, and its rows state the poses of robot b"
    found = raised(DataError, words, visioncal.calibrate, "cell")
    assert 'target_one = "flange_b"' in found.next_step


def test_a_board_that_a_robot_carries_though_it_is_declared_to_stand_still(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stereo(tmp_path / "cell", in_hand=False)
    changed(tmp_path / "cell", "session.toml", 'target_board = "flange_a"', 'target_board = "cell"')
    found = raised(DegenerateError, "target_board moves with robot a", visioncal.calibrate, "cell")
    assert 'Write target_board = "flange_a" in [frames]' in found.next_step


def test_exchanged_names_of_two_boards_of_one_camera_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    boards = (FLOOR, BoardAt("wall", CELL, place_m=(0.0, -0.3, 0.1)))
    saved(ROBOTS[:1], (CameraAt("hand", "a"),), boards)
    names = {"floor": "wall", "wall": "floor"}
    edited = dict[str, str]()

    def change(rows: Rows) -> Rows:
        for name in names:
            row = next(at for at in rows[4:] if at["target"] == name and at["view"] not in edited)
            row["target"] = edited[row["view"]] = names[name]
        return rows

    def of_corners(rows: Rows) -> Rows:
        return [row | {"target": edited.get(row["view"], row["target"])} for row in rows]

    edit_rows(tmp_path / "cell", change)
    edit_rows(tmp_path / "cell", of_corners, "corners.csv")
    cause = visioncal.calibrate("cell").verdict.causes[0]
    assert cause.kind == "misnamed_rows"
    assert {*cause.views} == {*map(int, edited)}
