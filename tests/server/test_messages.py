"""What comes through a room's socket and is not what should: each is answered with a sentence, and the room goes on."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from fringescope.client import Client, HubCase
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from fringescope.wire.room import FromServer
from tests.server.conftest import PASSWORD, SignIn, both, checked, populate
from tests.server.test_hub import RIG, SCAN, scanned, stroke

FROM_SERVER: TypeAdapter[Any] = TypeAdapter(FromServer)


def open_socket(case: HubCase) -> Any:
    cookies = "; ".join(f"{c.name}={c.value}" for c in case.hub.http.cookies.jar)
    url = case.hub.url.replace("http", "ws", 1) + f"/api/cases/{case.id}/room"
    return connect(url, additional_headers={"Cookie": cookies}, compression=None, max_size=None)


def no_number(name: str) -> None:
    raise AssertionError(f"{name} is no number that a browser reads")


def until(socket: ClientConnection, *types: str) -> dict[str, Any]:
    """The next message of one of these types. All must be as they are described."""
    while True:
        text = socket.recv(timeout=10)
        assert isinstance(text, str)
        FROM_SERVER.validate_json(text)
        json.loads(text, parse_constant=no_number)
        m: dict[str, Any] = json.loads(text)
        if m["type"] in types:
            return m


def say(what: Any, number: Any = 1, client: Any = "c", **more: Any) -> str:
    return json.dumps({"type": "say", "op": {"client": client, "number": number, "what": what}, **more})


def put(**changes: Any) -> dict[str, Any]:
    return {"kind": "put", "stroke": {**stroke("s"), **changes}, "scan": SCAN}


COMMENT = {"kind": "comment", "comment": "c1", "text": "hello"}
NOT_UNDERSTOOD = {
    "nothing": "",
    "no JSON": "hello",
    "half of it": say(COMMENT)[:-5],
    "a list": "[1, 2, 3]",
    "null": "null",
    "bytes": b'{"type":"ping"}',
    "empty bytes": b"",
    "no type": "{}",
    "unknown type": json.dumps({"type": "shutdown"}),
    "a server's type": json.dumps({"type": "event", "seq": 1}),
    "unknown kind": say({"kind": "paint"}),
    "the instrument's word": say({"kind": "ScanTaken", "scan": "x", "rig": "y"}),
    "the hub's word": say({"kind": "erased", "through": 99}),
    "somebody else's name": say(COMMENT)[:-2] + ', "actor": "p"}}',
    "a further field": say(COMMENT, seq=1),
    "a further field of two lines": say(COMMENT, **{"a\n\x00b": 1}),
    "a further field inside": say({**COMMENT, "author": "somebody"}),
    "deep lists": "[" * 100_000,
    "deep objects": '{"a":' * 50_000 + "1" + "}" * 50_000,
    "deep where a place is": say({**COMMENT, "place_mm": json.loads("[" * 900 + "]" * 900)}),
    "NaN": say(put(width_mm=math.nan)),
    "NaN in a pixel": say(put(pixels=[[math.nan, 1.0], [2.0, 3.0]])),
    "infinite": say(put(pixels=[[math.inf, 1.0], [2.0, 3.0]])),
    "beyond all pixels": say(put(pixels=[[1e300, 1.0], [2.0, 3.0]])),
    "NaN in a ping": '{"type":"ping","at_ms":NaN}',
    "number 0": say(COMMENT, 0),
    "a number below": say(COMMENT, -5),
    "a number without end": '{"type":"say","op":{"client":"c","number":1' + "0" * 6000 + ',"what":{"kind":"undo"}}}',
    "a number of 60 digits": say(COMMENT, 10**60),
    "a number as text": say(COMMENT, "one"),
    "half a number": say(COMMENT, 1.5),
    "true as number": '{"type":"say","op":{"client":"c","number":{},"what":{"kind":"undo"}}}',
    "a client with spaces": say(COMMENT, 1, "a b\n"),
    "a client of 65 letters": say(COMMENT, 1, "a" * 65),
    "half a surrogate": say({**COMMENT, "text": "\ud800"}),
    "NUL in a name": say({**COMMENT, "comment": "a\x00b"}),
    "a name of 201 letters": say({**COMMENT, "comment": "a" * 201}),
    "a comment of 4001 letters": say({**COMMENT, "text": "a" * 4001}),
    "5001 points": say(put(pixels=[[1.0, 2.0]] * 5001)),
    "no points": say(put(pixels=[])),
    "points of four": say(put(pixels=[[1, 2, 3, 4]])),
    "a script as colour": say(put(color="<script>alert(1)</script>")),
    "ink of 501 points": json.dumps({"type": "ink", "stroke": "s", "points": [[1, 2]] * 501}),
    "a pointer at text": json.dumps({"type": "pointer", "pixel": ["a", "b"]}),
}  # fmt: skip


@pytest.fixture
def quick(tmp_path: Any) -> Iterator[Server]:
    """A hub that lets everybody say as much as they like."""
    limits = Limits(ops_per_s=1e6, ops_burst=10**6, log_bytes_burst=10**9, live_per_s=1e6, message_bytes=600_000)
    with Server(Config(tmp_path / "hub", port=0, limits=limits), fast_passwords=True) as server:
        populate(server)
        yield server


def test_what_is_no_message(quick: Server) -> None:
    """Each is refused with one sentence, none leaves a trace, and the next good message is taken."""
    with Client(quick.url, "operator", PASSWORD) as operator:
        case = scanned(quick, operator)
        with open_socket(case) as socket:
            until(socket, "caught_up")
            for name, message in NOT_UNDERSTOOD.items():
                socket.send(message)
                refused = until(socket, "refusal", "said", "event", "pong")
                assert refused["type"] == "refusal", name
                assert refused["why"].startswith("a message"), name
                assert "\n" not in refused["why"], name
                assert len(refused["why"]) <= 300, name
                assert "https://" not in refused["why"], name
            assert case.get().seq == 3
            socket.send(say(COMMENT))
            assert until(socket, "said") == {"type": "said", "client": "c", "number": 1, "seq": 4, "refused": ""}


def test_what_is_too_long(quick: Server) -> None:
    """Long: refused. Longer than can be meant: that connection ends, with the code for it; nobody else notices."""
    with Client(quick.url, "operator", PASSWORD) as operator:
        case = scanned(quick, operator)
        with open_socket(case) as socket, case.enter() as room:
            until(socket, "caught_up")
            socket.send(say({**COMMENT, "text": "x" * 700_000}))
            why = until(socket, "refusal")["why"]
            assert "at most 600000 are taken" in why

            def say_on() -> None:
                socket.send("x" * 3_000_000)
                until(socket, "never")

            with pytest.raises(ConnectionClosed) as e:
                say_on()
            assert e.value.rcvd is None or e.value.rcvd.code == 1009  # None: cut while all that was still being sent
            room.draw(stroke("s"))
            assert room.seq == 4


def test_text_that_is_no_text(quick: Server) -> None:
    with Client(quick.url, "operator", PASSWORD) as operator:
        case = scanned(quick, operator)
        with open_socket(case) as socket:
            until(socket, "caught_up")
            socket.send(b"\xff\xfe", text=True)
            with pytest.raises(ConnectionClosed) as e:
                until(socket, "never")
            assert e.value.rcvd is not None
            assert e.value.rcvd.code == 1007
        assert case.get().seq == 3


def test_numbers_that_go_back_and_come_twice(quick: Server) -> None:
    """Any order of numbers is taken, as the messages came; each number once, whatever it says the second time."""
    with Client(quick.url, "operator", PASSWORD) as operator:
        case = scanned(quick, operator)
        with open_socket(case) as socket:
            until(socket, "caught_up")
            answers = []
            for number, text in ((5, "five"), (3, "three"), (5, "other"), (2**53, "last"), (1, "one"), (3, "again")):
                socket.send(say({**COMMENT, "comment": text, "text": text}, number))
                answers.append(until(socket, "said"))
            assert [a["seq"] for a in answers] == [4, 5, 4, 6, 7, 5]
            texts = [e.payload["text"] for e in case.events(since=3) if e.payload]
            assert texts == ["five", "three", "last", "one"]


@pytest.mark.parametrize(
    "what",
    [
        {**COMMENT, "text": "a\x00b \U0001f52c \u202e abc \ufeff"},
        {**COMMENT, "version": 10**30},
        {"kind": "layer", "layer": "l", "name": "\x00\x1b[31m"},
        {"kind": "stop", "why": "\x00' OR 1=1; DROP TABLE events; --\n\n"},
        {**put(color="\x00"), "layer": "\x00"},
        put(text="\x00\x07", kind="text"),
        {"kind": "undo", "of": 2**70},
        {"kind": "sign", "version": -(10**30), "content": "x", "meaning": "approved"},
        {"kind": "preview", "version": 10**200},
        {"kind": "acknowledge", "suspect": "9" * 19},
        {"kind": "start", "version": 10**30, "pattern": "%s %(x)s {} \\"},
        {"kind": "submit", "strokes": [["__proto__", "constructor"]] * 1000, "scan": SCAN, "rig": RIG},
        {"kind": "submit", "strokes": [["s", "x"]], "scan": "../../etc/passwd", "rig": RIG},
    ],
    ids=lambda w: str(w["kind"]),
)
@both
def test_strange_words_of_the_right_form(hub: Server, sign_in: SignIn, what: dict[str, Any]) -> None:
    """Taken or refused, always answered; what is in the log is what was said, and the chain is whole."""
    case = scanned(hub, sign_in("operator"))
    with open_socket(case) as socket:
        until(socket, "caught_up")
        socket.send(say(what))
        said = until(socket, "said")
        assert "bug" not in said["refused"]
        socket.send(say(COMMENT | {"comment": "next"}, 2))
        assert until(socket, "said")["refused"] == ""
    log = case.events(since=3)
    if said["seq"] is not None:
        assert log[0].kind == what["kind"]
        assert log[0].refused == said["refused"]
        for key in ("text", "why", "version", "name"):
            if key in what and said["refused"] == "":
                assert log[0].payload is not None
                assert log[0].payload[key] == what[key]
    assert checked(hub.site.engine)[2] == []
    assert case.state().seq == log[-1].seq


# ------------------------------------------------------------------------------------------------------------ at random

leaves = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
    | st.sampled_from([SCAN, RIG, "s", "c1", "put", "camera1", 10**40, -1, 2**53, "\x00"])
)  # fmt: skip
anything = st.recursive(leaves, lambda x: st.lists(x, max_size=4) | st.dictionaries(st.text(max_size=8), x, max_size=4))
GOOD: list[dict[str, Any]] = [
    put(), COMMENT, {"kind": "undo", "of": None}, {"kind": "remove", "stroke": "s"},
    {"kind": "layer", "layer": "l", "name": "n", "hidden": False}, {"kind": "stop", "version": None, "why": ""},
    {"kind": "submit", "strokes": [["s", "x"]], "scan": SCAN, "rig": RIG}, {"kind": "withdraw", "comment": "c1"},
    {"kind": "sign", "version": 1, "content": "x", "meaning": "approved"}, {"kind": "preview", "version": 1},
    {"kind": "arm", "version": 1, "content": "x", "pattern": "y"}, {"kind": "start", "version": 1, "pattern": "y"},
    {"kind": "acknowledge", "suspect": "1"}, {"kind": "carry_over", "version": 1, "scan": SCAN, "job": "j"},
]  # fmt: skip


@st.composite
def nearly(draw: Any) -> Any:
    """A good message of which a part was replaced by something else, or that has a part too much or too few."""
    what = draw(st.sampled_from(GOOD))
    message: Any = {"type": "say", "op": {"client": "h", "number": draw(st.integers(1, 10**6)), "what": what}}
    live = {"type": draw(st.sampled_from(["ink", "pointer", "view", "ping"])), "stroke": "s", "points": [[1.0, 2.0]]}
    message = json.loads(json.dumps(draw(st.sampled_from([message, message, live]))))
    place = message
    while isinstance(place, dict) and place:
        key = draw(st.sampled_from(sorted(place)))
        if isinstance(place[key], dict) and draw(st.integers(0, 4)):
            place = place[key]
            continue
        change = draw(st.sampled_from(["replace", "replace", "remove", "add"]))
        if change == "remove":
            del place[key]
        else:
            place[key if change == "replace" else draw(st.text(max_size=8))] = draw(anything)
        break
    return message


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, HubCase, ClientConnection]]:
    limits = Limits(ops_per_s=1e6, ops_burst=10**6, log_bytes_burst=10**9, live_per_s=1e6)
    with ExitStack() as stack:
        folder = tmp_path_factory.mktemp("messages")
        server = stack.enter_context(Server(Config(folder, port=0, limits=limits), fast_passwords=True))
        populate(server)
        case = scanned(server, stack.enter_context(Client(server.url, "operator", PASSWORD)))
        socket = stack.enter_context(open_socket(case))
        until(socket, "caught_up")
        yield server, case, socket


def alive(room: tuple[Server, HubCase, ClientConnection], message: Any) -> None:
    """A message is answered or ignored by its kind, and the room goes on."""
    socket = room[2]
    socket.send(message if isinstance(message, str) else json.dumps(message))
    socket.send('{"type":"ping","at_ms":7}')
    said = 0
    while (m := until(socket, "pong", "refusal", "said"))["type"] != "pong" or m["at_ms"] != 7:
        said += 1
        assert "bug" not in m.get("refused", "") + m.get("why", "")
    if isinstance(message, dict) and message.get("type") == "say" and not said:
        assert until(socket, "said", "refusal")["type"]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@example(message=json.loads(say(put(kind="text", text=""))))
@given(message=nearly() | anything)
def test_messages_at_random(room: tuple[Server, HubCase, ClientConnection], message: Any) -> None:
    alive(room, message)


@pytest.mark.verify
@settings(max_examples=5000, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(message=nearly() | anything)
def test_many_messages_at_random(room: tuple[Server, HubCase, ClientConnection], message: Any) -> None:
    alive(room, message)


def test_after_all_that_the_log_is_whole(room: tuple[Server, HubCase, ClientConnection]) -> None:
    server, case, _ = room
    assert checked(server.site.engine)[2] == []
    truth = case.state()
    server.site.hub._books.clear()  # folded anew from the log it is the same
    assert case.state() == truth
