"""Large arrays that are used again: a page that was never touched costs more than all the work on its pixels.

`empty` gives an array of memory that an earlier array has left, where there is some. The memory comes back when the
array and all views of it are gone; nobody has to give it back.
"""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

SMALL = 1 << 20  #: bytes below which the system's allocator is as good
STEP = 1 << 21  #: sizes are rounded up to so many bytes, a huge page
WASTE = 1.25  #: a block is not used for less than its size over this
MOST_KEPT = 3 << 30  #: bytes that may lie idle; a quarter of the machine's memory where that is less

_idle: list[NDArray[np.uint8]] = []
_lock = threading.RLock()  # a collector may run `_Loan.__del__` within `_take`


class _Loan:
    """A block in use. numpy arrays made of it hold it; when the last one goes, the block comes back."""

    def __init__(self, block: NDArray[np.uint8], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.block = block
        self.__array_interface__ = {
            "shape": shape,
            "typestr": dtype.str,
            "data": (block.ctypes.data, False),
            "version": 3,
        }

    def __del__(self) -> None:
        with _lock:
            _idle.append(self.block)
            held = sum(one.nbytes for one in _idle)
            while held > KEPT:
                held -= _idle.pop(0).nbytes


def empty(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """As `numpy.empty`, from memory that was in use before, if there is a block of about the size."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    if size < SMALL:
        return np.empty(shape, kind)
    return np.asarray(_Loan(_take(-(-size // STEP) * STEP), shape, kind))


def _take(size: int) -> NDArray[np.uint8]:
    with _lock:
        fitting = [n for n, one in enumerate(_idle) if size <= one.nbytes <= WASTE * size]
        if fitting:
            return _idle.pop(min(fitting, key=lambda n: _idle[n].nbytes))
    return np.empty(size, np.uint8)


def release() -> None:
    """Give all idle memory back to the system."""
    with _lock:
        _idle.clear()


def available() -> int | None:
    """Bytes that can be had without driving anything out of memory, idle blocks of ours included; None: unknown."""
    free = _told("MemAvailable")
    if free is None:
        return None
    with _lock:
        return free + sum(one.nbytes for one in _idle)


def _told(what: str) -> int | None:
    """Bytes, as the system tells them; None where it does not."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
        return int(lines[what].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None


def _kept() -> int:
    total = _told("MemTotal")
    return MOST_KEPT if total is None else min(MOST_KEPT, total // 4)


KEPT = _kept()  #: bytes that lie idle at most
