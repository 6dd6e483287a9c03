"""What every request passes first: how often, how long, from which page, and what browsers are told to forbid."""

from __future__ import annotations

import json
from collections.abc import MutableMapping
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fringescope.server.config import LOOPBACK, Config
from fringescope.server.throttle import Throttle

_HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self'; object-src 'none'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
_SAFE = ("GET", "HEAD", "OPTIONS")
_FORWARDED = ("x-forwarded-for", "forwarded", "x-real-ip", "via", "x-forwarded-host")


def is_local(scope: MutableMapping[str, Any], config: Config) -> bool:
    """Whether a request comes from the instrument's own machine, and not through another server on it."""
    client = scope.get("client")
    if config.behind_proxy or client is None or client[0] not in LOOPBACK:
        return False
    headers = Headers(scope=scope)
    return not any(h in headers for h in _FORWARDED)


def origin_fits(scope: MutableMapping[str, Any], config: Config) -> bool:
    """Whether a request comes from a page of ours, or from no page at all: browsers always name the page's origin."""
    origin = Headers(scope=scope).get("origin")
    return origin is None or origin in config.own_origins


class Guarded:
    """The outermost layer of the app."""

    def __init__(self, app: ASGIApp, config: Config, requests: Throttle) -> None:
        self._app, self._config, self._requests = app, config, requests

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuses what is too often, too long or from elsewhere; adds headers to what goes out."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        api = scope["path"].startswith("/api/")

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                out = MutableHeaders(scope=message)
                for k, v in _HEADERS.items():
                    out.setdefault(k, v)
                if self._config.tls:
                    out.setdefault("strict-transport-security", "max-age=31536000")
                if api:
                    out.setdefault("cache-control", "no-store")
            await send(message)

        wait = self._requests.take(scope["client"][0] if scope.get("client") else "")
        if wait:
            await _refuse(sent, 429, f"too many requests; try again in {wait:.0f} s", {"retry-after": f"{wait:.0f}"})
            return
        if scope["method"] not in _SAFE and not origin_fits(scope, self._config):
            await _refuse(sent, 403, "this request comes from another site's page; open the hub's own page")
            return
        limits = self._config.limits
        longest = limits.upload_bytes if scope["path"] == "/api/cases/import" else limits.body_bytes
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit()) or int(length) > longest:
            await _refuse(sent, 413, f"a body of {length[:20]} bytes; at most {longest} are taken")
            return
        count = 0
        began = False

        async def received() -> Message:
            nonlocal count
            message = await receive()
            count += len(message.get("body", b""))
            if count > longest:
                raise _TooLongError
            return message

        async def noted(message: Message) -> None:
            nonlocal began
            began = True
            await sent(message)

        try:
            await self._app(scope, received, noted)
        except _TooLongError:
            if not began:
                await _refuse(sent, 413, f"a body of more than {longest} bytes; no more are taken")


class _TooLongError(Exception):
    """A body goes on and on."""


async def _refuse(send: Send, status: int, why: str, headers: dict[str, str] | None = None) -> None:
    body = json.dumps({"detail": why}).encode()
    fields = {"content-type": "application/json", "content-length": str(len(body)), **(headers or {})}
    raw = [(k.encode(), v.encode()) for k, v in fields.items()]
    await send({"type": "http.response.start", "status": status, "headers": raw})
    await send({"type": "http.response.body", "body": body})
