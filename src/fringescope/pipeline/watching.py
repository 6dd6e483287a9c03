"""Is the specimen still where it was scanned? Pictures, and on demand one set of fringes, through the devices.

The ring light's picture is taken with a trigger by software while the projector shows what it shows: guidance need not
go dark for it, its pixels are masked. The fringes interrupt what is shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fringescope import capture, geometry, patterns, phase, response
from fringescope import watch as stage
from fringescope.devices.base import Camera, Light, Station
from fringescope.errors import CaptureError
from fringescope.settings import CaptureSettings, Settings
from fringescope.types import (
    Bool,
    Decoded,
    FringeSet,
    Grid,
    NoiseModel,
    Picture,
    PixelFormat,
    Response,
    Rig,
    Standing,
    ViewInput,
    ViewPlan,
    Watched,
)
from fringescope.types.capture import ROUNDING

STEPS = 3  #: frames of the set that measures again: the fewest that tell phase, background and modulation
STEPS_OF_A_PICTURE = 6  #: where the background is the picture: in that of 3 frames, what shines keeps its fringes
BACKGROUND_NOISE = 0.25  #: of the variance of one sample that is left in a background of 8 and one of 3 frames, about


def live_pictures(
    cameras: Sequence[Camera], light: Light, formats: Sequence[PixelFormat], settings: CaptureSettings | None = None
) -> tuple[Picture, ...]:
    """One picture of each camera under the ring light, whatever the projector shows meanwhile: see `capture.look`."""
    frames = capture.look(cameras, light, formats, settings)
    return tuple(
        Picture(c.info.serial, phase.unpacked(x, f), f) for c, f, x in zip(cameras, formats, frames, strict=True)
    )


def remeasured(
    station: Station, rig: Rig, camera: Camera, plan: ViewPlan, noise: NoiseModel, s: Settings,
    freed_by: Response | None = None,
) -> Decoded:  # fmt: skip
    """One camera's short set of fringes, projected and measured: wrapped phase, background and modulation.

    Raises IncompleteShotError and what devices raise.
    """
    shown = patterns.images(plan, rig.projector, s.patterns)
    frames = list(capture.stream(station.projector, camera, shown, plan, s.capture))
    view = ViewInput(plan, frames, noise=noise, response=freed_by)
    return response.corrected(phase.measure(view.frames, plan, s.phase, noise), freed_by)


def watch(
    station: Station,
    grids: Sequence[Grid],
    pictures: Sequence[Picture],
    rig: Rig,
    settings: Settings | None = None,
    *,
    noise: Mapping[str, NoiseModel] | None = None,
    masks: Mapping[str, Bool] | None = None,
    gradients: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    freed_by: Response | None = None,
) -> Watched:
    """Looks once and compares with a scan's grids and pictures; the worse verdict counts.

    By camera name: `noise` of one raw sample, `masks` (H, W) where guidance is projected, `gradients` of the scan's
    fringes, in cycles per projector-plane unit: with them the surface is measured again too. They are needed where the
    scan's pictures were lit by the projector: the same light then makes the live ones. A camera of the scan that the
    station lacks, or that gives no picture, makes the verdict SUSPECT. Raises CaptureError for grids without pictures,
    a scan under ring light where there is none now, gradients that are missing; and what devices raise.
    """
    s = settings or Settings()
    _check(station, grids, pictures, gradients)
    by_name = {c.info.serial: c for c in station.cameras}
    here = [(g, p, by_name[g.camera]) for g, p in zip(grids, pictures, strict=True) if g.camera in by_name]
    ring = [(p, c) for _, p, c in here if p.light == "ring"]
    now: dict[str, Picture] = {}
    if ring:
        assert station.light is not None
        taken = live_pictures([c for _, c in ring], station.light, [p.pixel_format for p, _ in ring], s.capture)
        now = {p.camera: x for (p, _), x in zip(ring, taken, strict=True)}
    again: dict[str, Decoded] = {}
    for g, p, c in here if gradients is not None else ():
        model = (noise or {}).get(g.camera) or _usual(p.pixel_format)
        steps = STEPS if p.light == "ring" else STEPS_OF_A_PICTURE
        plan = _plan(g, p.pixel_format, gradients or {}, rig, steps)
        again[g.camera] = one = remeasured(station, rig, c, plan, model, s, freed_by)
        if p.light == "projector":
            codes = np.clip(np.rint(np.nan_to_num(one.sets[0].background)), 0, p.pixel_format.max_value)
            now[g.camera] = Picture(g.camera, codes.astype(p.pixel_format.dtype), p.pixel_format, "projector")
    views = [
        stage.View(g, p, now.get(g.camera), (masks or {}).get(g.camera), _noise_of(p, (noise or {}).get(g.camera)))
        for g, p in zip(grids, pictures, strict=True)
    ]
    by_picture = stage.compare(views, rig, s.watch)
    if gradients is None:
        return by_picture
    fringes = [
        stage.Remeasured(
            g, again[g.camera].sets[0] if g.camera in again else None,
            s.denoise.min_modulation / 255 * p.pixel_format.full_scale,
        )
        for g, p in zip(grids, pictures, strict=True)
    ]  # fmt: skip
    return worse(by_picture, stage.compare_fringes(fringes, rig, s.watch))


def worse(picture: Watched, fringes: Watched) -> Watched:
    """Of two verdicts the worse, the picture's where they are equal but the words of both where both are VALID."""
    order = list(Standing)
    if order.index(fringes.verdict) > order.index(picture.verdict):
        return replace(fringes, motion=picture.motion)
    if picture.verdict is Standing.VALID:
        return replace(picture, why=f"{picture.why}; {fringes.why}", p=min(picture.p, fringes.p), by="picture, fringes")
    return picture


def _check(station: Station, grids: Sequence[Grid], pictures: Sequence[Picture], gradients: object) -> None:
    if [g.camera for g in grids] != [p.camera for p in pictures] or not grids:
        names = ", ".join(g.camera for g in grids), ", ".join(p.camera for p in pictures)
        raise CaptureError(f"grids of {names[0] or 'nothing'}, pictures of {names[1] or 'nothing'}; needed a picture "
                           "for each grid: reconstruct the capture again")  # fmt: skip
    if any(p.light == "ring" for p in pictures) and station.light is None:
        raise CaptureError("the scan's pictures were taken under the ring light and this instrument has none; needed "
                           "the instrument of the scan")  # fmt: skip
    if any(p.light == "projector" for p in pictures) and gradients is None:
        raise CaptureError("the scan has no picture under the ring light; the same light of the projector is needed: "
                           "measure again (--remeasure)")  # fmt: skip


def _plan(
    g: Grid, fmt: PixelFormat, gradients: Mapping[str, Sequence[tuple[float, float]]], rig: Rig, steps: int
) -> ViewPlan:
    """The set that measures again: the finest fringes of the scan, of the direction that tells depth best."""
    found = gradients.get(g.camera, ())
    if not found:
        raise CaptureError(f"{g.camera}: the scan does not tell its fringes; reconstruct the capture again")
    camera = rig.camera(g.camera)
    middle = rig.volume.center if rig.volume is not None else geometry.working_point(rig)
    ray = middle - geometry.centre(camera.pose)
    ends = np.stack([middle, middle + 0.1 * ray / np.linalg.norm(ray)])
    deepest = max(found, key=lambda x: abs(float(np.diff(geometry.phase_at(rig.projector, x, ends))[0])))
    return ViewPlan(g.camera, fmt, (FringeSet(deepest, steps),), rig.projector.plane_size)


def _usual(fmt: PixelFormat) -> NoiseModel:
    """The noise of a sensor that the scan does not tell."""
    unit = fmt.max_value / 255
    return NoiseModel(0.5 * unit**2, 0.02 * unit)


def _noise_of(p: Picture, told: NoiseModel | None) -> NoiseModel | None:
    """Of one sample of a picture; a background has less, but that of rounding to codes."""
    if told is None or p.light == "ring":
        return told
    return NoiseModel(BACKGROUND_NOISE * told.a + ROUNDING, BACKGROUND_NOISE * told.b, told.source)
