"""The page in headless Chromium: a calibration by typed poses alone, and checks of it."""

import csv
import re
import shutil
import socket
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browser import CHROMIUM
from support.commands import visioncal as command
from support.page import choose, free_port, opened, served

import visioncal
from visioncal import Calibration, Session
from visioncal.vision.boards.imaging import read_image

pytest.importorskip("nicegui")
expect = pytest.importorskip("playwright.sync_api").expect
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
POSE = "Pose of the flange"


def kuka(pose, *, comma: bool = False) -> str:
    """A pose as a KUKA's pendant shows it, or as a German types it."""
    matrix = np.asarray(pose.as_matrix())
    angles = Rotation.from_matrix(matrix[:3, :3]).as_euler("ZYX", degrees=True)
    numbers = [*(1e3 * matrix[:3, 3]), *angles]
    line = " ".join(f"{name} {value:.5f}" for name, value in zip("XYZABC", numbers, strict=True))
    return line.replace(".", ",") if comma else line


def row(page, number: int):
    """The row of a view."""
    return page.get_by_role("row", name=f"view {number}", exact=True)


def typed(page, folder: Path, view, line: str, place: int) -> None:
    """Shows a view to the camera, and types its pose."""
    (folder / "shown").write_text(str(view.number))
    page.wait_for_timeout(500)
    field = page.get_by_label(POSE)
    field.fill(line)
    page.get_by_text("Read as KUKA").wait_for()
    field.press("Enter")
    field.press("Enter")
    row(page, place).wait_for()
    # Pressed twice, it is one view.
    assert row(page, place + 1).count() == 0


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Path:
    """A cell's images, and those of two later days: on the second the camera has moved."""
    folder = tmp_path_factory.mktemp("page")
    options = ["--robot", "generic-6r-1800", "--seed", "4"]
    for words in (
        ["seen", "--views", "10", "--with-intrinsics"],
        ["monday", "--views", "5", "--recording", "1"],
        ["tuesday", "--views", "5", "--recording", "2", "--camera-moved-mm", "1.5"],
    ):
        command("simulate", folder / words[0], *words[1:], *options)
        (folder / words[0] / "shown").write_text("0")
    return folder


@pytest.fixture(scope="module")
def calibrated(cell, browser) -> Path:
    """A calibration made by the page alone, through a reload, a lost camera and a kill."""
    seen, out = cell / "seen", cell / "cell"
    views = Session.load(seen).views
    with served("record", "-o", out) as (url, process), opened(browser, url) as page:
        choose(page, "Camera", "uvc")
        page.get_by_role("button", name="Start").click()
        page.get_by_role("alert").get_by_text("cannot be opened").wait_for()
        choose(page, "Camera", f"played:{seen}")
        page.get_by_role("button", name="Start").click()
        page.get_by_label(POSE).fill("{X 0.4, Y 0.02, Z 0.3, A 10, B 20, C 30}")
        page.get_by_text("In metres?").wait_for()
        page.get_by_label(POSE).fill("400 20 300 10 20 30")
        page.get_by_text("must have one form").wait_for()
        for place, view in enumerate(views[:4], 1):
            typed(page, seen, view, kuka(view.base_from_flange(), comma=place % 2 == 0), place)
        page.get_by_role("button", name="Undo last").click()
        row(page, 4).wait_for(state="detached")
        page.reload()
        row(page, 3).wait_for()
        with opened(browser, url) as second:
            typed(second, seen, views[3], kuka(views[3].base_from_flange()), 4)
        row(page, 4).wait_for()
        (seen / "shown").unlink()
        page.get_by_text("gives no picture").wait_for()
        (seen / "shown").write_text("4")
        page.get_by_role("button", name="Start").click()
        for place, view in enumerate(views[4:8], 5):
            typed(page, seen, view, kuka(view.base_from_flange()), place)
        process.kill()
    with served("record", "-o", out) as (url, _), opened(browser, url) as page:
        # What was chosen is still there.
        page.get_by_role("button", name="Start").click()
        row(page, 8).wait_for()
        for place, view in enumerate(views[8:], 9):
            typed(page, seen, view, kuka(view.base_from_flange()), place)
        page.get_by_text("good so far").wait_for()
        assert page.get_by_text("X ").count() > 0
        page.get_by_role("button", name="Calibrate").click()
        page.get_by_role("status").get_by_text("good", exact=True).wait_for()
    return cell / "cell-result"


def test_a_calibration_by_typed_poses_is_that_of_their_session(cell, calibrated):
    taken, seen = Session.load(cell / "cell"), Session.load(cell / "seen")
    for view, wanted in zip(taken.views, seen.views, strict=True):
        poses = [np.asarray(one.base_from_flange().as_matrix()) for one in (view, wanted)]
        # The typed numbers have 1e-5 mm and 1e-5 deg, at a reach of about 1 m.
        assert np.abs(poses[0] - poses[1]).max() < 1e-6
        assert np.array_equal(
            *(
                read_image(folder / one.image)
                for folder, one in ((cell / "cell", view), (cell / "seen", wanted))
            )
        )
    # What the button did is what the command does.
    result = Calibration.load(calibrated)
    assert result.session_sha256 == visioncal.calibrate(taken).session_sha256


def test_a_robots_own_program_is_watched_on_the_page(cell, browser):
    seen, port = cell / "seen", free_port()
    views = Session.load(seen).views
    devices = ("--arm", f"socket:{port}", "--camera", f"played:{seen}")
    what = ("--target", "charuco_9x6_30mm", "--views", len(views))
    served_so = served("record", "-o", cell / "sent", *devices, *what)
    with served_so as (url, _), opened(browser, url) as page:
        page.get_by_text("Waiting for the robot's own program").wait_for()
        assert not page.get_by_label(POSE).is_visible()
        with socket.create_connection(("127.0.0.1", port)) as robot, robot.makefile("r") as file:
            for at, view in enumerate(views, 1):
                (seen / "shown").write_text(str(view.number))
                robot.sendall(f"{at} | {kuka(view.base_from_flange())}\n".encode())
                assert file.readline().split()[0] == ("next" if at < len(views) else "done")
        page.get_by_role("status").get_by_text("good", exact=True).wait_for()
    assert len(Session.load(cell / "sent").views) == len(views)


@pytest.mark.usefixtures("calibrated")
def test_a_check_passes_and_fails_and_is_remembered(cell, browser):
    with served("verify", cell / "checks", "--against", cell) as (url, _):
        for day, answer in (("monday", "valid"), ("tuesday", "not valid")):
            with opened(browser, url) as page:
                choose(page, "Camera", f"played:{cell / day}")
                page.get_by_role("button", name="Start").click()
                # Where to stand, in the form of the last typed pose or the default.
                page.get_by_text("the board then fills the orange outline").wait_for()
                for place, view in enumerate(Session.load(cell / day).views, 1):
                    typed(page, cell / day, view, kuka(view.base_from_flange()), place)
                page.get_by_role("status").get_by_text(answer, exact=True).wait_for()
                report = page.get_by_role("link", name="Open the report")
                report.wait_for()
                page.get_by_role("button", name="Close").click()
                report.wait_for(state="detached")
                if day == "tuesday":
                    page.get_by_text("The camera moved by").first.wait_for()
                    lines = page.get_by_text(re.compile(r"^\d{4}-\d\d-\d\d-cell-result"))
                    history = lines.all_inner_texts()
    assert ["agree" in line for line in history] == [False, True]


def paired(folder: Path) -> tuple[list[list[str]], list[bytes]]:
    """The table of a session without its stamps, and its images in the order of the rows."""
    rows = [*csv.reader((folder / "views.csv").read_text().splitlines())]
    stamp, image = rows[0].index("stamp_s"), rows[0].index("image")
    images = [(folder / row[image]).read_bytes() for row in rows[1:]]
    return [row[:stamp] + row[stamp + 1 :] for row in rows], images


def pasted(page, *lines: str) -> None:
    """Types poses, and has them taken."""
    field = page.get_by_label(POSE)
    field.fill("\n".join(lines))
    page.get_by_text("Read as KUKA").wait_for()
    field.press("Enter")


def due(page, name: str) -> None:
    """Waits until a picture is that of the next pose."""
    expect(page.get_by_label("Picture of the next pose")).to_have_value(name)


def changed(page, number: int, action: str, line: str = "") -> None:
    """Does something with a row, and waits until it is done."""
    page.get_by_role("button", name=f"change view {number}", exact=True).click()
    dialog = page.get_by_role("dialog")
    if line:
        dialog.get_by_label("Its pose").fill(line)
    dialog.get_by_role("button", name=action).click()
    dialog.wait_for(state="hidden")


def test_a_folder_typed_with_mistakes_is_the_session_typed_without(cell, browser):
    views = Session.load(cell / "seen").views
    lines = [kuka(view.base_from_flange()) for view in views]
    typos = [line.replace("X ", "X 9") for line in lines]
    for name in ("clean", "inbox"):
        (cell / name).mkdir()
        for number, view in enumerate(views, 1):
            shutil.copy(cell / "seen" / view.image, cell / name / f"shot{number}.png")
    # Of the stop before, once more: it belongs to no pose.
    shutil.copy(cell / "inbox/shot3.png", cell / "inbox/shot3b.png")
    board = ("--target", "charuco_9x6_30mm", "--arm", "manual", "--camera")
    with (
        served("record", "-o", cell / "without", *board, f"folder:{cell / 'clean'}") as (url, _),
        opened(browser, url) as page,
    ):
        due(page, "shot1.png")
        pasted(page, *lines)
        row(page, 10).wait_for()
    words = ("record", "-o", cell / "with", *board, f"folder:{cell / 'inbox'}")
    with served(*words) as (url, process), opened(browser, url) as page:
        for number, line in enumerate((lines[0], typos[1], lines[2]), 1):
            due(page, f"shot{number}.png")
            pasted(page, line)
            row(page, number).wait_for()
        page.get_by_role("button", name="Undo last").click()
        due(page, "shot3.png")
        # What was typed is there again.
        expect(page.get_by_label(POSE)).to_have_value(lines[2])
        page.get_by_label(POSE).press("Enter")
        row(page, 3).wait_for()
        due(page, "shot3b.png")
        pasted(page, lines[0])
        page.get_by_role("alert").get_by_text("View 1 has this very pose").wait_for()
        due(page, "shot3b.png")
        pasted(page, lines[3])
        row(page, 4).wait_for()
        changed(page, 4, "Take again")
        page.get_by_role("button", name="Keep view 4").wait_for()
        due(page, "shot4.png")
        pasted(page, lines[3].replace("X ", "X  "))
        row(page, 4).get_by_text("shot4.png").wait_for()
        changed(page, 4, "Replace the pose", lines[3])
        due(page, "shot5.png")
        # Nothing is taken of what cannot be read.
        page.get_by_label(POSE).fill("X 1\nY 2")
        page.get_by_text("Line 2: ").wait_for()
        rest = [lines[4], typos[5], lines[6], typos[7], lines[9], lines[8]]
        page.get_by_label(POSE).fill("\n".join([*rest[:3], "X 1 Y 2", *rest[3:]]))
        page.get_by_text("Line 4: ").wait_for()
        page.get_by_label(POSE).press("Enter")
        pasted(page, *rest)
        row(page, 10).wait_for()
        page.get_by_role("button", name="Undo last").click()
        row(page, 10).wait_for(state="detached")
        page.reload()
        due(page, "shot10.png")
        pasted(page, lines[8])
        row(page, 10).wait_for()
        changed(page, 6, "Replace the pose", lines[5])
        process.kill()
    with served(*words) as (url, _), opened(browser, url) as page:
        page.get_by_text("no further picture is there").wait_for()
        assert page.get_by_role("row").count() == 10
        for number in (2, 8):
            changed(page, number, "Replace the pose", lines[number - 1])
        # The trial finds the last mistake, and offers its remedy.
        page.get_by_role("button", name="Exchange the poses of views 9 and 10").click()
        page.get_by_text("good so far").wait_for()
        page.get_by_text("of 10 views", exact=True).wait_for()
    for made, wanted in zip(*map(paired, (cell / "with", cell / "without")), strict=True):
        assert made == wanted
    recorded = tomllib.loads((cell / "with/recorded.toml").read_text())
    assert recorded["left_out"] == ["shot3b.png"]


def test_each_button_of_a_row_does_what_it_says(cell, browser, tmp_path):
    shutil.copytree(cell / "seen/images", tmp_path / "shots")
    lines = [kuka(view.base_from_flange()) for view in Session.load(cell / "seen").views[:4]]
    board = ("--target", "charuco_9x6_30mm", "--arm", "manual")
    words = ("record", "-o", tmp_path / "cell", *board, "--camera", f"folder:{tmp_path / 'shots'}")

    def rows() -> list[tuple[int, int]]:
        """Numbers of the picture and of the line of each view."""
        table = csv.DictReader((tmp_path / "cell/views.csv").read_text().splitlines())
        return [(int(line["picture"][:3]), lines.index(line["typed"])) for line in table]

    with served(*words) as (url, _), opened(browser, url) as page:
        due(page, "000.png")
        pasted(page, *lines)
        row(page, 4).wait_for()
        changed(page, 2, "This picture has no pose")
        row(page, 2).wait_for(state="detached")
        assert rows() == [(0, 0), (2, 1), (3, 2)]
        # The pose that lost its picture is there to be taken with another.
        expect(page.get_by_label(POSE)).to_have_value(lines[3])
        page.get_by_label(POSE).press("Enter")
        row(page, 5).wait_for()
        changed(page, 3, "This pose has no picture")
        row(page, 5).wait_for(state="detached")
        assert rows() == [(0, 0), (2, 2), (3, 3)]
        changed(page, 1, "Remove")
        row(page, 1).wait_for(state="detached")
        assert rows() == [(2, 2), (3, 3)]


def test_typed_lines_outlive_a_reload(cell, browser, tmp_path):
    shutil.copytree(cell / "seen/images", tmp_path / "shots")
    board = ("--target", "charuco_9x6_30mm", "--arm", "manual")
    words = ("record", "-o", tmp_path / "cell", *board, "--camera", f"folder:{tmp_path / 'shots'}")
    lines = [kuka(view.base_from_flange()) for view in Session.load(cell / "seen").views[:3]]
    with served(*words) as (url, _), opened(browser, url) as page:
        due(page, "000.png")
        field = page.get_by_label(POSE)
        half = "\n".join([*lines[:2], "X 12"])
        field.fill(half)
        page.get_by_text("Line 3: ").wait_for()
        page.reload()
        expect(field).to_have_value(half)
        field.fill("\n".join(lines))
        page.get_by_text("3 poses").wait_for()
        field.press("Enter")
        row(page, 3).wait_for()
        # Once taken, it does not come back.
        expect(field).to_have_value("")
        page.reload()
        row(page, 3).wait_for()
        page.wait_for_timeout(500)
        expect(field).to_have_value("")
