"""Who may ask the page, and what a browser may run of its answers."""

import re
import secrets
import socket
from asyncio import TimerHandle, Transport
from collections.abc import Callable
from contextlib import suppress
from ipaddress import IPv4Address, IPv6Address, ip_address

import h11
from fastapi.responses import HTMLResponse, Response
from socketio import AsyncServer
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

# A report draws with its own styles and pictures, and runs nothing.
_OF_REPORTS = (
    "default-src 'none'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
# Scripts of the page are the files of NiceGUI and those of its template, which get a nonce. Vue
# compiles the templates of NiceGUI's components in the browser, which needs `unsafe-eval`. NiceGUI,
# Quasar and Tailwind write styles into the page: `unsafe-inline`, for styles alone.
_OF_PAGES = (
    f"{_OF_REPORTS}; script-src 'self' 'nonce-%s' 'unsafe-eval'; connect-src 'self'; "
    "font-src 'self'"
)
# A name, an address, or one of IPv6, and a port.
_HOST = re.compile(r"([\w.-]+|\[[\da-f:.]+\])(:\d{1,5})?", re.ASCII)
# Kinds of packets (Engine.IO, protocol 4); a browser sends none that is binary.
_PACKETS = tuple("0123456")
# How many connections there may be, and how long the head of a request may take [s].
_MOST_CONNECTIONS, _PATIENCE_S = 200, 10.0
# A redirect would bring no cookie where the address was followed from another site.
_WELCOME = '<meta http-equiv="refresh" content="0; url=/">'


class Connection(H11Protocol):  # type: ignore[misc]
    """A connection that does not stay without requests, nor breaks by one, nor is one of too many.

    The recording needs files, too, of which a process has a thousand.
    """

    _timer: TimerHandle | None = None

    def connection_made(self, transport: Transport) -> None:
        """Begins to wait for a request."""
        super().connection_made(transport)
        if len(self.connections) > _MOST_CONNECTIONS:
            transport.abort()
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Reads a request."""
        try:
            super().data_received(data)
        except Exception:  # noqa: BLE001
            # The parser of websockets lets errors out for texts that it does not expect.
            self.transport.abort()
        self._wait()

    def _wait(self) -> None:
        is_waiting = self.conn.their_state is h11.IDLE
        if is_waiting and self._timer is None:
            self._timer = self.loop.call_later(_PATIENCE_S, self.transport.abort)
        elif self._timer is not None and not is_waiting:
            self._timer.cancel()
            self._timer = None


class Admission:
    """Lets the browsers in for which a page is; refuses what other sites' pages ask them to ask.

    A request must name one of the page's hosts, and one by a script or for a websocket must come
    from a page of that host. On a network each browser brings a cookie, too, which it got for a
    token; and any address in numbers is a host there, since nobody else can point it at this one.

    Args:
        host: Address at which the page listens.
        port: Its port.
        invite: Shows the query of the page's address with the next browser's token to who started
            the page; None for a page that no other machine reaches.
    """

    def __init__(self, host: str, port: int, invite: Callable[[str], None] | None) -> None:
        name = socket.gethostname()
        hosts = {host, name, f"{name}.local", "localhost", "127.0.0.1", "[::1]"}
        # Asking for its domain may take seconds where no server answers.
        hosts |= {socket.getfqdn()} if invite else set()
        self._hosts, self._invite = {each.lower() for each in hosts}, invite
        # Browsers send cookies of a host to all of its ports.
        self._name, self._cookie = f"visioncal-{port}", secrets.token_urlsafe(32)
        self.query = self._invited()

    def around(self, asgi: ASGIApp) -> ASGIApp:
        """An application that answers only those who are let in."""

        async def answer(scope: Scope, receive: Receive, send: Send) -> None:
            kind, send, is_gone = scope["type"], _restrained(send), False
            refused = None if kind == "lifespan" else self._refused(HTTPConnection(scope))

            async def heard() -> Message:
                nonlocal is_gone
                message = await receive()
                is_frame = message["type"] == "websocket.receive"
                if is_frame and not (message.get("text") or "").startswith(_PACKETS):
                    return {"type": "websocket.disconnect", "code": 1002}
                is_gone |= message["type"] == "http.disconnect"
                return message

            if refused is None:
                try:
                    await asgi(scope, heard, send)
                except (RuntimeError, KeyError):
                    # Of Starlette and Engine.IO, where nobody waits for the answer any more.
                    if not is_gone:
                        raise
            elif kind == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                await refused(scope, receive, send)

        return answer

    def _invited(self) -> str:
        """A query with a new token, which is shown."""
        query = f"token={secrets.token_urlsafe(32)}"
        if self._invite:
            self._invite(query)
        return query

    def _refused(self, request: HTTPConnection) -> Response | None:
        """The answer to a request that is not for the page; None for one that is."""
        by, is_socket = request.headers, request.scope["type"] == "websocket"
        host, *others = by.getlist("host") or [""]
        match = _HOST.fullmatch(host.lower())
        is_half = not is_socket and "websocket" in by.get("upgrade", "").lower()
        if match is None or others or is_half:
            return Response("The request is broken.", 400)
        is_known = match[1].rstrip(".") in self._hosts or (self._invite and address_of(match[1]))
        page_origin = f"http://{host}"
        is_same_origin = by.get("origin", "" if is_socket else page_origin) in (
            page_origin,
            f"https://{host}",
        )
        fetched = by.get("sec-fetch-site"), by.get("sec-fetch-mode") == "navigate"
        if not is_known or not is_same_origin or fetched == ("cross-site", False):
            return Response("Not from here.", 403)
        if not self._invite or _same(request.cookies.get(self._name, ""), self._cookie):
            return None
        query = request.scope["query_string"].decode("latin-1")
        if request.scope.get("method") != "GET" or not _same(query, self.query):
            return Response("Open the address that the terminal shows; it is good once.", 403)
        self.query = self._invited()
        welcome = HTMLResponse(_WELCOME, headers={"Cache-Control": "no-store"})
        welcome.set_cookie(self._name, self._cookie, httponly=True, samesite="strict")
        return welcome


def refuse_malformed(messages: AsyncServer) -> None:
    """Ends the connection of a browser whose message does not have the form that is expected.

    Errors of the page's own handlers do not arrive here: NiceGUI reports them.

    Args:
        messages: Server of the page's messages (Socket.IO).
    """
    connections = messages.eio
    handle = connections.handlers["message"]

    async def handled(connection: str, message: str | bytes) -> None:
        try:
            await handle(connection, message)
        except Exception:  # noqa: BLE001
            await connections.disconnect(connection)

    # Handlers in tasks of their own would raise where nobody hears.
    messages.async_handlers = False
    connections.on("message", handled)


def address_of(host: str) -> IPv4Address | IPv6Address | None:
    """The address that a host is in numbers; None for a name."""
    with suppress(ValueError):
        return ip_address(host.strip("[]"))
    return None


def _same(text: str, secret: str) -> bool:
    return secrets.compare_digest(text.encode(), secret.encode())


def _restrained(send: Send) -> Send:
    """Adds the restraints to an answer; the scripts of a page of NiceGUI get their nonce."""
    nonce, is_page = secrets.token_urlsafe(16), False

    async def sent(message: Message) -> None:
        nonlocal is_page
        if message["type"] == "http.response.start":
            headers = MutableHeaders(raw=message["headers"])
            is_page = headers.get("X-NiceGUI-Content") == "page"
            headers["Content-Security-Policy"] = _OF_PAGES % nonce if is_page else _OF_REPORTS
            headers["Cross-Origin-Resource-Policy"] = "same-origin"
            headers["Referrer-Policy"] = "no-referrer"
            headers["X-Content-Type-Options"] = "nosniff"
            if is_page:
                del headers["Content-Length"]
        elif message["type"] == "http.response.body" and is_page:
            # Of all text from outside, `<` is escaped in the page.
            body = message["body"].replace(b"<script", f'<script nonce="{nonce}"'.encode())
            message = {**message, "body": body}
        await send(message)

    return sent
