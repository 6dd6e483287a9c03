"""What other views say about a pixel's ray, and its colour: one pass over the pixels that matter, in blocks.

Of each small tile of a picture the pixels wanted are listed, so that no work goes to others, and what is fetched pixel
by pixel from other views lies close together there too. All else is loops over lists that compilers turn into vector
instructions. Arrays and scalars only, in float32.
"""

import math
from typing import NamedTuple

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.blending import blend, colours_at, colours_between, taps, tint_weights
from fringescope.kernels.colour import codes_of, encode_tile
from fringescope.kernels.surface import CODE, locate
from fringescope.kernels.views import places, project
from fringescope.threads import by_rows

WIDE, HIGH = 32, 8  #: pixels of a tile that is worked on at a time
BLOCK = WIDE * HIGH
OWNED, EDGE, POINT, BLENDED = 1, 2, 4, 8  #: bits of a view's marks
TILE = 32  #: side, in pixels, of the squares of a picture that are blended or not: some tiles

_f = np.float32
_ZERO, _ONE, _TWO, _THREE = (np.float32(c) for c in (0.0, 1.0, 2.0, 3.0))
_NAN = np.float32(np.nan)
_ADD1, _ADD2 = np.uintp(1), np.uintp(2)  # to indices, which are quicker without a sign
_CONTRACT = {"contract"}


class Side(NamedTuple):
    """One view with all that the sums need: its weights follow from normal, sigma, and rise."""

    xyz: np.ndarray  #: (H * W * 3,) float32, world mm
    sigma: np.ndarray  #: (H * W,) float32
    code: np.ndarray  #: (H * W,) int32, normals (see `surface.encode`)
    rise: np.ndarray  #: (H * W,) uint8, 0..255 from borders and jumps
    rgb: np.ndarray  #: (H * W * channels,) float32, linear light
    channels: int  #: 3, or 1 of a picture that is grey
    gain: np.ndarray  #: (3,) float32
    clear: np.ndarray  #: (H * W,) uint8, 255 far from saturated pixels; or (1,)
    share: np.float32  #: of a view's colours; little where it has none
    centre: np.ndarray  #: (3,) float32, world mm
    height: int
    width: int
    pose: np.ndarray  #: (12,) float64
    lens: np.ndarray  #: (10,) float64


class Limits(NamedTuple):
    """Thresholds, float32."""

    agree_sigma: np.float32
    agree_mm: np.float32
    grazing: np.float32  #: cosine at which weights have fallen to nothing
    per_front: np.float32  #: one over the cosines between nothing and all
    gloss: np.float32


@njit(cache=True, nogil=True, error_model="numpy")
def _listed(marks, top, end, left, right, width, mask, wanted, n, place, start, target):
    """Append to the `n` places the pixels of a tile whose bits of `marks` (H * W,) in `mask` are those `wanted`.

    Those of row `top` + r have the targets start[r] and on; `start` is moved on.
    """
    for i in range(top, end):
        p, at = np.uintp(i * width + left), start[i - top]
        for j in range(right - left):
            has = (marks[p + np.uintp(j)] & mask) == wanted
            place[n], target[n] = p + np.uintp(j), at
            n += has
            at += has
        start[i - top] = at
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(side, place, n, coloured):
    """Reads every fourth of the pixels that will be needed, whose lines then come to the caches side by side."""
    some = _ZERO
    for k in range(0, n, 4):
        p = np.uintp(max(place[k], 0))
        some += side.xyz[p + p + p] + side.sigma[p] + _f(side.code[p]) + _f(side.rise[p])
        if coloured:
            some += side.rgb[p + p + p if side.channels == 3 else p]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _fetch(side, place, n, X, Y, Z, S, code, rise, clear):
    """Points, sigma, code of the normal, rise and clearness of pixels; sigma is NaN where the place is -1."""
    for k in range(n):
        p = np.uintp(max(place[k], 0))
        q = p + p + p
        X[k], Y[k], Z[k] = side.xyz[q], side.xyz[q + _ADD1], side.xyz[q + _ADD2]
        S[k], code[k], rise[k] = side.sigma[p], side.code[p], _f(side.rise[p])
    for k in range(n):
        S[k] = S[k] if place[k] >= 0 else _NAN
        clear[k] = _ONE
    if side.clear.shape[0] > 1:
        for k in range(n):
            clear[k] = _f(side.clear[np.uintp(max(place[k], 0))]) * _f(1 / 255)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def decode(code, n, X, Y, Z):
    """Codes of normals to unit vectors."""
    for k in range(n):
        u, v = _f(np.int16(code[k])) * _f(1 / CODE), _f(np.int16(code[k] >> 16)) * _f(1 / CODE)
        z = _ONE - abs(u) - abs(v)
        t = max(-z, _ZERO)
        u += -t if u >= _ZERO else t
        v += -t if v >= _ZERO else t
        size = _ONE / math.sqrt(u * u + v * v + z * z)
        X[k], Y[k], Z[k] = u * size, v * size, z * size


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def weigh(X, Y, Z, S, NX, NY, NZ, rise, centre, limits, n, cosine, sigma_n, weight, tint):
    """Cosine of incidence, sigma along the normal, weight of the point and weight of its colour.

    The weight is the cosine over the variance along the normal, times the rise from borders, times a smooth fall to
    nothing at grazing incidence. NaN where there is no point.
    """
    cx, cy, cz = centre[0], centre[1], centre[2]
    for k in range(n):
        dx, dy, dz = cx - X[k], cy - Y[k], cz - Z[k]
        c = max((dx * NX[k] + dy * NY[k] + dz * NZ[k]) / math.sqrt(dx * dx + dy * dy + dz * dz), _ZERO)
        front = min(max((c - limits.grazing) * limits.per_front, _ZERO), _ONE)
        r = max(rise[k] * _f(1 / 255), _f(1e-3)) * front * front * (_THREE - _TWO * front)
        s = S[k] * max(c, _f(0.05))
        least = max(s, _f(1e-6))
        cosine[k] = c
        sigma_n[k] = s
        weight[k] = r * c / (least * least) + (s - s)
        tint[k] = r * c * c + (s - s)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _rays(X, Y, Z, centre, n, DX, DY, DZ):
    for k in range(n):
        x, y, z = X[k] - centre[0], Y[k] - centre[1], Z[k] - centre[2]
        inverse = _ONE / math.sqrt(x * x + y * y + z * z)
        DX[k], DY[k], DZ[k] = x * inverse, y * inverse, z * inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _compare(own, ray, depth, other, cosine, sigma_w, weight, inverse_focal, limits, n, shift, ok):
    """Whether the other view's samples lie on the same surface, and how far along the own ray; NaN if that is unsure.

    Along the mean m of both normals, which is perpendicular to the chord PQ of any surface of second order, the views
    differ by s = (Q - P) . m. They agree if abs(s) <= agree_sigma * sqrt(sp^2 + sq^2) + agree_mm and Q is no farther
    from P than a pixel of w is wide on the surface: on a sphere the chord to any Q has s = 0.
    """
    X, Y, Z, NX, NY, NZ, sigma = own
    DX, DY, DZ = ray
    QX, QY, QZ, MX, MY, MZ = other
    for k in range(n):
        mx, my, mz = NX[k] + MX[k], NY[k] + MY[k], NZ[k] + MZ[k]
        size = mx * mx + my * my + mz * mz
        inverse = _ONE / math.sqrt(size)
        cx, cy, cz = QX[k] - X[k], QY[k] - Y[k], QZ[k] - Z[k]
        s = (cx * mx + cy * my + cz * mz) * inverse
        limit = limits.agree_sigma * math.sqrt(sigma[k] * sigma[k] + sigma_w[k] * sigma_w[k]) + limits.agree_mm
        reach = depth[k] * inverse_focal / max(cosine[k], _f(0.05)) + limit
        slope = (mx * DX[k] + my * DY[k] + mz * DZ[k]) * inverse
        near = cx * cx + cy * cy + cz * cz <= reach * reach
        ok[k] = (weight[k] > _ZERO) & (size >= _ONE) & (abs(s) <= limit) & near
        shift[k] = s / slope if slope < _f(-0.05) else _f(np.nan)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _add(ok, along, weight, sigma_w, MX, MY, MZ, n, shift, total, variance, FX, FY, FZ):
    for k in range(n):
        use = ok[k] & (along[k] == along[k])
        w = weight[k] if use else _ZERO
        ws = w * sigma_w[k] if use else _ZERO
        shift[k] += w * along[k] if use else _ZERO
        total[k] += w
        variance[k] += ws * ws
        FX[k] += w * MX[k]
        FY[k] += w * MY[k]
        FZ[k] += w * MZ[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _settle_points(X, Y, Z, DX, DY, DZ, weight, shift, total, n, x, y, z):
    """The weighted mean along each ray."""
    for k in range(n):
        along = shift[k] / (max(weight[k], _f(1e-9)) + total[k])
        x[k], y[k], z[k] = X[k] + along * DX[k], Y[k] + along * DY[k], Z[k] + along * DZ[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _settle_normals(NX, NY, NZ, weight, FX, FY, FZ, n, x, y, z):
    for k in range(n):
        w = max(weight[k], _f(1e-9))
        nx, ny, nz = FX[k] + w * NX[k], FY[k] + w * NY[k], FZ[k] + w * NZ[k]
        size = _ONE / math.sqrt(nx * nx + ny * ny + nz * nz)
        x[k], y[k], z[k] = nx * size, ny * size, nz * size


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _settle_sigma(NX, NY, NZ, DX, DY, DZ, sigma_n, weight, total, variance, n, out):
    """One standard deviation of the mean, along the ray."""
    for k in range(n):
        w = max(weight[k], _f(1e-9))
        ws = w * sigma_n[k]
        slope = -(NX[k] * DX[k] + NY[k] * DY[k] + NZ[k] * DZ[k])
        out[k] = math.sqrt(variance[k] + ws * ws) / ((w + total[k]) * max(slope, _f(0.05)))


@njit(cache=True, nogil=True, error_model="numpy")
def _put(x, y, z, target, n, out):
    """Three arrays to the places `target` of `out`, flat."""
    for k in range(n):
        p = np.uintp(target[k])
        p += p + p
        out[p], out[p + _ADD1], out[p + _ADD2] = x[k], y[k], z[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _put_one(x, target, n, out):
    for k in range(n):
        out[np.uintp(target[k])] = x[k]


@by_rows(lambda _sides, _count, _view, _limits, marks, *_: -(-marks.shape[0] // HIGH))
def fuse(first, last, sides, count, view, limits, marks, bit, near, start, table, xyz, normal, sigma, rgb, seen,
         picture):  # fmt: skip
    """Fuse the pixels of view number `view` that have `bit` in `marks` (H, W): the mean along each pixel's ray.

    The first `count` of `sides` are views. Each other view contributes the sample of the pixel nearest to the point,
    with its weight, if it lies on the same surface. Row i's points go to start[i] and on of `xyz`, `normal` (n, 3),
    `sigma`, `seen` (n,), and their blended colours to `rgb` (n, 3) and to `picture` (H, W, 3), if that has rows; then
    pixels in squares of TILE that are `near` get blended colours as well, others their own. Only in these squares are
    there pixels with `bit`. A point that nothing else sees stays as it is. What other views see gets BLENDED in
    `marks`. Rows first..last-1 are rows of tiles.
    """
    own = sides[view]
    H, W = marks.shape
    f = np.float32
    X, Y, Z, S = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    NX, NY, NZ, SN = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    DX, DY, DZ, weight = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    U, V, D = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    QX, QY, QZ, MX, MY, MZ = (
        np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f),
        np.empty(BLOCK, f),
    )  # fmt: skip
    shift, total, variance, FX, FY, FZ = (
        np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f),
        np.empty(BLOCK, f),
    )  # fmt: skip
    rise, clear, cosine, tint = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    sigma_w, weight_w, along = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    C, mixed = np.zeros((count, 4, BLOCK), f), np.empty((7, BLOCK), f)
    codes, factors = np.empty((3, BLOCK), np.int32), np.empty(3 * WIDE, f)
    normals, place, other_place = np.empty(BLOCK, np.int32), np.empty(BLOCK + 1, np.int32), np.empty(BLOCK, np.int32)
    ok, said, target = np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.uint8), np.empty(BLOCK + 1, np.int64)
    next_, nowhere = np.empty(HIGH, np.int64), np.zeros(HIGH, np.int64)
    for k in range(3 * WIDE):
        factors[k] = own.gain[k % 3]
    mono = True
    for w in range(count):
        gain = sides[w].gain
        mono = mono and sides[w].channels == 1 and gain[0] == gain[1] and gain[0] == gain[2]
    channels = 1 if mono else 3
    red, green, blue = codes[0], codes[1 % channels], codes[2 % channels]
    pictured = picture.shape[0] > 0
    shown, marked, scratch = picture.reshape(-1), marks.reshape(-1), codes.reshape(-1)
    points, normals_out, colours_out = xyz.reshape(-1), normal.reshape(-1), rgb.reshape(-1)
    touched = _ZERO
    for t in range(first, last):
        top, end = t * HIGH, min((t + 1) * HIGH, H)
        for i in range(top, end):
            next_[i - top] = start[i]
        for left in range(0, W, WIDE):
            right = min(left + WIDE, W)
            n = mine = 0
            if near[top // TILE, left // TILE] != 0:
                n = mine = _listed(marked, top, end, left, right, W, bit, bit, 0, place, next_, target)
                if pictured and count > 1:
                    n = _listed(marked, top, end, left, right, W, POINT | OWNED, POINT, n, place, nowhere, target)
            if pictured and n < (end - top) * (right - left):
                encode_tile(own, top, end, left, right, factors, table, scratch, shown)
            if n == 0:
                continue
            _fetch(own, place, n, X, Y, Z, S, normals, rise, clear)
            decode(normals, n, NX, NY, NZ)
            weigh(X, Y, Z, S, NX, NY, NZ, rise, own.centre, limits, n, cosine, SN, weight, tint)
            _rays(X, Y, Z, own.centre, n, DX, DY, DZ)
            for k in range(n):
                shift[k] = total[k] = variance[k] = FX[k] = FY[k] = FZ[k] = _ZERO
                said[k] = 0
                ok[k] = True
            if pictured:
                tint_weights(ok, tint, clear, own.share, n, C[0, 3])
                colours_at(own, place, mono, n, C[0])
            slot = 1
            for w in range(count):
                if w == view:
                    continue
                other = sides[w]
                project(X, Y, Z, other.pose, other.lens, n, U, V, D)
                places(U, V, D, other.height, other.width, _ZERO, n, other_place)
                touched += _touch(other, other_place, n, pictured)
                _fetch(other, other_place, n, QX, QY, QZ, S, normals, rise, clear)
                decode(normals, n, MX, MY, MZ)
                weigh(QX, QY, QZ, S, MX, MY, MZ, rise, other.centre, limits, n, cosine, sigma_w, weight_w, tint)
                focal = _f(1.0 / math.sqrt(other.lens[0] * other.lens[1]))
                _compare((X, Y, Z, NX, NY, NZ, SN), (DX, DY, DZ), D, (QX, QY, QZ, MX, MY, MZ), cosine, sigma_w,
                         weight_w, focal, limits, n, along, ok)
                _add(ok, along, weight_w, sigma_w, MX, MY, MZ, n, shift, total, variance, FX, FY, FZ)
                if pictured:
                    for k in range(n):
                        said[k] |= np.uint8(1 << w) if ok[k] else np.uint8(0)
                    tint_weights(ok, tint, clear, other.share, n, C[slot, 3])
                    taps(U, V, ok, other.height, other.width, n, other_place, along, cosine)
                    colours_between(other, other_place, along, cosine, mono, n, C[slot])
                slot += 1
            _settle_points(X, Y, Z, DX, DY, DZ, weight, shift, total, mine, QX, QY, QZ)
            _settle_normals(NX, NY, NZ, weight, FX, FY, FZ, mine, MX, MY, MZ)
            _settle_sigma(NX, NY, NZ, DX, DY, DZ, SN, weight, total, variance, mine, S)
            if pictured:
                blend(C, count, limits.gloss, channels, n, mixed)
                for c in range(channels):
                    codes_of(mixed[c], table, n, codes[c])
                _put(red, green, blue, place, n, shown)
                for k in range(n):
                    marked[np.uintp(place[k])] |= BLENDED if said[k] != 0 else 0
                    said[k] |= np.uint8(1 << view)
                _put(red, green, blue, target, mine, colours_out)
                _put_one(said, target, mine, seen)
            _put(QX, QY, QZ, target, mine, points)
            _put(MX, MY, MZ, target, mine, normals_out)
            _put_one(S, target, mine, sigma)
    codes[0, 0] = np.int32(touched > _ZERO)  # so that no compiler takes the reading away


@by_rows(lambda _side, _limits, _step, _raster, _rows, _cols, weight, *_: weight.shape[0])
def thinned(first, last, side, limits, step, raster, rows, cols, weight, row_out, column_out):
    """Weights (h, w) of every `step`-th point, and its cell (row, column) of the raster; row -1: none."""
    f = np.float32
    X, Y, Z, S = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    NX, NY, NZ = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    rise, clear, cosine, sigma_n = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    tint, place, code = np.empty(BLOCK, f), np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    for i in range(first, last):
        for col in range(0, weight.shape[1], BLOCK):
            n = min(BLOCK, weight.shape[1] - col)
            for k in range(n):
                place[k] = i * step * side.width + (col + k) * step
            _fetch(side, place, n, X, Y, Z, S, code, rise, clear)
            decode(code, n, NX, NY, NZ)
            weigh(X, Y, Z, S, NX, NY, NZ, rise, side.centre, limits, n, cosine, sigma_n, weight[i, col : col + n], tint)
            locate(X, Y, Z, raster, rows, cols, n, row_out[i, col : col + n], column_out[i, col : col + n])
