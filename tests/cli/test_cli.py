"""The commands as a user runs them: exit status, messages, and the files that appear."""

import io
import json
import os
import re
import subprocess
import sys
import time
from contextlib import redirect_stderr
from pathlib import Path
from typing import get_args

import pytest
from support.commands import every_command, started, visioncal
from typer.main import get_command

import visioncal as visioncal_package
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.kinematics import ASKED
from visioncal.cli import progress
from visioncal.cli.app import app
from visioncal.core.choices import (
    SIMULATED_ARMS,
    SIMULATED_CELLS,
    Convention,
    SolverName,
)
from visioncal.core.conventions import POSE_FORMS, UNITS_M
from visioncal.core.errors import DataError
from visioncal.core.types import Mount
from visioncal.live.planning.purposes import PURPOSES
from visioncal.session import Session
from visioncal.simulation import (
    CellOptions,
    cell_names,
    read_truth,
    simulate,
    truth_path,
    write_session,
)

# As a user has it.
DRAWS = True


@pytest.fixture(scope="module")
def poor(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("poor") / "one axis"
    options = CellOptions(views=6, motion="one_axis", seed=1)
    return write_session(simulate(options), folder, images=False)


def test_calibrate_writes_three_files_and_says_how_good_it_is(rendered, tmp_path):
    out = tmp_path / "out put, größer"
    done = started("calibrate", rendered, "-o", out, "-v")
    assert done.status == 0, done.err
    assert {path.name for path in out.iterdir()} == {
        "calibration.json",
        "report.html",
        "recording.rrd",
    }
    assert "\ngood" in f"\n{done.out}"
    assert "flange_from_cam" in done.out
    assert "daniilidis" in done.out


def test_json_goes_to_stdout_and_is_the_file(rendered, tmp_path):
    bare = ("--no-report", "--no-recording", "--json")
    done = visioncal("calibrate", rendered, "-o", tmp_path / "out", *bare)
    assert done.status == 0, done.err
    assert json.loads(done.out) == json.loads((tmp_path / "out/calibration.json").read_text())


def test_no_result_is_status_2_with_one_message_and_leaves_the_folder_alone(poor, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "calibration.json").write_text("an earlier result")
    done = started("calibrate", poor, "-o", out)
    assert done.status == 2
    assert done.out == ""
    assert "the camera's offset along the tool's" in done.err
    assert "Traceback" not in done.err
    assert [path.name for path in out.iterdir()] == ["calibration.json"]
    assert (out / "calibration.json").read_text() == "an earlier result"


def test_a_message_leaves_out_the_middle_of_what_nobody_reads():
    error = DataError(
        f"model is {'x' * 100_000}; a name is needed.\nLine 2.", culprits=["y" * 9000]
    )
    assert len(error.message) < 2100
    assert error.message.startswith("model is xxx")
    assert error.message.endswith("xxx; a name is needed.\nLine 2.")
    assert len(error.culprits[0]) < 400
    assert len(DataError("\n".join(["y" * 9000] * 10)).message) < 3200


def test_an_error_as_json_has_its_parts(poor, tmp_path):
    done = visioncal("calibrate", poor, "-o", tmp_path / "out", "--json")
    assert done.status == 2
    error = json.loads(done.out)["error"]
    assert error["class"] == "DegenerateError"
    assert error["culprits"]
    assert "Add 3 or more views" in error["next"]
    assert not (tmp_path / "out").exists()


def test_a_result_in_the_place_of_a_session_names_its_recording(tmp_path):
    (tmp_path / "recording.rrd").touch()
    done = visioncal("calibrate", tmp_path, "-o", tmp_path / "out")
    assert done.status == 2
    assert f"name {tmp_path}/recording.rrd" in done.err


def test_nothing_is_rendered_for_a_folder_that_is_not_empty(tmp_path, monkeypatch):
    (tmp_path / "mine.txt").touch()
    monkeypatch.setattr("visioncal.cli.simulate.simulate", None)
    done = visioncal("simulate", tmp_path)
    assert done.status == 2
    assert "exists and is not empty" in done.err


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--need-mm", "abc"),
        ("--solver", "foo"),
        ("--nosuch", "x"),
    ],
)
def test_a_wrong_option_is_an_error_as_json(option, value, poor, tmp_path):
    done = visioncal("calibrate", poor, "-o", tmp_path / "out", "--json", option, value)
    assert done.status == 2
    error = json.loads(done.out)["error"]
    assert option.strip("-") in error["message"]
    assert option.strip("-") in error["culprits"][0]
    assert error["next"]


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


def test_errors_as_json_have_one_form(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with_json = [
        name for name, value in every_command() if "as_json" in {p.name for p in value.params}
    ]
    assert len(with_json) == 17
    for name in with_json:
        source = [] if name == "record" else ["nowhere"]
        done = visioncal(*name.split(), *source, *NEEDED.get(name, ()), "--json")
        assert done.status == 2, name
        error = json.loads(done.out)["error"]
        # Who logs stderr sees it, too.
        assert error["message"] in done.err
        assert set(error) == {"class", "message", "culprits", "next"}
        assert "no" in error["message"]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_named(rendered, tmp_path):
    (tmp_path / "taken").write_text("a file where the folder should be")
    done = visioncal("calibrate", rendered, "-o", tmp_path / "taken")
    assert done.status == 2
    assert "taken" in done.err
    assert "Traceback" not in done.err


def test_simulate_writes_arms_that_warm_up_and_arms_that_bend(tmp_path):
    warm = visioncal("simulate", tmp_path / "warm", "--warm-up", "--currents", "--views", 12)
    assert warm.status == 0, warm.err
    session = Session.load(tmp_path / "warm")
    # Twelve views of a cold arm, and then six of them again every five minutes for 100 minutes.
    assert len(session.views) == 12 + 19 * 6
    assert {"current6_a", "ambient_c"} < set(session.streams["heat"].columns)
    heat = json.loads((tmp_path / "warm.truth.json").read_text())["heat"]
    assert len(heat["growth_per_k"]) == 6
    loads = ("--payload-kg", 0, "--payload-kg", 5)
    bending = ("--stiffness-knm", 10, "--no-images", "--views", 4)
    assert visioncal("simulate", tmp_path / "bent", *bending, *loads).status == 0
    carried = [view.numbers["payload_kg"] for view in Session.load(tmp_path / "bent").views]
    assert carried == [0.0, 5.0, 0.0, 5.0]
    truth = read_truth(tmp_path / "bent")
    assert truth.options["compliance_rad_per_nm"] == [1e-4] * 6


def test_simulate_writes_a_session_and_its_truth_beside_it(tmp_path):
    folder = tmp_path / "cell"
    done = visioncal("simulate", folder, "--views", 4, "--mount", "eye-to-hand", "--no-images")
    assert done.status == 0, done.err
    assert truth_path(folder).exists()
    assert not any("truth" in path.name for path in folder.rglob("*"))
    assert set(read_truth(folder).transforms) == {"base_from_cam", "flange_from_target"}
    again = visioncal("simulate", folder, "--views", 4, "--no-images")
    assert again.status == 2
    assert "cell" in again.err


@pytest.mark.slow
def test_demo_compares_itself_with_the_truth(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # a second run replaces the first
        done = visioncal("demo", "--views", 8)
        assert done.status == 0, done.err
    assert "against the truth" in done.out
    # What to do next can be typed as it is printed.
    assert "visioncal plan demo/session --add 5" in done.out
    assert (tmp_path / "demo/result/report.html").stat().st_size > 10_000


def test_steps_are_said_in_words_and_counted_by_what_they_go_through():
    steps = progress.Steps()
    said = []
    for report in (("detect", 2, 10), ("detect", 1, 40), ("detect", 40, 40), ("solve", 7, 10)):
        steps.report(*report)
        said.append(steps.line)
    board = "detect the board"
    assert said == [board, f"{board}: 1 of 40", f"{board}: 40 of 40", "solve for all frames"]


def test_every_step_has_words():
    sources = Path(visioncal_package.__file__).parent.rglob("*.py")
    called = r"""progress\(\s*"(\w+)","""
    named = {value for path in sources for value in re.findall(called, path.read_text("utf-8"))}
    assert {"detect", "render", "excitation", "path"} <= named
    assert progress.WORDS.keys() == named | {stage.name for stage in STAGES}


def test_without_a_terminal_the_step_at_work_is_a_line(monkeypatch):
    err = io.StringIO()
    monkeypatch.setattr(progress, "PAUSE_S", 0.001)
    with redirect_stderr(err), progress.shown_progress(quiet=False) as report:
        report("detect", 2, 10)
        report("detect", 12, 57)
        while "12 of 57" not in err.getvalue():
            time.sleep(0.001)
    assert err.getvalue().splitlines()[-1] == "detect the board: 12 of 57 (0 s)"


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
    "calibrate": {"level": (*ASKED, "hand-eye"), "solver": get_args(SolverName)},
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


def test_names_that_help_lists_are_those_of_the_files():
    assert cell_names() == SIMULATED_CELLS


def test_arrow_does_not_load_pandas_while_a_command_runs():
    pytest.importorskip("pandas", reason="the extra pandas is not installed")
    code = """if True:
        import sys
        import pyarrow
        from visioncal.cli import app as application

        def command():
            # Of another type than arrow would find, so that it looks at what it was given.
            assert pyarrow.array([1, 2], pyarrow.uint8()).to_pylist() == [1, 2]
            assert "pandas" not in sys.modules

        application.app = command
        application.main()
        import pandas
        assert pyarrow.Table.from_pandas(pandas.DataFrame({"a": [1]})).num_rows == 1
    """
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_blas_begins_one_thread_in_commands():
    code = """if True:
        from visioncal.cli import app as application

        def command():
            import numpy, scipy.linalg, threadpoolctl
            print({it["num_threads"] for it in threadpoolctl.threadpool_info()})

        application.app = command
        application.main()
    """
    limits = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"}
    environment = {it: value for it, value in os.environ.items() if it not in limits}
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment
    )
    assert done.stdout.strip() == "{1}"
