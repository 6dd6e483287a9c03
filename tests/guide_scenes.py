"""Analytic surfaces made ready for guidance, and strokes whose truth is known."""

import numpy as np

from fringescope import fuse, geometry, guide
from fringescope.settings import Settings
from fringescope.types import Guidelines, Layout, Lens, Projector, Rig
from tests import fuse_scenes

S = Settings()


def diamond(r):
    """The same rig with a projector of diamond mirrors, half of them in a row for the same plane."""
    p = r.projector
    K = p.lens.K * np.array([[2.0], [2.0], [1.0]])
    K[2] = [0, 0, 1]
    lens = Lens(2 * p.width, 2 * p.height, K, p.lens.distortion)
    return Rig(Projector(p.width, 2 * p.height, Layout.DIAMOND, lens, p.pose), r.cameras)


def tissue(hit, r=None, sigma=0.004, rng=None, keep=None, s=S):
    """What `fuse_scenes.rig` measures of a surface, fused and meshed as a scan is."""
    r = r or fuse_scenes.rig()
    grids = [fuse_scenes.grid(r, v, hit, sigma, rng, keep) for v in range(len(r.cameras))]
    fused = fuse.merge(grids, [fuse_scenes.photo(g) for g in grids], r, s.fuse)
    return guide.tissue(grids, fuse.surface(fused, r, s.mesh)[0], r, s.guide)


def one(stroke, t, s=S, **how):
    """A single stroke's record and the picture."""
    made = guide.guide(Guidelines((stroke,)), t, s.guide, **how)
    return made.strokes[0], made.image


def land(hit, projector, uv):
    """Where the projector's rays through (n, 2) meet a surface: (n, 3)."""
    o, d = geometry.world_rays(projector, uv)
    return o + hit(o, d)[:, None] * d


def seen_by(hit, camera, pixels):
    """Where a camera's rays through pixels (n, 2) meet a surface: (n, 3)."""
    o, d = geometry.world_rays(camera, pixels)
    return o + hit(o, d)[:, None] * d


def to_line(q, line):
    """Distances of points (n, d) from a polyline (m, d)."""
    a, ab = line[:-1], np.diff(line, axis=0)
    t = np.clip(((q[:, None] - a) * ab).sum(2) / np.maximum((ab**2).sum(1), 1e-15), 0, 1)
    return np.linalg.norm(q[:, None] - (a + t[..., None] * ab), axis=2).min(1)
