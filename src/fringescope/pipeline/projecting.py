"""Guidance on the tissue for as long as it is true: shown under a watchdog, while somebody keeps looking."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from fringescope import geometry, guide, report
from fringescope.devices.base import Station
from fringescope.errors import FringescopeError
from fringescope.settings import Settings
from fringescope.types import Bool, Guidance, Standing, Watched

LIT = 0.01  #: of full light; less does not change a picture
GLOW_MM = 2.5  #: so far around the projected lines the tissue, and the wall of a fold beside them, glow too


class Guard(Protocol):
    """What keeps the projector from shining on when nobody answers any more (`devices.watchdog.Guard`)."""

    def beat(self) -> None:
        """Somebody is there. Raises DeviceLostError once the projector was made dark."""

    def lease(self, seconds: float) -> None:
        """Somebody will be there again within `seconds`; it beats by itself till then."""


@dataclass(frozen=True, eq=False)
class Projected:
    """How a projection ended: `ended` is "stopped", "stale" or "lost", `why` in words; all verdicts, in order."""

    ended: str
    why: str
    verdicts: tuple[Watched, ...]


def lit_masks(guidance: Guidance, tissue: guide.Tissue) -> dict[str, Bool]:
    """Which pixels (H, W) of each camera the projected lines, and their glow, change: by the camera's name."""
    projector = tissue.rig.projector
    light = report.plane_light(guidance.image, projector).max(axis=2)
    shone = tissue.relief.at(np.argwhere(light > LIT)[:, ::-1].astype(np.float64))  # also where a camera has no points
    shone = shone[np.isfinite(shone).all(axis=1)]
    out = {}
    for grid, footprint in zip(tissue.grids, tissue.footprints, strict=True):
        uv = geometry.project(projector, grid.xyz).astype(np.float32)
        uv[~np.isfinite(uv)] = -10
        lit = cv2.remap(light, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        reach = max(1, round(GLOW_MM / footprint)) if footprint else 1
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        mask = (lit > LIT).astype(np.uint8)
        at = geometry.project(tissue.rig.cameras[grid.view], shone)
        h, w = mask.shape
        with np.errstate(invalid="ignore"):
            at = np.rint(at[((at > -0.5) & (at < [w - 0.5, h - 0.5])).all(axis=1)]).astype(np.intp)
        mask[at[:, 1], at[:, 0]] = 1
        out[grid.camera] = cv2.dilate(mask, around) > 0
    return out


def hold(
    station: Station,
    guarded: Callable[[], AbstractContextManager[Guard]],
    guidance: Guidance,
    dashed: Guidance,
    look: Callable[[], Watched],
    stop: Callable[[], bool],
    settings: Settings | None = None,
    tell: Callable[[Watched], None] | None = None,
) -> Projected:
    """Shows guidance until `stop` says so, or until it is no longer true. The projector is dark afterwards, whatever.

    `look` compares what is seen with the scan (`watching.watch`, with the masks of `lit_masks`): before anything is
    shown, and again and again meanwhile, in a thread beside the beats of the guard, which starts when something is to
    be shown. VALID: the guidance. SUSPECT: `dashed`, the same in dashes. STALE, a look that fails, or none for
    `loop.patience_s`: dark. `tell` hears every verdict.
    """
    s = settings or Settings()
    verdicts: list[Watched] = []
    failed: list[str] = []
    over = threading.Event()
    last = time.monotonic()

    def judged() -> Watched:
        verdict = look()
        verdicts.append(verdict)
        if tell is not None:
            tell(verdict)
        return verdict

    def keep_looking() -> None:
        nonlocal last
        while not over.wait(s.loop.look_s):
            try:
                judged()
            except FringescopeError as e:
                failed.append(str(e))
                return
            last = time.monotonic()

    first = judged()
    if first.verdict is Standing.STALE:
        return Projected("stale", first.why, tuple(verdicts))
    watcher = threading.Thread(target=keep_looking, name="watch", daemon=True)
    shown: Standing | None = None
    last = time.monotonic()
    try:
        with guarded() as guard:
            try:
                while True:
                    guard.lease(s.loop.lease_s)
                    now = verdicts[-1]
                    if failed:
                        why = f"the specimen can no longer be watched: {failed[0]}"
                        return Projected("lost", why, tuple(verdicts))
                    if now.verdict is Standing.STALE:
                        return Projected("stale", now.why, tuple(verdicts))
                    if time.monotonic() - last > s.loop.patience_s:
                        why = f"no look at the specimen for {s.loop.patience_s:g} s"
                        return Projected("lost", why, tuple(verdicts))
                    if stop():
                        return Projected("stopped", "as was asked", tuple(verdicts))
                    if now.verdict is not shown:
                        image = (guidance if now.verdict is Standing.VALID else dashed).image
                        grey = not station.projector.info.colours
                        station.projector.show(np.asarray(image.max(axis=2)) if grey else image)
                        shown = now.verdict
                        if not watcher.is_alive():
                            watcher.start()
                    time.sleep(1e-3 * s.guard.beat_ms)
            finally:
                station.projector.dark()
    finally:
        over.set()
        if watcher.is_alive():
            watcher.join(s.loop.patience_s)
