"""What every request passes first: how often, how long, from which page, and what browsers are told to forbid."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import re
import time
from collections.abc import MutableMapping
from typing import Any
from urllib.parse import urlsplit

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
_SLOWEST = 1000  #: bytes a second of a body, on average
_SAFE = ("GET", "HEAD", "OPTIONS")
_UPLOADS = re.compile(r"/api/cases/(import|[^/]+/scans/import)")
_FORWARDED = ("forwarded", "via", "x-real-ip", "x-client-ip", "x-cluster-client-ip", "true-client-ip", "cf-ray",
              "cf-connecting-ip", "fastly-client-ip", "x-original-host", "x-arr-log-id")  # fmt: skip


def address_of(scope: MutableMapping[str, Any], config: Config) -> str:
    """From where a request comes, as far as it matters for how often: who holds one address of IPv6 holds a /64.

    Behind a proxy it is the last address that the proxy named: those before it anybody can write.
    """
    client = scope.get("client")
    said = client[0] if client else ""
    if config.behind_proxy:
        named = Headers(scope=scope).getlist("x-forwarded-for")
        said = named[-1].rsplit(",", 1)[-1].strip() if named else said
    return counted_as(said) or (client[0] if client else "")


def counted_as(said: str) -> str:
    """What an address counts as where it is asked how often, "" for what is none."""
    try:
        address = ipaddress.ip_address(said)
    except ValueError:
        return ""
    if isinstance(address, ipaddress.IPv6Address):
        return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))
    return str(address)


def is_local(scope: MutableMapping[str, Any], config: Config) -> bool:
    """Whether a request comes from the instrument's own machine, and not through another server on it."""
    client, server = scope.get("client"), scope.get("server")
    handed_on = config.behind_proxy and (server is None or server[1] != config.local_port)
    if handed_on or client is None or client[0] not in LOOPBACK:
        return False
    if scope["type"] == "http" and scope.get("http_version") == "1.0":
        return False  # no browser and no program of ours, but proxies as they come
    headers = Headers(scope=scope)
    if any(h in _FORWARDED or h.startswith("x-forwarded") for h in headers):
        return False
    near = (*LOOPBACK, config.host)
    origin = headers.get("origin")
    return _host(f"//{headers.get('host', '')}") in near and (origin is None or _host(origin) in near)


def _host(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def origin_fits(scope: MutableMapping[str, Any], config: Config) -> bool:
    """Whether a request comes from a page of ours, or from no page at all: browsers always name the page's origin."""
    headers = Headers(scope=scope)
    origins = headers.getlist("origin")
    if not origins:
        return headers.get("sec-fetch-site", "none") in ("none", "same-origin")
    if len(origins) > 1:
        return False
    own = config.tls and origins[0] == f"https://{headers.get('host', '')}"  # who is elsewhere has no such certificate
    return own or origins[0] in config.own_origins


class Guarded:
    """The outermost layer of the app."""

    def __init__(self, app: ASGIApp, config: Config, requests: Throttle) -> None:
        self._app, self._config, self._requests = app, config, requests

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuses what is too often, too long or from elsewhere; adds headers to what goes out."""
        if scope["type"] == "websocket" and self._requests.take(address_of(scope, self._config)):
            await send({"type": "websocket.close", "code": 1013})
            return
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

        wait = self._requests.take(address_of(scope, self._config))
        if wait:
            await _refuse(sent, 429, f"too many requests; try again in {wait:.0f} s", {"retry-after": f"{wait:.0f}"})
            return
        if scope["method"] not in _SAFE and not origin_fits(scope, self._config):
            await _refuse(sent, 403, "this request comes from another site's page; open the hub's own page")
            return
        limits = self._config.limits
        longest = limits.upload_bytes if _UPLOADS.fullmatch(scope["path"]) else limits.body_bytes
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdigit() and len(length) < 20) or int(length) > longest:
            await _refuse(sent, 413, f"a body of {length[:20]} bytes; at most {longest} are taken")
            return
        count = 0
        began = over = whole = False
        since = time.monotonic()

        async def received() -> Message:
            nonlocal count, over, whole
            try:
                message = await asyncio.wait_for(receive(), None if whole else limits.body_s)
            except TimeoutError:
                return {"type": "http.disconnect"}  # whoever reads the body hears that it ended
            whole = whole or not message.get("more_body", False)
            count += len(message.get("body", b""))
            late = time.monotonic() - since - limits.body_s
            if not whole and late > 0 and count < _SLOWEST * late:
                return {"type": "http.disconnect"}
            if count > longest:
                over = True
                raise _TooLongError
            return message

        async def noted(message: Message) -> None:
            nonlocal began
            if not over or began:  # whatever is made of a body that was cut off: it was too long
                began = True
                await sent(message)

        try:
            await self._app(scope, received, noted)
        except _TooLongError:
            pass
        finally:
            if over and not began:
                await _refuse(sent, 413, f"a body of more than {longest} bytes; no more are taken")


class _TooLongError(Exception):
    """A body goes on and on."""


async def _refuse(send: Send, status: int, why: str, headers: dict[str, str] | None = None) -> None:
    body = json.dumps({"detail": why}).encode()
    fields = {"content-type": "application/json", "content-length": str(len(body)), **(headers or {})}
    raw = [(k.encode(), v.encode()) for k, v in fields.items()]
    await send({"type": "http.response.start", "status": status, "headers": raw})
    await send({"type": "http.response.body", "body": body})
