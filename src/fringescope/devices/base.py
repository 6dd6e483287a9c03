"""What a projector, a camera and a light are to the rest of the code, whoever made them.

The public verb checks, the hidden hook (`_load`, `_arm` ..) does the vendor's few lines: a driver subclasses `Camera`,
`Projector` or `Light` and fills the hooks in. Every device is a context manager; `close` and `cancel` may be called
twice and from any thread; errors are those of `errors.py`. Times are microseconds and nanoseconds, as the names say.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from fringescope.devices.killswitch import Cut, KillSwitch, Latch
from fringescope.devices.values import (
    DARK_GAP_US,
    FULL,
    CameraInfo,
    CameraSettings,
    Exposure,
    Frame,
    Held,
    Leds,
    LightInfo,
    LoadedShot,
    PatternRef,
    ProjectorInfo,
    Roi,
    Shot,
    Shutter,
    Trigger,
    TriggerSource,
)
from fringescope.errors import DeviceError, RejectedError
from fringescope.types import U8

__all__ = [
    "DARK_GAP_US",
    "FULL",
    "Acquisition",
    "Camera",
    "CameraInfo",
    "CameraSettings",
    "Cut",
    "Device",
    "Exposure",
    "Frame",
    "Held",
    "KillSwitch",
    "Leds",
    "Light",
    "LightInfo",
    "LoadedShot",
    "PatternRef",
    "Projector",
    "ProjectorInfo",
    "Roi",
    "Running",
    "Shot",
    "Shutter",
    "Station",
    "Trigger",
    "TriggerSource",
]


class Device:
    """Opened on construction, closed once; `with device:` closes it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._closed = False

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    def close(self) -> None:
        """Releases the device. May be called twice, and from any thread."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._close()

    def _close(self) -> None:
        """Hook: what a driver has to release."""

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceError(f"{type(self).__name__} is closed; open it again")

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class Acquisition(ABC):
    """Frames on their way from an armed camera: iterate to get them, in the order in which they arrive.

    Iteration ends after the frames asked for, or after `cancel`. It raises DeviceTimeoutError if a frame does not come
    in time and DeviceLostError if the camera is gone.
    """

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """The frames asked for, one by one."""

    @abstractmethod
    def trigger(self) -> None:
        """Starts one exposure of a camera armed with TriggerSource.SOFTWARE; RejectedError otherwise."""

    @abstractmethod
    def surplus(self, wait_s: float) -> int:
        """How many frames more than asked for arrived, after waiting `wait_s` for another."""

    @abstractmethod
    def cancel(self) -> None:
        """Ends the acquisition; a thread that waits in the iteration gets no more frames. May be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.cancel()


class Camera(Device, ABC):
    """A camera that records on an edge."""

    @property
    @abstractmethod
    def info(self) -> CameraInfo:
        """What it is."""

    @property
    @abstractmethod
    def settings(self) -> CameraSettings:
        """What it is set to."""

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Sets the camera and returns what it really took.

        Raises RejectedError for a pixel format, exposure, gain or region that it does not have.
        """
        self._check_open()
        i = self.info
        if settings.pixel_format not in i.pixel_formats:
            have = ", ".join(f.value for f in i.pixel_formats)
            raise RejectedError(f"{i.uri}: pixel format {settings.pixel_format.value}; it has {have}")
        if not i.min_exposure_us <= settings.exposure_us <= i.max_exposure_us:
            raise RejectedError(
                f"{i.uri}: exposure {settings.exposure_us} us; needed {i.min_exposure_us} to {i.max_exposure_us}"
            )
        if not (math.isfinite(settings.gain) and settings.gain > 0):
            raise RejectedError(f"{i.uri}: gain {settings.gain}; needed a positive number")
        r = settings.roi
        if r is not None and (
            r.left < 0
            or r.top < 0
            or r.width < 1
            or r.height < 1
            or r.left + r.width > i.width
            or r.top + r.height > i.height
        ):
            raise RejectedError(f"{i.uri}: region {tuple(r)}; it does not fit the sensor of {i.width} x {i.height}")
        if r is not None and (r.left % 2 or r.top % 2):
            raise RejectedError(f"{i.uri}: region {tuple(r)}; left and top must be even, or the colour mosaic shifts")
        return self._configure(settings)

    def arm(self, n: int, trigger: Trigger) -> Acquisition:
        """Makes ready for `n` exposures; returns once an edge can be accepted.

        Raises RejectedError if `n` is below 1 or the camera is armed already.
        """
        self._check_open()
        if n < 1:
            raise RejectedError(f"{self.info.uri}: armed for {n} frames; needed at least 1")
        return self._arm(n, trigger)

    @abstractmethod
    def _configure(self, settings: CameraSettings) -> CameraSettings:
        """Hook."""

    @abstractmethod
    def _arm(self, n: int, trigger: Trigger) -> Acquisition:
        """Hook."""


class Running(ABC):
    """A shot on its way."""

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Until the last pattern was shown. Raises DeviceTimeoutError."""

    @abstractmethod
    def cancel(self) -> None:
        """Stops the shot; the projector goes dark. May be called twice, and after the end."""

    @property
    @abstractmethod
    def edges(self) -> tuple[int, ...]:
        """Times in ns, on the projector's clock, of the edges emitted so far."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.cancel()


class Projector(Device, ABC):
    """A projector that plays patterns and emits an edge with each, or holds one picture.

    After a cut through its kill switch it is dark and refuses to show or fire until `release`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: Held | None = None
        self._running: Running | None = None
        self._latch: Latch | None = None

    @property
    @abstractmethod
    def info(self) -> ProjectorInfo:
        """What it is."""

    def load(self, shot: Shot) -> LoadedShot:
        """Checks and uploads a shot; returns the timing that the device will keep.

        Raises RejectedError for pictures of another size or type, too many of them, or too short an exposure.
        """
        self._check_open()
        i = self.info
        for k, p in enumerate(shot.patterns):
            if p.image.shape != (i.height, i.width) or p.image.dtype != np.uint8:
                raise RejectedError(
                    f"{i.uri}: pattern {k} is {p.image.shape} {p.image.dtype}; needed ({i.height}, {i.width}) uint8"
                )
        if len(shot.patterns) > i.max_patterns:
            raise RejectedError(f"{i.uri}: {len(shot.patterns)} patterns; it holds {i.max_patterns}")
        if shot.exposure.duration_us < i.min_exposure_us:
            raise RejectedError(
                f"{i.uri}: exposure {shot.exposure.duration_us} us; needed at least {i.min_exposure_us}"
            )
        return self._load(shot)

    def fire(self, loaded: LoadedShot) -> Running:
        """Plays a loaded shot once, from its first pattern; a picture that was held, or a shot that runs, ends.

        Raises RejectedError if another shot was loaded since, and after a cut.
        """
        self._check_open()
        with self._lock:
            self._check_uncut()
            self.dark()
            self._running = running = self._fire(loaded)
        return running

    def show(self, image: U8, leds: Leds = FULL) -> None:
        """Holds a picture, (height, width) or (height, width, 3) RGB uint8 device pixels, until `dark`, another `show`
        or `fire`; a shot that runs ends.

        Raises RejectedError for a picture of another size or type, colour on a projector without, and after a cut.
        """
        self._check_open()
        i, shape, kind = self.info, getattr(image, "shape", ()), getattr(image, "dtype", type(image).__name__)
        if shape not in ((i.height, i.width), (i.height, i.width, 3)) or kind != np.uint8:
            raise RejectedError(
                f"{i.uri}: a picture of {shape} {kind}; "
                f"needed ({i.height}, {i.width}) or ({i.height}, {i.width}, 3) uint8"
            )
        if len(shape) == 3 and not i.colours:
            raise RejectedError(f"{i.uri}: a coloured picture; it shows grey ones, ({i.height}, {i.width}) uint8")
        own = np.array(image, order="C")
        own.flags.writeable = False
        with self._lock:
            self._check_open()
            self._check_uncut()
            if self._running is not None:
                self.dark()
            self._show(own, leds)
            self._held = Held(own, leds, time.monotonic_ns())

    def dark(self) -> None:
        """Nothing is projected any more within 100 ms; a shot that runs ends. May be called in any state, any number of
        times and from any thread.
        """
        with self._lock:
            self._held = None
            running, self._running = self._running, None
            if running is not None:
                running.cancel()
            if not self._closed:
                self._dark()

    @property
    def held(self) -> Held | None:
        """What is held now, with its lamps; None = dark, or a shot runs."""
        held = self._held
        return None if self.cut is not None else held

    @property
    def shown(self) -> U8 | None:
        """The picture that is held now, read-only; None = dark, or a shot runs."""
        held = self.held
        return None if held is None else held.image

    def kill_switch(self) -> KillSwitch:
        """What turns this projector dark from any process, whatever this one does; it can be sent there."""
        with self._lock:
            self._check_open()
            if self._latch is None:
                self._latch = Latch.create()
            return self._kill_switch(self._latch.path)

    @property
    def cut(self) -> Cut | None:
        """The cut through a kill switch that holds, None while there is none."""
        return None if self._latch is None else self._latch.read(Latch.CUT)

    def release(self) -> None:
        """Lifts a cut. The projector stays dark: what it held before is not shown again."""
        self._check_open()
        with self._lock:
            self.dark()
            if self._latch is not None:
                self._latch.clear()

    def close(self) -> None:
        """Dark, then releases the device. May be called twice, and from any thread."""
        with self._lock:
            try:
                self.dark()
            finally:
                super().close()
                if self._latch is not None:
                    self._latch.mark(Latch.CUT, "the projector was closed")
                    self._latch.remove()

    def _check_uncut(self) -> None:
        latch = self._latch
        if latch is not None and (cut := latch.read(Latch.CUT) or latch.read(Latch.ASKED)) is not None:
            raise RejectedError(f"{self.info.uri}: kept dark ({cut.why}); release() it first")

    @abstractmethod
    def _load(self, shot: Shot) -> LoadedShot:
        """Hook."""

    @abstractmethod
    def _fire(self, loaded: LoadedShot) -> Running:
        """Hook."""

    @abstractmethod
    def _show(self, image: U8, leds: Leds) -> None:
        """Hook: holds a picture that nobody changes any more."""

    @abstractmethod
    def _dark(self) -> None:
        """Hook: no light, within 100 ms."""

    @abstractmethod
    def _kill_switch(self, latch: str) -> KillSwitch:
        """Hook: the switch, on the latch's file, that reaches the device from another process."""


class Light(Device, ABC):
    """A light of variable level, such as the ring light."""

    @property
    @abstractmethod
    def info(self) -> LightInfo:
        """What it is."""

    @property
    @abstractmethod
    def level(self) -> float:
        """Its level, 0..1."""

    def set(self, level: float) -> None:
        """Sets the level, 0 (off) to 1. Raises RejectedError outside."""
        self._check_open()
        if not 0.0 <= level <= 1.0:
            raise RejectedError(f"{self.info.uri}: level {level}; needed 0 to 1")
        self._set(level)

    @abstractmethod
    def _set(self, level: float) -> None:
        """Hook."""


@dataclass(frozen=True, eq=False)
class Station:
    """The opened devices of one instrument, in the order of its rig. `with station:` closes them all."""

    projector: Projector
    cameras: tuple[Camera, ...]
    light: Light | None

    def close(self) -> None:
        """Closes every device."""
        for d in (self.projector, *self.cameras, *([self.light] if self.light else [])):
            d.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.close()
