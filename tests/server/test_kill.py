"""A hub killed in the middle of its work: what it acknowledged is there; what it did not, said again, is done once."""

from __future__ import annotations

import contextlib
import hashlib
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fringescope.client import Client, HubError, Room
from fringescope.server import database as db
from fringescope.server.config import Config
from fringescope.wire.room import Event
from tests.server.conftest import PASSWORD, checked
from tests.server.hub_process import FILES, SCANS, STROKES


class Victim:
    """The hub's process; `scans` are those that it said were kept."""

    def __init__(self, command: list[str], root: Path) -> None:
        self._command, self._root = command, root
        self.scans: list[str] = []
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            self._command, cwd=self._root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._ready = threading.Event()
        self._reading = [threading.Thread(target=self._read, daemon=True)]
        self._reading.append(threading.Thread(target=self._drain, daemon=True))
        for t in self._reading:
            t.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("sha256:") and line.endswith("\n"):  # else it was killed while it said so
                self.scans.append(line.strip())

    def _drain(self) -> None:
        assert self.process.stderr is not None
        self.errors = "".join(self.process.stderr)

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(30)
        for t in self._reading:
            t.join(30)
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.process.stdout.close()
        self.process.stderr.close()


@pytest.fixture
def victims() -> Iterator[list[Victim]]:
    made: list[Victim] = []
    yield made
    for victim in made:
        with contextlib.suppress(ProcessLookupError):
            victim.kill()


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def enter(url: str, victim: Victim, name: str, password: str) -> Client:
    """Signs in as soon as the hub answers."""
    end = time.monotonic() + 60
    while True:
        try:
            return Client(url, name, password)
        except HubError as e:
            if e.status or victim.process.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.05)


def back(room: Room, victim: Victim) -> None:
    """Comes back as soon as the hub answers, and says again what was not answered."""
    end = time.monotonic() + 60
    while True:
        try:
            room.reconnect()
            return
        except HubError:
            if victim.process.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.05)


def draw(room: Room, count: int) -> None:
    """Strokes, as fast as they go out, with no wait for an answer."""
    for k in range(count):
        stroke = {"id": f"s{k % 50}", "camera": "camera1", "pixels": [[1.0 * k, 5.0], [60.0, 70.0]], "width_mm": 0.5}
        try:
            room.say({"kind": "put", "stroke": stroke, "scan": "scan"}, wait=False)
        except HubError:
            return  # killed
        time.sleep(0.002)


def whole_files(folder: Path) -> int:
    """Every file under its hash is what its hash says."""
    count = 0
    for path in folder.glob("??/*"):
        assert hashlib.sha256(path.read_bytes()).hexdigest() == path.name
        count += 1
    return count


def answered(room: Room) -> set[int]:
    with room._lock:
        return set(range(1, room._number + 1)) - set(room._unanswered)


def ordered(log: list[Event], client: str) -> dict[int, Event]:
    """A client's events by number: each once, in its order."""
    mine = [e for e in log if e.client == client]
    assert [e.number for e in mine] == sorted({e.number for e in mine})
    return {e.number: e for e in mine}


def all_events(hub: Client, case: str) -> list[Event]:
    log: list[Event] = []
    while page := hub.case(case).events(since=log[-1].seq if log else 0):
        log += page
    return log


def killed(root: Path, folder: Path, times: int, victims: list[Victim], url: str | None, record: Any) -> None:
    chance, port = random.Random(times), free_port()
    command = [sys.executable, "-m", "tests.server.hub_process", str(folder), str(port), *([url] if url else [])]
    victim = Victim(command, root)
    victims.append(victim)
    hub = enter(f"http://127.0.0.1:{port}", victim, "operator", PASSWORD)
    end = time.monotonic() + 60
    while True:  # the cases are made right after the accounts
        with contextlib.suppress(HubError):
            room = hub.case(STROKES).enter()
            break
        assert time.monotonic() < end
        time.sleep(0.05)
    while not victim.scans:  # a busy machine is slow to keep the first
        assert time.monotonic() < end + 60
        time.sleep(0.05)
    seen: dict[int, str] = {}
    again = 0
    for _ in range(times):
        pen = threading.Thread(target=draw, args=(room, 400))
        pen.start()
        time.sleep(chance.uniform(0.1, 0.9))
        victim.kill()
        pen.join(30)
        room._thread.join(30)
        known, kept = answered(room), len(victim.scans)
        seen |= {e.seq: e.hash for e in room.events}
        again += room._number - len(known)
        whole_files(folder / "files")
        halves = set((folder / "files" / "new").iterdir())
        victim.start()
        back(room, victim)
        room.until(lambda: not room._unanswered, 60)
        assert not halves & set((folder / "files" / "new").iterdir())
        log = all_events(hub, STROKES)
        assert seen.items() <= {e.seq: e.hash for e in log}.items()  # what was seen stands
        mine = ordered(log, room.client)
        assert known <= set(mine) == set(range(1, room._number + 1))  # what was answered, and all that was said
        scans = {s.id: s for s in hub.case(SCANS).scans()}
        assert set(victim.scans[:kept]) <= set(scans)
        for scan in scans.values():
            assert len(scan.files) == FILES
            assert all((folder / "files" / f.sha256[:2] / f.sha256).stat().st_size == f.size for f in scan.files)
    room.close()
    hub.close()
    victim.kill()
    whole_files(folder / "files")
    engine = db.open_engine(Config(folder, database=url).url)
    cases, events, faults = checked(engine)
    engine.dispose()
    assert (cases, faults) == (2, [])
    assert victim.scans
    record("kills, events, scans, said again", (times, events, len(victim.scans), again))


def test_killed_while_it_writes(root: Path, tmp_path: Path, victims: list[Victim], record_property: Any) -> None:
    killed(root, tmp_path / "hub", 3, victims, None, record_property)


@pytest.mark.verify
@pytest.mark.parametrize("kind", ["sqlite", "postgres"])
def test_killed_fifty_times(
    root: Path, tmp_path: Path, victims: list[Victim], kind: str, request: pytest.FixtureRequest, record_property: Any
) -> None:
    url = request.getfixturevalue("cluster").new() if kind == "postgres" else None
    killed(root, tmp_path / "hub", 50, victims, url, record_property)


def test_the_command_line_killed_and_started_again(root: Path, tmp_path: Path, victims: list[Victim]) -> None:
    """`serve` with its own passwords: nobody is shut out, and the second start prints where it is."""
    port = free_port()
    command = [sys.executable, "-m", "fringescope", "serve", "--data", str(tmp_path / "hub"), "--port", str(port)]
    added = [sys.executable, "-m", "fringescope", "person", "add", "operator", "--role", "operator", "--data",
             str(tmp_path / "hub")]  # fmt: skip
    subprocess.run(added, input=PASSWORD + "\n", text=True, check=True, capture_output=True, cwd=root)
    victim = Victim(command, root)
    victims.append(victim)
    hub = enter(f"http://127.0.0.1:{port}", victim, "operator", PASSWORD)
    case = hub.open_case("S26-1")
    with case.enter() as room:
        room.comment("before")
        victim.kill()
        assert f"listens at http://127.0.0.1:{port}" in victim.errors
        victim.start()
        back(room, victim)
        room.comment("after")
        assert [e.payload["text"] for e in room.heard("comment") if e.payload] == ["before", "after"]
    assert [e.seq for e in case.events()] == [1, 2, 3]
    hub.close()
