"""Distances from points to triangles, by what is nearest: a corner, an edge or the inside."""

import numpy as np
from scipy.spatial import cKDTree


def to_segment(p, a, b):
    """Distances (n,) of points p (n, 3) from segments a to b (n, 3)."""
    d = b - a
    t = np.clip(((p - a) * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-30), 0, 1)
    return np.linalg.norm(p - a - t[..., None] * d, axis=-1)


def to_triangle(p, corner):
    """Distances (n,) of points p (n, 3) from one triangle each, corners (n, 3, 3)."""
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    n = np.cross(b - a, c - a)
    size = np.maximum(np.linalg.norm(n, axis=1), 1e-30)
    inside = np.ones(len(p), bool)
    for s, e in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(e - s, p - s) * n).sum(1) >= 0
    edge = np.minimum(np.minimum(to_segment(p, a, b), to_segment(p, b, c)), to_segment(p, c, a))
    return np.where(inside, np.abs(((p - a) * n).sum(1)) / size, edge)


def distances(p, corner, nearest=16):
    """Distances (n,) of points p (n, 3) from the triangles (m, 3, 3), of which the `nearest` by their middles count."""
    best = np.full(len(p), np.inf)
    for column in cKDTree(corner.mean(axis=1)).query(p, k=nearest)[1].T:
        best = np.minimum(best, to_triangle(p, corner[column]))
    return best
