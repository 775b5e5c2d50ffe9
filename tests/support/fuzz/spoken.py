"""What is said to a running command: lines on its stdin, a robot's program, requests of a browser.

Makers of what is sound, and those who say it, whatever was made of it.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from support.commands import Done

from visioncal.session import Session

# What parts the requests in a file.
BETWEEN = b"\n%%%\n"
# How long an answer may take [s]; longer than any that comes.
_PATIENT_S = 60.0
_SOCKET_IO = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"


def kuka(pose: np.ndarray) -> str:
    """A pose as a KUKA's pendant shows it."""
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
    numbers = zip("XYZABC", [*(1e3 * pose[:3, 3]), *angles], strict=True)
    return " ".join(f"{name} {value:.4f}" for name, value in numbers)


def _poses(folder: Path) -> list[np.ndarray]:
    return [view.base_from_flange().as_matrix() for view in Session.load(folder).views]


def write_typed(path: Path, folder: Path) -> None:
    """Poses as a person types them, a line each."""
    path.write_text("".join(f"{kuka(pose)}\n" for pose in _poses(folder)), "utf-8")


def write_stops(path: Path, folder: Path) -> None:
    """What a robot's program sends, a line a stop."""
    lines = (f"{at} | {kuka(pose)}\n" for at, pose in enumerate(_poses(folder), 1))
    path.write_text("".join(lines), "utf-8")


def write_requests(path: Path, _: Path) -> None:
    """What a browser asks of a page, in whole requests."""
    head = "HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nConnection: close\r\n"
    origin = "Origin: http://127.0.0.1:PORT\r\n"
    said = '42["handshake",{"client_id":"1","tab_id":"2","next_message_id":0}]'
    requests = [
        f"GET / {head}\r\n",
        f"GET /live.jpg {head}Accept: image/jpeg\r\n\r\n",
        f"GET /report {head}Cookie: a=b\r\nRange: bytes=0-9\r\n\r\n",
        f"GET /_nicegui/3/static/nicegui.css {head}If-None-Match: \"x\"\r\n\r\n",
        f"GET {_SOCKET_IO} {head}{origin}\r\n",
        f"POST {_SOCKET_IO}&sid=1 {head}{origin}Content-Length: {len(said)}\r\n\r\n{said}",
        f"GET {_SOCKET_IO.replace('polling', 'websocket')} HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n"
        f"{origin}Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
    ]  # fmt: skip
    path.write_bytes(BETWEEN.join(each.encode() for each in requests))


def write_checks(path: Path, _: Path) -> None:
    """A folder of earlier checks, beside which a page remembers what was chosen."""
    check = {"passed": True, "sentences": ["It is valid."], "created": "2026-11-20T10:00:00+00:00"}
    (path / "2026-11-20-out-verified").mkdir(parents=True)
    (path / "2026-11-20-out-verified" / "verify.json").write_text(json.dumps(check), "utf-8")
    setup = {"arm": "manual", "camera": "folder:nothing", "pose_form": "kuka", "against": "out"}
    (path / "page.json").write_text(json.dumps(setup), "utf-8")


def free_port() -> int:
    """A port at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def robot_says(lines: bytes, port: int) -> Iterator[None]:
    """Sends lines, each after the answer to the last, from a thread; at the end that it ends."""
    is_over = threading.Event()

    def talk() -> None:
        link = None
        for line in [*lines.split(b"\n")[:40], b"end"]:
            for _ in range(600):
                if is_over.is_set():
                    return
                try:
                    link = link or socket.create_connection(("127.0.0.1", port), timeout=1.0)
                    link.sendall(line + b"\n")
                    # A line of nothing has no answer.
                    if not line.strip(b" \t\r\n\0") or link.recv(500):
                        break
                except TimeoutError:
                    break
                except OSError:
                    time.sleep(0.1)
                link = None
        # The last answer has come, and others wait until the link is closed.
        with suppress(OSError):
            if link is not None:
                link.close()

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join(5.0)


def _asked(port: int, request: bytes, patience_s: float = _PATIENT_S) -> bytes:
    """The answer to a request; empty where the link was closed without one, or none came."""
    with (
        socket.create_connection(("127.0.0.1", port), timeout=patience_s) as link,
        suppress(OSError),
    ):
        link.sendall(request)
        return link.recv(1 << 16)
    return b""


def served(words: Sequence[str], requests: bytes, port: int) -> tuple[Done, list[str]]:
    """Serves a page by a process, sends it requests, and ends it: how, and what is wrong with it.

    It has to answer a sound request at the end, and is ended by Ctrl-C.
    """
    # NiceGUI would take the process for a test of itself.
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"
    }
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "visioncal", *words],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    sound = (
        f"GET /live.jpg HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode()
    )
    faults: list[str] = []
    try:
        while process.poll() is None:
            with suppress(OSError):
                _asked(port, sound)
                break
            time.sleep(0.1)
        for request in requests.replace(b"PORT", str(port).encode()).split(BETWEEN)[:20]:
            if process.poll() is None:
                # What is not whole is waited for by both.
                _asked(port, request, 0.3)
        if process.poll() is None:
            answer = _asked(port, sound)
            if not re.match(rb"HTTP/1.1 200", answer):
                faults.append(f"after that a sound request was answered {answer[:100]!r}")
            process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=_PATIENT_S)
    finally:
        process.kill()
        process.wait()
    if "Traceback" in out + err:
        faults.append(f"traceback: {(out + err)[-3000:]}")
    return Done(process.returncode, out, err), faults
