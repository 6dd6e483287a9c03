"""Does the instrument project where it should? A cross grid on the calibration board, after each calibration (IV-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fringescope import capture, geometry, guide, patterns, pipeline
from fringescope.devices.base import Station
from fringescope.errors import EmptyResultError
from fringescope.pipeline import closing, guidance
from fringescope.pipeline.closing import Closed
from fringescope.settings import Settings
from fringescope.types import F64, Guidance, Guidelines, Rig, Scan, Stroke

LINES = 5  #: lines each way at most
SPACING_MM = 10.0
WIDTH_MM = 0.8
INSIDE = 0.8  #: share of what was measured that the grid covers


@dataclass(frozen=True, eq=False)
class SelfTest:
    """The grid that was asked for, where its lines landed, um, and whether that is as it should be."""

    closed: Closed
    guidance: Guidance
    median_um: float
    p95_um: float
    max_um: float
    ok: bool

    def words(self, limit_um: float) -> str:
        """The figures and the verdict in a line."""
        verdict = "as it should be" if self.ok else f"not as it should be ({limit_um:.0f} um): calibrate again"
        figures = f"median {self.median_um:.0f}, p95 {self.p95_um:.0f}, max {self.max_um:.0f} um"
        return f"cross grid: {figures}: {verdict}"


def self_test(station: Station, rig: Rig, settings: Settings | None = None) -> SelfTest:
    """Scans what lies under the instrument (a board, or anything flat), projects a cross grid and measures its lines.

    Raises EmptyResultError where too little of the grid is found, and what scans and devices raise.
    """
    s = settings or Settings()
    cameras = closing.cameras_of(station, rig, [c.name for c in rig.cameras])
    formats = {c.name: d.settings.pixel_format for c, d in zip(rig.cameras, cameras, strict=True)}
    plan = patterns.plan(rig, formats, s.patterns)
    images = [list(patterns.images(v, rig.projector, s.patterns)) for v in plan.views]
    views = capture.collect(station.projector, cameras, station.light, images, plan, s.capture)
    scan = pipeline.scan(views, rig, s)
    tissue = guidance.tissue_of(scan.grids, scan.surface, rig, s)
    strokes = cross_grid(scan, rig, tissue)
    made = guidance.project_guidance(Guidelines(strokes), tissue, s)
    closed = closing.close_loop(made, tissue, station, s)
    off = np.abs(np.concatenate([np.zeros(0), *(x.offset_um for x in closed.landings)]))
    if len(off) < 50:
        raise EmptyResultError(f"{len(off)} places of the grid were found; put the board, flat, into the middle")
    p95 = float(np.percentile(off, 95))
    return SelfTest(closed, made, float(np.median(off)), p95, float(off.max()), p95 <= s.loop.accept_um)


def cross_grid(scan: Scan, rig: Rig, tissue: guide.Tissue) -> tuple[Stroke, ...]:
    """Strokes across a flat thing, every 10 mm, along the projector's u and v; in mm on its mean plane."""
    xyz = np.concatenate([g.xyz[g.valid] for g in scan.grids])[::7].astype(np.float64)
    middle = np.median(xyz, axis=0)
    _, _, axes = np.linalg.svd(xyz[:: max(1, len(xyz) // 20_000)] - middle, full_matrices=False)
    n = axes[2]
    right = rig.projector.pose.R[0] - (rig.projector.pose.R[0] @ n) * n
    right /= np.linalg.norm(right)
    down = np.cross(n, right)
    at = np.stack([(xyz - middle) @ right, (xyz - middle) @ down], 1)
    low, high = np.percentile(at, [5, 95], axis=0)
    out = []
    for axis, name in ((0, "u"), (1, "v")):
        reach = INSIDE * (high - low) / 2
        centre = (low + high) / 2
        count = int(np.clip(2 * reach[axis] // SPACING_MM + 1, 1, LINES))
        for i in range(count):
            p = np.zeros((200, 2))
            p[:, axis] = centre[axis] + (i - (count - 1) / 2) * SPACING_MM
            p[:, 1 - axis] = centre[1 - axis] + np.linspace(-1, 1, 200) * reach[1 - axis]
            line = dropped(middle + p[:, :1] * right + p[:, 1:] * down, tissue)
            out.append(Stroke(f"{name}{i + 1}", world_mm=line, width_mm=WIDTH_MM, color=(255, 255, 255)))
    return tuple(out)


def dropped(points: F64, tissue: guide.Tissue) -> F64:
    """Places (n, 3) moved along the projector's rays onto the surface, where there is one."""
    ground = tissue.relief.at(geometry.project(tissue.rig.projector, points))
    return np.where(np.isfinite(ground), ground, points)
