"""Sessions with several boards: what they declare, what is refused, and how they are stored."""

import pytest
from support.edited import changed

from visioncal.core.errors import DataError
from visioncal.session import Session

TOML = """schema = 1
name = "cell"
mount = "eye-in-hand"

[camera]
resolution = [1280, 800]

[targets]
wall = "checkerboard_9x6_25mm"

[targets.floor]
target = "boards/floor.toml"
"""
BOARD = """kind = "charuco"
columns = 5
rows = 7
square_m = 0.04
marker_m = 0.03
dictionary = "DICT_5X5_100"
"""
TABLE = """view,stop,target,image,x_m,y_m,z_m,qx,qy,qz,qw
0,0,floor,a.png,0.1,0.2,0.3,0,0,0,1
1,0,wall,a.png,0.1,0.2,0.3,0,0,0,1
2,1,wall,b.png,0.2,0.2,0.3,0,0,0,1
"""


@pytest.fixture
def folder(tmp_path):
    session = tmp_path / "cell"
    (session / "boards").mkdir(parents=True)
    (session / "session.toml").write_text(TOML)
    (session / "views.csv").write_text(TABLE)
    (session / "boards" / "floor.toml").write_text(BOARD)
    for name in ("a.png", "b.png"):
        (session / name).write_bytes(b"\x89PNG " + name.encode())
    return session


def test_rows_say_which_board_they_show(folder):
    session = Session.load(folder)
    assert {name: board.kind for name, board in session.boards.items()} == {
        "wall": "checkerboard",
        "floor": "charuco",
    }
    assert [session.board_of(view) for view in session.views] == ["floor", "wall", "wall"]
    # Two rows of one image that show two boards are no mistake.
    assert session.warnings == ()


def test_files_from_elsewhere_come_along(folder, tmp_path):
    (tmp_path / "floor.toml").write_text(BOARD)
    changed(folder, "session.toml", "boards/floor.toml", "../floor.toml")
    session = Session.load(folder)
    session.save(tmp_path / "far" / "copy")
    assert (tmp_path / "far" / "copy" / "target_floor.toml").is_file()
    assert Session.load(tmp_path / "far" / "copy").digest() == session.digest()


def test_one_board_with_a_name_is_one_board(folder):
    changed(folder, "session.toml", 'wall = "checkerboard_9x6_25mm"', "")
    changed(folder, "views.csv", "wall", "")
    session = Session.load(folder)
    assert session.target is not None
    assert session.boards == {"": session.target}
    assert session.board_of(session.views[0]) == ""


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("views.csv", "1,0,wall", "1,0,", r"must name the one that a row shows.* in view 1"),
        ("views.csv", "1,0,wall", "1,0,wal", r"view 1, column target: 'wal'.*\n?.*Did you mean"),
        ("session.toml", "[camera]", 'target = "a"\n[camera]', "targets is there beside target"),
        ("session.toml", "targets.floor", "targets.up-stairs", "other than letters"),
        ("session.toml", 'target = "boards', 'board = "boards', "targets.floor.target is missing"),
        ("session.toml", "boards/floor.toml", "charuco_9x6", "charuco_9x6"),
    ],
)
def test_what_does_not_fit_together_is_refused(folder, name, old, new, words):
    changed(folder, name, old, new)
    with pytest.raises(DataError, match=words) as caught:
        Session.load(folder)
    assert caught.value.culprits


def test_names_without_a_declaration_say_what_to_declare(folder):
    text = (folder / "session.toml").read_text()
    (folder / "session.toml").write_text(
        text.partition("[targets]")[0].replace(
            "[camera]", 'target = "checkerboard_9x6_25mm"\n[camera]'
        )
    )
    with pytest.raises(DataError, match=r"names floor, wall.*\[targets.floor\], \[targets.wall\]"):
        Session.load(folder)


def test_a_board_that_no_row_names_is_told(folder):
    changed(folder, "views.csv", "0,0,floor", "0,0,wall")
    told = "session.toml: targets.floor: no row of views.csv names it."
    assert told in Session.load(folder).warnings
