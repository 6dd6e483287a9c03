"""The closed loop: show the guidance, photograph it, find its lines, and say how far they are from the asked ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fringescope import capture, fuse, guide, report
from fringescope.devices.base import Camera, Station
from fringescope.errors import DeviceError
from fringescope.settings import Settings
from fringescope.types import U8, Guidance, Landing, Rig


@dataclass(frozen=True, eq=False)
class Closed:
    """What the closed loop found: per stroke where it landed; and the pictures that it took."""

    landings: tuple[Landing, ...]
    shots: tuple[guide.Shots, ...]

    @property
    def worst_um(self) -> float | None:
        """The largest p95 of all strokes, um; None where no line was found."""
        return max((x.p95_um for x in self.landings if x.p95_um is not None), default=None)


def close_loop(guidance: Guidance, tissue: guide.Tissue, station: Station, settings: Settings | None = None) -> Closed:
    """Shows the guidance on an instrument, and measures where it lands. The projector is dark afterwards.

    Raises what devices raise, and DeviceError where the instrument lacks a camera of the scan or shows other pictures.
    """
    s = settings or Settings()
    check_device(guidance, tissue.rig, station)
    cameras = cameras_of(station, tissue.rig, [g.camera for g in tissue.grids])
    formats = [c.settings.pixel_format for c in cameras]
    image = guidance.image
    i = station.projector.info
    if not i.colours or bool((np.ptp(image, axis=2) == 0).all()):
        image = np.asarray(image.max(axis=2))  # grey
    taken = []
    try:
        for picture in (None, np.full((i.height, i.width), 255, np.uint8), image):
            if picture is None:
                station.projector.dark()
            else:
                station.projector.show(picture)
            taken.append(capture.look(cameras, None, formats, replace(s.capture, exposure_us=s.loop.exposure_us)))
    finally:
        station.projector.dark()
    shots = tuple(
        guide.Shots(g.camera, f, *frames) for g, f, *frames in zip(tissue.grids, formats, *taken, strict=True)
    )
    return Closed(guide.landings(guidance, shots, tissue, s.loop), shots)


def check_device(guidance: Guidance, rig: Rig, station: Station) -> None:
    """Raises DeviceError where an instrument's projector is not that of the rig: its mirrors are others."""
    i, ours = station.projector.info, rig.projector.layout
    if guidance.image.shape[:2] != (i.height, i.width):
        h, w = guidance.image.shape[:2]
        raise DeviceError(f"{i.uri} shows {i.width} x {i.height}; the guidance is for {w} x {h}: use the rig's device")
    if i.layout is not ours:
        has, needed = i.layout.value, ours.value
        raise DeviceError(f"{i.uri} has the layout {has}; the guidance is for {needed}: use the rig's device")


def cameras_of(station: Station, rig: Rig, names: Sequence[str]) -> list[Camera]:
    """The cameras of a station by the rig's names, whose order they have. Raises DeviceError if there are fewer."""
    order = [c.name for c in rig.cameras]
    if len(station.cameras) < len(order):
        raise DeviceError(f"the instrument has {len(station.cameras)} cameras; the rig has {', '.join(order)}")
    return [station.cameras[order.index(n)] for n in names]


def landing_pictures(closed: Closed, rig: Rig, s: Settings) -> dict[str, U8]:
    """Where the lines were found, over what each camera saw: (h, w, 3) RGB by the camera's name."""
    out = {}
    for shot in closed.shots:
        white, guided = (fuse.photo(f, shot.pixel_format, shot.camera, s.fuse).rgb for f in (shot.white, shot.guided))
        index = rig.index(shot.camera)
        out[shot.camera] = report.landing_picture(0.4 * white + guided, rig.cameras[index], index, closed.landings)
    return out
