"""Advice that is followed to its end: it runs, mends, and does not come again."""

import csv
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from PIL import Image
from scipy.spatial.transform import Rotation
from support.cells import pairs_session
from support.commands import Done, visioncal
from support.edited import rewritten
from support.following import follow
from support.fuzz.broken_sessions import BROKEN, SMALL, edit, sound_session
from support.marks import slow

from visioncal import Calibration, Session
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, cell_session, simulate

SIZE = "In session.toml, write resolution = [640, 480]."


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder that the commands are typed in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def program_of(*messages, status=2):
    """A program that says one message a run, and the last one from then on."""
    left = list(messages)

    def run(*_words):
        said = left.pop(0) if len(left) > 1 else left[0]
        return Done(status if said else 0, "", f"error: it is wrong.\n{said}\n")

    return run


@pytest.mark.parametrize(
    ("messages", "why"),
    [
        ((SIZE, "Look.", SIZE), None),
        ((SIZE, SIZE), "comes again"),
        (('In session.toml, write name = "cell".',), "so already"),
        (("In session.toml, delete matrix.",), "so already"),
        (("In the board's .toml, write columns = 8.",), "no file of the user's"),
        (("In views.csv, delete the rows of view 0, 1.",), "all rows"),
        (("visioncal nonsense",), "2 error: it is wrong"),
        (("visioncal calibrate SESSION -o out",), "a placeholder"),
        (tuple(f"In session.toml, write at = {at}." for at in range(1, 12)), "does not end"),
    ],
)
def test_a_step_that_cannot_be_followed_is_noticed(place, messages, why):
    cell = place / "cell"
    cell.mkdir()
    (cell / "session.toml").write_text('name = "cell"\ntarget = "charuco_9x6_30mm"\n')
    (cell / "views.csv").write_text("view\n0\n1\n")
    if why is None:
        followed = follow("calibrate", "cell", run=program_of(*messages))
        assert len(followed.done) == 1
        assert "[camera]\nresolution = [" in (cell / "session.toml").read_text()
    else:
        with pytest.raises(AssertionError, match=why):
            follow("calibrate", "cell", run=program_of(*messages))


def resized(folder: Path, every: int, size: tuple[int, int]) -> None:
    """One image of so many is of another size, as after a change of the camera's mode."""
    for path in sorted((folder / "images").iterdir())[::every]:
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), size))


def of_three_sizes(folder: Path) -> None:
    resized(folder, 2, (640, 400))
    resized(folder, 4, (960, 600))


def turned_for_viewers(folder: Path, every: int) -> None:
    """Pictures of a telephone, which turns some of them and says so in their EXIF data."""
    tag = Image.Exif()
    tag[0x0112] = 6
    for at, path in enumerate(sorted((folder / "images").iterdir())):
        image = Image.open(path)
        image = image.rotate(90, expand=True) if at % every == 0 else image
        image.save(path.with_suffix(".jpg"), quality=97, **{"exif": tag} if at % every == 0 else {})
        path.unlink()
    edit(folder, lambda text: text.replace(".png", ".jpg"), "views.csv")


def as_axis(_: int, row: dict[str, str], *, whole: bool = False) -> dict[str, str]:
    """A row whose quaternion is an axis and an angle, or the product of both."""
    turn = Rotation.from_quat([float(row[name]) for name in POSE[3:]]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    axis = turn if whole else turn / angle
    return row | dict(zip(POSE[3:], map(str, [*axis.tolist(), angle]), strict=True))


def without_a_lens(folder: Path) -> None:
    document = tomllib.loads((folder / "session.toml").read_text("utf-8"))
    del document["camera"]["matrix"], document["camera"]["distortion"]
    (folder / "session.toml").write_text(tomli_w.dumps(document), "utf-8")


PLANTED = {
    "half of another size": lambda it: resized(it, 2, (640, 400)),
    "three sizes": of_three_sizes,
    "half of another size, no lens": lambda it: (without_a_lens(it), resized(it, 2, (640, 400))),
    "all turned": lambda it: turned_for_viewers(it, 1),
    "half turned": lambda it: turned_for_viewers(it, 2),
    "all of another size, no lens": lambda it: (without_a_lens(it), resized(it, 1, (640, 400))),
}


def of_few_views(folder: Path) -> Path:
    """The session without its last rows."""
    edit(folder, lambda text: "".join(text.splitlines(keepends=True)[:12]), "views.csv")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTED)
@pytest.mark.parametrize("words", ["calibrate cell -o out", "doctor cell"])
def test_pictures_of_several_sizes_are_no_circle(place, name, words):
    PLANTED[name](of_few_views(sound_session(place / "cell")))
    assert follow(*words.split()).last.status == 0


@pytest.mark.slow
def test_a_board_of_markers_where_another_kind_is_declared_is_followed_to_a_result(place):
    sound = of_few_views(sound_session(place / "cell"))
    (sound / "board.toml").write_text(
        'kind = "marker"\nid = 3\nsize_m = 0.1\ndictionary = "DICT_6X6_250"\n'
    )
    edit(sound, lambda text: text.replace('"charuco_9x6_30mm"', '"board.toml"'))
    followed = follow("calibrate", "cell", "-o", "out")
    # The size is a person's to measure: it was not.
    assert "ChArUco board of 9 x 6 squares" in followed.runs[0].refused().said
    assert "seen.toml" in (sound / "session.toml").read_text("utf-8")


@pytest.mark.parametrize("seen", [slow("corners"), "poses"])
def test_a_board_of_another_size_is_scaled_in_a_copy(place, seen):
    cell = simulate(CellOptions(views=20, seed=3, board_scale=1.01, pixel_sigma_px=0.05))
    if seen == "corners":
        cell_session(cell, "cell", seen=seen).save(place / "cell")
    else:
        # As a program measures them that goes by the stated size.
        poses = cell.cam_from_target.copy()
        poses[:, :3, 3] /= 1.01
        pairs_session("eye-in-hand", cell.robot.base_from_flange, poses).save(place / "cell")
    followed = follow("calibrate", "cell", "-o", "out")
    assert "--board-scale" in followed.done[0]
    assert followed.last.good().said.startswith("good")
    found = Calibration.load(place / "out/calibration.json").transforms["flange_from_cam"]
    away = found.as_matrix() - cell.transforms["flange_from_cam"]
    # 1 % of the distance would be 4 mm.
    assert np.linalg.norm(away[:3, 3]) < 3e-4


def test_one_of_several_boards_is_scaled_by_its_name(place):
    session = cell_session(simulate(CellOptions(views=6)), "cell", seen="corners")
    document = {**session.document, "targets": {"left": {"target": "charuco_9x6_30mm"}}}
    document["targets"]["right"] = "aprilgrid_6x4_32mm"
    del document["target"]
    row = [[*(view.cell(at) for at in session.columns), "left"] for view in session.views]
    two = session.with_content(
        document=document,
        columns=(*session.columns, "target"),
        cells=row,
        target_document=None,
    )
    two.save(place / "cell")
    refused = visioncal("convert", "cell", "copy", "--board-scale", "1.01").refused().said
    assert "Name one of right, left" in refused
    session.save(place / "one")
    refused = visioncal("convert", "one", "copy", "--board-scale", "left:1.01").refused().said
    assert "Give the factor alone, as 1.01." in refused
    visioncal("convert", "cell", "copy", "--board-scale", "right:1.01").good()
    boards = Session.load(place / "copy").boards
    sizes = [boards[name].square_m for name in ("left", "right")]
    assert sizes == pytest.approx([0.03, 1.01 * 0.032])


def test_a_size_by_poses_is_known_no_better_than_the_poses(place):
    options = CellOptions(views=16, seed=3, board_scale=0.6, pixel_sigma_px=0.05)
    cell_session(simulate(options), "cell", seen="corners").save(place / "cell")
    guessed = visioncal("convert", "cell", "guessed", "--guess", "--yes")
    assert "times as large" in guessed.good().said
    board = tomllib.loads((place / "guessed/target.toml").read_text("utf-8"))
    # Of 16 poses of an arm that repeats to 0.1 mm.
    assert board["square_m"] == pytest.approx(0.018, rel=0.003)
    assert board["square_sigma_m"] == pytest.approx(0.01 * board["square_m"])


@pytest.mark.parametrize("mistake", [slow("images named .jpg"), "images in another folder"])
def test_images_that_are_elsewhere_are_found(place, mistake):
    BROKEN[mistake].plant(sound_session(place / "cell", SMALL))
    followed = follow("calibrate", "cell", "-o", "out")
    assert [run.status for run in followed.runs] == [2, 0]


def test_mirrored_images_are_named_and_mirrored_back(place):
    BROKEN["mirrored images"].plant(of_few_views(sound_session(place / "cell", SMALL)))
    followed = follow("calibrate", "cell", "-o", "out")
    assert "The images are mirrored" in followed.runs[0].refused().said
    assert followed.last.good().said.startswith("good")


def text(old: str, new: str, name: str = "session.toml"):
    """Replaces a text of a session's file."""
    return lambda folder: edit(folder, lambda before: before.replace(old, new), name)


def cells(change):
    """Changes each row of views.csv, given its number."""
    return lambda folder: rewritten(folder, change)


def logged(*, header=True, units=False, separator=",", image=True, rows=15):
    """Writes poses beside a session as a table of somebody else's."""

    def planted(folder: Path) -> None:
        with (folder / "views.csv").open(newline="", encoding="utf-8") as file:
            read = [*csv.DictReader(file)][:rows]
        lines = [["image", "x", "y", "z", "qx", "qy", "qz", "qw"]] * header
        lines += [["", "m", "m", "m", "", "", "", ""]] * units
        lines += [[row["image"][7:], *(row[name] for name in POSE)] for row in read]
        if separator == ";":
            lines = [
                [cell.replace(".", ",").replace(",png", ".png") for cell in it] for it in lines
            ]
        table = "\n".join(separator.join(line[not image :]) for line in lines)
        (folder.parent / "log.csv").write_text(f"{table}\n", "utf-8")

    return planted


def as_windows_has_it(folder: Path) -> None:
    for name in ("session.toml", "views.csv"):
        data = (folder / name).read_bytes().replace(b"\n", b"\r\n")
        (folder / name).write_bytes(b"\xef\xbb\xbf" + data)


def half_copied(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir())[8:]:
        path.unlink()


def nothing(_folder: Path) -> None:
    pass


def calibrate(path: str) -> tuple[str, ...]:
    return "calibrate", path, "-o", "out"


FOCAL, CELL = "    457.1,\n    456.8,", calibrate("cell")
MATRIX = f"matrix = [\n{FOCAL}\n    322.65,\n    198.4,\n]"
CONVERT = ("convert", "log.csv", "new", "--images", "cell/images", "--mount", "eye-in-hand")
CONVERT += ("--target", "charuco_9x6_30mm")
# What somebody did wrong, the command, and how it ends: with that status and those words.
DONE_WRONG = {
    "a typing error in the path": (nothing, calibrate("cel"), 0, "good"),
    "a table for the session": (nothing, calibrate("cell/views.csv"), 0, "good"),
    "the folder of the images": (nothing, calibrate("cell/images"), 0, "good"),
    "the folder above": (nothing, calibrate("."), 0, "good"),
    "no session.toml": (
        lambda it: (it / "session.toml").unlink(), CELL, 0, "wrote cell-session",
    ),
    "no views.csv": (lambda it: (it / "views.csv").unlink(), CELL, 2, "views.csv does not exist"),
    "no images": (lambda it: shutil.rmtree(it / "images"), CELL, 2, "Copy them there"),
    "half of the images": (half_copied, CELL, 0, "Only 8 views"),
    "a table that is cut": (
        lambda it: edit(it, lambda was: was[:-40], "views.csv"), CELL, 0, "good",
    ),
    "centimetres": (
        cells(lambda _, row: row | {name: str(100 * float(row[name])) for name in POSE[:3]}),
        CELL, 0, "good",
    ),
    "one decimal comma": (
        cells(lambda at, row: row | {"x_m": row["x_m"].replace(".", ",")} if at == 3 else row),
        CELL, 0, "good",
    ),
    "thousands or decimals": (
        cells(lambda at, row: row | {"x_m": "0.5" if at else "1,234"}), CELL, 2, "Write 1.234",
    ),
    "one number of a quaternion in thousandths": (
        cells(lambda _, row: row | {"qw": str(1000.0 * float(row["qw"]))}),
        CELL, 2, "Divide qw by 1000 in all rows",
    ),
    "quaternions in thousandths": (
        cells(lambda _, row: row | {q: str(1000.0 * float(row[q])) for q in POSE[3:]}),
        CELL, 2, "Divide qx, qy, qz, qw by 1000 in all rows",
    ),
    "an axis, and the angle about it": (cells(as_axis), CELL, 2, "empty column qw in all rows"),
    "a rotation vector, and nothing": (
        cells(lambda _, row: {**as_axis(0, row, whole=True), "qw": ""}), CELL, 0, "good",
    ),
    "names of a quaternion exchanged": (
        text("qx,qy,qz,qw", "qw,qx,qy,qz", "views.csv"), CELL, 0, "good",
    ),
    "columns exchanged": (
        cells(lambda _, row: row | {"x_m": row["y_m"], "y_m": row["x_m"]}), CELL, 0, "good",
    ),
    "Windows' line ends and marks": (as_windows_has_it, CELL, 0, "good"),
    "tabs": (text(",", "\t", "views.csv"), CELL, 0, "good"),
    "another board": (text("charuco_9x6_30mm", "charuco_7x5_36mm"), CELL, 0, "good"),
    "cv2's matrix": (
        text(MATRIX, "matrix = [[457.1, 0, 322.65], [0, 456.8, 198.4], [0, 0, 1]]"),
        CELL, 0, "good",
    ),
    "a comma in the matrix": (text("457.1", "457,1"), CELL, 2, "must be [fx, fy, cx, cy] [px]"),
    "a focal length in mm": (text(FOCAL, "3.6, 3.6,"), CELL, 2, "fx and fy are in pixels"),
    "a lens of twice the size": (text(FOCAL, "914.2, 913.6,"), CELL, 0, "good"),
    "images squeezed to another width": (
        lambda it: (resized(of_few_views(it), 1, (533, 400)), text("640", "533")(it)),
        CELL, 0, "good",
    ),
    "[cam] for [camera]": (text("[camera]", "[cam]"), CELL, 0, "good"),
    "a path as Windows writes it": (
        text("charuco_9x6_30mm", "C:\\Zelle\\b.toml"), CELL, 2, "paths with /",
    ),
    "images by their whole paths": (
        cells(lambda _, row: row | {"image": f"C:\\me\\{row['image']}"}),
        CELL, 2, "as images/000.png",
    ),
    "typographic quotes": (
        text('"eye-in-hand"', "\N{LEFT DOUBLE QUOTATION MARK}eye-in-hand"),
        CELL, 2, '"double quotes"',
    ),
    "Excel's semicolons": (logged(separator=";"), CONVERT, 0, "wrote new"),
    "no header": (logged(header=False), CONVERT, 0, "wrote new"),
    "a row of units": (logged(units=True), CONVERT, 0, "wrote new"),
    "one pose too few": (
        logged(image=False, rows=14), CONVERT, 0, "The images are taken from 000.png with log.csv",
    ),
    "a session for a result": (
        nothing, ("verify", "cell", "--against", "cell"), 2, "Run visioncal",
    ),
}  # fmt: skip
QUICK = (
    "a typing error",
    "no images",
    "no views",
    "no header",
    "a row",
    "a focal",
    "one pose",
    "a path",
)


@pytest.mark.parametrize(
    "name", [name if name.startswith(QUICK) else slow(name) for name in DONE_WRONG]
)
def test_a_user_s_mistake_ends_in_a_result_or_in_a_message(place, name):
    plant, words, status, said = DONE_WRONG[name]
    plant(sound_session(place / "cell", SMALL))
    followed = follow(*words)
    assert followed.last.status == status, followed.last.said
    assert said in followed.last.said
