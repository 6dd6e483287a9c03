"""Slow, obvious twins of kernels/regions.py: loops over pixels, scipy's graphs, least squares, OpenCV's projection."""

import math

import cv2
import numpy as np
from scipy import ndimage
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def spread(field, shape):
    """A coarse field (h, w, C) corner on corner at every pixel of an image (H, W, C)."""
    h, w, _ = field.shape
    at = RegularGridInterpolator((np.linspace(0, 1, h), np.linspace(0, 1, w)), field)
    y, x = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    return at(np.stack([y, x], -1))


def gradient_signs(phase, sigma, reasons, field, reach, significance):
    """Sign of the growth of the phase over `reach` pixels either way along the field."""
    H, W = phase.shape
    full = spread(field, (H, W))
    out = np.zeros((H, W), int)
    for i, j in np.argwhere(reasons == 0):
        at = full[i, j // 8 * 8, :2]  # the direction is that of the strip's first pixel
        du, dv = at / np.linalg.norm(at)
        dx, dy = int(np.rint(reach * du)), int(np.rint(reach * dv))
        ends = []
        for y, x in ((i + dy, j + dx), (i - dy, j - dx)):
            inside = 0 <= y < H and 0 <= x < W and reasons[y, x] == 0
            ends.append((y, x) if inside else (i, j))
        rise = float(phase[ends[0]]) - float(phase[ends[1]])
        if abs(rise) > significance * math.hypot(sigma[ends[0]], sigma[ends[1]]):
            out[i, j] = np.sign(rise)
    return out


def majority_backward(signs, radius, share, least):
    """Backward votes against all votes in the window, by correlation with ones."""
    ones = np.ones((2 * radius + 1, 2 * radius + 1), int)
    back = ndimage.correlate((signs < 0).astype(int), ones, mode="constant")
    votes = ndimage.correlate((signs != 0).astype(int), ones, mode="constant")
    return (votes >= least) & (back >= share * votes)


def linked(phase, sigma, limit, a, b):
    """Whether pixel b continues the surface of pixel a; `limit` is (T1 per pixel (H, W), sigmas of noise)."""
    t1, noise = limit
    distance = max(abs(a[0] - b[0]), abs(a[1] - b[1]))
    return abs(float(phase[a]) - float(phase[b])) < t1[a] * distance + noise * math.hypot(sigma[a], sigma[b])


def loose_pixels(phase, sigma, reasons, limit, least):
    """Pixels with fewer than `least` linked neighbours of the eight next to them and of the eight at distance two."""
    H, W = phase.shape
    out = np.zeros((H, W), bool)
    ring = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    for i, j in np.argwhere(reasons == 0):
        shares = []
        for far in (1, 2):
            inside = [(i + far * y, j + far * x) for y, x in ring]
            inside = [(y, x) for y, x in inside if 0 <= y < H and 0 <= x < W]
            links = sum(linked(phase, sigma, limit, (i, j), n) for n in inside if reasons[n] == 0)
            shares.append(links / len(inside))
        out[i, j] = max(shares) < least / 8
    return out


def domains(phase, sigma, reasons, limit):
    """Connected components of the graph of links (networks by scipy): labels from 1, 0 = masked.

    A pixel may be linked to the next in its row and column, and over one masked pixel to the next but one.
    """
    H, W = phase.shape
    ends = []
    for i, j in np.argwhere(reasons == 0):
        for y, x in ((1, 0), (0, 1)):
            near, far = (i - y, j - x), (i - 2 * y, j - 2 * x)
            other = near if min(near) >= 0 and reasons[near] == 0 else far
            if min(other) >= 0 and reasons[other] == 0 and linked(phase, sigma, limit, (i, j), other):
                ends.append((i * W + j, other[0] * W + other[1]))
    rows, columns = np.array(ends, int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(ends)), (rows, columns)), shape=(H * W, H * W))
    parts = connected_components(graph, directed=False)[1].reshape(H, W)
    out = np.zeros((H, W), int)
    out[reasons == 0] = np.unique(parts[reasons == 0], return_inverse=True)[1] + 1
    return out


def local_distance(phase, sigma, label, radius, least, i, j):
    """(distance in sigmas, roughness) of one pixel from the robust quadric of its domain's neighbours."""
    rows, values, sigmas = [], [], []
    for y in range(max(i - radius, 0), min(i + radius + 1, phase.shape[0])):
        for x in range(max(j - radius, 0), min(j + radius + 1, phase.shape[1])):
            if label[y, x] == label[i, j] and (y, x) != (i, j):
                dx, dy = x - j, y - i
                rows.append([1, dx, dy, dx * dx, dx * dy, dy * dy])
                values.append(float(phase[y, x]) - float(phase[i, j]))
                sigmas.append(float(sigma[y, x]))
    n = len(rows)
    if label[i, j] < 0 or n < least:
        return math.nan, math.nan
    M = np.array(rows, float)[:, : 6 if n >= 12 else 3]
    values, sigmas = np.array(values), np.array(sigmas)
    if np.linalg.matrix_rank(M) < M.shape[1]:
        return math.nan, math.nan
    weight, c, own, roughness = np.ones(n), np.zeros(M.shape[1]), 0.0, 0.0
    for sweep in range(4):
        if sweep:
            z2 = ((values - M @ c) / sigmas) ** 2
            weight = 1 / (1 + z2 / 2.5**2)
            roughness = math.sqrt((weight * z2).sum() / max(weight.sum() * (1 - M.shape[1] / n), 1.0))
            if z2.max() < 9 or sweep == 3:
                break
        root = np.sqrt(weight) / sigmas
        c = np.linalg.lstsq(M * root[:, None], values * root, rcond=None)[0]
        own = np.linalg.inv((M * root[:, None]).T @ (M * root[:, None]))[0, 0]
    return abs(c[0]) / (math.sqrt(float(sigma[i, j]) ** 2 + own) * max(roughness, 1.0)), roughness


def cross_examine(p, own_sigma, other, other_sigma, pose, lens, tolerance, slack):
    """One point against another view's surface: 1 confirmed, -1 denied (in front of it), 0 no evidence."""
    q = pose.R @ np.asarray(p, float) + pose.t
    if not q[2] > 0:
        return 0
    (u, v), = cv2.projectPoints(q[None], np.zeros(3), np.zeros(3), lens.K, lens.distortion)[0].reshape(-1, 2)
    h, w = other_sigma.shape
    if not (0 <= u < w - 1 and 0 <= v < h - 1):
        return 0
    i, j = int(v), int(u)
    depth = (other[i : i + 2, j : j + 2].astype(float) @ pose.R.T + pose.t)[..., 2]
    if not np.isfinite(depth).all():
        return 0
    there = RegularGridInterpolator(([0, 1], [0, 1]), depth)([v - i, u - j])[0]
    noise = math.hypot(own_sigma, other_sigma[i : i + 2, j : j + 2].max())
    limit = tolerance * noise + slack * q[2] / lens.K[0, 0] + np.ptp(depth)
    return 1 if abs(q[2] - there) <= limit else -1 if q[2] < there else 0
