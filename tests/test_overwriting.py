"""Files of others where results are written: none is replaced."""

import shlex
import shutil

import pytest
from support.commands import visioncal

THESIS = "<html>my thesis</html>"


@pytest.fixture
def session(tmp_path):
    visioncal("simulate", tmp_path / "cell", "--no-images", "--views", 6).good()
    return tmp_path / "cell"


@pytest.fixture
def result(session, tmp_path):
    visioncal("calibrate", session, "-o", tmp_path / "out", "--no-recording").good()
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("name", "content"),
    [("report.html", THESIS), ("calibration.json", '{"fx": 600}'), ("recording.rrd", "mine")],
)
def test_a_result_replaces_no_file_of_others(session, tmp_path, name, content):
    theirs = tmp_path / "project" / name
    theirs.parent.mkdir()
    theirs.write_text(content)
    words = ("calibrate", session, "-o", theirs.parent)
    visioncal(*words).refused(str(theirs), "not written by visioncal", "with -o")
    assert theirs.read_text() == content
    assert list(theirs.parent.iterdir()) == [theirs]
    # Nothing is lost with an empty one.
    theirs.write_text("")
    visioncal(*words).good()
    visioncal(*words).good()


@pytest.mark.parametrize("more", [(), ("--certificate",)])
def test_a_page_replaces_no_table_of_a_session(session, result, more):
    for file in (session / "views.csv", session / "session.toml"):
        content = file.read_text()
        visioncal("show", result, *more, "-o", file).refused(str(file), "not written by visioncal")
        assert file.read_text() == content
    page = result / "again.html"
    for _ in range(2):
        visioncal("show", result, *more, "-o", page).good()


def test_a_batch_replaces_no_page_of_others(session, tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    (site / "index.html").write_text(THESIS)
    visioncal("batch", session, "-o", site).refused("index.html", "not written by visioncal")
    assert (site / "index.html").read_text() == THESIS
    shutil.rmtree(site)
    for _ in range(2):
        visioncal("batch", session, "-o", site).good()


def test_a_plan_replaces_no_plan_of_others(tmp_path):
    plan = tmp_path / "plan.json"
    plan.write_text('{"mine": 1}')
    lines = visioncal("plan", "--example").good().out.splitlines()
    command = " ".join(line.rstrip("\\") for line in lines if not line.startswith("#"))
    words = [*shlex.split(command)[1:], "-o", tmp_path]
    visioncal(*words).refused("plan.json", "not written by visioncal")
    assert plan.read_text() == '{"mine": 1}'
