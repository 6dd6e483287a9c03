"""Analytic scenes as organised grids: rays of a small rig meet exact shapes; noise of known sigma along the rays."""

import numpy as np

from fringescope import geometry
from fringescope.types import Camera, Grid, Layout, Lens, Photo, Pose, Projector, Rig


def look_at(eye, target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)):
    """Pose of a device at `eye` that looks at `target`."""
    eye = np.asarray(eye, float)
    z = np.asarray(target, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ eye)


def rig(cameras=3, width=160, height=120, tilt_deg=30.0):
    """A projector 300 mm above the origin and cameras around it, 40 x 30 mm in view, all lenses distorted."""
    projector = Projector(
        200,
        160,
        Layout.GRID,
        Lens(200, 160, np.array([[1450.0, 0, 99], [0, 1450.0, 81], [0, 0, 1]]), np.array([-0.05, 0.1, 1e-4, 2e-4, 0])),
        look_at([0, 0, 300.0]),
    )
    made = []
    t = np.radians(tilt_deg)
    for i in range(cameras):
        a = 2 * np.pi * i / cameras - np.pi / 2
        eye = 320 * np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
        f = 8.0 * width
        K = np.array([[f, 0, width / 2 - 0.3], [0, f * 1.001, height / 2 + 0.4], [0, 0, 1]])
        made.append(
            Camera(f"camera{i + 1}", Lens(width, height, K, np.array([-0.2, 1.5, 2e-4, -1e-4, 0])), look_at(eye))
        )
    return Rig(projector, tuple(made))


def plane(normal=(0.05, 0.1, 1.0), offset=1.0):
    """First hit of rays on a plane."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)

    def hit(o, d):
        return (offset - n @ o) / (d @ n)

    hit.error = lambda p: p @ n - offset
    return hit


def ball(radius=6.0, centre=(0.0, 0.0, 4.0), floor=-2.0):
    """First hit of rays on a ball above a floor."""
    c = np.asarray(centre, float)

    def hit(o, d):
        t = (floor - o[2]) / d[..., 2]
        b, q = d @ (c - o), (c - o) @ (c - o) - radius**2
        root = b * b - q
        near = np.where(root > 0, b - np.sqrt(np.maximum(root, 0)), np.inf)
        return np.minimum(t, near)

    def error(p):
        e = np.linalg.norm(p - c, axis=-1) - radius
        f = p[..., 2] - floor
        return np.where(abs(e) < abs(f), e, f)

    hit.error = error
    return hit


def step(height=1.0):
    """First hit of rays on a step: z = height where x < 0, z = 0 where x > 0, and the wall between."""

    def hit(o, d):
        best = np.full(d.shape[:-1], np.inf)
        for level, side in ((height, -1), (0.0, 1)):
            t = (level - o[2]) / d[..., 2]
            best = np.minimum(best, np.where(side * (o[0] + t * d[..., 0]) >= 0, t, np.inf))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -o[0] / d[..., 0]
            z = o[2] + t * d[..., 2]
        return np.minimum(best, np.where((t > 0) & (z > 0) & (z < height), t, np.inf))

    hit.error = lambda p: np.where(p[..., 0] < 0, p[..., 2] - height, p[..., 2])
    return hit


def grid(r, view, hit, sigma=0.005, rng=None, keep=None):
    """What camera `view` measures of a scene: lit and visible points, moved along their rays by noise."""
    cam = r.cameras[view]
    H, W = cam.lens.height, cam.lens.width
    v, u = np.mgrid[:H, :W].astype(float)
    o, d = geometry.world_rays(cam, np.stack([u, v], -1))
    t = hit(o, d)
    p = o + t[..., None] * d
    light = geometry.centre(r.projector.pose)
    ray = p - light
    far = np.linalg.norm(ray, axis=-1)
    lit = hit(light, ray / far[..., None]) > far - 1e-3
    uv = geometry.project(r.projector, p)
    with np.errstate(invalid="ignore"):
        ok = (
            lit
            & np.isfinite(t)
            & (uv > 0).all(-1)
            & (uv[..., 0] < r.projector.plane_size[0] - 1)
            & (uv[..., 1] < r.projector.plane_size[1] - 1)
        )
    if keep is not None:
        ok &= keep(p, u, v)
    if rng is not None:
        p = p + (sigma * rng.standard_normal(t.shape))[..., None] * d
    xyz = np.where(ok[..., None], p, np.nan).astype(np.float32)
    return Grid(
        view, cam.name, xyz, np.where(ok, sigma, np.nan).astype(np.float32), np.where(ok, 0, 1).astype(np.uint16)
    )


def paint(p):
    """Colour in linear light, smooth and different everywhere, of world points."""
    x, y = p[..., 0], p[..., 1]
    return np.stack([0.4 + 0.01 * x, 0.35 + 0.012 * y, 0.3 + 0.1 * np.sin(x / 3) * np.cos(y / 4)], -1)


def photo(g, gain=(1.0, 1.0, 1.0), rng=None, noise=0.0):
    """The picture of a grid's camera, painted; grey where there is no point."""
    with np.errstate(invalid="ignore"):
        rgb = np.where(np.isfinite(g.xyz[..., :1]), paint(g.xyz.astype(float)), 0.2) * np.asarray(gain)
    if rng is not None:
        rgb = rgb + noise * rng.standard_normal(rgb.shape)
    return Photo(g.camera, rgb.astype(np.float32), np.zeros(g.sigma.shape, bool))


def seen(fused):
    """Which views see the points (H, W) that each view owns; 0 elsewhere."""
    out, first = [], 0
    for own in fused.owned:
        n = int(own.sum())
        one = np.zeros(own.shape, np.uint8)
        one[own] = fused.seen[first : first + n]
        out.append(one)
        first += n
    return out
