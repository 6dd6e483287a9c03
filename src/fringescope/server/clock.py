"""The hub's clock: the wall's time when it started, then never back and never a leap, whatever happens to the wall."""

from __future__ import annotations

import threading
import time


class Clock:
    """Nanoseconds since 1970 that only grow. `after` is a time that everything to come lies behind."""

    def __init__(self, after: int = 0) -> None:
        self._wall, self._mono = max(time.time_ns(), after + 1), time.monotonic_ns()
        self._last, self._lock = after, threading.Lock()

    def now_ns(self) -> int:
        """A time later than every one before."""
        with self._lock:
            self._last = max(self._last + 1, self._wall + time.monotonic_ns() - self._mono)
            return self._last
