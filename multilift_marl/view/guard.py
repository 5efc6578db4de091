"""Access control of the page: only requests to this machine's own names, with the token of the printed address."""

from __future__ import annotations

import hmac
import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

_LOOPBACK = ("127.0.0.1", "localhost", "::1")


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
        if len(hosts) != 1 or _hostname(f"//{hosts[0]}") not in _LOOPBACK:
            return "the viewer answers to 127.0.0.1 and localhost alone"
        if origins not in ([], [f"http://{hosts[0]}"]):
            return "the viewer refuses requests of other sites' pages"
        if not any(hmac.compare_digest(given.encode(), self.token.encode()) for given in self._tokens(request)):
            return "open the whole address that the viewer has printed, with its token"
        return ""

    def cookie(self, request: Any) -> str:
        """Return the cookie that holds the token; its name has the port, as cookies are shared between ports."""
        return f"{_cookie_name(request)}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def _tokens(self, request: Any) -> Iterator[str]:
        yield from parse_qs(urlsplit(request.path).query).get("token", [])
        for header in request.headers.get_all("Cookie"):
            for pair in header.split(";"):
                name, _, value = pair.strip().partition("=")
                if name == _cookie_name(request):
                    yield value


@contextmanager
def guarded_servers(guard: Guard) -> Iterator[None]:
    """Let the websocket servers that are started in this context ask `guard` first.

    viser has no option for such a check, so the function of the library that serves it is replaced for a moment.
    """
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


def _hostname(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


def _cookie_name(request: Any) -> str:
    return f"multilift_{request.headers['Host'].rpartition(':')[2]}"
