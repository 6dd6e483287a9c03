"""What goes to devices and comes from them: timing, lamps, settings, frames, and what each kind says of itself.

Users import these from `devices.base`. Times are microseconds and nanoseconds, as the names say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Any, NamedTuple

from fringescope.errors import RejectedError
from fringescope.types import U8, AnyArray, Layout, PixelFormat

DARK_GAP_US = 230  #: a DLPC350 needs this much dark time after an exposure, or none at all


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


FULL = Leds()  #: all lamps fully on


@dataclass(frozen=True, eq=False)
class PatternRef:
    """One picture to show: (height, width) uint8 in device pixels, and a label for messages and logs."""

    image: U8
    label: str = ""


@dataclass(frozen=True, eq=False)
class Held:
    """What a projector holds: (height, width) or (height, width, 3) uint8, read-only, and the lamps that light it."""

    image: U8
    leds: Leds
    at_ns: int = 0  #: since when, `time.monotonic_ns`


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
    """What a projector is: device pixels, where they lie on its plane, its limits, and whether it shows colours."""

    uri: str
    model: str
    serial: str
    width: int
    height: int
    layout: Layout
    min_exposure_us: int
    max_patterns: int
    colours: bool = False  #: holds (height, width, 3) RGB pictures too
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
