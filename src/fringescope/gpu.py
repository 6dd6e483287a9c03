"""Rows of pictures through a GPU: slabs on their way in, at work and on their way out at the same time.

Knows nothing of what the rows hold: what is launched comes from the caller, and every array is a plain one. Page-locked
staging buffers and their twins on the device are kept between calls. Where Numba simulates CUDA (tests) all of it runs
on the processor, one step after the other.
"""

from __future__ import annotations

import functools
import importlib.util
import itertools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np
from numba import config, cuda

from fringescope.threads import WORKERS, later

SIMULATED = bool(config.ENABLE_CUDASIM)  #: Numba's simulator: no GPU, no speed
SLOTS = 3  #: slabs on the way: one comes in, one is at work, one goes out
SLAB = 64 << 20  #: bytes of a slab, in and out

Array = np.ndarray[Any, np.dtype[Any]]


class Field(NamedTuple):
    """One of the arrays that come out: how many numbers a pixel has (0: one, without an axis), and of which kind."""

    channels: int
    dtype: type


class Slab(NamedTuple):
    """Rows first..last-1 on the device: frames (F, rows, W) in, `out` one array (rows, W[, channels]) a field."""

    first: int
    last: int
    frames: Any
    out: tuple[Any, ...]
    stream: Any


class Times(NamedTuple):
    """Seconds of the steps of a run in which each waited for the one before."""

    stage: float  #: frames into page-locked memory
    upload: float
    kernel: float
    download: float
    collect: float  #: results out of page-locked memory


def missing() -> str:
    """What there is not, of what work on a GPU needs, and what to do; empty if nothing is missing."""
    if SIMULATED:
        return ""
    if importlib.util.find_spec("numba_cuda") is None:
        return "numba-cuda is not installed; pip install 'fringescope[gpu]'"
    if not cuda.is_available():
        return "numba-cuda finds no NVIDIA GPU, driver or CUDA 12 toolkit; see nvidia-smi"
    return ""


def name() -> str:
    """The GPU's name."""
    return "simulator" if SIMULATED else str(cuda.get_current_device().name.decode())


def sent(array: Array) -> Any:
    """A copy of an array on the device, in the form in which kernels take it."""
    return _within(cuda.to_device(np.ascontiguousarray(array)))


def room(shape: tuple[int, ...], dtype: type) -> Any:
    """An array on the device that is yet to be filled, in the form in which kernels take it."""
    return _within(cuda.device_array(shape, dtype))


def wait() -> None:
    """Until the device has done all that it was asked for."""
    cuda.synchronize()


def _within(array: Any) -> Any:
    """What a kernel gets: the simulator's functions are the processor's own, and want its arrays."""
    return np.asarray(array.data) if SIMULATED else array


class _Slot:
    """Buffers for one slab, page-locked and on the device, and its stream; `leaving`: what still copies its results."""

    def __init__(self, frames: int, rows: int, width: int, dtype: Any, fields: Sequence[Field]) -> None:
        self.stream = cuda.stream()
        sizes = [(frames * rows * width, dtype)] + [(max(f.channels, 1) * rows * width, f.dtype) for f in fields]
        self.host = [cuda.pinned_array(n, kind) for n, kind in sizes]
        self.device = [cuda.device_array(n, kind) for n, kind in sizes]
        self.count, self.width, self.fields = frames, width, tuple(fields)
        self.leaving: list[Future[None]] = []
        self.rows = (0, 0)
        self.wanted: tuple[Array | None, ...] = ()

    def stage(self, frames: Sequence[Array], first: int, last: int) -> list[Future[None]]:
        """Start copying rows first..last-1 of all frames into page-locked memory."""
        into = self.host[0][: self.count * (last - first) * self.width].reshape(self.count, last - first, self.width)
        return [later(np.copyto, target, frame[first:last]) for target, frame in zip(into, frames, strict=True)]

    def upload(self, first: int, last: int) -> Slab:
        """The staged rows to the device, without waiting."""
        n = self.count * (last - first) * self.width
        target = self.device[0][:n]
        target.copy_to_device(self.host[0][:n], stream=self.stream)
        shape = (self.count, last - first, self.width)
        out = tuple(_within(self._cut(a, f, first, last)) for a, f in zip(self.device[1:], self.fields, strict=True))
        self.rows = (first, last)
        return Slab(first, last, _within(target.reshape(*shape)), out, self.stream)

    def _cut(self, buffer: Any, field: Field, first: int, last: int) -> Any:
        shape = (last - first, self.width, field.channels)[: 3 if field.channels else 2]
        return buffer[: int(np.prod(shape))].reshape(*shape)

    def download(self, wanted: Sequence[Array | None]) -> None:
        """The results of the fields that are wanted to page-locked memory, without waiting."""
        self.wanted = tuple(wanted)
        for device, host, field, target in zip(self.device[1:], self.host[1:], self.fields, wanted, strict=True):
            if target is not None:
                n = max(field.channels, 1) * (self.rows[1] - self.rows[0]) * self.width
                device[:n].copy_to_host(host[:n], stream=self.stream)

    def collect(self) -> None:
        """Wait for the device and start copying its results to where they are wanted."""
        if not self.wanted:
            return
        self.stream.synchronize()
        first, last = self.rows
        edges = np.linspace(first, last, min(WORKERS, last - first) + 1).astype(int).tolist()
        for host, field, target in zip(self.host[1:], self.fields, self.wanted, strict=True):
            if target is not None:
                source = self._cut(host, field, first, last)
                self.leaving += [
                    later(np.copyto, target[a:b], source[a - first : b - first])
                    for a, b in itertools.pairwise(edges)
                ]
        self.wanted = ()

    def wait(self) -> None:
        """Until its results are where they are wanted."""
        leaving, self.leaving = self.leaving, []
        for task in leaving:
            task.result()


class Slabs:
    """Buffers and streams for pictures of one size: `run` sends a view through them."""

    def __init__(self, frames: int, height: int, width: int, dtype: Any, fields: Sequence[Field], most: int) -> None:
        pixel = frames * np.dtype(dtype).itemsize
        pixel += sum(max(f.channels, 1) * np.dtype(f.dtype).itemsize for f in fields)
        self.rows = max(1, min(height, most // (pixel * width)))
        count = min(SLOTS, -(-height // self.rows))
        self.slots = [_Slot(frames, self.rows, width, dtype, fields) for _ in range(count)]
        self.lock = threading.Lock()

    def run(
        self, frames: Sequence[Array], launch: Callable[[Slab], None], wanted: Sequence[Array | None]
    ) -> None:
        """Rows of all frames, slab by slab, to the device, through `launch`, and back into the arrays that are wanted.

        None in place of an array: that field stays on the device. `launch` must put its kernels on the slab's stream.
        One run at a time; returns once every array is filled.
        """
        height = len(frames[0])
        edges = [*range(0, height, self.rows), height]
        spans = list(itertools.pairwise(edges))
        with self.lock:
            coming = self.slots[0].stage(frames, *spans[0])
            try:
                for n, span in enumerate(spans):
                    slot, then = self.slots[n % len(self.slots)], self.slots[(n + 1) % len(self.slots)]
                    for task in coming:
                        task.result()
                    slot.wait()
                    launch(slot.upload(*span))
                    slot.download(wanted)
                    then.collect()  # its staging buffers are free once its work is done
                    coming = then.stage(frames, *spans[n + 1]) if n + 1 < len(spans) else []
                for slot in self.slots:
                    slot.collect()
            finally:
                for task in coming:
                    task.result()
                for slot in self.slots:
                    slot.wait()

    def timed(
        self, frames: Sequence[Array], launch: Callable[[Slab], None], wanted: Sequence[Array | None],
        clock: Callable[[], float],
    ) -> Times:  # fmt: skip
        """As `run`, but every step waits for the one before; the seconds of each."""
        height, slot, spent = len(frames[0]), self.slots[0], np.zeros(5)
        with self.lock:
            for first in range(0, height, self.rows):
                last = min(first + self.rows, height)
                at = [clock()]
                for task in slot.stage(frames, first, last):
                    task.result()
                at.append(clock())
                slab = slot.upload(first, last)
                slot.stream.synchronize()
                at.append(clock())
                launch(slab)
                slot.stream.synchronize()
                at.append(clock())
                slot.download(wanted)
                slot.stream.synchronize()
                at.append(clock())
                slot.collect()
                slot.wait()
                at.append(clock())
                spent += np.diff(at)
        return Times(*spent.tolist())


@functools.lru_cache(maxsize=2)
def slabs(
    frames: int, height: int, width: int, dtype: str, fields: tuple[Field, ...], most: int
) -> Slabs:
    """Buffers for pictures of this size, made when they are first asked for; those of the last two sizes are kept."""
    return Slabs(frames, height, width, np.dtype(dtype), fields, most)
