"""Access control of the page: only requests to this machine's own names, with the token of the printed address.

viser (1.1) calls `websockets.asyncio.server.serve` with a `process_request` of its own and takes no other: neither
`ViserServer` nor its HTTP server has an argument or a method for a check before the page and its websocket are served.
So `guarded_servers` replaces that function of websockets, which is public, while the server starts.
"""

from __future__ import annotations

import hmac
import http
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs


class Guard:
    """Refuses requests that do not come from the page.

    A page of another site can make a browser send requests here, but it has no token. A name of another site that
    resolves to this machine (DNS rebinding) is refused too.

    Attributes:
        token: of the address; the browser keeps it as a cookie, since the page's websocket comes without it.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(16)

    def refuse(self, request: Any) -> str:
        """Return why a request is refused, "" if it is not."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not _is_loopback(hosts[0]):
            return "the viewer answers to 127.0.0.1 and localhost alone"
        if origins not in ([], [f"http://{hosts[0]}"]):
            return "the viewer refuses requests of other sites' pages"
        # Compared in the same time wherever a guess is wrong.
        if not any(hmac.compare_digest(_encode(given), self.token.encode()) for given in self._tokens(request)):
            return "open the whole address that the viewer has printed, with its token"
        return ""

    def cookie(self, request: Any) -> str:
        """Return the cookie that holds the token; its name has the port, as cookies are shared between ports."""
        return f"{_cookie_name(request)}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def _tokens(self, request: Any) -> Iterator[str]:
        yield from parse_qs(request.path.partition("?")[2]).get("token", [])
        for header in request.headers.get_all("Cookie"):
            for pair in header.split(";"):
                name, _, value = pair.strip().partition("=")
                if name == _cookie_name(request):
                    yield value


@contextmanager
def guarded_servers(guard: Guard) -> Iterator[None]:
    """Let the websocket servers that are started in this context ask `guard` first."""
    from websockets.asyncio import server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve = server.serve

    def serve_guarded(*arguments: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if reason := guard.refuse(request):
                body = f"{reason}\n".encode()
                headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
                return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", headers, body)
            answer = process_request(connection, request)
            if answer is not None:
                answer.headers["Set-Cookie"] = guard.cookie(request)
            return answer

        return serve(*arguments, process_request=check, **options)

    server.serve = serve_guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _is_loopback(host: str) -> bool:
    """Return whether the header Host is a name of this machine alone: with a port or without, and nothing else."""
    return re.fullmatch(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", host, re.ASCII | re.IGNORECASE) is not None


def _encode(text: str) -> bytes:
    """Return the bytes of what a request holds, which need not be characters."""
    return text.encode("utf-8", "replace")


def _cookie_name(request: Any) -> str:
    return f"multilift_{request.headers['Host'].rpartition(':')[2]}"
