"""Slow, obvious twins of kernels/surface.py and kernels/mesh.py."""

import numpy as np


def normal(xyz, sigma, centre, i, j, radius, max_slope, jump_sigma):
    """Normal of pixel (i, j): least squares of its window's points on their pixel coordinates."""
    p = xyz[i, j].astype(float)
    ray = (p - centre) / np.linalg.norm(p - centre)
    rows, points = [], []
    for ii in range(max(i - radius, 0), min(i + radius + 1, xyz.shape[0])):
        for jj in range(max(j - radius, 0), min(j + radius + 1, xyz.shape[1])):
            q = xyz[ii, jj].astype(float) - p
            if not np.isfinite(q).all():
                continue
            along = q @ ray
            across = np.linalg.norm(q - along * ray)
            if abs(along) <= max_slope * across + jump_sigma * (float(sigma[i, j]) + float(sigma[ii, jj])):
                rows.append([1.0, jj - j, ii - i])
                points.append(q)
    A = np.array(rows)
    if len(rows) < 3 or np.linalg.matrix_rank(A) < 3:
        return -ray
    fit = np.linalg.lstsq(A, np.array(points), rcond=None)[0]
    n = np.cross(fit[1], fit[2])
    n /= np.linalg.norm(n)
    return n if n @ ray < 0 else -n


def blend(colours, weights, gloss):
    """One pixel's blended colour from the views' colours (n, 3) and weights (n,); the first is its own."""
    colours, weights = np.asarray(colours, float), np.asarray(weights, float)
    if not (weights > 0).any():
        return colours[0]
    light = colours.mean(axis=1) + 1e-3
    use = weights > 0
    low = (weights[use].sum() / (weights[use] / light[use] ** 4).sum()) ** 0.25
    w = np.where(use, weights / (1 + (np.maximum(light - low, 0) / (gloss * low)) ** 2), 0)
    return (w[:, None] * colours).sum(0) / w.sum()


def doubles(ab, view, reach, order):
    """Points dropped, in the given order, because a kept point of another view lies within their reach."""
    out = np.zeros(len(ab), bool)
    for a in order:
        for b in range(len(ab)):
            if view[b] != view[a] and not out[b] and np.linalg.norm(ab[a] - ab[b]) < reach:
                out[a] = True
    return out


def on_surface(face, xyz, normals, sigma, reach, max_edge, jump_slope, jump_sigma):
    """Whether a triangle bridges no hole, shadow or jump."""
    for a, b in ((0, 1), (1, 2), (2, 0)):
        a, b = face[a], face[b]
        d = xyz[b].astype(float) - xyz[a].astype(float)
        m = normals[a].astype(float) + normals[b].astype(float)
        noise = np.hypot(sigma[a], sigma[b])
        if np.linalg.norm(d) > max_edge * max(reach[a], reach[b]) or np.linalg.norm(m) <= 0.2:
            return False
        if abs(d @ m) / np.linalg.norm(m) > jump_slope * np.linalg.norm(d) + jump_sigma * noise:
            return False
    return True


def fans(faces, v):
    """The fans of triangles around vertex v: lists of triangles, those that share an edge at v together."""
    around = [f for f in range(len(faces)) if v in faces[f]]
    groups = [[f] for f in around]
    while True:
        for x in range(len(groups)):
            for y in range(x):
                if any(len(set(faces[a]) & set(faces[b])) >= 2 for a in groups[x] for b in groups[y]):
                    groups[y] += groups.pop(x)
                    break
            else:
                continue
            break
        else:
            return groups
