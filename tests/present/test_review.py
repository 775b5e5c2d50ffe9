"""`visioncal review`: what it opens, who can reach its server, and that nothing stays behind."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from support import browser
from support.commands import visioncal
from support.samples import made_up

from visioncal.interchange.result_files import load_result
from visioncal.present import viewer
from visioncal.present.recording import write_recording
from visioncal.present.viewer import blueprint

ENVIRONMENT = os.environ | {"COLUMNS": "300", "PYTHONWARNINGS": "error", "PYTHONUTF8": "1"}


def command(*arguments) -> list[str]:
    return [sys.executable, "-m", "visioncal", "review", *map(str, arguments)]


def review(*arguments, **environment) -> subprocess.CompletedProcess:
    return subprocess.run(
        command(*arguments),
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
        env=ENVIRONMENT | environment,
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """A folder as `visioncal calibrate` leaves it, of which only the recording matters here."""
    sample = made_up()
    folder = tmp_path_factory.mktemp("out put, größer")
    layout = blueprint(sample.session, sample.calibration)
    write_recording(
        folder / "recording.rrd", sample.session, sample.calibration, sample.evidence, layout
    )
    return folder


@contextmanager
def served(*arguments) -> Iterator[tuple[subprocess.Popen, str]]:
    """Runs the command with --web; gives its process and the URL that it prints."""
    process = subprocess.Popen(
        command(*arguments, "--web", "--no-open"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


def ask(url: str, path: str, method: str = "GET", **headers: str) -> tuple[int, dict, bytes]:
    """Asks for a path exactly as it is written."""
    connection = HTTPConnection(urlsplit(url).netloc, timeout=60)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def is_open(host: str, port: int) -> bool:
    with socket.socket() as connection:
        connection.settimeout(60)
        return connection.connect_ex((host, port)) == 0


def children(process: subprocess.Popen) -> str:
    return "".join(
        path.read_text() for path in Path(f"/proc/{process.pid}/task").glob("*/children")
    )


def test_what_cannot_be_reviewed_is_refused_with_the_next_step(tmp_path):
    session, empty, other = (tmp_path / name for name in ("session", "empty", "other.rrd"))
    session.mkdir()
    (session / "session.toml").write_text("schema = 1\n")
    empty.mkdir()
    other.write_text("no recording")
    for path, words in (
        (session, f"visioncal calibrate {session} -o OUT"),
        (empty, "holds no recording.rrd"),
        (other, "first bytes"),
        (tmp_path / "nowhere.rrd", "does not exist"),
    ):
        done = visioncal("review", path)
        assert done.status == 2
        assert words in done.err


def test_it_opens_at_the_worst_view_or_at_the_named_one(out, monkeypatch):
    opened = []
    monkeypatch.setattr(viewer, "review_native", lambda _, row: opened.append(row))
    views = load_result(out / "recording.rrd").views
    assert visioncal("review", out).status == 0
    worst = views[opened[0]]
    assert not worst.used
    assert worst.residual_mm == max(view.residual_mm or 0.0 for view in views)
    # Views are numbered as the session says, and stand in its order.
    assert visioncal("review", out, "--view", views[3].view).status == 0
    assert opened[1] == 3
    refused = visioncal("review", out, "--view", "99")
    assert refused.status == 2
    assert "no view 99" in refused.err


def test_options_of_the_server_belong_to_it(out):
    done = visioncal("review", out, "--port", "8080")
    assert done.status == 2
    assert "--web" in done.err


def test_a_port_that_is_taken_is_named(out):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = visioncal("review", out, "--web", "--no-open", "--port", port)
    assert done.status == 2
    assert f"port {port}" in done.err
    assert done.out == ""


def test_the_server_hands_out_the_page_the_viewer_and_the_recording(out):
    with served(out / "recording.rrd") as (_, url):
        contents = {}
        for path, media_type in (
            ("/", "text/html; charset=utf-8"),
            ("/review.js", "text/javascript; charset=utf-8"),
            ("/re_viewer.js", "text/javascript; charset=utf-8"),
            ("/re_viewer_bg.wasm", "application/wasm"),
            ("/recording.rrd", "application/octet-stream"),
        ):
            status, headers, contents[path] = ask(url, path)
            assert status == 200
            assert headers["Content-Type"] == media_type
            assert int(headers["Content-Length"]) == len(contents[path])
            status, head, nothing = ask(url, path, "HEAD")
            assert (status, nothing) == (200, b"")
            assert head["Content-Length"] == headers["Content-Length"]
    assert contents["/recording.rrd"] == (out / "recording.rrd").read_bytes()
    assert contents["/re_viewer_bg.wasm"].startswith(b"\0asm")
    assert b"http" not in contents["/"]


def test_the_server_answers_nobody_and_nothing_else(out):
    with served(out) as (process, url):
        port = urlsplit(url).port
        assert urlsplit(url).hostname == "127.0.0.1"
        # A server on all addresses would answer at the other loopback addresses too.
        assert not is_open("127.0.0.2", port)
        for path in (
            "/../recording.rrd",
            "/..%2frecording.rrd",
            "//etc/passwd",
            "/etc/passwd",
            "/recording.rrd/../../etc/passwd",
            "/recording.rrd?x",
            "/session.toml",
            f"http://127.0.0.1:{port}/etc/passwd",
        ):
            status, headers, _ = ask(url, path)
            assert status == 404, path
            assert "connect-src 'self' http://127.0.0.1:*" in headers["Content-Security-Policy"]
        assert ask(url, "/", Host="attacker.example")[0] == 421
        assert ask(url, "/", "POST")[0] == 501
        _, headers, _ = ask(url, "/")
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        # Rerun's own server, which gave us its viewer, has ended.
        assert children(process) == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_server_ends_with_status_0_and_frees_its_port(number, out):
    with served(out) as (process, url):
        port = urlsplit(url).port
        assert is_open("127.0.0.1", port)
        # A browser keeps a connection in reserve, which must not hold the end up.
        with socket.create_connection(("127.0.0.1", port)):
            process.send_signal(number)
            assert process.wait(timeout=60) == 0
        assert not is_open("127.0.0.1", port)
        assert "Traceback" not in process.stderr.read()


@pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed here")
def test_a_browser_draws_it_and_asks_nobody_else(out, tmp_path):
    def drawn(picture: np.ndarray) -> bool:
        height, half = picture.shape[0], picture.shape[1] // 2
        cell, image = picture[100 : 2 * height // 3, :half], picture[height // 3 :, half:]
        # The robot is shaded; panels that are empty or hold words have under 700 colours. The
        # ground of the sample's images is grey 150.
        shaded = len(np.unique(cell.reshape(-1, 3), axis=0)) > 1000
        return shaded and bool(np.mean(np.all(np.abs(image.astype(int) - 150) < 4, axis=2)) > 0.1)

    def moved(now: np.ndarray, before: np.ndarray) -> bool:
        # The words about the view, at the lower right.
        height, width = now.shape[:2]
        part = np.s_[6 * height // 7 : -40, width // 2 :]
        return bool(np.mean(np.any(now[part] != before[part], axis=2)) > 0.005)

    with served(out) as (process, url):
        with browser.chromium(tmp_path / "profile") as page:
            assert not drawn(page.picture())
            page.visit(url)
            picture = page.picture_once(drawn, patience_s=90)
            # The viewer goes where the address says.
            page.call("Runtime.evaluate", expression="location.hash = '#when=view@0'")
            elsewhere = page.picture_once(lambda value: moved(value, picture), patience_s=120)
            requested = page.requested
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0
    assert drawn(picture)
    server = url.partition("#")[0]
    assert f"{server}recording.rrd" in requested
    assert [name for name in requested if not name.startswith((server, "data:", "blob:"))] == []
    assert moved(elsewhere, picture)


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

    def put(script: str) -> dict[str, str]:
        package = tmp_path / "site" / "rerun_cli"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "__main__.py").write_text(script)
        return {"PYTHONPATH": str(package.parent), "TOLD": str(tmp_path / "told.json")}

    return put


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_native_viewer_ends_with_all_that_it_started(number, out, stub, tmp_path):
    told = tmp_path / "told.json"
    process = subprocess.Popen(
        command(out), stderr=subprocess.PIPE, text=True, env=ENVIRONMENT | stub(STUB)
    )
    try:
        end = time.monotonic() + 60
        while not told.exists() and time.monotonic() < end:
            time.sleep(0.05)
        viewer = json.loads(told.read_text())
        process.send_signal(number)
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


def test_a_viewer_that_cannot_open_a_window_points_to_the_browser(out, stub):
    script = "print('earlier'); print('no display: DISPLAY is not set'); raise SystemExit(3)"
    done = review(out, **stub(script))
    assert done.returncode == 2
    assert "status 3: no display: DISPLAY is not set" in done.stderr
    assert "--web" in done.stderr


def test_rerun_without_a_web_viewer_is_an_error_with_a_next_step(out, stub):
    done = review(out, "--web", "--no-open", **stub("print('compiled without web_viewer')"))
    assert done.returncode == 2
    assert "compiled without web_viewer" in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("request_line", [b"", b"GET /", b"GET /recording.rrd HTTP/1.1\r\n"])
def test_a_connection_that_the_browser_resets_is_nothing_to_report(out, request_line):
    with served(out) as (process, url):
        address = urlsplit(url)
        whole = request_line.endswith(b"\n")
        for _ in range(3):
            with socket.create_connection((address.hostname, address.port)) as connection:
                connection.sendall(request_line)
                if whole:
                    connection.sendall(f"Host: {address.netloc}\r\n\r\n".encode())
                    assert connection.recv(1)
                # Closing sends a reset, as a browser does that drops a connection.
                linger = struct.pack("ii", 1, 0)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        # It serves on, and says nothing.
        assert ask(url, "/")[0] == 200
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "Traceback" not in said
    assert "Exception" not in said
