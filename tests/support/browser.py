"""A headless Chromium that tests look through: what a page asks for, and how it looks."""

import base64
import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_FLAGS = [
    "--headless",
    "--no-sandbox",
    # A software rasteriser, which machines without a graphics card have too.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--window-size=1100,700",
    "--remote-debugging-pipe",
]


class Page:
    """A page, by Chrome's DevTools protocol over two pipes."""

    def __init__(self, reader: int, writer: int) -> None:
        self._reader, self._writer = os.fdopen(reader, "rb"), os.fdopen(writer, "wb")
        self._number, self._session = 0, ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        self.call("Page.enable")

    def visit(self, url: str) -> None:
        """Goes to a page and waits for its files to be loaded."""
        self.call("Page.navigate", url=url)
        while self._receive().get("method") != "Page.loadEventFired":
            pass

    def call(self, method: str, **params: object) -> dict:
        """Calls a method of the protocol and waits for its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        message |= {"sessionId": self._session} if self._session else {}
        self._writer.write(json.dumps(message).encode() + b"\0")
        self._writer.flush()
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _receive(self) -> dict:
        data = bytearray()
        while (byte := self._reader.read(1)) != b"\0":
            assert byte, "Chromium ended"
            data += byte
        return json.loads(data)

    def close(self) -> None:
        """Closes the pipes."""
        self._reader.close()
        self._writer.close()

    def picture(self) -> np.ndarray:
        """Takes a picture of the page as it is, (h, w, 3) blue, green, red."""
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)

    def printed(self) -> bytes:
        """The PDF that printing the page gives."""
        return base64.b64decode(self.call("Page.printToPDF", preferCSSPageSize=True)["data"])


@contextmanager
def chromium(profile: Path) -> Iterator[Page]:
    """Starts Chromium with an empty page; `profile` is a folder of its own."""
    to_read, to_write = os.pipe(), os.pipe()
    command = [CHROMIUM, *_FLAGS, f"--user-data-dir={profile}"]
    # Chromium reads from descriptor 3 and writes to descriptor 4.
    shell = f"exec {shlex.join(command)} 3<&{to_write[0]} 4>&{to_read[1]}"
    process = subprocess.Popen(
        ["bash", "-c", shell],
        pass_fds=(to_write[0], to_read[1]),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(to_write[0])
    os.close(to_read[1])
    page = None
    try:
        page = Page(to_read[0], to_write[1])
        yield page
    finally:
        process.kill()
        process.wait()
        if page is not None:
            page.close()
