"""Streams of JPEG files over HTTP, as network cameras send them (MJPEG)."""

import http.client
import os
import socket
import ssl
import time
import urllib.error
import urllib.request
from urllib.parse import unquote, urlsplit

from visioncal.core.errors import DriverError
from visioncal.live.drivers.newest import Arrival

UNREACHED = (
    "Look at its address, its power and its network: does another player on this computer show its "
    "pictures?"
)
# Timeout of the answer, and of silence afterwards [s].
_TIMEOUT_S = 5.0
# Upper bounds of a picture, and of a line of a header [B].
_PICTURE_B, _LINE_B = 1 << 27, 1 << 16
_MAX_HEADER_LINES = 100
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def without_password(url: str) -> str:
    """A URL without user and password, to be shown and stored."""
    scheme, separator, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{separator}{authority.rpartition('@')[2]}{slash}{path}" if separator else url


def open_multipart(url: str) -> "MultipartPictures | None":
    """Opens a stream of JPEG files; None where the URL answers with something else.

    User and password are part of the URL where the camera requires them.

    Raises:
        DriverError: It does not answer, or refuses.
    """
    shown = without_password(url)
    try:
        response = _opener(url).open(shown, timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        error.close()
        raise _refused_error(shown, error) from None
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise DriverError(
            f"The camera {shown} cannot be opened: {getattr(error, 'reason', error)}.",
            culprits=[shown],
            next_step=UNREACHED,
        ) from error
    if response.headers.get_content_type() != "multipart/x-mixed-replace":
        response.close()
        return None
    boundary = response.headers.get_boundary("")
    return MultipartPictures(response, boundary.strip("-").encode("latin-1", "replace"), shown)


def _opener(url: str) -> urllib.request.OpenerDirector:
    # A camera of the cell is reached without a proxy, and has a self-signed certificate.
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    words = urlsplit(url)
    passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    if words.username is not None:
        user, password = unquote(words.username), unquote(words.password or "")
        passwords.add_password(None, without_password(url), user, password)
    return urllib.request.build_opener(
        urllib.request.ProxyHandler({}),
        urllib.request.HTTPSHandler(context=context),
        _ClosingRefused(),
        urllib.request.HTTPBasicAuthHandler(passwords),
        urllib.request.HTTPDigestAuthHandler(passwords),
    )


class _ClosingRefused(urllib.request.BaseHandler):
    """Closes an answer that requires a password, before the handlers that repeat the request."""

    handler_order = 100

    def http_error_401(
        self,
        request: urllib.request.Request,  # noqa: ARG002
        response: http.client.HTTPResponse,
        *_: object,
    ) -> None:
        """Closes the answer; other handlers go on."""
        response.close()


def _refused_error(shown: str, error: urllib.error.HTTPError) -> DriverError:
    scheme, _, rest = shown.partition("://")
    asks = error.code == http.HTTPStatus.UNAUTHORIZED
    return DriverError(
        f"The camera {shown} refuses: it answers {error.code} {error.reason}.",
        culprits=[shown],
        next_step=f"Give it the right user and password: {scheme}://USER:PASSWORD@{rest}"
        if asks
        else "Look up the path of its video stream in its manual.",
    )


class MultipartPictures:
    """Source of JPEG files from a multipart/x-mixed-replace response.

    They are read without decoding, which keeps pace with any network.

    Args:
        response: The response, of which nothing was read yet.
        boundary: Separator of its parts, without dashes.
        name: Name of the camera in messages.
    """

    def __init__(self, response: http.client.HTTPResponse, boundary: bytes, name: str) -> None:
        self._response, self._boundary, self._name = response, boundary, name
        # Closing the response while another thread reads would wait for that thread; shutting down
        # this duplicate wakes it.
        self._connection = socket.socket(fileno=os.dup(response.fileno()))
        self._jpeg = b""

    def grab(self) -> Arrival:
        """Waits for the next whole picture, stamped when its first bytes arrive.

        Raises:
            DriverError: The stream ends, times out, or sends anything but pictures.
        """
        try:
            arrived_s, self._jpeg = self._read_part()
            while not self._jpeg.rstrip(b"\r\n\0").endswith(_JPEG_END):
                arrived_s, self._jpeg = self._read_part()
        except TimeoutError as error:
            raise self._ended_error(f"sent nothing for {_TIMEOUT_S:g} s") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise self._ended_error(f"is lost: {error}") from error
        return Arrival(arrived_s)

    def take(self) -> bytes:
        """Returns the file of the last grabbed picture."""
        return self._jpeg

    def interrupt(self) -> None:
        """Ends the connection."""
        try:
            self._connection.shutdown(socket.SHUT_RDWR)
        except OSError:
            # It has ended already.
            return

    def close(self) -> None:
        """Closes the connection."""
        self._response.close()
        self._connection.close()

    def _read_part(self) -> tuple[float, bytes]:
        """Reads the next part, with the time of its first bytes [s]."""
        size = self._read_part_size()
        start = self._response.read(len(_JPEG_START))
        arrived_s = time.monotonic()
        if start != _JPEG_START:
            raise self._ended_error(
                "closed the stream" if not start else "sends something else than JPEG"
            )
        if size is not None:
            return arrived_s, start + self._response.read(size - len(start))
        parts, length = [start], len(start)
        while not self._is_boundary(line := self._read_line()):
            parts.append(line)
            length += len(line)
            if length > _PICTURE_B:
                raise self._ended_error("sends pictures without end")
        return arrived_s, b"".join(parts)

    def _read_part_size(self) -> int | None:
        """Reads a part's headers; returns its size where it is stated [B]."""
        size, has_headers = None, False
        for _ in range(_MAX_HEADER_LINES):
            line = self._read_line().strip()
            name, separator, value = line.partition(b":")
            if separator:
                has_headers = True
                if name.strip().lower() == b"content-length":
                    size = int(value)
            elif not line and has_headers:
                if size is not None and not len(_JPEG_START) < size < _PICTURE_B:
                    raise self._ended_error(f"states {size} bytes for a picture")
                return size
        raise self._ended_error("sends no pictures")

    def _read_line(self) -> bytes:
        line = self._response.readline(_LINE_B)
        if not line:
            raise self._ended_error("closed the stream")
        return line

    def _is_boundary(self, line: bytes) -> bool:
        # Some cameras state it with its dashes, and some send it without.
        return bool(self._boundary) and line.strip().strip(b"-") == self._boundary

    def _ended_error(self, how: str) -> DriverError:
        return DriverError(
            f"The camera {self._name} gives no more pictures: it {how}.",
            culprits=[self._name],
            next_step="Look at its power and its network; then go on with --resume.",
        )
