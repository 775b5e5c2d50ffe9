"""`visioncal show --viewer`: what it opens, who can reach it, and that nothing stays behind."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.commands import visioncal
from support.marks import slow
from support.samples import made_up

from visioncal.interchange.result_files import load_result
from visioncal.present import viewer
from visioncal.present.recording import write_recording
from visioncal.present.viewer import blueprint, native

ENVIRONMENT = os.environ | {"COLUMNS": "300", "PYTHONWARNINGS": "error", "PYTHONUTF8": "1"}


def command(*arguments):
    return [sys.executable, "-m", "visioncal", "show", "--viewer", *map(str, arguments)]


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """A folder as `visioncal calibrate` leaves it, of which only the recording matters here."""
    sample = made_up()
    folder = tmp_path_factory.mktemp("out put, größer")
    layout = blueprint(sample.session, sample.calibration)
    write_recording(
        folder / "recording.rrd", sample.session, sample.calibration, sample.evidence, layout
    )
    return folder


def is_open(host, port):
    with socket.socket() as connection:
        connection.settimeout(60)
        return connection.connect_ex((host, port)) == 0


def test_a_source_that_cannot_be_reviewed_is_refused_with_the_next_step(tmp_path):
    session, empty, other = (tmp_path / name for name in ("session", "empty", "other.rrd"))
    session.mkdir()
    (session / "session.toml").write_text("schema = 1\n")
    empty.mkdir()
    other.write_text("no recording")
    for path, words in (
        (session, f"visioncal calibrate {session} -o OUT"),
        (empty, "holds no recording.rrd"),
        (other, "must be a recording"),
        (tmp_path / "nowhere.rrd", "does not exist"),
    ):
        visioncal("show", "--viewer", path).refused(words)


def test_the_viewer_opens_at_the_worst_view_or_at_the_named_one(out, monkeypatch):
    opened = []
    monkeypatch.setattr(viewer, "review_native", lambda _, row: opened.append(row))
    views = load_result(out / "recording.rrd").views
    assert visioncal("show", "--viewer", out).status == 0
    worst = views[opened[0]]
    assert not worst.used
    assert worst.residual_mm == max(view.residual_mm or 0.0 for view in views)
    # Views are numbered as the session says, and stand in its order.
    assert visioncal("show", "--viewer", out, "--view", views[3].view).status == 0
    assert opened[1] == 3
    visioncal("show", "--viewer", out, "--view", "99").refused("no view 99")


STUB = """
import json, os, subprocess, sys, time
# A child that stops at nothing but SIGKILL.
stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
child = subprocess.Popen([sys.executable, "-c", stubborn])
time.sleep(0.5)
told = {"arguments": sys.argv[1:], "child": child.pid, "environment": dict(os.environ)}
with open(os.environ["TOLD"] + ".new", "w") as file:
    json.dump(told, file)
os.rename(os.environ["TOLD"] + ".new", os.environ["TOLD"])
time.sleep(600)
"""


@pytest.fixture
def stub(tmp_path):
    """Puts a script in the place of rerun's command; gives the environment that does it."""

    def put(script):
        package = tmp_path / "site" / "rerun_cli"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "__main__.py").write_text(script)
        return {"PYTHONPATH": str(package.parent), "TOLD": str(tmp_path / "told.json")}

    return put


def test_the_native_viewer_ends_with_all_that_it_started(out, stub, tmp_path):
    record = tmp_path / "told.json"
    process = subprocess.Popen(
        command(out), stderr=subprocess.PIPE, text=True, env=ENVIRONMENT | stub(STUB)
    )
    try:
        end = time.monotonic() + 60
        while not record.exists() and time.monotonic() < end:
            time.sleep(0.05)
        viewer = json.loads(record.read_text())
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0
        assert process.stderr.read() == ""
    finally:
        process.kill()
        process.communicate()
    arguments = " ".join(viewer["arguments"])
    assert "--bind 127.0.0.1" in arguments
    assert arguments.endswith(str(out / "recording.rrd"))
    # So that rerun sends no statistics, and asks nobody for a newer version.
    assert viewer["environment"]["CI"] == "1"
    assert viewer["environment"]["HTTPS_PROXY"].startswith("http://127.0.0.1")
    # The viewer itself is a child of rerun's command; an ended one may wait for its reaper.
    state = Path(f"/proc/{viewer['child']}/stat")
    assert not state.exists() or state.read_text().split()[2] == "Z"


def test_on_windows_the_viewer_s_tree_is_ended(monkeypatch):
    """Without groups of processes, and signals to them."""
    ended = []

    def run(words, **_):
        ended.append(words)
        process.kill()

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(os, "killpg")
    monkeypatch.setattr(native.subprocess, "run", run)
    with native.viewer_process("--version") as process:
        pass
    assert ended == [["taskkill", "/F", "/T", "/PID", str(process.pid)]]
    assert process.returncode is not None


@pytest.mark.parametrize(
    ("more", "script", "words"),
    [
        (
            (),
            "print('earlier'); print('no display: DISPLAY is not set'); raise SystemExit(3)",
            ("status 3: no display: DISPLAY is not set", "--web"),
        ),
        slow(
            ("--web",),
            "print('compiled without web_viewer'); raise SystemExit(2)",
            ("compiled without web_viewer",),
        ),
    ],
    ids=["no window", "no web viewer"],
)
def test_a_viewer_that_cannot_open_says_what_else_can(out, stub, more, script, words):
    environment = ENVIRONMENT | stub(script)
    options = {"capture_output": True, "text": True, "env": environment}
    done = subprocess.run(command(out, *more), check=False, **options)
    assert (done.returncode, done.stdout) == (2, "")
    assert all(word in done.stderr for word in words)


@pytest.mark.slow
def test_reruns_own_server_answers_this_machine_alone_and_ends_with_the_command(out):
    process = subprocess.Popen(
        command(out, "--web"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A browser that shows nothing.
        env=ENVIRONMENT | {"BROWSER": "true"},
    )
    try:
        url = urlsplit(process.stdout.readline().strip())
        # The page, and the recording's stream, whose address is in the page's own.
        ports = [url.port, int(re.search(r"localhost%3A(\d+)", url.query)[1])]
        assert [is_open("127.0.0.1", port) for port in ports] == [True, True]
        # A server on all addresses would answer at the other loopback addresses, too.
        assert not any(is_open("127.0.0.2", port) for port in ports)
        # The browser, which starts once the address is printed, ends at once: Ctrl-C is for what
        # waits after it, and Python warns of a process that it leaves.
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
        # The kernel may close a server's connections after its process has ended.
        ended = time.monotonic()
        while any(is_open("127.0.0.1", port) for port in ports):
            assert time.monotonic() < ended + 10.0
            time.sleep(0.1)
        assert "Traceback" not in process.stderr.read()
    finally:
        process.kill()
        process.communicate()
