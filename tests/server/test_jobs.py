"""Long work: cancelled at once and alone, and never where everybody waits."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from fringescope.errors import DeviceError, DeviceLostError
from fringescope.server.processes.parent import Child
from fringescope.server.running import Server
from tests.server.conftest import SignIn
from tests.server.test_hub import RIG, SCAN, scanned, stroke


async def begun(note: Path, times: int = 1) -> None:
    async with asyncio.timeout(60):
        while not note.exists() or len(note.read_text().split()) < times:
            await asyncio.sleep(0.02)


def with_child(work: Callable[[Child], Any]) -> None:
    async def run() -> None:
        child = Child("tests.server.slow_hand")
        try:
            await work(child)
        finally:
            await child.kill()

    asyncio.run(run())


def test_who_cancels_ends_their_own_work_alone(tmp_path: Path) -> None:
    """The process ends in the middle of it; what waits behind it is begun anew, and what comes meanwhile is done."""
    long, behind, later = (str(tmp_path / n) for n in ("long", "behind", "later"))

    async def work(child: Child) -> None:
        first = asyncio.create_task(child.call("sleep", seconds=600, note=long))
        await begun(tmp_path / "long")
        second = asyncio.create_task(child.call("sleep", seconds=0, note=behind))
        await asyncio.sleep(0)
        first.cancel()
        with pytest.raises(asyncio.CancelledError):
            await first
        ends = asyncio.create_task(child.restart())
        await asyncio.sleep(0)
        third = asyncio.create_task(child.call("sleep", seconds=0, note=later))
        async with asyncio.timeout(60):
            await ends
            assert await second == behind
            assert await third == later

    with_child(work)


def test_what_is_being_done_is_begun_anew(tmp_path: Path) -> None:
    """Who cancels what still waits costs the one before only time."""
    note = str(tmp_path / "note")

    async def work(child: Child) -> None:
        first = asyncio.create_task(child.call("sleep", seconds=2, note=note))
        await begun(tmp_path / "note")
        await child.restart()
        async with asyncio.timeout(60):
            assert await first == note
        assert (tmp_path / "note").read_text().split() == ["begun", "begun"]

    with_child(work)


def test_who_ends_the_hub_ends_all_of_it(tmp_path: Path) -> None:
    async def work(child: Child) -> None:
        first = asyncio.create_task(child.call("sleep", seconds=600, note=str(tmp_path / "note")))
        await begun(tmp_path / "note")
        await child.kill()
        with pytest.raises(DeviceLostError, match="cancelled"):
            await first

    with_child(work)


def test_many_watch_and_the_instrument_is_asked_once(hub: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty who look put one question at a time to the devices: what must light waits for one frame alone."""
    instrument = hub.site.instrument
    busy, most, calls = 0, 0, 0

    async def call(*_: Any, **how: Any) -> dict[str, Any]:
        nonlocal busy, most, calls
        busy, calls = busy + 1, calls + 1
        most = max(most, busy)
        await asyncio.sleep(0.05)
        busy -= 1
        if how["camera"] == "none":
            raise DeviceError("no camera none")
        return {"camera": how["camera"], "width": how["width"]}

    async def opened() -> None:
        return None

    async def watch() -> list[Any]:
        asked = [instrument.live(c, w, 60) for _ in range(10) for c in ("a", "b") for w in (640, 960)]
        return await asyncio.gather(*asked, instrument.live("none", 640, 60), return_exceptions=True)

    monkeypatch.setattr(instrument._devices, "call", call)
    monkeypatch.setattr(instrument, "open", opened)
    assert hub.loop is not None
    found = asyncio.run_coroutine_threadsafe(watch(), hub.loop).result(60)
    assert [x["camera"] + str(x["width"]) for x in found[:4]] == ["a640", "a960", "b640", "b960"]
    assert isinstance(found[-1], DeviceError)
    assert (most, calls) == (1, 5)
    assert instrument._frames == {}


def test_nobody_waits_for_the_database_where_all_are_served(hub: Server, sign_in: SignIn) -> None:
    """A disk that is busy for seconds keeps who asked waiting, and no stop, no beat, no handshake."""
    seen: list[str] = []

    @sa.event.listens_for(hub.site.engine, "begin")
    def begin(_connection: Any) -> None:
        import traceback

        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return
        seen.append("".join(traceback.format_stack(limit=12)))

    operator, expert, admin = (sign_in(x) for x in ("operator", "expert", "admin"))
    case = scanned(hub, operator)
    operator.ask("PUT", f"/api/cases/{case.id}/members/{expert.me.person.id}")
    with case.enter() as room, expert.case(case.id).enter() as far:
        far.draw(stroke("s"))
        far.undo()
        far.draw(stroke("s"))
        version = far.submit()
        far.say({"kind": "sign", "version": version.number, "content": version.content, "meaning": "proposed"})
        room.comment("here")
        room.stop()
        case.change(specimen={"organ": "tongue"})
        for path, body in (("scans", {}), ("compare", {"before": SCAN, "after": RIG}), ("carry", {"version": 1})):
            job = operator.ask("POST", f"/api/cases/{case.id}/{path}", body)["id"]
            operator.ask("GET", f"/api/jobs/{job}")
            operator.ask("DELETE", f"/api/jobs/{job}")
        for path in ("", "/events", "/state", "/scans", "/files", "/members", "/invitations"):
            operator.ask("GET", f"/api/cases/{case.id}{path}")
        for path in ("/api/cases", "/api/jobs", "/api/instrument", "/api/people", "/api/passkeys"):
            operator.ask("GET", path)
        operator.stop()
        guest = case.invite("Gast")
        case.revoke(guest.id)
        operator.ask("DELETE", f"/api/cases/{case.id}/members/{expert.me.person.id}")
    admin.ask("PATCH", f"/api/people/{expert.me.person.id}", {"disabled": True})
    admin.ask("GET", "/api/audit")
    admin.case(case.id).erase("asked for")
    operator.sign_out()
    assert seen == [], seen[0]
