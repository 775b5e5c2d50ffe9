"""Who may ask the page, and what a browser may run of its answers."""

import secrets
from collections.abc import Sequence
from urllib.parse import urlsplit

from fastapi import Response
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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


class Admission:
    """Refuses requests of other sites' pages, which a browser on this machine may have open.

    A page's own requests name its address as their host, and as their origin where they name one.
    """

    def __init__(self, asgi: ASGIApp, hosts: Sequence[str]) -> None:
        self._asgi, self._hosts = asgi, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request, or refuses it."""
        headers = {key.lower(): value.decode("latin-1") for key, value in scope.get("headers", ())}
        host = headers.get(b"host", "")
        is_known = not self._hosts or urlsplit(f"//{host}").hostname in self._hosts
        origin = headers.get(b"origin")
        is_own = origin is None or urlsplit(origin).netloc == host
        if scope["type"] == "lifespan" or (is_known and is_own):
            await self._asgi(scope, receive, _restrained(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await Response("Not from here.", 403)(scope, receive, send)


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
