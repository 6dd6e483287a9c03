"""What other views say about a pixel's ray, and its colour: one pass over the pixels that matter, in blocks.

Of every row the pixels wanted are listed, so that no work goes to others. Arrays and scalars only, in float32, in loops
that compilers turn into vector instructions; only what lies scattered in other views is fetched pixel by pixel.
"""

import math
from typing import NamedTuple

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.colour import codes_of, encode_row
from fringescope.kernels.surface import CODE, locate
from fringescope.kernels.views import nearest, pick, project
from fringescope.threads import by_rows

BLOCK = 512  #: pixels that are worked on together
OWNED, EDGE, POINT, BLENDED = 1, 2, 4, 8  #: bits of a view's marks
TILE = 32  #: side, in pixels, of the squares of a picture that are blended or not

_f = np.float32
_ZERO, _ONE, _TWO, _THREE = (np.float32(c) for c in (0.0, 1.0, 2.0, 3.0))
_ADD1, _ADD2 = np.uintp(1), np.uintp(2)  # to indices, which are quicker without a sign
_CONTRACT = {"contract"}


class Side(NamedTuple):
    """One view with all that the sums need: its weights follow from normal, sigma, and rise."""

    xyz: np.ndarray  #: (H * W * 3,) float32, world mm
    sigma: np.ndarray  #: (H * W,) float32
    code: np.ndarray  #: (H * W * 2,) int16, normals (see `surface.encode`)
    rise: np.ndarray  #: (H * W,) uint8, 0..255 from borders and jumps
    rgb: np.ndarray  #: (H * W * 3,) float32, linear light
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
def listed(marks, mask, wanted, first, out):
    """Columns, from `first` on, of a part of a row of `marks` whose bits in `mask` are those `wanted`; how many."""
    n = 0
    for j in range(marks.shape[0]):
        out[n] = first + j
        n += (marks[j] & mask) == wanted
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(side, row, column, n, coloured):
    """Reads every fourth of the pixels that will be needed, whose lines then come to the caches side by side."""
    some = _ZERO
    for k in range(0, n, 4):
        if row[k] >= 0:
            p = np.uintp(row[k] * side.width + column[k])
            q = p + p + p
            some += side.xyz[q] + side.sigma[p] + _f(side.code[p + p]) + _f(side.rise[p])
            if coloured:
                some += side.rgb[q]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _fetch(side, row, column, n, S, P, Q, rise, clear):
    """Sigma, code of the normal, rise and clearness at pixels (row, column); row -1 leaves sigma NaN."""
    W = side.width
    bright = side.clear.shape[0] > 1
    for k in range(n):
        if row[k] >= 0:
            p = np.uintp(row[k] * W + column[k])
            S[k] = side.sigma[p]
            P[k], Q[k] = _f(side.code[p + p]), _f(side.code[p + p + _ADD1])
            rise[k] = _f(side.rise[p])
        else:
            S[k] = np.nan
            P[k] = Q[k] = rise[k] = _ZERO
    for k in range(n):
        clear[k] = _ONE
    if bright:
        for k in range(n):
            if row[k] >= 0:
                clear[k] = _f(side.clear[np.uintp(row[k] * W + column[k])]) * _f(1 / 255)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def decode(P, Q, n, X, Y, Z):
    """Codes of normals to unit vectors."""
    for k in range(n):
        u, v = P[k] * _f(1 / CODE), Q[k] * _f(1 / CODE)
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
def _taps(U, V, ok, tint, clear, share, height, width, bit, n, place, fu, fv, weight, seen):
    """The pixel up and left of (U, V), how far beyond it they are, and the weight; what is seen gets `bit`."""
    high_u, high_v = _f(max(width - 2, 0)), _f(max(height - 2, 0))
    for k in range(n):
        u, v = (U[k] if ok[k] else _ZERO), (V[k] if ok[k] else _ZERO)
        j, i = np.int32(min(u, high_u)), np.int32(min(v, high_v))
        fu[k], fv[k] = u - _f(j), v - _f(i)
        place[k] = 3 * (i * width + j)
        own = tint[k] * clear[k] * share
        weight[k] = own if ok[k] and own > _ZERO else _ZERO
        seen[k] |= bit if ok[k] else np.uint8(0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _between(rgb, place, right, below, fu, fv, weight, gain, n, c0, c1, c2):
    """Colours between four pixels each, bilinear, where they have a weight."""
    right, below = np.uintp(right), np.uintp(below)
    g0, g1, g2 = gain[0], gain[1], gain[2]
    for k in range(n):
        if not weight[k] > _ZERO:
            continue
        a = np.uintp(place[k])
        b, c = a + right, a + below
        d = c + right
        x, y = fu[k], fv[k]
        p0, p1, p2 = rgb[a], rgb[a + _ADD1], rgb[a + _ADD2]
        q0, q1, q2 = rgb[c], rgb[c + _ADD1], rgb[c + _ADD2]
        p0, p1, p2 = p0 + x * (rgb[b] - p0), p1 + x * (rgb[b + _ADD1] - p1), p2 + x * (rgb[b + _ADD2] - p2)
        q0, q1, q2 = q0 + x * (rgb[d] - q0), q1 + x * (rgb[d + _ADD1] - q1), q2 + x * (rgb[d + _ADD2] - q2)
        c0[k], c1[k], c2[k] = (p0 + y * (q0 - p0)) * g0, (p1 + y * (q1 - p1)) * g1, (p2 + y * (q2 - p2)) * g2


@njit(cache=True, nogil=True, error_model="numpy")
def _colours(side, U, V, ok, tint, clear, bit, n, place, fu, fv, c0, c1, c2, weight, seen):
    """Colour of the other view at (U, V), bilinear, and its weight; what it sees is marked with `bit`."""
    W, H = side.width, side.height
    _taps(U, V, ok, tint, clear, side.share, H, W, bit, n, place, fu, fv, weight, seen)
    right, below = 3 if W > 1 else 0, 3 * W if H > 1 else 0
    _between(side.rgb, place, right, below, fu, fv, weight, side.gain, n, c0, c1, c2)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _light(c0, c1, c2, w, n, soft, total):
    """What a view adds to the soft minimum of the views' light."""
    for k in range(n):
        light = max((c0[k] + c1[k] + c2[k]) * _f(1 / 3) + _f(1e-3), _f(1e-3))
        square = light * light
        soft[k] += w[k] / (square * square) if w[k] > _ZERO else _ZERO
        total[k] += w[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _mix(c0, c1, c2, w, low, gloss, n, s0, s1, s2, sw):
    """Add a view's colour: less of it where it is brighter than the others by more than the share `gloss`."""
    for k in range(n):
        excess = max((c0[k] + c1[k] + c2[k]) * _f(1 / 3) + _f(1e-3) - low[k], _ZERO) / (gloss * low[k])
        use = w[k] / (_ONE + excess * excess) if w[k] > _ZERO else _ZERO
        s0[k] += use * c0[k] if w[k] > _ZERO else _ZERO
        s1[k] += use * c1[k] if w[k] > _ZERO else _ZERO
        s2[k] += use * c2[k] if w[k] > _ZERO else _ZERO
        sw[k] += use


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _darkest(total, n, soft):
    for k in range(n):
        soft[k] = math.sqrt(math.sqrt(total[k] / soft[k])) if total[k] > _ZERO else _ONE


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _divide(own, weight, n, out):
    for k in range(n):
        out[k] = out[k] / weight[k] if weight[k] > _ZERO else own[k]


@njit(cache=True, nogil=True, error_model="numpy")
def blend(C, views, gloss, n, soft, total, r, g, b, weight):
    """Blended colours r, g, b from C (views, 4, BLOCK): colours and weights; the first is the view's own.

    A view that is brighter than a soft minimum over the views by more than the share `gloss` sees a highlight there
    and counts less. Where no view has a weight the own colour stays. `soft`, `total`, `weight` are scratch.
    """
    for k in range(n):
        soft[k] = total[k] = r[k] = g[k] = b[k] = weight[k] = _ZERO
    for v in range(views):
        _light(C[v, 0], C[v, 1], C[v, 2], C[v, 3], n, soft, total)
    _darkest(total, n, soft)
    for v in range(views):
        _mix(C[v, 0], C[v, 1], C[v, 2], C[v, 3], soft, gloss, n, r, g, b, weight)
    _divide(C[0, 0], weight, n, r)
    _divide(C[0, 1], weight, n, g)
    _divide(C[0, 2], weight, n, b)


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
def _put(x, y, z, n, out):
    """Three arrays to rows of `out` (n, 3)."""
    flat = out.reshape(-1)
    for k in range(n):
        flat[3 * k] = x[k]
        flat[3 * k + 1] = y[k]
        flat[3 * k + 2] = z[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _own(side, i, columns, n, row, X, Y, Z):
    """The own points of the listed columns of row i."""
    part = side.xyz[3 * i * side.width : 3 * (i + 1) * side.width]
    for k in range(n):
        p = 3 * columns[k]
        X[k], Y[k], Z[k] = part[p], part[p + 1], part[p + 2]
        row[k] = i


@njit(cache=True, nogil=True, error_model="numpy")
def _own_colours(side, i, columns, n, tint, clear, c0, c1, c2, w):
    part = side.rgb[3 * i * side.width : 3 * (i + 1) * side.width]
    g0, g1, g2 = side.gain[0], side.gain[1], side.gain[2]
    for k in range(n):
        p = np.uintp(3 * columns[k])
        c0[k], c1[k], c2[k] = part[p] * g0, part[p + _ADD1] * g1, part[p + _ADD2] * g2
    for k in range(n):
        own = tint[k] * clear[k] * side.share
        w[k] = own if own > _ZERO else _ZERO


@by_rows(lambda _sides, _count, _view, _limits, marks, *_: marks.shape[0])
def fuse(first, last, sides, count, view, limits, marks, bit, near, start, table, xyz, normal, sigma, rgb, seen,
         picture):  # fmt: skip
    """Fuse the pixels of view number `view` that have `bit` in `marks` (H, W): the mean along each pixel's ray.

    The first `count` of `sides` are views. Each other view contributes the sample of the pixel nearest to the point,
    with its weight, if it lies on the same surface. Row i's points go to start[i] and on of `xyz`, `normal` (n, 3),
    `sigma`, `seen` (n,), and their blended colours to `rgb` (n, 3) and to `picture` (H, W, 3), if that has rows; then
    pixels in squares of TILE that are `near` get blended colours as well, others their own. A point that nothing else
    sees stays as it is. What other views see gets BLENDED in `marks`.
    """
    own = sides[view]
    f = np.float32
    X, Y, Z, S = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    NX, NY, NZ, SN = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    DX, DY, DZ, weight = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    U, V, D, P, Q = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
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
    C, code, green = np.empty((count, 4, BLOCK), f), np.empty(3 * BLOCK, np.int32), np.empty(BLOCK, np.int32)
    place, factors = np.empty(BLOCK, np.int64), np.empty(3 * BLOCK, f)
    C[:] = _ZERO
    for k in range(3 * BLOCK):
        factors[k] = own.gain[k % 3]
    row, column, columns = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32), np.empty(BLOCK + 1, np.int32)
    ok, said = np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.uint8)
    pictured = picture.shape[0] > 0
    if pictured:
        for i in range(first, last):
            line = own.rgb[3 * i * own.width : 3 * (i + 1) * own.width]
            encode_row(line, factors, table, code, picture[i].reshape(-1))
    touched = _ZERO
    next_ = start[first : last + 1].copy()
    for col in range(0, own.width, BLOCK):  # downwards, so that the other views' pixels are still in the caches
        end = min(col + BLOCK, own.width)
        for i in range(first, last):
            for turn in range(2 if pictured and count > 1 else 1):
                if turn == 0:
                    n = listed(marks[i, col:end], bit, bit, col, columns)
                else:
                    n = 0
                    for left in range(col, end, TILE):
                        if near[i // TILE, left // TILE] != 0:
                            part = marks[i, left : min(left + TILE, end)]
                            n += listed(part, POINT | OWNED, POINT, left, columns[n:])
                if n == 0:
                    continue
                at = next_[i - first]
                _own(own, i, columns, n, row, X, Y, Z)
                _fetch(own, row, columns, n, S, P, Q, rise, clear)
                decode(P, Q, n, NX, NY, NZ)
                weigh(X, Y, Z, S, NX, NY, NZ, rise, own.centre, limits, n, cosine, SN, weight, tint)
                _rays(X, Y, Z, own.centre, n, DX, DY, DZ)
                if pictured:
                    _own_colours(own, i, columns, n, tint, clear, C[0, 0], C[0, 1], C[0, 2], C[0, 3])
                for k in range(n):
                    shift[k] = total[k] = variance[k] = FX[k] = FY[k] = FZ[k] = _ZERO
                    said[k] = 0
                slot = 1
                for w in range(count):
                    if w == view:
                        continue
                    other = sides[w]
                    project(X, Y, Z, other.pose, other.lens, n, U, V, D)
                    nearest(U, V, D, other.height, other.width, _ZERO, n, row, column)
                    touched += _touch(other, row, column, n, pictured)
                    pick(row, column, other.width, other.xyz, n, QX, QY, QZ)
                    _fetch(other, row, column, n, S, P, Q, rise, clear)
                    decode(P, Q, n, MX, MY, MZ)
                    weigh(QX, QY, QZ, S, MX, MY, MZ, rise, other.centre, limits, n, cosine, sigma_w, weight_w, tint)
                    focal = _f(1.0 / math.sqrt(other.lens[0] * other.lens[1]))
                    _compare((X, Y, Z, NX, NY, NZ, SN), (DX, DY, DZ), D, (QX, QY, QZ, MX, MY, MZ), cosine, sigma_w,
                             weight_w, focal, limits, n, along, ok)
                    _add(ok, along, weight_w, sigma_w, MX, MY, MZ, n, shift, total, variance, FX, FY, FZ)
                    if pictured:
                        _colours(other, U, V, ok, tint, clear, np.uint8(1 << w), n, place, along, cosine, C[slot, 0],
                                 C[slot, 1], C[slot, 2], C[slot, 3], said)
                    slot += 1
                if pictured:
                    blend(C, count, limits.gloss, n, cosine, tint, U, V, D, P)
                    codes_of(U, table, n, row)
                    codes_of(V, table, n, column)
                    codes_of(D, table, n, green)
                    target = picture[i].reshape(-1)
                    for k in range(n):
                        c = columns[k]
                        target[3 * c], target[3 * c + 1], target[3 * c + 2] = row[k], column[k], green[k]
                        marks[i, c] |= BLENDED if said[k] != 0 else 0
                    if turn == 0:
                        _put(row, column, green, n, rgb[at : at + n])
                        for k in range(n):
                            seen[at + k] = said[k] | np.uint8(1 << view)
                if turn == 0:
                    _settle_points(X, Y, Z, DX, DY, DZ, weight, shift, total, n, QX, QY, QZ)
                    _put(QX, QY, QZ, n, xyz[at : at + n])
                    _settle_normals(NX, NY, NZ, weight, FX, FY, FZ, n, MX, MY, MZ)
                    _put(MX, MY, MZ, n, normal[at : at + n])
                    _settle_sigma(NX, NY, NZ, DX, DY, DZ, SN, weight, total, variance, n, sigma[at : at + n])
                    next_[i - first] += n
    code[0] = np.int32(touched > _ZERO)  # so that no compiler takes the reading away


@by_rows(lambda _side, _limits, _step, _raster, _rows, _cols, weight, *_: weight.shape[0])
def thinned(first, last, side, limits, step, raster, rows, cols, weight, row_out, column_out):
    """Weights (h, w) of every `step`-th point, and its cell (row, column) of the raster; row -1: none."""
    f = np.float32
    X, Y, Z, S = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    NX, NY, NZ = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    P, Q = np.empty(BLOCK, f), np.empty(BLOCK, f)
    rise, clear, cosine, sigma_n = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    tint, row, columns = np.empty(BLOCK, f), np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    for i in range(first, last):
        for col in range(0, weight.shape[1], BLOCK):
            n = min(BLOCK, weight.shape[1] - col)
            for k in range(n):
                columns[k] = (col + k) * step
            _own(side, i * step, columns, n, row, X, Y, Z)
            _fetch(side, row, columns, n, S, P, Q, rise, clear)
            decode(P, Q, n, NX, NY, NZ)
            weigh(X, Y, Z, S, NX, NY, NZ, rise, side.centre, limits, n, cosine, sigma_n, weight[i, col : col + n], tint)
            locate(X, Y, Z, raster, rows, cols, n, row_out[i, col : col + n], column_out[i, col : col + n])
