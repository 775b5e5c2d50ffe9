"""Shows a recording in a browser, from a server that only this machine reaches.

Rerun's own server listens to the whole network, and its page requests fonts and news from other
servers. This one serves a fixed set of names, with a page that loads nothing from elsewhere.
"""

import re
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from visioncal.core.errors import DataError, DriverError
from visioncal.core.files import read_bytes
from visioncal.present.recording import paths
from visioncal.present.viewer.process import until_interrupted, viewer_process

_HOST = "127.0.0.1"
_PAGE, _STYLE, _STARTER, _RECORDING = "review.html", "review.css", "review.js", "recording.rrd"
_REPORT = "report.html"
_HTML, _JAVASCRIPT = "text/html; charset=utf-8", "text/javascript; charset=utf-8"
_HEADERS = {
    "Content-Security-Policy": "; ".join(
        (
            "default-src 'none'",
            "script-src 'self' 'wasm-unsafe-eval'",
            f"connect-src 'self' http://{_HOST}:*",
            # The viewer styles its canvas itself, and shows generated pictures.
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    # Another recording may have the same address later.
    "Cache-Control": "no-store",
}
SCRIPT, MODULE = "re_viewer.js", "re_viewer_bg.wasm"
_PATIENCE_S = 30.0
_SERVING = re.compile(r"Hosting a web-viewer at http://127\.0\.0\.1:(\d+)")
# With the URL of a recording, rerun only serves the viewer's files; nothing fetches it.
_NO_RECORDING = "http://127.0.0.1/none.rrd"


@dataclass(frozen=True)
class _Route:
    """Content of one path.

    Attributes:
        media_type: Media type.
        source: The bytes, or the file that is read for each request.
    """

    media_type: str
    source: bytes | Path

    def open(self) -> tuple[BinaryIO, int]:
        """Opens the content: (stream, length in bytes)."""
        if isinstance(self.source, bytes):
            return BytesIO(self.source), len(self.source)
        file = self.source.open("rb")
        return file, self.source.stat().st_size


def review_web(
    recording: Path, port: int, opened: Callable[[str], None], row: int | None = None
) -> None:
    """Serves a recording with the viewer to this machine, until Ctrl-C or SIGTERM.

    Args:
        recording: The `.rrd`.
        port: Port to listen on; 0 for any free port.
        opened: Called with the page's URL once it is available.
        row: Row of the view to open it at; None for the first.

    Raises:
        DataError: The port cannot be used.
        DriverError: Rerun's command does not serve its web viewer.
    """
    with until_interrupted(), _server(_routes(recording), port) as server:
        fragment = "" if row is None else f"#when={paths.TIMELINE}@{row}"
        opened(f"http://{_HOST}:{server.server_port}/{fragment}")
        server.serve_forever()


def _routes(recording: Path) -> dict[str, _Route]:
    """All served paths; a request is never turned into a file path."""
    page_files = {
        name: read_bytes(Path(__file__).with_name(name)) for name in (_PAGE, _STYLE, _STARTER)
    }
    assets = _viewer_assets()
    report = recording.with_name(_REPORT)
    # The notes of the views link to it.
    report_route = {f"/{_REPORT}": _Route(_HTML, report)} if report.is_file() else {}
    return report_route | {
        "/": _Route(_HTML, page_files[_PAGE]),
        f"/{_STYLE}": _Route("text/css; charset=utf-8", page_files[_STYLE]),
        f"/{_STARTER}": _Route(_JAVASCRIPT, page_files[_STARTER]),
        f"/{SCRIPT}": _Route(_JAVASCRIPT, assets[SCRIPT]),
        f"/{MODULE}": _Route("application/wasm", assets[MODULE]),
        f"/{_RECORDING}": _Route("application/octet-stream", recording),
    }


def _server(routes: Mapping[str, _Route], port: int) -> ThreadingHTTPServer:
    try:
        # Threads, as browsers keep idle connections open.
        return _Server((_HOST, port), partial(_Handler, routes))
    except OSError as error:
        raise DataError(
            f"port {port} of {_HOST} cannot be used: {error.strerror or error}.",
            next_step="Choose another --port; 0 takes one that is free.",
        ) from error


class _Server(ThreadingHTTPServer):
    """A server that ignores connections closed by the browser."""

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - its interface
        """Reports errors of a request other than a closed connection."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request from the routes."""

    server_version = "visioncal"
    sys_version = ""

    def __init__(self, routes: Mapping[str, _Route], *arguments: object) -> None:
        self._routes = routes
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def do_HEAD(self) -> None:
        """Sends what `do_GET` would, without the content."""
        self._answer(with_content=False)

    def _answer(self, *, with_content: bool) -> None:
        if not self._is_own_host():
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        route = self._routes.get(self.path)
        if route is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        try:
            stream, length = route.open()
        except OSError:
            self.send_error(HTTPStatus.GONE)
            return
        with stream:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", route.media_type)
            self.send_header("Content-Length", str(length))
            self.end_headers()
            if with_content:
                shutil.copyfileobj(stream, self.wfile)

    def _is_own_host(self) -> bool:
        """Whether the request's host is the page's own address."""
        # Through another name, a foreign page could read this server in the browser (DNS
        # rebinding).
        port = self.connection.getsockname()[1]
        return self.headers.get("Host", "") in (f"{_HOST}:{port}", f"localhost:{port}")

    def end_headers(self) -> None:
        """Adds the headers common to all answers."""
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Suppresses log output."""


def _viewer_assets() -> Mapping[str, bytes]:
    """Script and module of the web viewer, by name."""
    # Rerun's command serves them on this machine, for about a quarter of a second.
    arguments = ("--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", "0", _NO_RECORDING)
    with viewer_process(*arguments) as process:
        output: list[str] = []
        for line in process.stdout or ():
            output.append(line.strip())
            if serving := _SERVING.search(line):
                return {name: _fetch(int(serving[1]), name) for name in (SCRIPT, MODULE)}
    raise _unserved(" ".join(output[-1:]) or "it said nothing")


def _fetch(port: int, name: str) -> bytes:
    # Not urllib, which would use a proxy from the environment.
    connection = HTTPConnection("127.0.0.1", port, timeout=_PATIENCE_S)
    try:
        connection.request("GET", f"/{name}")
        response = connection.getresponse()
        content = response.read()
    except (OSError, HTTPException) as error:
        raise _unserved(f"{name}: {error}") from error
    finally:
        connection.close()
    if response.status != 200:
        raise _unserved(f"{name}: HTTP status {response.status}")
    return content


def _unserved(reason: str) -> DriverError:
    return DriverError(
        f"rerun's command does not hand out its web viewer: {reason}.",
        next_step="Install rerun-sdk again, or leave out --web for the native viewer.",
    )
