"""Specimens before and after a cut: exact rays of the twin with noise along them, or the whole chain of pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fringescope import patterns, pipeline
from fringescope.settings import Settings
from fringescope.twin import optics, render, scene, shapes
from fringescope.twin.presets import Instrument
from fringescope.twin.shapes import Mesh
from fringescope.types import F64, Cloud, Pose, Scan, ViewInput

PATHS = {
    "groove": ([(-20.0, -4.0), (0.0, 2.0), (20.0, -2.0)], 2.0, 2.0),
    "pocket": ([(-14.0, -8.0), (-2.0, -9.0), (0.0, 3.0), (-12.0, 5.0)], 1.5, 2.0),
    "wedge": ([(45.0, -8.0), (0.0, -3.0), (-45.0, -6.0)], 2.0, 6.0),
}


def turn(w) -> F64:
    """The rotation about w by |w| radians."""
    w = np.asarray(w, dtype=float)
    a = np.linalg.norm(w)
    if a == 0:
        return np.eye(3)
    k = w / a
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(a) * K + (1 - np.cos(a)) * K @ K


def motion(rng, mm: float, deg: float, flat: bool = False) -> Pose:
    """A random motion of that size about the origin; `flat`: on the tray, about z."""
    axis = np.array([0.0, 0, 1]) if flat else rng.standard_normal(3)
    shift = rng.standard_normal(3)
    shift[2] = 0.0 if flat else 0.3 * shift[2]
    R = turn(axis / np.linalg.norm(axis) * np.radians(deg))
    return Pose(R, mm * shift / np.linalg.norm(shift))


def moved(view: scene.Scene, T: Pose) -> scene.Scene:
    """The specimen of a scene moved by p -> R p + t; the tray stays."""
    there = [
        Mesh(s.finish, s.vertices @ T.R.T + T.t, s.normals @ T.R.T, s.faces) if isinstance(s, Mesh) else s
        for s in view.shapes
    ]
    return replace(view, shapes=tuple(there))


def traced(view: scene.Scene, inst: Instrument, rng, sigma: float = 0.005, drop=None) -> Cloud:
    """What the cameras would measure: exact hits of every pixel that the projector lights, with noise along the rays.

    Surfaces seen or lit at more than 78 degrees are lost, as they are in pictures. `drop` (n, 3) -> (n,): more that is.
    """
    light = -inst.rig.projector.pose.R.T @ inst.rig.projector.pose.t
    xyz, normals, views = [], [], []
    for k, cam in enumerate(inst.rig.cameras):
        v, u = np.mgrid[: cam.lens.height, : cam.lens.width].astype(float)
        origin, d = optics.look(cam.lens, cam.pose, np.stack([u.ravel(), v.ravel()], 1))
        hits = shapes.trace(view.shapes, origin, d)
        to = light - hits.point
        to /= np.linalg.norm(to, axis=1, keepdims=True)
        steep = np.cos(np.radians(78))
        ok = (hits.shape >= 0) & (np.einsum("ij,ij->i", to, hits.normal) > steep)
        ok &= -np.einsum("ij,ij->i", d, hits.normal) > steep
        uvz = optics.land(inst.rig.projector.lens, inst.rig.projector.pose, hits.point)
        w, h = inst.rig.projector.plane_size
        ok &= (uvz[:, 0] > 3) & (uvz[:, 1] > 3) & (uvz[:, 0] < w - 4) & (uvz[:, 1] < h - 4)
        i = np.flatnonzero(ok)
        i = i[shapes.lit(view.shapes, hits.point[i], hits.normal[i], light)]
        p = hits.point[i] + sigma * rng.standard_normal(len(i))[:, None] * d[i]
        n = hits.normal[i] + 0.01 * rng.standard_normal((len(i), 3))
        keep = np.ones(len(i), bool) if drop is None else ~drop(hits.point[i])
        xyz.append(p[keep])
        normals.append((n / np.linalg.norm(n, axis=1, keepdims=True))[keep])
        views.append(np.full(keep.sum(), k, np.uint8))
    points = np.concatenate(xyz).astype(np.float32)
    n = len(points)
    return Cloud(points, np.concatenate(normals).astype(np.float32), np.full((n, 3), 150, np.uint8),
                 np.full(n, sigma, np.float32), np.concatenate(views))  # fmt: skip


def photographed(view: scene.Scene, inst: Instrument, seed: int, surface: bool = False, rays: int | None = None,
                 mirrors: bool = True) -> Scan:  # fmt: skip
    """The whole chain: pictures with noise, decoded, masked, fused."""
    r = render.Renderer(view, inst, rays, mirrors)
    formats = {c.name: f for c, f in zip(inst.rig.cameras, inst.pixel_formats, strict=True)}
    views = []
    for i, one in enumerate(patterns.paper_plan(inst.rig, formats).views):
        rng = np.random.default_rng([seed, i])
        frames = [(k, r.frame(one.camera, im, rng)) for k, im in patterns.images(one, inst.rig.projector)]
        views.append(ViewInput(one, frames, r.frame(one.camera, None, rng, ring=1.0)))
    return pipeline.scan(views, inst.rig, Settings(), surface=surface)


def draped(view: scene.Scene, xy) -> F64:
    """Points (n, 3) of a height field's surface above points (n, 2): bilinear on its vertices."""
    mesh = next(s for s in view.shapes if isinstance(s, Mesh))
    n = round(len(mesh.vertices) ** 0.5)
    x, y, z = (mesh.vertices[:, k].reshape(n, n) for k in range(3))
    xy = np.asarray(xy, dtype=float)
    u = np.clip((xy[:, 0] - x[0, 0]) / (x[0, -1] - x[0, 0]) * (n - 1), 0, n - 1.001)
    v = np.clip((xy[:, 1] - y[0, 0]) / (y[-1, 0] - y[0, 0]) * (n - 1), 0, n - 1.001)
    i, j = v.astype(int), u.astype(int)
    a, b = v - i, u - j
    z = np.maximum(z, float(view.truth["tissue.json"]["base_z"]))
    low = z[i, j] * (1 - b) + z[i, j + 1] * b
    return np.column_stack([xy, low * (1 - a) + (z[i + 1, j] * (1 - b) + z[i + 1, j + 1] * b) * a])


def line(path, closed: bool = False, step: float = 0.25) -> F64:
    """A path (m, 2) with points `step` mm apart."""
    p = np.asarray(path, dtype=float)
    if closed:
        p = np.vstack([p, p[:1]])
    along = np.r_[0, np.cumsum(np.hypot(*np.diff(p, axis=0).T))]
    u = np.arange(0, along[-1], step)
    return np.column_stack([np.interp(u, along, p[:, k]) for k in (0, 1)])
