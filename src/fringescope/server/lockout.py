"""Wrong passwords: how many were tried for a name, from where, and when it is enough.

Counted for each name and address, known or not, so that nothing tells a stranger which names exist, and so that nobody
far away locks the operator out who stands at the instrument. A name that is tried from everywhere is closed to
addresses from which nobody has come in yet. Kept in memory: a hub started anew begins at nought.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict

from fringescope.server.clock import Clock

_MOST = 50_000  #: names and addresses that are kept; the oldest go first
_EVERYWHERE = 10  #: times as many wrong passwords close a name to addresses that nobody has come in from


class Lockout:
    """Tries at passwords. May be used from several threads: a try is counted before it is judged."""

    def __init__(self, clock: Clock, failures: int, locked_s: float) -> None:
        self._clock, self._failures, self._locked_ns = clock, failures, int(locked_s * 1e9)
        self._tries: OrderedDict[str, tuple[int, int]] = OrderedDict()  #: key -> (tries, locked until or begun at)
        self._known: OrderedDict[str, None] = OrderedDict()
        self._lock = threading.Lock()

    def begin(self, name: str, address: str) -> bool:
        """Counts a try; whether it may be judged at all."""
        here, everywhere = _key(name, address), _key(name, "")
        with self._lock:
            free = self._count(here, self._failures)
            if here in self._known:
                return free
            return self._count(everywhere, _EVERYWHERE * self._failures) and free

    def right(self, name: str, address: str) -> None:
        """The try was right: the name begins anew from there, and nobody elsewhere closes it to this address."""
        with self._lock:
            self._tries.pop(_key(name, address), None)
            self._known[_key(name, address)] = None
            while len(self._known) > _MOST:
                self._known.popitem(last=False)

    def forget(self, name: str) -> None:
        """A new password: from anywhere it begins anew."""
        start = _key(name, "")
        with self._lock:
            for key in [k for k in self._tries if k.startswith(start)]:
                del self._tries[key]

    def _count(self, key: str, most: int) -> bool:
        now = self._clock.now_ns()
        tries, since = self._tries.pop(key, (0, now))
        if now - since > self._locked_ns:
            tries, since = 0, now
        if tries >= most:
            self._tries[key] = (tries, since)
            return False
        self._tries[key] = (tries + 1, now)
        while len(self._tries) > _MOST:
            self._tries.popitem(last=False)
        return True


def _key(name: str, address: str) -> str:
    return f"{hashlib.sha256(name.encode()).hexdigest()}@{address}"
