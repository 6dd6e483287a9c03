"""The owner of a watchdog, for tests: guards the simulated projector and does what it is told, a line at a time.

With `light` it guards a projector without a world to look at, which is there sooner. Commands: `guard` (starts a guard,
shows a picture, beats), `hush` (stops beating), `hang` (holds the interpreter for a second), `end` (closes the guard),
`quit`. Each is answered by one line of JSON.
"""

from __future__ import annotations

import contextlib
import json
import pickle
import sys
import time
from collections.abc import Callable

import numpy as np

from fringescope.devices.base import LoadedShot, Projector, ProjectorInfo, Running
from fringescope.devices.virtual import VirtualProjector
from fringescope.devices.watchdog import Guard
from fringescope.errors import DeviceLostError, RejectedError
from fringescope.settings import GuardSettings
from fringescope.types import Layout


class Lamp(VirtualProjector):
    """Holds pictures as the simulated projector does, and plays nothing."""

    def _play(self, loaded: LoadedShot) -> Running:
        raise DeviceLostError(f"a shot of {len(loaded.shot.patterns)}; it plays nothing")


class Diary(Guard):
    """A guard that remembers when it beat."""

    def __init__(self, projector: Projector) -> None:
        super().__init__(projector, GuardSettings())
        self.beats: list[int] = []

    def _beat(self) -> None:
        super()._beat()
        self.beats.append(self.beaten_ns)


def hold_the_interpreter(seconds: float) -> None:
    """One call, of at least so long, that lets no other thread run."""
    n, took = 1_000_000, 0.0
    while took < seconds:
        begin = time.monotonic()
        sum(range(n))
        took = time.monotonic() - begin
        n = int(1.5 * n * min(100.0, seconds / took)) if took < seconds else n


def main() -> None:
    if sys.argv[1:] == ["light"]:
        p: Projector = Lamp(ProjectorInfo("lamp://", "lamp", "", 912, 1140, Layout.GRID, 1, 1))
    else:
        from fringescope.devices import registry

        p = registry.open_station("sim://pair/plane?scale=0.02").projector
    picture = np.full((p.info.height, p.info.width), 255, np.uint8)
    guard: Diary | None = None

    def begin() -> dict[str, object]:
        nonlocal guard
        if guard is not None:
            guard.close()
        p.release()
        guard = Diary(p)
        with contextlib.suppress(DeviceLostError, RejectedError):  # on a busy machine
            guard.start()
            guard.lease(2.0)
            p.show(picture)
        return {"watchdog": guard.pid, "button": pickle.dumps(guard.button()).hex(), "shown": p.shown is not None}

    def hush() -> dict[str, object]:
        assert guard is not None
        guard.lease(0.0)
        end = time.monotonic() + 1.0
        while not guard.lost and time.monotonic() < end:
            time.sleep(0.001)
        return state()

    def state() -> dict[str, object]:
        assert guard is not None
        with contextlib.suppress(DeviceLostError):
            guard.lease(2.0)
        cut = p.cut
        at = 0 if cut is None else cut.at_ns
        last = max((b for b in guard.beats if b < at), default=0)
        return {"lost": guard.lost, "shown": p.shown is not None, "cut_ns": at, "beaten_ns": last}

    def end() -> dict[str, object]:
        assert guard is not None
        guard.close()
        return state()

    def hang() -> dict[str, object]:
        hold_the_interpreter(1.0)
        return state()

    commands: dict[str, Callable[[], dict[str, object]]] = {
        "guard": begin,
        "hush": hush,
        "state": state,
        "end": end,
        "hang": hang,
    }
    for line in sys.stdin:
        if line.strip() == "quit":
            break
        print(json.dumps(commands[line.strip()]()), flush=True)
    if guard is not None:
        guard.close()
    p.close()


if __name__ == "__main__":
    main()
