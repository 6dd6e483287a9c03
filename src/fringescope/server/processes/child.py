"""The child's side: `python -m fringescope.server.processes.child MODULE` answers calls, a line of JSON each.

MODULE has a class Hand: its `calls` are carried out one by one, its `urgent` ones at once, whatever is being done, and
those `aside`, if it has any, one by one beside the others: nothing waits for them. What goes wrong comes back as a
line. When the pipe closes, the child ends.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

from fringescope.errors import FringescopeError

STOPPED = "stopped meanwhile: nothing is projected"  #: what a call says that was overtaken by a stop
_LOCK = threading.Lock()
_CANCELLED: set[int] = set()


class CancelledError(FringescopeError):
    """Somebody does not want the work any more."""


class Call:
    """One call that is being carried out."""

    def __init__(self, number: int, out: int) -> None:
        self.number, self._out = number, out

    def progress(self, stage: str, share: float) -> None:
        """Tells how far it is. Raises CancelledError once it was cancelled."""
        self.check()
        write(self._out, {"id": self.number, "progress": [stage, round(float(share), 4)]})

    def check(self) -> None:
        """Raises CancelledError once it was cancelled."""
        if self.number in _CANCELLED:
            raise CancelledError("cancelled")


def write(out: int, message: dict[str, Any]) -> None:
    """A line for the parent; nothing happens if that has ended."""
    data = json.dumps(message, allow_nan=False).encode() + b"\n"
    with _LOCK, contextlib.suppress(OSError):
        while data:
            data = data[os.write(out, data) :]


def carry_out(message: dict[str, Any], calls: dict[str, Callable[..., Any]], out: int) -> None:
    """One call, and its answer."""
    number = message["id"]
    try:
        result = calls[message["call"]](Call(number, out), **message["args"])
        write(out, {"id": number, "result": result})
    except FringescopeError as e:
        write(out, {"id": number, "error": str(e), "kind": type(e).__name__})
    except MemoryError:
        write(out, {"id": number, "error": "out of memory; close other programs", "kind": "ResourceError"})
    except Exception as e:
        traceback.print_exc()
        write(out, {"id": number, "error": f"{type(e).__name__}: {e}: this is a bug; report it", "kind": "bug"})
    finally:
        _CANCELLED.discard(number)


def main(name: str) -> None:
    """Answers until the pipe closes."""
    gc.set_threshold(20_000)
    sys.setswitchinterval(1e-3)  # who beats must not wait long for who computes
    out = os.dup(1)
    os.dup2(2, 1)  # whatever else prints does so beside the answers
    module: Any = importlib.import_module(name)
    hand = module.Hand(lambda event: write(out, {"event": event}))
    waiting: queue.Queue[dict[str, Any] | None] = queue.Queue()
    beside: queue.Queue[dict[str, Any]] = queue.Queue()
    aside: dict[str, Callable[..., Any]] = getattr(hand, "aside", {})

    def carry_out_aside() -> None:
        while True:
            carry_out(beside.get(), aside, out)

    def read() -> None:
        for line in sys.stdin.buffer:
            message = json.loads(line)
            if "cancel" in message:
                _CANCELLED.add(message["cancel"])
            elif message["call"] in hand.urgent:
                carry_out(message, hand.urgent, out)
            elif message["call"] in aside:
                beside.put(message)
            else:
                waiting.put(message)
        hand.ended()
        waiting.put(None)
        os._exit(0)  # also out of the middle of a computation: nobody waits for it

    threading.Thread(target=read, name="calls", daemon=True).start()
    if aside:
        threading.Thread(target=carry_out_aside, name="aside", daemon=True).start()
    write(out, {"ready": True})
    while (message := waiting.get()) is not None:
        carry_out(message, hand.calls, out)


if __name__ == "__main__":
    main(sys.argv[1])
