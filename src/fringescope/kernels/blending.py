"""Colours of a place in several views, and their mean: in blocks of pixels. Arrays and scalars only, float32.

Pictures are flat, of three samples a pixel or of one where they are grey.
"""

import math

import numpy as np

from fringescope.jit import njit

_f = np.float32
_ZERO, _ONE = np.float32(0), np.float32(1)
_ADD1, _ADD2 = np.uintp(1), np.uintp(2)  # to indices, which are quicker without a sign
_CONTRACT = {"contract"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def tint_weights(ok, tint, clear, share, n, weight):
    """Weights of a view's colours where they are `ok`."""
    for k in range(n):
        own = tint[k] * clear[k] * share
        weight[k] = own if ok[k] and own > _ZERO else _ZERO


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def taps(U, V, ok, height, width, n, place, fu, fv):
    """The pixel up and left of (U, V), and how far beyond it they are; the first pixel where they are not `ok`."""
    high_u, high_v = _f(max(width - 2, 0)), _f(max(height - 2, 0))
    for k in range(n):
        u, v = (U[k] if ok[k] else _ZERO), (V[k] if ok[k] else _ZERO)
        j, i = np.int32(min(u, high_u)), np.int32(min(v, high_v))
        fu[k], fv[k] = u - _f(j), v - _f(i)
        place[k] = np.int32(i * width + j)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _between(rgb, place, right, below, fu, fv, weight, gain, n, c0, c1, c2):
    """Colours between four pixels each, bilinear, where they have a weight."""
    right, below = np.uintp(right), np.uintp(below)
    g0, g1, g2 = gain[0], gain[1], gain[2]
    for k in range(n):
        if not weight[k] > _ZERO:
            continue
        a = np.uintp(place[k])
        a += a + a
        b, c = a + right, a + below
        d = c + right
        x, y = fu[k], fv[k]
        p0, p1, p2 = rgb[a], rgb[a + _ADD1], rgb[a + _ADD2]
        q0, q1, q2 = rgb[c], rgb[c + _ADD1], rgb[c + _ADD2]
        p0, p1, p2 = p0 + x * (rgb[b] - p0), p1 + x * (rgb[b + _ADD1] - p1), p2 + x * (rgb[b + _ADD2] - p2)
        q0, q1, q2 = q0 + x * (rgb[d] - q0), q1 + x * (rgb[d + _ADD1] - q1), q2 + x * (rgb[d + _ADD2] - q2)
        c0[k], c1[k], c2[k] = (p0 + y * (q0 - p0)) * g0, (p1 + y * (q1 - p1)) * g1, (p2 + y * (q2 - p2)) * g2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _between_grey(grey, place, right, below, fu, fv, n, light):
    right, below = np.uintp(right), np.uintp(below)
    for k in range(n):
        a = np.uintp(place[k])
        c = a + below
        p, q = grey[a], grey[c]
        p, q = p + fu[k] * (grey[a + right] - p), q + fu[k] * (grey[c + right] - q)
        light[k] = p + fv[k] * (q - p)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _times(light, gain, n, out):
    for k in range(n):
        out[k] = light[k] * gain


@njit(cache=True, nogil=True, error_model="numpy")
def colours_between(side, place, fu, fv, mono, n, C):
    """Colours of a view, times its gains, bilinear from the pixels at `place` on, to C (4, BLOCK), whose last row are
    weights; those that have none stay as they are. `mono`: the first channel is enough.
    """
    W, H = side.width, side.height
    if side.channels == 1:
        _between_grey(side.rgb, place, min(W - 1, 1), W if H > 1 else 0, fu, fv, n, C[2])
        for c in range(1 if mono else 3):
            _times(C[2], side.gain[c], n, C[c])
    else:
        right, below = 3 if W > 1 else 0, 3 * W if H > 1 else 0
        _between(side.rgb, place, right, below, fu, fv, C[3], side.gain, n, C[0], C[1], C[2])


@njit(cache=True, nogil=True, error_model="numpy")
def colours_at(side, place, mono, n, C):
    """Colours of a view's pixels at `place`, times its gains, to C (4, BLOCK). `mono`: see `colours_between`."""
    g0, g1, g2 = side.gain[0], side.gain[1], side.gain[2]
    if side.channels == 1:
        for k in range(n):
            C[2, k] = side.rgb[np.uintp(place[k])]
        for c in range(1 if mono else 3):
            _times(C[2], side.gain[c], n, C[c])
    else:
        for k in range(n):
            p = np.uintp(place[k])
            p += p + p
            C[0, k], C[1, k], C[2, k] = side.rgb[p] * g0, side.rgb[p + _ADD1] * g1, side.rgb[p + _ADD2] * g2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _light(c0, c1, c2, w, n, soft, total):
    """What a view adds to the soft minimum of the views' light."""
    for k in range(n):
        light = max((c0[k] + c1[k] + c2[k]) * _f(1 / 3) + _f(1e-3), _f(1e-3))
        square = light * light
        soft[k] += w[k] / (square * square) if w[k] > _ZERO else _ZERO
        total[k] += w[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _shares(c0, c1, c2, w, low, gloss, n, use, total):
    """A view's share: less where it is brighter than the others by more than the share `gloss`."""
    for k in range(n):
        excess = max((c0[k] + c1[k] + c2[k]) * _f(1 / 3) + _f(1e-3) - low[k], _ZERO) / (gloss * low[k])
        share = w[k] / (_ONE + excess * excess) if w[k] > _ZERO else _ZERO
        use[k] = share
        total[k] += share


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _mix(c, use, n, total):
    for k in range(n):
        total[k] += use[k] * c[k] if use[k] > _ZERO else _ZERO


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _darkest(total, n, soft):
    for k in range(n):
        soft[k] = math.sqrt(math.sqrt(total[k] / soft[k])) if total[k] > _ZERO else _ONE


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _divide(own, weight, n, out):
    for k in range(n):
        out[k] = out[k] / weight[k] if weight[k] > _ZERO else own[k]


@njit(cache=True, nogil=True, error_model="numpy")
def blend(C, views, gloss, channels, n, out):
    """Blended colours `out`[:channels] from C (views, 4, BLOCK): colours and weights; the first is the view's own.

    A view that is brighter than a soft minimum over the views by more than the share `gloss` sees a highlight there
    and counts less. Where no view has a weight the own colour stays. Of one channel all three are alike. The other
    rows of `out` (7, BLOCK) are scratch.
    """
    soft, total, use, weight = out[3], out[4], out[5], out[6]
    g, b = (1, 2) if channels == 3 else (0, 0)
    for k in range(n):
        soft[k] = total[k] = weight[k] = _ZERO
    for c in range(channels):
        out[c, :n] = _ZERO
    for v in range(views):
        _light(C[v, 0], C[v, g], C[v, b], C[v, 3], n, soft, total)
    _darkest(total, n, soft)
    for v in range(views):
        _shares(C[v, 0], C[v, g], C[v, b], C[v, 3], soft, gloss, n, use, weight)
        for c in range(channels):
            _mix(C[v, c], use, n, out[c])
    for c in range(channels):
        _divide(C[0, c], weight, n, out[c])
