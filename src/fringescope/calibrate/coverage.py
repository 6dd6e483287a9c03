"""Where the boards were: over each device's image, in depth, in tilt; and in words, where they were not."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fringescope import geometry
from fringescope.calibrate import prediction, scatter
from fringescope.settings import EvidenceSettings
from fringescope.types import F64, Bool, Calibration, Camera, Coverage, Filled, Projector, Rig

CELLS = (8, 6)  #: columns, rows
VOLUME = (8, 6, 3)  #: cells of the measuring volume along its axes
_COLUMNS, _ROWS = (("left", 0, 3), ("", 3, 5), ("right", 5, 8)), (("upper", 0, 2), ("", 2, 4), ("lower", 4, 6))


class Words(Protocol):
    """Where a judgement is written."""

    good: list[str]
    next: list[str]

    def against(self, text: str, level: int = 1) -> None:
        """Something weak; level 0: worth knowing, 1: no longer good, 2: not to be used."""


def coverage(calibration: Calibration) -> tuple[Coverage, ...]:
    """The projector's and each camera's coverage."""
    rig = calibration.rig
    pairs = scatter.paired(calibration)
    uv = [r.sample_uv[np.isfinite(r.sample).any(axis=1)] for _, r in pairs if r.sample.size]
    out = [_covered(calibration, rig.projector, "projector", uv)]
    for c in rig.cameras:
        px = [s.corner_px[np.isfinite(r.corner).all(axis=1)] for s, r in pairs if s.camera == c.name]
        out.append(_covered(calibration, c, c.name, px))
    return tuple(out)


def _covered(calibration: Calibration, device: Camera | Projector, name: str, where: list[F64]) -> Coverage:
    at = np.concatenate([np.zeros((0, 2)), *where])
    w, h = device.lens.width, device.lens.height
    edges = (np.linspace(-0.5, h - 0.5, CELLS[1] + 1), np.linspace(-0.5, w - 0.5, CELLS[0] + 1))
    count = np.histogram2d(at[:, 1], at[:, 0], edges)[0].astype(int)
    world = prediction.board_points(calibration)
    depth = geometry.transform(device.pose, world)[:, 2]
    near, far = (float(v) for v in (np.percentile(depth, [0, 100]) if depth.size else (np.nan, np.nan)))
    needed = (count > 0) | _needed(calibration, device, (near, far))
    share = float((count[needed] > 0).mean()) if needed.any() else 0.0
    cells = np.where(needed, count, -1)
    return Coverage(
        name,
        tuple(tuple(int(v) for v in row) for row in cells),
        share,
        _missing(cells),
        _tilts(calibration, device, name),
        near,
        far,
    )


def _needed(calibration: Calibration, device: Camera | Projector, depths: tuple[float, float]) -> Bool:
    """Cells (rows, columns) through whose middle a ray meets, at the boards' depths, what another device looks at."""
    rig = calibration.rig
    others: list[Camera | Projector] = [rig.projector] if isinstance(device, Camera) else list(rig.cameras)
    L = device.lens
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in CELLS[::-1]), indexing="ij")
    n = geometry.unproject(L, np.stack([u * L.width - 0.5, v * L.height - 0.5], axis=-1))
    out = np.zeros(CELLS[::-1], dtype=bool)
    for z in np.linspace(*depths, 3):
        p = geometry.transform(geometry.inverse(device.pose), np.concatenate([n, np.ones((*n.shape[:2], 1))], -1) * z)
        for o in others:
            uv = geometry.project(o, p)
            with np.errstate(invalid="ignore"):
                out |= ((uv >= -0.5) & (uv <= np.array([o.lens.width, o.lens.height]) - 0.5)).all(axis=-1)
    return out


def _missing(cells: F64) -> tuple[str, ...]:
    """Ninths of a picture with two cells or more of which fewer than a quarter saw a board."""
    out = []
    for row, r0, r1 in _ROWS:
        for column, c0, c1 in _COLUMNS:
            part = cells[r0:r1, c0:c1]
            if (part >= 0).sum() >= 2 and (part > 0).sum() < 0.25 * (part >= 0).sum():
                out.append({"": "middle"}.get(row + column, f"{row} {column}".strip()))
    return tuple(out)


# -------------------------------------------------------------------------------------------------------------- volume


def filled(calibration: Calibration) -> Filled:
    """How many poses reached each cell of the measuring volume, half a square around every corner that was seen."""
    rig, board, v = calibration.rig, calibration.board, prediction.space(calibration)
    middles = [(2 * np.arange(n) + 1) / n - 1 for n in VOLUME]
    centres = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    world = v.center + (centres.reshape(-1, 3) * v.half_size) @ v.axes
    lit = np.any([geometry.field_of_view(Rig(rig.projector, (c,)), world) for c in rig.cameras], axis=0)
    count = np.zeros(VOLUME, dtype=int)
    step = np.linspace(-0.5, 0.5, 5) * board.square_mm
    around = np.stack(np.meshgrid(step, step, [0.0], indexing="ij"), -1).reshape(-1, 3)
    for pose, T in calibration.boards.items():
        seen = [s.corner for s in calibration.sightings if s.pose == pose]
        if not seen:
            continue
        corner = board.corner_mm(np.unique(np.concatenate(seen), axis=0))
        p = geometry.transform(T, (corner[:, None] + around).reshape(-1, 3))
        cell = np.floor(((p - v.center) @ v.axes.T / v.half_size + 1) / 2 * VOLUME).astype(int)
        cell = np.unique(cell[((cell >= 0) & (cell < VOLUME)).all(axis=1)], axis=0)
        count[tuple(cell.T)] += 1
    needed = lit.reshape(VOLUME) | (count > 0)
    share = float((count[needed] > 0).mean()) if needed.any() else 0.0
    count = np.where(needed, count, -1)
    middle, half = float(v.axes[2] @ v.center), float(v.half_size[2])
    return Filled(
        tuple(tuple(tuple(int(n) for n in row) for row in count[:, :, k].T) for k in range(VOLUME[2])),
        tuple(float(z) for z in middle + np.linspace(-half, half, VOLUME[2] + 1)),
        (2 * float(v.half_size[0]), 2 * float(v.half_size[1])),
        share,
    )


# ---------------------------------------------------------------------------------------------------------------- tilt


def facing(calibration: Calibration, device: Camera | Projector, pose: str, middle: F64) -> tuple[float, float]:
    """Angle between a board's normal and the line of sight to `middle` (3,) on it, and the direction it faces (rad)."""
    T = geometry.compose(device.pose, calibration.boards[pose])
    sight = -geometry.transform(T, middle)
    sight = sight / np.linalg.norm(sight)
    n = -T.R[:, 2] if T.R[:, 2] @ sight < 0 else T.R[:, 2]
    side = n - (n @ sight) * sight
    return float(np.arccos(np.clip(n @ sight, -1, 1))), float(np.arctan2(side[1], side[0]))


def lean(calibration: Calibration, pose: str, middle: F64) -> tuple[float, float]:
    """Tilt against the projector's line of sight (rad), and depth of `middle` along its axis (mm)."""
    p = calibration.rig.projector
    depth = geometry.transform(geometry.compose(p.pose, calibration.boards[pose]), middle)[2]
    return facing(calibration, p, pose, middle)[0], float(depth)


def _tilts(
    calibration: Calibration, device: Camera | Projector, name: str
) -> tuple[tuple[str, float, float], ...]:
    out = {}
    for s, _ in scatter.paired(calibration):
        if s.pose in calibration.boards and len(s.corner) and name in (s.camera, "projector"):
            middle = calibration.board.corner_mm(s.corner).mean(axis=0)
            out[s.pose] = (s.pose, *facing(calibration, device, s.pose, middle))
    return tuple(out.values())


def directions(calibration: Calibration) -> list[tuple[str, F64]]:
    """Sides to which boards should be tilted, as words and unit vectors (2,) in the projector's image."""
    p = calibration.rig.projector
    middle = prediction.space(calibration).center
    out = []
    for c in calibration.rig.cameras:
        to = geometry.transform(p.pose, geometry.centre(c.pose))[:2] - geometry.transform(p.pose, middle)[:2]
        to = to / max(float(np.linalg.norm(to)), 1e-9)
        out += [(f"towards {c.name}", to), (f"away from {c.name}", -to)]
        if len(calibration.rig.cameras) < 3:
            across = np.array([-to[1], to[0]])
            out += [(f"{_side(d)}, in the projector's picture", d) for d in (across, -across)]
    return out


def _side(d: F64) -> str:
    """A direction of a picture in words."""
    if abs(d[0]) > abs(d[1]):
        return "to the right" if d[0] > 0 else "to the left"
    return "downwards" if d[1] > 0 else "upwards"


# --------------------------------------------------------------------------------------------------------------- words


def judge(w: Words, calibration: Calibration, covered: tuple[Coverage, ...], s: EvidenceSettings) -> None:
    """What the coverage is worth, and what to photograph next."""
    low = [c for c in covered if c.share < s.min_coverage]
    for c in low:
        text = f"{c.device}: boards reached {100 * c.share:.0f} % of the picture"
        w.against(text, 1 if c.share < 0.5 * s.min_coverage else 0)
    for c in covered:
        if c.missing:
            regions = ", ".join(c.missing[:4])
            where = "light of the projector" if c.device == "projector" else f"picture of {c.device}"
            w.next.append(f"no board in the {regions} of the {where}: put one there")
    tilted = _judge_tilt(w, calibration, covered, s)
    deep = _judge_depth(w, calibration, s)
    if not low and tilted and deep:
        least = 100 * min(c.share for c in covered)
        w.good.append(f"Boards reached {least:.0f} % or more of every picture, near and far, tilted to all sides.")


def _judge_tilt(w: Words, calibration: Calibration, covered: tuple[Coverage, ...], s: EvidenceSettings) -> bool:
    tilts = np.array([(t, a) for _, t, a in covered[0].tilts]).reshape(-1, 2)
    if not len(tilts):
        return False
    way = np.tan(np.minimum(tilts[:, 0], 1.5))[:, None] * np.stack([np.cos(tilts[:, 1]), np.sin(tilts[:, 1])], axis=1)
    enough = np.tan(np.radians(s.min_tilt_deg))
    spread = np.degrees(np.arctan(np.sqrt(np.linalg.eigvalsh(np.cov(way.T))[0]))) if len(way) > 2 else 0.0
    missing = [name for name, d in directions(calibration) if (way @ d).max() < enough]
    parallel = bool(spread < 0.5 * s.min_tilt_deg)
    if parallel:
        w.against(f"the tilts all lie near one line (spread across it {spread:.1f} degrees)")
        if not missing:
            w.next.append("tilt the board to more sides, not only along one line of the tilts drawn below")
    if missing:
        shown = " or ".join(missing[:4])
        w.next.append(f"no pose tilted {shown}: tilt the board there by 20 to 30 degrees")
    return not (missing or parallel)


def _judge_depth(w: Words, calibration: Calibration, s: EvidenceSettings) -> bool:
    points = prediction.board_points(calibration)
    if not len(points):
        return False
    local = geometry.transform(calibration.rig.projector.pose, points)
    low, high = np.percentile(local, [2, 98], axis=0)
    depth, width = float(high[2] - low[2]), float((high - low)[:2].max())
    if depth >= s.min_depth * width:
        return True
    away = 0.5 * s.min_depth * width
    z = np.percentile(points[:, 2], [2, 98])
    w.against(f"boards span only {depth:.0f} mm of depth over {width:.0f} mm of width", 0)
    reached = f"never nearer to the projector than z = {z[1]:.0f} mm nor farther than z = {z[0]:.0f} mm"
    w.next.append(f"boards were {reached}: move some {away:.0f} mm nearer and farther")
    return False
