"""The switch that turns a projector dark from any process, and the latch in which processes see that it did.

A latch is one page of memory that processes share by way of a little file. Two marks lie in it: somebody asks for the
dark (`ask`), and it is dark (`cut`). A cut stays until the projector's owner lifts it (`Projector.release`).
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import tempfile
import time
import weakref
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import NamedTuple

_SIZE = 4096
_LONGEST = 200  #: bytes of a reason
_MARK = struct.Struct(f"<BxxxxxxxqH{_LONGEST}s")  #: set, time, length and text of the reason


class Cut(NamedTuple):
    """When (`time.monotonic_ns`, the same clock in all processes of a machine) and why a projector went dark."""

    at_ns: int
    why: str


class Latch:
    """The shared page: marks that any process sets, and only `clear` takes back. Raises OSError if its file is gone."""

    CUT, ASKED = 0, 1024  #: where the marks lie

    def __init__(self, path: str) -> None:
        self.path = path
        with Path(path).open("r+b") as f:
            self._page = mmap.mmap(f.fileno(), _SIZE)

    @classmethod
    def create(cls) -> Latch:
        """A new one, in a file of its own that only this user may open: in memory where there is such a place, since
        writing to a page of a busy disk may have to wait.
        """
        memory = Path("/dev/shm")
        folder = str(memory) if memory.is_dir() and os.access(memory, os.W_OK) else None
        number, path = tempfile.mkstemp(prefix="fringescope-latch-", dir=folder)
        try:
            os.write(number, bytes(_SIZE))
        finally:
            os.close(number)
        made = cls(path)
        weakref.finalize(made, _unlink, path)  # where nobody calls `remove`
        return made

    def mark(self, where: int, why: str) -> None:
        """Sets a mark; the first reason stays."""
        if not self._page[where]:
            text = why.encode()[:_LONGEST]
            entry = _MARK.pack(0, time.monotonic_ns(), len(text), text)
            self._page[where + 1 : where + len(entry)] = entry[1:]
            self._page[where] = 1  # after the rest, in one byte: who sees it sees the rest
            self._page[where + 8 : where + 16] = struct.pack("<q", time.monotonic_ns())  # it holds from here, or before

    def read(self, where: int) -> Cut | None:
        """A mark, None while it is not set."""
        if not self._page[where]:
            return None
        _, at, length, text = _MARK.unpack_from(self._page, where)
        return Cut(at, text[:length].decode(errors="replace"))

    def clear(self) -> None:
        """Takes both marks back."""
        self._page[self.ASKED] = 0
        self._page[self.CUT] = 0

    def remove(self) -> None:
        """Removes the file; whoever has opened it can go on reading."""
        _unlink(self.path)


def _unlink(path: str) -> None:
    with contextlib.suppress(OSError):  # Windows keeps a file that somebody has open
        Path(path).unlink(missing_ok=True)


@dataclass(frozen=True)
class KillSwitch:
    """Turns one projector dark from any process, without its owner's help, and for good until the owner releases it.

    A frozen value of plain fields, so that it can be sent to another process. A driver subclasses it with what its
    hook `_cut` needs to reach the device; the simulated lamp burns through the latch, and needs no more.
    """

    path: str  #: file of the latch
    _latch: Latch | None = field(default=None, init=False, repr=False, compare=False)

    def open(self) -> None:
        """Makes ready, so that `cut` has nothing left to fail on. Raises OSError if the projector was closed."""
        self._opened()
        self._open()

    def cut(self, why: str = "") -> None:
        """Dark, and latched. May be called twice. A projector that was closed is dark already."""
        try:
            latch = self._opened()
        except FileNotFoundError:
            return
        latch.mark(Latch.ASKED, why or "cut by its kill switch")  # the owner shows nothing new from here on
        self._cut()
        latch.mark(Latch.CUT, why or "cut by its kill switch")

    def ask(self, why: str = "") -> None:
        """Asks whoever watches over the projector to cut it; its owner shows nothing new."""
        with contextlib.suppress(FileNotFoundError):
            self._opened().mark(Latch.ASKED, why or "STOP")

    @property
    def state(self) -> Cut | None:
        """The cut that holds, None while there is none. Raises OSError if the projector was closed."""
        return self._opened().read(Latch.CUT)

    @property
    def asked(self) -> Cut | None:
        """The request for a cut, None while there is none. Raises OSError if the projector was closed."""
        return self._opened().read(Latch.ASKED)

    def clean(self) -> None:
        """Removes the latch's file where the owner cannot any more."""
        self._opened().remove()

    def _opened(self) -> Latch:
        if self._latch is None:
            object.__setattr__(self, "_latch", Latch(self.path))
        assert self._latch is not None
        return self._latch

    def __getstate__(self) -> dict[str, object]:
        return {f.name: getattr(self, f.name) if f.init else None for f in fields(self)}

    def _open(self) -> None:
        """Hook: opens the way to the device."""

    def _cut(self) -> None:
        """Hook: makes the device itself dark. Called in any process, perhaps while its owner hangs."""
