"""Somebody of every kind at a hub, raw requests and raw messages: what a test of rights needs."""

from __future__ import annotations

import itertools
import json
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from fringescope.client import Client, HubCase
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD, populate
from tests.server.test_hub import scanned

WIDE = Limits(
    logins_per_minute=100_000, requests_per_s=100_000, requests_burst=100_000, ops_per_s=1e5, ops_burst=10_000,
    log_bytes_burst=10**9,
)
ROLES = ("stranger", "guest", "watcher", "observer", "expert", "operator", "admin")
S = 1_000_000_000


@contextmanager
def hub_at(folder: Path, limits: Limits = WIDE, **how: Any) -> Iterator[Server]:
    """A hub with somebody of each role, whose limits are out of the way."""
    with Server(Config(folder / "hub", port=0, limits=limits, **how), fast_passwords=True) as server:
        populate(server)
        yield server


def later(hub: Server, seconds: float) -> None:
    """The hub's clock goes on by so much at once."""
    hub.site.clock._wall += int(seconds * S)


def invited(case: HubCase, role: str = "expert", name: str = "Gast", **how: Any) -> Client:
    """A guest who came in by an invitation to a case."""
    asked = case.invite(name, role, **how)
    guest = Client(case.hub.url)
    guest.accept(asked.token or "", asked.code or "")
    return guest


@dataclass
class World:
    """A case with a scan that everybody was let into, and one that nobody was."""

    hub: Server
    case: HubCase
    other: HubCase
    clients: dict[str, Client] = field(default_factory=dict)
    opened: list[Client] = field(default_factory=list)

    def enter(self, role: str) -> Client:
        """Somebody who has just come in; a guest by a new invitation, a watcher is a guest who observes."""
        self.opened.append(self._entered(role))
        return self.opened[-1]

    def _entered(self, role: str) -> Client:
        if role == "stranger":
            return Client(self.hub.url)
        if role in ("guest", "watcher"):
            return invited(self.case, "expert" if role == "guest" else "observer")
        return Client(self.hub.url, role, PASSWORD)

    def client(self, role: str) -> Client:
        """Somebody who came in once."""
        if role not in self.clients:
            self.clients[role] = self.enter(role)
        return self.clients[role]

    def close(self) -> None:
        for client in self.opened:
            client.close()


@contextmanager
def world_at(folder: Path, **how: Any) -> Iterator[World]:
    with hub_at(folder, **how) as hub:
        operator = Client(hub.url, "operator", PASSWORD)
        world = World(hub, scanned(hub, operator), operator.open_case("S26-other"), {"operator": operator}, [operator])
        for role in ("expert", "observer"):
            person = world.client(role).me.person.id
            operator.ask("PUT", f"/api/cases/{world.case.id}/members/{person}")
        try:
            yield world
        finally:
            world.close()


def asked(
    client: Client, method: str, path: str, body: Any = None, csrf: bool = True, **headers: str
) -> httpx.Response:
    """One raw request, with the CSRF token unless told otherwise; underlines in names of headers become dashes."""
    named = {k.replace("_", "-"): v for k, v in headers.items()}
    if csrf and client.account is not None:
        named["x-csrf-token"] = client.account.csrf
    return client.http.request(method, path, json=body, headers=named)


def cookies(client: Client) -> str:
    return "; ".join(f"{c.name}={c.value}" for c in client.http.cookies.jar)


@contextmanager
def room_of(
    client: Client, case: str, since: int = 10**6, ssl: Any = None, **headers: str
) -> Iterator[ClientConnection]:
    """A raw connection to a room, from which the log up to now was not asked for."""
    named = {k.replace("_", "-"): v for k, v in headers.items()} | {"Cookie": cookies(client)}
    origin: Any = named.pop("Origin", None)
    there = urlsplit(client.url)
    host = named.pop("Host", there.hostname)
    url = f"{there.scheme.replace('http', 'ws')}://{host}:{there.port}/api/cases/{case}/room?since={since}"
    sock = socket.create_connection((there.hostname or "", there.port or 0), 10)
    with connect(url, sock=sock, additional_headers=named, origin=origin, compression=None, ssl=ssl) as made:
        yield made


def heard(room: ClientConnection, *types: str, timeout_s: float = 30.0) -> dict[str, Any]:
    """The next message of one of these types."""
    while True:
        message: dict[str, Any] = json.loads(room.recv(timeout_s))
        if message["type"] in types:
            return message


def closed(room: ClientConnection, timeout_s: float = 30.0) -> tuple[int, str]:
    """With what code and reason a connection is closed; what comes before is passed over."""
    with pytest.raises(ConnectionClosed) as e:
        all(room.recv(timeout_s) is not None for _ in itertools.count())
    assert e.value.rcvd is not None, "closed without a word"
    return e.value.rcvd.code, e.value.rcvd.reason


def op(what: dict[str, Any]) -> dict[str, Any]:
    """An op that was never said before."""
    return {"client": f"raw-{secrets.token_hex(6)}", "number": 1, "what": what}


def say(room: ClientConnection, what: dict[str, Any]) -> dict[str, Any]:
    """An op, and what became of it."""
    room.send(json.dumps({"type": "say", "op": op(what)}))
    return heard(room, "said", "refusal")
