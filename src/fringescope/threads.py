"""Loops over rows on all cores: compiled once as a plain loop (quick to compile), run on blocks of rows by threads."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from fringescope.jit import njit

WORKERS = max(1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 64))
BLOCKS = 8 * WORKERS  #: more blocks than workers, so that none waits long for another
SMALL = 8  #: fewer rows than this run in one piece,
LITTLE = 1 << 16  #: and arrays of fewer elements: other threads would only be waited for
BLOCK = 1 << 15  #: elements that are worth a block of their own


@functools.cache
def _pool(_process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(WORKERS, thread_name_prefix="rows")


def _share(work: Callable[..., None], bands: list[tuple[int, int]], args: tuple[Any, ...] = ()) -> None:
    """Call `work(first, last, *args)` for all bands; this thread takes the next one, and so does each worker that is
    free. The first error is raised when nobody works any longer.
    """
    left = iter(bands)
    taken = threading.Lock()

    def some() -> None:
        while True:
            with taken:
                band = next(left, None)
            if band is None:
                return
            work(*band, *args)

    helpers = [_pool(os.getpid()).submit(some) for _ in range(min(WORKERS, len(bands)) - 1)]
    try:
        some()
    finally:
        busy = [h for h in helpers if not h.cancel()]  # who has not begun by now finds nothing to do
        wait(busy)
    for h in busy:
        h.result()


class OverRows:
    """A kernel that `by_rows` has decorated."""

    def __init__(self, compiled: Any, count: Callable[..., int | tuple[int, int]]) -> None:
        self.rows = compiled  #: the compiled kernel itself
        self._count = count

    def __call__(self, *args: Any) -> None:
        """Work on all rows, on all cores."""
        n, size = self._counted(args)
        self._run(0, n, size, args)

    def among(self, begin: int, end: int, *args: Any) -> None:
        """Work on some of the rows alone."""
        n, size = self._counted(args)
        self._run(begin, end, size * (end - begin) // max(n, 1), args)

    def _counted(self, args: tuple[Any, ...]) -> tuple[int, int]:
        told = self._count(*args)
        return told if isinstance(told, tuple) else (told, max(getattr(a, "size", 0) for a in args))

    def _run(self, begin: int, end: int, size: int, args: tuple[Any, ...]) -> None:
        n = end - begin
        if n < SMALL or WORKERS == 1 or size < LITTLE:
            self.rows(begin, end, *args)
            return
        blocks = max(min(BLOCKS, n, size // BLOCK), WORKERS)
        _share(self.rows, [(begin + n * b // blocks, begin + n * (b + 1) // blocks) for b in range(blocks)], args)


def by_rows(count: Callable[..., int | tuple[int, int]]) -> Callable[[Callable[..., None]], OverRows]:
    """Decorate a kernel `f(first, last, *args)` that works on rows first..last-1 and writes nothing outside them.

    The decorated kernel is called as `f(*args)`; `count(*args)` tells the number of rows, and how many elements it
    works on where those are not all of its largest array. It is compiled by Numba without the interpreter's lock.
    """

    def decorate(f: Callable[..., None]) -> OverRows:
        kernel = OverRows(njit(cache=True, nogil=True, error_model="numpy")(f), count)
        functools.update_wrapper(kernel, f)
        return kernel

    return decorate


def later(work: Callable[..., None], *args: Any) -> Future[None]:
    """Start `work(*args)` on some core."""
    return _pool(os.getpid()).submit(work, *args)


def in_bands(height: int, rows: int, work: Callable[[int, int], None]) -> None:
    """Call `work(first, last)` for bands of `rows` rows of `height`, on all cores; the first error is raised."""
    _share(work, [(row, min(row + rows, height)) for row in range(0, height, rows)])
