"""Text on the tissue: letters on the mean plane of what they cover, each shown as a whole or not at all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.errors import GuidanceError
from fringescope.guide import fills
from fringescope.guide.drape import Source, in_shadow, places, resampled, seen
from fringescope.guide.inside import STEEP, window
from fringescope.guide.tissue import Tissue
from fringescope.settings import GuideSettings
from fringescope.types import F32, F64, Camera, Hidden, Projector, Stroke

FONT = "DejaVu Sans"  #: comes with matplotlib: the same letters everywhere
LEAN_DEG = 60.0  #: the plane of the letters leans no more than this against the projector's rays
PLANES = 3  #: times that the plane is fitted to what the text then covers
EDGE_SHARE = 0.02  #: of a letter may have no surface: specks, and what is cut from its rim


@dataclass(frozen=True, eq=False)
class Letter:
    """One letter: its outlines on the tissue, each (n, 3) mm, and on the projector's plane (n, 2), closed.

    `why` it is not shown: None where all of it lies on surface that the projector lights. `torn`: that is because the
    surface jumps under it, which counts as a hole.
    """

    lands: tuple[F64, ...]
    rings: tuple[F64, ...]
    why: Hidden | None
    length_mm: float
    torn: bool = False

    @property
    def reason(self) -> str:
        """Why it is not shown, in a word or two."""
        return "torn by a jump" if self.torn else self.why.value if self.why else ""


def _without_a_letter(text: str) -> str:
    """What of a text the font cannot draw."""
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font = get_font(findfont(FontProperties(family=FONT)))
    return "".join(dict.fromkeys(c for c in text if not c.isspace() and font.get_char_index(ord(c)) == 0))


def _outlines(stroke: Stroke) -> list[list[F64]]:
    """The outlines (n, 2) of each letter, mm to the right and up from where the text starts."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath  # only who writes needs it

    if missing := _without_a_letter(stroke.text):
        raise GuidanceError(f"text {stroke.text!a}: the font has no letter for {missing!a}; write it otherwise")
    path = TextPath((0, 0), stroke.text.replace("$", r"\$"), stroke.size_mm, FontProperties(family=FONT))
    rings = [r for r in map(np.asarray, path.to_polygons(closed_only=False)) if len(r) > 2]
    if not rings:
        raise GuidanceError(f"text {stroke.text!r} has nothing to draw")
    rings.sort(key=lambda r: float(r[:, 0].min()))
    out: list[list[F64]] = []
    reach = -math.inf
    for r in rings:  # what overlaps sideways belongs together: dots, accents, what is inside an o
        if r[:, 0].min() >= reach:
            out.append([])
        out[-1].append(np.vstack([r, r[:1]]))
        reach = max(reach, float(r[:, 0].max()))
    return out


def letters(stroke: Stroke, tissue: Tissue, s: GuideSettings) -> list[Letter]:
    """The letters of a text. It starts at the first point, and its base line runs through the second one, or to the
    projector's right; `size_mm` is the height of its lines.

    They are laid on the mean plane of what they cover and from there, as the camera of the photograph or the projector
    sees them, on the surface.
    """
    outlines = _outlines(stroke)
    at = places(stroke, stroke.points[:2], tissue, s)
    if not np.isfinite(at[0]).all():
        raise GuidanceError("the text starts beside the measured surface; move it")
    if len(at) > 1 and not np.isfinite(at[1]).all():
        raise GuidanceError("the point that the text runs towards lies beside the measured surface; move it")
    every = np.concatenate([r for rings in outlines for r in rings])
    look = _Look(stroke.camera if stroke.pixels is not None else None, tissue, s)
    along, up = _plane(at, every.min(0), every.max(0), look)
    return [_letter(rings, at[0], along, up, look) for rings in outlines]


@dataclass(frozen=True, eq=False)
class _Look:
    """From where the text is laid on the surface: a camera, or the projector."""

    camera: str | None
    tissue: Tissue
    s: GuideSettings

    @property
    def device(self) -> Camera | Projector:
        """The device itself."""
        if self.camera is None:
            return self.tissue.rig.projector
        return self.tissue.rig.cameras[self.tissue.grids[self.tissue.number(self.camera)].view]

    def ground(self, spot: F64) -> tuple[F64, Any]:
        """The surface behind or before places (n, 3), NaN where there is none, and who says so."""
        uv = geometry.project(self.device, spot)
        if self.camera is not None:
            out = seen(uv, self.camera, self.tissue, self.s)
            return np.where((out.source == Source.NOBODY)[:, None], np.nan, out.xyz), out.source
        return self.tissue.relief.at(uv), np.full(len(uv), int(Source.SURFACE))


def _plane(at: F64, low: F64, high: F64, look: _Look) -> tuple[F64, F64]:
    """Unit vectors along the base line and up, on the mean plane of what a text covers from `low` to `high`, mm."""
    eye = geometry.centre(look.device.pose)
    light = _unit(eye - at[0])
    normal = light
    x, y = np.meshgrid(np.linspace(low[0], high[0], 40), np.linspace(low[1], high[1], 12))
    for k in range(PLANES + 1):
        along, up = _axes(at, normal, eye, look.tissue.rig.projector.pose.R[0])
        if k == PLANES:
            break
        ground, _ = look.ground(at[0] + x.ravel()[:, None] * along + y.ravel()[:, None] * up)
        ground = ground[np.isfinite(ground).all(1)]
        if len(ground) < 10:
            break
        found = np.linalg.svd(ground - ground.mean(0), full_matrices=False)[2][2]
        found *= np.sign(found @ light)
        if found @ light < math.cos(math.radians(LEAN_DEG)):
            break
        normal = found
    return along, up


def _axes(at: F64, normal: F64, eye: F64, right: F64) -> tuple[F64, F64]:
    """On the plane through the first place: towards where the second one is seen on it, and up from it."""
    aim = right
    if len(at) > 1:
        ray = at[1] - eye
        aim = eye + ray * (((at[0] - eye) @ normal) / (ray @ normal)) - at[0]
        if np.linalg.norm(aim) < 0.05:
            raise GuidanceError("the two points of the text lie at one place; move the second one away")
    along = _unit(aim - (aim @ normal) * normal)
    return along, np.cross(normal, along)


def _unit(a: F64) -> F64:
    return np.asarray(a / np.linalg.norm(a))


def _letter(outlines: list[F64], start: F64, along: F64, up: F64, look: _Look) -> Letter:
    projector, s = look.tissue.rig.projector, look.s
    rings, lands, who, flat = [], [], [], 0.0
    for outline in outlines:
        xy = resampled(outline, s.sample_mm, s.max_samples)[0]
        spot = start + xy[:, :1] * along + xy[:, 1:] * up
        ground, source = look.ground(spot)
        lands.append(ground)
        who.append(source)
        rings.append(geometry.project(projector, np.where(np.isfinite(ground), ground, spot)))
        flat += float(np.linalg.norm(np.diff(outline, axis=0), axis=1).sum())
    why = _why_not(rings, lands, np.concatenate(who), look.tissue, s)
    torn = why in (None, Hidden.HOLE) and _torn(rings, lands, look.tissue, s)
    length = flat
    if why is None and not torn:
        length = sum(float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for p in lands)
    return Letter(tuple(lands), tuple(rings), Hidden.HOLE if torn else why, length, torn)


def _why_not(rings: list[F64], lands: list[F64], source: Any, tissue: Tissue, s: GuideSettings) -> Hidden | None:
    """Why the projector cannot light all of a letter."""
    projector, relief = tissue.rig.projector, tissue.relief
    every, ground = np.concatenate(rings), np.concatenate(lands)
    w, h = projector.plane_size
    with np.errstate(invalid="ignore"):
        if not ((every >= -0.5).all(1) & (every[:, 0] <= w - 0.5) & (every[:, 1] <= h - 0.5)).all():
            return Hidden.OUTSIDE
    if not np.isfinite(ground).all():
        return Hidden.HOLE
    share, depth = _under(rings, tissue)
    if share[~np.isfinite(depth)].sum() > EDGE_SHARE * share.sum():
        return Hidden.HOLE
    if in_shadow(ground, every, source, tissue, s).any():
        return Hidden.SHADOW
    to_light = geometry.centre(projector.pose) - ground
    facing = (relief.of(relief.normal, every) * to_light).sum(1) / np.linalg.norm(to_light, axis=1)
    with np.errstate(invalid="ignore"):
        if (facing < math.cos(math.radians(s.grazing_deg))).any():
            return Hidden.GRAZING
    return None


def _under(rings: list[F64], tissue: Tissue) -> tuple[F32, F32]:
    """Shares (h, w) of the units that a letter covers, and the depth of the surface there, NaN where there is none."""
    low, size = window(np.concatenate(rings), tissue.rig.projector)
    part = (slice(low[1], low[1] + size[0]), slice(low[0], low[0] + size[1]))
    return fills.inside(rings, low, size), tissue.relief.depth[part]


def _torn(rings: list[F64], lands: list[F64], tissue: Tissue, s: GuideSettings) -> bool:
    """Whether the surface jumps under a letter, there or over a hole that slopes do not explain."""
    share, depth = _under(rings, tissue)
    projector = tissue.rig.projector
    if not np.isfinite(depth).any():
        return False
    unit_mm = float(np.nanmedian(depth)) / float(projector.lens.K[0, 0])
    far = max(s.jump_mm, 4 * unit_mm)
    for ring, land in zip(rings, lands, strict=True):
        known = np.isfinite(land).all(1)
        if (np.linalg.norm(np.diff(land, axis=0), axis=1) > far).any():
            return True
        aside = unit_mm * np.linalg.norm(np.diff(ring[known], axis=0), axis=1)
        if (np.abs(np.diff(geometry.transform(projector.pose, land[known])[:, 2])) > far + STEEP * aside).any():
            return True
    depth = np.where(share > 0, depth, np.nan)
    with np.errstate(invalid="ignore"):
        return any(bool((np.abs(np.diff(depth, axis=axis)) > far).any()) for axis in (0, 1))
