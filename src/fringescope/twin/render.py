"""Pictures of a scene: geometry once per camera, then every pattern is a lookup of light.

A pixel's signal is a sum over its rays of gain times projector light at the ray's (u, v), plus steady light. On smooth
surfaces one ray serves, its light blurred by the pixel's footprint; at edges several rays sit where their second
moments equal those of the pixel's area and the camera's defocus disc together. Either way blur is symmetric and moves
no phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from fringescope.errors import UsageError
from fringescope.twin import loops, optics
from fringescope.twin.presets import Instrument
from fringescope.twin.scene import Scene
from fringescope.twin.shapes import Hits, lit, trace
from fringescope.types import F32, F64, U8, AnyArray, Bool, Camera, PixelFormat

TILE = 1 << 14  #: rays that are traced at a time: short enough to let other threads of the interpreter have a turn
MIRROR_MIN = 2e-4  #: mirrored light below this share of a white surface's is left out
MIRROR_REACH = 60.0  #: mm; what is mirrored from farther away is left out
MOST_BLUR = 10.0  #: plane units; light is not blurred more than this
MOST_BEND = 0.3  #: plane units; second difference of (u, v) up to which a pixel's surroundings count as smooth


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """What every pixel centre of a camera sees: arrays (H, W).

    `xyz` (H, W, 3) world mm and `uv` (H, W, 2) projector plane, NaN where nothing is hit; `lit`: the projector reaches
    the point; `mirrored`: share of the pixel's projector light that came by way of another surface; `shape`: index or
    -1.
    """

    xyz: F64
    uv: F64
    lit: Bool
    mirrored: F32
    shape: AnyArray


_Lights = tuple[tuple[float, float, float], ...]  #: red, green, blue of lamps


class _Sparse(NamedTuple):
    """Further rays: the pixel that each belongs to, where it lands, its blur (plane units) and its gains (n, lamps)."""

    pixel: AnyArray
    u: F32
    v: F32
    sigma: F32
    gain: F32


class _Surface(NamedTuple):
    """What rays (n,) found: hits, response to body colour (lamps', ring's, room's light), film, scattering."""

    hits: Hits
    colours: F64  #: (lamps + 2, n)
    alpha: F64
    f0: F64
    scatter: F64
    shiny: F64  #: (n, 3), the normal that gloss sees


class _Rays(NamedTuple):
    """Rays (n,) with their projector light; `gain` (n, lamps)."""

    surface: _Surface
    uv: F64
    lit: Bool
    sigma: F64
    gain: F64
    room: F64
    mirrored: _Sparse


@dataclass(frozen=True, eq=False)
class _View:
    """Geometry of one camera: per pixel where it looks (columns, rows and levels of the light stack), gains (lamps, n),
    steady and ring light. The first lamp is the projector's white one.
    """

    stack: optics.LightStack
    x: F32
    y: F32
    level: F32
    gain: F32
    more: tuple[AnyArray, F32, F32, F32]  #: pixel, x, y, level
    more_gain: F32  #: (lamps, m)
    steady: F32
    ring: F32
    stray: F32  #: gain by way of other surfaces


class Renderer:
    """Renders one scene through one instrument; keeps each camera's geometry once it has been needed.

    Where a pixel's surroundings are smooth, one ray serves and its footprint is blur; at edges of shape, shadow or
    colour `rays` (1, 4 or 16; None: what suits the scene) are traced. `mirrors`: whether wet surfaces mirror
    what lies around them.
    """

    def __init__(self, scene: Scene, instrument: Instrument, rays: int | None = None, mirrors: bool = True) -> None:
        if rays not in (None, 1, 4, 16):
            raise UsageError(f"rays {rays}; needed 1, 4 or 16 per pixel")
        self.scene, self.instrument = scene, instrument
        self._rays, self._mirrors = rays or scene.rays, mirrors
        self._views: dict[tuple[str, bool], _View] = {}
        p = instrument.rig.projector
        self._aspect = float(p.lens.K[0, 0] / p.lens.K[1, 1])
        self._centre = -p.pose.R.T @ p.pose.t

    # ---------------------------------------------------------------------------------------------------- pictures

    def signal(
        self, camera: str, image: U8 | None, ring: float = 0.0, leds: float | tuple[float, float, float] = 1.0
    ) -> F32:
        """Noise-free signal (H, W) while the projector shows `image` (None: lamp off); 1 = a white surface fully lit.

        `image`: (height, width) or (height, width, 3), red, green, blue. `ring`: level of the ring light, 0..1; `leds`:
        brightness of the lamp, or of its three colours, 0..1, which together are the white one.
        """
        cam, inst = self.instrument.rig.camera(camera), self.instrument
        three = leds if isinstance(leds, tuple) else (leds,) * 3
        coloured = image is not None and (image.shape[2:] == (3,) or len(set(three)) > 1)
        view = self._view(cam, coloured)
        steady = view.steady + np.float32(ring * self.scene.ring) * view.ring if ring else view.steady
        out = steady.copy()
        if image is not None:
            channels = np.moveaxis(image, -1, 0) if image.shape[2:] == (3,) else [image] * 3
            for gain, more, channel, level in zip(view.gain, view.more_gain, channels, three, strict=False):
                if level > 0:
                    light = optics.mirror_light(channel, inst.rig.projector, inst.projector)
                    levels = view.stack.build(light * np.float32(level * self.scene.lamp))
                    loops.gather(levels, view.x, view.y, view.level, gain, out, out)
                    pixel, x, y, depth = view.more
                    loops.gather_sparse(levels, pixel, x, y, depth, more, out)
        return out.reshape(cam.lens.height, cam.lens.width)

    def frame(
        self,
        camera: str,
        image: U8 | None,
        rng: np.random.Generator | None,
        exposure_us: float | None = None,
        ring: float = 0.0,
        gain: float = 1.0,
        leds: float | tuple[float, float, float] = 1.0,
        pixel_format: PixelFormat | None = None,
    ) -> AnyArray:
        """Raw codes (H, W), or (H, W, 3) for RGB8, as the sensor gives them; without `rng` no noise is drawn."""
        inst = self.instrument
        own = inst.pixel_formats[inst.rig.index(camera)]
        fmt = pixel_format or own
        if fmt.is_bayer != own.is_bayer or fmt is PixelFormat.RGB8:
            raise UsageError(f"{camera} has a {own.value} sensor; it cannot give {fmt.value}")
        electrons = inst.electrons * (exposure_us or inst.standard_exposure_us) / inst.standard_exposure_us
        s = self.signal(camera, image, ring, leds)
        return inst.sensor.read(s.ravel(), electrons, fmt, gain, rng).reshape(s.shape)

    def truth(self, camera: str) -> ViewTruth:
        """What each pixel centre really sees."""
        cam = self.instrument.rig.camera(camera)
        w, h = cam.lens.width, cam.lens.height
        xyz, uv = np.empty((h * w, 3)), np.empty((h * w, 2))
        light, shape = np.empty(h * w, bool), np.empty(h * w, np.int32)
        for k in self._tiles(cam):
            origin, d = optics.look(cam.lens, cam.pose, _pixels(cam, np.arange(k.start, k.stop)))
            hits = trace(self.scene.shapes, origin, d)
            uvz, light[k] = self._to_projector(hits)
            hit = (hits.shape >= 0)[:, None]
            xyz[k], uv[k], shape[k] = np.where(hit, hits.point, np.nan), np.where(hit, uvz[:, :2], np.nan), hits.shape
        view = self._view(cam)
        total = view.gain[0] + np.bincount(view.more[0], view.more_gain[0], h * w)
        share = np.divide(view.stray, total, out=np.zeros(h * w, np.float32), where=total > 0, casting="unsafe")
        return ViewTruth(
            xyz.reshape(h, w, 3), uv.reshape(h, w, 2), light.reshape(h, w), share.reshape(h, w), shape.reshape(h, w)
        )

    # ---------------------------------------------------------------------------------------------------- geometry

    def _tiles(self, cam: Camera) -> list[slice]:
        """Pixel numbers in pieces of whole pairs of rows."""
        step, n = max(2, TILE // cam.lens.width // 2 * 2) * cam.lens.width, cam.lens.width * cam.lens.height
        return [slice(k, min(k + step, n)) for k in range(0, n, step)]

    def _view(self, cam: Camera, coloured: bool = False) -> _View:
        """The white lamp's view, or the three coloured lamps': with gains of their own in the white one's geometry."""
        if (cam.name, coloured) not in self._views:
            white = self.instrument.projector_colour
            if coloured:
                three = ((white[0], 0.0, 0.0), (0.0, white[1], 0.0), (0.0, 0.0, white[2]))
                made = self._make(cam, (white, *three))
                made = replace(self._view(cam), gain=made.gain[1:], more_gain=made.more_gain[1:])
            else:
                made = self._make(cam, (white,))
            self._views[cam.name, coloured] = made
        return self._views[cam.name, coloured]

    def _make(self, cam: Camera, lamps: _Lights) -> _View:
        """Traces a camera's rays. What is traced, and what is left out, depends on the first lamp alone."""
        h, w = cam.lens.height, cam.lens.width
        u, v, sigma, steady, ring, stray, spread = (np.zeros(h * w, np.float32) for _ in range(7))
        gains = np.zeros((len(lamps), h * w), np.float32)
        gain = gains[0]
        shape, light = np.empty(h * w, np.int16), np.empty(h * w, bool)
        shadow = np.empty((self.instrument.ring.lamps, h * w), bool)
        found: list[_Sparse] = []
        glossy: list[_Sparse] = []
        for k in self._tiles(cam):
            index = np.arange(k.start, k.stop)
            origin, d = optics.look(cam.lens, cam.pose, _pixels(cam, index))
            rays = self._shade(cam, origin, d, index, lamps)
            u[k], v[k], sigma[k], gains[:, k] = rays.uv[:, 0], rays.uv[:, 1], rays.sigma, rays.gain.T
            steady[k] = rays.room
            shape[k], light[k] = rays.surface.hits.shape, rays.lit
            spread[k] = self._spread(cam, rays.surface.hits, origin)
            glossy.append(rays.mirrored)
            seen = self._ring_shadows(rays.surface.hits, w)
            ring[k] = self._ring(cam, rays.surface, d, seen, index)
            shadow[:, k] = seen
        gains[:, ~light] = 0.0
        size = (h, w)
        at, kind = (u.reshape(size), v.reshape(size)), shape.reshape(size)
        foot, rough = _footprint(*at, gain.reshape(size), kind, self._aspect)
        one = _joined(glossy)
        one = one._replace(sigma=np.hypot(one.sigma, _reach(one, size, self._aspect) * spread[one.pixel]))
        if self._rays > 1:
            edges = np.flatnonzero(rough)
            one = one._replace(**_pick(one, ~rough[one.pixel]))
            gains[:, edges] = steady[edges] = ring[edges] = 0.0
            offsets, weight = _quadrature(self._rays), 1.0 / self._rays
            for part in np.array_split(edges, len(edges) // TILE + 1):
                base = _pixels(cam, part)
                for o in offsets:
                    origin, d = optics.look(cam.lens, cam.pose, base + spread[part, None] * o)
                    rays = self._shade(cam, origin, d, part, lamps)
                    steady[part] += weight * rays.room
                    ring[part] += weight * self._ring(cam, rays.surface, d, shadow[:, part], part)
                    on = np.flatnonzero(rays.lit & (rays.gain[:, 0] > 0))
                    numbers = (*rays.uv[on].T, rays.sigma[on], weight * rays.gain[on])
                    direct = _Sparse(part[on], *(a.astype(np.float32) for a in numbers))
                    found += [direct, rays.mirrored._replace(gain=np.float32(weight) * rays.mirrored.gain)]
                    np.add.at(stray, rays.mirrored.pixel, np.float32(weight) * rays.mirrored.gain[:, 0])
        np.add.at(stray, one.pixel, one.gain[:, 0])
        sigma = np.sqrt(sigma**2 + (foot.ravel() * spread) ** 2)
        more = _spread_out(_joined([one, *found]), self._aspect)
        smooth = gain > 0
        for a in (u, v):
            a[~smooth] = 0.0
        low = float(np.percentile(sigma[smooth], 2)) if smooth.any() else 1.0
        high = max([low, *(float(a.max()) for a in (sigma[smooth], more.sigma) if a.size)])
        stack = optics.LightStack(optics.blur_levels(low, min(high, MOST_BLUR)), self._aspect)
        lookups = (more.pixel, *stack.place(more.sigma, more.u, more.v))
        more_gain = np.ascontiguousarray(more.gain.T)
        return _View(stack, *stack.place(sigma, u, v), gains, lookups, more_gain, steady, ring, stray)

    def _spread(self, cam: Camera, hits: Hits, origin: F64) -> F64:
        """Standard deviation (n,) in pixels of pixel area and defocus together."""
        o = self.instrument.camera
        depth = np.where(hits.shape >= 0, (hits.point - origin) @ cam.pose.R[2], o.focus_mm)
        f = 0.5 * (cam.lens.K[0, 0] + cam.lens.K[1, 1])
        return np.asarray(np.sqrt(1.0 / 12.0 + optics.defocus_sigma(f, o.aperture_mm, o.focus_mm, depth) ** 2))

    def _to_projector(self, hits: Hits) -> tuple[F64, Bool]:
        """(u, v, depth) (n, 3) of hits on the projector plane, and whether the projector reaches them."""
        p = self.instrument.rig.projector
        uvz = optics.land(p.lens, p.pose, hits.point)
        w, h = p.plane_size
        m = optics.MARGIN - 4
        with np.errstate(invalid="ignore"):
            ok = (hits.shape >= 0) & (uvz[:, 0] > -m) & (uvz[:, 0] < w - 1 + m)
            ok &= (uvz[:, 1] > -m) & (uvz[:, 1] < h - 1 + m)
        k = np.flatnonzero(ok)
        ok[k] = lit(self.scene.shapes, hits.point[k], hits.normal[k], self._centre)
        return uvz, ok

    def _surface(self, cam: Camera, hits: Hits, d: F64, pixel: AnyArray, lamps: _Lights) -> _Surface:
        n = len(hits.t)
        albedo, alpha, f0, scatter = np.zeros((n, 3)), np.full(n, 0.3), np.zeros(n), np.zeros(n)
        shiny = hits.normal.copy()
        for i, shape in enumerate(self.scene.shapes):
            k = np.flatnonzero(hits.shape == i)
            if not k.size:
                continue
            f, p = shape.finish, shape.local(hits.point[k])
            albedo[k], alpha[k], f0[k], scatter[k] = f.albedo(p), f.alpha, f.f0, f.scatter_mm
            if f.bumps is not None:
                b = shiny[k]
                b[:, :2] += f.bumps(p) * np.abs(b[:, 2:])
                shiny[k] = b / np.linalg.norm(b, axis=1, keepdims=True)
        fall = np.clip(d @ cam.pose.R[2], 0, 1) ** self.instrument.camera.falloff
        inst = self.instrument
        colours = np.empty((len(lamps) + 2, n))
        for j, light in enumerate((*lamps, inst.ring.colour, inst.ambient)):
            colours[j] = fall * (albedo * self._response(cam, light, pixel)).sum(1)
        return _Surface(hits, colours, alpha, f0, scatter, shiny)

    def _response(self, cam: Camera, colour: tuple[float, float, float], pixel: AnyArray) -> F64:
        """Response (n, 3) of pixels' sensor sites to surface colour under a light; a green (or mono) site answers white
        with 1.
        """
        fmt = self.instrument.pixel_formats[self.instrument.rig.index(cam.name)]
        M = self.instrument.sensor.response(fmt)
        M = M * np.asarray(colour) / M[len(M) // 2].sum()
        if not fmt.is_bayer:
            return np.broadcast_to(M[0], (len(pixel), 3))
        return np.asarray(M[(pixel % cam.lens.width) % 2 + (pixel // cam.lens.width) % 2])

    def _shade(self, cam: Camera, origin: F64, d: F64, pixel: AnyArray, lamps: _Lights) -> _Rays:
        """Traces rays along `d` (n, 3) that belong to `pixel` (n,)."""
        inst, p = self.instrument, self.instrument.rig.projector
        surface = self._surface(cam, trace(self.scene.shapes, origin, d), d, pixel, lamps)
        hits = surface.hits
        uvz, light = self._to_projector(hits)
        gain, sigma = np.zeros((len(d), len(lamps))), np.full(len(d), inst.projector.blur_units)
        k = np.flatnonzero(light)
        value = np.empty(len(k))
        for j, lamp in enumerate(lamps):
            tint = self._response(cam, lamp, pixel[k]).sum(1)
            loops.reflect(
                hits.point[k], hits.normal[k], surface.shiny[k], d[k], self._centre, p.pose.R[2],
                inst.projector.focus_mm, inst.projector.falloff, surface.alpha[k], surface.f0[k],
                surface.colours[j, k], tint, 0.01, value,
            )  # fmt: skip
            gain[k, j] = value
        to = self._centre - hits.point[k]
        cos = np.einsum("ij,ij->i", to, hits.normal[k]) / np.linalg.norm(to, axis=1)
        sigma[k] = self._blur(uvz[k, 2], surface.scatter[k] * np.sqrt(np.clip(cos, 0, 1)))
        mirrored = self._mirror(cam, surface, d, pixel, lamps) if self._mirrors else _nothing(len(lamps))
        return _Rays(surface, uvz[:, :2], light, sigma, gain, surface.colours[-1], mirrored)

    def _blur(self, depth: F64, spread_mm: F64) -> F64:
        """Standard deviation in plane units (along v) of projector light at `depth`, walked `spread_mm` sideways."""
        o, f = self.instrument.projector, float(self.instrument.rig.projector.lens.K[1, 1])
        defocus = optics.defocus_sigma(f, o.aperture_mm, o.focus_mm, depth)
        return np.asarray(np.sqrt(o.blur_units**2 + defocus**2 + (spread_mm * f / depth) ** 2))

    def _mirror(self, cam: Camera, surface: _Surface, d: F64, pixel: AnyArray, lamps: _Lights) -> _Sparse:
        """Fringes that a wet surface mirrors into the camera from what lies around it (the paper's case 2).

        Facets of roughness alpha have slopes of variance alpha^2 / 2 each way (Walter et al. 2007), which turn what is
        mirrored by twice as much in the plane of incidence, and by twice the cosine of incidence across it.
        """
        hits, inst = surface.hits, self.instrument
        ne = -np.einsum("ij,ij->i", surface.shiny, d)
        out = d + 2 * ne[:, None] * surface.shiny
        k = np.flatnonzero((surface.f0 > 0) & (ne > 0) & (np.einsum("ij,ij->i", out, hits.normal) > 0.02))
        if not k.size:
            return _nothing(len(lamps))
        second = trace(self.scene.shapes, hits.point[k] + 0.02 * hits.normal[k] + 0.01 * out[k], out[k])
        near = np.flatnonzero((second.shape >= 0) & (second.t < MIRROR_REACH))
        k = k[near]
        second = Hits(*(a[near] for a in (second.shape, second.t, second.point, second.normal)))
        uvz, light = self._to_projector(second)
        where = self._surface(cam, second, d[k], pixel[k], lamps)
        gain, value, none = np.empty((len(k), len(lamps))), np.empty(len(k)), np.zeros(len(k))
        for j in range(len(lamps)):
            loops.reflect(
                second.point, second.normal, where.shiny, out[k], self._centre, inst.rig.projector.pose.R[2],
                inst.projector.focus_mm, inst.projector.falloff, where.alpha, none, where.colours[j], none, 0.01, value,
            )  # fmt: skip
            gain[:, j] = value * optics.fresnel(surface.f0[k], ne[k]) * light
        keep = np.flatnonzero(gain[:, 0] > MIRROR_MIN)
        rough = surface.alpha[k[keep]] * np.sqrt(1 + ne[k[keep]] ** 2)
        sigma = self._blur(uvz[keep, 2], rough * second.t[keep])
        return _Sparse(pixel[k[keep]], *(a.astype(np.float32) for a in (*uvz[keep, :2].T, sigma, gain[keep])))

    def _lamps(self) -> F64:
        r = self.instrument.ring
        a = 2 * math.pi * (np.arange(r.lamps) + 0.5) / r.lamps
        return np.stack([r.radius * np.cos(a), r.radius * np.sin(a), np.full(r.lamps, r.height)], 1)

    def _ring_shadows(self, hits: Hits, width: int) -> Bool:
        """Which lamps of the ring reach whole rows of hits (lamps, n): traced at every second row and column, for it is
        soft.
        """
        index = np.arange(len(hits.t)).reshape(-1, width)
        few = index[::2, ::2].ravel()
        out = np.empty((self.instrument.ring.lamps, len(hits.t)), bool)
        ok = hits.shape[few] >= 0
        for i, lamp in enumerate(self._lamps()):
            see = np.zeros(len(few), bool)
            see[ok] = lit(self.scene.shapes, hits.point[few[ok]], hits.normal[few[ok]], lamp)
            grid = see.reshape(-1, (width + 1) // 2)
            out[i] = np.repeat(np.repeat(grid, 2, 0), 2, 1)[: len(index), :width].ravel()
        return out

    def _ring(self, cam: Camera, surface: _Surface, d: F64, seen: Bool, pixel: AnyArray) -> F64:
        """Ring-light signal (n,)."""
        r, hits = self.instrument.ring, surface.hits
        tint, total, value = self._response(cam, r.colour, pixel).sum(1), np.zeros(len(d)), np.empty(len(d))
        for lamp, reaches in zip(self._lamps(), seen, strict=True):
            loops.reflect(
                hits.point, hits.normal, surface.shiny, d, lamp, np.zeros(3), r.height, 0.0,
                surface.alpha, surface.f0, surface.colours[-2], tint, r.softness, value,
            )  # fmt: skip
            total += reaches * value
        return r.brightness / r.lamps * np.where(hits.shape >= 0, total, 0.0)


def _nothing(lamps: int) -> _Sparse:
    return _Sparse(np.empty(0, np.intp), *(np.empty(s, np.float32) for s in (0, 0, 0, (0, lamps))))


def _pixels(cam: Camera, index: AnyArray) -> F64:
    """Pixel numbers (n,) to coordinates (n, 2)."""
    return np.stack([index % cam.lens.width, index // cam.lens.width], 1).astype(np.float64)


def _joined(parts: list[_Sparse]) -> _Sparse:
    return _Sparse(*(np.concatenate(c) for c in zip(*parts, strict=True)))


def _reach(s: _Sparse, shape: tuple[int, int], aspect: float) -> F32:
    """Projector-plane units (along v, n) by which what is mirrored moves from a pixel to the next.

    Differences to the four neighbours, of those that mirror something too; a curved film spreads what it mirrors.
    """
    place = np.full(shape[0] * shape[1], -1, np.int32)
    place[s.pixel] = np.arange(s.pixel.size, dtype=np.int32)
    place = place.reshape(shape)
    total, count = np.zeros((2, s.pixel.size), np.float32), np.zeros((2, s.pixel.size), np.float32)
    for axis in (0, 1):
        low, high = ((slice(None),) * axis + (k,) for k in (slice(None, -1), slice(1, None)))
        a, b = place[low].ravel(), place[high].ravel()
        both = (a >= 0) & (b >= 0)
        a, b = a[both], b[both]
        length = ((s.u[a] - s.u[b]) / np.float32(aspect)) ** 2 + (s.v[a] - s.v[b]) ** 2
        for k in (a, b):
            total[axis][k] += length
            count[axis][k] += 1
    return np.asarray(np.sqrt(0.5 * (total / np.maximum(count, 1)).sum(0)), np.float32)


def _spread_out(s: _Sparse, aspect: float) -> _Sparse:
    """Light that is blurred by more than `MOST_BLUR`, from four places around instead, of the same total spread."""
    wide = s.sigma > MOST_BLUR
    if not wide.any():
        return s
    far = s._replace(**_pick(s, wide))
    off = np.sqrt(far.sigma**2 - np.float32(MOST_BLUR) ** 2)
    parts = [s._replace(**_pick(s, ~wide))]
    for du, dv in _quadrature(4).astype(np.float32):
        u, v = far.u + du * off * np.float32(aspect), far.v + dv * off
        parts.append(far._replace(u=u, v=v, sigma=np.full_like(off, MOST_BLUR), gain=far.gain * np.float32(0.25)))
    return _joined(parts)


def _pick(s: _Sparse, keep: Bool) -> dict[str, AnyArray]:
    return {name: getattr(s, name)[keep] for name in s._fields}


def _footprint(u: F32, v: F32, gain: F32, shape: AnyArray, aspect: float) -> tuple[F32, Bool]:
    """Projector-plane units (along v) per pixel (H, W), and where (H W,) a pixel's surroundings are not smooth.

    Not smooth: another shape, shadow or light beside it, a fifth more or less gain in a like-coloured neighbour, or
    bent (u, v).
    """
    bent = np.zeros(u.shape, np.float32)
    length = np.zeros(u.shape, np.float32)
    rough = np.zeros(u.shape, bool)
    for axis in (0, 1):
        for a, scale in ((u, 1 / aspect), (v, 1.0)):
            d = np.diff(a, axis=axis) * np.float32(scale)
            inner, first, last = ((slice(None),) * axis + (s,) for s in (slice(1, -1), slice(0, 1), slice(-1, None)))
            before, after = (d[(slice(None),) * axis + (s,)] for s in (slice(None, -1), slice(1, None)))
            bent[inner] = np.fmax(bent[inner], np.abs(after - before))
            length[inner] += 0.25 * (after + before) ** 2
            length[first] += d[first] ** 2
            length[last] += d[last] ** 2
        for step in (1, 2):
            low, high = ((slice(None),) * axis + (s,) for s in (slice(None, -step), slice(step, None)))
            other = (shape[low] != shape[high]) | ((gain[low] > 0) != (gain[high] > 0))
            if step == 2:
                other |= np.abs(gain[low] - gain[high]) > 0.2 * np.maximum(gain[low], gain[high])
            rough[low] |= other
            rough[high] |= other
    rough |= ~(bent < MOST_BEND) & (gain > 0)
    return np.sqrt(0.5 * np.where(rough, 0, length)), rough.ravel()


def _quadrature(rays: int) -> F64:
    """Offsets (rays, 2) of equal weight whose mean is 0 and whose covariance is 1; no two alike along either axis."""
    if rays == 1:
        return np.zeros((1, 2))
    if rays == 4:
        return np.array([[1.0, 3], [3, -1], [-1, -3], [-3, 1]]) / math.sqrt(5)
    i = np.arange(16)
    reverse = (i & 1) * 8 + (i & 2) * 2 + (i & 4) // 2 + (i & 8) // 8  # Hammersley's points, made normal
    x = ndtri((np.stack([i, reverse], 1) + 0.5) / 16)
    values, vectors = np.linalg.eigh(np.cov(x.T, bias=True))
    return np.asarray(x @ vectors / np.sqrt(values) @ vectors.T)
