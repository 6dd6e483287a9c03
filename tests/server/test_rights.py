"""Who may do what: every route and every message, by everybody; a new one without a line here fails."""

from __future__ import annotations

import itertools
import json
import socket as sockets
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import httpx
import pytest

from fringescope.client import Client
from fringescope.errors import UsageError
from fringescope.server.config import Config
from fringescope.server.rights import MAY, WORDS
from fringescope.wire.ops import Op
from fringescope.wire.room import FromClient
from tests.server.conftest import PASSWORD
from tests.server.people_scenes import ROLES, World, asked, heard, hub_at, op, room_of, say, world_at
from tests.server.test_hub import SCAN, stroke

PEOPLE = ROLES[1:]  #: everybody who came in
ALL = " ".join(PEOPLE)
ANYBODY = " ".join(ROLES)
DRAW = "guest expert operator"
TALK = "guest watcher observer expert operator"


@dataclass(frozen=True)
class Row:
    """A route: who may, what they get, with which body; `other`: who gets something else."""

    may: str
    ok: int
    body: Any = None
    other: dict[str, int] = field(default_factory=dict)
    ends: bool = False  #: ends the session that asks
    fresh: bool = False  #: ends the case that it is asked of

    def expected(self, role: str) -> int:
        if role in self.other:
            return self.other[role]
        return self.ok if role in self.may.split() else 401 if role == "stranger" else 403


OP = {"client": "c", "number": 1, "what": {"kind": "carry_over", "version": 1, "scan": SCAN, "job": "job-1"}}
NEW = {"name": "newcomer", "password": PASSWORD, "role": "observer"}
GUESTS = {"guest": 403, "watcher": 403}

#: 401, 404 and 503 here come behind the question who may: a login that is none, something that is not there
ROUTES: dict[str, Row] = {
    "GET /openapi.json": Row(ANYBODY, 200),
    "GET /api/health": Row(ANYBODY, 200),
    "GET /api/ways": Row(ANYBODY, 200),
    "POST /api/login": Row(ANYBODY, 401, {"name": "nobody", "password": "x"}),
    "POST /api/invitations/accept": Row(ANYBODY, 401, {"token": "x", "code": "y"}),
    "GET /api/provider/begin": Row(ANYBODY, 404),
    "GET /api/provider/callback": Row(ANYBODY, 404),
    "POST /api/passkeys/ask": Row(ANYBODY, 200),
    "POST /api/passkeys/login": Row(ANYBODY, 401, {"credential": {}}),
    "POST /api/logout": Row(ALL, 200, ends=True),
    "GET /api/me": Row(ALL, 200),
    "POST /api/confirm": Row(ALL, 200, {"password": PASSWORD}, {"guest": 401, "watcher": 401}),
    "POST /api/password": Row(ALL, 200, {"old": PASSWORD, "new": PASSWORD}, {"guest": 401, "watcher": 401}, True),
    "GET /api/passkeys": Row(ALL, 200, None, GUESTS),
    "POST /api/passkeys": Row(ALL, 400, {"credential": {}}, GUESTS),
    "POST /api/passkeys/new": Row(ALL, 200, None, GUESTS),
    "POST /api/passkeys/confirm": Row(ALL, 401, {"credential": {}}, GUESTS),
    "DELETE /api/passkeys/{key}": Row(ALL, 404, None, GUESTS),
    "GET /api/people": Row("operator admin", 200),
    "POST /api/people": Row("admin", 201, NEW),
    "PATCH /api/people/{person}": Row("admin", 200, {}),
    "GET /api/cases": Row(ALL, 200),
    "POST /api/cases": Row("operator", 201, {"accession": "S26-new"}),
    "GET /api/cases/{case}": Row(ALL, 200),
    "PATCH /api/cases/{case}": Row("operator", 200, {"status": "open"}),
    "GET /api/cases/{case}/events": Row(ALL, 200),
    "GET /api/cases/{case}/state": Row(ALL, 200),
    "POST /api/cases/{case}/ops": Row(ALL, 200, []),
    "GET /api/cases/{case}/members": Row("operator", 200),
    "PUT /api/cases/{case}/members/{person}": Row("operator", 200),
    "DELETE /api/cases/{case}/members/{person}": Row("operator", 404),
    "GET /api/cases/{case}/invitations": Row("operator", 200),
    "POST /api/cases/{case}/invitations": Row("operator", 201, {"name": "Gast"}),
    "DELETE /api/cases/{case}/invitations/{invitation}": Row("operator", 404),
    "GET /api/cases/{case}/scans": Row(ALL, 200),
    "POST /api/cases/{case}/scans": Row("operator", 202, {}),
    "POST /api/cases/{case}/carry": Row("operator", 202, {"version": 1}),
    "POST /api/cases/{case}/carry_over": Row("operator", 400, OP),
    "POST /api/cases/{case}/compare": Row("operator", 202, {"before": "a", "after": "b"}),
    "GET /api/cases/{case}/files": Row(ALL, 200),
    "GET /api/cases/{case}/files/{sha256}": Row(ALL, 404),
    "GET /api/jobs": Row("operator", 200),
    "GET /api/jobs/{job}": Row(TALK, 404),
    "DELETE /api/jobs/{job}": Row("operator", 404),
    "GET /api/instrument": Row(ALL, 200),
    "POST /api/instrument/stop": Row(ALL, 200),
    "POST /api/instrument/poses": Row("operator", 202, {}),
    "POST /api/instrument/calibrate": Row("operator", 202),
    "POST /api/instrument/simulate": Row("operator", 409, {"move": "1,0,0"}),
    "GET /api/audit": Row("admin", 200),
    "GET /api/cases/{case}/bundle": Row(DRAW, 200),
    "POST /api/cases/import": Row("operator", 400, {}),
    "POST /api/cases/{case}/scans/import": Row("operator", 202, {}),
    "POST /api/cases/{case}/erase": Row("admin", 200, {"why": "asked for"}, fresh=True),
}
SOCKETS = {"/api/cases/{case}/room": ALL, "/api/cases/{case}/video/{camera}": TALK,
           "/api/cases/{case}/webrtc/{camera}": TALK}  # fmt: skip

#: what somebody says: who may, and how it looks
SAID: dict[str, tuple[str, dict[str, Any]]] = {
    "put": (DRAW, {"stroke": stroke("s"), "scan": SCAN}),
    "remove": (DRAW, {"stroke": "s"}),
    "layer": (DRAW, {"layer": "l", "name": "mine"}),
    "undo": (DRAW, {}),
    "submit": (DRAW, {"strokes": [["s", "0" * 64]], "scan": SCAN, "rig": "r"}),
    "comment": (TALK, {"comment": "c", "text": "look"}),
    "withdraw": (TALK, {"comment": "c"}),
    "sign": (DRAW, {"version": 1, "content": "x", "meaning": "approved"}),
    "preview": ("operator", {"version": 1}),
    "arm": ("operator", {"version": 1, "content": "x", "pattern": "x"}),
    "start": ("operator", {"version": 1, "pattern": "x"}),
    "acknowledge": ("operator", {"suspect": "1"}),
    "stop": (ALL, {}),
    "carry_over": ("", {"version": 1, "scan": SCAN, "job": "job-1"}),  # by its own route alone
}
LOCAL = ("preview", "arm", "start", "acknowledge")
#: what belongs to who stands at the instrument, beside these words: whatever projects, or moves what lies there
AT_THE_INSTRUMENT = ("POST /api/cases/{case}/scans", "POST /api/instrument/poses", "POST /api/instrument/calibrate",
                     "POST /api/instrument/simulate")  # fmt: skip
LIVE: dict[str, tuple[str, dict[str, Any]]] = {
    "pointer": (TALK, {"camera": "camera1", "pixel": [1, 2]}),
    "view": (TALK, {"eye_mm": [0, 0, 1], "target_mm": [0, 0, 0], "up": [0, 1, 0]}),
    "ink": (DRAW, {"stroke": "s", "points": [[1, 2]]}),
}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with world_at(tmp_path_factory.mktemp("rights")) as made:
        yield made


def test_the_description_says_how_one_is_known(world: World) -> None:
    """Cookie and token, for each route that is not for anybody."""
    told = world.hub.app.openapi()
    schemes = told["components"]["securitySchemes"]
    assert {(s["in"], s["name"]) for s in schemes.values()} == {("cookie", "fringescope"), ("header", "X-CSRF-Token")}
    for route, row in ROUTES.items():
        method, path = route.split()
        if path.startswith("/api"):
            asked_for = {k for way in told["paths"][path][method.lower()].get("security", []) for k in way}
            assert asked_for == (set() if row.may == ANYBODY else {"session", "token"}), route


def flat(routes: Any) -> Iterator[Any]:
    """All routes of an app, those of the routers that it includes, too."""
    for route in routes:
        inner = getattr(route, "original_router", None)
        yield from flat(inner.routes) if inner is not None else [route]


def test_every_route_and_message_has_its_line(world: World) -> None:
    app, http, rooms = world.hub.app, set(), set()
    for route in flat(app.routes):
        methods = getattr(route, "methods", None)
        if methods is None:
            assert type(route).__name__ == "APIWebSocketRoute", f"{route}: neither a route nor a room"
            rooms.add(route.path)
        else:
            http |= {f"{m} {route.path}" for m in methods - {"HEAD", "OPTIONS"}}
    assert http == set(ROUTES)
    assert rooms == set(SOCKETS)
    described = {f"{m.upper()} {p}" for p, ways in app.openapi()["paths"].items() for m in ways}
    assert described == http - {"GET /openapi.json"}
    union = get_args(Op.model_fields["what"].annotation)
    assert {t.model_fields["kind"].default for t in union} == set(SAID)
    messages = {t.model_fields["type"].default for t in get_args(get_args(FromClient)[0])}
    assert messages == set(LIVE) | {"say", "ping"}


def filled(world: World, path: str, case: str) -> str:
    person = world.client("expert").me.person.id
    names = {"{case}": case, "{sha256}": "0" * 64, "{job}": "job-" + "0" * 20, "{invitation}": "invitation-0",
             "{key}": "AAAA", "{person}": person}  # fmt: skip
    for name, value in names.items():
        path = path.replace(name, value)
    return path


@pytest.mark.parametrize("route", ROUTES)
def test_every_route_by_everybody(world: World, route: str) -> None:
    row, (method, path) = ROUTES[route], route.split()
    case = world.client("operator").open_case("S26-fresh").id if row.fresh else world.case.id
    path = filled(world, path, case)
    if route == "DELETE /api/cases/{case}/members/{person}":
        path = path.rsplit("/", 1)[0] + "/person-0"
    found = {}
    for role in ROLES:
        client = world.enter(role) if row.ends else world.client(role)
        answer = asked(client, method, path, row.body)
        found[role] = answer.status_code
        if answer.status_code >= 400:
            assert set(answer.json()) == {"detail"}, answer.text
        if route == "POST /api/password" and answer.status_code == 200:  # all their sessions ended
            world.clients.pop(role, None)
            world.case.hub = world.other.hub = world.client("operator")
    assert found == {role: row.expected(role) for role in ROLES}


CASES = [r for r in ROUTES if "{case}" in r]


@pytest.mark.parametrize("route", CASES)
def test_a_case_that_one_was_not_let_into_is_not_there(world: World, route: str) -> None:
    row, (method, path) = ROUTES[route], route.split()
    before = len(world.other.events())
    for role in ("guest", "watcher", "observer", "expert"):
        answer = asked(world.client(role), method, filled(world, path, world.other.id), row.body)
        assert answer.status_code == (404 if role in row.may.split() else 403), (role, answer.text)
        assert world.other.id not in answer.text
        nowhere = asked(world.client(role), method, filled(world, path, "case-" + "0" * 20), row.body)
        assert (nowhere.status_code, nowhere.text) == (answer.status_code, answer.text)  # nor can one tell
    assert len(world.other.events()) == before


@pytest.mark.parametrize("route", [r for r in ROUTES if not r.startswith("GET")])
def test_what_changes_something_needs_the_token_and_a_page_of_ours(world: World, route: str) -> None:
    row, (method, path) = ROUTES[route], route.split()
    path, operator = filled(world, path, world.case.id), world.client("operator")
    if row.may != ANYBODY:
        for wrong in ({}, {"x_csrf_token": ""}, {"x_csrf_token": "a" * 32}, {"x_csrf_token": "ä"}):
            sent = {k: v.encode("latin-1").decode("latin-1") for k, v in wrong.items()}
            named = {k.replace("_", "-").encode(): v.encode("latin-1") for k, v in sent.items()}
            answer = operator.http.request(method, path, json=row.body, headers=list(named.items()))
            assert (answer.status_code, "X-CSRF-Token" in answer.text) == (403, True), (wrong, answer.text)
    foreign = ("https://evil.example", "null", f"http://127.0.0.1:{world.hub.config.port + 1}", "", world.hub.url + "0")
    for origin in foreign:
        answer = asked(operator, method, path, row.body, origin=origin)
        assert (answer.status_code, "another site" in answer.text) == (403, True), (origin, answer.text)
    answer = asked(operator, method, path, row.body, sec_fetch_site="cross-site")
    assert answer.status_code == 403


def test_the_list_of_cases_shows_what_one_may_see(world: World) -> None:
    for role, seen in (("guest", 1), ("watcher", 1), ("expert", 1), ("observer", 1)):
        assert [c.id for c in world.client(role).cases().cases] == [world.case.id][:seen]
    assert {world.case.id, world.other.id} <= {c.id for c in world.client("admin").cases(limit=500).cases}
    world.other.change(patient={"name": "Erika Muster", "identifier": "4711", "born": "1950"})
    assert world.other.get().patient is not None
    admin = world.client("admin")
    assert admin.case(world.other.id).get().patient is None
    assert admin.cases("Muster").total == 0
    assert world.client("operator").cases("Muster").total == 1


# ------------------------------------------------------------------------------------------------------------ messages


def judged(role: str, kind: str, may: str, answer: dict[str, Any]) -> None:
    """That a message had the outcome that its line promises."""
    name = {"guest": "expert", "watcher": "observer"}.get(role, role)
    said = answer.get("refused", answer.get("why", ""))
    if kind == "carry_over":
        assert "use the route" in said
    elif role in may.split():
        assert "is not for" not in said, said
        assert "at the instrument" not in said, said
    else:
        assert said == f"{WORDS.get(kind, kind)} is not for the {name} to do"


@pytest.mark.parametrize("role", PEOPLE)
def test_every_message_by_everybody(world: World, role: str) -> None:
    client = world.enter(role)
    before = client.case(world.case.id).state()
    with room_of(client, world.case.id) as room, room_of(world.client("operator"), world.case.id) as other:
        heard(room, "caught_up")
        heard(other, "caught_up")
        for kind, (may, what) in SAID.items():
            judged(role, kind, may, say(room, {"kind": kind} | what))
        room.send('{"type": "ping", "at_ms": 5}')
        assert heard(room, "pong")["at_ms"] == 5
        for kind, (may, what) in LIVE.items():
            room.send(json.dumps({"type": kind} | what))
            if role in may.split():
                relayed = heard(other, "relayed")
                assert (relayed["person"], relayed["what"]["type"]) == (client.me.person.id, kind)
            else:
                judged(role, kind, may, heard(room, "refusal"))
    state = client.case(world.case.id).state()
    if role == "admin":
        assert (state.strokes, state.layers, state.comments) == (before.strokes, before.layers, before.comments)


@pytest.mark.parametrize("role", PEOPLE)
def test_every_message_by_everybody_as_after_a_time_offline(world: World, role: str) -> None:
    client = world.enter(role)
    for kind, (may, what) in SAID.items():
        body = [op({"kind": kind} | what)]
        answer = asked(client, "POST", f"/api/cases/{world.case.id}/ops", body)
        judged(role, kind, may, {"why": answer.json()["detail"]} if kind == "carry_over" else answer.json()[0])


def test_rights_hold_what_the_lines_here_say() -> None:
    roles = {"observer", "expert", "operator", "admin"}
    for kind, (may, _) in (SAID | LIVE).items():
        if kind != "carry_over":
            assert {r.value for r in MAY[kind]} == roles & set(may.split()), kind


@pytest.mark.parametrize("path", SOCKETS)
def test_every_room_by_everybody(world: World, path: str) -> None:
    from tests.server.people_scenes import closed, connect, cookies

    for role, own in itertools.product(ROLES, (True, False)):
        client = world.client(role)
        url = client.url.replace("http", "ws") + path.replace("{camera}", "camera1") + "?since=1000000"
        url = url.replace("{case}", world.case.id if own else world.other.id)
        with connect(url, additional_headers={"Cookie": cookies(client)}, compression=None) as room:
            if role in SOCKETS[path].split() and (own or role in ("operator", "admin")):
                first = json.loads(room.recv(10))
                assert first["type"] == "welcome" or "no instrument" in first["why"]
                continue
            code, why = closed(room)
            assert code == (4401 if role == "stranger" else 4403 if own or role == "admin" else 4404), why
            assert why


# ------------------------------------------------------------------------------------------------- only who is there


def refused_from_afar(client: Client, case: str, **headers: str) -> None:
    """That nothing that belongs to who stands at the instrument is taken from this client."""
    me = asked(client, "GET", "/api/me", **headers).json()
    assert me["local"] is False, headers
    for route in AT_THE_INSTRUMENT:
        method, path = route.split()
        answer = asked(client, method, path.replace("{case}", case), ROUTES[route].body, **headers)
        assert (answer.status_code, "at the instrument; from afar" in answer.text) == (403, True), (route, answer.text)
    assert asked(client, "POST", "/api/instrument/stop", **headers).status_code == 200
    with room_of(client, case, **headers) as room:
        assert heard(room, "welcome")["local"] is False
        for kind in LOCAL:
            answer = say(room, {"kind": kind} | SAID[kind][1])
            assert answer["refused"].startswith(f"{kind} is for the operator at the instrument;")
        assert "at the instrument" not in say(room, {"kind": "stop"})["refused"]
    for kind in LOCAL:
        body = [op({"kind": kind} | SAID[kind][1])]
        answer = asked(client, "POST", f"/api/cases/{case}/ops", body, **headers)
        assert "at the instrument" in answer.json()[0]["refused"], headers


FORWARDED = {
    "X_Forwarded_For": "203.0.113.9", "X_Forwarded_Proto": "https", "X_Real_IP": "127.0.0.1", "Via": "1.1 proxy",
    "Forwarded": "for=127.0.0.1", "X_Forwarded_Host": "localhost", "CF_Connecting_IP": "127.0.0.1",
    "Host": "hub.hospital.example",
}  # fmt: skip


@pytest.mark.parametrize("header", FORWARDED)
def test_who_comes_through_another_server_is_not_at_the_instrument(world: World, header: str) -> None:
    client = world.enter("operator")
    assert client.me.local
    refused_from_afar(client, world.case.id, **{header: FORWARDED[header]})


def test_a_page_from_elsewhere_is_not_at_the_instrument(tmp_path: Path) -> None:
    """A proxy that tells nothing still hands on what the browser says of its page."""
    with world_at(tmp_path, origins=("https://hub.hospital.example",)) as world:
        refused_from_afar(world.client("operator"), world.case.id, Origin="https://hub.hospital.example")


def test_behind_a_proxy_nobody_is_at_the_instrument(tmp_path: Path) -> None:
    with world_at(tmp_path, behind_proxy=True) as world:
        refused_from_afar(world.client("operator"), world.case.id)


def test_behind_a_proxy_a_port_of_its_own_is_for_who_is_there(tmp_path: Path) -> None:
    """Whoever comes by the port that the proxy hands on is elsewhere; by the other one it is as without a proxy."""
    with world_at(tmp_path, behind_proxy=True, local_port=0) as world:
        port = world.hub.config.local_port
        assert port not in (None, 0, world.hub.config.port)
        refused_from_afar(world.client("operator"), world.case.id)
        page = f"http://localhost:{port}"
        with Client(f"http://127.0.0.1:{port}", "operator", PASSWORD) as here:
            assert here.me.local
            with room_of(here, world.case.id, Origin=page) as room:
                assert heard(room, "welcome")["local"]
                assert "at the instrument" not in say(room, {"kind": "arm"} | SAID["arm"][1])["refused"]
            for header, value in FORWARDED.items():  # a proxy that was set up for the wrong port is one all the same
                refused_from_afar(here, world.case.id, **{header: value})
            assert asked(here, "POST", f"/api/cases/{world.case.id}/scans", {}, origin=page).status_code == 202
        with httpx.Client(base_url=f"http://127.0.0.2:{port}") as elsewhere, pytest.raises(httpx.ConnectError):
            elsewhere.get("/api/health")


def test_a_port_for_who_is_there_needs_a_proxy(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="for a hub --behind-proxy"):
        Config(tmp_path, local_port=0)


def test_another_address_is_not_at_the_instrument(world: World) -> None:
    with httpx.Client(base_url=world.hub.url, transport=httpx.HTTPTransport(local_address="127.0.0.2")) as http:
        client = Client(world.hub.url, "operator", PASSWORD, http=http)
        assert client.me.local is False
        body = [op({"kind": "start", "version": 1, "pattern": "x"})]
        answer = asked(client, "POST", f"/api/cases/{world.case.id}/ops", body)
        assert "at the instrument" in answer.json()[0]["refused"]


def test_an_old_proxy_is_not_at_the_instrument(world: World) -> None:
    """HTTP/1.0 is what a proxy speaks that nobody has set up."""
    client, config = world.client("operator"), world.hub.config
    from tests.server.people_scenes import cookies

    for version, local in (("1.0", False), ("1.1", True)):
        with sockets.create_connection((config.host, config.port), 10) as raw:
            lines = [f"GET /api/me HTTP/{version}", f"Host: 127.0.0.1:{config.port}", f"Cookie: {cookies(client)}"]
            raw.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
            answer = b"".join(iter(lambda raw=raw: raw.recv(65536), b""))
        assert json.loads(answer.split(b"\r\n\r\n", 1)[1])["local"] is local


def test_a_hub_without_tls_still_needs_a_page_of_its_own(tmp_path: Path) -> None:
    """A name that was bent to this machine (DNS rebinding) is no page of ours, whatever the Host header says."""
    with hub_at(tmp_path) as hub, Client(hub.url) as nobody:
        body = {"name": "operator", "password": PASSWORD}
        evil = f"evil.example:{hub.config.port}"
        answer = asked(nobody, "POST", "/api/login", body, Host=evil, Origin=f"http://{evil}")
        assert answer.status_code == 403
