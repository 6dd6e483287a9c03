"""What the hub promises about order when things go wrong inside: what is not written nobody sees, and nobody misses."""

from __future__ import annotations

import asyncio
import os
import sqlite3
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from fringescope.client import Client, HubCase, HubError
from fringescope.errors import OutputError
from fringescope.server import database as db
from fringescope.server import hub as hub_module
from fringescope.server import journal, truth
from fringescope.server.config import Config, Limits
from fringescope.server.hub import Hub
from fringescope.server.rights import Speaker
from fringescope.server.running import Server
from fringescope.wire import Op, PersonRole
from fringescope.wire.room import Said
from tests.server.conftest import PASSWORD, SignIn, both, checked, populate
from tests.server.test_hub import SCAN, invite, scanned, stroke


def on_loop(server: Server, *words: Awaitable[Any]) -> list[Any]:
    """Things that happen at the same time in the hub."""

    async def all_of() -> list[Any]:
        return list(await asyncio.gather(*words))

    assert server.loop is not None
    return asyncio.run_coroutine_threadsafe(all_of(), server.loop).result(60)


def note(server: Server, case: HubCase, beside: Callable[[sa.Connection], None] | None = None) -> Awaitable[Said]:
    return server.site.hub.note(case.id, "somebody", "operator", "changed", {}, beside)


def put(number: int, name: str = "s", client: str = "c") -> dict[str, Any]:
    return {"client": client, "number": number, "what": {"kind": "put", "stroke": stroke(name), "scan": SCAN}}


@both
def test_a_word_that_cannot_be_written_takes_no_other_down(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))

    def twice(c: sa.Connection) -> None:
        c.execute(db.cases.insert().values(id=case.id, accession="", status="", specimen={}, created_ns=0,
                                           changed_ns=0))  # fmt: skip

    before = case.get().seq
    good, bad, also = on_loop(hub, note(hub, case), note(hub, case, twice), note(hub, case))
    assert (good.seq, bad.seq, also.seq) == (before + 1, None, before + 2)
    assert "nothing was changed" in bad.refused
    assert checked(hub.site.engine)[2] == []


def test_a_fault_of_ours_is_an_answer_too(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))

    def fault(_: sa.Connection) -> None:
        raise ZeroDivisionError

    good, bad = on_loop(hub, note(hub, case), note(hub, case, fault))
    assert good.seq is not None
    assert (bad.seq, bad.refused) == (None, "ZeroDivisionError: this is a bug; report it. Nothing was changed")


def test_what_is_not_written_yet_nobody_sees(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody comes in while an event is on its way to a disk that refuses it: they see the truth without it."""
    import threading

    case = scanned(hub, sign_in("operator"))
    waits, goes_on = threading.Event(), threading.Event()

    def commit(_self: Hub, _batch: Any) -> None:
        waits.set()
        goes_on.wait(20)
        raise OutputError("the disk is full; nothing was changed")

    monkeypatch.setattr(Hub, "_commit", commit)
    with case.enter() as room:
        room.say({"kind": "put", "stroke": stroke("s"), "scan": SCAN}, wait=False)
        assert waits.wait(10)
        assert case.state().seq == 3
        assert case.state().strokes == {}
        with case.enter() as other:
            assert other.seq == 3
            goes_on.set()
            room.until(lambda: not room._unanswered)
            monkeypatch.undo()
            room.draw(stroke("t"))
            other.until(lambda: other.seq == 4)
            assert [e.seq for e in other.events] == [1, 2, 3, 4]
            assert set(case.state().strokes) == {"t"}


@both
def test_the_answer_of_the_database_is_lost_but_not_the_words(
    hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = scanned(hub, sign_in("operator"))
    real = Hub._commit
    lost: list[int] = []

    def commit(self: Hub, batch: Any) -> None:
        real(self, batch)
        if not lost:
            lost.append(1)
            raise OutputError("the connection was lost; nothing was changed")

    with case.enter() as room, case.enter() as other:
        monkeypatch.setattr(Hub, "_commit", commit)
        room.draw(stroke("s"))
        room.draw(stroke("t"))
        other.until(lambda: other.seq == 5)
        assert lost
        assert [e.seq for e in other.events] == [e.seq for e in room.events] == [1, 2, 3, 4, 5]
        assert set(case.state().strokes) == {"s", "t"}
    assert checked(hub.site.engine)[1:] == (5, [])


def test_an_effect_that_fails_keeps_no_event_from_the_room(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))

    async def fails(*_: Any) -> None:
        raise ZeroDivisionError

    hub.site.hub.carry_out = fails
    with case.enter() as room:
        room.draw(stroke("s"))
        room.say({"kind": "preview", "version": 1}, wait=False)
        room.say({"kind": "comment", "comment": "c", "text": "and on"}, wait=False)
        room.until(lambda: room.seq == 6)


def test_more_cases_than_are_kept_ready(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A case that is put away while it is written, and read again at once, goes on where it stopped."""
    monkeypatch.setattr(hub_module, "_BOOKS", 2)
    operator = sign_in("operator")
    cases = [scanned(hub, operator) for _ in range(6)]
    words = [w for _ in range(15) for case in cases for w in (note(hub, case), hub.site.hub.truth_of(case.id))]
    found = on_loop(hub, *words)
    assert all(said.seq is not None for said in found[::2])
    assert [case.get().seq for case in cases] == [18] * 6
    assert checked(hub.site.engine) == (6, 108, [])


@both
def test_said_again_long_after(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    """Older answers than are kept ready are looked up: also of numbers that came out of order, or never."""
    monkeypatch.setattr(hub_module, "_SAID", 5)
    case = scanned(hub, sign_in("operator"))
    numbers = [1, 2, 30, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    first = case.say([put(n) for n in numbers])
    assert [s.seq for s in first] == list(range(4, 16))
    assert case.say([put(n) for n in numbers]) == first
    late = case.say([put(3)])[0]  # never said before
    assert late.seq == 16
    hub.close()
    with Server(hub.config, fast_passwords=True) as second, Client(second.url, "operator", PASSWORD) as again:
        assert again.case(case.id).say([put(n) for n in (*numbers, 3)]) == [*first, late]
        assert checked(second.site.engine)[1:] == (16, [])


def test_the_same_words_at_the_same_time(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    again = [hub.site.hub._put(case.id, "p", "operator", "changed", {}, "c", 1, 0, "") for _ in range(5)]
    assert {s.seq for s in on_loop(hub, *again)} == {4}
    assert case.get().seq == 4


def test_somebody_elses_client_and_number_are_not_mine(hub: Server, sign_in: SignIn) -> None:
    """Who forges another person's client gets no answer of theirs, and takes no number from them."""
    case, expert = scanned(hub, sign_in("operator")), sign_in("expert")
    invite(case, expert)
    assert case.say([put(1, "a")])[0].seq == 5
    assert expert.case(case.id).say([put(1, "b")])[0].seq == 6
    assert case.say([put(1, "a"), put(2, "c")]) == [
        Said(client="c", number=1, seq=5), Said(client="c", number=2, seq=7),
    ]  # fmt: skip
    assert [e.actor for e in case.events(since=4)] == [p.me.person.id for p in (case.hub, expert, case.hub)]


def test_who_says_too_much_is_answered(tmp_path: Any) -> None:
    limits = Limits(ops_per_s=0.01, ops_burst=2)
    with Server(Config(tmp_path, port=0, limits=limits), fast_passwords=True) as hub:
        populate(hub)
        with Client(hub.url, "operator", PASSWORD) as operator:
            case = scanned(hub, operator)
            with case.enter() as room:
                room.comment("one")
                room.comment("two")
                with pytest.raises(HubError, match="too many ops; wait"):
                    room.say({"kind": "comment", "comment": "c", "text": "three"}, timeout_s=5)
                hub.site.hub.can_stop = lambda _case: True  # type: ignore[method-assign]
                room.stop("a stop of what is lit is never too often")
                assert room.seq == 6


def test_what_can_be_undone_is_bounded(monkeypatch: pytest.MonkeyPatch, hub: Server, sign_in: SignIn) -> None:
    monkeypatch.setattr(truth, "UNDOABLE", 3)
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        for k in range(5):
            room.draw(stroke("s", 10.0 + k))
        with pytest.raises(HubError, match="of the last 3 ops can"):
            room.undo(4)
        assert len(on_loop(hub, hub.site.hub.truth_of(case.id))[0][0].done) == 3
        room.undo()
        assert case.state().strokes["s"]["stroke"]["pixels"][0][0] == 13.0


# -------------------------------------------------------------------------------------------- early, and the disk


def test_drawing_is_told_before_the_disk_has_it_and_all_else_after(
    hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What SQLite itself says of the connection that is about to be committed: 1 = NORMAL, 2 = FULL."""
    seen: dict[str, int] = {}
    real = journal.append

    def append(c: sa.Connection, records: Any) -> None:
        seen.update({r.kind: c.exec_driver_sql("PRAGMA synchronous").scalar() for r in records})
        real(c, records)

    monkeypatch.setattr(journal, "append", append)
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        room.draw(stroke("s"))
        room.say({"kind": "comment", "comment": "c", "text": "here"})
        room.undo()
        room.submit()
        room.stop()
    early = {"put", "comment", "undo"}
    assert early | {"submit", "stop", "opened", "ScanTaken"} <= set(seen)
    assert {k: v for k, v in seen.items() if v != (1 if k in early else 2)} == {}


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_the_disk_has_it_an_instant_later(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    real = os.fdatasync

    def fdatasync(number: int) -> None:
        real(number)
        synced.append(Path(f"/proc/self/fd/{number}").readlink().name)

    case = scanned(hub, sign_in("operator"))
    monkeypatch.setattr(os, "fdatasync", fdatasync)
    with case.enter() as room:
        room.draw(stroke("s"))
        end = time.monotonic() + 10
        while "hub.sqlite-wal" not in synced and time.monotonic() < end:
            time.sleep(0.01)
    assert "hub.sqlite-wal" in synced


def test_a_disk_that_refused_what_was_told_is_waited_for_from_then_on(
    hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    early: list[bool] = []
    real = Hub._commit

    def commit(self: Hub, batch: Any) -> None:
        early.append(batch.early)
        real(self, batch)

    def refuses(_: Any) -> None:
        raise OutputError("the disk did not take it: input/output error")

    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        monkeypatch.setattr(Hub, "_commit", commit)
        monkeypatch.setattr(db, "flush", refuses)
        room.draw(stroke("s"))
        end = time.monotonic() + 10
        while not hub.site.hub._cautious and time.monotonic() < end:
            time.sleep(0.01)
        monkeypatch.setattr(db, "flush", lambda _: None)
        room.draw(stroke("t"))
    assert early == [True, False]


def test_who_saw_what_a_power_cut_took_sees_all_anew(tmp_path: Path) -> None:
    """The database as it was some events ago; the log goes on in another way, and somebody comes back."""
    folder = tmp_path / "hub"
    with Server(Config(folder, port=0), fast_passwords=True) as hub:
        populate(hub)
        with Client(hub.url, "operator", PASSWORD) as operator:
            case = scanned(hub, operator)
            with case.enter() as room:
                room.draw(stroke("kept"))
                with sqlite3.connect(folder / "hub.sqlite") as a, sqlite3.connect(tmp_path / "as-it-was") as b:
                    a.backup(b)
                room.draw(stroke("lost"))
                room.draw(stroke("lost too"))
                assert room.seq == 6
        port = hub.config.port
    for left in folder.glob("hub.sqlite*"):
        left.unlink()
    (tmp_path / "as-it-was").rename(folder / "hub.sqlite")
    with (
        Server(Config(folder, port=port), fast_passwords=True) as hub,
        Client(hub.url, "operator", PASSWORD) as again,
    ):
        room.case = again.case(case.id)
        room.reconnect()  # the log is shorter than what was seen
        assert [e.seq for e in room.events] == [1, 2, 3, 4]
        room.close()
        with again.case(case.id).enter() as other:
            other.draw(stroke("new"))
            other.draw(stroke("new too"))
        room._seq, stale = 5, room.events[-1].model_copy(update={"seq": 5, "hash": "0" * 64})
        room.events.append(stale)
        room.reconnect()  # it is as long, but another
        room.until(lambda: room.seq == 6)
        assert [e.seq for e in room.events] == [1, 2, 3, 4, 5, 6]
        assert stale.hash not in {e.hash for e in room.events}
        before = room.events[-1]
        room.close()
        room.reconnect()  # nothing happened: nothing comes again
        assert room.events[-1] is before
        assert room.welcome is not None
        assert not room.welcome.anew
        room.close()
        assert checked(hub.site.engine)[1:] == (6, [])


def test_words_behind_the_end_of_a_right_are_refused_until_it_comes_back(hub: Server, sign_in: SignIn) -> None:
    """All in one batch: what waits behind the word that ended a right is not drawn; operators need no invitation."""
    operator, expert = sign_in("operator"), sign_in("expert")
    case = scanned(hub, operator)
    gone, who = {"person": expert.me.person.id}, Speaker(expert.me.person.id, PersonRole.EXPERT)
    other = Speaker(operator.me.person.id, PersonRole.OPERATOR)

    def say(number: int, speaker: Speaker) -> Awaitable[Said]:
        return hub.site.hub.say(case.id, speaker, Op(**put(number, f"s{number}", speaker.role.value)))

    def word(kind: str, person: dict[str, str]) -> Awaitable[Said]:
        return hub.site.hub.note(case.id, "somebody", "operator", kind, person)

    said = on_loop(
        hub, say(1, who), word("revoked", gone), say(2, who), word("revoked", {"person": other.person}), say(3, other),
        word("invited", gone), say(4, who),
    )  # fmt: skip
    assert [bool(s.refused) for s in said] == [False, False, True, False, False, False, False]
    assert said[2].refused == "your right to see this case has ended"
    assert set(case.state().strokes) == {"s1", "s3", "s4"}
    hub.site.hub.forget(case.id)  # and read again from the log
    assert set(case.state().strokes) == {"s1", "s3", "s4"}
    assert checked(hub.site.engine)[2] == []
