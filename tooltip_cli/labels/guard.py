"""Who may talk to the labelling server: its own page, on this machine, and nobody else.

Other sites that the browser has open can send requests to 127.0.0.1, and can point a name of their
own at it (DNS rebinding). They know neither the token in the path nor can they forge the headers
Host and Origin, which are checked here before anything else sees a request.
"""

from __future__ import annotations

import hmac

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 4096
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Refuses requests that are not the page's own, and adds the page's policy to every answer."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app = app
        self._token = token
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}
        self._origins = {f"http://{host}" for host in self._hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with the reason why not."""

        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = [(name.encode(), value.encode()) for name, value in _HEADERS.items()]
                message["headers"] = [*message.get("headers", ()), *added]
            await send(message)

        refusal = self._refusal(scope)
        if refusal is not None:
            status, reason = refusal
            answer = JSONResponse({"error": reason}, status)
            await answer(scope, receive, send_with_policy)
            return
        await self.app(scope, receive, send_with_policy)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        if scope["type"] != "http":
            return 404, "not found"
        headers = Headers(scope=scope)
        if headers.getlist("host") not in [[host] for host in self._hosts]:
            return 403, "this server answers to 127.0.0.1 only"
        origins = headers.getlist("origin")
        if not set(origins) <= self._origins or headers.get("sec-fetch-site") not in (
            None,
            "same-origin",
            "none",  # typed, or opened by 'tooltip label'
        ):
            return 403, "another site must not send requests here"
        token = scope["path"].split("/")[1].encode()
        if not hmac.compare_digest(token, self._token.encode()):
            return 404, "not found; 'tooltip label' prints the address of its page"
        if scope["method"] == "POST":
            if not origins:
                return 403, "a change must say which page it comes from"
            if headers.get("content-type") != "application/json":
                return 415, "expected application/json"
        return _body_refusal(headers)


def _body_refusal(headers: Headers) -> tuple[int, str] | None:
    """Refuse a body whose length is unknown or too large; h11 holds it to the length it claims."""
    if "transfer-encoding" in headers:
        return 411, "expected the length of the body"
    if int(headers.get("content-length", "0")) > MAX_BODY_BYTES:
        return 413, f"expected at most {MAX_BODY_BYTES} bytes"
    return None
