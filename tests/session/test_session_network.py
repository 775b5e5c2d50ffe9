"""Sessions with several robots, cameras and boards: what hangs on what, who saw what, refusals."""

import pytest
from support.edited import changed
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.frames.touches import touches_of
from visioncal.present.recording import write_recording
from visioncal.session import Session
from visioncal.session.selecting import check_one_of_each

TOML = """schema = 1
name = "two arms"

[cameras.left]
resolution = [1280, 800]
[cameras.right]
resolution = [2448, 2048]
model = "fisheye"

[robots]
a = "ur5e"
[robots.b]
model = "arms/b.toml"
tip = "tool"

[targets]
plate = "charuco_9x6_30mm"
floor = "checkerboard_9x6_25mm"

[instruments]
tracker = "leica-at960"

[frames]
cam_left = "flange_a"
cam_right = "post"
fixture_post = "cell"
target_floor = "cell"
target_plate = "flange_b"
""".replace('"post"', '"fixture_post"')
ARM = """schema = 1
kind = "dh"
[[joint]]
a_m = 0.1
alpha_rad = 0.0
d_m = 0.1
"""
POSE = "0.1,0.2,0.3,0,0,0,1"
TABLE = f"""view,stop,role,camera,robot,target,image,x_m,y_m,z_m,qx,qy,qz,qw
0,0,,left,a,floor,a.png,{POSE}
1,0,,left,,plate,a.png,,,,,,,
2,0,,right,,plate,b.png,,,,,,,
3,0,,,b,,,{POSE}
4,1,,left,a,floor,c.png,{POSE.replace("0.1", "0.4")}
5,1,,right,,floor,d.png,,,,,,,
6,1,,right,,plate,d.png,,,,,,,
7,,intrinsics,right,,plate,lens/e.png,,,,,,,
"""


@pytest.fixture
def folder(tmp_path):
    session = tmp_path / "cell"
    (session / "arms").mkdir(parents=True)
    (session / "session.toml").write_text(TOML)
    (session / "views.csv").write_text(TABLE)
    (session / "arms" / "b.toml").write_text(ARM)
    for name in "abcd":
        (session / f"{name}.png").write_bytes(b"\x89PNG " + name.encode())
    return session


def test_every_frame_hangs_on_another(folder):
    session = Session.load(folder)
    assert session.frames == {
        "base_a": "cell",
        "base_b": "cell",
        "flange_a": "base_a",
        "flange_b": "base_b",
        "cam_left": "flange_a",
        # What is fixed to a fixture never moves before the cell.
        "cam_right": "cell",
        "target_plate": "flange_b",
        "target_floor": "cell",
        "instrument_tracker": "cell",
    }
    assert list(session.cameras) == ["left", "right"]
    assert session.robots["a"].model == "ur5e"
    assert session.instruments["tracker"].name == "leica-at960"
    assert session.robot_documents["b"]["tip"] == "tool"
    assert session.plates["floor"].kind == "checkerboard"


def test_rows_say_who_saw_what_while_which_robots_stood_how(folder):
    found = {
        observation.view.number: observation for observation in Session.load(folder).observations
    }
    assert list(found) == [0, 1, 2, 4, 5, 6, 7]
    assert (found[1].seer, found[1].seen) == ("cam_left", "target_plate")
    # The pose of robot b is in a row that shows nothing.
    assert {name: row.number for name, row in found[1].robots.items()} == {"a": 0, "b": 3}
    assert list(found[0].robots) == ["a"]
    assert not found[5].robots
    # Nothing tells where robot b stood at the second stop.
    assert found[6].missing_robots == ("b",)
    assert [
        index for index in found if found[index].view.is_of_lens or found[index].missing_robots
    ] == [6, 7]
    stations = [found[index].station for index in found]
    assert stations == [0, 0, 0, 1, 1, 1, 2]


def test_a_row_with_another_pose_than_its_stop_is_of_a_state_of_its_own(folder):
    changed(folder, "views.csv", "1,0,,left,,plate,a.png,,,,,,,", f"1,0,,left,a,plate,a.png,{POSE}")
    assert not [warning for warning in Session.load(folder).warnings if "another pose" in warning]
    far = POSE.replace("0.3", "0.35")
    changed(
        folder, "views.csv", "2,0,,right,,plate,b.png,,,,,,,", f"2,0,,right,a,plate,b.png,{far}"
    )
    session = Session.load(folder)
    (warning,) = [warning for warning in session.warnings if "another pose" in warning]
    assert "view 2 has another pose of robot a than view 0 of the same stop 0" in warning
    found = {observation.view.number: observation.station for observation in session.observations}
    assert found[0] == found[1] != found[2]


def test_every_stored_form_is_the_same_session(folder, tmp_path):
    session = Session.load(folder)
    session.save(tmp_path / "copy")
    write_recording(tmp_path / "cell.rrd", session, None, (), None)
    recorded = Session.load(tmp_path / "cell.rrd")
    recorded.save(tmp_path / "back")
    for again in (Session.load(tmp_path / "copy"), recorded, Session.load(tmp_path / "back")):
        assert again.digest() == session.digest()
        assert again.frames == session.frames
        assert again.robot_documents == session.robot_documents


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("views.csv", "2,0,,right,", "2,0,,rigth,", "names rigth .* left, right.*right"),
        ("views.csv", "2,0,,right,", "2,0,,,", "column camera must name the one that.* view 2"),
        ("views.csv", "0,0,,left,a", "0,0,,left,", "the one whose pose or joints .* view 0"),
        ("views.csv", "0,0,,left", "0,0,intrinsics,left", "the row has x_m"),
        ("session.toml", '"flange_a"', '"flange_c"', "cam_left hangs on 'flange_c', which must be"),
        ("session.toml", "cam_left", "cam_lef", "'cam_lef' must be a frame.*Did you mean cam_left"),
        (
            "session.toml",
            '"flange_a"',
            '["flange_a", "cell"]',
            "cam_left hangs on .* must be a frame",
        ),
        ("session.toml", "[frames]", '[frames]\nflange_a = "cell"', "on base_a by its robot"),
        (
            "session.toml",
            "[frames]",
            '[frames]\nbase_a = "flange_b"\nbase_b = "cam_left"',
            "in a circle: .*base_a on flange_b on base_b on cam_left on flange_a",
        ),
        (
            "session.toml",
            "[cameras.left]",
            'mount = "eye-to-hand"\n[cameras.left]',
            'cam_left hangs on flange_a, but mount = "eye-to-hand" has the cameras beside',
        ),
    ],
)
def test_contradicting_declarations_are_refused(folder, name, old, new, words):
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    assert raised(DataError, words, Session.load, folder).culprits


def test_frames_that_follow_from_mount_and_rows_need_no_declaration(folder):
    text = (folder / "session.toml").read_text()
    head = text[: text.index("[frames]")].replace(
        "[cameras.left]", 'mount = "eye-in-hand"\n[cameras.left]'
    )
    (folder / "session.toml").write_text(head)
    with pytest.raises(DataError, match="frame that carries cam_right") as caught:
        _ = Session.load(folder).frames
    assert caught.value.culprits == ("session.toml: frames.cam_right",)
    # Rows of the right camera that tell where robot b stood put it on that robot's flange.
    changed(
        folder, "views.csv", "5,1,,right,,floor,d.png,,,,,,,", f"5,1,,right,b,floor,d.png,{POSE}"
    )
    frames = Session.load(folder).frames
    assert (frames["cam_left"], frames["cam_right"]) == ("flange_a", "flange_b")
    assert frames["target_plate"] == frames["target_floor"] == "cell"


def test_of_one_robot_what_its_camera_sees_is_in_the_cell(tmp_path):
    (tmp_path / "session.toml").write_text(
        'schema = 1\nname = "one arm"\n[cameras.hand]\n[cameras.top]\n[robot]\nmodel = "ur5e"\n'
        '[targets]\nfloor = "charuco_9x6_30mm"\nplate = "checkerboard_9x6_25mm"\n'
        '[frames]\ncam_hand = "flange"\ntarget_plate = "flange"\n'
    )
    (tmp_path / "views.csv").write_text(
        "view,stop,camera,target,image,x_m,y_m,z_m,qx,qy,qz,qw\n"
        f"0,0,hand,floor,a.png,{POSE}\n1,0,top,plate,b.png,,,,,,,\n"
    )
    session = Session.load(tmp_path)
    assert session.frames["target_floor"] == session.frames["cam_top"] == "cell"
    assert [tuple(observation.robots) for observation in session.observations] == [("",), ("",)]


def test_functions_of_one_camera_and_robot_say_how_to_choose_one(folder):
    session = Session.load(folder)
    raised(DataError, r"several robots \(a, b\)", touches_of, session)
    caught = raised(
        DataError, r"several cameras \(left, right\) and several robots", check_one_of_each, session
    )
    assert "--robot" in caught.next_step


def test_robots_of_six_and_of_seven_joints_share_columns(tmp_path):
    (tmp_path / "session.toml").write_text(
        'schema = 1\nname = "two"\n[cameras]\ntop = {}\n[robots]\na = "ur5e"\nb = "iiwa"\n'
        '[targets]\nplate = "charuco_9x6_30mm"\n[frames]\ncam_top = "cell"\n'
        'target_plate = "flange_b"\n'
    )
    header = "view,stop,robot,image," + ",".join(f"q{at}_rad" for at in range(1, 8))
    rows = "0,0,a,,1,2,3,1,2,3,\n1,0,b,a.png,1,2,3,1,2,3,1\n"
    (tmp_path / "views.csv").write_text(f"{header}\n{rows}")
    session = Session.load(tmp_path)
    assert [len(view.joints_rad) for view in session.views] == [6, 7]
    # A model that is unknown is a warning until something needs it.
    assert any("robots.b.model" in warning for warning in session.warnings)
    assert list(session.robot_documents) == ["a"]
    (tmp_path / "views.csv").write_text(f"{header}\n{rows.replace('0,a,,1,2,', '0,a,,1,,')}")
    raised(DataError, "q1_rad ... q7_rad: some are empty", Session.load, tmp_path)


def test_points_are_on_what_moves_while_they_are_read(tmp_path):
    (tmp_path / "session.toml").write_text(
        'schema = 1\nname = "two"\n[robots]\na = "ur5e"\nb = "ur5e"\n'
        "[instruments.east]\nsigma_m = 1e-5\n[instruments.west]\nsigma_m = 1e-5\n"
    )
    (tmp_path / "views.csv").write_text(
        "view,stop,robot,instrument,point,meas_x_m,meas_y_m,meas_z_m,x_m,y_m,z_m,qx,qy,qz,qw\n"
        f"0,0,b,east,ball,1,2,3,{POSE}\n1,0,,east,nest,1,2,3,,,,,,,\n2,0,,west,nest,1,2,3,,,,,,,\n"
    )
    session = Session.load(tmp_path)
    assert session.frames["point_ball"] == "flange_b"
    assert session.frames["point_nest"] == session.frames["instrument_east"] == "cell"
    found = [
        (observation.seer, observation.seen, tuple(observation.robots))
        for observation in session.observations
    ]
    assert found == [
        ("instrument_east", "point_ball", ("b",)),
        ("instrument_east", "point_nest", ()),
        ("instrument_west", "point_nest", ()),
    ]


def test_rows_say_which_board_they_show_whose_file_comes_along(tmp_path):
    board = 'kind = "charuco"\ncolumns = 5\nrows = 7\nsquare_m = 0.04\nmarker_m = 0.03\n'
    (tmp_path / "floor.toml").write_text(f'{board}dictionary = "DICT_5X5_100"\n')
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / "session.toml").write_text(
        'schema = 1\nname = "cell"\nmount = "eye-in-hand"\n[camera]\nresolution = [1280, 800]\n'
        '[targets]\nwall = "checkerboard_9x6_25mm"\n[targets.floor]\ntarget = "../floor.toml"\n'
    )
    (folder / "views.csv").write_text(
        "view,stop,target,image,x_m,y_m,z_m,qx,qy,qz,qw\n"
        f"0,0,floor,a.png,{POSE}\n1,0,wall,a.png,{POSE}\n2,1,wall,b.png,{POSE}\n"
    )
    for name in ("a.png", "b.png"):
        (folder / name).write_bytes(b"\x89PNG " + name.encode())
    session = Session.load(folder)
    kinds = {name: board.kind for name, board in session.boards.items()}
    assert kinds == {"wall": "checkerboard", "floor": "charuco"}
    assert [session.board_of(view) for view in session.views] == ["floor", "wall", "wall"]
    # Two rows of one image that show two boards are no mistake.
    (said,) = session.notes
    assert not session.warnings
    assert "'../floor.toml' lies outside of the session's folder" in said
    session.save(tmp_path / "far" / "copy")
    assert (tmp_path / "far" / "copy" / "target_floor.toml").is_file()
    assert Session.load(tmp_path / "far" / "copy").digest() == session.digest()


def test_rows_without_a_robot_are_named_before_frames_that_hang_on_nothing(tmp_path):
    (tmp_path / "session.toml").write_text(
        'schema = 1\nname = "s"\nmount = "eye-in-hand"\ntarget = "charuco_9x6_30mm"\n'
        "[camera]\nresolution = [1280, 800]\n"
    )
    (tmp_path / "views.csv").write_text("view\n0\n1\n")
    (tmp_path / "corners.csv").write_text("view,point,u_px,v_px\n0,0,10,10\n1,0,20,20\n")
    with pytest.raises(DataError, match="no row says where the robot is") as caught:
        _ = Session.load(tmp_path).frames
    assert "x_m, y_m, z_m, qx, qy, qz, qw" in caught.value.next_step


def test_boards_on_either_side_of_one_camera_are_one_cell(tmp_path):
    (tmp_path / "session.toml").write_text(
        'schema = 1\nname = "one arm"\n[camera]\n[robot]\nmodel = "ur5e"\n[targets]\n'
        'floor = "charuco_9x6_30mm"\nplate = "checkerboard_9x6_25mm"\n'
        '[frames]\ncam = "cell"\ntarget_plate = "flange"\ntarget_floor = "cell"\n'
    )
    (tmp_path / "views.csv").write_text(
        f"view,target,image,x_m,y_m,z_m,qx,qy,qz,qw\n0,floor,a.png,{POSE}\n1,plate,b.png,{POSE}\n"
    )
    session = Session.load(tmp_path)
    assert session.mount == "eye-to-hand"
    with pytest.raises(
        DataError, match="and target_floor on cell; this takes boards on the flange"
    ):
        check_one_of_each(session)
