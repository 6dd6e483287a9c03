"""Slow, obvious twins of `kernels/guiding.py`."""

import numpy as np


def relief(screen, faces, shape):
    """Depth of the nearest triangle at every unit: every triangle at every unit, by barycentric coordinates."""
    h, w = shape
    out = np.full(shape, np.inf)
    for a, b, c in faces:
        P = screen[[a, b, c]]
        if not np.isfinite(P).all() or (P[:, 2] <= 0).any():
            continue
        M = np.vstack([P[:, :2].T, np.ones(3)])
        if abs(np.linalg.det(M)) < 1e-12:
            continue
        for v in range(h):
            for u in range(w):
                share = np.linalg.solve(M, [u, v, 1.0])
                if (share >= -1e-9).all():
                    out[v, u] = min(out[v, u], 1 / (share / P[:, 2]).sum())
    return out


def drape(grid_xyz, reasons, sigma, pixel, origin, ray, half, slope):
    """Range of one place of a picture, by numpy's least squares over the points that continue the nearest one."""
    H, W = reasons.shape
    c, r = np.floor(np.asarray(pixel) + 0.5).astype(int)
    if not (0 <= c < W and 0 <= r < H) or reasons[r, c] != 0:
        return np.full(3, np.nan)
    near = np.linalg.norm(grid_xyz[r, c] - origin)
    rows = []
    for row in range(max(r - half, 0), min(r + half, H - 1) + 1):
        for col in range(max(c - half, 0), min(c + half, W - 1) + 1):
            if reasons[row, col] != 0:
                continue
            d = grid_xyz[row, col] - origin
            far = np.linalg.norm(d)
            cosine = d @ (grid_xyz[r, c] - origin) / far / near
            aside = near * np.sqrt(max(1 - cosine**2, 0))
            if abs(far - near) <= slope * aside + 5 * sigma[row, col]:
                rows.append([1.0, col - pixel[0], row - pixel[1], far])
    rows = np.array(rows)
    fit = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0][0] if len(rows) >= 4 else near
    return origin + fit * ray


def ribbon_share(parts, u, v, diamond, fine=41):
    """Share of the pixel at (u, v) that lies within a ribbon, by points: a unit square, or |du| + |dv| <= 1."""
    if diamond:
        a = np.linspace(-1, 1, fine)
        du, dv = np.meshgrid(a, a)
        ok = np.abs(du) + np.abs(dv) <= 1
    else:
        a = (np.arange(fine) + 0.5) / fine - 0.5
        du, dv = np.meshgrid(a, a)
        ok = np.ones(du.shape, bool)
    p = np.stack([u + du[ok], v + dv[ok]], 1)
    inside = np.zeros(len(p), bool)
    for u0, v0, h0, u1, v1, h1 in parts:
        q, d = np.array([u0, v0]), np.array([u1 - u0, v1 - v0])
        t = np.clip((p - q) @ d / max(d @ d, 1e-12), 0, 1)
        inside |= np.linalg.norm(p - q - t[:, None] * d, axis=1) <= h0 + t * (h1 - h0)
    return inside.mean()
