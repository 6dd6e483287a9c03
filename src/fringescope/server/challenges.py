"""Secrets that are good once and not for long: what a passkey must sign, what an identity provider must give back."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Generic, TypeVar

from fringescope.server.clock import Clock

T = TypeVar("T")
_MOST = 10_000  #: that wait at once; the oldest go first


class Challenges(Generic[T]):
    """What was given out and has not come back yet, with what it was for. May be used from several threads."""

    def __init__(self, clock: Clock, good_s: float) -> None:
        self._clock, self._good_ns = clock, int(good_s * 1e9)
        self._waiting: OrderedDict[str, tuple[int, T]] = OrderedDict()
        self._lock = threading.Lock()

    def give(self, secret: str, purpose: T) -> None:
        """A secret that was just made, and what for."""
        with self._lock:
            self._waiting[secret] = (self._clock.now_ns(), purpose)
            while len(self._waiting) > _MOST:
                self._waiting.popitem(last=False)

    def take(self, secret: str) -> T | None:
        """What a secret was for, this once; None where it is unknown, used or too old."""
        with self._lock:
            given_ns, purpose = self._waiting.pop(secret, (0, None))
        return purpose if self._clock.now_ns() - given_ns <= self._good_ns else None
