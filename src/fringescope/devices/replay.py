"""A stored capture poses as the instrument that recorded it: `file:///folder#camera1`, `#projector`, `#light`.

The projector accepts any shot; with each edge, every armed camera gives the next frame of its own view, in the
order of the capture's plan. While the light is on, it gives the ring-light picture instead. A picture may be shown, but
not photographed.
"""

from __future__ import annotations

import threading
import time
import urllib.parse
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from fringescope import store
from fringescope.devices import base, virtual
from fringescope.errors import DeviceError, RejectedError
from fringescope.types import AnyArray


class _Edge(NamedTuple):
    at_ns: int
    lit: bool


class Recording:
    """What replayed devices share: the capture, its trigger line, a clock, and the level of the light."""

    def __init__(self, folder: Path | str) -> None:
        self.capture = store.read_capture(folder)
        self.line: virtual.TriggerLine[_Edge] = virtual.TriggerLine()
        self.ring = 0.0
        self.projector: base.Projector | None = None
        self._clock = 0
        self._lock = threading.Lock()

    def edge(self, period_us: int) -> int:
        """One edge: every armed camera exposes. Returns its time, ns."""
        with self._lock:
            at = self._clock
            self._clock += period_us * 1000
            self.line.rise(_Edge(at, self.ring > 0))
            return at


class ReplayProjector(virtual.VirtualProjector):
    """Plays nothing, but emits the edges, and holds any picture."""

    def __init__(self, recording: Recording, uri: str) -> None:
        c = recording.capture
        w, h = c.projector_width, c.projector_height
        super().__init__(base.ProjectorInfo(uri, "stored capture", "", w, h, c.layout, 1, 65536, True))
        self._recording = recording
        recording.projector = self

    def _play(self, loaded: base.LoadedShot) -> base.Running:
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


class ReplayCamera(virtual.VirtualCamera[_Edge]):
    """A camera that sends what was recorded."""

    def __init__(self, recording: Recording, name: str, uri: str) -> None:
        self.view = recording.capture.view(name)
        w, h = self.view.size
        fmt = self.view.plan.pixel_format
        info = base.CameraInfo(uri, "stored capture", name, w, h, (fmt,), base.Shutter.GLOBAL, 1)
        super().__init__(info, base.CameraSettings(fmt, 16000), recording.line)
        self._recording = recording

    def _configure(self, settings: base.CameraSettings) -> base.CameraSettings:
        if settings.roi is not None or settings.gain != 1.0:
            raise RejectedError(
                f"{self._info.uri}: a stored capture has neither region nor gain; leave both as they are"
            )
        return super()._configure(settings)

    def _acquire(self, n: int, trigger: base.Trigger) -> virtual.VirtualAcquisition[_Edge]:
        return _ReplayAcquisition(self, self._recording, n, trigger)

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


class _ReplayAcquisition(virtual.VirtualAcquisition[_Edge]):
    def __init__(self, camera: ReplayCamera, recording: Recording, n: int, trigger: base.Trigger) -> None:
        super().__init__(camera, recording.line, n, trigger)
        self._source, self._recording = camera, recording

    def _own_edge(self) -> _Edge:
        p = self._recording.projector
        if p is not None and p.shown is not None:
            raise RejectedError(
                f"{self._source.info.uri}: a stored capture cannot photograph a new picture; make the projector dark"
            )
        return _Edge(time.monotonic_ns(), self._recording.ring > 0)

    def _frame(self, edge: _Edge, number: int, block: int) -> base.Frame:
        pixels = self._source.picture(number, edge.lit)
        return base.Frame(pixels, self._source.settings.pixel_format, block, edge.at_ns, time.monotonic_ns())


class ReplayLight(virtual.VirtualLight):
    """Chooses between fringe frames (off) and the ring-light picture (on)."""

    def __init__(self, recording: Recording, uri: str) -> None:
        super().__init__(recording, base.LightInfo(uri, "stored capture"))


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
