"""The recipes: which step comes next. Objects in, objects out; reads like Figs. 6 and 7 of the paper.

Two doors: `scan` does the usual thing in one call; `scan_view`, `decode_view` and the stages that they name are the
parts it is made of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from fringescope import denoise, fuse, geometry, phase, triangulate
from fringescope.errors import EmptyResultError
from fringescope.settings import Settings
from fringescope.types import Decoded, Grid, Photo, Rig, Scan, Surface, ViewInput

Progress = Callable[[str, float], None]  #: called with what is being done and the share that is done, 0 to 1


def decode_view(view: ViewInput, s: Settings) -> Decoded:
    """Frames to absolute phase with reasons, without a rig (equations 3 to 5, masks 1 and 3 of III-D).

    Raises CaptureError if frames are missing or do not fit, DecodeError if the sets do not span the projector's field.
    """
    measured = phase.measure(view.frames, view.plan, s.phase, view.noise)
    decoded = phase.settle_order(measured, view.plan, s.phase)
    reasons = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)
    reasons = denoise.connected(decoded, reasons, None, s.denoise)
    return phase.with_reasons(decoded, reasons)


def scan_view(view: ViewInput, rig: Rig, s: Settings) -> tuple[Decoded, Grid]:
    """One camera's frames to organised points with sigma (Fig. 6, with the masks of Fig. 7).

    Raises CaptureError, DecodeError or RigError, each with what came, what was needed and what to do.
    """
    geometry.check_baseline(rig, rig.camera(view.plan.camera))
    decoded = phase.measure(view.frames, view.plan, s.phase, view.noise)  # II-C; frames may still be arriving
    decoded = phase.settle_order(decoded, view.plan, s.phase, rig, s.denoise.volume_margin)
    reasons = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)  # III-D 1
    reasons = denoise.monotonic(decoded, reasons, rig, s.denoise)  # III-D 2
    reasons = denoise.connected(decoded, reasons, rig, s.denoise)  # III-D 3
    reasons = denoise.local(decoded, reasons, rig, s.denoise)
    grid = triangulate.grid(decoded, reasons, rig, volume_margin=s.denoise.volume_margin)  # equations 8 to 15
    return phase.with_reasons(decoded, grid.reasons), grid


def picture(view: ViewInput, decoded: Decoded, s: Settings) -> Photo:
    """The ring-light picture of a view; where there is none, the background A of its fringes."""
    plan = view.plan
    if view.color is None:
        return fuse.photo_from_background(decoded.background, plan.pixel_format, plan.camera, s.fuse)
    return fuse.photo(view.color, plan.pixel_format, plan.camera, s.fuse)


def scan(
    views: Sequence[ViewInput],
    rig: Rig,
    settings: Settings | None = None,
    *,
    all_points: bool = False,
    surface: bool = True,
    progress: Progress | None = None,
) -> Scan:
    """Fringe images of all views to one clean, coloured surface.

    `all_points` also lists every valid pixel of every view, unthinned; `surface=False` leaves out the mesh. Where the
    points are too few or too far apart for a triangle, the surface is None and `figures["surface"]` says why. Raises
    EmptyResultError, with the reasons, if no view keeps a point; and as `scan_view`.
    """
    s = settings or Settings()
    tell = progress or _silent
    times: dict[str, float] = {}
    grids: list[Grid] = []
    photos: list[Photo] = []
    figures: dict[str, Any] = {"views": {}}
    for n, view in enumerate(views):
        tell(f"decoding {view.plan.camera}", 0.7 * n / len(views))
        start = perf_counter()
        decoded, grid = scan_view(view, rig, s)
        grids.append(grid)
        photos.append(picture(view, decoded, s))
        times[f"scan_view {grid.camera}"] = perf_counter() - start
        figures["views"][grid.camera] = _figures(decoded, grid)
    order = np.argsort([g.view for g in grids])
    grids, photos = [grids[i] for i in order], [photos[i] for i in order]
    tell("comparing the views", 0.7)
    start = perf_counter()
    grids = list(denoise.agree(grids, rig, s.denoise))
    verdicts = tuple(denoise.verdict(g) for g in grids)
    if not any(v.points for v in verdicts):
        raise EmptyResultError("no point was left; " + "; ".join(w for v in verdicts for w in v.words[1:]))
    times["agree"] = perf_counter() - start
    tell("fusing", 0.75)
    start = perf_counter()
    fused = fuse.merge(grids, photos, rig, s.fuse)
    cloud = fuse.cloud(fused)
    every = fuse.all_points(grids, photos, rig, s.fuse) if all_points else None
    times["fuse"] = perf_counter() - start
    levels: tuple[Surface, ...] = ()
    if surface:
        tell("meshing", 0.85)
        start = perf_counter()
        try:
            levels = fuse.surface(fused, rig, s.mesh)
        except EmptyResultError as e:  # points too far apart for a triangle are still points
            figures["surface"] = str(e)
        times["mesh"] = perf_counter() - start
    tell("done", 1.0)
    figures["times_s"] = times
    return Scan(
        tuple(grids), cloud, levels[0] if levels else None, verdicts, figures, levels[-1] if levels else None, every
    )


def _silent(_what: str, _share: float) -> None:
    """No progress is shown."""


def _figures(decoded: Decoded, grid: Grid) -> dict[str, Any]:
    """What scan.json tells of a view: noise, sigma, modulation."""
    ok = grid.valid
    some = bool(ok.any())
    return {
        "noise": {"a": decoded.noise.a, "b": decoded.noise.b, "source": decoded.noise.source},
        "sigma_median_mm": float(np.median(grid.sigma[ok])) if some else None,
        "modulation_median": float(np.median(decoded.modulation[ok])) if some else None,
        "background_median": float(np.median(decoded.background[ok])) if some else None,
        "directions": [list(d.g) for d in decoded.directions],
    }
