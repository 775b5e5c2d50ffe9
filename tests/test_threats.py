"""Attacks by what a person may have downloaded; .github/SECURITY.md has a row for each."""

import ast
import contextlib
import csv
import io
import json
import os
import re
import shlex
import shutil
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from unittest.mock import patch

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from support.commands import every_command, visioncal, write_poses
from support.fuzz.looks import write_looks
from support.fuzz.mutants import PACKAGED, READINGS, sound
from support.marks import slow

from visioncal.cli.app import main
from visioncal.core.choices import SITE_FILE
from visioncal.core.documents.tables import csv_text, is_number
from visioncal.core.documents.toml import parse_toml
from visioncal.core.errors import DataError
from visioncal.present.report.plotting import drawn
from visioncal.results import history
from visioncal.results.history import History
from visioncal.session import Session

PACKAGE = Path(__file__).parents[1] / "visioncal"
PAGE = Path(__file__).parents[1] / ".github" / "SECURITY.md"
# Modules that Python, its worker processes and the libraries of the house import.
PLANTED = (
    "json", "numpy", "multiprocessing", "typing", "random", "logging", "cv2", "rerun_cli",
    "pathlib", "scipy", "pickle", "visioncal", "sitecustomize", "usercustomize",
    "concurrent", "matplotlib",
)  # fmt: skip
TRAP = "import os\nopen(os.environ['VISIONCAL_CAUGHT'], 'a').write(__name__ + '\\n')\n"
# Commands that read no file: what each is called with, in a folder with planted modules.
NOT_READING = {
    "audit": "--help",
    "batch": "SESSION -o fleet --workers 2",
    "demo": "--help",
    "simulate": "cell --no-images",
    "record": "--help",
    "dynamics record": "--help",
    "dynamics plan": "ur10e -o out --seconds 1 --duration 10 --starts 1 --harmonics 3 --floor none "
    "--friction none --no-sweeps --rate 50",
}
QUICK = ("pairs", "pairs_out", "frames.json", *PACKAGED)


def calls():
    """Words for each command; those of sound inputs that take long to make ask for help."""
    for name, _ in every_command():
        reading = next((words for words in READINGS if words.startswith(f"{name} ")), "")
        inputs = re.findall(r"[\[{]([\w.]+)", reading)
        if name in NOT_READING:
            yield name, NOT_READING[name]
        elif all(each in QUICK for each in inputs):
            yield name, reading.removeprefix(f"{name} ")
        else:
            yield name, "--help"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    for name in {"pairs", "pairs_out", "frames.json"} | PACKAGED.keys():
        sound(folder, name)
    return folder


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A current folder with planted modules; what they were imported as is in the returned file."""
    caught, folder = tmp_path / "caught", tmp_path / "downloaded"
    folder.mkdir()
    for name in PLANTED:
        (folder / f"{name}.py").write_text(TRAP, "utf-8")
    caught.touch()
    monkeypatch.setenv("VISIONCAL_CAUGHT", str(caught))
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.chdir(folder)
    return caught


@pytest.fixture(scope="session")
def program(tmp_path_factory):
    """The installed command, as pip writes it."""
    path = tmp_path_factory.mktemp("bin") / "visioncal"
    path.write_text(
        "import sys\nfrom visioncal.cli import main\nif __name__ == '__main__':\n"
        "    sys.exit(main())\n",
        "utf-8",
    )
    return [sys.executable, str(path)]


def test_each_row_of_the_threat_model_has_its_test():
    rows = re.findall(r"^\| (?!what |---)(.*) \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    assert len(rows) > 5
    for row in rows:
        tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row.rpartition("|")[2])
        assert tests, row
        for file, test in tests:
            assert f"def {test}(" in (PAGE.parents[1] / file).read_text("utf-8"), test


def test_the_trap_is_sprung_by_what_imports_from_the_current_folder(trap):
    subprocess.run([sys.executable, "-c", "import json"], check=True)
    assert "json" in trap.read_text("utf-8")


# All in one process, whose path of imports no command changes: a module of the current folder would
# be imported by the first that needs it.
EACH = """
import json, os, sys
from visioncal.cli import main
if __name__ == "__main__":
    before = [*sys.path]
    for folder, *words in json.loads(sys.argv[1]):
        os.chdir(folder)
        sys.argv[1:] = words
        try:
            main()
        except SystemExit as stop:
            assert not stop.code, words
        assert sys.path == before, words
"""


@pytest.mark.slow
def test_no_command_runs_code_of_the_current_folder(trap, inputs, tmp_path):
    typed, program = list[list[str]](), tmp_path / "bin/visioncal"
    program.parent.mkdir()
    shutil.copytree(inputs / "pairs", "session")
    shutil.copytree(inputs / "pairs_out", "out")
    for at, (name, called) in enumerate(calls()):
        words = re.sub(r"[\[{]([\w./]+)[\]}]", lambda found: str(inputs / found[1]), called)
        words = words.replace("SESSION", "session").replace("OUT", "out").replace("NEW", "new")
        folder = shutil.copytree(Path.cwd(), tmp_path / f"{at}")
        typed.append([str(folder), *name.split(), *shlex.split(words)])
    program.write_text(EACH, "utf-8")
    done = subprocess.run(
        [sys.executable, str(program), json.dumps(typed)], capture_output=True, text=True,
        check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert trap.read_text("utf-8") == ""


@pytest.mark.slow
def test_processes_of_the_page_and_of_the_simulated_cell_run_no_foreign_code(trap, tmp_path):
    # From a script elsewhere, so that the current folder is not on the path of this process.
    script = tmp_path / "script.py"
    script.write_text(
        "from visioncal.live.page.outcome import ask_command\n"
        "from visioncal.live.simulated.controller import spawn\n"
        "if __name__ == '__main__':\n"
        "    print(ask_command(['calibrate', 'nothing'], None, ()).title)\n"
        "    spawn().close()\n",
        "utf-8",
    )
    subprocess.run([sys.executable, str(script)], check=True)
    assert trap.read_text("utf-8") == ""


def test_every_process_of_python_starts_with_a_safe_path():
    starts = 0
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text("utf-8")
        # To parse all of them takes seconds.
        for node in ast.walk(ast.parse(text if "sys.executable" in text else "")):
            if isinstance(node, ast.List) and ast.unparse(node).startswith("[sys.executable"):
                assert ast.unparse(node).startswith("[sys.executable, '-P', "), path
                starts += 1
        if re.search(r"get_context\(|ProcessPoolExecutor\(", text):
            assert "with safe_path():" in text, path
            starts += 1
    assert starts >= 4


def test_settings_of_matplotlib_in_the_current_folder_change_no_figure():
    # As `matplotlibrc` of the current folder sets them when matplotlib is imported.
    hostile = {"text.usetex": True, "text.latex.preamble": r"\input{/etc/passwd}", "font.size": 40}

    @drawn
    def figure():
        figure = Figure()
        figure.add_subplot().set_title("a title")
        return figure, "a figure"

    plain = figure()
    with mpl.rc_context(hostile):
        assert figure() == plain
        assert mpl.rcParams["text.usetex"]


VIEW = (
    "CREATE VIEW entry AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, i AS at, 'x' AS cell, 'calibrated' AS kind, i AS sha256, '{}' AS document "
    "FROM n"
)
TRIGGER = "CREATE TRIGGER more AFTER INSERT ON entry BEGIN DELETE FROM entry; END"


def planted_history(path, hostile):
    History(path).append()
    with closing(sqlite3.connect(path)) as file:
        if hostile is VIEW:
            file.execute("DROP TABLE entry")
        file.execute(hostile)
        file.commit()
    return path


@pytest.mark.parametrize("hostile", [slow(VIEW), TRIGGER, slow("CREATE TABLE more (x)")])
def test_a_history_with_code_in_it_is_refused_before_it_is_read(hostile, tmp_path, inputs):
    path = planted_history(tmp_path / SITE_FILE, hostile)
    visioncal("history", path).refused("other tables, views or triggers")
    out = tmp_path / "out"
    done = visioncal("calibrate", inputs / "pairs", "-o", out, "--history", path, "--no-report")
    assert "This is not in the history" in done.err
    assert (out / "calibration.json").is_file()


def test_a_history_that_came_with_a_session_is_not_adopted(tmp_path, inputs):
    session = tmp_path / "site" / "session"
    shutil.copytree(inputs / "pairs", session)
    (session / "deeper").mkdir()
    for folder in (session, session / "deeper"):
        planted_history(folder / SITE_FILE, VIEW)
    assert History.of_site(session) is History.of_site(session / "deeper") is None
    History(session.parent / SITE_FILE).append()
    assert History.of_site(session) == History(session.parent / SITE_FILE)


def plant_journal(database, victim):
    """A journal of a transaction over several databases: SQLite deletes the file that it names."""
    magic, name = bytes.fromhex("d9d505f920a163d7"), str(victim).encode()
    page = int.from_bytes(database.read_bytes()[16:18], "big")
    head = magic + struct.pack(">5I", 0, 1, database.stat().st_size // page, 512, page)
    end = struct.pack(">I", 0x40000000 // page + 1) + name
    end += struct.pack(">2I", len(name), sum(name)) + magic
    Path(f"{database}-journal").write_bytes(head.ljust(512, b"\0") + end)


def test_a_journal_beside_a_database_deletes_no_file(tmp_path, inputs):
    victim, history, bag = tmp_path / "precious.txt", tmp_path / SITE_FILE, tmp_path / "bag"
    victim.write_text("mine")
    History(history).append()
    plant_journal(history, victim)
    (tmp_path / "link.db").symlink_to(history)
    for path in (history, tmp_path / "link.db"):
        visioncal("history", path).refused(f"{history}-journal", "SQLite would delete")
    done = visioncal("calibrate", inputs / "pairs", "-o", tmp_path / "out", "--history", history)
    assert "This is not in the history" in done.err
    bag.mkdir()
    shutil.copy(history, bag / "bag_0.db3")
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    plant_journal(bag / "bag_0.db3", victim)
    visioncal("convert", bag, tmp_path / "new").refused("bag_0.db3-journal", "SQLite would delete")
    assert victim.read_text() == "mine"
    # What a process that was killed leaves is undone as ever.
    Path(f"{history}-journal").write_bytes(Path(f"{history}-journal").read_bytes()[:512])
    visioncal("history", history).good()


def test_reading_a_history_has_an_end(tmp_path, monkeypatch):
    History(tmp_path / SITE_FILE).append()
    with closing(sqlite3.connect(tmp_path / SITE_FILE)) as file:
        file.execute(
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 200000) "
            "INSERT INTO entry SELECT i, i, 'x', 'calibrated', i, '{}' FROM n"
        )
        file.commit()
    monkeypatch.setattr(history, "_MOST_ROUNDS", 1)
    visioncal("history", tmp_path / SITE_FILE).refused("takes without end to read")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_in_another_encoding_are_refused_or_read(tmp_path, inputs, rendered):
    other = os.fsdecode(b"b\xe4r")
    shutil.copytree(inputs / "pairs", tmp_path / other)
    for words in (f"calibrate {other} -o out", "batch * -o out", f"calibrate pairs -o {other}"):
        with contextlib.chdir(tmp_path):
            visioncal(*words.split()).refused("no UTF-8")
    with contextlib.chdir(tmp_path / other):
        visioncal("doctor", ".").refused("no UTF-8")
    # An archive's pictures of another system: the names are read as they were meant.
    shots = tmp_path / "shots"
    shots.mkdir()
    session = Session.load(rendered)
    for number in range(3):
        shutil.copy(rendered / session.views[number].image, shots / f"{other}{number}.png")
    poses = np.array([view.base_from_flange().as_matrix() for view in session.views[:3]])
    table = write_poses(tmp_path / "log.csv", poses)
    words = ["--images", shots, "--target", "charuco_9x6_30mm", "--mount", "eye-in-hand"]
    visioncal("convert", table, tmp_path / "new", *words).good()
    assert [view.image for view in Session.load(tmp_path / "new").views] == [
        f"images/bär{number}.png" for number in range(3)
    ]


@pytest.mark.parametrize("part", ["a", '"a b"', "'x.y'"])
@pytest.mark.parametrize("form", ["{} = 1", "[{}]", "x = {{ {} = 1 }}"])
def test_deep_keys_are_refused_before_they_are_parsed(part, form):
    with pytest.raises(DataError, match="nested deeper"):
        parse_toml(form.format(" . ".join([part] * 200_000)), "session.toml")
    assert parse_toml("x = '" + "a" * 500_000 + "'", "session.toml")


def test_no_table_for_other_programs_carries_formulas(tmp_path, inputs):
    hostile = "=cmd|' /C calc'!A0"
    result = json.loads((inputs / "pairs_out" / "calibration.json").read_text("utf-8"))
    result["session"]["name"] = hostile
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "calibration.json").write_text(json.dumps(result), "utf-8")
    visioncal("history", tmp_path / "h.db", "--add", tmp_path / "out").good()
    visioncal("history", tmp_path / "h.db", "-o", tmp_path / "h.csv").good()
    rows = [*csv.DictReader((tmp_path / "h.csv").read_text("utf-8").splitlines())]
    assert rows[0]["cell"] == f"'{hostile}"
    assert is_number(rows[0]["views"])
    assert csv_text([["@SUM(1)", "-1.5e-3", "+1", "-x", "ok"]], inert=True) == (
        "'@SUM(1),-1.5e-3,+1,'-x,ok\n"
    )


@pytest.mark.slow
def test_a_calibration_by_a_tracker_cannot_be_recovered_by_a_camera(tmp_path):
    visioncal("simulate", tmp_path / "s", "--instrument", "points").good()
    visioncal("calibrate", tmp_path / "s", "-o", tmp_path / "out", "--no-report").good()
    done = visioncal("recover", tmp_path / "act", "--against", tmp_path / "out")
    done.refused("was measured by an instrument", "visioncal calibrate")


def called(program, words, said, **more):
    """Runs a command as a process of its own, with bytes on its stdin; None closes it."""
    close = {"preexec_fn": lambda: os.close(0)} if said is None else {"input": said}
    return subprocess.run([*program, *map(str, words)], capture_output=True, check=False, **close,
                          **more)  # fmt: skip


@pytest.mark.skipif(sys.platform == "win32", reason="stdin is closed as on POSIX")
def test_bad_lines_on_stdin_are_refused_one_by_one(program, inputs, tmp_path):
    words = ["guard", "--against", inputs / "pairs_out"]
    write_looks(tmp_path / "looks", inputs / "pairs")
    sound_look = (tmp_path / "looks").read_bytes().split(b"\n")[0]
    # A guard goes on after a line that is no text.
    done = called(program, words, b'\xff\xfe\n{"time_s": "\xe4"}\n' + sound_look + b"\n")
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert ["error" in answer for answer in answers] == [True, True, False]
    assert (done.returncode, done.stderr) == (2, b"")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="stdin is closed as on POSIX")
def test_a_closed_stdin_and_lines_without_an_end_are_refused(program, inputs, tmp_path):
    none = called(program, ["guard", "--against", inputs / "pairs_out"], None)
    assert (none.returncode, b"guard --example" in none.stderr + none.stdout) == (2, True)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / "0.png"), np.zeros((48, 64), np.uint8))
    words = ["record", "-o", tmp_path / "new", "--arm", "manual", "--target", "charuco_9x6_30mm",
             "--camera", f"folder:{pictures}", "--json"]  # fmt: skip
    # A line without an end takes no memory; of the guard, it comes in pieces.
    for said, reason in ((b"X 1 \xff\n", "be a pose"), (b"1" * 5_000_000, "stdin has a line of")):
        document = json.loads(called(program, words, said).stdout)
        assert reason in document["error"]["message"]
        assert not (tmp_path / "new").exists()
    assert called(program, ["--version"], None).returncode == 0


@pytest.mark.slow
def test_letters_that_a_terminal_does_not_have_are_written_as_their_numbers(inputs, tmp_path):
    session = tmp_path / "Zelle ü \N{CAMERA}"
    shutil.copytree(inputs / "pairs", session)
    text = (session / "session.toml").read_text("utf-8")
    name = text.replace('name = "', 'name = "Zelle ü \N{CAMERA} ')
    (session / "session.toml").write_text(name, "utf-8")
    calls = (
        ["calibrate", session, "-o", tmp_path / "out", "--no-report"],
        ["verify", session, "--against", tmp_path / "out"],
        ["doctor", session],
    )
    for words in calls:
        said = io.BytesIO()
        terminal = io.TextIOWrapper(said, encoding="ascii", write_through=True)
        typed = patch.object(sys, "argv", ["visioncal", *map(str, words)])
        streams = patch.multiple(sys, stdout=terminal, stderr=terminal)
        with typed, streams, pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code, said.getvalue()
        assert rb"Zelle \xfc \U0001f4f7" in said.getvalue()


@pytest.mark.parametrize("at", [0, *map(slow, range(1, 4))])
def test_no_name_steers_the_terminal(inputs, tmp_path, at):
    hostile = "\x1b]0;title\x07\x1b[31m\u202e"
    session = tmp_path / "session"
    shutil.copytree(inputs / "pairs", session)
    toml = session / "session.toml"
    text = toml.read_text("utf-8")
    key = hostile.replace("\x1b", "\\u001b").replace("\x07", "\\u0007")
    documents = (
        f'"{key}" = 1\n{text}',
        f'target = "{key}.toml"\n{text}',
        text.replace('"ur10e"', f'"{key}.toml"'),
        text.replace("[robot]", f'["{key}"]'),
    )
    toml.write_text(documents[at], "utf-8")
    calls = (
        ["calibrate", session, "-o", tmp_path / "out", "--no-report"],
        ["doctor", session],
        ["diff", tmp_path / hostile, session],
    )
    for words in calls:
        said = visioncal(*words).said
        assert said.strip()
        assert all(letter.isprintable() for letter in said.replace("\n", "")), said


@pytest.mark.parametrize("created", ["9999-12-31T23:59:59-12:00", "0001-01-01T00:00:00+12:00"])
def test_a_result_from_the_ends_of_the_calendar_enters_no_history(created, inputs, tmp_path):
    result = json.loads((inputs / "pairs_out" / "calibration.json").read_text("utf-8"))
    (tmp_path / "calibration.json").write_text(json.dumps(result | {"created": created}), "utf-8")
    done = visioncal("history", tmp_path / "h.db", "--add", tmp_path / "calibration.json")
    done.refused("not a time")
