"""Strangers who only open connections: too many, too slow, or full of nothing. Nobody else waits for them."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from fringescope.client import Client
from fringescope.server import connections
from fringescope.server.running import Server
from fringescope.server.security import counted_as
from tests.server.conftest import PASSWORD
from tests.server.people_scenes import WIDE, cookies, hub_at, invited, room_of
from tests.server.test_hub import scanned


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    few = replace(WIDE, connections_each=4, connections=6, body_s=0.5)
    with hub_at(tmp_path_factory.mktemp("connections"), few) as made:
        yield made


def opened(hub: Server, address: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection((hub.config.host, hub.config.port), 20, source_address=(address, 0))


def ended(connection: socket.socket) -> bool:
    """That the hub closes it, whatever it says before."""
    try:
        while connection.recv(65536):
            pass
    except ConnectionError:
        pass
    return True  # else the socket's own time would be over


def lives(hub: Server, address: str = "127.0.0.1") -> bool:
    with httpx.Client(transport=httpx.HTTPTransport(local_address=address), timeout=20) as http:
        return http.get(f"{hub.url}/api/health").status_code == 200


def taken(hub: Server, address: str) -> bool:
    try:
        return lives(hub, address)
    except httpx.HTTPError:
        return False


def soon(hub: Server, address: str, good: bool) -> bool:
    """Whether it comes to that, though a busy machine closes late."""
    end = time.monotonic() + 20
    while taken(hub, address) is not good and time.monotonic() < end:
        time.sleep(0.05)
    return taken(hub, address) is good


WHOLE = b"GET /api/health HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.mark.parametrize("said", [(b"",), (b"GET / HTTP/1.1\r\nHost: x\r\n",), (WHOLE, b"GET"), (WHOLE, WHOLE, b"G")])
def test_a_request_that_never_ends(hub: Server, monkeypatch: pytest.MonkeyPatch, said: tuple[bytes, ...]) -> None:
    monkeypatch.setattr(connections, "_HEAD_S", 1.0)
    with contextlib.closing(opened(hub)) as slow:
        for part in said:
            slow.sendall(part)
            if part is WHOLE:
                got = b""
                while not got.endswith(b"}"):
                    got += slow.recv(65536)
                assert got.startswith(b"HTTP/1.1 200")
        assert ended(slow)


def test_a_head_without_end(hub: Server) -> None:
    with contextlib.closing(opened(hub)) as raw, contextlib.suppress(ConnectionError):
        raw.sendall(b"GET / HTTP/1.1\r\n")
        for _ in range(1000):
            raw.sendall(b"a: " + b"x" * 10_000 + b"\r\n")
        raise AssertionError("10 MB of head were taken")


def test_what_is_no_request_is_answered_as_all_else_is(hub: Server) -> None:
    for said in (b"GET /api/health?" + b"x" * 70_000 + b" HTTP/1.1\r\nHost: x\r\n\r\n", b"\x16\x03\x01 hello\r\n\r\n"):
        with contextlib.closing(opened(hub)) as raw:
            raw.sendall(said)
            got = b""
            while piece := raw.recv(65536):
                got += piece
        assert got.startswith(b"HTTP/1.1 400 ")
        assert b"content-type: application/json" in got
        assert "send a shorter one" in json.loads(got.split(b"\r\n\r\n", 1)[1])["detail"]


def test_a_body_that_trickles(hub: Server) -> None:
    """A pause is the end of it; nothing of it was done."""
    with contextlib.closing(http.client.HTTPConnection(hub.config.host, hub.config.port, timeout=20)) as raw:
        raw.putrequest("POST", "/api/login")
        raw.putheader("Content-Length", "1000")
        raw.putheader("Content-Type", "application/json")
        raw.endheaders(b"{")
        assert raw.getresponse().status == 400


def test_one_address_has_so_many_and_this_machine_always_one_more(hub: Server) -> None:
    with contextlib.ExitStack() as crowd:
        for _ in range(4):
            crowd.enter_context(opened(hub, "127.0.0.2"))
        assert soon(hub, "127.0.0.2", False)
        assert lives(hub, "127.0.0.3")
        end = time.monotonic() + 20
        while hub._socket.count < 6 and time.monotonic() < end:  # of those before some may still be closing
            crowd.enter_context(opened(hub, "127.0.0.3"))
            time.sleep(0.05)
        assert soon(hub, "127.0.0.4", False)  # all together, too
        assert all(lives(hub) for _ in range(3))
    assert soon(hub, "127.0.0.2", True)


def flooded(connection: socket.socket, piece: bytes) -> bool:
    """Whether it is cut off before it has sent a hundred megabytes."""
    try:
        for _ in range(100_000_000 // len(piece)):
            connection.sendall(piece)
    except ConnectionError:
        return True
    return False


PING = bytes([0x89, 0x80 | 125]) + bytes(4) + b"x" * 125
EMPTY = bytes([0x00, 0x80]) + bytes(4)


@pytest.mark.parametrize(("first", "piece"), [(b"", PING * 500), (bytes([0x01, 0x80]) + bytes(4), EMPTY * 5000)])
def test_frames_that_hold_nothing(hub: Server, first: bytes, piece: bytes) -> None:
    """Pings whose answers nobody reads, and pieces of a message that never ends: cut off; the others go on."""
    with Client(hub.url, "operator", PASSWORD) as operator:
        case = scanned(hub, operator)
        with invited(case) as guest, case.enter() as room, contextlib.closing(opened(hub)) as raw:
            path = f"/api/cases/{case.id}/room?since=100000"
            lines = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{hub.config.port}", "Upgrade: websocket"]
            lines += ["Connection: Upgrade", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
            raw.sendall("\r\n".join([*lines, f"Cookie: {cookies(guest)}", "", ""]).encode())
            assert raw.recv(12) == b"HTTP/1.1 101"
            raw.sendall(first)
            assert flooded(raw, piece)
            room.comment("meanwhile")


def test_a_body_in_pieces_of_one_byte(hub: Server) -> None:
    """Hours of work for the hub at little cost; who far away does that is not heard for a while."""
    with contextlib.closing(opened(hub, "127.0.0.5")) as raw:
        raw.sendall(b"POST /api/login HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
        assert flooded(raw, b"1\r\nx\r\n" * 5000)
    assert soon(hub, "127.0.0.5", False)
    assert lives(hub)


def test_long_messages_are_no_work(hub: Server) -> None:
    with Client(hub.url, "operator", PASSWORD) as operator:
        case = scanned(hub, operator)
        with room_of(operator, case.id) as room:
            for _ in range(30):
                room.send('{"type": "ping", "at_ms": %s}' % ("1" + " " * 900_000))
            pongs = 0
            while pongs < 30:
                pongs += '"pong"' in room.recv(20)  # type: ignore[operator]


def test_as_many_files_as_the_process_may_have() -> None:
    assert connections.more_files(64) >= 64


def test_who_comes_while_it_starts_waits(tmp_path: Path) -> None:
    from fringescope.server.config import Config

    hub = Server(Config(tmp_path, port=0), fast_passwords=True)
    with contextlib.closing(opened(hub)) as early:
        early.sendall(b"GET /api/health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        with hub:
            assert early.recv(12) == b"HTTP/1.1 200"


def test_who_holds_a_net_is_one() -> None:
    assert counted_as("2001:db8:1:2::5") == counted_as("2001:db8:1:2:ffff::1") != counted_as("2001:db8:1:3::5")
    assert (counted_as("::ffff:192.0.2.1"), counted_as("192.0.2.1"), counted_as("x")) == ("192.0.2.1",) * 2 + ("",)
