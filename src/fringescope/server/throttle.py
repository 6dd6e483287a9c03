"""How often somebody may ask: buckets that fill at a steady rate."""

from __future__ import annotations

import threading
import time

_MOST = 20_000  #: buckets that are kept; the fullest go first


class Bucket:
    """Lets `burst` through at once, and `rate` a second after that."""

    def __init__(self, rate: float, burst: float) -> None:
        self.rate, self.burst = rate, burst
        self._level, self._at = burst, time.monotonic()

    def take(self, n: float = 1) -> bool:
        """Whether there is room for `n` more; they are counted if so. More than `burst` at once need a full bucket,
        and are waited for afterwards.
        """
        now = time.monotonic()
        self._level = min(self.burst, self._level + self.rate * (now - self._at))
        self._at = now
        if self._level < min(n, self.burst):
            return False
        self._level -= n
        return True

    def wait_s(self, n: float = 1) -> float:
        """How long until there is room for `n` more."""
        return max(0.0, (min(n, self.burst) - self._level) / self.rate)

    @property
    def full(self) -> bool:
        """Whether nobody has asked for long."""
        return self._level + self.rate * (time.monotonic() - self._at) >= self.burst


class Throttle:
    """A bucket for each key, as an address. May be used from several threads."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._buckets: dict[str, Bucket] = {}
        self._lock, self._swept = threading.Lock(), 0.0

    def take(self, key: str, n: int = 1) -> float:
        """0 if `key` may go on with `n` more, else how many seconds it should wait."""
        with self._lock:
            if len(self._buckets) > _MOST and time.monotonic() - self._swept > 1:
                self._buckets = {k: b for k, b in self._buckets.items() if not b.full}
                self._swept = time.monotonic()
            bucket = self._buckets.setdefault(key, Bucket(self._rate, self._burst))
            return 0.0 if bucket.take(n) else max(1.0, bucket.wait_s(n))
