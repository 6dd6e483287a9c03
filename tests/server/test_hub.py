"""The shared truth: order, each once, undo, submissions, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from fringescope.client import Client, HubCase, HubError
from fringescope.server.running import Server
from fringescope.types.examination import RigChanged, ScanTaken
from tests.server.conftest import PASSWORD, SignIn, both

pytestmark = both
SCAN, RIG = "sha256:" + "a" * 64, "sha256:" + "b" * 64


def stroke(name: str, x: float = 100.0) -> dict[str, Any]:
    return {"id": name, "camera": "camera1", "pixels": [[x, 50.0], [x + 40, 60.0]], "width_mm": 0.8}


def told(hub: Server, case: HubCase, word: Any) -> None:
    """A word of the instrument."""
    import asyncio

    loop = hub.loop
    asyncio.run_coroutine_threadsafe(hub.site.hub.tell(case.id, word), loop).result(10)


def scanned(hub: Server, operator: Client) -> HubCase:
    """A case with a scan that nobody took."""
    case = operator.open_case("S26-1", {"organ": "tongue"})
    told(hub, case, RigChanged(RIG))
    told(hub, case, ScanTaken(SCAN, RIG))
    return case


def test_strangers_are_told_to_sign_in(hub: Server) -> None:
    with Client(hub.url) as nobody, pytest.raises(HubError, match="sign in") as e:
        nobody.cases()
    assert e.value.status == 401


def test_what_one_draws_the_other_sees_in_the_same_order(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    expert = sign_in("expert")
    invite(case, expert)
    with case.enter() as a, expert.case(case.id).enter() as b:
        for k in range(5):
            b.draw(stroke(f"e{k}", 50.0 * k))
            a.draw(stroke(f"o{k}", 50.0 * k))
        a.until(lambda: a.seq == b.seq == 14)  # opened, rig, scan, joined, ten strokes
        assert [e.hash for e in a.events] == [e.hash for e in b.events]
        assert [e.seq for e in a.events] == list(range(1, 15))
        state = case.state()
        assert set(state.strokes) == {f"{w}{k}" for w in "eo" for k in range(5)}
        assert {x["author"] for x in state.strokes.values()} == {p.me.person.id for p in (expert, case.hub)}


def invite(case: HubCase, person: Client) -> None:
    """Lets somebody who has an account into a case."""
    case.hub.ask("PUT", f"/api/cases/{case.id}/members/{person.me.person.id}")


def test_said_twice_is_done_once(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    op = {"client": "offline-1", "number": 1, "what": {"kind": "put", "stroke": stroke("s"), "scan": SCAN}}
    first = case.say([op])[0]
    again = case.say([op, op])
    assert (first.seq, first.refused) == (4, "") == (again[0].seq, again[1].refused)
    assert case.get().seq == 4


def test_undo_takes_back_and_undo_of_undo_does_it_again(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        room.draw(stroke("s", 10.0))
        room.draw(stroke("s", 90.0))
        room.undo()
        assert case.state().strokes["s"]["stroke"]["pixels"][0][0] == 10.0
        undone = room.seq
        room.undo(undone)
        assert case.state().strokes["s"]["stroke"]["pixels"][0][0] == 90.0
        with pytest.raises(HubError, match="undone already"):
            room.undo(undone)
        room.remove("s")
        room.undo()
        assert "s" in case.state().strokes
        room.undo()  # and again: one step further back each time
        room.undo()
        assert "s" not in case.state().strokes
        room.draw(stroke("s", 5.0))
        room.comment("look here", stroke="s")
        room.undo()
        assert not case.state().comments
    assert len(case.events()) == 3 + 12  # nothing was ever taken out of the log, and what was refused is in it


def test_only_its_author_changes_a_stroke(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    expert = sign_in("expert")
    invite(case, expert)
    with case.enter() as room, expert.case(case.id).enter() as other:
        room.draw(stroke("s"))
        for attempt in (lambda: other.draw(stroke("s", 7.0)), lambda: other.remove("s"), lambda: other.undo()):
            with pytest.raises(HubError, match=r"only its author|nothing of yours"):
                attempt()
        refused = [e for e in case.events() if e.refused]
        assert [e.kind for e in refused] == ["put", "remove", "undo"]  # tried is written down, too


def test_a_submission_freezes_what_was_drawn(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        room.draw(stroke("s", 10.0))
        version = room.submit()
        assert version.number == 1
        assert version.phase in ("submitted", "draft")  # back with its author: no instrument can check it
        room.draw(stroke("s", 99.0))
        assert case.state().versions[1][0]["stroke"]["pixels"][0][0] == 10.0
        with pytest.raises(HubError, match="the present one"):
            room.say({"kind": "submit", "strokes": [["s", "0" * 64]], "scan": "sha256:old", "rig": RIG})
        with pytest.raises(HubError, match="only what is armed"):
            room.say({"kind": "start", "version": 1, "pattern": "x"})


def test_a_signature_needs_the_password_once_more(hub: Server, sign_in: SignIn) -> None:
    operator = sign_in("operator")
    case = scanned(hub, operator)
    with case.enter() as room:
        room.draw(stroke("s"))
        version = room.submit()
        with hub.site.engine.begin() as c:
            c.exec_driver_sql("UPDATE sessions SET confirmed_ns = 0")
        with pytest.raises(HubError, match="password once more"):
            room.sign(version, "approved")
        operator.confirm(PASSWORD)
        room.sign(version, "approved")
        signed = case.state().standing["signatures"]
        assert [(x["version"], x["content"], x["meaning"]) for x in signed] == [(1, version.content, "approved")]


def test_a_hub_started_anew_knows_all_of_it(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        room.draw(stroke("s"))
        version = room.submit()
        room.until(lambda: room.version(version.number).phase == "draft")  # its check is in the log: no such scan
    before = case.state()
    hub.close()
    with Server(hub.config, fast_passwords=True) as second, Client(second.url, "operator", PASSWORD) as again:
        assert again.case(case.id).state() == before
