"""Passwords, lock-out, sessions, and what a page or a program from elsewhere may try."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from websockets.exceptions import ConnectionClosed

from fringescope.client import Client, HubError
from fringescope.errors import UsageError
from fringescope.server import database as db
from fringescope.server.accounts import SignInError, plain_name
from fringescope.server.clock import Clock
from fringescope.server.config import Limits
from fringescope.server.lockout import Lockout
from fringescope.server.running import Server
from fringescope.wire import PersonRole
from tests.server.conftest import PASSWORD, SignIn
from tests.server.people_scenes import WIDE, asked, closed, cookies, heard, hub_at, later, op, room_of, say
from tests.server.test_hub import invite, scanned


@pytest.fixture
def wide(tmp_path: Path) -> Iterator[Server]:
    with hub_at(tmp_path, replace(WIDE, doors_s=0.1)) as made:
        yield made


def tried(hub: Server, name: str, password: str, address: str = "127.0.0.1") -> httpx.Response:
    with httpx.Client(base_url=hub.url, transport=httpx.HTTPTransport(local_address=address)) as http:
        return http.post("/api/login", json={"name": name, "password": password})


# ----------------------------------------------------------------------------------------------------------- passwords


def test_a_password_is_kept_as_argon2id_and_a_cookie_as_a_digest(hub: Server, sign_in: SignIn) -> None:
    client = sign_in("expert")
    secret = client.http.cookies["fringescope"]
    assert len(secret) >= 43  # 256 bits
    with hub.site.engine.connect() as c:
        hashes = list(c.execute(sa.select(db.people.c.password)).scalars())
    assert all(h.startswith("$argon2id$v=19$") for h in hashes)
    assert len(set(hashes)) == len(hashes)  # each with its own salt
    data = b"".join(p.read_bytes() for p in hub.config.data.glob("hub.sqlite*"))
    assert PASSWORD.encode() not in data
    assert secret.encode() not in data
    from argon2 import PasswordHasher

    real = PasswordHasher()  # what a hub takes that is no test's
    assert (real.time_cost, real.memory_cost) >= (3, 65536)


@pytest.mark.parametrize("password", ["", "short", "elevenchars"])
def test_a_short_password_is_none(hub: Server, sign_in: SignIn, password: str) -> None:
    admin, body = sign_in("admin"), {"name": "new", "password": password, "role": "expert"}
    assert asked(admin, "POST", "/api/people", body).status_code == 422
    with pytest.raises(UsageError, match="at least 12"):
        hub.site.accounts.add("new", password, PersonRole.EXPERT)
    assert asked(admin, "POST", "/api/password", {"old": PASSWORD, "new": password}).status_code == 422


def test_a_name_is_what_one_sees(hub: Server, sign_in: SignIn) -> None:
    admin = sign_in("admin")
    assert plain_name(" Ａnna\u00a0  Müller ") == "Anna Müller"
    for name in ("ad\u200bmin", "nimda\u202e", "\u00a0", "a\u009bb", "ad\u00admin", "\ue000"):
        with pytest.raises(HubError, match=r"can be seen|match"):
            admin.add_person(name, PASSWORD, "expert")
    for twin in ("admin ", "ａdmin", " admin"):
        with pytest.raises(HubError, match="already"):
            admin.add_person(twin, PASSWORD, "expert")
    admin.add_person("Mu\u0308ller", PASSWORD, "expert")
    assert tried(hub, "M\u00fcller", PASSWORD).status_code == 200


def test_nothing_tells_which_names_exist(hub: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same words, the same number of hashes, and nothing written, whatever is wrong."""
    accounts, hashed, written = hub.site.accounts, [], []
    accounts.add("by provider", None, PersonRole.EXPERT, subject="x y")
    off = accounts.add("off", PASSWORD, PersonRole.EXPERT)
    accounts.change(off.id, disabled=True)
    for _ in range(9):
        tried(hub, "observer", "wrong")
    verify = accounts._fits
    monkeypatch.setattr(accounts, "_fits", lambda *a: hashed.append(1) or verify(*a))
    sa.event.listen(hub.site.engine, "before_cursor_execute", lambda _c, _k, s, *_: written.append(s.split()[0]))
    seen = set()
    for name, password in (
        ("expert", "wrong"), ("nobody", "wrong"), ("off", PASSWORD), ("off", "wrong"), ("observer", PASSWORD),
        ("by provider", ""), ("by provider", "wrong"), ("x\u200b", "wrong"),
    ):  # fmt: skip
        del hashed[:]
        answer = tried(hub, name, password or "x")
        seen.add((answer.status_code, answer.text, tuple(sorted(k for k in answer.headers)), len(hashed)))
    assert len(seen) == 1, seen
    assert next(iter(seen))[0] == 401
    assert next(iter(seen))[3] == 1
    assert not {"UPDATE", "INSERT", "DELETE"} & set(written)


# ------------------------------------------------------------------------------------------------------------ lock-out


def test_too_many_wrong_passwords_lock_who_tries_and_nobody_else(wide: Server) -> None:
    for _ in range(8):
        assert tried(wide, "operator", "wrong").status_code == 401
    assert tried(wide, "operator", PASSWORD).status_code == 401  # right, and too late
    assert tried(wide, "expert", PASSWORD).status_code == 200
    assert tried(wide, "operator", PASSWORD, "127.0.0.2").status_code == 200  # nobody far away locks the operator out
    later(wide, 290)
    assert tried(wide, "operator", PASSWORD).status_code == 401
    later(wide, 20)
    assert tried(wide, "operator", PASSWORD).status_code == 200
    for _ in range(7):
        tried(wide, "operator", "wrong")
    assert tried(wide, "operator", PASSWORD).status_code == 200  # seven, and all is forgotten
    for _ in range(7):
        tried(wide, "operator", "wrong")
    assert tried(wide, "operator", PASSWORD).status_code == 200


def test_a_name_that_is_tried_from_everywhere_is_closed_to_strangers_alone(tmp_path: Path) -> None:
    with hub_at(tmp_path, replace(WIDE, failures=2)) as wide:
        closed_to_strangers(wide)


def closed_to_strangers(wide: Server) -> None:
    assert tried(wide, "operator", PASSWORD).status_code == 200
    for k in range(20):
        assert tried(wide, "operator", "wrong", f"127.0.1.{k + 1}").status_code == 401
    assert tried(wide, "operator", PASSWORD, "127.0.2.1").status_code == 401
    assert tried(wide, "operator", PASSWORD).status_code == 200
    assert tried(wide, "expert", PASSWORD, "127.0.2.1").status_code == 200
    admin = Client(wide.url, "admin", PASSWORD)
    person = next(p for p in admin.people() if p.name == "operator")
    admin.ask("PATCH", f"/api/people/{person.id}", {"password": PASSWORD})  # an administrator opens it
    assert tried(wide, "operator", PASSWORD, "127.0.2.1").status_code == 200
    admin.close()


def test_tries_at_once_are_counted_each() -> None:
    lockout, start, free = Lockout(Clock(), 8, 300), threading.Barrier(40), []

    def attempt() -> None:
        start.wait(60)
        free.append(lockout.begin("anna", "192.0.2.1"))

    threads = [threading.Thread(target=attempt) for _ in range(40)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert sum(free) == 8


def test_a_stolen_page_does_not_try_passwords_for_ever(wide: Server) -> None:
    client = Client(wide.url, "expert", PASSWORD)
    for _ in range(8):
        with pytest.raises(HubError, match="do not fit"):
            client.confirm("wrong")
    with pytest.raises(HubError, match="do not fit"):
        client.confirm(PASSWORD)
    client.close()


# ------------------------------------------------------------------------------------------------------------ sessions


def test_the_cookie_is_for_browsers_alone(hub: Server) -> None:
    answer = tried(hub, "expert", PASSWORD)
    name, *flags = [x.strip() for x in answer.headers["set-cookie"].lower().split(";")]
    assert name.startswith("fringescope=")
    assert {"httponly", "samesite=strict", "path=/", "max-age=43200"} == set(flags)  # Secure needs TLS: test_tls
    assert answer.json()["csrf"] not in answer.headers["set-cookie"]
    assert answer.headers["cache-control"] == "no-store"


def test_a_session_ends(wide: Server) -> None:
    client = Client(wide.url, "expert", PASSWORD)
    for _ in range(14):  # used every fifty minutes it goes on
        later(wide, 3000)
        client.cases()
    later(wide, 43_200 - 14 * 3000 + 60)  # for twelve hours
    with pytest.raises(HubError, match="sign in"):
        client.cases()
    client.sign_in("expert", PASSWORD)
    later(wide, 3660)  # or an hour without a word
    with pytest.raises(HubError, match="sign in"):
        client.cases()
    client.close()


def wait_until_seen(hub: Server, at_ns: int) -> None:
    """Until the hub has looked through its rooms after that moment, and noted down who was there."""
    end, s = time.monotonic() + 30, db.sessions.c
    while time.monotonic() < end:
        with db.reading(hub.site.engine) as c:
            if (c.execute(sa.select(sa.func.max(s.seen_ns))).scalar() or 0) >= at_ns:
                return
        time.sleep(0.02)
    raise AssertionError("the hub does not look")


def test_a_session_that_ends_is_over_in_open_rooms(wide: Server) -> None:
    operator = Client(wide.url, "operator", PASSWORD)
    case = scanned(wide, operator)
    with room_of(operator, case.id) as room:
        for _ in range(3):  # who says something is there
            before = wide.site.clock.now_ns()
            room.send('{"type": "pointer", "camera": "camera1", "pixel": [1, 2]}')
            room.send('{"type": "ping"}')
            heard(room, "pong")
            wait_until_seen(wide, before)
            later(wide, 3000)
        room.send('{"type": "ping"}')  # a page that only says that it is open is no person
        heard(room, "pong")
        later(wide, 3000)
        assert closed(room)[0] == 4401
    operator.close()


def test_no_session_is_one_that_somebody_else_chose(hub: Server) -> None:
    with httpx.Client(base_url=hub.url, headers={"cookie": "fringescope=chosen; __Host-fringescope=chosen"}) as http:
        answer = http.post("/api/login", json={"name": "expert", "password": PASSWORD})
        assert "chosen" not in answer.headers["set-cookie"]
        assert http.get("/api/me").status_code == 401
    with Client(hub.url, "expert", PASSWORD) as client:
        old = cookies(client)
        client.sign_in("observer", PASSWORD)
        assert cookies(client) != old
        with httpx.Client(base_url=hub.url, headers={"cookie": old}) as http:
            assert http.get("/api/me").status_code == 401  # nothing of the one before is left


def test_the_token_of_another_session_is_none(sign_in: SignIn) -> None:
    one, two = sign_in("operator"), sign_in("operator")
    assert one.me.csrf != two.me.csrf
    answer = asked(one, "POST", "/api/cases", {"accession": "x"}, csrf=False, x_csrf_token=two.me.csrf)
    assert answer.status_code == 403


def test_who_signs_out_is_out_where_they_signed_out(hub: Server, sign_in: SignIn) -> None:
    one, two = sign_in("operator"), sign_in("operator")
    case = scanned(hub, one)
    with room_of(one, case.id) as a, room_of(two, case.id) as b:
        heard(a, "caught_up")
        heard(b, "caught_up")
        two.sign_out()
        assert closed(b)[0] == 4403
        a.send('{"type": "ping"}')
        heard(a, "pong")
    assert asked(one, "GET", "/api/me").status_code == 200
    assert asked(two, "GET", "/api/me").status_code == 401


def test_a_new_password_ends_all_sessions(hub: Server, sign_in: SignIn) -> None:
    one, two, new = sign_in("operator"), sign_in("operator"), "another long password"
    case = scanned(hub, one)
    with room_of(two, case.id) as room:
        heard(room, "caught_up")
        with pytest.raises(HubError, match="do not fit"):
            one.ask("POST", "/api/password", {"old": "wrong", "new": new})
        assert asked(two, "GET", "/api/me").status_code == 200
        one.ask("POST", "/api/password", {"old": PASSWORD, "new": new})
        assert closed(room)[0] == 4403
    assert asked(one, "GET", "/api/me").status_code == asked(two, "GET", "/api/me").status_code == 401
    assert tried(hub, "operator", PASSWORD).status_code == 401
    assert tried(hub, "operator", new).status_code == 200


# ------------------------------------------------------------------------------------------------------ rights that end


@pytest.mark.parametrize("change", [{"disabled": True}, {"role": "observer"}, {"password": "another long password"}])
def test_who_loses_a_right_is_out_at_once(hub: Server, sign_in: SignIn, change: dict[str, Any]) -> None:
    expert, operator, admin = sign_in("expert"), sign_in("operator"), sign_in("admin")
    case = scanned(hub, operator)
    invite(case, expert)
    with room_of(expert, case.id) as room:
        heard(room, "caught_up")
        assert say(room, {"kind": "comment", "comment": "a", "text": "x"})["refused"] == ""
        admin.ask("PATCH", f"/api/people/{expert.me.person.id}", change)
        before = len(case.events())
        for _ in range(20):  # the lot that is on its way already
            try:
                room.send(json.dumps({"type": "say", "op": op({"kind": "stop"})}))
            except ConnectionClosed:
                break
        assert closed(room)[0] == 4403
    assert asked(expert, "GET", "/api/me").status_code == 401
    taken = [e for e in case.events()[before:] if not e.refused and e.kind == "stop"]
    assert len(taken) == 0


def test_who_is_let_out_of_a_case_is_out_at_once(hub: Server, sign_in: SignIn) -> None:
    expert, operator = sign_in("expert"), sign_in("operator")
    case = scanned(hub, operator)
    invite(case, expert)
    with room_of(expert, case.id) as room:
        heard(room, "caught_up")
        operator.ask("DELETE", f"/api/cases/{case.id}/members/{expert.me.person.id}")
        assert closed(room)[0] == 4403
    assert asked(expert, "GET", f"/api/cases/{case.id}").status_code == 404
    assert asked(expert, "GET", "/api/me").status_code == 200
    with room_of(expert, case.id) as room:
        assert closed(room)[0] == 4404


def test_who_is_let_out_while_coming_in_is_out(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the question whether they may and the moment that they would be expelled."""
    expert, operator, rooms = sign_in("expert"), sign_in("operator"), hub.site.rooms
    case = scanned(hub, operator)
    invite(case, expert)
    join = rooms.join

    def slowly(*args: Any) -> Any:
        with db.writing(hub.site.engine) as c:
            c.execute(db.members.delete())
        rooms.expel(expert.me.person.id, case.id)
        return join(*args)

    monkeypatch.setattr(rooms, "join", slowly)
    with room_of(expert, case.id) as room:
        assert closed(room)[0] == 4403


def test_the_last_administrator_stays(hub: Server, sign_in: SignIn) -> None:
    admin = sign_in("admin")
    me = admin.me.person.id
    for change in ({"disabled": True}, {"role": "operator"}):
        with pytest.raises(HubError, match="last administrator") as e:
            admin.ask("PATCH", f"/api/people/{me}", change)
        assert e.value.status == 400
    accounts = hub.site.accounts
    for _ in range(10):  # two who disable each other at once
        second = accounts.person(accounts.add(f"second-{_}", PASSWORD, PersonRole.ADMIN).id)
        assert second is not None
        with ThreadPoolExecutor(2) as pool:
            tries = [pool.submit(accounts.change, p, disabled=True) for p in (me, second.id)]
            failed = [t for t in tries if t.exception() is not None]
        assert len(failed) == 1
        assert sum(p.role is PersonRole.ADMIN and not p.disabled for p in accounts.people()) == 1
        left = next(p.id for p in accounts.people() if p.role is PersonRole.ADMIN and not p.disabled)
        if left != me:
            accounts.change(me, disabled=False)
            accounts.change(left, disabled=True)
    with pytest.raises(SignInError):
        accounts.open_session(second.id)


# ------------------------------------------------------------------------------------------------ pages from elsewhere


def test_a_room_opens_for_pages_of_ours(hub: Server, sign_in: SignIn) -> None:
    operator, port = sign_in("operator"), hub.config.port
    case = scanned(hub, operator)
    for origin in ("https://evil.example", "null", f"http://localhost:{port + 1}", f"https://localhost:{port}"):
        with room_of(operator, case.id, Origin=origin) as room:
            code, why = closed(room)
            assert (code, "another site" in why) == (4403, True), origin
    for origin in (f"http://localhost:{port}", f"http://127.0.0.1:{port}"):
        with room_of(operator, case.id, Origin=origin) as room:
            assert heard(room, "welcome")["person"] == operator.me.person.id


def test_browsers_are_told_what_to_forbid(hub: Server) -> None:
    with httpx.Client(base_url=hub.url) as http:
        for path in ("/api/health", "/api/me", "/nowhere", "/openapi.json"):
            h = http.get(path).headers
            assert "frame-ancestors 'none'" in h["content-security-policy"]
            assert "unsafe" not in h["content-security-policy"]
            assert (h["x-content-type-options"], h["x-frame-options"]) == ("nosniff", "DENY")
            assert "access-control-allow-origin" not in h
            assert "server" not in h


# ----------------------------------------------------------------------------------------------------------- how often


def test_too_many_tries_are_told_to_wait(hub: Server) -> None:
    hub.site.logins._rate = 1e-3  # a busy machine tries slowly, and a third of a try a second would be forgiven
    answers = [tried(hub, f"name-{k}", "wrong") for k in range(21)]
    assert [a.status_code for a in answers[:20]] == [401] * 20
    assert answers[20].status_code == 429
    assert int(answers[20].headers["retry-after"]) >= 1
    assert "wait" in answers[20].json()["detail"]
    with httpx.Client(base_url=hub.url) as http:  # all ways in are one way
        body = {"token": "x", "code": "y"}
        assert http.post("/api/invitations/accept", json=body).status_code == 429
        assert http.post("/api/passkeys/ask").status_code == 429
        assert http.post("/api/passkeys/login", json={"credential": {}}).status_code == 429
        assert http.get("/api/health").status_code == 200
    assert tried(hub, "expert", PASSWORD, "127.0.0.2").status_code == 200


def test_too_many_requests_are_told_to_wait(tmp_path: Path) -> None:
    with hub_at(tmp_path, Limits(requests_per_s=0.1, requests_burst=30)) as hub:
        operator = Client(hub.url, "operator", PASSWORD)
        case = scanned(hub, operator)
        seen = [asked(operator, "GET", "/api/health").status_code for _ in range(40)]
        assert seen[0] == 200
        assert seen[-1] == 429
        with pytest.raises(Exception, match=r"403|1013"), room_of(operator, case.id) as room:
            room.recv(5)
        with httpx.Client(base_url=hub.url, transport=httpx.HTTPTransport(local_address="127.0.0.2")) as other:
            assert other.get("/api/health").status_code == 200
        operator.close()


def test_behind_a_proxy_each_is_counted_by_the_address_that_the_proxy_saw(tmp_path: Path) -> None:
    with hub_at(tmp_path, behind_proxy=True) as hub, httpx.Client(base_url=hub.url) as http:

        def attempt(name: str, password: str, seen: str) -> int:
            body = {"name": name, "password": password}
            return http.post("/api/login", json=body, headers={"x-forwarded-for": seen}).status_code

        for k in range(8):  # what stands before the last is what the stranger says of themselves
            assert attempt("expert", "wrong", f"10.0.0.{k}, 203.0.113.7") == 401
        assert attempt("expert", PASSWORD, "10.0.0.99, 203.0.113.7") == 401
        assert attempt("expert", PASSWORD, "203.0.113.7, 203.0.113.8") == 200
        for k in range(8):  # who holds one address of IPv6 holds a whole net
            assert attempt("observer", "wrong", f"2001:db8:1:2::{k + 1}") == 401
        assert attempt("observer", PASSWORD, "2001:db8:1:2:ffff::1") == 401
        assert attempt("observer", PASSWORD, "2001:db8:1:3::1") == 200
        secure = {"x-forwarded-proto": "https", "x-forwarded-for": "203.0.113.9"}
        answer = http.post("/api/login", json={"name": "admin", "password": PASSWORD}, headers=secure)
        assert answer.headers["set-cookie"].startswith("__Host-fringescope=")
        assert "secure" in answer.headers["set-cookie"].lower()
    with hub_at(tmp_path / "2") as hub, httpx.Client(base_url=hub.url) as http:  # nobody asked for it: not believed
        for k in range(8):
            assert attempt("expert", "wrong", f"203.0.113.{k}") == 401
        assert attempt("expert", PASSWORD, "203.0.113.99") == 401
