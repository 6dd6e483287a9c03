"""What other views say of a point: where it lies in their pictures, and whether they look through it.

Arrays and scalars only. In float32, in blocks of pixels that compilers turn into vector instructions; what looks
suspicious there is judged by the slow way, in float64.
"""

import math
from typing import NamedTuple

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.lens import to_plane
from fringescope.kernels.raw import unowned
from fringescope.threads import by_rows

BLOCK = 512  #: pixels of a row that are worked on together
TILE = 8  #: side, in pixels, of the tiles that are judged as a whole
EDGE = np.float32(0.01)  #: pixels by which float32 may miss the border of a picture
ROUNDING = np.float32(2e-6)  #: of a depth, in float32

_f = np.float32
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_NAN = np.float32(np.nan)
_ADD1, _ADD2 = np.uintp(1), np.uintp(2)  # to indices, which are quicker without a sign
_CONTRACT = {"contract"}


class View(NamedTuple):
    """A view's points, and how its camera sees the world."""

    xyz: np.ndarray  #: (H * W * 3,) float32, world mm, NaN where there is none
    sigma: np.ndarray  #: (H * W,) float32, mm along the ray
    height: int
    width: int
    pose: np.ndarray  #: (12,) float64: R row by row, t
    lens: np.ndarray  #: (10,) float64, see `kernels.lens`


def constant(a: np.ndarray) -> np.ndarray:
    """An array, contiguous and not to be written to: kernels see one type, whoever made it."""
    a = np.ascontiguousarray(a).view()
    a.setflags(write=False)
    return a


@njit(cache=True, nogil=True, error_model="numpy")
def split(row, col, n, X, Y, Z):
    """Points of columns col..col+n-1 of a row (3 W,) into one array per coordinate; returns how many there are."""
    part = row[3 * col : 3 * (col + n)]
    some = 0
    for k in range(n):
        x = part[3 * k]
        X[k] = x
        Y[k] = part[3 * k + 1]
        Z[k] = part[3 * k + 2]
        some += x == x
    return some


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def project(X, Y, Z, pose, lens, n, U, V, D):
    """World points to plane coordinates U, V (pixels) and depths D along the camera's axis, mm."""
    r00, r01, r02, r10, r11, r12 = _f(pose[0]), _f(pose[1]), _f(pose[2]), _f(pose[3]), _f(pose[4]), _f(pose[5])
    r20, r21, r22, t0, t1, t2 = _f(pose[6]), _f(pose[7]), _f(pose[8]), _f(pose[9]), _f(pose[10]), _f(pose[11])
    bend = (
        _f(lens[0]), _f(lens[1]), _f(lens[2]), _f(lens[3]), _f(lens[4]), _f(lens[5]), _f(lens[6]), _f(lens[7]),
        _f(lens[8]), _f(lens[9]),
    )  # fmt: skip
    for k in range(n):
        x, y, z = X[k], Y[k], Z[k]
        depth = r20 * x + r21 * y + r22 * z + t2
        inverse = _ONE / depth
        u, v = to_plane(
            (r00 * x + r01 * y + r02 * z + t0) * inverse, (r10 * x + r11 * y + r12 * z + t1) * inverse, bend
        )
        U[k], V[k], D[k] = u, v, depth


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def places(U, V, D, height, width, edge, n, place):
    """The number of the pixel nearest to each (U, V), row by row, if that lies in the picture, grown by `edge`, in
    front of the camera; else -1.
    """
    high_u, high_v, wide = _f(width - 1), _f(height - 1), np.int32(width)
    for k in range(n):
        u, v = U[k], V[k]
        inside = (D[k] > _ZERO) & (u >= -edge) & (v >= -edge) & (u <= high_u + edge) & (v <= high_v + edge)
        u = min(max(u, _ZERO), high_u) if inside else _ZERO
        v = min(max(v, _ZERO), high_v) if inside else _ZERO
        at = np.int32(v + _HALF) * wide + np.int32(u + _HALF)
        place[k] = np.int32(at) if inside else np.int32(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(place, xyz, sigma, n):
    """Reads every fourth of the pixels that will be needed, whose lines then come to the caches side by side."""
    some = _ZERO
    for k in range(0, n, 4):
        p = np.uintp(max(place[k], 0))
        some += xyz[p + p + p] + sigma[p]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _pick(place, xyz, sigma, n, X, Y, Z, S):
    """The points and sigmas of pixels, NaN where there is none."""
    for k in range(n):
        p = np.uintp(max(place[k], 0))
        S[k] = sigma[p]
        p += p + p
        X[k], Y[k], Z[k] = xyz[p], xyz[p + _ADD1], xyz[p + _ADD2]
    for k in range(n):
        X[k] = X[k] if place[k] >= 0 else _NAN


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _suspects(D, X, Y, Z, sigma, S, pose, tolerance, slack, n, ask):
    """Mark points at depths D that lie in front of the other view's points (X, Y, Z) by more than both sigmas."""
    r0, r1, r2, t = _f(pose[6]), _f(pose[7]), _f(pose[8]), _f(pose[11])
    for k in range(n):
        d = r0 * X[k] + r1 * Y[k] + r2 * Z[k] + t
        noise = math.sqrt(sigma[k] * sigma[k] + S[k] * S[k])
        ask[k] = D[k] < d - (tolerance * noise + slack * D[k])


@njit(cache=True, nogil=True, error_model="numpy")
def examine(x, y, z, sigma, other, tolerance, slack):
    """One point against the surface of another view: 1 confirmed, -1 denied, 0 no evidence (see `contradicted`)."""
    R, L, w = other.pose, other.lens, other.width
    depth = R[6] * x + R[7] * y + R[8] * z + R[11]
    if not depth > 0.0:
        return 0
    u, v = to_plane(
        (R[0] * x + R[1] * y + R[2] * z + R[9]) / depth, (R[3] * x + R[4] * y + R[5] * z + R[10]) / depth, L
    )
    if not (0.0 <= u < w - 1 and 0.0 <= v < other.height - 1):
        return 0
    a, b = int(v), int(u)
    fy, fx = v - a, u - b
    there, low, high, noise = 0.0, np.inf, -np.inf, 0.0
    for k in range(4):
        i, j = k >> 1, k & 1
        p = (a + i) * w + b + j
        d = R[6] * other.xyz[3 * p] + R[7] * other.xyz[3 * p + 1] + R[8] * other.xyz[3 * p + 2] + R[11]
        there += (fy if i == 1 else 1.0 - fy) * (fx if j == 1 else 1.0 - fx) * d
        low, high = min(low, d), max(high, d)
        noise = max(noise, float(other.sigma[p]))
    if there != there:
        return 0
    limit = tolerance * math.sqrt(sigma * sigma + noise * noise) + slack * depth / L[0] + (high - low)
    if depth < there - limit:
        return -1
    return 1 if depth <= there + limit else 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _sum_rows(rows, n, upper, lower):
    """Sums of the columns of rows 0..3, and of rows 4..7."""
    a, b, c, d, e, f, g, h = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]
    for k in range(n):
        upper[k] = (a[k] + b[k]) + (c[k] + d[k])
        lower[k] = (e[k] + f[k]) + (g[k] + h[k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _lean(upper, lower, t, per_x, per_y):
    """Mean of tile t of a coordinate, and how much it grows to its last column, and to its last row."""
    a = (upper[t] + upper[t + 1]) + (upper[t + 2] + upper[t + 3])
    b = (upper[t + 4] + upper[t + 5]) + (upper[t + 6] + upper[t + 7])
    c = (lower[t] + lower[t + 1]) + (lower[t + 2] + lower[t + 3])
    d = (lower[t + 4] + lower[t + 5]) + (lower[t + 6] + lower[t + 7])
    return ((a + b) + (c + d)) * _f(1 / 64), ((b - a) + (d - c)) * per_x, ((c - a) + (d - b)) * per_y


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _stray(X, Y, Z, sigma, y, F, n, low, high, stray, least):
    """How far the points of row y of tiles, -1..1, lie from their planes F: along the normal, and at all (squared)."""
    px, py, pz, bx, by, bz, nx, ny, nz = F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8]
    for k in range(n):
        dx, dy, dz = X[k] - (px[k] + y * bx[k]), Y[k] - (py[k] + y * by[k]), Z[k] - (pz[k] + y * bz[k])
        s = nx[k] * dx + ny[k] * dy + nz[k] * dz
        away = dx * dx + dy * dy + dz * dz
        a, b, c, d = low[k], high[k], stray[k], least[k]
        a, b, c, d = a + _ZERO, b + _ZERO, c + _ZERO, d + _ZERO  # else masked stores, which are slow: see tiles.py
        low[k] = s if s < a else a
        high[k] = s if s > b else b
        stray[k] = away if away > c else c
        least[k] = sigma[k] if sigma[k] < d else d


@by_rows(lambda _view, _centre, out: out.shape[0])
def planes(first, last, view, centre, out):
    """A plane through the points of each tile of TILE x TILE pixels: `out` (h, w, 16).

    Its middle; from there to the middle of the last column, and of the last row; its unit normal towards the camera at
    `centre` (3,); least and greatest distance of a point from it, along the normal; greatest distance of a point from
    where a plane would have it, in any direction; least sigma. Where points are missing the normal is NaN, and the
    middle is too if there is none at all.
    """
    W = view.width
    xyz, sigma, out = unowned(view.xyz), unowned(view.sigma), unowned(out)
    f = np.float32
    X, Y, Z = np.empty((TILE, BLOCK), f), np.empty((TILE, BLOCK), f), np.empty((TILE, BLOCK), f)
    xu, xl, yu, yl, zu, zl = (
        np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f),
        np.empty(BLOCK, f),
    )  # fmt: skip
    F, some, side = np.empty((9, BLOCK), f), np.empty(TILE, np.int64), np.empty(TILE, f)
    for j in range(TILE):
        side[j] = _f(j - 3.5) * _f(1 / 3.5)
    low, high, stray, least = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    half = _f(3.5 / 4 / 32)  # sums of two times sixteen points four pixels apart, to three and a half
    cx, cy, cz = _f(centre[0]), _f(centre[1]), _f(centre[2])
    for t in range(first, last):
        for col in range(0, W, BLOCK):
            n = min(BLOCK, W - col)
            rows = min(TILE, view.height - t * TILE)
            found = 0
            for r in range(rows):
                i = t * TILE + r
                some[r] = split(xyz[3 * i * W : 3 * (i + 1) * W], col, n, X[r], Y[r], Z[r])
                found += some[r]
            tiles = out[t, col // TILE : (col + n + TILE - 1) // TILE]
            if found < rows * n or rows < TILE or n % TILE:
                for q in range(len(tiles)):
                    points = 0
                    for r in range(rows):
                        for k in range(TILE * q, min(TILE * q + TILE, n)):
                            points += X[r, k] == X[r, k]
                    tiles[q, 9] = _NAN if points < TILE * TILE else _ZERO
                    tiles[q, 0] = _ZERO if points > 0 else _NAN
            else:
                for q in range(len(tiles)):
                    tiles[q, 0] = tiles[q, 9] = _ZERO
            if found == 0 or rows < TILE:
                continue
            _sum_rows(X, n, xu, xl)
            _sum_rows(Y, n, yu, yl)
            _sum_rows(Z, n, zu, zl)
            for q in range(len(tiles)):
                k = TILE * q
                a = tiles[q]
                if a[9] != a[9]:
                    continue
                a[0], a[3], a[6] = _lean(xu, xl, k, half, half)
                a[1], a[4], a[7] = _lean(yu, yl, k, half, half)
                a[2], a[5], a[8] = _lean(zu, zl, k, half, half)
                nx, ny, nz = a[4] * a[8] - a[5] * a[7], a[5] * a[6] - a[3] * a[8], a[3] * a[7] - a[4] * a[6]
                scale = _ONE / math.sqrt(nx * nx + ny * ny + nz * nz)
                if nx * (cx - a[0]) + ny * (cy - a[1]) + nz * (cz - a[2]) < _ZERO:
                    scale = -scale
                a[9], a[10], a[11] = nx * scale, ny * scale, nz * scale
                for c in range(3):
                    middle, across, down, up = a[c], a[3 + c], a[6 + c], a[9 + c]
                    for j in range(TILE):
                        F[c, k + j] = middle + side[j] * across
                        F[3 + c, k + j] = down
                        F[6 + c, k + j] = up
            for k in range(n):
                low[k] = least[k] = np.inf
                high[k] = stray[k] = -np.inf
            for r in range(TILE):
                p = (t * TILE + r) * W + col
                y = _f(r - 3.5) * _f(1 / 3.5)
                _stray(X[r], Y[r], Z[r], sigma[p : p + n], y, F, n, low, high, stray, least)
            for q in range(len(tiles)):
                k = TILE * q
                a = tiles[q]
                if a[9] != a[9]:
                    continue
                for j in range(1, TILE):
                    low[k], high[k] = min(low[k], low[k + j]), max(high[k], high[k + j])
                    stray[k], least[k] = max(stray[k], stray[k + j]), min(least[k], least[k + j])
                a[12], a[13], a[14], a[15] = low[k], high[k], math.sqrt(stray[k]), least[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _highest(xyz, first, stride, nx, ny, nz):
    """The largest component along a normal of the points of a tile whose first is at `first` of xyz."""
    best = -_f(np.inf)
    for r in range(TILE):
        p = first + r * stride
        for k in range(TILE):
            q = np.uintp(p + 3 * k)
            s = xyz[q] * nx + xyz[q + _ADD1] * ny + xyz[q + _ADD2] * nz
            best = s if s > best else best
    return best


@by_rows(lambda _view, own, *_: own.shape[0])
def doubtful(first, last, view, own, other, plane, tolerance, slack, out):
    """The tiles (h, w) that may hold a point which the other view denies: see `contradicted`.

    `own` and `plane` are the `planes` of the view and of the other. A point lies within known distances of its tile's
    plane, or where it lies, and the other view's at the nearest pixel within known distances of that tile's plane:
    where these leave no room for a point too far in front, none needs to be looked for.
    """
    R, L = other.pose, other.lens
    h, w = plane.shape[0], plane.shape[1]
    per = 1.05 / min(L[0], L[1])
    for t in range(first, last):
        for u in range(own.shape[1]):
            out[t, u] = own[t, u, 0] == own[t, u, 0]
            if own[t, u, 9] != own[t, u, 9]:
                continue
            mx, my, mz = float(own[t, u, 0]), float(own[t, u, 1]), float(own[t, u, 2])
            ax, ay, az = float(own[t, u, 3]), float(own[t, u, 4]), float(own[t, u, 5])
            bx, by, bz = float(own[t, u, 6]), float(own[t, u, 7]), float(own[t, u, 8])
            stray, sigma = float(own[t, u, 14]), float(own[t, u, 15])
            left = top = near = np.inf
            right = low = far = -np.inf
            for c in range(4):
                p, q = (1.0 if c & 1 else -1.0), (1.0 if c & 2 else -1.0)
                x, y, z = mx + p * ax + q * bx, my + p * ay + q * by, mz + p * az + q * bz
                depth = R[6] * x + R[7] * y + R[8] * z + R[11]
                per_depth = 1.0 / depth
                i, j = to_plane((R[0] * x + R[1] * y + R[2] * z + R[9]) * per_depth,
                                (R[3] * x + R[4] * y + R[5] * z + R[10]) * per_depth, L)
                left, right, top, low = min(left, i), max(right, i), min(top, j), max(low, j)
                near, far = min(near, depth), max(far, depth)
            if not near > 2.0 * stray:
                continue
            margin = 1.0 + 2.0 * stray / ((near - stray) * per)
            left, right, top, low = left - margin, right + margin, top - margin, low + margin
            if right < 0.0 or low < 0.0 or left > other.width - 1.0 or top > other.height - 1.0:
                out[t, u] = False
                continue
            if not (right - left < 16 * TILE and low - top < 16 * TILE):
                continue
            pixel, footprint = 0.5 * (far + stray) * per, slack * (near - stray) / L[0]
            across, down = (0.5 * (left + right) - L[2]) / L[0], (0.5 * (top + low) - L[3]) / L[1]
            sure = True
            for tt in range(int(max(top, 0.0)) // TILE, min(int(low) // TILE, h - 1) + 1):
                for uu in range(int(max(left, 0.0)) // TILE, min(int(right) // TILE, w - 1) + 1):
                    if not sure or plane[tt, uu, 0] != plane[tt, uu, 0]:
                        continue  # no point at all
                    nx, ny, nz = float(plane[tt, uu, 9]), float(plane[tt, uu, 10]), float(plane[tt, uu, 11])
                    ex, ey = abs(R[0] * nx + R[1] * ny + R[2] * nz), abs(R[3] * nx + R[4] * ny + R[5] * nz)
                    along = -(R[6] * nx + R[7] * ny + R[8] * nz)
                    along -= across * (R[0] * nx + R[1] * ny + R[2] * nz) + down * (R[3] * nx + R[4] * ny + R[5] * nz)
                    along -= 0.02 * (ex + ey)
                    noise = math.sqrt(sigma * sigma + float(plane[tt, uu, 15]) * float(plane[tt, uu, 15]))
                    limit = plane[tt, uu, 12] + 0.999 * along * (tolerance * noise + footprint) - pixel * (ex + ey)
                    limit -= 2e-6 * far
                    if not (along > 0.0 and limit == limit):
                        sure = False
                        continue
                    base = nx * plane[tt, uu, 0] + ny * plane[tt, uu, 1] + nz * plane[tt, uu, 2]
                    same = nx * own[t, u, 9] + ny * own[t, u, 10] + nz * own[t, u, 11]
                    above = nx * mx + ny * my + nz * mz - base + abs(nx * ax + ny * ay + nz * az)
                    above += abs(nx * bx + ny * by + nz * bz) + max(same * own[t, u, 12], same * own[t, u, 13])
                    above += stray * math.sqrt(max(1.0 - same * same, 0.0))
                    if above > limit:
                        start = 3 * (t * TILE * view.width + u * TILE)
                        above = _highest(view.xyz, start, 3 * view.width, _f(nx), _f(ny), _f(nz)) - base
                    sure = above <= limit
            out[t, u] = not sure


@njit(cache=True, nogil=True, error_model="numpy")
def _append(top, end, left, right, width, n, place):
    """Append the pixels of a tile to the `n` places."""
    for i in range(top, end):
        for j in range(left, right):
            place[n] = i * width + j
            n += 1
    return n


@by_rows(lambda _own, _others, _count, _tolerance, _slack, asked, *_: asked.shape[1])
def contradicted(first, last, own, others, count, tolerance, slack, asked, bad, lost):
    """Points that one of the first `count` of the `others` looks through, and that none confirms: 1 in `bad` (H, W).

    The other surface is interpolated between four pixels that all carry points. Nearer than `tolerance` combined sigmas
    plus `slack` pixel footprints plus the rise among the four: confirmed. In front of it by more: denied. Behind it:
    hidden there, no evidence. Depths are along the other camera's axis. `bad` comes as zeros; `lost` (H,) counts. Only
    the tiles `asked` (V, h, w) are compared with each of the others. Rows first..last-1 are rows of tiles.

    What is denied lies in front of each of the four by more than both their sigmas and the footprints: only points that
    lie so far in front of the nearest pixel's are examined.
    """
    W = own.width
    X, Y, Z = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    U, V, D = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    A, B, C = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    sigma, S, ask = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.bool_)
    here, there = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    marked = bad.reshape(-1)
    touched = _ZERO
    for t in range(first, last):
        top, end = t * TILE, min(t * TILE + TILE, own.height)
        lost[top:end] = 0
        for o in range(count):
            other = others[o]
            footprint = _f(slack / other.lens[0]) - ROUNDING
            u = 0
            while u < asked.shape[2]:
                n = 0
                while u < asked.shape[2] and n + TILE * TILE <= BLOCK:
                    if asked[o, t, u]:
                        n = _append(top, end, TILE * u, min(TILE * u + TILE, W), W, n, here)
                    u += 1
                if n == 0:
                    continue
                _pick(here, own.xyz, own.sigma, n, X, Y, Z, sigma)
                project(X, Y, Z, other.pose, other.lens, n, U, V, D)
                places(U, V, D, other.height, other.width, EDGE, n, there)
                touched += _touch(there, other.xyz, other.sigma, n)
                _pick(there, other.xyz, other.sigma, n, A, B, C, S)
                _suspects(D, A, B, C, sigma, S, other.pose, _f(tolerance), footprint, n, ask)
                for k in range(n):
                    if not ask[k] or marked[here[k]] != 0:
                        continue
                    denied = confirmed = 0
                    for q in range(count):
                        said = examine(float(X[k]), float(Y[k]), float(Z[k]), float(sigma[k]), others[q], tolerance,
                                       slack)  # fmt: skip
                        denied += said < 0
                        confirmed += said > 0
                    if denied > 0 and confirmed == 0:
                        marked[here[k]] = 1
                        lost[here[k] // W] += 1
    X[0] = touched  # so that no compiler takes the reading away


@by_rows(lambda bad, *_: bad.shape[0])
def blank(first, last, bad, lost, bit, xyz, sigma, reasons):
    """Take the points marked in `bad` (H, W) away, in rows that have `lost` some, and give them the reason `bit`."""
    for i in range(first, last):
        if lost[i] == 0:
            continue
        for j in range(bad.shape[1]):
            if bad[i, j]:
                reasons[i, j] |= bit
                sigma[i, j] = np.nan
                for k in range(3):
                    xyz[i, j, k] = np.nan
