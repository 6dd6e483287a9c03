"""What a projector, a camera and a light are to the rest of the code, whoever made them.

The public verb checks, the hidden hook (`_load`, `_arm` ..) does the vendor's few lines: a driver subclasses `Camera`,
`Projector` or `Light` and fills the hooks in. Every device is a context manager; `close` and `cancel` may be called
twice and from any thread; errors are those of `errors.py`. Times are microseconds and nanoseconds, as the names say.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from fringescope.errors import DeviceError, RejectedError
from fringescope.types import U8, AnyArray, Layout, PixelFormat

DARK_GAP_US = 230  #: a DLPC350 needs this much dark time after an exposure, or none at all


# ----------------------------------------------------------------------------------------------------------- values


@dataclass(frozen=True)
class Exposure:
    """How long each pattern is lit, and from one pattern's start to the next. Raises RejectedError for an impossible
    pair.
    """

    duration_us: int
    period_us: int

    def __post_init__(self) -> None:
        gap = self.period_us - self.duration_us
        if self.duration_us < 1 or gap < 0 or 0 < gap < DARK_GAP_US:
            raise RejectedError(
                f"exposure {self.duration_us} us in a period of {self.period_us} us; "
                f"needed period = exposure, or at least {DARK_GAP_US} us longer"
            )


@dataclass(frozen=True)
class Leds:
    """Brightness of the projector's red, green and blue lamps, 0..1."""

    red: float = 1.0
    green: float = 1.0
    blue: float = 1.0

    def __post_init__(self) -> None:
        for name, value in (("red", self.red), ("green", self.green), ("blue", self.blue)):
            if not 0.0 <= value <= 1.0:
                raise RejectedError(f"LED {name} {value}; needed 0 to 1")


@dataclass(frozen=True, eq=False)
class PatternRef:
    """One picture to show: (height, width) uint8 in device pixels, and a label for messages and logs."""

    image: U8
    label: str = ""


@dataclass(frozen=True, eq=False)
class Shot:
    """The compiled, checkable unit of work: patterns in order, each shown once for one exposure."""

    patterns: tuple[PatternRef, ...]
    exposure: Exposure
    leds: Leds = field(default_factory=Leds)

    def __post_init__(self) -> None:
        if not self.patterns:
            raise RejectedError("a shot without patterns; needed at least one")


class Shutter(Enum):
    """How a sensor ends its exposure."""

    GLOBAL = "global"
    ROLLING = "rolling"


class Roi(NamedTuple):
    """Part of a sensor, pixels."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class CameraInfo:
    """What a camera is: sensor size in pixels, formats, shutter, and how long the full frame takes to read out."""

    uri: str
    model: str
    serial: str
    width: int
    height: int
    pixel_formats: tuple[PixelFormat, ...]
    shutter: Shutter
    readout_us: int
    min_exposure_us: int = 10
    max_exposure_us: int = 30_000_000
    extra: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def readout_of(self, roi: Roi | None) -> int:
        """Readout time in us of part of the sensor: in proportion to its rows."""
        return self.readout_us if roi is None else math.ceil(self.readout_us * roi.height / self.height)


@dataclass(frozen=True)
class CameraSettings:
    """How a camera shall record: None leaves what the device has."""

    pixel_format: PixelFormat
    exposure_us: int
    gain: float = 1.0  #: linear
    roi: Roi | None = None


class TriggerSource(Enum):
    """What starts an exposure."""

    LINE = "line"  #: a rising edge of the projector
    SOFTWARE = "software"  #: `Acquisition.trigger`


@dataclass(frozen=True)
class Trigger:
    """What starts each exposure, and how long to wait for the frame that follows."""

    source: TriggerSource = TriggerSource.LINE
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.timeout_s) and self.timeout_s > 0):
            raise RejectedError(f"trigger timeout {self.timeout_s} s; needed a positive number")


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame as the device sent it.

    `block_id` counts the device's exposures, contiguous unless something was lost. `device_ns`: start of exposure on
    the device's clock, None where it has none. `host_ns`: arrival. `complete`: False if part of the buffer never came.
    """

    pixels: AnyArray
    pixel_format: PixelFormat
    block_id: int
    device_ns: int | None
    host_ns: int
    complete: bool = True
    chunks: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class ProjectorInfo:
    """What a projector is: device pixels, where they lie on its plane, and its limits."""

    uri: str
    model: str
    serial: str
    width: int
    height: int
    layout: Layout
    min_exposure_us: int
    max_patterns: int
    extra: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class LightInfo:
    """What a light is."""

    uri: str
    model: str


@dataclass(frozen=True, eq=False)
class LoadedShot:
    """A shot that a projector has accepted, with the timing that it will really keep."""

    shot: Shot
    exposure: Exposure
    token: int


# ---------------------------------------------------------------------------------------------------------- devices


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
    """A projector that plays patterns and emits an edge with each."""

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
        """Plays a loaded shot once, from its first pattern. Raises RejectedError if another shot was loaded since."""
        self._check_open()
        return self._fire(loaded)

    @abstractmethod
    def _load(self, shot: Shot) -> LoadedShot:
        """Hook."""

    @abstractmethod
    def _fire(self, loaded: LoadedShot) -> Running:
        """Hook."""


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
