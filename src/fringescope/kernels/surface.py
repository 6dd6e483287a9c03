"""Loops over organised points: normals, borders, sampling.

Arrays and scalars only. `xyz` (H, W, 3) float32 world mm with NaN holes. Normals of calm surfaces, where the window is
whole and no jump in it, come from loops that compilers turn into vector instructions; all others from the slow way.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.raw import unowned
from fringescope.kernels.views import split
from fringescope.threads import by_rows

BLOCK = 1024  #: pixels of a row that are worked on together
REACH = 2  #: radius of the windows that the fast way knows
CODE = 32767  #: a normal's code is this times its octahedral coordinates
NOTHING = -32768  #: lower half of the code where there is no point
SOME, TORN = 1, 2  #: bits of a square of pixels: it has a point, a jump

_f = np.float32
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_NAN = np.float32(np.nan)
_CONTRACT = {"contract"}


@njit(cache=True, inline="always", error_model="numpy")
def _unit(x, y, z):
    s = math.sqrt(x * x + y * y + z * z)
    return x / s, y / s, z / s


@njit(cache=True, inline="always", error_model="numpy")
def _apart(qx, qy, qz, rx, ry, rz, noise, max_slope):
    """Whether a chord (qx, qy, qz) leads across a jump, seen along the ray (rx, ry, rz)."""
    along = qx * rx + qy * ry + qz * rz
    across = math.sqrt(max(qx * qx + qy * qy + qz * qz - along * along, 0.0))
    return abs(along) > max_slope * across + noise


@njit(cache=True, nogil=True, error_model="numpy")
def regression(xyz, sigma, i, j, cx, cy, cz, radius, max_slope, jump_sigma):
    """Normal of pixel (i, j), which has a point, by least squares over its window: see `normals`."""
    H, W = sigma.shape
    px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
    rx, ry, rz = _unit(px - cx, py - cy, pz - cz)
    n = sx = sy = sxx = sxy = syy = 0.0
    ax = ay = az = bx = by = bz = dx = dy = dz = 0.0
    for ii in range(max(i - radius, 0), min(i + radius + 1, H)):
        for jj in range(max(j - radius, 0), min(j + radius + 1, W)):
            if not math.isfinite(xyz[ii, jj, 0]):
                continue
            qx, qy, qz = xyz[ii, jj, 0] - px, xyz[ii, jj, 1] - py, xyz[ii, jj, 2] - pz
            if _apart(qx, qy, qz, rx, ry, rz, jump_sigma * (float(sigma[i, j]) + sigma[ii, jj]), max_slope):
                continue
            u, v = float(jj - j), float(ii - i)
            n += 1.0
            sx += u
            sy += v
            sxx += u * u
            sxy += u * v
            syy += v * v
            ax += qx
            ay += qy
            az += qz
            bx += u * qx
            by += u * qy
            bz += u * qz
            dx += v * qx
            dy += v * qy
            dz += v * qz
    mx, my = sx / n, sy / n
    vxx, vxy, vyy = sxx - sx * mx, sxy - sx * my, syy - sy * my
    det = vxx * vyy - vxy * vxy
    if n < 3.0 or det < 1e-6 * (vxx + vyy) * (vxx + vyy) or det <= 0.0:
        return -rx, -ry, -rz
    bx, by, bz = bx - mx * ax, by - mx * ay, bz - mx * az
    dx, dy, dz = dx - my * ax, dy - my * ay, dz - my * az
    ux, uy, uz = vyy * bx - vxy * dx, vyy * by - vxy * dy, vyy * bz - vxy * dz
    wx, wy, wz = vxx * dx - vxy * bx, vxx * dy - vxy * by, vxx * dz - vxy * bz
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not size > 0.0:
        return -rx, -ry, -rz
    if nx * rx + ny * ry + nz * rz > 0.0:
        size = -size
    return nx / size, ny / size, nz / size


@njit(cache=True, nogil=True, error_model="numpy")
def torn(xyz, sigma, i, j, cx, cy, cz, max_slope, jump_sigma):
    """Whether the left, right, upper or lower neighbour of pixel (i, j), which has a point, lies across a jump."""
    H, W = sigma.shape
    px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
    rx, ry, rz = _unit(px - cx, py - cy, pz - cz)
    for side in range(4):
        ii = i + (1 if side == 0 else -1 if side == 1 else 0)
        jj = j + (1 if side == 2 else -1 if side == 3 else 0)
        if ii < 0 or jj < 0 or ii >= H or jj >= W or not math.isfinite(xyz[ii, jj, 0]):
            continue
        qx, qy, qz = xyz[ii, jj, 0] - px, xyz[ii, jj, 1] - py, xyz[ii, jj, 2] - pz
        if _apart(qx, qy, qz, rx, ry, rz, jump_sigma * (float(sigma[i, j]) + sigma[ii, jj]), max_slope):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _ranges(X, Y, Z, cx, cy, cz, m, R):
    for k in range(m):
        x, y, z = X[k] - cx, Y[k] - cy, Z[k] - cz
        R[k] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def _take_row(flat, sigma, i, col, m, cx, cy, cz, X, Y, Z, R, S):
    """Columns col .. col + m - 1 of row i, NaN beyond the picture."""
    H, W = sigma.shape
    if i < 0 or i >= H:
        for k in range(m):
            X[k] = Y[k] = Z[k] = R[k] = S[k] = _NAN
        return
    a, b = max(col, 0), min(col + m, W)
    for k in range(a - col):
        X[k] = Y[k] = Z[k] = S[k] = _NAN
    split(flat[i], a, b - a, X[a - col :], Y[a - col :], Z[a - col :])
    part, target = sigma[i, a:b], S[a - col :]
    for k in range(b - a):
        target[k] = part[k]
    for k in range(b - col, m):
        X[k] = Y[k] = Z[k] = S[k] = _NAN
    _ranges(X, Y, Z, cx, cy, cz, m, R)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _columns(p0, p1, p2, p3, p4, ref, m, total, slope):
    """Sums over five rows of a coordinate, and of it times y = -2 .. 2."""
    for k in range(m):
        a, b, c, d, e = p0[k] - ref, p1[k] - ref, p2[k] - ref, p3[k] - ref, p4[k] - ref
        total[k] = (a + e) + (b + d) + c
        slope[k] = (e - a) + (e - a) + (d - b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _extremes(p0, p1, p2, p3, p4, m, low, high):
    for k in range(m):
        low[k] = min(min(min(p0[k], p1[k]), min(p2[k], p3[k])), p4[k])
        high[k] = max(max(max(p0[k], p1[k]), max(p2[k], p3[k])), p4[k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _least(p0, p1, p2, p3, p4, m, low):
    for k in range(m):
        low[k] = min(min(min(p0[k], p1[k]), min(p2[k], p3[k])), p4[k])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _across(total, slope, n, u, v):
    """Sums over the window of a coordinate times x, and times y."""
    for k in range(n):
        u[k] = (total[k + 4] - total[k]) + (total[k + 4] - total[k]) + (total[k + 3] - total[k + 1])
        v[k] = (slope[k] + slope[k + 4]) + (slope[k + 1] + slope[k + 3]) + slope[k + 2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _calm(low, high, least, R, S, slope, bend, jump_sigma, n, ask):
    """Ask where some range in the window differs by more than what is no jump even next door."""
    for k in range(n):
        lowest = min(min(min(low[k], low[k + 1]), min(low[k + 3], low[k + 4])), low[k + 2])
        highest = max(max(max(high[k], high[k + 1]), max(high[k + 3], high[k + 4])), high[k + 2])
        s = min(min(min(least[k], least[k + 1]), min(least[k + 3], least[k + 4])), least[k + 2])
        r = R[k + 2]
        limit = slope * r + jump_sigma * (S[k + 2] + s) - bend * r
        ask[k] = not ((highest - r <= limit) & (r - lowest <= limit))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _cross(ux, vx, uy, vy, uz, vz, X, Y, Z, cx, cy, cz, n, NX, NY, NZ, ask):
    """Unit normals towards the camera from the slopes along both axes; ask where there is none."""
    for k in range(n):
        x, y, z = uy[k] * vz[k] - uz[k] * vy[k], uz[k] * vx[k] - ux[k] * vz[k], ux[k] * vy[k] - uy[k] * vx[k]
        size = x * x + y * y + z * z
        away = x * (X[k + 2] - cx) + y * (Y[k + 2] - cy) + z * (Z[k + 2] - cz)
        scale = _ONE / math.sqrt(size)
        scale = -scale if away > _ZERO else scale
        NX[k], NY[k], NZ[k] = x * scale, y * scale, z * scale
        ask[k] = ask[k] | (not size > _ZERO)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _encode(X, NX, NY, NZ, n, out):
    """Unit normals to octahedral coordinates, two of 16 bits in an int32, to 3e-5 rad; NOTHING where there is no point.
    """
    for k in range(n):
        x, y, z = NX[k], NY[k], NZ[k]
        share = _f(CODE) / (abs(x) + abs(y) + abs(z))
        u, v = x * share, y * share
        fu, fv = _f(CODE) - abs(v), _f(CODE) - abs(u)
        fu, fv = (fu if u >= _ZERO else -fu), (fv if v >= _ZERO else -fv)
        u, v = (u if z >= _ZERO else fu), (v if z >= _ZERO else fv)
        u += _HALF if u >= _ZERO else -_HALF
        v += _HALF if v >= _ZERO else -_HALF
        none = X[k + 2] != X[k + 2]
        low, high = np.int32(_f(NOTHING) if none else u), np.int32(_ZERO if none else v)
        out[k] = np.int32((low & 65535) | (high << 16))


@njit(cache=True, nogil=True, error_model="numpy")
def _first(X, m):
    """A number among X, or 0: what sums are taken from, so that float32 keeps their digits."""
    for k in range(m):
        if X[k] == X[k]:
            return X[k]
    return _ZERO


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def locate(X, Y, Z, raster, rows, cols, n, row, column):
    """The raster's cell that each point lies in, those beyond it in its border; row -1 where there is no point.

    `raster` (15,): R and t of the device whose ideal coordinates span the raster, its origin, cells per unit.
    """
    r00, r01, r02, r10, r11, r12 = (
        _f(raster[0]), _f(raster[1]), _f(raster[2]), _f(raster[3]), _f(raster[4]), _f(raster[5]),
    )  # fmt: skip
    r20, r21, r22, t0, t1, t2 = (
        _f(raster[6]), _f(raster[7]), _f(raster[8]), _f(raster[9]), _f(raster[10]), _f(raster[11]),
    )  # fmt: skip
    a0, b0, scale, high_c, high_r = _f(raster[12]), _f(raster[13]), _f(raster[14]), _f(cols - 1), _f(rows - 1)
    for k in range(n):
        x, y, z = X[k], Y[k], Z[k]
        depth = r20 * x + r21 * y + r22 * z + t2
        inverse = _ONE / depth
        a = ((r00 * x + r01 * y + r02 * z + t0) * inverse - a0) * scale
        b = ((r10 * x + r11 * y + r12 * z + t1) * inverse - b0) * scale
        there = depth > _ZERO
        column[k] = np.int32(min(max(a, _ZERO), high_c) if there else _ZERO)
        row[k] = np.int32(min(max(b, _ZERO), high_r) if there else -_ONE)


@njit(cache=True, nogil=True, error_model="numpy")
def _walk(first, last, xyz, flat, sigma, centre, angle, radius, max_slope, jump_sigma, out, code, squares, step, raster,
          there):  # fmt: skip
    """Rows first..last-1 of `normals` (where `out` has rows) and of `survey` (where `code` has)."""
    xyz, flat, sigma, out = unowned(xyz), unowned(flat), unowned(sigma), unowned(out)
    code, squares, raster, there = unowned(code), unowned(squares), unowned(raster), unowned(there)
    W = sigma.shape[1]
    m = BLOCK + 4
    f = np.float32
    cx, cy, cz = _f(centre[0]), _f(centre[1]), _f(centre[2])
    X, Y, Z = np.empty((5, m), f), np.empty((5, m), f), np.empty((5, m), f)
    R, S = np.empty((5, m), f), np.empty((5, m), f)
    total, slope = np.empty(m, f), np.empty(m, f)
    low, high, least = np.empty(m, f), np.empty(m, f), np.empty(m, f)
    ux, vx, uy, vy, uz, vz = (
        np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f),
        np.empty(BLOCK, f),
    )  # fmt: skip
    NX, NY, NZ, ask = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, np.bool_)
    row, column = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    lean, bend = _f(0.95 * max_slope * angle), _f(4.0 * angle * angle + 1e-6)
    jump = _f(jump_sigma)
    for col in range(0, W, BLOCK):
        n = min(BLOCK, W - col)
        wide = n + 4
        for i in range(first - 2, last + 2):
            s = (i + 10) % 5
            _take_row(flat, sigma, i, col - 2, wide, cx, cy, cz, X[s], Y[s], Z[s], R[s], S[s])
            i -= 2
            if i < first:
                continue
            a, b, c, d, e = (i + 8) % 5, (i + 9) % 5, (i + 10) % 5, (i + 11) % 5, (i + 12) % 5
            if radius == REACH:
                ref = _first(X[c], wide)
                _columns(X[a], X[b], X[c], X[d], X[e], ref, wide, total, slope)
                _across(total, slope, n, ux, vx)
                ref = _first(Y[c], wide)
                _columns(Y[a], Y[b], Y[c], Y[d], Y[e], ref, wide, total, slope)
                _across(total, slope, n, uy, vy)
                ref = _first(Z[c], wide)
                _columns(Z[a], Z[b], Z[c], Z[d], Z[e], ref, wide, total, slope)
                _across(total, slope, n, uz, vz)
                _extremes(R[a], R[b], R[c], R[d], R[e], wide, low, high)
                _least(S[a], S[b], S[c], S[d], S[e], wide, least)
                _calm(low, high, least, R[c], S[c], lean, bend, jump, n, ask)
                _cross(ux, vx, uy, vy, uz, vz, X[c], Y[c], Z[c], cx, cy, cz, n, NX, NY, NZ, ask)
            else:
                ask[:n] = True
            centre_x = X[c]
            for k in range(n):
                if ask[k] and centre_x[k + 2] == centre_x[k + 2]:
                    NX[k], NY[k], NZ[k] = regression(
                        xyz, sigma, i, col + k, centre[0], centre[1], centre[2], radius, max_slope, jump_sigma
                    )
                    if len(code) > 0 and torn(
                        xyz, sigma, i, col + k, centre[0], centre[1], centre[2], max_slope, jump_sigma
                    ):
                        squares[i // step, (col + k) // step] |= TORN
            if len(out) > 0:
                for k in range(n):
                    none = centre_x[k + 2] != centre_x[k + 2]
                    out[i, col + k, 0] = _NAN if none else NX[k]
                    out[i, col + k, 1] = _NAN if none else NY[k]
                    out[i, col + k, 2] = _NAN if none else NZ[k]
            if len(code) > 0:
                _encode(centre_x, NX, NY, NZ, n, code[i, col : col + n])
                locate(X[c][2:], Y[c][2:], Z[c][2:], raster, there.shape[0], there.shape[1], n, row, column)
                for k in range(n):
                    if row[k] >= 0:
                        there[row[k], column[k]] = 1
                for q in range(col // step, (col + n - 1) // step + 1):
                    for k in range(max(q * step - col, 0), min((q + 1) * step - col, n)):
                        if row[k] >= 0:
                            squares[i // step, q] |= SOME
                            break


@by_rows(lambda xyz, *_: xyz.shape[0])
def normals(first, last, xyz, flat, sigma, centre, angle, radius, max_slope, jump_sigma, out):
    """Unit normals (H, W, 3) towards the camera at `centre` (3,): regression of xyz on pixel coordinates.

    The window is (2 radius + 1)^2. Neighbours whose range along the ray differs by more than `max_slope` times their
    sideways distance plus `jump_sigma` standard deviations lie across a jump and do not count. Pixel coordinates are
    free of noise, so the slope is unbiased, unlike that of a principal-axis fit. Where no plane can be fitted the
    normal points to the camera; NaN where there is no point. `flat` (H, 3 W) are the same points; `angle` is the least
    angle between the rays of neighbouring pixels: what lies no farther apart along the ray is no jump.
    """
    none, one = np.empty((0, 0), np.int32), np.empty((0, 0), np.uint8)
    _walk(first, last, xyz, flat, sigma, centre, angle, radius, max_slope, jump_sigma, out, none, one, 1,
          np.empty(0), one)  # fmt: skip


@by_rows(lambda _xyz, _flat, _sigma, _centre, _angle, _radius, _slope, _jump, squares, *_: squares.shape[0])
def survey(first, last, xyz, flat, sigma, centre, angle, radius, max_slope, jump_sigma, squares, step, raster, code,
           there):  # fmt: skip
    """What fusion must know of every pixel: `code` (H, W) int32 of its normal (see `normals`, `fusing.decode`).

    `squares` (h, w), zeros, gets the bits of squares of `step` x `step` pixels; `there` (rows, cols) gets 1 in cells of
    the raster (see `locate`) that hold a point. Rows are rows of squares.
    """
    end = min(last * step, sigma.shape[0])
    _walk(first * step, end, xyz, flat, sigma, centre, angle, radius, max_slope, jump_sigma,
          np.empty((0, 0, 0), np.float32), code, squares, step, raster, there)  # fmt: skip


@by_rows(lambda xyz, step, *_: -(-xyz.shape[0] // step))
def spacing(first, last, xyz, step, out):
    """Distance in mm of every `step`-th pixel to the nearer of its right and lower neighbours; NaN without any."""
    H, W = xyz.shape[0], xyz.shape[1]
    for i in range(first, last):
        for j in range(out.shape[1]):
            best = np.inf
            for side in range(2):
                ii, jj = i * step + side, j * step + 1 - side
                if ii < H and jj < W:
                    x = xyz[ii, jj, 0] - xyz[i * step, j * step, 0]
                    y = xyz[ii, jj, 1] - xyz[i * step, j * step, 1]
                    z = xyz[ii, jj, 2] - xyz[i * step, j * step, 2]
                    d = math.sqrt(x * x + y * y + z * z)
                    if d < best:
                        best = d
            out[i, j] = best if best < np.inf else np.nan
