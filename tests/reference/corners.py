"""Slow, obvious twins of kernels/corners.py."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

Array = np.ndarray[Any, Any]


def edge_profile(d: float, half1: float, half2: float, blur: float, fine: int = 201) -> float:
    """A blurred step averaged over two boxes, by adding up."""
    a = (np.arange(fine) + 0.5) / fine * 2 - 1
    z = d + half1 * a[:, None] + half2 * a[None]
    return float(np.vectorize(math.erf)(z / (math.sqrt(2) * blur)).mean())


def ring_test(image: Array, x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    """Edge angles, contrast and symmetry of a ring of 32 samples; zeros if it has not four sectors."""
    angle = 2 * np.pi * np.arange(32) / 32
    ring = map_coordinates(image, [y + radius * np.sin(angle), x + radius * np.cos(angle)], order=1, mode="nearest")
    middle = (ring.max() + ring.min()) / 2
    bright = ring >= middle
    changes = np.flatnonzero(bright != np.roll(bright, -1))
    if len(changes) != 4:
        return 0.0, 0.0, 0.0, 0.0
    exact = []
    for k in changes:
        a, b = ring[k] - middle, ring[(k + 1) % 32] - middle
        exact.append((2 * np.pi / 32 * (k + a / (a - b)), not bright[k]))
    rising = [t for t, up in exact if up]
    falling = [t for t, up in exact if not up]
    alpha, beta = (0.5 * (p + q - math.pi) % math.pi for p, q in (rising, falling))
    a, b = ring[:16] - middle, ring[16:] - middle
    return alpha, beta, (ring.max() - ring.min()) / 2, float(2 * (a * b).sum() / (a**2 + b**2).sum())


def fit_corner(image: Array, start: Array, step1: Array, step2: Array, reach: float, fine: int = 5) -> Array:
    """Place (2,) of a chequer corner: two crossing edges, each pixel averaged by adding up, by SciPy."""
    A = np.linalg.inv(np.column_stack([step1, step2]))
    j, i = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    p = np.column_stack([j.ravel(), i.ravel()]).astype(float)
    p = p[(np.abs((p - start) @ A.T) <= reach).all(1)]
    value = image[p[:, 1].astype(int), p[:, 0].astype(int)]
    q = p - start
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    erf = np.vectorize(math.erf)

    def misses(v: Array) -> Array:
        chequer = np.zeros(len(q))
        for dx in sub:
            for dy in sub:
                x, y = q[:, 0] + dx - v[0], q[:, 1] + dy - v[1]
                one = erf((np.cos(v[2]) * y - np.sin(v[2]) * x) / (math.sqrt(2) * v[4]))
                two = erf((np.cos(v[3]) * y - np.sin(v[3]) * x) / (math.sqrt(2) * v[4]))
                chequer += one * two / fine**2
        x, y = q[:, 0] - v[0], q[:, 1] - v[1]
        light = np.column_stack([x * 0 + 1, x, y, x * x, x * y, y * y, chequer, chequer * x, chequer * y])
        return np.asarray(light @ np.linalg.lstsq(light, value, rcond=None)[0] - value)

    guess = [0.0, 0.0, math.atan2(step1[1], step1[0]), math.atan2(step2[1], step2[0]), 0.6]
    return np.asarray(start + least_squares(misses, guess).x[:2])
