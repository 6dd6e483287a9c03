"""The room of a case: what you say for good, what you point at, and all that the others do, in one order."""

from __future__ import annotations

import json
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from pydantic import TypeAdapter
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

from fringescope.client.hub import HubError
from fringescope.wire.ops import Op, StrokeDocument
from fringescope.wire.record import content_of_stroke
from fringescope.wire.room import (
    CaughtUp,
    Event,
    FromServer,
    Refusal,
    Relayed,
    Said,
    Standing,
    Warned,
    Welcome,
)

if TYPE_CHECKING:
    from fringescope.client.hub import HubCase

_MESSAGE: TypeAdapter[Any] = TypeAdapter(FromServer)


@dataclass(frozen=True)
class HubVersion:
    """A submitted version of a guideline, as it stands."""

    number: int
    phase: str
    content: str
    pattern: str
    dashed: str
    problems: tuple[str, ...]
    why: str


class Room:
    """A connection to the room of a case. `events` holds the log as far as it came, in its order and each once.

    Words are answered: a method that says something raises HubError where nothing came of it. After a lost connection
    `reconnect` goes on where it stopped, and says again what was not answered: it is done once. If the log lost its end
    meanwhile (a power cut), `events` begins anew.
    """

    def __init__(self, case: HubCase, since: int = 0) -> None:
        self.case = case
        self.client = f"py-{secrets.token_hex(8)}"
        self.events: list[Event] = []
        self.standing: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.relayed: queue.Queue[Relayed] = queue.Queue()
        self.welcome: Welcome | None = None
        self.closed: str = ""
        self.on_event: Callable[[Event], None] | None = None
        self._seq, self._number = since, 0
        self._answers: dict[int, queue.Queue[Said | Refusal]] = {}
        self._unanswered: dict[int, dict[str, Any]] = {}
        self._news = threading.Condition()
        self._lock = threading.Lock()
        self._socket: ClientConnection
        self._thread: threading.Thread
        self.reconnect()

    # ------------------------------------------------------------------------------------------------------ connection

    def reconnect(self) -> None:
        """Comes in, or comes back."""
        hub = self.case.hub
        scheme, rest = hub.url.split("://", 1)
        url = f"{'wss' if scheme == 'https' else 'ws'}://{rest}/api/cases/{self.case.id}/room?since={self._seq}"
        if self.events:
            url += f"&hash={self.events[-1].hash}"
        cookies = "; ".join(f"{c.name}={c.value}" for c in hub.http.cookies.jar)
        self.closed = ""
        self._open = ExitStack()
        try:
            how = connect(
                url, additional_headers={"Cookie": cookies}, max_size=64 << 20, ssl=self._tls(scheme == "https"),
                open_timeout=20, compression=None,
            )  # fmt: skip
            self._socket = self._open.enter_context(how)
        except (OSError, WebSocketException, TimeoutError) as e:
            raise HubError(f"{hub.url}: {e}; is the hub there?") from e
        self._thread = threading.Thread(target=self._hear, args=(self._socket,), name="room", daemon=True)
        self._caught_up = threading.Event()
        self._thread.start()
        if not self._caught_up.wait(30) or self.closed:
            raise HubError(self.closed or "the room does not answer")
        with self._lock:
            again = list(self._unanswered.values())
        for op in again:
            self._send({"type": "say", "op": op})

    def _tls(self, secure: bool) -> Any:
        if not secure:
            return None
        import ssl

        verify = self.case.hub.verify
        context = verify if isinstance(verify, ssl.SSLContext) else ssl.create_default_context()
        if verify is False:
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        return context

    def close(self) -> None:
        """Leaves."""
        self._open.close()
        self._thread.join(5)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _hear(self, socket: ClientConnection) -> None:
        try:
            for text in socket:
                self._take(_MESSAGE.validate_json(text))
            self.closed = self.closed or "the connection was closed"
        except ConnectionClosed as e:
            received = e.rcvd
            self.closed = (received.reason or f"closed ({received.code})") if received else "the connection was lost"
        finally:
            self.closed = self.closed or "the connection was closed"
            self._caught_up.set()
            with self._news:
                self._news.notify_all()
            for waiting in list(self._answers.values()):
                waiting.put(Refusal(why=self.closed))

    def _take(self, m: Any) -> None:
        if isinstance(m, Event):
            if m.seq <= self._seq:
                return
            with self._news:  # who sees the number finds the event
                self.events.append(m)
                self._seq = m.seq
                self._news.notify_all()
            if self.on_event is not None:
                self.on_event(m)
        elif isinstance(m, Said):
            with self._lock:
                self._unanswered.pop(m.number, None)
                waiting = self._answers.pop(m.number, None)
            if waiting is not None:
                waiting.put(m)
        elif isinstance(m, Standing):
            with self._news:
                self.standing = m.state
                self._news.notify_all()
        elif isinstance(m, Warned):
            self.warnings.append(m.text)
        elif isinstance(m, Relayed):
            self.relayed.put(m)
        elif isinstance(m, Welcome):
            self.welcome = m
            if m.anew:
                with self._news:
                    self._seq = 0
                    self.events.clear()
        elif isinstance(m, CaughtUp):
            self._caught_up.set()
        elif isinstance(m, Refusal):
            self.warnings.append(m.why)

    def _send(self, message: Mapping[str, Any]) -> None:
        try:
            self._socket.send(json.dumps(message))
        except (ConnectionClosed, OSError) as e:
            raise HubError(self.closed or f"the connection was lost: {e}") from e

    # ---------------------------------------------------------------------------------------------------------- saying

    def say(self, what: Mapping[str, Any], timeout_s: float = 20.0, wait: bool = True) -> Said | None:
        """An op for the log: its event. Raises HubError where it was refused."""
        with self._lock:
            self._number += 1
            number = self._number
            op = Op(client=self.client, number=number, at_ns=time.time_ns(), what=dict(what))  # type: ignore[arg-type]
            plain = op.model_dump(mode="json", exclude_none=True)
            answer: queue.Queue[Said | Refusal] = queue.Queue()
            self._unanswered[number] = plain
            if wait:
                self._answers[number] = answer
            self._send({"type": "say", "op": plain})
        if not wait:
            return None
        try:
            said = answer.get(timeout=timeout_s)
        except queue.Empty:
            raise HubError(f"no answer to {what.get('kind')} in {timeout_s:g} s") from None
        if isinstance(said, Refusal):
            raise HubError(said.why)
        if said.refused:
            raise HubError(said.refused, 409)
        return said

    def draw(self, stroke: Mapping[str, Any], meaning: str = "cut", layer: str = "") -> str:
        """A stroke on the present scan; its content's hash."""
        plain = StrokeDocument(**stroke).model_dump(mode="json", exclude_none=True)
        self.say({"kind": "put", "stroke": plain, "scan": self.scan, "meaning": meaning, "layer": layer})
        return content_of_stroke(plain, meaning)

    def remove(self, stroke: str) -> None:
        """Takes a stroke of yours away."""
        self.say({"kind": "remove", "stroke": stroke})

    def undo(self, of: int | None = None) -> None:
        """Takes back what event `of` did, or the last of yours."""
        self.say({"kind": "undo", "of": of})

    def comment(self, text: str, **about: Any) -> None:
        """Words for the others."""
        self.say({"kind": "comment", "comment": f"c-{secrets.token_hex(6)}", "text": text, **about})

    def submit(self) -> HubVersion:
        """Submits all strokes of yours that are on the present scan."""
        state = self.case.state()
        me, scan = self.case.hub.me.person.id, state.standing["scan"]
        mine = {k: v["content"] for k, v in state.strokes.items() if v["author"] == me and v["scan"] == scan}
        if not mine:
            raise HubError("no stroke of yours lies on the present scan; draw first")
        said = self.say({"kind": "submit", "strokes": list(mine.items()), "scan": scan, "rig": state.standing["rig"]})
        assert said is not None
        found: HubVersion = self._until(lambda: self._after(said.seq or 0), "the submission")
        return found

    def preview(self, version: int) -> None:
        """Asks for the preview of a version."""
        self.say({"kind": "preview", "version": version})

    def arm(self, v: HubVersion) -> HubVersion:
        """Confirms what the preview showed."""
        self.say({"kind": "arm", "version": v.number, "content": v.content, "pattern": v.pattern})
        return self.wait(v, "armed")

    def start(self, v: HubVersion) -> HubVersion:
        """Turns on the light."""
        self.say({"kind": "start", "version": v.number, "pattern": v.pattern})
        return self.wait(v, "projecting")

    def stop(self, why: str = "") -> None:
        """Dark."""
        self.say({"kind": "stop", "why": why})

    def sign(self, v: HubVersion, meaning: str) -> None:
        """Signs a version; confirm the password first."""
        self.say({"kind": "sign", "version": v.number, "content": v.content, "meaning": meaning})

    def point(self, camera: str, pixel: tuple[float, float]) -> None:
        """Points at a place in a photograph: never kept."""
        self._send({"type": "pointer", "camera": camera, "pixel": list(pixel)})

    def ink(self, stroke: str, points: list[list[float]], camera: str | None = None) -> None:
        """A piece of a stroke while it is drawn: never kept."""
        self._send({"type": "ink", "stroke": stroke, "points": points, "camera": camera})

    # --------------------------------------------------------------------------------------------------------- knowing

    @property
    def seq(self) -> int:
        """The number of the last event that came."""
        return self._seq

    @property
    def scan(self) -> str:
        """The scan that the case stands at."""
        return str(self.standing.get("scan", ""))

    def version(self, number: int) -> HubVersion:
        """A version, as it stands. Raises HubError where there is none."""
        for v in self.standing.get("versions", []):
            if v["number"] == number:
                keys = ("number", "phase", "content", "pattern", "dashed", "why")
                return HubVersion(**{k: v[k] for k in keys}, problems=tuple(v["problems"]))
        raise HubError(f"no version {number}")

    def wait(self, version: HubVersion | int, *phases: str, timeout_s: float = 60.0) -> HubVersion:
        """Until a version has come to one of these phases. Raises HubError if it goes elsewhere for good."""
        number = version if isinstance(version, int) else version.number
        over = {"stale", "superseded", "draft"} - set(phases)
        if "projecting" in phases:
            over |= {"stopped"} - set(phases)

        def there() -> HubVersion | None:
            v = self.version(number)
            if v.phase in over:
                raise HubError(f"version {number} is {v.phase}: {v.why}")
            return v if v.phase in phases else None

        found: HubVersion = self._until(there, f"version {number} to be {' or '.join(phases)}", timeout_s)
        return found

    def until(self, true: Callable[[], Any], timeout_s: float = 30.0) -> Any:
        """Until something is true of what came. Raises HubError when the time is over."""
        return self._until(lambda: true() or None, "that", timeout_s)

    def heard(self, kind: str) -> Iterator[Event]:
        """The events of one kind that came so far."""
        return (e for e in list(self.events) if e.kind == kind)

    def _after(self, seq: int) -> HubVersion | None:
        if self._seq < seq or not self.standing.get("versions"):
            return None
        return self.version(len(self.standing["versions"]))

    def _until(self, there: Callable[[], Any], what: str, timeout_s: float = 30.0) -> Any:
        end = time.monotonic() + timeout_s
        with self._news:
            while True:
                found = there()
                if found is not None:
                    return found
                if self.closed:
                    raise HubError(self.closed)
                if not self._news.wait(min(0.5, max(0.0, end - time.monotonic()))) and time.monotonic() > end:
                    last = self.warnings[-1] if self.warnings else ""
                    raise HubError(f"waited {timeout_s:g} s for {what}" + (f"; last warning: {last}" if last else ""))
