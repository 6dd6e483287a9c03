"""Loops over rows on all cores: compiled once as a plain loop (quick to compile), run on blocks of rows by threads."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from numba import njit

WORKERS = max(1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 64))
BLOCKS = 8 * WORKERS  #: more blocks than workers, so that none waits long for another
SMALL = 8  #: fewer rows than this run in one piece,
LITTLE = 1 << 16  #: and arrays of fewer elements: other threads would only be waited for


@functools.cache
def _pool(_process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(WORKERS, thread_name_prefix="rows")


def by_rows(count: Callable[..., int]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a kernel `f(first, last, *args)` that works on rows first..last-1 and writes nothing outside them.

    The decorated kernel is called as `f(*args)`; `count(*args)` tells the number of rows. It is compiled by Numba
    without the interpreter's lock. `f.rows` is the compiled kernel itself.
    """

    def decorate(f: Callable[..., None]) -> Callable[..., None]:
        compiled: Any = njit(cache=True, nogil=True, error_model="numpy")(f)

        @functools.wraps(f)
        def call(*args: Any) -> None:
            n = count(*args)
            if n < SMALL or WORKERS == 1 or max(getattr(a, "size", 0) for a in args) < LITTLE:
                compiled(0, n, *args)
                return
            edges = [n * b // BLOCKS for b in range(BLOCKS + 1)]
            tasks = [
                _pool(os.getpid()).submit(compiled, a, b, *args)
                for a, b in itertools.pairwise(edges)
                if b > a
            ]
            for task in tasks:
                task.result()

        call.rows = compiled  # type: ignore[attr-defined]
        return call

    return decorate


def later(work: Callable[..., None], *args: Any) -> Future[None]:
    """Start `work(*args)` on some core."""
    return _pool(os.getpid()).submit(work, *args)


def in_bands(height: int, rows: int, work: Callable[[int, int], None]) -> None:
    """Call `work(first, last)` for bands of `rows` rows of `height`, on all cores; the first error is raised."""
    bands = [(row, min(row + rows, height)) for row in range(0, height, rows)]
    if len(bands) == 1 or WORKERS == 1:
        for first, last in bands:
            work(first, last)
        return
    for task in [_pool(os.getpid()).submit(work, first, last) for first, last in bands]:
        task.result()
