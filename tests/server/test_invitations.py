"""Guests: one case, one link, one code told another way, and out again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from fringescope.client import Client, HubError
from fringescope.server import database as db
from fringescope.wire import Invitation
from tests.server.conftest import PASSWORD
from tests.server.people_scenes import World, asked, closed, heard, invited, later, op, room_of, say, world_at
from tests.server.test_hub import SCAN, stroke


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with world_at(tmp_path_factory.mktemp("invitations")) as made:
        yield made


def accepted(world: World, token: str | None, code: str | None) -> httpx.Response:
    with httpx.Client(base_url=world.hub.url) as http:
        return http.post("/api/invitations/accept", json={"token": token, "code": code})


def state(world: World, invitation: Invitation) -> dict[str, Any]:
    with world.hub.site.engine.connect() as c:
        asked = sa.select(db.invitations).where(db.invitations.c.id == invitation.id)
        return dict(c.execute(asked).mappings().one())


def test_link_and_code_are_told_once_and_kept_as_digests(world: World) -> None:
    made = world.case.invite("Dr. Gast")
    assert made.token is not None
    assert made.code is not None
    assert len(made.token) >= 32
    assert len(made.code) == 8
    again = asked(world.client("operator"), "GET", f"/api/cases/{world.case.id}/invitations").json()
    assert {(i["token"], i["code"]) for i in again} == {(None, None)}
    data = b"".join(p.read_bytes() for p in world.hub.config.data.glob("hub.sqlite*"))
    for secret in (made.token, made.code):
        assert secret.encode() not in data
        assert secret not in str(world.case.events())
    assert state(world, made)["code"].startswith("$argon2id$")


def test_it_is_good_once(world: World) -> None:
    made = world.case.invite("Dr. Gast")
    with Client(world.hub.url) as guest:
        account = guest.accept(made.token or "", f" {(made.code or '').lower()} ")  # as it was written down by hand
        assert (account.case, account.person.role, account.local) == (world.case.id, "expert", True)
        assert account.person.name.startswith("Dr. Gast (")
    answer = accepted(world, made.token, made.code)
    assert (answer.status_code, "was used" in answer.text) == (401, True)
    kinds = [e.kind for e in world.case.events() if e.kind in ("invited", "joined")]
    assert kinds[-2:] == ["invited", "joined"]


def test_of_two_who_come_at_once_one_comes_in(world: World) -> None:
    for _ in range(3):
        made, start = world.case.invite("Dr. Gast"), threading.Barrier(4)

        def come(made: Invitation = made, start: threading.Barrier = start) -> int:
            start.wait(60)
            return accepted(world, made.token, made.code).status_code

        with ThreadPoolExecutor(4) as pool:
            codes = sorted(t.result() for t in [pool.submit(come) for _ in range(4)])
        assert codes == [200, 401, 401, 401]


def test_it_expires_and_so_does_the_guest(world: World) -> None:
    short, long = world.case.invite("late", hours=1.0), world.case.invite("early", hours=1.0)
    with Client(world.hub.url) as guest:
        guest.accept(long.token or "", long.code or "")
        with room_of(guest, world.case.id) as room:
            heard(room, "caught_up")
            later(world.hub, 3590)
            guest.cases()
            later(world.hub, 20)
            assert accepted(world, short.token, short.code).status_code == 401
            assert asked(guest, "GET", "/api/me").status_code == 401
            room.send('{"type": "say", "op": {"client": "x", "number": 1, "what": {"kind": "stop"}}}')
            assert closed(room)[0] in (4403, 4401)
    world.client("operator").sign_in("operator", PASSWORD)  # ours has ended, too
    world.clients = {"operator": world.client("operator")}


def test_wrong_codes_end_it(world: World) -> None:
    made = world.case.invite("Dr. Gast")
    for k in range(5):
        assert accepted(world, made.token, f"WRONG{k:03}").status_code == 401
    answer = accepted(world, made.token, made.code)
    assert answer.status_code == 401
    assert accepted(world, "no such token", "x").text == answer.text  # nothing tells what was wrong
    assert state(world, made)["revoked"]
    made = world.case.invite("Dr. Gast")
    for k in range(4):
        accepted(world, made.token, f"WRONG{k:03}")
    assert accepted(world, made.token, made.code).status_code == 200


def test_wrong_codes_at_once_are_counted_each(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty guesses in one breath are five guesses."""
    made, judged = world.case.invite("Dr. Gast"), []
    hasher = world.hub.site.invitations._hasher

    class Slow:
        def verify(self, *args: Any) -> Any:
            judged.append(1)
            threading.Event().wait(0.05)
            return hasher.verify(*args)

    monkeypatch.setattr(world.hub.site.invitations, "_hasher", Slow())
    with ThreadPoolExecutor(20) as pool:
        list(pool.map(lambda k: accepted(world, made.token, f"WRONG{k:03}"), range(20)))
    assert len(judged) == 5
    assert accepted(world, made.token, made.code).status_code == 401


def test_who_was_revoked_does_not_come_in(world: World) -> None:
    made = world.case.invite("Dr. Gast")
    world.case.revoke(made.id)
    before = world.hub.site.accounts.people()
    assert accepted(world, made.token, made.code).status_code == 401
    assert world.hub.site.accounts.people() == before


def test_a_revocation_while_somebody_comes_in(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each step of it they are out in the end."""
    accounts, add = world.hub.site.accounts, world.hub.site.accounts.add
    for before in (True, False):
        made = world.case.invite("Dr. Gast")

        def revoking(*args: Any, made: Invitation = made, before: bool = before, **how: Any) -> Any:
            if before:
                world.hub.site.invitations.revoke(made.id)
            person = add(*args, **how)
            if not before:
                world.hub.site.invitations.revoke(made.id)
            return person

        monkeypatch.setattr(accounts, "add", revoking)
        assert accepted(world, made.token, made.code).status_code == 401
        monkeypatch.undo()
        assert not any(accounts.allowed(p.id) for p in accounts.people() if made.id[-6:] in p.name)


def test_revoked_while_drawing(world: World) -> None:
    """They are out at once, what they proposed stays, what they say then is not taken."""
    made = world.case.invite("Dr. Gast")
    with Client(world.hub.url) as guest:
        guest.accept(made.token or "", made.code or "")
        me = guest.me.person.id
        with room_of(guest, world.case.id) as room, room_of(world.client("operator"), world.case.id) as other:
            heard(room, "caught_up")
            heard(other, "caught_up")
            assert say(room, {"kind": "put", "stroke": stroke("kept"), "scan": SCAN})["refused"] == ""
            room.send('{"type": "ink", "stroke": "half", "points": [[1, 2], [3, 4]]}')
            assert heard(other, "relayed")["what"]["stroke"] == "half"
            world.case.revoke(made.id)
            code, why = closed(room)
            assert (code, "ended" in why) == (4403, True)
        body = [op({"kind": "put", "stroke": stroke("late"), "scan": SCAN})]
        assert asked(guest, "POST", f"/api/cases/{world.case.id}/ops", body).status_code == 401
        assert asked(guest, "GET", f"/api/cases/{world.case.id}").status_code == 401
    strokes = world.case.state().strokes
    assert strokes["kept"]["author"] == me
    assert "late" not in strokes
    assert [e.kind for e in world.case.events()][-1] == "revoked"


def test_a_guest_sees_the_one_case_alone(world: World) -> None:
    with invited(world.case) as guest:
        assert [c.id for c in guest.cases().cases] == [world.case.id]
        assert guest.cases("S26-other").total == 0
        assert asked(guest, "GET", f"/api/cases/{world.other.id}").status_code == 404
        with room_of(guest, world.other.id) as room:
            assert closed(room)[0] == 4404
        put = f"/api/cases/{world.other.id}/members/{guest.me.person.id}"
        answer = asked(world.client("operator"), "PUT", put)  # nor does anybody let them into another by a slip
        assert (answer.status_code, "invite them" in answer.text) == (409, True)
        assert guest.cases().total == 1
        with db.writing(world.hub.site.engine) as c:  # and were they in the table, they would not see it
            db.members.insert().values(case_id=world.other.id, person_id=guest.me.person.id)
            c.execute(db.members.insert().values(case_id=world.other.id, person_id=guest.me.person.id))
        assert asked(guest, "GET", f"/api/cases/{world.other.id}").status_code == 404
        assert [c.id for c in guest.cases().cases] == [world.case.id]


def test_a_guest_who_is_let_out_does_not_come_back(world: World) -> None:
    with invited(world.case) as guest, room_of(guest, world.case.id) as room:
        heard(room, "caught_up")
        world.client("operator").ask("DELETE", f"/api/cases/{world.case.id}/members/{guest.me.person.id}")
        assert closed(room)[0] == 4403
        assert asked(guest, "GET", f"/api/cases/{world.case.id}").status_code == 404
        with room_of(guest, world.case.id) as again:
            assert closed(again)[0] == 4404


def test_a_guest_becomes_no_operator(world: World) -> None:
    with invited(world.case) as guest:
        path = f"/api/people/{guest.me.person.id}"
        for role in ("operator", "admin"):
            answer = asked(world.client("admin"), "PATCH", path, {"role": role})
            assert (answer.status_code, "a guest" in answer.text) == (400, True)
        assert asked(world.client("admin"), "PATCH", path, {"role": "observer"}).status_code == 200
        assert asked(guest, "GET", "/api/me").status_code == 401


@pytest.mark.parametrize(
    "body",
    [
        {"name": "x", "role": "operator"}, {"name": "x", "role": "admin"}, {"name": "x", "hours": 0}, {"name": ""},
        {"name": "x", "hours": 24 * 91}, {"name": "x", "hours": -1}, {"name": "x", "hours": "NaN"}, {"name": "\u200b"},
        {"name": "x", "case": "case-0"},
    ],
)  # fmt: skip
def test_an_invitation_that_is_none(world: World, body: dict[str, Any]) -> None:
    path = f"/api/cases/{world.case.id}/invitations"
    before = len(world.case.events())
    answer = asked(world.client("operator"), "POST", path, body)
    assert answer.status_code in (409, 422), answer.text
    assert len(world.case.events()) == before


def test_the_longest_name_is_no_trap(world: World) -> None:
    """A name that grows when its guest comes in must not be one that nobody can read any more."""
    with invited(world.case, name="Ä" * 200) as guest:
        assert len(guest.me.person.name) <= 200
        assert guest.me.person.name in [p.name for p in world.client("operator").people()]


def test_an_invitation_of_another_case_is_not_revoked_from_here(world: World) -> None:
    made = world.other.invite("Dr. Gast")
    with pytest.raises(HubError, match="no such invitation") as e:
        world.case.revoke(made.id)
    assert e.value.status == 404
    assert not state(world, made)["revoked"]
