"""How long until the others see a stroke: a crowd in one room of a hub, some of them drawing.

    python benchmarks/hub.py [--clients 10] [--drawing 2] [--seconds 10] [--json]
    python benchmarks/hub.py --confirm 30 [--device URI] [--json]

The second form: how long from the operator's START, as their program sends it, until the simulated projector holds the
picture, by the projector's own record. Both processes read the one monotonic clock of the machine.

The hub runs in a process of its own, the crowd in this one. Ratios first: `stroke` (drawn, written down, seen by
another) beside one synced transaction of SQLite on the same disk, `ink` (a piece of a stroke while it is drawn) beside
a message there and back through a bare socket. Every client checks that each event came once and in order, and its
list of hashes is compared with the log.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import itertools
import json
import math
import os
import re
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from fringescope.client import Client, HubError

CASE = "case-" + 20 * "0"
PASSWORD = "correct horse battery"
POINTS = 100  # of a stroke
STROKES = 40  # that each who draws has; then they are drawn anew
_SEQ, _ID, _INK = re.compile(r'"seq":(\d+)'), re.compile(r'"id":"(\d+-\d+)-'), re.compile(r'"points":\[\[([0-9.]+)')
_MARK, _HASH = re.compile(r'"layer":"(\d+)"'), re.compile(r'"hash":"([0-9a-f]{64})"}$')


def serve(folder: Path, database: str | None, device: str | None) -> None:
    """The hub's process, with a case that has a scan: says where it is, ends when its input does."""
    from fringescope.server import cases
    from fringescope.server.config import Config, Limits
    from fringescope.server.running import Server
    from fringescope.settings import from_dict
    from fringescope.types.examination import RigChanged, ScanTaken
    from fringescope.wire import PersonRole, Specimen

    limits = Limits(requests_per_s=1e6, requests_burst=10**6, logins_per_minute=1e6)
    patient = from_dict({"examination": {"verdict_s": 60.0}})  # a busy machine is slow to look: not what is timed here
    config = Config(folder, port=0, database=database, limits=limits, instrument=device, settings=patient)
    with Server(config, fast_passwords=True) as server:
        for role in (PersonRole.OPERATOR, PersonRole.EXPERT, PersonRole.OBSERVER):
            server.site.accounts.add(role.value, PASSWORD, role)

        async def scanned() -> None:
            said = server.site.hub
            await said.note(CASE, "bench", "operator", "opened", {},
                            lambda c: cases.insert(c, CASE, "bench", Specimen(), None, 0))  # fmt: skip
            await said.tell(CASE, RigChanged("rig"))
            await said.tell(CASE, ScanTaken("scan", "rig"))

        assert server.loop is not None
        if device is None:
            asyncio.run_coroutine_threadsafe(scanned(), server.loop).result(20)
        print(server.url, flush=True)
        for _ in sys.stdin:  # each line asks since when the projector holds a picture
            shown = asyncio.run_coroutine_threadsafe(server.site.instrument.shown(), server.loop)
            print(shown.result(60), flush=True)


@contextlib.contextmanager
def hub(
    folder: Path, database: str | None, device: str | None = None
) -> Iterator[tuple[str, subprocess.Popen[str]]]:  # fmt: skip
    """A hub in another process: its address and process."""
    asked = [sys.executable, __file__, "--serve", str(folder), *(["--database", database] if database else []),
             *(["--device", device] if device else [])]  # fmt: skip
    with subprocess.Popen(asked, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip(), process
        finally:
            process.communicate()


def rss_mb(pid: int) -> float:
    """Memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s(pid: int) -> float:
    """Time that a process has computed."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Heard:
    """What one client heard."""

    seq: int = 0
    lost: int = 0
    doubled: int = 0
    closed: str = ""
    hashes: Any = field(default_factory=hashlib.sha256)


@dataclass
class Crowd:
    """All clients, in one process with one clock."""

    case: str
    url: str
    cookies: dict[str, str]
    rate_hz: float
    strokes_hz: float
    heard: list[Heard] = field(default_factory=list)
    sent: dict[str, float] = field(default_factory=dict)
    answered: int = 0
    refused: list[str] = field(default_factory=list)
    stroke_ms: list[float] = field(default_factory=list)
    ink_ms: list[float] = field(default_factory=list)
    ink_sent: int = 0
    over: bool = False
    marks: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    async def enter(self, role: str) -> ClientConnection:
        """Comes into the room."""
        address = f"{self.url.replace('http', 'ws', 1)}/api/cases/{self.case}/room"
        cookie = {"Cookie": self.cookies[role]}
        return await connect(address, additional_headers=cookie, compression=None, max_size=None, open_timeout=60)

    async def listen(self, socket: ClientConnection, me: Heard, drew: bool) -> None:
        """Takes what comes, and notes how old it is."""
        try:
            async for text in socket:
                now = perf_counter()
                assert isinstance(text, str)
                if text.startswith('{"type":"event"'):
                    self.event(text, now, me, drew)
                elif text.startswith('{"type":"relayed"') and (ink := _INK.search(text)):
                    self.ink_ms.append(1e3 * (now - self.sent.get(f"ink{float(ink[1]):.0f}", now)))
                elif text.startswith('{"type":"said"'):
                    said = json.loads(text)
                    self.answered += 1
                    if said["refused"]:
                        self.refused.append(said["refused"])
                elif text.startswith('{"type":"refusal"'):
                    self.refused.append(text)
            me.closed = me.closed or f"{socket.close_code} {socket.close_reason}"
        except Exception as e:
            me.closed = f"{type(e).__name__}: {e}"

    def event(self, text: str, now: float, me: Heard, drew: bool) -> None:
        """An event: the next one, and how long it was under way."""
        found, hashed = _SEQ.search(text), _HASH.search(text)
        assert found is not None
        assert hashed is not None
        seq = int(found[1])
        me.lost += max(0, seq - me.seq - 1)
        me.doubled += seq <= me.seq
        me.seq = seq
        me.hashes.update(hashed[1].encode())
        if not drew and (mark := _MARK.search(text)):
            self.stroke_ms.append(1e3 * (now - self.sent[f"stroke{mark[1]}"]))

    async def draw(self, socket: ClientConnection, n: int) -> None:
        """Draws: ink all the time, a finished stroke now and then."""
        next_s, pieces, number = perf_counter(), 0, 0
        each = max(1, round(self.rate_hz / self.strokes_hz))
        while not self.over:
            mark = next(self.marks)
            points = [[float(mark), 50.0], [pieces % 500 + 1.0, 60.0]]
            self.sent[f"ink{mark}"] = perf_counter()
            await socket.send(json.dumps({"type": "ink", "stroke": f"s{n}", "points": points, "camera": "camera1"}))
            self.ink_sent += 1
            pieces += 1
            if pieces % each == 0:
                number += 1
                line = [[100 + 3 * k + number % 50, 200 + 40 * math.sin(k / 9 + n)] for k in range(POINTS)]
                stroke = {"id": f"{n}-{number % STROKES}-", "camera": "camera1", "pixels": line, "width_mm": 0.8}
                what = {"kind": "put", "stroke": stroke, "scan": "scan", "layer": str(mark)}
                self.sent[f"stroke{mark}"] = perf_counter()
                op = {"client": f"crowd-{n}", "number": number, "what": what}
                await socket.send(json.dumps({"type": "say", "op": op}))
            if len(self.sent) > 20_000:
                for old in list(itertools.islice(self.sent, 10_000)):
                    del self.sent[old]
            next_s += 1 / self.rate_hz
            await asyncio.sleep(max(0.0, next_s - perf_counter()))
        socket.number = number  # type: ignore[attr-defined]


async def run(crowd: Crowd, clients: int, drawing: int, seconds: float, pid: int) -> dict[str, Any]:
    """All of it; what came of it."""
    roles = [("operator", "expert")[n % 2] if n < drawing else "observer" for n in range(clients)]
    crowd.heard = [Heard() for _ in roles]
    sockets = [await crowd.enter(role) for role in roles]
    listening = [
        asyncio.create_task(crowd.listen(s, h, n < drawing))
        for n, (s, h) in enumerate(zip(sockets, crowd.heard, strict=True))
    ]
    await asyncio.sleep(0.3)
    memory, begun, computed, own = [rss_mb(pid)], perf_counter(), cpu_s(pid), process_time()
    pens = [asyncio.create_task(crowd.draw(s, n)) for n, s in enumerate(sockets[:drawing])]
    while perf_counter() - begun < seconds:
        await asyncio.sleep(seconds / 50)
        memory.append(rss_mb(pid))
    took, computed, own = perf_counter() - begun, cpu_s(pid) - computed, process_time() - own
    crowd.over = True
    await asyncio.gather(*pens)
    said = sum(s.number for s in sockets[:drawing])  # type: ignore[attr-defined]
    end = perf_counter() + 20
    while (crowd.answered < said or len({h.seq for h in crowd.heard}) > 1) and perf_counter() < end:
        await asyncio.sleep(0.05)
    await asyncio.sleep(0.2)
    for s in sockets:
        await s.close()
    await asyncio.gather(*listening)
    return {
        "clients": clients, "drawing": drawing, "seconds": round(took, 1), "strokes": said,
        "answered": crowd.answered, "refused": len(crowd.refused), "why": crowd.refused[:3],
        "lost": sum(h.lost for h in crowd.heard), "doubled": sum(h.doubled for h in crowd.heard),
        "closed_early": [h.closed for h in crowd.heard if not h.closed.startswith("1000")],
        "stroke_ms": spread(crowd.stroke_ms), "ink_ms": spread(crowd.ink_ms), "ink_sent": crowd.ink_sent,
        "ink_seen_share": round(len(crowd.ink_ms) / max(1, crowd.ink_sent * (clients - 1)), 4),
        "memory_mb": [round(m, 1) for m in memory], "hub_cpu_share": round(computed / took, 3),
        "crowd_cpu_share": round(own / took, 3),
    }  # fmt: skip


def stroke_across(name: str, shift: float, camera: Any) -> dict[str, Any]:
    """A line through the middle of a camera's picture."""
    width, height = camera
    pixels = [[width * (0.4 + 0.008 * i), height * 0.45 + shift + 0.002 * width * i] for i in range(25)]
    return {"id": name, "camera": "camera1", "pixels": pixels, "width_mm": 0.8, "color": "#ffffff"}


@contextlib.contextmanager
def watching(case: Any, n: int) -> Iterator[list[int]]:
    """So many who look at the live video of a case meanwhile; how many frames each has seen."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect as connect_here

    cookies = "; ".join(f"{c.name}={c.value}" for c in case.hub.http.cookies.jar)
    frames = [0] * n

    def watch(k: int) -> None:
        address = f"{case.hub.url.replace('http', 'ws', 1)}/api/cases/{case.id}/video/camera{k % 3 + 1}"
        how = connect_here(address, additional_headers={"Cookie": cookies}, compression=None)
        with contextlib.suppress(ConnectionClosed, TimeoutError), how as socket:
            while not over.is_set():
                told = json.loads(socket.recv(60))
                if told["type"] == "frame":
                    socket.recv(60)
                    frames[k] += 1
                    socket.send(json.dumps({"ack": told["number"]}))

    over = threading.Event()
    threads = [threading.Thread(target=watch, args=(k,), daemon=True) for k in range(n)]
    for t in threads:
        t.start()
    try:
        yield frames
    finally:
        over.set()
        for t in threads:
            t.join(60)


def confirmed(url: str, process: subprocess.Popen[str], n: int, videos: int) -> dict[str, Any]:
    """The operator at the instrument draws, previews, arms and starts `n` times."""
    assert process.stdin is not None
    assert process.stdout is not None
    frame_ms, event_ms, answer_ms, again = [], [], [], 0
    with Client(url, "operator", PASSWORD, timeout_s=300) as operator:
        case = operator.open_case("bench")
        case.scan("as received")
        photo = next(f for f in case.scans()[0].files if f.name == "photo-camera1.jpg")
        import cv2
        import numpy as np

        picture = cv2.imdecode(np.frombuffer(case.fetch(photo.sha256), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        with watching(case, videos) as frames, case.enter() as room:
            heard: dict[str, float] = {}
            room.on_event = lambda e: heard.__setitem__(e.kind, perf_counter())
            for k in range(2 * n):
                if len(frame_ms) == n:
                    break
                try:
                    room.draw(stroke_across("cut", 0.02 * k, picture.shape[::-1]))
                    version = room.wait(room.submit(), "checked")
                    room.preview(version.number)
                    version = room.arm(room.wait(version, "previewed", timeout_s=10))
                    begun, sent_ns = perf_counter(), time.monotonic_ns()
                    room.say({"kind": "start", "version": version.number, "pattern": version.pattern})
                    answered = perf_counter()
                    room.wait(version, "projecting", timeout_s=20)
                    process.stdin.write("shown\n")
                    process.stdin.flush()
                    held_ns = int(process.stdout.readline())
                    if held_ns <= sent_ns:
                        raise HubError("the projector is dark")
                except HubError:  # a busy machine kept its watchdog waiting: dark, so once more
                    again += 1
                    continue
                finally:
                    room.stop()
                evidence = sum(1 for _ in room.heard("evidence"))
                frame_ms.append((held_ns - sent_ns) / 1e6)
                event_ms.append(1e3 * (heard["start"] - begun))
                answer_ms.append(1e3 * (answered - begun))
                with contextlib.suppress(HubError):  # the photographs of it are taken before the next
                    room.until(lambda n=evidence: sum(1 for _ in room.heard("evidence")) > n, timeout_s=2)
    return {"frame_ms": spread(frame_ms), "event_ms": spread(event_ms), "answer_ms": spread(answer_ms), "again": again,
            "video_frames": frames}  # fmt: skip


def spread(values: list[float]) -> dict[str, float]:
    """Median, 99th percentile and the longest."""
    if not values:
        return {"n": 0}
    ordered = sorted(values)
    return {
        "n": len(ordered), "p50": round(statistics.median(ordered), 2),
        "p99": round(ordered[min(len(ordered) - 1, math.ceil(0.99 * len(ordered)) - 1)], 2),
        "max": round(ordered[-1], 2),
    }  # fmt: skip


def synced_ms(folder: Path) -> float:
    """One transaction of SQLite that waits for the disk."""
    c = sqlite3.connect(folder / "synced.sqlite", isolation_level=None)
    c.executescript("PRAGMA journal_mode=WAL; PRAGMA synchronous=FULL; CREATE TABLE t (v TEXT)")
    times = []
    for _ in range(100):
        start = perf_counter()
        c.execute("INSERT INTO t VALUES (?)", ("x" * 5000,))
        times.append(1e3 * (perf_counter() - start))
    c.close()
    return statistics.median(times)


async def bare_ms() -> float:
    """A line there and back through a socket."""

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            writer.write(line)
        writer.close()

    server = await asyncio.start_server(echo, "127.0.0.1", 0)
    reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
    times = []
    for _ in range(300):
        start = perf_counter()
        writer.write(b"x" * 100 + b"\n")
        await reader.readline()
        times.append(1e3 * (perf_counter() - start))
    writer.close()
    await asyncio.sleep(0.05)
    server.close()
    return statistics.median(times)


def main() -> None:
    ask = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    ask.add_argument("--clients", type=int, default=10)
    ask.add_argument("--drawing", type=int, default=2)
    ask.add_argument("--seconds", type=float, default=10)
    ask.add_argument("--rate", type=float, default=30, help="pieces of ink a second, of each who draws")
    ask.add_argument("--strokes", type=float, default=2, help="strokes a second, of each who draws")
    ask.add_argument("--database", help="URL; default: SQLite")
    ask.add_argument("--json", action="store_true")
    ask.add_argument("--confirm", type=int, metavar="N", help="time N starts on the simulated instrument instead")
    ask.add_argument("--videos", type=int, default=0, help="of the second form: so many watch live meanwhile")
    ask.add_argument("--device", help="of the second form; default: a small simulated one")
    ask.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    given = ask.parse_args()
    if given.serve is not None:
        serve(given.serve, given.database, given.device)
        return
    if given.confirm is not None:
        with tempfile.TemporaryDirectory(prefix="fringescope-bench-") as name:
            folder, device = Path(name), given.device or "sim://paper/tissue-domed?scale=0.06&seed=3"
            with hub(folder, given.database, device) as (url, process):
                starts = confirmed(url, process, given.confirm, given.videos)
            starts |= {"device": device, "synced_ms": round(synced_ms(folder), 3)}
        if given.json:
            print(json.dumps(starts))
            return
        frame, event = starts["frame_ms"], starts["event_ms"]
        print(f"START to the projector's frame, {frame['n']} times on {device}, {given.videos} watch live: "
              f"{frame['p50']} ms, "
              f"99 %: {frame['p99']}, longest {frame['max']}; {starts['again']} tries more")  # fmt: skip
        print(f"  of it until the event is written and told: {event['p50']} ms, 99 %: {event['p99']}; "
              f"a synced transaction of SQLite: {starts['synced_ms']} ms")  # fmt: skip
        return
    made = tempfile.TemporaryDirectory(prefix="fringescope-bench-")
    with made as name, hub(Path(name), given.database) as (url, process):
        pid = process.pid
        people = {role: Client(url, role, PASSWORD) for role in ("operator", "expert", "observer")}
        case = people["operator"].case(CASE)
        for role in ("expert", "observer"):
            case.hub.ask("PUT", f"/api/cases/{case.id}/members/{people[role].me.person.id}")
        cookies = {
            role: "; ".join(f"{c.name}={c.value}" for c in p.http.cookies.jar) for role, p in people.items()
        }  # fmt: skip
        crowd = Crowd(case.id, url, cookies, given.rate, given.strokes)
        found = asyncio.run(run(crowd, given.clients, given.drawing, given.seconds, pid))
        log, hashes = case.events(), hashlib.sha256()
        while log:
            for e in log:
                hashes.update(e.hash.encode())
            log = case.events(since=log[-1].seq)
        found["events"] = case.get().seq
        found["same_log"] = {h.hashes.hexdigest() for h in crowd.heard} == {hashes.hexdigest()}
        found["synced_ms"], found["bare_ms"] = round(synced_ms(Path(name)), 3), round(asyncio.run(bare_ms()), 3)
    if given.json:
        print(json.dumps(found))
        return
    stroke, ink, memory = found["stroke_ms"], found["ink_ms"], found["memory_mb"]
    print(f"stroke seen by another: {stroke['p50'] / found['synced_ms']:.1f} times a synced transaction of SQLite;")
    print(f"  ink: {ink['p50'] / found['bare_ms']:.1f} times there and back through a bare socket")
    print(f"{given.clients} clients, {given.drawing} drawing, {found['seconds']} s, {found['events']} events: "
          f"{found['lost']} lost, {found['doubled']} doubled, the same log for all: {found['same_log']}")  # fmt: skip
    print(f"stroke {stroke['p50']} ms, 99 %: {stroke['p99']}, longest {stroke['max']}")
    seen = 100 * found["ink_seen_share"]
    print(f"ink {ink['p50']} ms, 99 %: {ink['p99']}, longest {ink['max']}, seen {seen:.1f} %")
    print(f"hub: {100 * found['hub_cpu_share']:.0f} % of a core, {memory[0]} MB before, {memory[len(memory) // 5]} MB "
          f"after a fifth, {memory[-1]} MB at the end")  # fmt: skip


if __name__ == "__main__":
    main()
