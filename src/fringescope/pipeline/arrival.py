"""Frames on their way: views whose frames are read, or still recorded, while others are worked on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from time import perf_counter
from types import TracebackType
from typing import Self, TypeVar

from fringescope import memory
from fringescope.errors import CaptureError, ResourceError
from fringescope.pipeline import fast, tiling
from fringescope.pipeline.tiling import ByRows
from fringescope.settings import Settings
from fringescope.threads import WORKERS
from fringescope.types import AnyArray, FrameKey, PixelFormat, Rig, RowFrames, ViewInput

T = TypeVar("T")
AHEAD = 2  #: views whose frames are held at most: that which is worked on, and the next

PATIENCE_S = 6.0  #: for a source to end: a camera waits `capture.timeout_s` for a frame

Arrived = tuple[FrameKey, AnyArray]


def is_here(view: ViewInput) -> bool:
    """Whether all frames of a view lie in memory."""
    return isinstance(view.frames, list | tuple)


def is_ready(view: ViewInput) -> bool:
    """Whether nobody has to take the frames of a view as they come: they lie in memory, or stay where they are."""
    return is_here(view) or isinstance(view.frames, ByRows)


def gathered(
    view: ViewInput, rig: Rig, s: Settings, *, by_frame: bool = True
) -> tuple[ViewInput, fast.Begun | None]:
    """A view with its frames in memory, and what was worked out while they came; one that goes the stages' way as it
    is, since they take frames one by one. The frames are taken in a thread of their own. Those of the finest set are
    summed one by one while there is nothing else to do, unless `by_frame` is false; results are the same. Raises
    CaptureError for more frames than the plan has, or one in another's memory, and what the frames raise.
    """
    if is_ready(view) or not fast.takes(view):
        return view, None
    if not isinstance(view.frames, Arriving):
        with Reader([view]) as reader:
            return gathered(reader.view(0), rig, s, by_frame=by_frame)
    beginning, most = fast.Beginning(view, rig, s), len(view.plan.keys)
    for key, frame in view.frames:
        beginning.add(key, frame, view.frames.room_s if by_frame else 0.0)
        if len(beginning.frames) > most:
            raise CaptureError(
                f"view '{view.plan.camera}': more than the plan's {most} frames came; needed each once: one came "
                "twice, or the camera runs on"
            )
    return replace(view, frames=beginning.frames), beginning.begun


def held(view: ViewInput) -> ViewInput:
    """A view with its frames in memory, unless they are not to be."""
    return view if is_ready(view) else replace(view, frames=list(view.frames))


LITTLE = 1_000_000  #: pixels of pictures that leave cores idle


@contextmanager
def each(
    work: Callable[[ViewInput], T], views: Sequence[ViewInput], rig: Rig, *, at_once: bool
) -> Iterator[Iterator[T]]:
    """What `work` gives for each view, in their order; `at_once`: little pictures whose frames can be had at any time
    are worked on all together.
    """
    sizes = [rig.camera(v.plan.camera).lens for v in views]
    if at_once and all(L.width * L.height <= LITTLE for L in sizes) and all(isinstance(v.frames, Sized) for v in views):
        with ThreadPoolExecutor(WORKERS) as pool:
            yield pool.map(work, views)
    else:
        with Reader(views) as reader:
            yield (work(reader.view(n)) for n in range(len(views)))


class Arriving:
    """The frames of a view as they come, to be iterated once; they raise what their source raises."""

    def __init__(self) -> None:
        self._come: queue.SimpleQueue[Arrived | BaseException | None] = queue.SimpleQueue()
        self._last, self._between = perf_counter(), 0.0  # when one came, and after how long

    @property
    def room_s(self) -> float:
        """Seconds between the last two frames, as a guess at the next; 0 if others have come that were not taken."""
        return self._between if self._come.empty() else 0.0

    def put(self, one: Arrived | BaseException | None) -> None:
        """A frame has come, or an error; None: all have."""
        now = perf_counter()
        self._between, self._last = now - self._last, now
        self._come.put(one)

    def __iter__(self) -> Iterator[Arrived]:
        while (one := self._come.get()) is not None:
            if isinstance(one, BaseException):
                raise one
            yield one


class Reader:
    """Takes the frames of views, one view after the other, in a thread of its own, so that whoever yields them need not
    wait for those who work on them. `with reader:`, and `view` for each in its order: when one is asked for, the next
    is begun to be read. At the end of the `with` the source that is being read is closed, if it can be.
    """

    def __init__(self, views: Sequence[ViewInput]) -> None:
        self._views = views
        self._come = [Arriving() for _ in views]
        self._room = threading.Semaphore(AHEAD)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if not all(map(is_ready, views)):
            self._thread = threading.Thread(target=self._read, name="frames", daemon=True)
            self._thread.start()

    def view(self, n: int) -> ViewInput:
        """View n with its frames as they come, to be iterated once; they raise what their source raises."""
        view = self._views[n]
        if n and not is_ready(self._views[n - 1]):
            self._room.release()
        return view if is_ready(view) else replace(view, frames=self._come[n])

    def _read(self) -> None:
        for n, view in enumerate(self._views):
            if is_ready(view):
                continue
            self._room.acquire()
            try:
                self._pass_on(view, self._come[n].put)
            except BaseException as e:  # raised again where the frames are taken
                self._come[n].put(e)
                return
            if self._stop.is_set():
                return
            self._come[n].put(None)

    def _pass_on(self, view: ViewInput, put: Callable[[Arrived], None]) -> None:
        source = iter(view.frames)
        try:
            for one in islice(source, len(view.plan.keys) + 1):  # one too many tells that there are too many
                if self._stop.is_set():
                    return
                put(one)
        finally:
            close = getattr(source, "close", None)
            if close is not None:
                close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self._stop.set()
        for _ in self._views:
            self._room.release()
        if self._thread is not None:
            self._thread.join(PATIENCE_S)  # a source that waits for a frame without end is left to itself


def _bytes_of(view: ViewInput) -> int:
    """Bytes of all frames, a pixel."""
    fmt = view.plan.pixel_format
    return len(view.plan.keys) * fmt.dtype.itemsize * (3 if fmt is PixelFormat.RGB8 else 1)


VIEW_BYTES, KEPT_BYTES, CLOUD_BYTES = 45, 31, 20  #: a pixel: while its view is scanned, kept of it, of the cloud
SLACK = 16 << 20  #: bytes: what the blocks of `memory` are larger than their arrays
ONE_FRAME = 3  #: times its bytes: while a frame is read, its file and what is made of it


def fitted(
    views: Sequence[ViewInput], rig: Rig, budget: int | None = None, *, alone: bool = False, device: str = "cpu"
) -> tuple[ViewInput, ...]:
    """The views as they fit into memory for a scan: as they are, or `ByRows` where their frames may stay on a disk.

    `budget`: bytes that may be used; what the machine has left, if None. `alone`: one view, for its grid. Raises
    ResourceError, with the figures, if it is too little for what has to be in memory.
    """
    free = memory.available() if budget is None else budget
    if free is None or not views:
        return tuple(views)
    lenses = [rig.camera(v.plan.camera).lens for v in views]
    pixels = [lens.width * lens.height for lens in lenses]
    frames = [0 if is_here(v) else n * _bytes_of(v) for n, v in zip(pixels, views, strict=True)]
    least = max(n * VIEW_BYTES for n in pixels) + (0 if alone else sum(pixels) * (KEPT_BYTES + CLOUD_BYTES))
    need = least + sum(sorted(frames)[-AHEAD:])
    if need <= free:
        return tuple(views)
    tiled = [device == "cpu" and isinstance(v.frames, RowFrames) and fast.takes(v) for v in views]
    least += sum(sorted(0 if t else size for t, size in zip(tiled, frames, strict=True))[-AHEAD:])
    one = max(n * ONE_FRAME * v.plan.pixel_format.dtype.itemsize for n, v in zip(pixels, views, strict=True))
    row = [lens.width * _bytes_of(v) for lens, v in zip(lenses, views, strict=True)]
    how = ""
    if any(tiled):
        least += SLACK
        by_rows = least + max(one, tiling.LEAST * max(r for t, r in zip(tiled, row, strict=True) if t))
        how, need = (", a few rows of their frames at a time", by_rows) if by_rows < need else ("", need)
    if need > free:
        count = "1 view" if len(views) == 1 else f"{len(views)} views"
        raise ResourceError(
            f"{count}, {sum(pixels) / 1e6:.1f} megapixels in all, need about {need / 1e9:.1f} GB of memory{how}; "
            f"{free / 1e9:.1f} GB are free: close other programs, or scan fewer views or smaller pictures at a time"
        )
    return tuple(
        replace(v, frames=ByRows(v.frames, int(free - least) // r)) if t and isinstance(v.frames, RowFrames) else v
        for v, t, r in zip(views, tiled, row, strict=True)
    )
