"""Residuals of a joint calibration with their analytic derivatives: points of a board seen by a device, and phases
measured at fixed camera pixels whose rays meet the board.

Poses here: T_rb maps board to reference, T_cr reference to a device; a small turn w and shift s change them to
(exp(w) R, t + s). A board's shape is five numbers: sag in mm at the half diagonal along x x, x y, y y, then how much
longer its rows' spacing is (ratio - 1) and how much x leans with y (shear); `frame` is the board's middle x, y and its
half diagonal. Lenses are the ten numbers of `kernels.lens`; derivatives are by nine of them: fx, fy, u0, v0, k1 .. k3.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.lens import distort_jacobian, from_plane


@njit(cache=True, inline="always", error_model="numpy")
def _by_terms(x, y, dx, dy):
    """Derivatives of the distorted x and y by k1, k2, p1, p2, k3."""
    r2 = x * x + y * y
    dx[0], dx[1], dx[2], dx[3], dx[4] = x * r2, x * r2 * r2, 2.0 * x * y, r2 + 2.0 * x * x, x * r2 * r2 * r2
    dy[0], dy[1], dy[2], dy[3], dy[4] = y * r2, y * r2 * r2, r2 + 2.0 * y * y, 2.0 * x * y, y * r2 * r2 * r2


@njit(cache=True, inline="always", error_model="numpy")
def _sag(x, y, shape, frame):
    """Height z of the board at x, y and its slopes."""
    p, q = (x - frame[0]) / frame[2], (y - frame[1]) / frame[2]
    z = shape[0] * p * p + shape[1] * p * q + shape[2] * q * q
    zx = (2.0 * shape[0] * p + shape[1] * q) / frame[2]
    zy = (shape[1] * p + 2.0 * shape[2] * q) / frame[2]
    return z, zx, zy, p, q


@njit(cache=True, nogil=True, error_model="numpy")
def point_rows(xy, place, shape, frame, R_rb, t_rb, R_cr, t_cr, lens, residual, J):
    """Board points (n, 2) mm, seen at `place` (n, 2): residual (n, 2) = predicted - seen, NaN behind the device.

    J (n, 2, 26): by nine of the lens, turn and shift of T_cr, turn and shift of T_rb, five of the board's shape; an
    empty J is left alone.
    """
    want = J.shape[0] > 0
    dx, dy = np.empty(5), np.empty(5)
    h = np.empty(3)
    for i in range(xy.shape[0]):
        bx = xy[i, 0] + shape[4] * (xy[i, 1] - frame[1])
        by = xy[i, 1] + shape[3] * (xy[i, 1] - frame[1])
        bz, zx, zy, p, q = _sag(bx, by, shape, frame)
        e0 = R_rb[0, 0] * bx + R_rb[0, 1] * by + R_rb[0, 2] * bz
        e1 = R_rb[1, 0] * bx + R_rb[1, 1] * by + R_rb[1, 2] * bz
        e2 = R_rb[2, 0] * bx + R_rb[2, 1] * by + R_rb[2, 2] * bz
        r0, r1, r2 = e0 + t_rb[0], e1 + t_rb[1], e2 + t_rb[2]
        c0 = R_cr[0, 0] * r0 + R_cr[0, 1] * r1 + R_cr[0, 2] * r2
        c1 = R_cr[1, 0] * r0 + R_cr[1, 1] * r1 + R_cr[1, 2] * r2
        c2 = R_cr[2, 0] * r0 + R_cr[2, 1] * r1 + R_cr[2, 2] * r2
        Z = c2 + t_cr[2]
        if not Z > 0.0:
            residual[i, 0] = np.nan
            residual[i, 1] = np.nan
            continue
        x, y = (c0 + t_cr[0]) / Z, (c1 + t_cr[1]) / Z
        xd, yd, jxx, jxy, jyy = distort_jacobian(x, y, lens)
        residual[i, 0] = lens[0] * xd + lens[4] * yd + lens[2] - place[i, 0]
        residual[i, 1] = lens[1] * yd + lens[3] - place[i, 1]
        if not want:
            continue
        _by_terms(x, y, dx, dy)
        for a in range(2):
            row = J[i, a]
            if a == 0:
                fx, fy = lens[0], lens[4]
                row[0], row[1], row[2], row[3] = xd, 0.0, 1.0, 0.0
            else:
                fx, fy = 0.0, lens[1]
                row[0], row[1], row[2], row[3] = 0.0, yd, 0.0, 1.0
            for k in range(5):
                row[4 + k] = fx * dx[k] + fy * dy[k]
            m0 = (fx * jxx + fy * jxy) / Z
            m1 = (fx * jxy + fy * jyy) / Z
            m2 = -(m0 * x + m1 * y)
            row[9], row[10], row[11] = c1 * m2 - c2 * m1, c2 * m0 - c0 * m2, c0 * m1 - c1 * m0
            row[12], row[13], row[14] = m0, m1, m2
            for k in range(3):
                h[k] = m0 * R_cr[0, k] + m1 * R_cr[1, k] + m2 * R_cr[2, k]
            row[15], row[16], row[17] = e1 * h[2] - e2 * h[1], e2 * h[0] - e0 * h[2], e0 * h[1] - e1 * h[0]
            row[18], row[19], row[20] = h[0], h[1], h[2]
            b0 = h[0] * R_rb[0, 0] + h[1] * R_rb[1, 0] + h[2] * R_rb[2, 0]
            b1 = h[0] * R_rb[0, 1] + h[1] * R_rb[1, 1] + h[2] * R_rb[2, 1]
            b2 = h[0] * R_rb[0, 2] + h[1] * R_rb[1, 2] + h[2] * R_rb[2, 2]
            row[21], row[22], row[23] = b2 * p * p, b2 * p * q, b2 * q * q
            away = xy[i, 1] - frame[1]
            row[24], row[25] = (b1 + b2 * zy) * away, (b0 + b2 * zx) * away


@njit(cache=True, error_model="numpy")
def _meet(o, d, shape, frame):
    """Distance s at which the ray o + s d (board coordinates) meets the board's surface; NaN if it does not."""
    s = -o[2] / d[2]
    for _ in range(12):
        z, zx, zy, _p, _q = _sag(o[0] + s * d[0], o[1] + s * d[1], shape, frame)
        step = (o[2] + s * d[2] - z) / (d[2] - zx * d[0] - zy * d[1])
        s -= step
        if abs(step) <= 1e-13 * abs(s):
            return s
    return np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def sample_rows(
    px, cycles, g, shape, frame, R_rb, t_rb, R_cr, t_cr, camera, projector, residual, uv, board_xy, J
):
    """Cycles (k, d) measured at camera pixels (k, 2) along directions g (d, 2), the reference being the projector.

    residual (k, d) in projector-plane units along each direction = predicted - measured, NaN where nothing was measured
    or the ray misses; uv (k, 2) predicted plane coordinates; board_xy (k, 2) where the ray meets the board.
    J (k, d, 35): by nine of the projector's lens, nine of the camera's, turn and shift of T_cr, of T_rb, five of the
    board's shape; an empty J is left alone.
    """
    want = J.shape[0] > 0
    directions = g.shape[0]
    dx, dy = np.empty(5), np.empty(5)
    tx, ty = np.empty(5), np.empty(5)
    o, d = np.empty(3), np.empty(3)
    ob, db = np.empty(3), np.empty(3)
    P, e, n, h, m = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        o[k] = -(R_cr[0, k] * t_cr[0] + R_cr[1, k] * t_cr[1] + R_cr[2, k] * t_cr[2])
    for k in range(3):
        ob[k] = 0.0
        for a in range(3):
            ob[k] += R_rb[a, k] * (o[a] - t_rb[a])
    for i in range(px.shape[0]):
        for a in range(directions):
            residual[i, a] = np.nan
        uv[i, 0] = np.nan
        uv[i, 1] = np.nan
        x, y = from_plane(px[i, 0], px[i, 1], camera)
        for k in range(3):
            d[k] = R_cr[0, k] * x + R_cr[1, k] * y + R_cr[2, k]
        for k in range(3):
            db[k] = R_rb[0, k] * d[0] + R_rb[1, k] * d[1] + R_rb[2, k] * d[2]
        s = _meet(ob, db, shape, frame)
        if not s > 0.0:
            continue
        for k in range(3):
            P[k] = o[k] + s * d[k]
            e[k] = P[k] - t_rb[k]
        if not P[2] > 0.0:
            continue
        board_xy[i, 0] = ob[0] + s * db[0]
        board_xy[i, 1] = ob[1] + s * db[1]
        _z, zx, zy, p, q = _sag(board_xy[i, 0], board_xy[i, 1], shape, frame)
        X, Y = P[0] / P[2], P[1] / P[2]
        xd, yd, jxx, jxy, jyy = distort_jacobian(X, Y, projector)
        uv[i, 0] = projector[0] * xd + projector[4] * yd + projector[2]
        uv[i, 1] = projector[1] * yd + projector[3]
        for a in range(directions):
            size = math.hypot(g[a, 0], g[a, 1])
            residual[i, a] = (g[a, 0] * uv[i, 0] + g[a, 1] * uv[i, 1] - cycles[i, a]) / size
        if not want:
            continue
        _by_terms(X, Y, dx, dy)
        cxd, cyd, cxx, cxy, cyy = distort_jacobian(x, y, camera)
        _by_terms(x, y, tx, ty)
        det = cxx * cyy - cxy * cxy
        for k in range(3):
            n[k] = R_rb[k, 2] - zx * R_rb[k, 0] - zy * R_rb[k, 1]
        facing = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
        lift = n[0] * R_rb[0, 2] + n[1] * R_rb[1, 2] + n[2] * R_rb[2, 2]
        for a in range(directions):
            row = J[i, a]
            size = math.hypot(g[a, 0], g[a, 1])
            gu, gv = g[a, 0] / size, g[a, 1] / size
            fx, fy = gu * projector[0], gu * projector[4] + gv * projector[1]
            row[0], row[1], row[2], row[3] = gu * xd, gv * yd, gu, gv
            for k in range(5):
                row[4 + k] = fx * dx[k] + fy * dy[k]
            h[0] = (fx * jxx + fy * jxy) / P[2]
            h[1] = (fx * jxy + fy * jyy) / P[2]
            h[2] = -(h[0] * X + h[1] * Y)
            along = (h[0] * d[0] + h[1] * d[1] + h[2] * d[2]) / facing
            for k in range(3):
                h[k] -= along * n[k]
            for k in range(3):
                m[k] = R_cr[k, 0] * h[0] + R_cr[k, 1] * h[1] + R_cr[k, 2] * h[2]
            # the ray's ideal x, y by the camera's lens: the inverse of the distortion
            bx, by = s * (m[0] * cyy - m[1] * cxy) / det, s * (m[1] * cxx - m[0] * cxy) / det
            ax = bx / camera[0]
            ay = (by - bx * camera[4] / camera[0]) / camera[1]
            row[9], row[10], row[11], row[12] = -ax * cxd, -ay * cyd, -ax, -ay
            for k in range(5):
                row[13 + k] = -(bx * tx[k] + by * ty[k])
            q0, q1, q2 = t_cr[0] - s * x, t_cr[1] - s * y, t_cr[2] - s
            row[18], row[19], row[20] = q1 * m[2] - q2 * m[1], q2 * m[0] - q0 * m[2], q0 * m[1] - q1 * m[0]
            row[21], row[22], row[23] = -m[0], -m[1], -m[2]
            row[24] = along * (e[1] * n[2] - e[2] * n[1])
            row[25] = along * (e[2] * n[0] - e[0] * n[2])
            row[26] = along * (e[0] * n[1] - e[1] * n[0])
            row[27], row[28], row[29] = along * n[0], along * n[1], along * n[2]
            row[30], row[31], row[32] = along * lift * p * p, along * lift * p * q, along * lift * q * q
            row[33], row[34] = 0.0, 0.0
