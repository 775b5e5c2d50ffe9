"""Commands as a user runs them: exit status, messages, streams, and advice that is typed."""

import csv
import dataclasses
import errno
import gzip
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import types
from contextlib import chdir, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import get_args
from unittest.mock import patch

import numpy as np
import pytest
from support.commands import every_command, turned_poses, visioncal, write_poses
from support.edited import rewritten
from support.following import follow, printed_commands
from support.fuzz.broken_sessions import BROKEN, broken_session
from support.marks import slow
from support.samples import made_up
from typer.main import get_command

import visioncal as visioncal_package
from visioncal.calibration.run import STAGES
from visioncal.cli import dynamics, progress
from visioncal.cli.app import app, main
from visioncal.cli.libraries import SmallLibraries
from visioncal.cli.summary import truth_rows
from visioncal.core.choices import SIMULATED_ARMS, SIMULATED_CELLS, Convention, SolverName
from visioncal.core.conventions import POSE_FORMS, UNITS_M
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Mount
from visioncal.dynamics.excitation import ExcitationRequest
from visioncal.planning.purposes import PURPOSES
from visioncal.results import Calibration
from visioncal.results.history import History
from visioncal.robot.arm_model import LEVELS
from visioncal.session import Session
from visioncal.simulation import CellOptions, read_truth, simulate, write_session
from visioncal.simulation.dynamics import exercise_session, real_dynamics, record, slow_sweep
from visioncal.vision.targets import load_target

FILES = ["calibration.json", "recording.rrd", "report.html"]
# What moves a terminal's cursor, colours it, or turns the direction of its text.
STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")


def test_calibrate_writes_three_files_and_says_how_good_it_is(rendered, tmp_path):
    out = tmp_path / "out put, größer"
    words = [sys.executable, "-m", "visioncal", "calibrate", str(rendered), "-o", str(out), "-v"]
    strict = os.environ | {"PYTHONWARNINGS": "error", "PYTHONUTF8": "1"}
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=strict)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert "\ngood" in f"\n{done.stdout}"
    assert "flange_from_cam" in done.stdout
    assert "daniilidis" in done.stdout


@pytest.mark.slow
def test_demo_compares_itself_with_the_truth(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # a second run replaces the first
        done = visioncal("demo", "--views", 8).good()
    assert "against the truth" in done.out
    # What to do next can be typed as it is printed.
    assert "visioncal plan demo/session --add 5" in done.out
    assert (tmp_path / "demo/result/report.html").stat().st_size > 10_000


def test_ctrl_c_is_status_130(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("visioncal.cli.simulate.write_session", interrupted)
    done = visioncal("simulate", tmp_path / "cell", "--views", 3)
    assert (done.status, done.out, done.err) == (130, "", "stopped by Ctrl-C\n")


@pytest.mark.parametrize("columns", [80, 200])
def test_help_has_every_word_within_the_terminal(columns):
    """Markup takes `[mm]` for a style, and columns beside each other cut names and words off."""
    for name, command in every_command():
        shown = visioncal(*name.split(), "--help", columns=columns).out
        assert max(map(len, shown.splitlines())) <= columns
        for value in (command, *command.params):
            for words in (getattr(value, "help", None) or "", *getattr(value, "opts", ())):
                assert "".join(words.split()) in "".join(shown.split()), (name, value.name)


CHOICES = {
    "calibrate": {"level": LEVELS, "solver": get_args(SolverName)},
    "plan": {"purpose": PURPOSES, "mount": get_args(Mount)},
    "record": {"pose_form": ("ours", *POSE_FORMS)},
    "simulate": {"robot": SIMULATED_ARMS},
    "export": {"convention": get_args(Convention)},
    "convert": {"robot_unit": UNITS_M},
    "fixture": {"cad_unit": UNITS_M},
}


@pytest.mark.parametrize("name", CHOICES)
def test_help_lists_what_can_be_chosen(name):
    command = get_command(app).imported(name)
    context = command.make_context(name, [], resilient_parsing=True)
    params = {param.name: param for param in command.params}
    for option, choices in CHOICES[name].items():
        words = set(re.split(r"[^\w-]+", " ".join(params[option].get_help_record(context))))
        assert set(choices) <= words, option


@pytest.fixture(scope="module")
def poor(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("poor") / "one axis"
    options = CellOptions(views=6, motion="one_axis", seed=1)
    return write_session(simulate(options), folder, images=False)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory) -> Path:
    """A session of pose pairs, which are calibrated in no time."""
    folder = tmp_path_factory.mktemp("pairs") / "cell"
    return write_session(simulate(CellOptions(views=12, seed=1)), folder, images=False)


def test_no_result_is_status_2_with_one_message_and_leaves_the_folder_alone(poor, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "calibration.json").write_text("an earlier result")
    done = visioncal("calibrate", poor, "-o", out)
    assert (done.status, done.out) == (2, "")
    assert "the camera's offset along the tool's" in done.err
    assert "Traceback" not in done.err
    assert [path.name for path in out.iterdir()] == ["calibration.json"]
    assert (out / "calibration.json").read_text() == "an earlier result"
    done = visioncal("calibrate", poor, "-o", tmp_path / "new", "--json").refused()
    error = json.loads(done.out)["error"]
    assert error["class"] == "DegenerateError"
    assert error["culprits"]
    assert "Add 3 or more views" in error["next"]
    assert not (tmp_path / "new").exists()


def test_a_long_message_is_shortened_in_its_middle():
    words = f"model is {'x' * 100_000}; a name is needed.\nLine 2."
    error = DataError(words, culprits=["y" * 9000])
    assert len(error.message) < 2100
    assert error.message.startswith("model is xxx")
    assert error.message.endswith("xxx; a name is needed.\nLine 2.")
    assert len(error.culprits[0]) < 400
    assert len(DataError("\n".join(["y" * 9000] * 10)).message) < 3200


def test_files_in_the_way_are_named(pairs, tmp_path, monkeypatch):
    (tmp_path / "recording.rrd").touch()
    (tmp_path / "taken").write_text("a file where the folder should be")
    # Nothing is rendered for a folder that is not empty.
    monkeypatch.setattr("visioncal.cli.simulate.simulate", None)
    for words, said in (
        (("calibrate", tmp_path, "-o", tmp_path / "out"), f"name {tmp_path}/recording.rrd"),
        (("calibrate", pairs, "-o", tmp_path / "taken"), "taken"),
        (("simulate", tmp_path), "exists and is not empty"),
    ):
        done = visioncal(*words).refused(said)
        assert "Traceback" not in done.err


# Options that each command with --json needs before it can look for its input.
NEEDED = {
    "correct": ["-c", "nowhere"],
    "diff": ["nowhere"],
    "dynamics gains": ["--loaded", "nowhere", "--mass-kg", 1, "--com-mm", "0,0,0"],
    "dynamics payload": ["--against", "nowhere"],
    "dynamics validate": ["--against", "nowhere"],
    "locate": ["-c", "nowhere"],
    "record": ["-o", "new", "--arm", "manual", "--camera", "folder:nowhere", "--target", "no"],
    "touch-test": ["-c", "nowhere"],
    "verify": ["--against", "nowhere"],
}


def test_errors_as_json_have_one_form(poor, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with_json = [
        name for name, value in every_command() if "as_json" in {p.name for p in value.params}
    ]
    assert "calibrate" in with_json
    for name in with_json:
        source = [] if name == "record" else ["nowhere"]
        done = visioncal(*name.split(), *source, *NEEDED.get(name, ()), "--json").refused()
        error = json.loads(done.out)["error"]
        # Who logs stderr sees it, too.
        assert error["message"] in done.err
        assert set(error) == {"class", "message", "culprits", "next"}
        assert "no" in error["message"]
    for option, value in (("--need-mm", "abc"), ("--solver", "foo"), ("--nosuch", "x")):
        done = visioncal("calibrate", poor, "-o", tmp_path / "out", "--json", option, value)
        assert done.status == 2
        error = json.loads(done.out)["error"]
        assert option.strip("-") in error["message"]
        assert option.strip("-") in error["culprits"][0]
        assert error["next"]
    assert not list(tmp_path.iterdir())


MISSING = {
    "verify": "SESSION and --against are missing",
    "dynamics gains": "SESSION, --loaded, --mass-kg and --com-mm are missing",
    "diff one": "SECOND is missing",
    "plan ur10e --camera 900,900,640,400": "--target, --cam, --board, --resolution are needed",
    "fixture": "visioncal fixture TOUCHES -c OUT --cad DRAWING --tool NAME",
    "fixture cell/points.csv": "tool that touched the points is not stated, nor which points they",
    "record -o new": "--target, --arm and --camera are missing",
    "record -o new --arm manual": "--target and --camera are missing",
    "record -o new --camera folder:x": "Name them, as --target charuco_9x6_30mm --arm manual; ",
}


@pytest.mark.parametrize("words", MISSING)
def test_all_that_is_missing_is_named_at_once(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    if "cell" in words:
        visioncal("simulate", "cell", "--touches", "--no-images").good()
    visioncal(*words.split()).refused(MISSING[words])


def test_simulate_writes_arms_that_warm_up_and_arms_that_bend(tmp_path):
    visioncal("simulate", tmp_path / "warm", "--warm-up", "--currents", "--views", 12).good()
    session = Session.load(tmp_path / "warm")
    # Twelve views of a cold arm, and then six of them again every five minutes for 100 minutes.
    assert len(session.views) == 12 + 19 * 6
    assert {"current6_a", "ambient_c"} < set(session.streams["heat"].columns)
    heat = json.loads((tmp_path / "warm.truth.json").read_text())["heat"]
    assert len(heat["growth_per_k"]) == 6
    bent = ("--stiffness-knm", 10, "--no-images", "--views", 4, "--mount", "eye-to-hand")
    loads = ("--payload-kg", 0, "--payload-kg", 5)
    visioncal("simulate", tmp_path / "bent", *bent, *loads).good()
    carried = [view.numbers["payload_kg"] for view in Session.load(tmp_path / "bent").views]
    assert carried == [0.0, 5.0, 0.0, 5.0]
    # The truth lies beside it.
    truth = read_truth(tmp_path / "bent")
    assert truth.options["compliance_rad_per_nm"] == [1e-4] * 6
    assert not any("truth" in path.name for path in (tmp_path / "bent").rglob("*"))
    assert set(truth.transforms) == {"base_from_cam", "flange_from_target"}


def test_steps_are_shown_in_words_and_without_a_terminal_in_lines(monkeypatch):
    steps, said, err = progress.Steps(), [], io.StringIO()
    for report in (("detect", 2, 10), ("detect", 1, 40), ("detect", 40, 40), ("solve", 7, 10)):
        steps.report(*report)
        said.append(steps.line)
    board = "detect the board"
    assert said == [board, f"{board}: 1 of 40", f"{board}: 40 of 40", "solve for all frames"]
    sources = Path(visioncal_package.__file__).parent.rglob("*.py")
    called = r"""progress\(\s*"(\w+)","""
    named = {value for path in sources for value in re.findall(called, path.read_text("utf-8"))}
    assert {"detect", "render", "excitation", "path"} <= named
    assert progress.WORDS.keys() == named | {stage.name for stage in STAGES}
    monkeypatch.setattr(progress, "PAUSE_S", 0.001)
    with redirect_stderr(err), progress.shown_progress(quiet=False) as report:
        report("detect", 2, 10)
        report("detect", 12, 57)
        while "12 of 57" not in err.getvalue():
            time.sleep(0.001)
        # What takes long is said again.
        while err.getvalue().count("12 of 57") < 2:
            time.sleep(0.001)
    assert err.getvalue().splitlines()[-1].startswith("detect the board: 12 of 57 (")


def test_names_that_help_lists_are_those_of_the_files():
    cells = (Path(visioncal_package.__file__).parent / "simulation" / "cells").glob("*.toml")
    assert tuple(sorted(cell.stem for cell in cells)) == SIMULATED_CELLS


SMALL = """
from visioncal.cli import app as it

def command():
    import sys, numpy, pyarrow, scipy.linalg, threadpoolctl
    # Of another type than arrow would find, so that it looks at what it was given.
    assert pyarrow.array([1, 2], pyarrow.uint8()).to_pylist() == [1, 2]
    assert scipy.linalg.solve([[2.0]], [1.0]).tolist() == [0.5]
    import cv2
    assert "cv2.typing" not in sys.modules
    assert cv2.norm(numpy.ones(4)) == 2.0
    assert cv2.aruco.DICT_4X4_50 == 0
    assert not hasattr(cv2, "nothing")
    print("pandas" in sys.modules, {it["num_threads"] for it in threadpoolctl.threadpool_info()})

it.app = command
it.main()
import pandas, pyarrow
assert pyarrow.Table.from_pandas(pandas.DataFrame({"a": [1]})).num_rows == 1
"""


def test_libraries_are_kept_small_in_commands():
    """Arrow loads pandas after a command alone, and OpenCV comes as used; BLAS has one thread."""
    limits = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"}
    environment = {name: value for name, value in os.environ.items() if name not in limits}
    words = [sys.executable, "-c", SMALL]
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "False {1}"


def test_help_lists_first_what_most_need():
    """Of commands by group, and of options in order of use."""
    said = visioncal("--help").out
    heads = ("Start:", "Calibrate:", "Use the result:", "Keep it valid:", "More:")
    assert [line for line in said.splitlines() if line in heads] == [*heads]
    for name, command in every_command():
        if " " not in name and (shown := len(command.first)):
            said = visioncal(name, "--help").out
            assert said.index("\nOptions:") < said.index("\nMore")
            head = said[said.index("\nOptions:") : said.index("\nMore")]
            names = {param.name: max(param.opts, key=len) for param in command.params}
            lines = [rf"^  (-\S+, )*{names[name]}\b" for name in command.first]
            places = [re.search(line, head, re.M).start() for line in lines]
            assert places == sorted(places)
            assert len(places) == shown <= 11
        elif " " not in name and name not in ("target", "dynamics"):
            assert len(command.params) <= 8, f"{name} has options, and none that matter"


@pytest.mark.slow
def test_examples_work(pairs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("OUT").mkdir()
    made_up().calibration.save("OUT/calibration.json")
    for name in ("tcp", "fixture", "correct"):
        Path(f"{name}.csv").write_text(visioncal(name, "--example").good().out)
    visioncal("tcp", "tcp.csv", "-o", "frames.json", "--name", "tip").good()
    for source, name, *more in (("tcp", "tcp.csv"), ("fixture", "fixture.csv", "--tool", "none")):
        done = visioncal(source, name, *more, "--json").good()
        (frame,) = json.loads(done.out).values()
        assert frame["verdict"]["status"] == "good"
    elastic = Path(__file__).parents[1] / "data" / "calibration_elastic.json.gz"
    Path("elastic.json").write_bytes(gzip.decompress(elastic.read_bytes()))
    done = visioncal("correct", "correct.csv", "--against", "elastic.json", "--json").good()
    assert len(json.loads(done.out)["targets"]) == 2
    more = {
        "plan": ("--candidates", "60", "--stops", "4"),
        "history": (),
        # That camera's pictures are smaller.
        "locate": ("--pixel", "320,200"),
    }
    for name, words in more.items():
        lines = visioncal(name, "--example").good().out.replace("\\\n", "").splitlines()
        _, typed, *rest = shlex.split(lines[-1])
        assert typed == name
        if name == "locate":
            rest[rest.index("--pixel") : rest.index("--pixel") + 2] = []
        visioncal(name, *rest, *words).good()
    looks = visioncal("guard", "--example").good().out
    monkeypatch.setattr(sys, "stdin", io.StringIO(looks))
    visioncal("calibrate", pairs, "--level", "hand-eye", "-o", "pairs", "--no-report").good()
    done = visioncal("guard", "--against", "pairs")
    assert "error" not in done.out
    assert len(done.out.splitlines()) == 2


def test_files_and_columns_that_are_missing_are_named_at_once(tmp_path):
    out, drawing = tmp_path / "out", tmp_path / "drawing.csv"
    out.mkdir()
    made_up().calibration.save(out / "calibration.json")
    visioncal("fixture", "points.csv", "--cad", "cad.csv", "-c", out).refused(
        "points.csv and cad.csv do not exist, and", "has no tool", "visioncal tcp", "--example"
    )
    visioncal("fixture", "points.csv", "--cad", "cad.csv", "--tool", "none", "-c", "none").refused(
        "points.csv, cad.csv and none do not exist."
    )
    visioncal("tcp", "points.csv", "-c", out).refused("points.csv does not exist.")
    visioncal("locate", "-c", out, "--pixel", "1,2").refused("(--plane)", "(--pose)", "--example")
    drawing.write_text("part,x\n1,2\n")
    touches = tmp_path / "points.csv"
    touches.write_text(visioncal("fixture", "--example").out)
    visioncal("fixture", touches, "--cad", drawing, "--tool", "none").refused(
        "a column point", "x_mm, y_mm, z_mm"
    )
    visioncal("plan", "ur5e").refused("--target, --camera, --cam, --board", "plan --example")
    visioncal("plan").refused("SOURCE is missing", "visioncal plan --example prints one")
    visioncal("history", out, "--add", out).refused("is a folder", "and --add the folder")
    begun = visioncal("history", "--add", out)
    begun.refused(f"visioncal history visioncal-history.db --add {out}")


def test_a_folder_that_is_no_session_yet_is_refused_with_the_way_to_one(rendered, tmp_path):
    pictures, table = tmp_path / "pictures", tmp_path / "log.csv"
    shutil.copytree(rendered / "images", pictures)
    table.write_text("X,Y,Z,W,P,R\n1,2,3,4,5,6\n")
    named = f"{tmp_path}/log-session --images PICTURES --mount"
    visioncal("calibrate", table).refused(
        "must be the folder of a session", f"convert {table} {named}"
    )
    visioncal("doctor", pictures).refused(f"convert TABLE {pictures}-session --images {pictures}")
    shutil.copy(table, pictures)
    visioncal("doctor", pictures).refused(f"convert {pictures} {pictures}-session --mount")
    # Poses of both sides need no board.
    (tmp_path / "both").mkdir()
    (tmp_path / "both/pairs.csv").write_text("x,y\n1,2\n")
    visioncal("doctor", tmp_path / "both").refused("both-session --mount eye-in-hand &&")


RECORDS = """
from dataclasses import dataclass, field

@dataclass(frozen=True, order=True)
class Whole:
    "One with all methods."
    a: int
    b: list = field(default_factory=list, hash=False)

@dataclass(frozen=True, eq=False, kw_only=True)
class Part(Whole):
    "One that inherits."
    c: float = 1.0

    def __post_init__(self):
        if self.c < 0:
            raise ValueError(self.c)
"""


def test_records_of_a_command_are_those_of_the_library():
    made, small = {}, SmallLibraries()
    for late in (True, False):
        module = types.ModuleType("visioncal.planted")
        with small if late else nullcontext(), patch.dict(sys.modules, {module.__name__: module}):
            exec(RECORDS, vars(module))
        whole, part = module.Whole(1, [2]), module.Part(a=3, c=4.0)
        seen = [repr(whole), repr(part), hash(whole), whole == module.Whole(1, [2]),
                whole < module.Whole(2), part == replace(part), replace(part, c=5.0).c]  # fmt: skip
        for broken in (
            lambda one=whole: setattr(one, "a", 2),
            lambda one=part: delattr(one, "c"),
            module.Whole,
            lambda module=module: module.Part(3, [], 4.0),
            lambda module=module: module.Part(a=3, c=-4.0),
        ):
            with pytest.raises((TypeError, ValueError, FrozenInstanceError)) as refused:
                broken()
            seen.append((type(refused.value), str(refused.value)))
        made[late] = seen
    assert made[True] == made[False]
    assert not hasattr(dataclasses, "exec")


LOADING = """
import sys
from visioncal.cli import main
try:
    main()
finally:
    heavy = "cv2.typing jinja2 matplotlib pandas pinocchio pyarrow rerun scipy.optimize scipy.stats"
    heavy = {*heavy.split(), "scipy.io", "visioncal.calibration", "visioncal.interchange.formats"}
    heavy |= {"numpy.f2py", "numpy.testing", "rich"}
    print(len(sys.modules), *heavy & set(sys.modules), file=sys.stderr)
"""


@pytest.mark.parametrize(
    ("words", "most", "used"),
    [
        ("--help", 250, set()),
        ("calibrate --help", 450, set()),
        # A quarter of today's beyond them: what another Python and other releases may add.
        ("export out --to ur", 1100, {"cv2.typing"}),
        slow("diff out out", 1100, {"cv2.typing"}),
        slow("locate -c out --pixel 320,200 --plane z=20 --pose 0.5,0.1,0.4,0,1,0,0", 1100,
             {"cv2.typing"}),
        slow("show out -o report.html", 1250, {"cv2.typing", "jinja2", "matplotlib"}),
        slow("history empty.db", 1050, {"rich"}),
    ],
)  # fmt: skip
def test_a_short_command_loads_what_it_uses(words, most, used, tmp_path):
    (tmp_path / "out").mkdir()
    made_up().calibration.save(tmp_path / "out" / "calibration.json")
    History(tmp_path / "empty.db").append()
    program = [sys.executable, "-c", LOADING, *words.split()]
    done = subprocess.run(program, check=False, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    count, *loaded = done.stderr.splitlines()[-1].split()
    assert set(loaded) <= used
    assert int(count) <= most


@pytest.mark.slow
def test_messages_are_of_use_in_their_place(rendered, pairs, tmp_path, monkeypatch):
    """Coverage, verdicts beside exports, what could not be checked, and guards without looks."""
    out = tmp_path / "out"
    said = visioncal("calibrate", rendered, "-o", out, "--no-recording").out
    assert re.search(r"^Corners in \d+ of 40 fields of the image\.$", said, re.MULTILINE)
    (count,) = re.findall(r"Coverage: corners in (\d+) of 40", (out / "report.html").read_text())
    assert 10 < int(count) < 40
    assert "Corners in" not in visioncal("calibrate", pairs, "-o", tmp_path / "pairs").out
    for name in ("fanuc", "yaskawa", "zivid"):
        file = tmp_path / f"{name}.out"
        visioncal("export", out, "--to", name, "-o", file, "--force").good()
        note = file.with_name(f"{file.name}.txt")
        assert f"verdict {Calibration.load(out).verdict.status}" in note.read_text()
        note.write_text("another's")
        file.unlink()
        assert note.name in visioncal("export", out, "--to", name, "-o", file).err
        assert not file.exists()
    visioncal("export", out, "--to", "kuka", "-o", tmp_path / "kuka", "--force").good()
    assert not (tmp_path / "kuka.txt").exists()
    against = ("--against", tmp_path / "pairs")
    assert "could not be checked" not in visioncal("verify", pairs, *against).out
    rows = (pairs / "views.csv").read_text().splitlines()
    warm = shutil.copytree(pairs, tmp_path / "warm")
    (warm / "views.csv").write_text(
        "\n".join([f"{rows[0]},ambient_c", *(f"{row},20.5" for row in rows[1:])])
    )
    said = visioncal("verify", warm, *against).out
    assert "could not be checked: the ambient temperature" in said
    assert "payload" not in said.partition("could not be checked")[2]
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    visioncal("guard", *against).refused("stdin held no look", "guard --example")


@pytest.mark.slow
def test_stops_to_repeat_come_with_the_board_of_the_result(rendered, tmp_path, monkeypatch):
    """Of an arm without a model, whose way to the stops nobody plans."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(rendered, "cell")
    declared, table = Path("cell/session.toml"), Path("cell/views.csv")
    declared.write_text(re.sub(r"\[robot\]\n(?:.+\n)*", "", declared.read_text("utf-8")), "utf-8")
    with table.open(newline="", encoding="utf-8") as file:
        rows = [
            {name: cell for name, cell in row.items() if not re.fullmatch(r"q\d_rad", name)}
            for row in csv.DictReader(file)
        ]
    with table.open("w", newline="", encoding="utf-8") as file:
        written = csv.DictWriter(file, rows[0])
        written.writeheader()
        written.writerows(rows)
    visioncal("calibrate", "cell", "-o", "out", "--no-recording", "--no-report").good()
    done = visioncal("plan", "out", "--verify", "--stops", 3, "-o", "again").good()
    assert "visioncal record --arm manual --target again/board.toml" in done.out
    assert load_target("again/board.toml").square_m == 0.03
    recovering = visioncal("recover", "act", "--against", "out", "--count", 9)
    assert "--target act/plan/board.toml" in recovering.err
    assert "BOARD" not in recovering.err


@pytest.mark.slow
def test_next_steps_keep_the_views_that_were_typed(tmp_path):
    cell, out = tmp_path / "cell", tmp_path / "out"
    visioncal("simulate", cell, "--no-images").good()
    document = (cell / "session.toml").read_text()
    (cell / "session.toml").write_text(document.replace("eye-in-hand", "eye-to-hand"))
    quick = ("--no-report", "--no-recording")
    done = visioncal("calibrate", cell, "-o", out, "--views", "0-14", *quick)
    assert f"visioncal calibrate {cell}-fixed -o {out} --views 0-14" in done.out


def test_a_bad_result_has_status_3_and_is_used_by_force_alone(pairs, tmp_path):
    # No cell of this kind reaches it: the probability of the need is zero.
    out, need = tmp_path / "out", ("--need-mm", "0.001")
    done = visioncal("calibrate", pairs, "-o", out, *need, "--json")
    assert done.status == 3
    assert json.loads(done.out)["verdict"]["status"] == "bad"
    drawn = ("--no-report", "--workers", 1)
    assert visioncal("batch", pairs, "-o", tmp_path / "many", *need, *drawn).status == 3
    assert visioncal("batch", pairs, "-o", tmp_path / "other", *drawn).status == 0
    first, *others = Calibration.load(out).verdict.reasons
    for command in (
        f"export {out} --to ur",
        f"correct {pairs}/views.csv --against {out}",
        f"locate {pairs} -c {out}",
        f"locate -c {out} --pixel 640,400 --plane z=20 --pose 0.5,0.1,0.4,0,1,0,0",
    ):
        words = command.split()
        refused = visioncal(*words)
        assert (refused.status, refused.out) == (3, "")
        assert "is bad" in refused.err
        assert "--force" in refused.err
        assert first in refused.err
        assert not any(reason in refused.err for reason in others)
        forced = visioncal(*words, "--force")
        assert forced.status != 3
        if words[0] == "export":
            assert forced.status == 0, forced.err
            assert "is bad" in forced.err
        else:
            machine = visioncal(*words, "--json")
            assert machine.status == 3
            assert json.loads(machine.out)["error"]["class"] == "VerdictError"


def full():
    return Path("/dev/full").open("w", encoding="utf-8")


def unread():
    """A pipe whose reader has gone."""
    reading, writing = os.pipe()
    os.close(reading)
    return os.fdopen(writing, "w", encoding="utf-8")


def status(out, err, *arguments) -> int:
    words = ["visioncal", *map(str, arguments)]
    with patch.object(sys, "argv", words), redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


HAS_FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")


@HAS_FULL
@pytest.mark.parametrize(
    ("out", "err", "options", "ends", "said"),
    [
        (full, io.StringIO, ["--json"], 2, "stdout cannot be written: No space left on device."),
        slow(io.StringIO, full, [], 0, None),
        # A reader that has gone ends the command quietly.
        slow(unread, io.StringIO, ["--json"], 141, ""),
        # Streams that were closed before are no error.
        (nullcontext, nullcontext, ["--json"], 0, None),
    ],
    ids=["full stdout", "full stderr", "no reader", "closed"],
)
def test_broken_streams_take_no_result_away(pairs, tmp_path, out, err, options, ends, said):
    folder, history = tmp_path / "out", tmp_path / "history.db"
    options = [*options, "--history", history]
    with out() as stdout, err() as stderr:
        assert status(stdout, stderr, "calibrate", pairs, "-o", folder, *options) == ends
        if said is not None:
            errors = stderr.getvalue()
            assert said in errors
            assert bool(said) == bool(errors)
    assert sorted(path.name for path in folder.iterdir()) == FILES
    with out() as stdout, err() as stderr:
        status(stdout, stderr, "verify", pairs, "--against", folder, *options)
    assert [entry.kind for entry in History(history).entries()] == ["calibrated", "verified"]


@HAS_FULL
def test_every_command_ends_with_one_message_where_stdout_is_full_or_closed():
    for arguments in (["--help"], ["--version"], ["calibrate", "none", "--json"]):
        err = io.StringIO()
        with full() as out:
            assert status(out, err, *arguments) == 2
        assert err.getvalue().count("stdout cannot be written") == 1
        with unread() as out:
            assert status(out, io.StringIO(), *arguments) == 141
    # An error that cannot be printed keeps its status.
    for arguments in (["calibrate", "none"], ["calibrate", "--nonsense"]):
        with full() as err:
            assert status(io.StringIO(), err, *arguments) == 2
        assert status(None, None, *arguments) == 2


def test_a_lens_that_is_held_has_no_ratio_of_error_and_sigma():
    found = made_up().calibration
    held = replace(found.camera, covariance=np.zeros((9, 9)))
    edges = {name: edge.matrix for name, edge in found.edges.items()}
    rows = [*truth_rows(replace(found, camera=held), edges, held.camera)]
    assert [ratio for *_, ratio in rows][-4:] == ["", "", "", ""]


READERS = """
    calibrate {} -o out; convert {} out; show {}; export {} --to ros; diff {} {};
    verify {} --against {}; locate {} -c {}; show {} --viewer; tcp {} --robot-model ur10e;
    dynamics identify {}; target check {}
"""


@pytest.mark.parametrize("name", ["a" * 300, "pipe.rrd", "pipe.json"])
def test_an_unreadable_source_is_no_bug_and_is_not_waited_for(name, tmp_path, monkeypatch):
    """Names that no file has, and files that might never end, at every command that reads."""
    monkeypatch.chdir(tmp_path)
    if name.startswith("pipe"):
        os.mkfifo(name)
    for command in READERS.split(";"):
        done = visioncal(*(word.format(tmp_path / name) for word in command.split())).refused()
        assert done.err.startswith("error: ")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_may_not_be_searched_is_said_with_its_rights(tmp_path, monkeypatch):
    """Not by its rights themselves, which hold no administrator back."""
    closed = tmp_path / "closed"
    closed.mkdir()
    stat = Path.stat

    def refused(path: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if closed in path.parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(Path, "stat", refused)
    for words in (("calibrate", closed, "-o", tmp_path / "out"), ("doctor", closed)):
        done = visioncal(*words).refused()
        assert f"error: {closed}" in done.err
        assert "may not be read by this user" in done.err
        assert "chmod u+rwx" in done.err


@pytest.mark.slow
def test_a_name_does_not_steer_the_terminal(pairs, tmp_path):
    cell, out = shutil.copytree(pairs, tmp_path / "cell"), tmp_path / "out"
    document, result = cell / "session.toml", out / "calibration.json"
    named = r'name = "\u001b[31mred\u0007\u202e\nand \u009b1m"'
    text, count = re.subn("^name = .*$", lambda _: named, document.read_text(), flags=re.M)
    assert count == 1
    document.write_text(text)
    for call in (
        ("doctor", cell),
        ("calibrate", cell, "-o", out),
        ("show", out, "-o", tmp_path / "report.html"),
        ("show", out, "--certificate", "-o", tmp_path / "certificate.html"),
        ("verify", cell, "--against", out, "-o", tmp_path / "check"),
        # Nor that of a result from elsewhere.
        ("verify", cell, "--against", result),
    ):
        if call[-1] == result:
            written = re.sub(r'"name": ".*?\[31m', r'"name": "\\u001b[31m', result.read_text())
            assert r"\u001b[31m" in written
            result.write_text(written)
        done = visioncal(*call).good()
        assert not STEERING.search(done.out + done.err), call
    pages = [page.read_text() for page in sorted(tmp_path.rglob("*.html"))]
    assert len(pages) >= 3
    assert all("[31mred" in page and not STEERING.search(page) for page in pages)


# Read as they are, as tests of tables show: what is then printed is that of semicolons.
ALIKE = ("decimal commas", "a byte-order mark", "empty rows")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder that the commands are typed in: some write beside it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Of each kind of advice, tests/cli/test_following.py has a quick one.
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in BROKEN if name not in ALIKE])
def test_broken_sessions_are_answered_with_the_next_step(place, name):
    broken_session(place / "session", BROKEN[name])
    for words in (("doctor", "session"), ("calibrate", "session", "-o", "out")):
        shutil.copytree(place / "session", place / words[0] / "session")
        with chdir(place / words[0]):
            follow(*words)


WRONG_PLACES = {
    "a session's table for a result": (
        ("export", "session/views.csv", "--to", "ros"),
        "session/views.csv begins with 'view,",
        "nothing need be changed",
    ),
    "a result for a session": (
        ("convert", "out", "copy"),
        "must be a session, but is a result",
        "recording",
    ),
    "no folder": (("calibrate", "session", "-o", ""), "--out is empty", "variable"),
    "no folder, as one word": (("plan", "session", "--out="), "--out is empty", "variable"),
    "touches for a drawing": (
        ("fixture", "session/views.csv", "--cad", "session/views.csv", "--tool", "none"),
        "views.csv has rotations",
        "Name the touches first",
    ),
    "no arm": (("simulate", "x", "--robot", "foo"), "the names are ur3e, ur5e", "Name one"),
    "readings to look in": (
        ("locate", "tracker", "-c", "tracked"),
        "is of an instrument",
        "visioncal verify",
    ),
}


@pytest.mark.parametrize(
    "name", [slow(name) if name == "readings to look in" else name for name in WRONG_PLACES]
)
def test_arguments_in_the_wrong_place_are_answered_with_the_next_step(place, name):
    words, said, advised = WRONG_PLACES[name]
    write_session(simulate(CellOptions(views=8, seed=4)), place / "session", images=False)
    if "out" in words:
        for file in ("calibration.json", "recording.rrd"):
            (place / "out" / file).parent.mkdir(exist_ok=True)
            (place / "out" / file).touch()
    if "tracker" in words:
        assert visioncal("simulate", "tracker", "--instrument", "point").status == 0
    if "tracked" in words:
        assert visioncal("calibrate", "tracker", "-o", "tracked").status == 0
    first, *_ = follow(*words).runs
    first.refused(said, advised)


@pytest.mark.slow
def test_failed_checks_are_answered_with_the_next_step(place):
    whole = Session.load(write_session(simulate(CellOptions(views=20, seed=5)), place / "all"))
    replace(whole, views=whole.views[:15]).save(place / "fit")
    assert visioncal("calibrate", "fit", "-o", "out").status == 0
    for name, last, change in (
        ("few", 18, lambda _, row: row),
        ("knocked", 20, lambda _, row: row | {"x_m": str(float(row["x_m"]) + 0.01)}),
    ):
        replace(whole, views=whole.views[15:last]).save(place / name)
        rewritten(place / name, change)
        first, *_ = follow("verify", name, "--against", "out").runs
        assert printed_commands(first.said), name


def test_mistakes_about_a_tool_are_answered_with_the_next_step(place):
    rng = np.random.default_rng(3)
    above, tip = np.eye(3), np.array([0.02, 0.01, 0.15])
    tips = np.tile([0.4, 0.1, 0.2], (8, 1)) + rng.normal(scale=1e-4, size=(8, 3))
    poses = turned_poses(rng, tips, tip, above)
    write_poses(place / "inverse.csv", invert(poses))
    write_poses(place / "touches.csv", poses)
    for words in (
        ("tcp", "inverse.csv", "-o", "frames.json"),
        ("tcp", "touches.csv", "-o", "frames.json", "--force", "--touch-noise-mm", "0.01"),
    ):
        followed = follow(*words)
        assert all(run.good() for run in followed.runs)
        assert followed.done


@pytest.mark.slow
def test_mistakes_about_a_fixture_are_answered_with_the_next_step(place):
    assert visioncal("simulate", "cell", "--touches", "--no-images").status == 0
    assert visioncal("calibrate", "cell", "-o", "out").status == 0
    assert visioncal("tcp", "cell/touches.csv", "-c", "out", "--name", "gripper").status == 0
    points = (place / "cell/points.csv").read_text("utf-8").splitlines()
    view, name, x, *others = points[4].split(",")
    points[4] = ",".join((view, name, str(float(x) + 0.004), *others))
    (place / "missed.csv").write_text("\n".join(points), "utf-8")
    command = ("fixture", "cell/points.csv", "--cad", "cell/cad.csv", "-c", "out")
    for words in (
        ("fixture", "missed.csv", *command[2:], "--name", "jig"),
        (*command, "--name", "tray", "--touch-noise-mm", "0.005"),
        (*command, "--name", "bin", "--touch-noise-mm=0.005"),
    ):
        # That of a value as one word is that of two.
        first = visioncal(*words).good() if "bin" in words else follow(*words).runs[0].good()
        (again,) = printed_commands(first.said)
        # The advice's value stands behind what was typed, and counts.
        assert ("--touch-noise-mm" in again) == ("--touch-noise" in words[-1] + words[-2])


@pytest.mark.slow
def test_mistakes_about_dynamics_are_answered_with_the_next_step(place, monkeypatch):
    # The motion that is planned need not be a good one: a short search will do.
    monkeypatch.setattr(
        dynamics,
        "ExcitationRequest",
        lambda *words, **more: replace(ExcitationRequest(*words, **more), starts=1, steps=3),
    )
    rng = np.random.default_rng(2)
    built = real_dynamics("ur5e", rng)
    streams = {"sweeps": record(built, slow_sweep(6, rng, seconds=30.0), rng)}
    exercise_session("ur5e", streams).save(place / "session")
    first, *_ = follow("dynamics", "identify", "session", "-o", "out").runs
    assert "visioncal dynamics plan ur5e -o motions" in printed_commands(first.good().said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("calibrate {} --need-mm 0,5", ("--need-mm is '0,5'", "a number above 0")),
        ("calibrate {} --need-mm 0", ("--need-mm is '0'", "a number above 0")),
        ("calibrate {} --need-deg nan", ("--need-deg is 'nan'", "a number above 0")),
        ("verify {} --against {} --most-kg 2,5", ("--most-kg is '2,5'", "of 0 or more", "2.5")),
        ("simulate new --views 1e6", ("--views is '1e6'", "a whole number of 1 or more")),
        ("simulate new --robot-sigma-mm nan", ("'nan'", "a number from 0 to 100")),
        ("plan {} --add -1", ("--add is '-1'", "a whole number from 1 to")),
        ("calibrate {} --solver tsay", ("'tsay'", "one of joint, tsai", "Did you mean tsai?")),
        ("calibrate {} -o {}/views.csv", ("--out is", "views.csv, a file", "a folder")),
        ("show ''", ("RESULT is empty", "variable of the shell")),
        ("audit ''", ("DATASET is empty",)),
        ("diff {} ''", ("SECOND is empty",)),
        ("batch {} '' -o new", ("SESSIONS is empty",)),
    ],
)
def test_a_refused_value_is_shown_with_a_possible_one(rendered, tmp_path, words, said):
    typed = [word.replace("{}", str(rendered)) for word in shlex.split(words)]
    with chdir(tmp_path):
        visioncal(*typed).refused(*said)
        assert not [*tmp_path.iterdir()]


def test_ctrl_c_before_a_command_has_begun_says_nothing_of_python(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("visioncal.cli.app.app", interrupted)
    done = visioncal("doctor", "cell")
    assert (done.status, done.said) == (130, "")
    # While its libraries are imported, too.
    code = (
        "import builtins; real = builtins.__import__\n"
        "def fake(name, *more, **others):\n"
        "    if name == 'visioncal.cli.app': raise KeyboardInterrupt\n"
        "    return real(name, *more, **others)\n"
        "builtins.__import__ = fake\n"
        "from visioncal.cli import main\n"
    )
    stopped = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert (stopped.returncode, stopped.stderr) == (130, b"")
