"""Pictures as network cameras send them over HTTP: JPEG files one after the other, without end."""

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
# How long it may take to answer, and how long it may then send nothing before it is given up [s].
_SILENT_S = 5.0
# More than any picture, and any line of a header, has [B].
_PICTURE_B, _LINE_B = 1 << 27, 1 << 16
_HEADERS = 100
_BEGINS, _ENDS = b"\xff\xd8", b"\xff\xd9"


def without_password(url: str) -> str:
    """A URL as it may be shown and kept: without user and password."""
    scheme, found, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{found}{authority.rpartition('@')[2]}{slash}{path}" if found else url


def open_multipart(url: str) -> "MultipartPictures | None":
    """Opens a stream of JPEG files; None where the URL answers with something else.

    Args:
        url: Of http or https, with user and password in it where the camera asks for them.

    Raises:
        DriverError: It does not answer, or refuses.
    """
    shown = without_password(url)
    try:
        response = _opener(url).open(shown, timeout=_SILENT_S)
    except urllib.error.HTTPError as error:
        error.close()
        raise _refused(shown, error) from None
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
    # A camera of the cell is reached directly, and signs its certificate itself.
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
    """Closes an answer that asks for a password, before the handlers that ask again with one."""

    handler_order = 100

    def http_error_401(
        self,
        request: urllib.request.Request,  # noqa: ARG002
        response: http.client.HTTPResponse,
        *_: object,
    ) -> None:
        """Is called with such an answer; what comes next is left to others."""
        response.close()


def _refused(shown: str, error: urllib.error.HTTPError) -> DriverError:
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
    """A source of JPEG files out of an answer of the kind multipart/x-mixed-replace.

    They are read and not decoded, so that this keeps pace with any network.

    Args:
        response: The answer, of which nothing was read yet.
        boundary: What stands between its parts, without dashes.
        name: Where it is from, for people.
    """

    def __init__(self, response: http.client.HTTPResponse, boundary: bytes, name: str) -> None:
        self._response, self._boundary, self._name = response, boundary, name
        # Closing it while another thread reads would wait for that thread; this wakes it.
        self._line = socket.socket(fileno=os.dup(response.fileno()))
        self._jpeg = b""

    def grab(self) -> Arrival:
        """Waits for the next whole picture; it is stamped when its first bytes come.

        Raises:
            DriverError: The stream is at its end, sends nothing for long, or other things.
        """
        try:
            came_s, self._jpeg = self._part()
            while not self._jpeg.rstrip(b"\r\n\0").endswith(_ENDS):
                came_s, self._jpeg = self._part()
        except TimeoutError as error:
            raise self._ended(f"sent nothing for {_SILENT_S:g} s") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise self._ended(f"is lost: {error}") from error
        return Arrival(came_s)

    def take(self) -> bytes:
        """Returns the file of the picture that was grabbed last."""
        return self._jpeg

    def interrupt(self) -> None:
        """Ends the connection."""
        try:
            self._line.shutdown(socket.SHUT_RDWR)
        except OSError:
            # It has ended already.
            return

    def close(self) -> None:
        """Lets go of the connection."""
        self._response.close()
        self._line.close()

    def _part(self) -> tuple[float, bytes]:
        """The next part, and when its first bytes came."""
        size = self._size()
        begins = self._response.read(len(_BEGINS))
        came_s = time.monotonic()
        if begins != _BEGINS:
            raise self._ended(
                "closed the stream" if not begins else "sends something else than JPEG"
            )
        if size is not None:
            return came_s, begins + self._response.read(size - len(begins))
        parts, length = [begins], len(begins)
        while not self._is_boundary(line := self._read_line()):
            parts.append(line)
            length += len(line)
            if length > _PICTURE_B:
                raise self._ended("sends pictures without end")
        return came_s, b"".join(parts)

    def _size(self) -> int | None:
        """Reads up to where a part's content begins; its size, where it is stated [B]."""
        size, has_headers = None, False
        for _ in range(_HEADERS):
            line = self._read_line().strip()
            name, found, value = line.partition(b":")
            if found:
                has_headers = True
                if name.strip().lower() == b"content-length":
                    size = int(value)
            elif not line and has_headers:
                if size is not None and not len(_BEGINS) < size < _PICTURE_B:
                    raise self._ended(f"states {size} bytes for a picture")
                return size
        raise self._ended("sends no pictures")

    def _read_line(self) -> bytes:
        line = self._response.readline(_LINE_B)
        if not line:
            raise self._ended("closed the stream")
        return line

    def _is_boundary(self, line: bytes) -> bool:
        # Some state it with its dashes, and some send it without.
        return bool(self._boundary) and line.strip().strip(b"-") == self._boundary

    def _ended(self, how: str) -> DriverError:
        return DriverError(
            f"The camera {self._name} gives no more pictures: it {how}.",
            culprits=[self._name],
            next_step="Look at its power and its network; then go on with --resume.",
        )
