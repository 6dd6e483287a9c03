"""Pictures of a scene: geometry once per camera, then every pattern is a lookup of light.

A pixel's signal is a sum over its rays of gain times projector light at the ray's (u, v), plus steady light. Rays per
pixel sit where their second moments equal those of the pixel's area and the camera's defocus disc, so blur costs nothing and moves no phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fringescope.errors import RigError, UsageError
from fringescope.twin import loops, optics
from fringescope.twin.presets import Instrument
from fringescope.twin.scene import Scene
from fringescope.twin.shapes import Hits, lit, trace
from fringescope.types import F32, F64, U8, AnyArray, Bool, Camera, PixelFormat

TILE = 150_000  #: rays traced at a time
MIRROR_MIN = 2e-4  #: mirrored light below this share of a white surface's is left out


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """What every pixel centre of a camera sees: arrays (H, W).

    `xyz` (H, W, 3) world mm and `uv` (H, W, 2) projector plane, NaN where nothing is hit; `lit`: the projector reaches the
    point; `mirrored`: share of the pixel's projector light that came by way of another surface; `shape`: index or -1.
    """

    xyz: F64
    uv: F64
    lit: Bool
    mirrored: F32
    shape: AnyArray


class _Sparse(NamedTuple):
    pixel: AnyArray
    u: F32
    v: F32
    sigma: F32
    gain: F32


class _Shaded(NamedTuple):
    """Rays (k,): their hits, projector coordinates, blur in plane units and gain per sensor channel (k, channels)."""

    hits: Hits
    uv: F64
    visible: Bool
    sigma: F64
    gain: F64


@dataclass(frozen=True, eq=False)
class _View:
    """Geometry of one camera: ray arrays (pixels, rays), steady and ring-light signal (pixels,)."""

    u: F32
    v: F32
    sigma: F32
    gain: F32
    mirrored: _Sparse
    steady: F32
    ring: F32


class Renderer:
    """Renders one scene through one instrument; keeps each camera's geometry once it has been needed.

    `rays`: per pixel, 1, 4 or 9; None takes 4 up to a million pixels and 1 beyond. `mirrors`: whether wet surfaces
    mirror what lies around them.
    """

    def __init__(self, scene: Scene, instrument: Instrument, rays: int | None = None, mirrors: bool = True) -> None:
        if rays not in (None, 1, 4, 9):
            raise UsageError(f"rays {rays}; needed 1, 4 or 9 per pixel")
        self.scene, self.instrument = scene, instrument
        self._rays, self._mirrors = rays, mirrors
        self._views: dict[str, _View] = {}
        projector = instrument.rig.projector
        self._aspect = float(projector.lens.K[0, 0] / projector.lens.K[1, 1])
        self._centre = -projector.pose.R.T @ projector.pose.t
        self._reference = float(instrument.projector.focus_mm)

    # ---------------------------------------------------------------------------------------------------- pictures

    def signal(self, camera: str, image: U8 | None, ring: float = 0.0, leds: float = 1.0) -> F32:
        """Noise-free signal (H, W) while the projector shows `image` (None: lamp off); 1 = a white surface fully lit.

        `ring`: level of the ring light, 0..1; `leds`: brightness of the projector's lamp, 0..1.
        """
        cam = self.instrument.rig.camera(camera)
        view = self._view(cam)
        out = np.empty(view.u.shape[0], dtype=np.float32)
        steady = view.steady + np.float32(ring * self.scene.ring) * view.ring if ring else view.steady
        if image is None:
            out[:] = steady
        else:
            light = optics.mirror_light(image, self.instrument.rig.projector, self.instrument.projector)
            stack = self._stack(view)
            fine, coarse = stack.build(light * np.float32(leds * self.scene.lamp))
            m = np.float32(optics.MARGIN)
            loops.gather(fine, coarse, view.u + m, view.v + m, stack.level(view.sigma), view.gain, steady, out)
            s = view.mirrored
            if s.pixel.size:
                level = stack.level(s.sigma)
                loops.gather_sparse(fine, coarse, s.pixel, s.u + m, s.v + m, level, s.gain, out)
        return out.reshape(cam.lens.height, cam.lens.width)

    def frame(
        self,
        camera: str,
        image: U8 | None,
        rng: np.random.Generator | None,
        exposure_us: float | None = None,
        ring: float = 0.0,
        gain: float = 1.0,
        leds: float = 1.0,
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
        one = Renderer(self.scene, self.instrument, rays=1, mirrors=self._mirrors)
        xyz, uv = np.empty((h * w, 3)), np.empty((h * w, 2))
        light, shape = np.empty(h * w, bool), np.empty(h * w, np.int32)
        for rows in one._tiles(cam, 1):
            p = one._pixels(cam, rows)
            origin, d = optics.look(cam.lens, cam.pose, p)
            hits = trace(self.scene.shapes, origin, d)
            k = slice(rows.start * w, rows.stop * w)
            seen = one._to_projector(hits)
            hit = hits.shape >= 0
            xyz[k] = np.where(hit[:, None], hits.point, np.nan)
            uv[k] = np.where(hit[:, None], seen[0][:, :2], np.nan)
            light[k], shape[k] = seen[1], hits.shape
        view = one._view(cam)
        direct = view.gain.sum(1)
        stray = np.bincount(view.mirrored.pixel, view.mirrored.gain, h * w)
        with np.errstate(invalid="ignore"):
            share = np.where(direct + stray > 0, stray / (direct + stray), 0).astype(np.float32)
        return ViewTruth(
            xyz.reshape(h, w, 3), uv.reshape(h, w, 2), light.reshape(h, w), share.reshape(h, w), shape.reshape(h, w)
        )

    def forget(self, camera: str | None = None) -> None:
        """Drops the geometry kept for one camera, or for all."""
        for name in [camera] if camera else list(self._views):
            self._views.pop(name, None)

    # ---------------------------------------------------------------------------------------------------- geometry

    def rays_of(self, cam: Camera) -> int:
        """Rays per pixel for a camera."""
        return self._rays or (4 if cam.lens.width * cam.lens.height <= 1_000_000 else 1)

    def _stack(self, view: _View) -> optics.LightStack:
        used = view.sigma[view.gain > 0]
        low, high = (float(used.min()), float(used.max())) if used.size else (1.0, 1.0)
        if view.mirrored.sigma.size:
            high = max(high, float(view.mirrored.sigma.max()))
        return optics.LightStack(optics.blur_levels(low, min(high, 24.0)), self._aspect)

    def _tiles(self, cam: Camera, rays: int) -> list[slice]:
        step = max(2, TILE // (cam.lens.width * rays) // 2 * 2)
        return [slice(r, min(r + step, cam.lens.height)) for r in range(0, cam.lens.height, step)]

    def _pixels(self, cam: Camera, rows: slice) -> F64:
        x, y = np.meshgrid(np.arange(cam.lens.width, dtype=np.float64), np.arange(rows.start, rows.stop))
        return np.stack([x.ravel(), y.ravel()], 1)

    def _channel(self, cam: Camera, pixels: F64) -> AnyArray:
        """Index of the sensor channel of each pixel (n,): RGGB, or 0 for a mono sensor."""
        if not self.instrument.pixel_formats[self.instrument.rig.index(cam.name)].is_bayer:
            return np.zeros(len(pixels), np.intp)
        return (pixels.astype(np.intp) % 2).sum(1)

    def _view(self, cam: Camera) -> _View:
        if cam.name not in self._views:
            self._views[cam.name] = self._make(cam)
        return self._views[cam.name]

    def _make(self, cam: Camera) -> _View:
        n, s = cam.lens.width * cam.lens.height, self.rays_of(cam)
        u, v, sigma, gain = (np.zeros((n, s), np.float32) for _ in range(4))
        steady, ring = np.zeros(n, np.float32), np.zeros(n, np.float32)
        found: list[_Sparse] = []
        offsets, weights = _quadrature(s)
        for rows in self._tiles(cam, s):
            pixels = self._pixels(cam, rows)
            k = slice(rows.start * cam.lens.width, rows.stop * cam.lens.width)
            origin, d = optics.look(cam.lens, cam.pose, pixels)
            middle = trace(self.scene.shapes, origin, d)
            spread = self._spread(cam, middle, origin, d)
            channel = self._channel(cam, pixels)
            for j in range(s):
                if s > 1:
                    origin, d = optics.look(cam.lens, cam.pose, pixels + spread[:, None] * offsets[j])
                    hits = trace(self.scene.shapes, origin, d)
                else:
                    hits = middle
                shaded, room = self._shade(cam, hits, d, channel)
                u[k, j], v[k, j] = shaded.uv[:, 0], shaded.uv[:, 1]
                sigma[k, j], gain[k, j] = shaded.sigma, shaded.gain * weights[j]
                steady[k] += weights[j] * room
                if self._mirrors:
                    extra = self._mirror(cam, hits, d, channel)
                    if extra is not None:
                        found.append(extra._replace(pixel=extra.pixel + k.start, gain=extra.gain * weights[j]))
            ring[k] = self._ring(cam, middle, d if s == 1 else optics.look(cam.lens, cam.pose, pixels)[1], channel, rows)
        dark = ~((gain > 0) & np.isfinite(u))
        for a in (u, v, sigma, gain):
            a[dark] = 0.0
        sparse = _Sparse(*(np.concatenate(c) for c in zip(*found, strict=True))) if found else _EMPTY
        return _View(u, v, sigma, gain, sparse, steady, ring)

    def _spread(self, cam: Camera, hits: Hits, origin: F64, d: F64) -> F64:
        """Standard deviation (n,) in pixels of pixel area and defocus together."""
        o = self.instrument.camera
        depth = np.where(hits.shape >= 0, (hits.point - origin) @ cam.pose.R[2], o.focus_mm)
        f = 0.5 * (cam.lens.K[0, 0] + cam.lens.K[1, 1])
        blur = optics.defocus_sigma(f, o.aperture_mm, o.focus_mm, depth)
        return np.sqrt(1.0 / 12.0 + blur**2)

    def _to_projector(self, hits: Hits) -> tuple[F64, Bool]:
        """(u, v, depth) (n, 3) of hits on the projector plane, and whether the projector reaches them."""
        p = self.instrument.rig.projector
        uvz = optics.land(p.lens, p.pose, hits.point)
        w, h = p.plane_size
        m = optics.MARGIN - 2
        with np.errstate(invalid="ignore"):
            ok = (hits.shape >= 0) & (uvz[:, 0] > -m) & (uvz[:, 0] < w - 1 + m) & (uvz[:, 1] > -m) & (uvz[:, 1] < h - 1 + m)
        k = np.flatnonzero(ok)
        ok[k] = lit(self.scene.shapes, hits.point[k], hits.normal[k], self._centre)
        return uvz, ok

    def _irradiance(self, points: F64, normals: F64) -> tuple[F64, F64]:
        """Projector light on surfaces facing it (n,): 1 at the focus distance, straight on; and unit vectors towards it."""
        to = self._centre - points
        r = np.linalg.norm(to, axis=1)
        to = to / r[:, None]
        axis = -to @ self.instrument.rig.projector.pose.R[2]
        cos = np.clip(np.einsum("ij,ij->i", to, normals), 0, 1)
        return (self._reference / r) ** 2 * np.clip(axis, 0, 1) ** self.instrument.projector.falloff * cos, to

    def _surface(self, hits: Hits) -> tuple[F64, F64, F64, F64, F64]:
        """Per hit: albedo (n, 3), roughness, mirrored share, scattering length (n,) and the normal that gloss sees."""
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
                slope = f.bumps(p)
                b = shiny[k]
                b[:, :2] += slope[:, :2] * np.abs(b[:, 2:])
                shiny[k] = b / np.linalg.norm(b, axis=1, keepdims=True)
        return albedo, alpha, f0, scatter, shiny

    def _falloff(self, cam: Camera, d: F64) -> F64:
        return np.clip(d @ cam.pose.R[2], 0, 1) ** self.instrument.camera.falloff

    def _colour(self, cam: Camera, colour: tuple[float, float, float]) -> F64:
        """Response of each sensor channel (c, 3) to surface colour under a light; green (or mono) white gives 1."""
        fmt = self.instrument.pixel_formats[self.instrument.rig.index(cam.name)]
        M = self.instrument.sensor.response(fmt)
        return np.asarray(M * np.asarray(colour) / M[len(M) // 2].sum())

    def _shade(self, cam: Camera, hits: Hits, d: F64, channel: AnyArray) -> tuple[_Shaded, F64]:
        """Direct projector light of each ray, and the room's steady light (n,)."""
        uvz, visible = self._to_projector(hits)
        albedo, alpha, f0, scatter, shiny = self._surface(hits)
        fall = self._falloff(cam, d)
        room_M, M = self._colour(cam, self.instrument.ambient), self._colour(cam, self.instrument.projector_colour)
        room = fall * np.einsum("ij,ij->i", albedo, room_M[channel])
        gain, sigma = np.zeros(len(d)), np.ones(len(d))
        k = np.flatnonzero(visible)
        if k.size:
            E, to = self._irradiance(hits.point[k], hits.normal[k])
            eye = -d[k]
            ne = np.einsum("ij,ij->i", hits.normal[k], eye)
            inside = (1 - optics.fresnel(f0[k], ne)) * (1 - f0[k])
            tint = M[channel[k]]
            cos = np.maximum(np.einsum("ij,ij->i", to, hits.normal[k]), 1e-3)
            shine = optics.gloss(shiny[k], to, eye, alpha[k], f0[k]) / cos
            gain[k] = fall[k] * E * (inside * np.einsum("ij,ij->i", albedo[k], tint) + shine * tint.sum(1))
            sigma[k] = self._blur(uvz[k, 2], scatter[k] * np.sqrt(cos))
        return _Shaded(hits, uvz[:, :2], visible, sigma, gain), room

    def _blur(self, depth: F64, spread_mm: F64) -> F64:
        """Standard deviation in plane units (along v) of projector light at `depth`, walked `spread_mm` sideways."""
        o, f = self.instrument.projector, float(self.instrument.rig.projector.lens.K[1, 1])
        return np.sqrt(
            o.blur_units**2 + optics.defocus_sigma(f, o.aperture_mm, o.focus_mm, depth) ** 2 + (spread_mm * f / depth) ** 2
        )

    def _mirror(self, cam: Camera, hits: Hits, d: F64, channel: AnyArray) -> _Sparse | None:
        """Fringes that a wet surface mirrors into the camera from what lies around it (the paper's case 2)."""
        _, alpha, f0, _, shiny = self._surface(hits)
        ne = -np.einsum("ij,ij->i", shiny, d)
        F = np.where((f0 > 0) & (ne > 0), optics.fresnel(f0, ne), 0.0)
        k = np.flatnonzero((F > 0.01) & (hits.shape >= 0))
        if not k.size:
            return None
        n = shiny[k]
        out = d[k] + 2 * ne[k, None] * n
        up = np.einsum("ij,ij->i", out, hits.normal[k]) > 0.02
        k, out, n = k[up], out[up], hits.normal[k][up]
        second = trace(self.scene.shapes, hits.point[k] + 0.02 * n + 0.01 * out, out)
        away = np.where(second.shape >= 0, second.t, 0.0)
        near = (second.shape >= 0) & (away < 60.0)
        k, away, out = k[near], away[near], out[near]
        second = Hits(*(a[near] for a in (second.shape, second.t, second.point, second.normal)))
        uvz, visible = self._to_projector(second)
        albedo, *_ = self._surface(second)
        E, _ = self._irradiance(second.point, second.normal)
        M = self._colour(cam, self.instrument.projector_colour)[channel[k]]
        g = self._falloff(cam, d[k]) * F[k] * E * np.einsum("ij,ij->i", albedo, M)
        keep = visible & (g > MIRROR_MIN)
        sigma = self._blur(uvz[keep, 2], 0.5 * alpha[k[keep]] * away[keep])
        u, v = uvz[keep, 0].astype(np.float32), uvz[keep, 1].astype(np.float32)
        return _Sparse(k[keep], u, v, sigma.astype(np.float32), g[keep].astype(np.float32))

    def _ring(self, cam: Camera, hits: Hits, d: F64, channel: AnyArray, rows: slice) -> F64:
        """Ring-light signal (n,) of pixel centres; shadows are traced at every second row and column, for they are soft."""
        r = self.instrument.ring
        albedo, alpha, f0, _, shiny = self._surface(hits)
        M = self._colour(cam, r.colour)[channel]
        w = cam.lens.width
        shape = (rows.stop - rows.start, w)
        index = np.arange(shape[0] * w).reshape(shape)
        sparse = index[::2, ::2].ravel()
        total = np.zeros(len(d))
        eye = -d
        for i in range(r.lamps):
            a = 2 * math.pi * (i + 0.5) / r.lamps
            lamp = np.array([r.radius * math.cos(a), r.radius * math.sin(a), r.height])
            to = lamp - hits.point
            far = np.linalg.norm(to, axis=1)
            to /= far[:, None]
            cos = np.clip(np.einsum("ij,ij->i", to, hits.normal), 0, 1)
            ok = hits.shape[sparse] >= 0
            see = np.zeros(len(sparse))
            see[ok] = lit(self.scene.shapes, hits.point[sparse[ok]], hits.normal[sparse[ok]], lamp)
            shadow = np.repeat(np.repeat(see.reshape(-1, (w + 1) // 2), 2, 0), 2, 1)[: shape[0], :w].ravel()
            shine = optics.gloss(shiny, to, eye, np.maximum(alpha, 0.18), f0)
            total += shadow * (r.height / far) ** 2 * (cos * np.einsum("ij,ij->i", albedo, M) + shine * M.sum(1))
        return np.where(hits.shape >= 0, self._falloff(cam, d) * r.brightness * total / r.lamps, 0.0)


_EMPTY = _Sparse(np.empty(0, np.intp), *(np.empty(0, np.float32) for _ in range(4)))


def _quadrature(rays: int) -> tuple[F64, F64]:
    """Offsets (rays, 2) in standard deviations and weights (rays,), of unit second moment along both axes."""
    if rays == 1:
        return np.zeros((1, 2)), np.ones(1)
    if rays == 4:
        return np.array([[-1.0, -1], [1, -1], [-1, 1], [1, 1]]), np.full(4, 0.25)
    if rays == 9:
        x, w = np.array([-math.sqrt(3), 0, math.sqrt(3)]), np.array([1, 4, 1]) / 6
        return np.array([[a, b] for b in x for a in x]), np.array([a * b for b in w for a in w])
    raise RigError(f"{rays} rays per pixel; needed 1, 4 or 9")
