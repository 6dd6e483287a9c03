"""A process that does nothing but turn the projector dark, and its owner's side of it.

`python -m fringescope.devices.watchdog` holds a kill switch. It cuts when no beat came for the deadline (the owner
hangs, is frozen, or its loop forgot), when the pipe from its owner closes (the owner is gone, however it went), and
when a stop button is pressed in any process. It sends signs of life back: an owner that misses them makes dark itself.

    with Guard(projector) as guard:      # ready before anything is shown
        projector.show(picture)
        while ...:
            guard.beat()                 # raises DeviceLostError once the projector was made dark

Pipes and a shared page are all that it needs: no socket, no fork of a process with threads.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import importlib
import json
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

from fringescope.devices.killswitch import KillSwitch
from fringescope.errors import DeviceLostError, RejectedError, UsageError
from fringescope.settings import GuardSettings

if TYPE_CHECKING:
    from fringescope.devices.base import Projector

_BEAT = struct.Struct("<q")  #: what the owner says: when it said so, `time.monotonic_ns`; 0 = it is over
_READY, _ALIVE, _CUT = b"r", b".", b"c"  #: what the watchdog says
_MS = 1_000_000
_LOOK_AGAIN_S = 0.002  #: for whoever was kept from the processor: the sign may lie in the pipe


# ------------------------------------------------------------------------------------------------------ the stop button


@dataclass(frozen=True)
class StopButton:
    """Stops the projector from any process and thread; a frozen value that can be sent there."""

    switch: KillSwitch
    patience_ms: float

    def press(self, why: str = "STOP") -> None:
        """Asks the watchdog, and cuts by its own switch if that did not. Dark when it returns."""
        with contextlib.suppress(FileNotFoundError):  # closed is dark
            self.switch.ask(why)
            end = time.monotonic_ns() + self.patience_ms * _MS
            while self.switch.state is None and time.monotonic_ns() < end:
                time.sleep(0.001)
            if self.switch.state is None:
                self.switch.cut(why)


# ----------------------------------------------------------------------------------------------------- the owner's side


class Guard:
    """The owner's side of a watchdog: start it, beat, and hear when the projector was made dark.

    Once lost it stays lost: `release` the projector and start another. May be used from several threads. Raises
    UsageError for a deadline of less than two beats.
    """

    def __init__(self, projector: Projector, settings: GuardSettings | None = None) -> None:
        self._projector, self._s = projector, settings or GuardSettings()
        if self._s.deadline_ms < 2 * self._s.beat_ms:
            raise UsageError(
                f"guard: a beat every {self._s.beat_ms:g} ms and a deadline of {self._s.deadline_ms:g} ms; "
                "needed a deadline of two beats at least"
            )
        self._switch: KillSwitch | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._lost, self._over, self._ready = "", threading.Event(), threading.Event()
        self._heard_ns = self._sent_ns = self._lease_ns = 0

    @property
    def lost(self) -> str:
        """Why the projector was made dark; "" while it is guarded."""
        if not self._lost and self._ready.is_set() and not self._over.is_set() and (cut := self._projector.cut):
            return cut.why  # the thread that hears of it has not run yet
        return self._lost

    @property
    def beaten_ns(self) -> int:
        """When the last beat was sent, `time.monotonic_ns`."""
        return self._sent_ns

    @property
    def pid(self) -> int:
        """The watchdog's process."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Starts the watchdog and returns once it is ready.

        Raises RejectedError if a picture is held already or the projector is kept dark, and DeviceLostError if the
        watchdog does not get ready.
        """
        if self._process is not None:
            raise RejectedError("this guard was started before; make another")
        p = self._projector
        if p.shown is not None:
            raise RejectedError(f"{p.info.uri}: it holds a picture that nobody guards; make it dark first")
        if p.cut is not None:
            raise RejectedError(f"{p.info.uri}: kept dark ({p.cut.why}); release() it first")
        self._switch = p.kill_switch()
        self._switch.open()
        try:
            self._process = _launch()
        except OSError as e:
            raise DeviceLostError(f"{p.info.uri}: no watchdog, and nothing is shown without one: {e}") from e
        try:
            order = {"switch": described(self._switch), "beat_ms": self._s.beat_ms, "deadline_ms": self._s.deadline_ms}
            self._send(json.dumps(order).encode() + b"\n")
        except OSError:
            pass  # it has ended already, and says why
        self._threads = [
            threading.Thread(target=self._hear, args=(self._process.stdout,), name="guard hears", daemon=True)
        ]
        self._threads[0].start()
        if not self._ready.wait(self._s.start_s) or self._lost:
            self._end()
            why = self._lost or f"it was not ready in {self._s.start_s:g} s"
            raise DeviceLostError(f"{p.info.uri}: no watchdog, and nothing is shown without one: {why}")
        self._heard_ns = time.monotonic_ns()
        self.beat()
        self._threads.append(threading.Thread(target=self._mind, name="guard minds", daemon=True))
        self._threads[1].start()

    def beat(self) -> None:
        """A sign of life; the next is due in `beat_ms`. Raises DeviceLostError once the projector was made dark."""
        if not self.lost:
            self._beat()
        if self.lost:
            raise DeviceLostError(
                f"{self._projector.info.uri}: made dark: {self.lost}; release() it and start another guard"
            )

    def lease(self, seconds: float) -> None:
        """Beats, and goes on beating from a thread for so long: for a caller who is about to wait, or to compute.

        If the caller is not back by then, the projector goes dark. Raises RejectedError for more than `lease_s`, and
        DeviceLostError as `beat`.
        """
        if not 0 <= seconds <= self._s.lease_s:
            raise RejectedError(f"a lease of {seconds} s; needed 0 to {self._s.lease_s:g} (guard.lease_s)")
        self._lease_ns = time.monotonic_ns() + int(seconds * 1e9)
        self.beat()

    def button(self) -> StopButton:
        """A stop button for any process."""
        return StopButton(self._projector.kill_switch(), 0.6 * self._s.deadline_ms)

    def close(self) -> None:
        """Makes the projector dark and sends the watchdog home. May be called twice."""
        try:
            self._projector.dark()
        finally:
            self._end()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    # ---------------------------------------------------------------------------------------------------------- inside

    def _send(self, data: bytes) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        with self._lock:
            if not self._process.stdin.closed:
                os.write(self._process.stdin.fileno(), data)

    def _beat(self) -> None:
        now = time.monotonic_ns()
        try:
            self._send(_BEAT.pack(now))
        except OSError:
            self._trip("the watchdog has ended")
        else:
            self._sent_ns = now

    def _hear(self, pipe: IO[bytes]) -> None:
        """Reads the watchdog's signs until it ends."""
        while data := os.read(pipe.fileno(), 4096):
            self._heard_ns = time.monotonic_ns()
            if _READY in data:
                self._ready.set()
            if _CUT in data:
                self._trip("the watchdog has cut")
        if not self._over.is_set():
            self._trip("the watchdog has ended")
        self._ready.set()

    def _mind(self) -> None:
        """Beats while a lease runs, and looks whether the watchdog answers."""
        step = 0.25e-3 * self._s.beat_ms
        while not self._over.wait(step) and not self._lost:
            now = time.monotonic_ns()
            if now < self._lease_ns and now - self._sent_ns > 0.5 * self._s.beat_ms * _MS:
                self._beat()
            if self._silent(now):
                time.sleep(_LOOK_AGAIN_S)
                if self._silent(time.monotonic_ns()):
                    self._trip("the watchdog does not answer")

    def _silent(self, now: int) -> bool:
        return now - self._heard_ns > self._s.deadline_ms * _MS

    def _trip(self, why: str) -> None:
        """Lost: whatever the watchdog did, the switch is cut and the projector dark."""
        with contextlib.suppress(OSError):
            if self._switch is not None:
                if self._ready.is_set():
                    self._switch.cut(why)
                state = self._switch.state
                why = why if state is None else state.why
        self._lost = self._lost or why
        self._projector.dark()

    def _end(self) -> None:
        self._over.set()
        p = self._process
        if p is None or p.stdin is None or p.stdout is None or p.stderr is None:
            return
        with contextlib.suppress(OSError):
            self._send(_BEAT.pack(0))
        with self._lock, contextlib.suppress(OSError):
            p.stdin.close()
        try:
            p.wait(1.0)
        except subprocess.TimeoutExpired:
            p.kill()
            p.wait()
        for t in self._threads:
            if t is not threading.current_thread():
                t.join()
        if not p.stderr.closed:
            last = p.stderr.read().decode(errors="replace").strip().splitlines()
            if last and not self._switched():
                self._lost = last[-1]
            p.stderr.close()
        p.stdout.close()

    def _switched(self) -> bool:
        with contextlib.suppress(OSError):
            return self._switch is not None and self._switch.state is not None
        return True


def _launch() -> subprocess.Popen[bytes]:
    """The watchdog's process: another Python, which shares three pipes with this one, and finds what this one finds."""
    # Ctrl-C is for the owner. A session of its own would do, too; but Linux schedules sessions as groups, and one that
    # has just started and mostly sleeps was seen to wait for seconds on a busy machine.
    how: dict[str, Any] = {"process_group": 0}
    if sys.platform == "win32":
        how = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.HIGH_PRIORITY_CLASS}
    path = os.pathsep.join(p or os.getcwd() for p in sys.path)  # noqa: PTH109
    env = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    pipe = subprocess.PIPE
    command = [sys.executable, "-m", "fringescope.devices.watchdog"]
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, env=env, bufsize=0, **how)


def described(switch: KillSwitch) -> dict[str, Any]:
    """A kill switch as plain values, for another process: `rebuilt` makes it there."""
    kind = type(switch)
    values = {f.name: getattr(switch, f.name) for f in dataclasses.fields(switch) if f.init}
    return {"module": kind.__module__, "name": kind.__qualname__, "values": values}


def rebuilt(plain: dict[str, Any]) -> KillSwitch:
    """The kill switch that `described` was given in another process of ours. Only for what comes from there."""
    kind: Any = importlib.import_module(plain["module"])
    for part in plain["name"].split("."):
        kind = getattr(kind, part)
    if not (isinstance(kind, type) and issubclass(kind, KillSwitch)):
        raise UsageError(f"{plain['name']} is no kill switch")
    switch: KillSwitch = kind(**plain["values"])
    return switch


# -------------------------------------------------------------------------------------------------------- the process


class _Pipe:
    """What came through the owner's pipe. A beat counts from when it was sent, however late it is read."""

    def __init__(self, number: int) -> None:
        self.beat_ns, self.gone, self.quit = 0, False, False  #: no beat yet: nothing is shown yet
        self._number, self._rest = number, b""
        self._news = threading.Event()
        if sys.platform == "win32":  # where nobody can wait for a pipe and for time at once
            threading.Thread(target=self._follow, daemon=True).start()

    def wait(self, seconds: float) -> None:
        """Until there is news, but no longer than that."""
        if self.gone or self.quit:
            time.sleep(seconds)
        elif sys.platform == "win32":
            self._news.wait(seconds)
            self._news.clear()
        elif select.select([self._number], [], [], seconds)[0]:
            self._take()

    def _follow(self) -> None:
        while not self.gone:
            self._take()
            self._news.set()

    def _take(self) -> None:
        data = _read(self._number)
        self.gone = not data
        data = self._rest + data
        whole = len(data) - len(data) % _BEAT.size
        for (sent,) in _BEAT.iter_unpack(data[:whole]):
            self.quit |= sent == 0
            self.beat_ns = max(self.beat_ns, min(sent, time.monotonic_ns()))
        self._rest = data[whole:]


def _read(number: int) -> bytes:
    try:
        return os.read(number, 4096)
    except OSError:
        return b""


def watch(switch: KillSwitch, pipe: _Pipe, out: int, beat_ms: float, deadline_ms: float) -> str:
    """Waits until there is a reason to cut, cuts, and returns it; "" if the owner said that it is over.

    `out`: where signs of life go, every `beat_ms`.
    """
    told = 0
    while not (why := _reason(switch, pipe, deadline_ms)):
        if pipe.quit:
            return ""
        now = time.monotonic_ns()
        if now - told >= 0.75 * beat_ms * _MS:
            with contextlib.suppress(OSError):  # nobody hears: then the other pipe has closed, too
                os.write(out, _ALIVE)
            told = now
        pipe.wait(0.25e-3 * beat_ms)
    while True:
        try:
            switch.cut(why)
            return why
        except OSError:  # no way to the device just now
            time.sleep(_LOOK_AGAIN_S)


def _reason(switch: KillSwitch, pipe: _Pipe, deadline_ms: float) -> str:
    asked = switch.asked
    if asked is not None:
        return asked.why
    if pipe.gone and not pipe.quit:
        return "the watchdog's owner is gone"
    if pipe.quit or not pipe.beat_ns or time.monotonic_ns() - pipe.beat_ns <= deadline_ms * _MS:
        return ""
    pipe.wait(0.0 if sys.platform != "win32" else _LOOK_AGAIN_S)  # kept from the processor, perhaps, and not the owner
    silent_ms = (time.monotonic_ns() - pipe.beat_ns) / _MS
    return f"no heartbeat for {silent_ms:.0f} ms" if silent_ms > deadline_ms and not pipe.quit else ""


def _ahead_of_others() -> None:
    """Before other processes, where the system lets us."""
    if sys.platform == "win32":
        return  # its owner has asked for that
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        return
    with contextlib.suppress(OSError):
        os.nice(-10)


def _order(number: int) -> dict[str, Any]:
    """The first line of the pipe, byte by byte: what follows it are beats."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(number, 1)
        if not byte:
            raise DeviceLostError("the owner ended before it said what to watch")
        line += byte
    order: dict[str, Any] = json.loads(line)
    return order


def main() -> int:
    """The process: 0 if its owner sent it home, 3 after a cut."""
    for name in ("SIGINT", "SIGHUP", "SIGTERM"):  # it ends when its owner does
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    order = _order(0)
    switch = rebuilt(order["switch"])
    switch.open()
    _ahead_of_others()
    gc.freeze()
    gc.disable()
    pipe = _Pipe(0)
    os.write(1, _READY)
    why = watch(switch, pipe, 1, order["beat_ms"], order["deadline_ms"])
    if why:
        with contextlib.suppress(OSError):
            os.write(1, _CUT)
    while not (pipe.gone or pipe.quit):  # to tidy up after an owner who cannot
        pipe.wait(1.0)
    if not pipe.quit:
        switch.clean()
    return 3 if why else 0


if __name__ == "__main__":
    sys.exit(main())
