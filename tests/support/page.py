"""The page of a command, as a process of its own, and headless browsers before it."""

import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest
from support import played
from support.browser import CHROMIUM

# Longer than anything takes that comes at all, beside other suites, too [ms].
PATIENT_MS = 90_000


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


class Process(subprocess.Popen):
    """A command, whose words are kept in a file."""

    def __init__(self, words, output, **others):
        self._output = output
        super().__init__(words, stdout=output, stderr=subprocess.STDOUT, **others)

    def said(self) -> str:
        """All that the terminal shows so far."""
        return Path(self._output.name).read_text("utf-8")


@contextmanager
def served(*words: object, host: str = "127.0.0.1", folder: Path | None = None):
    """The page of a command: the address that its terminal shows, and its process."""
    address = f"{host}:{free_port()}"
    words = [sys.executable, played.__file__, *map(str, words), "--page", "--address", address]
    # NiceGUI would take the process for a test of itself.
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"
    }
    with tempfile.NamedTemporaryFile("w+", suffix=".txt") as output:
        process = Process(words, output, env=environment, cwd=folder, text=True)
        try:
            for _ in range(300):
                assert process.poll() is None, process.said()
                try:
                    urllib.request.urlopen(f"http://{address}/live.jpg").close()
                    break
                except urllib.error.HTTPError as refusal:
                    # It answers, though not everybody.
                    refusal.close()
                    break
                except OSError:
                    time.sleep(0.1)
            yield re.search(r"at (http://\S+?)[;.]?\s", process.said())[1], process
        finally:
            process.kill()
            process.wait()
            assert "Traceback" not in process.said(), process.said()


@contextmanager
def launched():
    """A Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as play:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        browser = play.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()


@contextmanager
def opened(browser, url: str):
    """A page with a short patience, whose own errors fail the test, as do those that it opens.

    So do dialogs, and contents that its policy forbids.
    """
    context = browser.new_context(viewport={"width": 1300, "height": 1000})
    context.set_default_timeout(PATIENT_MS)
    faults = []

    def on_dialog(dialog):
        faults.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    def wrote(message):
        # A page whose process was killed says that it cannot be reached.
        is_lost = "net::ERR" in message.text or "WebSocket connection" in message.text
        if message.type == "error" and not is_lost:
            faults.append(message.text)

    context.on("weberror", lambda error: faults.append(str(error.error)))
    context.on("dialog", on_dialog)
    context.on("console", wrote)
    page = context.new_page()
    page.goto(url)
    try:
        yield page
    finally:
        # One that stays asks for its process, and draws its pictures, for ever.
        context.close()
    assert not faults, faults


def choose(page, label: str, words: str) -> None:
    """Types words into the field of a label."""
    field = page.get_by_label(label, exact=True)
    field.click()
    field.fill(words)
    field.press("Enter")
