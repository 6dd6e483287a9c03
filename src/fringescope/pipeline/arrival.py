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
from fringescope.pipeline import fast
from fringescope.settings import Settings
from fringescope.threads import WORKERS
from fringescope.types import AnyArray, FrameKey, PixelFormat, Rig, ViewInput

T = TypeVar("T")
AHEAD = 2  #: views whose frames are held at most: that which is worked on, and the next

PATIENCE_S = 6.0  #: for a source to end: a camera waits `capture.timeout_s` for a frame

Arrived = tuple[FrameKey, AnyArray]


def is_here(view: ViewInput) -> bool:
    """Whether all frames of a view lie in memory."""
    return isinstance(view.frames, list | tuple)


def gathered(
    view: ViewInput, rig: Rig, s: Settings, *, by_frame: bool = True
) -> tuple[ViewInput, fast.Begun | None]:
    """A view with its frames in memory, and what was worked out while they came; one that goes the stages' way as it
    is, since they take frames one by one. The frames are taken in a thread of their own. Those of the finest set are
    summed one by one while there is nothing else to do, unless `by_frame` is false; results are the same. Raises
    CaptureError for more frames than the plan has, or one in another's memory, and what the frames raise.
    """
    if is_here(view) or not fast.takes(view):
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
    """A view with its frames in memory."""
    return view if is_here(view) else replace(view, frames=list(view.frames))


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
        if not all(map(is_here, views)):
            self._thread = threading.Thread(target=self._read, name="frames", daemon=True)
            self._thread.start()

    def view(self, n: int) -> ViewInput:
        """View n with its frames as they come, to be iterated once; they raise what their source raises."""
        view = self._views[n]
        if n and not is_here(self._views[n - 1]):
            self._room.release()
        return view if is_here(view) else replace(view, frames=self._come[n])

    def _read(self) -> None:
        for n, view in enumerate(self._views):
            if is_here(view):
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


def check_memory(views: Sequence[ViewInput], rig: Rig) -> None:
    """Raise ResourceError if the machine has too little memory left for a scan of these views."""
    free = memory.available()
    if free is None or not views:
        return
    lenses = [rig.camera(v.plan.camera).lens for v in views]
    pixels = [lens.width * lens.height for lens in lenses]
    frames = [0 if is_here(v) else n * _bytes_of(v) for n, v in zip(pixels, views, strict=True)]
    need = max(n * VIEW_BYTES for n in pixels) + sum(sorted(frames)[-AHEAD:]) + sum(pixels) * (KEPT_BYTES + CLOUD_BYTES)
    if need > free:
        raise ResourceError(
            f"{len(views)} views, {sum(pixels) / 1e6:.1f} megapixels in all, need about {need / 1e9:.1f} GB of memory; "
            f"{free / 1e9:.1f} GB are free: close other programs, or scan fewer views or smaller pictures at a time"
        )
