"""Bad days: a full disk, somebody who does not read, clocks that jump, a locked database, two hubs, two operators."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from fringescope import examination
from fringescope.client import Client, HubCase, HubError, Room
from fringescope.errors import OutputError
from fringescope.server import clock
from fringescope.server.blobs import Blobs
from fringescope.server.clock import Clock
from fringescope.server.config import Config, Limits
from fringescope.server.hub import Hub
from fringescope.server.rooms import TOO_SLOW, Listener
from fringescope.server.running import Server
from fringescope.server.site import open_site
from fringescope.types.examination import Checked, Guarded, Previewed, Standing, Watched
from tests.server.conftest import PASSWORD, SignIn, checked, populate
from tests.server.test_hub import SCAN, invite, scanned, stroke, told

# --------------------------------------------------------------------------------------------------------- a full disk


@contextlib.contextmanager
def full(hub: Server) -> Iterator[None]:
    """The database may not grow by a page, as on a disk without room."""

    def no_more(connection: Any, _record: Any) -> None:
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count={pages}")

    sa.event.listen(hub.site.engine, "connect", no_more)
    hub.site.engine.dispose()
    yield
    sa.event.remove(hub.site.engine, "connect", no_more)
    hub.site.engine.dispose()


def until_refused(room: Room) -> str:
    """Draws until that is refused (there is some room left in the pages that it has): why."""
    for k in range(200):
        try:
            room.draw({"id": f"x{k}", "camera": "camera1", "pixels": [[1.0 * n, 2.0] for n in range(300)],
                       "width_mm": 1})  # fmt: skip
        except HubError as e:
            return str(e)
    raise AssertionError("never full")


def test_a_full_disk(hub: Server, sign_in: SignIn) -> None:
    """What is said is refused with a sentence, nobody sees it, all that was there stays, and afterwards all goes on."""
    operator, expert = sign_in("operator"), sign_in("expert")
    case = scanned(hub, operator)
    invite(case, expert)
    with case.enter() as room, expert.case(case.id).enter() as other:
        room.draw(stroke("s"))
        with full(hub):
            assert "full; nothing was changed" in until_refused(room)
            with pytest.raises(HubError, match="full") as e:
                operator.open_case("S26-2", {"notes": 4000 * "n"})
            assert e.value.status == 507
            before = case.state()
            assert before.seq == case.get().seq == room.seq
            with expert.case(case.id).enter() as third:  # to look is no harm
                assert third.seq == before.seq
        room.draw(stroke("t"))
        assert room.seq == before.seq + 1
        other.until(lambda: other.seq == room.seq)
        assert [e.hash for e in other.events] == [e.hash for e in room.events] == [e.hash for e in case.events()]
        assert set(case.state().strokes) == {*before.strokes, "t"}
    assert checked(hub.site.engine)[2] == []


def lit(hub: Server, case: HubCase, room: Room) -> int:
    """A version that is projected, as far as the log knows: the instrument's words are said for it."""
    room.draw(stroke("s"))
    version = room.submit()
    ready(hub, case, version.number, version.content)
    room.say({"kind": "arm", "version": version.number, "content": version.content, "pattern": "p" * 64})
    room.say({"kind": "start", "version": version.number, "pattern": "p" * 64})
    assert room.wait(version, "projecting").phase == "projecting"
    return version.number


def ready(hub: Server, case: HubCase, number: int, content: str) -> None:
    for word in (Checked(number, content, "p" * 64, "d" * 64), Guarded(), Watched(SCAN, Standing.VALID),
                 Previewed(number, "p" * 64)):  # fmt: skip
        told(hub, case, word)


@pytest.fixture
def without_instrument(hub: Server) -> list[str]:
    """Nobody carries anything out, so the test can say the instrument's words; why it was told to be dark."""
    why: list[str] = []

    async def nobody(*_: Any) -> None:
        return None

    hub.site.hub.carry_out, hub.site.hub.dark = nobody, why.append
    return why


def test_a_stop_on_a_full_disk_is_dark_at_once_and_written_down_later(
    hub: Server, sign_in: SignIn, without_instrument: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room:
        lit(hub, case, room)

        def no_room(*_: Any) -> None:
            raise OutputError("the database cannot be written: the disk is full; nothing was changed")

        monkeypatch.setattr(Hub, "_commit", no_room)
        with pytest.raises(HubError, match="full"):
            room.stop("it moves")
        assert len(without_instrument) == 1
        monkeypatch.undo()
        for _ in range(20):  # the camera still finds all as it was: it is not for want of a verdict that it ends
            told(hub, case, Watched(SCAN, Standing.VALID))
            if room.version(1).phase != "projecting":
                break
            time.sleep(0.2)
        assert room.version(1).phase != "projecting"
        assert "GuardLost" in [e.kind for e in room.events]
        assert "Expired" not in [e.kind for e in room.events]


def test_a_file_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blobs = Blobs(tmp_path)
    kept, _ = blobs.put(b"kept")

    def no_room(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(OutputError, match="the disk is full; nothing was kept of the file"):
        blobs.put(b"x" * 100_000)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == [kept]
    assert blobs.put(b"x" * 100_000)[0] == hashlib.sha256(b"x" * 100_000).hexdigest()


def test_on_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """The whole hub on a disk of a few megabytes; needs root."""
    folder = tmp_path / "small"
    folder.mkdir()
    made = ["mount", "-t", "tmpfs", "-o", "size=6m", "fringescope-test", str(folder)]
    if os.getuid() != 0 or subprocess.run(made, capture_output=True, check=False).returncode:
        pytest.skip("no small disk can be mounted here")
    try:
        with Server(Config(folder / "hub", port=0), fast_passwords=True) as hub:
            populate(hub)
            with Client(hub.url, "operator", PASSWORD) as operator:
                case = scanned(hub, operator)
                ballast = folder / "ballast"
                with case.enter() as room:
                    room.draw(stroke("s"))
                    with contextlib.suppress(OSError), ballast.open("wb") as f:
                        while True:
                            f.write(b"x" * 4096)
                    with pytest.raises(OutputError, match="the disk is full"):
                        hub.site.blobs.put(b"y" * 500_000)
                    why = until_refused(room)
                    assert "full" in why or "disk" in why
                    before = room.seq
                    assert case.get().seq == before
                    ballast.unlink()
                    room.draw(stroke("t"))
                    assert [e.seq for e in room.events] == list(range(1, before + 2))
                assert checked(hub.site.engine)[2] == []
        site = open_site(Config(folder / "hub"))
        assert checked(site.engine)[1:] == (before + 1, [])
        site.close()
    finally:
        subprocess.run(["umount", str(folder)], check=True)


# ----------------------------------------------------------------------------------------- a browser that stops reading


def test_what_waits_for_a_listener_is_bounded() -> None:
    for count, letters in ((11, 1), (2, 600)):
        listener = Listener(None, 10, 1000)  # type: ignore[arg-type]
        ended: list[int] = []
        listener.on_end = lambda: ended.append(1)  # noqa: B023
        for _ in range(count):
            listener.send("x" * letters)
        assert (listener.ended, ended) == (TOO_SLOW, [1])
        assert not listener._lines
        listener.send("more")
        listener.send_live(("p", "ink"), "more")
        assert not listener._lines
        assert not listener._live


def test_ink_waits_in_order_then_the_latest_alone() -> None:
    listener = Listener(None, 100, 1000)  # type: ignore[arg-type]
    for k in range(300):
        listener.send_live(("p", "ink"), f"{k:04d}")
    lines = asyncio.run(listener.next())
    assert lines == [*(f"{k:04d}" for k in range(len(lines) - 1)), "0299"]
    assert len(lines) < 30
    assert listener.ended is None


def test_a_browser_that_stops_reading_is_let_go(tmp_path: Path) -> None:
    """It hears why when it reads again; what waited for it is gone from memory at once; nobody else waits."""
    limits = Limits(waiting_letters=300_000, ops_per_s=1e6, ops_burst=10**6, log_bytes_burst=10**9)
    with Server(Config(tmp_path, port=0, limits=limits), fast_passwords=True) as hub:
        populate(hub)
        with Client(hub.url, "operator", PASSWORD) as operator:
            case = scanned(hub, operator)
            deaf = socket.create_connection(("127.0.0.1", hub.config.port))
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100_000)
            cookies = "; ".join(f"{c.name}={c.value}" for c in operator.http.cookies.jar)
            url = f"ws://127.0.0.1:{hub.config.port}/api/cases/{case.id}/room"
            me = {"Cookie": cookies}
            opened = connect(url, sock=deaf, additional_headers=me, compression=None, max_queue=1, ping_interval=None)
            with opened as stuck, case.enter() as room:
                stuck.recv()
                assert hub.site.rooms.count(case.id) == 2
                listener = next(x for x in hub.site.rooms._rooms[case.id])
                big = [[float(n % 900), 2.5] for n in range(5000)]
                took = []
                for k in range(200):
                    start = time.monotonic()
                    room.draw({"id": f"b{k % 3}", "camera": "camera1", "pixels": big, "width_mm": 1})
                    took.append(time.monotonic() - start)
                    assert listener._letters <= 400_000
                    if hub.site.rooms.count(case.id) == 1:
                        break
                assert hub.site.rooms.count(case.id) == 1, "never let go"
                assert max(took) < 15  # nobody waits for who does not read
                room.draw(stroke("s"))
                heard, why = 0, None
                try:
                    while True:
                        heard += str(stuck.recv(timeout=20)).startswith('{"type":"event"')
                except ConnectionClosed as e:
                    why = e.rcvd
                assert why is not None
                assert (why.code, why.reason) == TOO_SLOW
                assert heard < room.seq
                back = Room(case, since=heard)
                assert [x.seq for x in back.events] == list(range(heard + 1, room.seq + 1))
                back.close()


# ------------------------------------------------------------------------------------------------------- clocks, locks


def test_a_clock_that_jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.time_ns()
    hub = Clock(after=now + 10**9)  # the log's last entry is in the future: the wall was set back
    seen = [now + 10**9]
    for jump in (0, 10**18, -(10**18), 5, -5):
        monkeypatch.setattr(clock.time, "time_ns", lambda jump=jump: now + jump)
        seen += [hub.now_ns() for _ in range(3)]
    assert seen == sorted(set(seen))
    assert seen[-1] - seen[0] < 60 * 10**9  # never a leap


def test_a_clock_that_jumps_between_two_starts(hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch) -> None:
    case = scanned(hub, sign_in("operator"))
    real = time.time_ns
    with case.enter() as room:
        room.comment("before")
        monkeypatch.setattr(clock.time, "time_ns", lambda: real() - 86_400 * 10**9)
        room.comment("meanwhile")
    hub.close()
    with Server(hub.config, fast_passwords=True) as second, Client(second.url, "operator", PASSWORD) as again:
        case = again.case(case.id)
        with case.enter() as room:
            room.comment("after")
        log = case.events()
    assert [e.seq for e in log] == list(range(1, len(log) + 1))
    times = [e.at_ns for e in log]
    assert times == sorted(set(times))


LOCKER = """
import sqlite3, sys
c = sqlite3.connect(sys.argv[1], isolation_level=None)
c.execute("BEGIN IMMEDIATE")
print("locked", flush=True)
sys.stdin.readline()
"""


def test_a_database_that_another_process_has_locked(hub: Server, sign_in: SignIn) -> None:
    """For a while: words wait. For long: they are refused with a sentence; to read goes on; then all goes on."""
    case = scanned(hub, sign_in("operator"))
    sa.event.listen(hub.site.engine, "connect", lambda c, _: c.execute("PRAGMA busy_timeout=700"))
    hub.site.engine.dispose()
    command = [sys.executable, "-c", LOCKER, str(hub.config.data / "hub.sqlite")]
    with case.enter() as room:
        for patience, good in ((0.2, True), (2.0, False)):
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
                assert other.stdout is not None
                assert other.stdin is not None
                other.stdout.readline()
                let_go = threading.Timer(patience, lambda p=other: p.communicate("\n"))
                let_go.start()
                before = room.seq
                if good:
                    room.draw(stroke("s"))
                else:
                    with pytest.raises(HubError, match="database is locked; nothing was changed"):
                        room.draw(stroke("t"))
                    assert case.get().seq == room.seq == before
                let_go.join()
        room.draw(stroke("t"))
        assert room.seq == 5


def test_two_hubs_on_one_folder(hub: Server) -> None:
    with pytest.raises(OutputError, match="another hub runs on this folder; stop it first"):
        Server(Config(hub.config.data, port=0))


# ------------------------------------------------------------------------------------------ strokes, operators, experts


def test_a_stroke_on_another_scan(hub: Server, sign_in: SignIn) -> None:
    case = scanned(hub, sign_in("operator"))
    with case.enter() as room, pytest.raises(HubError, match=r"a stroke on scan sha256:old; the present one is .*draw"):
        room.say({"kind": "put", "stroke": stroke("s"), "scan": "sha256:old"})
    assert case.state().strokes == {}


def test_two_operators(hub: Server, sign_in: SignIn, without_instrument: list[str]) -> None:
    """Both may arm and start: the log's order decides, the second is told; either may stop."""
    assert without_instrument == []
    from fringescope.wire import PersonRole

    hub.site.accounts.add("second", PASSWORD, PersonRole.OPERATOR)
    case = scanned(hub, sign_in("operator"))
    second = sign_in("second")
    with case.enter() as one, second.case(case.id).enter() as two:
        one.draw(stroke("s"))
        version = one.submit()
        ready(hub, case, 1, version.content)
        word = {"kind": "arm", "version": 1, "content": version.content, "pattern": "p" * 64}
        outcomes: list[str] = []

        def arm(room: Room) -> None:
            try:
                room.say(word)
                outcomes.append("armed")
            except HubError as e:
                outcomes.append(str(e))

        threads = [threading.Thread(target=arm, args=(r,)) for r in (one, two)]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
        assert sorted(outcomes)[0] == "armed"
        assert sorted(outcomes)[1].startswith("version 1 is armed")
        two.say({"kind": "start", "version": 1, "pattern": "p" * 64})
        with pytest.raises(HubError, match="version 1 is projecting"):
            one.say({"kind": "start", "version": 1, "pattern": "p" * 64})
        one.stop("mine")
        assert one.wait(1, "previewed", "stopped", "checked").number == 1
        assert not examination.shown(hub.site.hub._books[case.id].truth.exam)


def test_the_right_is_gone_while_drawing(hub: Server, sign_in: SignIn) -> None:
    """Out at once, with the reason; what was drawn stays; nothing comes in afterwards."""
    case, expert = scanned(hub, sign_in("operator")), sign_in("expert")
    invite(case, expert)
    room = expert.case(case.id).enter()
    room.draw(stroke("s"))
    pen = threading.Thread(target=lambda: [time.sleep(0.002) or _try(room, k) for k in range(300)])
    pen.start()
    time.sleep(0.1)
    case.hub.ask("DELETE", f"/api/cases/{case.id}/members/{expert.me.person.id}")
    room._thread.join(10)
    pen.join(10)
    assert room.closed == "your right to see this case has ended"
    revoked = next(e.seq for e in case.events() if e.kind == "revoked")
    after = [e for e in case.events(since=revoked) if e.actor == expert.me.person.id]
    assert {e.refused for e in after} <= {"your right to see this case has ended"}  # what was in the queue already
    mine = {e.payload["stroke"]["id"] for e in case.events() if e.kind == "put" and not e.refused}
    assert set(case.state().strokes) == mine
    assert "s" in case.state().strokes
    with pytest.raises(HubError, match="no such case, or you were not invited"):
        room.reconnect()


def test_the_right_is_gone_in_the_middle_of_many_ops(
    hub: Server, sign_in: SignIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a time offline: each is judged for itself, and nothing comes behind the word that they are out."""
    case, expert = scanned(hub, sign_in("operator")), sign_in("expert")
    invite(case, expert)
    say = hub.site.hub.say

    async def slowly(*args: Any) -> Any:
        said = await say(*args)
        if args[2].number == 3:
            who = expert.me.person.id
            await asyncio.to_thread(case.hub.ask, "DELETE", f"/api/cases/{case.id}/members/{who}")
        return said

    monkeypatch.setattr(hub.site.hub, "say", slowly)
    lot = [{"client": "c", "number": k, "what": {"kind": "comment", "comment": f"c{k}", "text": "x"}}
           for k in range(1, 9)]  # fmt: skip
    with pytest.raises(HubError, match="has ended; what you said before that is written down") as e:
        HubCase(expert, case.id).say(lot)
    assert e.value.status == 403
    assert [x.kind for x in case.events(since=4)] == ["comment"] * 3 + ["revoked"]


def _try(room: Room, k: int) -> None:
    with contextlib.suppress(HubError):
        room.say({"kind": "put", "stroke": stroke(f"k{k}"), "scan": SCAN}, wait=False)
