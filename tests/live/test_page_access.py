"""Who may ask the page for what: hostile names, other sites, other machines, broken requests."""

import ast
import json
import shutil
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browser import CHROMIUM
from support.commands import visioncal as command
from support.page import opened, served

from visioncal import Session

pytest.importorskip("nicegui")
pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
PAGE = Path(__file__).parents[2] / "visioncal" / "live" / "page"
TARGETS = PAGE.parents[2] / "targets"
FIELDS = (
    *("Where the camera is", "Its poses: typed, or by address", "The pendant's form of poses"),
    *("Robot's model, where it is known", "Board (a name, or its .toml)"),
)
# Each would run as an attribute, an element, a template of Vue, a template of JavaScript, a string.
HOSTILE = (
    'x" :label="(()=>{alert(1);return 1})()',
    "x' :hint='(()=>{alert(2);return 1})()",
    "<img src=x onerror=alert(3)>",
    "{{constructor.constructor('alert(4)')()}}",
    "`${alert(5)}`",
    "');alert(6);('",
    "<svg onload=alert(7)>&lt;script&gt;",
    "![x](http://127.0.0.1:9) [y](javascript:alert(8))".replace("/", "\N{FRACTION SLASH}"),
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Path:
    """A session with pictures, and its result."""
    folder = tmp_path_factory.mktemp("access")
    command("simulate", folder / "seen", "--views", 8, "--with-intrinsics", "--seed", 4)
    command("calibrate", folder / "seen", "-o", folder / "result")
    return folder


def choose(page, label: str, words: str) -> None:
    field = page.get_by_label(label, exact=True)
    field.click()
    field.fill(words)
    field.press("Enter")


@pytest.mark.parametrize("names", [HOSTILE[:1], HOSTILE], ids=["one", "all"])
def test_no_name_of_a_check_runs_in_the_browser(names, cell, tmp_path, browser):
    results, checks = tmp_path / "results", tmp_path / HOSTILE[0]
    for name in names:
        shutil.copytree(cell / "result", results / name)
        verified = checks / f"{name}-verified"
        verified.mkdir(parents=True)
        said = {"passed": False, "sentences": [f"said {name}"]}
        (verified / "verify.json").write_text(json.dumps(said))
    with served("verify", checks, "--against", results) as (url, _), opened(browser, url) as page:
        page.get_by_text(f"Check {checks.name}").wait_for()
        for name in names:
            page.get_by_text(f"{name}: said {name}").wait_for()
        hint = page.get_by_text(", ".join(str(results / name) for name in sorted(names)))
        page.get_by_label("Cell", exact=True).focus()
        hint.wait_for()
        page.get_by_role("button", name="Start").click()
        page.get_by_role("alert").get_by_text("camera").first.wait_for()
        for name in names:
            for label in ("Cell", "Camera", "The pendant's form of poses"):
                choose(page, label, name)
            page.get_by_role("button", name="Start").click()
            page.get_by_role("alert").get_by_text(name[:20]).first.wait_for()


def test_no_name_of_a_recording_runs_in_the_browser(cell, tmp_path, browser):
    pictures, views = tmp_path / HOSTILE[2], Session.load(cell / "seen").views
    pictures.mkdir()
    for number, view in enumerate(views):
        shutil.copy(cell / "seen" / view.image, pictures / f"{number}{HOSTILE[number]}.png")
    board = tmp_path / f"{HOSTILE[0]}.toml"
    shutil.copy(TARGETS / "charuco_9x6_30mm.toml", board)
    recording = served("record", "-o", tmp_path / HOSTILE[6])
    with recording as (url, _), opened(browser, url) as page:
        page.get_by_text(f"Record {HOSTILE[6]}").wait_for()
        for name in HOSTILE:
            for label in (*FIELDS, "Camera"):
                choose(page, label, name)
            page.get_by_role("button", name="Start").click()
            page.get_by_role("alert").get_by_text(name[:20]).first.wait_for()
        for label, words in zip(FIELDS, ("eye-in-hand", "manual", "", "", str(board)), strict=True):
            choose(page, label, words)
        choose(page, "Camera", f"folder:{pictures}")
        page.get_by_role("button", name="Start").click()
        field = page.get_by_label("Pose of the flange")
        for name in HOSTILE:
            field.fill(name)
            page.get_by_text(name[:20]).first.wait_for()
        for place, view in enumerate(views, 1):
            matrix = np.asarray(view.base_from_flange().as_matrix())
            angles = Rotation.from_matrix(matrix[:3, :3]).as_euler("ZYX", degrees=True)
            numbers = zip("XYZABC", [*(1e3 * matrix[:3, 3]), *angles], strict=True)
            field.fill(" ".join(f"{name} {value:.5f}" for name, value in numbers))
            field.press("Enter")
            page.get_by_role("row", name=f"view {place}", exact=True).wait_for()
        page.get_by_role("button", name="Calibrate").click()
        page.get_by_text(f"{HOSTILE[6]}-result").wait_for()
        with page.expect_popup() as report:
            page.get_by_role("link", name="Open the report").click()
        report.value.get_by_text(HOSTILE[6]).first.wait_for()


def faults_in(code: str):
    """Places of a module of the page where a text could become code."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            words = [*node.args, *(word.value for word in node.keywords)]
            is_constant = all(isinstance(word, ast.Constant) for word in words)
            # What these get is parsed, or run.
            if name in {"props", "add_slot", "run_javascript"} and not is_constant:
                yield ast.unparse(node)
            if name in {"markdown", "add_head_html", "add_body_html", "add_css", "Html"}:
                yield ast.unparse(node)
            given = {word.arg: word.value for word in node.keywords}
            handler = given.get("js_handler", ast.Constant(""))
            if "sanitize" in given or not isinstance(handler, ast.Constant):
                yield ast.unparse(node)
        # A name with a colon in front would have its value run.
        if isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("props"):
            key = node.slice.value if isinstance(node.slice, ast.Constant) else ":"
            if key.startswith(":"):
                yield ast.unparse(node)
        if isinstance(node, ast.Constant) and "v-html" in str(node.value):
            yield ast.unparse(node)


def test_no_text_becomes_code_of_the_page():
    for path in PAGE.glob("*.py"):
        assert not [*faults_in(path.read_text("utf-8"))], path


@pytest.mark.parametrize(
    "code",
    [
        "field.props(f'hint={words}')",
        "field.props('hint=' + words)",
        "field.props(add=words)",
        "ui.html(words, sanitize=False)",
        "ui.markdown(words)",
        "table.add_slot('body', words)",
        "ui.run_javascript(words)",
        "field.on('click', js_handler=words)",
        "field.props[words] = 1",
        "field._props[':label'] = words",
        "table.add_slot('body', '<td v-html=props.value>')",
    ],
)
def test_the_search_for_such_code_can_fail(code):
    assert len([*faults_in(code)]) == 1


def test_other_sites_are_refused(cell):
    with served("record", "-o", cell / "alone") as (url, _):
        for headers in ({"Origin": "http://elsewhere.example"}, {"Host": "elsewhere.example"}):
            asked = urllib.request.Request(f"{url}/live.jpg", headers=headers)
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(asked)
        own = urllib.request.Request(f"{url}/live.jpg", headers={"Origin": url})
        assert urllib.request.urlopen(own).status == 200
