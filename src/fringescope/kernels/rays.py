"""Phase to points (equations 8 to 15): the camera's ray meets the equiphase surface, exact for both lenses."""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.lens import distort_jacobian, from_plane, to_plane
from fringescope.threads import by_rows

TWO_PI = 2.0 * math.pi


@njit(cache=True, inline="always", error_model="numpy")
def plane_depth(g0, g1, cycles, a0, a1, a2, b0, b1, b2, lens):
    """Depth d where the point d a + b (projector frame) lies on the equiphase plane of a distortion-free projector.

    The closed form of equations 8 to 15: g . (f X/Z + u0) = cycles is linear in d.
    """
    kx = g0 * lens[0]
    ky = g0 * lens[4] + g1 * lens[1]
    kz = g0 * lens[2] + g1 * lens[3] - cycles
    return -(kx * b0 + ky * b1 + kz * b2) / (kx * a0 + ky * a1 + kz * a2)


@njit(cache=True, inline="always", error_model="numpy")
def cycles_along(d, g0, g1, a0, a1, a2, b0, b1, b2, lens):
    """Cycles that a projector with distortion throws on the point d a + b, and their derivative by d."""
    X = d * a0 + b0
    Y = d * a1 + b1
    Z = d * a2 + b2
    x = X / Z
    y = Y / Z
    xd, yd, jxx, jxy, jyy = distort_jacobian(x, y, lens)
    dx = (a0 - x * a2) / Z
    dy = (a1 - y * a2) / Z
    du = lens[0] * (jxx * dx + jxy * dy) + lens[4] * (jxy * dx + jyy * dy)
    dv = lens[1] * (jxy * dx + jyy * dy)
    u = lens[0] * xd + lens[4] * yd + lens[2]
    v = lens[1] * yd + lens[3]
    return g0 * u + g1 * v, g0 * du + g1 * dv


@by_rows(lambda phase, *_: phase.shape[1])
def triangulate(
    first, last, phase, sigma, reasons, g, cam_lens, proj_lens, R_pc, t_pc, R_wc, t_wc, xyz, sigma_mm, miss
):
    """Points of one view: D phases (D, H, W) of gradients g (D, 2) to world xyz (H, W, 3) and sigma along the ray.

    One direction: Newton on the depth, from the closed form of the plane, until the phase is met to 1e-9 cycles. More:
    Gauss-Newton, weighted by 1 / sigma^2; `miss` gets the rms misfit of the phases in standard deviations.
    NaN wherever `reasons` is not zero, where no phase is finite, or where the ray misses.
    """
    D, _H, W = phase.shape
    for i in range(first, last):
        for j in range(W):
            xyz[i, j, 0] = np.nan
            xyz[i, j, 1] = np.nan
            xyz[i, j, 2] = np.nan
            sigma_mm[i, j] = np.nan
            miss[i, j] = 0.0
            if reasons[i, j] != 0:
                continue
            x, y = from_plane(float(j), float(i), cam_lens)
            a0 = R_pc[0, 0] * x + R_pc[0, 1] * y + R_pc[0, 2]
            a1 = R_pc[1, 0] * x + R_pc[1, 1] * y + R_pc[1, 2]
            a2 = R_pc[2, 0] * x + R_pc[2, 1] * y + R_pc[2, 2]
            best = -1
            best_information = 0.0
            d = np.nan
            for k in range(D):  # the direction that tells most about the depth gives the start
                if phase[k, i, j] != phase[k, i, j]:
                    continue
                c = phase[k, i, j] / TWO_PI
                start = plane_depth(g[k, 0], g[k, 1], c, a0, a1, a2, t_pc[0], t_pc[1], t_pc[2], proj_lens)
                if not start > 0.0:
                    continue
                _, slope = cycles_along(start, g[k, 0], g[k, 1], a0, a1, a2, t_pc[0], t_pc[1], t_pc[2], proj_lens)
                information = (TWO_PI * slope / sigma[k, i, j]) ** 2
                if information > best_information:
                    best, best_information, d = k, information, start
            if best < 0:
                continue
            information = 0.0
            chi2 = 0.0
            used = 0
            settled = False
            for _ in range(12):
                information = 0.0
                moment = 0.0
                chi2 = 0.0
                used = 0
                for k in range(D):
                    if phase[k, i, j] != phase[k, i, j]:
                        continue
                    w = (TWO_PI / sigma[k, i, j]) ** 2
                    c, slope = cycles_along(d, g[k, 0], g[k, 1], a0, a1, a2, t_pc[0], t_pc[1], t_pc[2], proj_lens)
                    r = phase[k, i, j] / TWO_PI - c
                    information += w * slope * slope
                    moment += w * slope * r
                    chi2 += w * r * r
                    used += 1
                step = moment / information
                d += step
                if not d > 0.0:
                    break
                if abs(step) < 1e-9 * d:
                    settled = True
                    break
            if not settled:
                continue
            X = d * x - t_wc[0]
            Y = d * y - t_wc[1]
            Z = d - t_wc[2]
            for c3 in range(3):
                xyz[i, j, c3] = R_wc[0, c3] * X + R_wc[1, c3] * Y + R_wc[2, c3] * Z
            sigma_mm[i, j] = math.sqrt((x * x + y * y + 1.0) / information)
            if used > 1:
                miss[i, j] = math.sqrt(chi2 / (used - 1))


@by_rows(lambda xyz, *_: xyz.shape[0])
def mark_outside(first, last, xyz, R, t, lens, low, high, centre, axes, half_size, reasons, bit):
    """Give `bit` to points (H, W, 3) whose reasons are 0 and that lie outside the box or off the projector's field.

    The box: `centre` (3,), unit vectors in the rows of `axes` (3, 3), `half_size` (3,). The field: from `low` to `high`
    (2,) on the plane of the projector with pose R, t and `lens`.
    """
    for i in range(first, last):
        for j in range(xyz.shape[1]):
            if reasons[i, j] != 0:
                continue
            x, y, z = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            X = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
            Y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
            Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            u, v = to_plane(X / Z, Y / Z, lens)
            inside = Z > 0.0 and low[0] <= u <= high[0] and low[1] <= v <= high[1]
            for k in range(3):
                along = axes[k, 0] * (x - centre[0]) + axes[k, 1] * (y - centre[1]) + axes[k, 2] * (z - centre[2])
                inside = inside and abs(along) <= half_size[k]
            if not inside:
                reasons[i, j] |= bit


@by_rows(lambda xyz, *_: xyz.shape[0])
def blank(first, last, xyz, sigma, reasons):
    """NaN in place of points (H, W, 3) and sigma (H, W) that have a reason."""
    W = reasons.shape[1]
    for i in range(first, last):
        row, s, p = reasons[i], sigma[i], xyz[i]
        for col in range(0, W, 64):
            end = min(col + 64, W)
            some = np.uint16(0)
            for j in range(col, end):
                some |= row[j]
            if some == 0:
                continue
            for j in range(col, end):
                if row[j] != 0:
                    s[j] = p[j, 0] = p[j, 1] = p[j, 2] = np.nan
