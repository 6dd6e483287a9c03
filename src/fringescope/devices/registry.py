"""Devices by URI: `sim://paper/tissue-domed?scale=0.125&seed=1#camera1`, `file:///folder#projector`.

The part before `#` names an instrument, the part after it one of its devices: projector, light, or a camera's name.
"""

from __future__ import annotations

import importlib
import urllib.parse
from dataclasses import dataclass
from typing import Any

from fringescope.devices.base import Device, Station
from fringescope.errors import DeviceError, UsageError

_DRIVERS = {"sim": "fringescope.devices.simulated", "file": "fringescope.devices.replay"}


@dataclass(frozen=True)
class Listed:
    """A device that can be opened."""

    uri: str
    kind: str  #: projector, camera or light
    model: str


def schemes() -> tuple[str, ...]:
    """The first parts of URIs that can be opened."""
    return tuple(_DRIVERS)


def open_station(uri: str) -> Station:
    """All devices of an instrument. Raises UsageError for a URI that names none, and the driver's own errors."""
    scheme = urllib.parse.urlsplit(uri).scheme
    if scheme not in _DRIVERS:
        raise UsageError(
            f"{uri}: unknown kind of device '{scheme}'; there are {', '.join(s + '://' for s in _DRIVERS)}"
        )
    driver: Any = importlib.import_module(_DRIVERS[scheme])
    station: Station = driver.station(driver.parse(uri), uri)
    return station


def open_device(uri: str) -> Device:
    """One device by its full URI. Devices opened one by one share no trigger line: open a station for that.

    Raises UsageError without a fragment, DeviceError where the instrument lacks the device.
    """
    name = urllib.parse.urlsplit(uri).fragment
    if not name:
        raise UsageError(f"{uri}: names no device; add #projector, #light or #camera1")
    devices = _named(open_station(uri))
    if name not in devices:
        raise DeviceError(f"{uri}: no device '{name}'; this instrument has {', '.join(devices)}")
    return devices[name]


def find(uri: str) -> tuple[Listed, ...]:
    """The devices of an instrument, without keeping them open."""
    with open_station(uri) as station:
        out = [Listed(station.projector.info.uri, "projector", station.projector.info.model)]
        out += [Listed(c.info.uri, "camera", c.info.model) for c in station.cameras]
        if station.light is not None:
            out.append(Listed(station.light.info.uri, "light", station.light.info.model))
        return tuple(out)


def _named(station: Station) -> dict[str, Device]:
    out: dict[str, Device] = {"projector": station.projector}
    out |= {urllib.parse.urlsplit(c.info.uri).fragment: c for c in station.cameras}
    if station.light is not None:
        out["light"] = station.light
    return out
