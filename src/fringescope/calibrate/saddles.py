"""Candidates for inner corners: saddle points of the brightness that look like four sectors on a ring around them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fringescope.kernels import corners as k
from fringescope.types import F32, F64, Bool

RINGS = (3.5, 5.5)  #: radii in pixels, both of which must show four sectors
MOST = 6000  #: candidates that are looked at, strongest first


@dataclass(frozen=True, eq=False)
class Saddles:
    """Places (n, 2) in pixels, angles (n, 2) of the two edges in [0, pi) with the bright sectors from the first to the
    second, and the contrast (n,), strongest first.
    """

    place: F64
    angle: F64
    contrast: F64

    def __len__(self) -> int:
        return len(self.place)


def find_saddles(image: F32, blur: float = 1.5) -> Saddles:
    """Saddles of a picture (H, W): minima of the Hessian's determinant, in pixels, sharpened to a fraction of one.

    The response is relative to the local contrast, so that dim corners count as much as bright ones.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), blur)
    xx, yy = (cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3, scale=0.25) for d in ((2, 0), (0, 2)))
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    response = xy * xy - xx * yy
    wide = cv2.GaussianBlur(image, (0, 0), 3 * blur)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((image - wide) ** 2, (0, 0), 3 * blur), 0))
    floor = 0.01 * float(np.percentile(image, 99.5)) + 1e-6
    response /= (spread + floor) ** 2
    top = cv2.dilate(response, np.ones((5, 5), np.uint8))
    rows, cols = np.nonzero((response >= top) & (response > 0.004))
    edge = int(max(RINGS)) + 1
    inside = (rows > edge) & (cols > edge) & (rows < image.shape[0] - edge - 1) & (cols < image.shape[1] - edge - 1)
    rows, cols = rows[inside], cols[inside]
    order = np.argsort(-response[rows, cols])[:MOST]
    rows, cols = rows[order], cols[order]
    place = _sharpen(smooth, xx, yy, xy, rows, cols)
    first, second = (_rings(smooth, place, r) for r in RINGS)
    good = (first[:, 2] > 0) & (second[:, 2] > 0) & (first[:, 3] > 0.6) & (second[:, 3] > 0.4)
    good &= (first[:, 2] > floor) & _agree(first[:, :2], second[:, :2])
    ring = second[good]
    return Saddles(place[good], ring[:, :2], ring[:, 2])


def _sharpen(smooth: F32, xx: F32, yy: F32, xy: F32, rows: F64, cols: F64) -> F64:
    """Where the gradient vanishes, by one Newton step of at most 1.5 pixels."""
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3, scale=0.125)[rows, cols] for d in ((1, 0), (0, 1)))
    a, b, c = xx[rows, cols], xy[rows, cols], yy[rows, cols]
    det = np.minimum(a * c - b * b, -1e-12)
    dx, dy = (-(c * gx - b * gy) / det, -(a * gy - b * gx) / det)
    return np.column_stack([cols + np.clip(dx, -1.5, 1.5), rows + np.clip(dy, -1.5, 1.5)]).astype(np.float64)


def _rings(smooth: F32, place: F64, radius: float) -> F64:
    out = np.empty((len(place), 4))
    k.ring_tests(smooth, place, radius, out)
    return out


def _agree(a: F64, b: F64, degrees: float = 25.0) -> Bool:
    d = np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2)
    return np.asarray((d < np.radians(degrees)).all(1))
