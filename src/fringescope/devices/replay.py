"""A stored capture poses as the instrument that recorded it: `file:///folder#camera1`, `#projector`, `#light`.

The projector accepts any shot; with each edge, every armed camera gives the next frame of its own view, in the
order of the capture's plan. While the light is on, it gives the ring-light picture instead.
"""

from __future__ import annotations

import itertools
import queue
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fringescope import store
from fringescope.devices import base
from fringescope.errors import DeviceError, DeviceTimeoutError, RejectedError
from fringescope.types import AnyArray


class Recording:
    """What replayed devices share: the capture, its trigger line, a clock, and whether the light is on."""

    def __init__(self, folder: Path | str) -> None:
        self.capture = store.read_capture(folder)
        self.level = 0.0
        self._clock = 0
        self._armed: dict[str, _ReplayAcquisition] = {}
        self._lock = threading.RLock()

    def attach(self, acquisition: _ReplayAcquisition) -> None:
        """Connects an armed camera. Raises RejectedError if it is armed already."""
        with self._lock:
            if acquisition.name in self._armed:
                raise RejectedError(f"{acquisition.name} is armed already; cancel that acquisition first")
            self._armed[acquisition.name] = acquisition

    def detach(self, acquisition: _ReplayAcquisition) -> None:
        """Takes an acquisition off the line."""
        with self._lock:
            if self._armed.get(acquisition.name) is acquisition:
                del self._armed[acquisition.name]

    def edge(self, period_us: int) -> int:
        """One edge: every armed camera exposes. Returns its time, ns."""
        with self._lock:
            at = self._clock
            self._clock += period_us * 1000
            for a in list(self._armed.values()):
                a.edge(at, self.level > 0)
            return at


class ReplayProjector(base.Projector):
    """Plays nothing, but emits the edges."""

    def __init__(self, recording: Recording, uri: str) -> None:
        super().__init__()
        c = recording.capture
        self._recording, self._loaded, self._tokens = recording, -1, itertools.count()
        self._info = base.ProjectorInfo(
            uri, "stored capture", "", c.projector_width, c.projector_height, c.layout, 1, 65536
        )

    @property
    def info(self) -> base.ProjectorInfo:
        """What it is."""
        return self._info

    def _load(self, shot: base.Shot) -> base.LoadedShot:
        self._loaded = next(self._tokens)
        return base.LoadedShot(shot, shot.exposure, self._loaded)

    def _fire(self, loaded: base.LoadedShot) -> base.Running:
        if loaded.token != self._loaded:
            raise RejectedError(f"{self._info.uri}: this shot is no longer loaded; load it again")
        return _ReplayRunning(self._recording, loaded)


class _ReplayRunning(base.Running):
    def __init__(self, recording: Recording, loaded: base.LoadedShot) -> None:
        self._edges = tuple(recording.edge(loaded.exposure.period_us) for _ in loaded.shot.patterns)

    def wait(self, timeout_s: float) -> None:
        """See `base.Running`. It is over at once."""

    def cancel(self) -> None:
        """See `base.Running`."""

    @property
    def edges(self) -> tuple[int, ...]:
        """See `base.Running`."""
        return self._edges


class ReplayCamera(base.Camera):
    """A camera that sends what was recorded."""

    def __init__(self, recording: Recording, name: str, uri: str) -> None:
        super().__init__()
        self._recording, self.name = recording, name
        self.view = recording.capture.view(name)
        w, h = self.view.size
        fmt = self.view.plan.pixel_format
        self._info = base.CameraInfo(uri, "stored capture", name, w, h, (fmt,), base.Shutter.GLOBAL, 1)
        self._settings = base.CameraSettings(fmt, 16000)
        self._acquisition: _ReplayAcquisition | None = None
        self._block = 0

    @property
    def info(self) -> base.CameraInfo:
        """What it is."""
        return self._info

    @property
    def settings(self) -> base.CameraSettings:
        """What it is set to."""
        return self._settings

    def _configure(self, settings: base.CameraSettings) -> base.CameraSettings:
        if settings.roi is not None or settings.gain != 1.0:
            raise RejectedError(
                f"{self._info.uri}: a stored capture has neither region nor gain; leave both as they are"
            )
        self._settings = settings
        return settings

    def _arm(self, n: int, trigger: base.Trigger) -> base.Acquisition:
        self._acquisition = _ReplayAcquisition(self, self._recording, n, trigger)
        self._recording.attach(self._acquisition)
        return self._acquisition

    def next_block(self) -> int:
        """Number of the exposure that begins now."""
        with self._lock:
            self._block += 1
            return self._block

    def picture(self, number: int, lit: bool) -> AnyArray:
        """Stored frame `number` of the view, or the ring-light picture. Raises DeviceError where there is none."""
        keys = self.view.plan.keys
        if lit:
            if self.view.color is None:
                raise DeviceError(f"{self._info.uri}: the capture has no ring-light picture of this camera")
            return self._recording.capture.images.frame(self.view.color, self.view.plan.pixel_format, self.view.size)
        if number >= len(keys):
            raise DeviceError(f"{self._info.uri}: frame {number + 1} asked for; the capture holds {len(keys)}")
        return store.Frames(self._recording.capture, self.view)[keys[number]]

    def _close(self) -> None:
        if self._acquisition is not None:
            self._acquisition.cancel()


class _ReplayAcquisition(base.Acquisition):
    def __init__(self, camera: ReplayCamera, recording: Recording, n: int, trigger: base.Trigger) -> None:
        self._camera, self._recording, self._n, self._trigger = camera, recording, n, trigger
        self._queue: queue.SimpleQueue[tuple[int, int, int, bool] | None] = queue.SimpleQueue()
        self._seen, self._taken, self._cancelled = itertools.count(), 0, threading.Event()

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._camera.name

    def edge(self, at_ns: int, lit: bool) -> None:
        """The line rose."""
        if not self._cancelled.is_set():
            self._queue.put((next(self._seen), at_ns, self._camera.next_block(), lit))

    def trigger(self) -> None:
        """See `base.Acquisition`."""
        if self._trigger.source is not base.TriggerSource.SOFTWARE:
            raise RejectedError(
                f"{self._camera.info.uri}: armed for the line; a software trigger needs TriggerSource.SOFTWARE"
            )
        self.edge(time.monotonic_ns(), self._recording.level > 0)

    def __iter__(self) -> Iterator[base.Frame]:
        while self._taken < self._n and not self._cancelled.is_set():
            try:
                item = self._queue.get(timeout=self._trigger.timeout_s)
            except queue.Empty:
                raise DeviceTimeoutError(
                    f"{self._camera.info.uri}: no frame {self._taken + 1} of {self._n} in {self._trigger.timeout_s} s"
                ) from None
            if item is None:
                return
            number, at, block, lit = item
            self._taken += 1
            pixels = self._camera.picture(number, lit)
            yield base.Frame(pixels, self._camera.settings.pixel_format, block, at, time.monotonic_ns())

    def surplus(self, wait_s: float) -> int:
        """See `base.Acquisition`. Nothing is on its way: `wait_s` need not pass."""
        del wait_s
        n = 0
        while not self._queue.empty():
            n += self._queue.get_nowait() is not None
        return n

    def cancel(self) -> None:
        """See `base.Acquisition`."""
        if not self._cancelled.is_set():
            self._cancelled.set()
            self._recording.detach(self)
            self._queue.put(None)


class ReplayLight(base.Light):
    """Chooses between fringe frames (off) and the ring-light picture (on)."""

    def __init__(self, recording: Recording, uri: str) -> None:
        super().__init__()
        self._recording, self._info = recording, base.LightInfo(uri, "stored capture")

    @property
    def info(self) -> base.LightInfo:
        """What it is."""
        return self._info

    @property
    def level(self) -> float:
        """Its level, 0..1."""
        return self._recording.level

    def _set(self, level: float) -> None:
        self._recording.level = float(level)

    def _close(self) -> None:
        self._recording.level = 0.0


@dataclass(frozen=True, eq=False)
class ReplayStation(base.Station):
    """All devices of a stored capture."""

    recording: Recording


def folder_of(uri: str) -> Path:
    """The folder that `file:///folder` names."""
    return Path(urllib.request.url2pathname(urllib.parse.urlsplit(uri).path))


def parse(uri: str) -> Recording:
    """The capture of `file:///folder`; a fragment is ignored. Raises FormatError and CaptureError as
    `store.read_capture`.
    """
    return Recording(folder_of(uri))


def station(recording: Recording, uri: str) -> ReplayStation:
    """All devices of a stored capture; the light only where every view has its ring-light picture."""
    stem = uri.split("#")[0]
    views = recording.capture.views
    light = ReplayLight(recording, f"{stem}#light") if all(v.color for v in views) else None
    cameras = tuple(ReplayCamera(recording, v.camera, f"{stem}#{v.camera}") for v in views)
    return ReplayStation(ReplayProjector(recording, f"{stem}#projector"), cameras, light, recording)
