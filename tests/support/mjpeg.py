"""A network camera on the loopback: numbered JPEG pictures over HTTP, and what it knows of each."""

import base64
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

from visioncal.core.types import Image

# Bits of a number, dark or light in blocks along the picture's upper edge, a tenth of it high.
_BITS, _HIGH = 16, 10


def with_number(image: Image, number: int) -> Image:
    """Writes a number into a grey picture so that it survives JPEG."""
    height, width = image.shape
    bits = (number >> np.arange(_BITS) & 1).astype(np.uint8)
    edges = np.linspace(0, width, _BITS + 1).astype(int)
    image = image.copy()
    image[: height // _HIGH] = np.repeat(255 * bits, np.diff(edges))
    return image


def number_of(image: Image) -> int:
    """Reads it."""
    height, width = image.shape[:2]
    middles = ((np.arange(_BITS) + 0.5) * width / _BITS).astype(int)
    bits = image[height // (2 * _HIGH), middles].reshape(_BITS, -1)[:, 0] > 127
    return int(bits @ (1 << np.arange(_BITS)))


@dataclass(eq=False)
class NetworkCamera:
    """What a camera sends to whoever asks, and what may befall it."""

    draw: Callable[[], Image]  # Draws what the camera sees, (h, w) grey.
    period_s: float = 0.02  # From one picture to the next [s].
    password: str = ""  # `user:password` that it asks for; empty for none.
    cut: tuple[int, ...] = ()  # Numbers of pictures that it sends half.
    # When each picture was drawn, by its number, on the monotonic clock [s].
    drawn_s: list[float] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def parts(self) -> Iterator[bytes]:
        """The parts of the answer, at the camera's pace."""
        due_s = time.monotonic()
        while not self.ended.is_set():
            time.sleep(max(due_s - time.monotonic(), 0.0))
            due_s += self.period_s
            yield self._part(len(self.drawn_s))

    def _part(self, number: int) -> bytes:
        drawn_s = time.monotonic()
        _, jpeg = cv2.imencode(".jpg", with_number(self.draw(), number))
        self.drawn_s.append(drawn_s)
        content = jpeg.tobytes()
        if number in self.cut:
            content = content[: len(content) // 2]
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(content)}\r\n\r\n"
        return head.encode() + content + b"\r\n"


@contextmanager
def served(camera: NetworkCamera) -> Iterator[str]:
    """Serves a camera for as long as the block lasts, at the URL that is given."""
    connections: list[socket.socket] = []

    class Handler(BaseHTTPRequestHandler):
        def setup(self) -> None:
            """Keeps the connection, to cut it in the end."""
            super().setup()
            connections.append(self.connection)

        def do_GET(self) -> None:
            """Answers with pictures until the client or the camera ends."""
            expected = f"Basic {base64.b64encode(camera.password.encode()).decode()}"
            if camera.password and self.headers.get("Authorization") != expected:
                self.send_response(401)
                self.send_header("WWW-Authenticate", 'Basic realm="camera"')
                self.end_headers()
                return
            self.send_response(200)
            kind = "multipart/x-mixed-replace; boundary=frame"
            self.send_header("Content-Type", kind)
            self.end_headers()
            with suppress(OSError):
                for part in camera.parts():
                    self.wfile.write(part)

        def log_message(self, *_: object) -> None:
            """Says nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    # A daemon that encodes while the interpreter ends would abort it: threads are waited for.
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/stream"
    finally:
        camera.ended.set()
        server.shutdown()
        # A picture that is under way to nobody must not be waited for.
        for connection in connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        server.server_close()
        thread.join()
