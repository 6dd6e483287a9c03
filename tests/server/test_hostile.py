"""Requests and messages that nobody sends by accident: deep, long, many, broken, and names of files that are none."""

from __future__ import annotations

import contextlib
import http.client
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from fringescope.client import Client
from fringescope.server import database as db
from fringescope.server.config import Limits
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD
from tests.server.people_scenes import WIDE, World, asked, closed, cookies, heard, op, room_of, say, world_at
from tests.server.test_hub import SCAN, stroke


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with world_at(tmp_path_factory.mktemp("hostile")) as made:
        yield made


DEEP = "[" * 100_000
BODIES = {
    "deep": DEEP.encode(), "deep and whole": (DEEP + "]" * 100_000).encode(),
    "deep in a field": ('{"name": ' + DEEP).encode(), "deep objects": b'{"name":' * 50_000,
    "a long number": b'{"name": ' + b"9" * 10_000 + b"}", "a long number in a list": b"[" + b"1" * 5000 + b"]",
    "half a letter": b'{"\\ud800": 1, "name": "\\udfff", "password": "x"}', "no utf-8": b'{"name": "\xff\xfe"}',
    "not a number": b'{"name": NaN, "password": Infinity}', "nothing": b"", "null": b"null", "a word": b'"x"',
    "twice": b'{"name": "a", "name": "b", "password": "c", "password": "d"}', "a bom": b"\xef\xbb\xbf[7]",
    "a nul": b'{"name": "a\\u0000b", "password": "x"}', "a long name": b'{"name": "' + b"a" * 100_000 + b'"}',
}  # fmt: skip


@pytest.mark.parametrize("body", BODIES)
def test_a_body_that_is_none(world: World, body: str) -> None:
    client = world.client("operator")
    head = {"content-type": "application/json", "x-csrf-token": client.me.csrf}
    for method, path in (
        ("POST", "/api/login"), ("POST", "/api/cases"), ("PATCH", f"/api/cases/{world.case.id}"),
        ("POST", f"/api/cases/{world.case.id}/ops"), ("POST", f"/api/cases/{world.case.id}/carry"),
        ("POST", "/api/passkeys"), ("POST", "/api/passkeys/login"), ("POST", "/api/invitations/accept"),
    ):  # fmt: skip
        answer = client.http.request(method, path, content=BODIES[body], headers=head)
        assert answer.status_code in (400, 401, 403, 422), (path, answer.status_code, answer.text[:200])
        detail = answer.json()["detail"]
        assert "\n" not in detail
        assert len(detail) <= 1000
    for kind in ("text/plain", "application/x-www-form-urlencoded", ""):  # what a page elsewhere may send unasked
        good = json.dumps({"name": "operator", "password": PASSWORD})
        named = [("content-type", kind)] if kind else []
        answer = client.http.build_request("POST", "/api/login", content=good, headers=named)
        if not kind:
            answer.headers.pop("content-type", None)
        assert client.http.send(answer).status_code == 422, kind


def test_a_long_body_is_not_read(world: World) -> None:
    client, most = world.client("operator"), world.hub.config.limits.body_bytes

    def pieces() -> Iterator[bytes]:
        for _ in range(most // 100_000 + 5):
            yield b" " * 100_000

    head = {"x-csrf-token": client.me.csrf, "content-type": "application/json"}
    for path in ("/api/login", "/api/cases"):
        with contextlib.closing(http.client.HTTPConnection(world.hub.config.host, world.hub.config.port)) as raw:
            named = head | {"cookie": cookies(client), "transfer-encoding": "chunked"}
            with contextlib.suppress(OSError):  # it may hang up before all was said
                raw.request("POST", path, pieces(), named, encode_chunked=True)
            answer = raw.getresponse()
            assert (answer.status, "no more are taken" in answer.read().decode()) == (413, True)
    for length in ("9" * 30, "-1", "1e3", "٣"):
        with contextlib.closing(http.client.HTTPConnection(world.hub.config.host, world.hub.config.port)) as raw:
            raw.putrequest("POST", "/api/login")
            raw.putheader("Content-Length", length.encode())
            raw.endheaders()
            assert raw.getresponse().status in (400, 413), length


MESSAGES = {
    "deep": DEEP, "deep in a field": '{"type": "say", "op": ' + DEEP, "no JSON": "{", "nothing": "", "a list": "[]",
    "no type": "{}", "a type that is none": '{"type": "welcome"}', "a number": "7",
    "a type that is a list": '{"type": []}',
    "half a letter": '{"type": "\\ud800"}', "a long number": '{"type": "ping", "at_ms": ' + "9" * 5000 + "}",
    "not a number": '{"type": "ping", "at_ms": NaN}', "endless": '{"type": "ping", "at_ms": 1e999}',
    "somebody else": '{"type": "pointer", "person": "person-0", "pixel": [1, 2]}',
    "a place that is none": '{"type": "pointer", "pixel": [1e9, 2]}',
    "ink without end": json.dumps({"type": "ink", "stroke": "s", "points": [[0, 0]] * 501}),
    "an op without a number": '{"type": "say", "op": {"client": "c", "what": {"kind": "stop"}}}',
    "an op that is none": json.dumps({"type": "say", "op": op({"kind": "ScanTaken", "scan": "x", "rig": "y"})}),
    "a word of the instrument": json.dumps({"type": "say", "op": op({"kind": "Guarded"})}),
    "an op by somebody else": json.dumps({"type": "say", "op": op({"kind": "stop"}) | {"actor": "person-0"}}),
    "a stroke by somebody else": json.dumps(
        {"type": "say", "op": op({"kind": "put", "stroke": {"id": "s"}, "scan": "x", "author": "person-0"})}
    ),
}  # fmt: skip


def test_a_message_that_is_none(world: World) -> None:
    operator, before = world.client("operator"), len(world.case.events())
    with room_of(operator, world.case.id) as room:
        heard(room, "caught_up")
        for name, message in MESSAGES.items():
            room.send(message)
            why = heard(room, "refusal", "pong", "said")
            assert why["type"] == "refusal", (name, why)
            assert "\n" not in why["why"]
            assert len(why["why"]) <= 300
        room.send(b"\x00\xff" * 10)
        heard(room, "refusal")
        room.send('{"type": "ping", "at_ms": %s}' % (" " * world.hub.config.limits.message_bytes + "1"))
        assert "at most" in heard(room, "refusal")["why"]
        room.send('{"type": "ping", "at_ms": 1}')
        assert heard(room, "pong")["at_ms"] == 1
        size = (4 * world.hub.config.limits.message_bytes + 1).to_bytes(8, "big")
        room.socket.sendall(b"\x81\xff" + size + bytes(4))  # its head alone says that the frame is too long
        assert closed(room)[0] == 1009
    assert len(world.case.events()) == before


def test_a_flood_of_messages_is_shut_off(tmp_path: Path) -> None:
    few = replace(WIDE, messages_per_s=5.0, messages_burst=100)
    with world_at(tmp_path, limits=few) as world, room_of(world.client("expert"), world.case.id) as room:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(300):
                room.send('{"type": "ping"}')
        assert closed(room)[0] == 1008


def test_a_flood_of_stops_fills_no_log_and_a_stop_that_matters_is_never_too_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(WIDE, ops_per_s=0.001, ops_burst=5)
    with world_at(tmp_path, limits=few) as world, room_of(world.client("observer"), world.case.id) as room:
        before = len(world.case.events())
        answers = [say(room, {"kind": "stop"}) for _ in range(30)]
        assert sum("too many ops" in x.get("refused", "") for x in answers) == 25
        assert len(world.case.events()) == before + 5
        path, body = f"/api/cases/{world.case.id}/ops", [op({"kind": "stop"})]
        assert asked(world.client("observer"), "POST", path, body).status_code == 429
        monkeypatch.setattr(world.hub.site.hub, "can_stop", lambda _case: True)
        assert asked(world.client("observer"), "POST", path, body).status_code == 200
        assert say(room, {"kind": "stop"})["type"] == "said"


def test_long_ops_count_as_many(tmp_path: Path) -> None:
    few = replace(WIDE, ops_per_s=0.001, ops_burst=10)
    with world_at(tmp_path, limits=few) as world, room_of(world.client("expert"), world.case.id) as room:
        long = {"kind": "put", "stroke": stroke("s") | {"pixels": [[k / 7, k / 7] for k in range(5000)]}, "scan": SCAN}
        size = len(json.dumps(long))
        answers = [say(room, long) for _ in range(5)]
        taken = sum(a.get("refused") == "" for a in answers)
        assert taken == 10 // (1 + size // 50_000) < 5
        path = f"/api/cases/{world.case.id}/ops"
        lot = [op(long) for _ in range(5)]  # more than can ever be there at once: taken once, and waited for after it
        assert asked(world.client("operator"), "POST", path, lot).status_code == 200
        assert asked(world.client("operator"), "POST", path, [op({"kind": "stop"})]).status_code == 429
        assert asked(world.client("observer"), "POST", path, [op({"kind": "stop"})] * 10).status_code == 200
        assert asked(world.client("observer"), "POST", path, [op({"kind": "stop"})]).status_code == 429


def test_one_person_does_not_fill_the_log(tmp_path: Path) -> None:
    """By message or by request, good or refused: so many bytes, then a sentence; others are not kept from theirs."""
    few = replace(WIDE, log_bytes_per_s=0.001, log_bytes_burst=300_000)
    with world_at(tmp_path, limits=few) as world, room_of(world.client("expert"), world.case.id) as room:
        long = {"kind": "put", "stroke": stroke("s") | {"pixels": [[k / 7, k / 7] for k in range(2000)]}, "scan": SCAN}
        size, path = len(json.dumps(long)), f"/api/cases/{world.case.id}/ops"
        answers = [say(room, long | {"scan": SCAN if k % 2 else "another"})["refused"] for k in range(10)]
        taken = sum("too much at once" not in a for a in answers)
        assert 300_000 // (size + 1000) <= taken <= 300_000 // size
        assert answers[-1].startswith("you have drawn and written too much at once; the log takes ")
        assert answers[-1].endswith("s and say it again")
        answer = asked(world.client("expert"), "POST", path, [op(long)])
        assert (answer.status_code, "too much at once" in answer.text) == (429, True)
        mine = long | {"stroke": long["stroke"] | {"id": "mine"}}
        assert asked(world.client("operator"), "POST", path, [op(mine)]).json()[0]["refused"] == ""
        assert asked(world.client("operator"), "POST", path, [op(mine)] * 9).status_code == 429


def test_one_person_does_not_take_all_video(tmp_path: Path) -> None:
    few = replace(WIDE, videos=5, videos_each=3)
    with world_at(tmp_path, limits=few) as world, contextlib.ExitStack() as open_:

        def watch(role: str) -> ClientConnection:
            client = world.client(role)
            url = f"{client.url.replace('http', 'ws')}/api/cases/{world.case.id}/video/camera1"
            return open_.enter_context(connect(url, additional_headers={"Cookie": cookies(client)}, compression=None))

        for _ in range(3):
            assert "no instrument" in heard(watch("guest"), "refusal")["why"]
        code, why = closed(watch("guest"))
        assert (code, why) == (1013, "you watch 3 streams already; close one; try again later")
        for _ in range(2):
            heard(watch("operator"), "refusal")
        assert closed(watch("expert")) == (1013, "too many watch already; try again later")
        open_.close()
        watching = world.hub.site.instrument.watching
        assert soon(lambda: not watching.total())  # whoever goes makes room


def test_an_answer_to_a_picture_that_is_none(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes, deep lists, words without end: that stream ends, and nothing is written of it but that."""

    async def live(*_: Any) -> dict[str, Any]:
        return {"jpeg": "", "at_ns": 1}

    monkeypatch.setattr(world.hub.site.instrument, "live", live)
    client = world.client("expert")
    url = f"{client.url.replace('http', 'ws')}/api/cases/{world.case.id}/video/camera1"
    for answer in (b"\xff\x00", "[" * 200_000, "x", '{"ack": 2}'):
        with connect(url, additional_headers={"Cookie": cookies(client)}, compression=None) as video:
            heard(video, "frame")
            video.recv(10)
            with contextlib.suppress(ConnectionClosed):
                for _ in range(200):
                    video.send(answer)
            assert closed(video)[0] == 1000, answer[:10]


def soon(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + 20
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    return true()


def test_one_person_does_not_fill_a_room(tmp_path: Path) -> None:
    few = replace(WIDE, present=4)
    with world_at(tmp_path, limits=few) as world, contextlib.ExitStack() as open_:
        guest, operator = world.enter("guest"), world.client("operator")
        rooms = [open_.enter_context(room_of(guest, world.case.id)) for _ in range(2)]
        for room in rooms:
            heard(room, "caught_up")
        assert closed(open_.enter_context(room_of(guest, world.case.id)))[0] == 1013
        heard(open_.enter_context(room_of(operator, world.case.id)), "caught_up")


# -------------------------------------------------------------------------------------------------------------- files

NAMES = [
    'a"; filename=evil.exe', "a\r\nset-cookie: fringescope=evil", "../../etc/passwd", "ünïcode\u202eexe.txt", "",
    "x/..",
]  # fmt: skip


def kept(hub: Server, case: str, name: str, kind: str, data: bytes) -> str:
    sha256, size = hub.site.blobs.put(data)
    with db.writing(hub.site.engine) as c:
        row = {"case_id": case, "owner": f"o-{name}", "name": name, "sha256": sha256, "size": size, "type": kind}
        c.execute(db.blobs.insert().values(row))
    return sha256


@pytest.mark.parametrize("name", NAMES)
def test_the_name_of_a_file_is_only_a_name(world: World, name: str) -> None:
    page = b"<script>alert(1)</script>" + name.encode()
    for kind in ("text/html", "image/svg+xml", "application/octet-stream"):
        sha256 = kept(world.hub, world.case.id, f"{name}{kind[:1]}", kind, page + kind.encode())
        answer = asked(world.client("expert"), "GET", f"/api/cases/{world.case.id}/files/{sha256}")
        assert answer.status_code == 200
        told = answer.headers["content-disposition"]
        assert told.startswith("attachment; filename=")
        inside = told.split("=", 1)[1].strip('"')
        assert all(c.isascii() and (c.isalnum() or c in "._-") for c in inside), told
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "set-cookie" not in answer.headers
        assert answer.headers["cache-control"].startswith("private")


def test_a_file_of_another_case_is_not_there(world: World) -> None:
    sha256 = kept(world.hub, world.other.id, "secret", "application/json", b"{}")
    for role in ("expert", "guest", "operator"):
        path = f"/api/cases/{world.case.id}/files/{sha256}"
        assert asked(world.client(role), "GET", path).status_code == 404  # the hash alone opens nothing
    for role in ("expert", "guest"):
        assert asked(world.client(role), "GET", f"/api/cases/{world.other.id}/files/{sha256}").status_code == 404
    for odd in (
        "../" * 6 + "etc/passwd",
        "..%2f..%2fhub.sqlite",
        "%2e%2e",
        "0" * 63,
        "A" * 64,
        "0" * 64 + "%0a",
        "%00",
    ):
        answer = asked(world.client("operator"), "GET", f"/api/cases/{world.case.id}/files/{odd}")
        assert answer.status_code in (404, 405, 422), (odd, answer.status_code)
    for odd in ("case-" + "0" * 20 + "%0a", "..%2f", "case-" + "0" * 19 + "%00"):
        assert asked(world.client("operator"), "GET", f"/api/cases/{odd}/state").status_code in (404, 422)


def test_limits_are_those_that_are_written_down() -> None:
    """A change of one of these is a decision, not a slip."""
    x = Limits()
    assert (x.failures, x.locked_s, x.session_s, x.idle_s) == (8, 300.0, 43_200.0, 3600.0)
    assert (x.logins_per_minute, x.requests_per_s, x.ops_per_s, x.message_bytes) == (20.0, 100.0, 40.0, 1_000_000)
    assert (x.log_bytes_per_s, x.log_bytes_burst, x.videos_each, x.connections_each) == (20_000.0, 8_000_000, 10, 500)


def test_the_folder_of_a_hub_is_its_own(world: World) -> None:
    assert world.hub.config.data.stat().st_mode & 0o077 == 0
    with Client(world.hub.url) as nobody:
        for path in ("/hub.sqlite", "/../hub.sqlite", "/%2e%2e/hub.sqlite", "/files/", "/api/../hub.lock"):
            assert asked(nobody, "GET", path).status_code == 404
