"""Loops over organised points: normals, what other views say about a pixel's ray, colours, ownership, doubles.

Arrays and scalars only. `xyz` (H, W, 3) float32 world mm with NaN holes; a lens is the vector of `kernels.lens`.
"""

import math

import numpy as np
from numba import njit

from fringescope.kernels.lens import to_plane
from fringescope.threads import by_rows


@njit(cache=True, inline="always", error_model="numpy")
def _unit(x, y, z):
    s = math.sqrt(x * x + y * y + z * z)
    return x / s, y / s, z / s


@by_rows(lambda xyz, *_: xyz.shape[0])
def normals(first, last, xyz, sigma, centre, radius, max_slope, jump_sigma, out):
    """Unit normals (H, W, 3) towards the camera at `centre` (3,): regression of xyz on pixel coordinates.

    The window is (2 radius + 1)^2. Neighbours whose range along the ray differs by more than `max_slope` times their
    sideways distance plus `jump_sigma` standard deviations lie across a jump and do not count. Pixel coordinates are
    free of noise, so the slope is unbiased, unlike that of a principal-axis fit. Where no plane can be fitted the
    normal points to the camera; NaN where there is no point.
    """
    H, W = xyz.shape[0], xyz.shape[1]
    for i in range(first, last):
        for j in range(W):
            px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            if not math.isfinite(px):
                out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = np.nan
                continue
            rx, ry, rz = px - centre[0], py - centre[1], pz - centre[2]
            range_p = math.sqrt(rx * rx + ry * ry + rz * rz)
            rx, ry, rz = rx / range_p, ry / range_p, rz / range_p
            noise = jump_sigma * float(sigma[i, j])
            n = sx = sy = sxx = sxy = syy = 0.0
            ax = ay = az = bx = by = bz = cx = cy = cz = 0.0
            for di in range(-radius, radius + 1):
                ii = i + di
                if ii < 0 or ii >= H:
                    continue
                for dj in range(-radius, radius + 1):
                    jj = j + dj
                    if jj < 0 or jj >= W or not math.isfinite(xyz[ii, jj, 0]):
                        continue
                    qx, qy, qz = xyz[ii, jj, 0] - px, xyz[ii, jj, 1] - py, xyz[ii, jj, 2] - pz
                    along = qx * rx + qy * ry + qz * rz
                    across = math.sqrt(max(qx * qx + qy * qy + qz * qz - along * along, 0.0))
                    if abs(along) > max_slope * across + noise + jump_sigma * sigma[ii, jj]:
                        continue
                    n += 1.0
                    sx += dj
                    sy += di
                    sxx += dj * dj
                    sxy += dj * di
                    syy += di * di
                    ax += qx
                    ay += qy
                    az += qz
                    bx += dj * qx
                    by += dj * qy
                    bz += dj * qz
                    cx += di * qx
                    cy += di * qy
                    cz += di * qz
            mx, my = sx / n, sy / n
            vxx, vxy, vyy = sxx - sx * mx, sxy - sx * my, syy - sy * my
            det = vxx * vyy - vxy * vxy
            if n < 3.0 or det < 1e-6 * (vxx + vyy) * (vxx + vyy) or det <= 0.0:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = -rx, -ry, -rz
                continue
            bx, by, bz = bx - mx * ax, by - mx * ay, bz - mx * az
            cx, cy, cz = cx - my * ax, cy - my * ay, cz - my * az
            ux, uy, uz = vyy * bx - vxy * cx, vyy * by - vxy * cy, vyy * bz - vxy * cz
            wx, wy, wz = vxx * cx - vxy * bx, vxx * cy - vxy * by, vxx * cz - vxy * bz
            nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not size > 0.0:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = -rx, -ry, -rz
                continue
            if nx * rx + ny * ry + nz * rz > 0.0:
                size = -size
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = nx / size, ny / size, nz / size


@by_rows(lambda xyz, *_: xyz.shape[0])
def jumps(first, last, xyz, sigma, centre, max_slope, jump_sigma, out):
    """Whether (H, W) a point's left, right, upper or lower neighbour lies across a jump, as `normals` tells them."""
    H, W = xyz.shape[0], xyz.shape[1]
    for i in range(first, last):
        for j in range(W):
            out[i, j] = False
            px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            if not math.isfinite(px):
                continue
            rx, ry, rz = _unit(px - centre[0], py - centre[1], pz - centre[2])
            for side in range(4):
                ii = i + (1 if side == 0 else -1 if side == 1 else 0)
                jj = j + (1 if side == 2 else -1 if side == 3 else 0)
                if ii < 0 or jj < 0 or ii >= H or jj >= W or not math.isfinite(xyz[ii, jj, 0]):
                    continue
                qx, qy, qz = xyz[ii, jj, 0] - px, xyz[ii, jj, 1] - py, xyz[ii, jj, 2] - pz
                along = qx * rx + qy * ry + qz * rz
                across = math.sqrt(max(qx * qx + qy * qy + qz * qz - along * along, 0.0))
                if abs(along) > max_slope * across + jump_sigma * (sigma[i, j] + sigma[ii, jj]):
                    out[i, j] = True


@by_rows(lambda xyz, *_: xyz.shape[0])
def incidence(first, last, xyz, normal, centre, out):
    """Cosine (H, W) of the angle between the normal and the direction to `centre`; 0 where there is no point."""
    for i in range(first, last):
        for j in range(xyz.shape[1]):
            if not math.isfinite(xyz[i, j, 0]):
                out[i, j] = 0.0
                continue
            x, y, z = centre[0] - xyz[i, j, 0], centre[1] - xyz[i, j, 1], centre[2] - xyz[i, j, 2]
            x, y, z = _unit(x, y, z)
            out[i, j] = max(x * normal[i, j, 0] + y * normal[i, j, 1] + z * normal[i, j, 2], 0.0)


@by_rows(lambda xyz, *_: xyz.shape[0])
def spacing(first, last, xyz, out):
    """Distance (H, W) in mm to the nearer of the right and lower neighbours; NaN where neither has a point."""
    H, W = xyz.shape[0], xyz.shape[1]
    for i in range(first, last):
        for j in range(W):
            best = np.inf
            for step in range(2):
                ii, jj = i + step, j + 1 - step
                if ii < H and jj < W:
                    x = xyz[ii, jj, 0] - xyz[i, j, 0]
                    y = xyz[ii, jj, 1] - xyz[i, j, 1]
                    z = xyz[ii, jj, 2] - xyz[i, j, 2]
                    d = math.sqrt(x * x + y * y + z * z)
                    if d < best:
                        best = d
            out[i, j] = best if best < np.inf else np.nan


@by_rows(lambda _xyz, _normal, _sigma_n, _centre, row0, row1, *_: row1 - row0)
def gather(
    first, last, xyz, normal, sigma_n, centre, row0, _row1, R, t, lens, xyz_w, normal_w, sigma_w, cosine_w, weight_w,
           rgb_w, colour_w, agree_sigma, agree_mm, bit, shift, total, variance, facing, seen, sample):
    """What view w says about the rays of rows `row0` to `_row1` of another view; sums go into the band's arrays.

    A point P is projected into view w (rotation R, translation t, `lens`) and compared with the one sample Q of the
    nearest pixel. Along the mean m of both normals, which is perpendicular to the chord PQ of any surface of second
    order, the views differ by s = (Q - P) . m. They agree if abs(s) <= agree_sigma * sqrt(sp^2 + sq^2) + agree_mm and Q
    is no farther from P than a pixel of w is wide on the surface: on a sphere the chord to any Q has s = 0.
    Then s, turned into a shift along P's own ray, counts with weight_w: `shift` += w s / (m . d), `total` += w,
    `variance` += w^2 sq^2, `facing` (3) += w n; `seen` gets `bit`; `sample` (.., 4) the colour of view w at P
    (bilinear) and its weight, or weight 0.
    """
    H, W = xyz_w.shape[0], xyz_w.shape[1]
    inverse_focal = 1.0 / math.sqrt(lens[0] * lens[1])
    for i in range(row0 + first, row0 + last):
        b = i - row0
        for j in range(xyz.shape[1]):
            sample[b, j, 3] = 0.0
            px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            if not math.isfinite(px):
                continue
            Z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
            if not Z > 0.0:
                continue
            X = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
            Y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
            u, v = to_plane(X / Z, Y / Z, lens)
            if not (u >= 0.0 and v >= 0.0 and u <= W - 1.0 and v <= H - 1.0):
                continue
            qj, qi = int(u + 0.5), int(v + 0.5)
            if not weight_w[qi, qj] > 0.0:
                continue
            mx = normal[i, j, 0] + normal_w[qi, qj, 0]
            my = normal[i, j, 1] + normal_w[qi, qj, 1]
            mz = normal[i, j, 2] + normal_w[qi, qj, 2]
            if mx * mx + my * my + mz * mz < 1.0:
                continue
            mx, my, mz = _unit(mx, my, mz)
            cx, cy, cz = xyz_w[qi, qj, 0] - px, xyz_w[qi, qj, 1] - py, xyz_w[qi, qj, 2] - pz
            s = cx * mx + cy * my + cz * mz
            sp, sq = sigma_n[i, j], sigma_w[qi, qj]
            limit = agree_sigma * math.sqrt(sp * sp + sq * sq) + agree_mm
            reach = Z * inverse_focal / max(cosine_w[qi, qj], 0.05) + limit
            if not (abs(s) <= limit and cx * cx + cy * cy + cz * cz <= reach * reach):
                continue
            dx, dy, dz = _unit(px - centre[0], py - centre[1], pz - centre[2])
            slope = mx * dx + my * dy + mz * dz
            seen[b, j] |= bit
            if slope < -0.05:
                w = weight_w[qi, qj]
                shift[b, j] += w * s / slope
                total[b, j] += w
                variance[b, j] += w * w * sq * sq
                for k in range(3):
                    facing[b, j, k] += w * normal_w[qi, qj, k]
            cw = colour_w[qi, qj]
            if cw > 0.0:
                j0, i0 = min(int(u), W - 2), min(int(v), H - 2)
                fu, fv = u - j0, v - i0
                for k in range(3):
                    top = rgb_w[i0, j0, k] + fu * (rgb_w[i0, j0 + 1, k] - rgb_w[i0, j0, k])
                    low = rgb_w[i0 + 1, j0, k] + fu * (rgb_w[i0 + 1, j0 + 1, k] - rgb_w[i0 + 1, j0, k])
                    sample[b, j, k] = top + fv * (low - top)
                sample[b, j, 3] = cw


@by_rows(lambda _xyz, _normal, _sigma_n, _weight, _centre, row0, row1, *_: row1 - row0)
def settle(
    first, last, xyz, normal, sigma_n, weight, centre, row0, _row1, shift, total, variance, facing, xyz_out, normal_out,
           sigma_out):
    """The weighted mean along each ray of rows `row0` to `_row1`, from the sums of `gather` and the view's own sample.

    `sigma_out` is one standard deviation along the ray. Nothing else sees a point: it stays as it is.
    """
    for i in range(row0 + first, row0 + last):
        b = i - row0
        for j in range(xyz.shape[1]):
            px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            if not math.isfinite(px):
                sigma_out[i, j] = np.nan
                for k in range(3):
                    xyz_out[i, j, k] = normal_out[i, j, k] = np.nan
                continue
            dx, dy, dz = _unit(px - centre[0], py - centre[1], pz - centre[2])
            w = max(float(weight[i, j]), 1e-9)
            sum_w = w + total[b, j]
            along = shift[b, j] / sum_w
            xyz_out[i, j, 0], xyz_out[i, j, 1], xyz_out[i, j, 2] = px + along * dx, py + along * dy, pz + along * dz
            nx = facing[b, j, 0] + w * normal[i, j, 0]
            ny = facing[b, j, 1] + w * normal[i, j, 1]
            nz = facing[b, j, 2] + w * normal[i, j, 2]
            nx, ny, nz = _unit(nx, ny, nz)
            normal_out[i, j, 0], normal_out[i, j, 1], normal_out[i, j, 2] = nx, ny, nz
            s = math.sqrt(variance[b, j] + w * w * sigma_n[i, j] * sigma_n[i, j]) / sum_w
            slope = -(normal[i, j, 0] * dx + normal[i, j, 1] * dy + normal[i, j, 2] * dz)
            sigma_out[i, j] = s / max(slope, 0.05)


@by_rows(lambda samples, *_: samples.shape[1])
def blend(first, last, samples, gloss, row0, rgb, colour_weight, out):
    """Blended colour of a band from `samples` (V, rows, W, 4) = other views' colours and weights, and the view's own.

    A view that is brighter than a soft minimum over the views by more than the share `gloss` sees a highlight there
    and counts less. Where no view has a weight the view's own colour stays.
    """
    V, _rows, W = samples.shape[0], samples.shape[1], samples.shape[2]
    for b in range(first, last):
        i = row0 + b
        for j in range(W):
            own = colour_weight[i, j]
            light = (rgb[i, j, 0] + rgb[i, j, 1] + rgb[i, j, 2]) / 3.0 + 1e-3
            soft, total = own / light**4, own
            for v in range(V):
                w = samples[v, b, j, 3]
                if w > 0.0:
                    light = (samples[v, b, j, 0] + samples[v, b, j, 1] + samples[v, b, j, 2]) / 3.0 + 1e-3
                    light = max(light, 1e-3)
                    soft += w / light**4
                    total += w
            if not total > 0.0:
                for k in range(3):
                    out[i, j, k] = rgb[i, j, k]
                continue
            low = (total / soft) ** 0.25
            s0 = s1 = s2 = sw = 0.0
            for v in range(-1, V):
                if v < 0:
                    c0, c1, c2, w = rgb[i, j, 0], rgb[i, j, 1], rgb[i, j, 2], own
                else:
                    c0, c1, c2 = samples[v, b, j, 0], samples[v, b, j, 1], samples[v, b, j, 2]
                    w = samples[v, b, j, 3]
                if not w > 0.0:
                    continue
                excess = max((c0 + c1 + c2) / 3.0 + 1e-3 - low, 0.0) / (gloss * low)
                w /= 1.0 + excess * excess
                s0 += w * c0
                s1 += w * c1
                s2 += w * c2
                sw += w
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = s0 / sw, s1 / sw, s2 / sw


@by_rows(lambda xyz, *_: xyz.shape[0])
def plane_coordinates(first, last, xyz, R, t, out):
    """Ideal normalised coordinates (H, W, 2) of points as the device R, t sees them; NaN where there is none."""
    for i in range(first, last):
        for j in range(xyz.shape[1]):
            px, py, pz = float(xyz[i, j, 0]), float(xyz[i, j, 1]), float(xyz[i, j, 2])
            Z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
            if not Z > 0.0:
                out[i, j, 0] = out[i, j, 1] = np.nan
                continue
            out[i, j, 0] = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]) / Z
            out[i, j, 1] = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]) / Z


@njit(cache=True, error_model="numpy")
def bin_weights(ab, weight, origin, cell, total, count):
    """Sum of the weights and number of the points (H, W) whose coordinates `ab` fall into each cell of a raster."""
    rows, cols = total.shape
    for i in range(ab.shape[0]):
        for j in range(ab.shape[1]):
            if not math.isfinite(ab[i, j, 0]):
                continue
            c, r = int((ab[i, j, 0] - origin[0]) / cell), int((ab[i, j, 1] - origin[1]) / cell)
            if 0 <= c < cols and 0 <= r < rows:
                total[r, c] += weight[i, j]
                count[r, c] += 1


@by_rows(lambda ab, *_: ab.shape[0])
def owned(first, last, ab, origin, cell, owner, view, out):
    """Whether (H, W) each point lies in a cell that belongs to `view`."""
    rows, cols = owner.shape
    for i in range(first, last):
        for j in range(ab.shape[1]):
            out[i, j] = False
            if not math.isfinite(ab[i, j, 0]):
                continue
            c, r = int((ab[i, j, 0] - origin[0]) / cell), int((ab[i, j, 1] - origin[1]) / cell)
            out[i, j] = 0 <= c < cols and 0 <= r < rows and owner[r, c] == view


@njit(cache=True, error_model="numpy")
def doubles(ab, xyz, normal, view, reach, sideways, near, cell_start, cell_row, cell_col, lookup, out):
    """Which points (n,) lie too near a kept point of another view.

    Too near is less than `reach` in the plane `ab` (n, 2), or a distance below `near` in space of which less than
    `sideways` lies in the tangent plane of one of the two (`xyz`, `normal` (n, 3), mm).

    Points come sorted by cell: cell k holds cell_start[k] to cell_start[k + 1], at (cell_row[k], cell_col[k]), and
    `lookup` (rows, cols) is k or -1; cells are at least `reach` wide. The first kept point wins.
    """
    for k in range(cell_row.shape[0]):
        for a in range(cell_start[k], cell_start[k + 1]):
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    r, c = cell_row[k] + dr, cell_col[k] + dc
                    if out[a] or r < 0 or c < 0 or r >= lookup.shape[0] or c >= lookup.shape[1] or lookup[r, c] < 0:
                        continue
                    m = lookup[r, c]
                    for b in range(cell_start[m], cell_start[m + 1]):
                        if view[b] == view[a] or out[b]:
                            continue
                        x, y = ab[a, 0] - ab[b, 0], ab[a, 1] - ab[b, 1]
                        if x * x + y * y < reach * reach:
                            out[a] = True
                            break
                        x, y, z = xyz[a, 0] - xyz[b, 0], xyz[a, 1] - xyz[b, 1], xyz[a, 2] - xyz[b, 2]
                        far = x * x + y * y + z * z
                        if far > near * near:
                            continue
                        up = x * normal[a, 0] + y * normal[a, 1] + z * normal[a, 2]
                        above = x * normal[b, 0] + y * normal[b, 1] + z * normal[b, 2]
                        if far - max(up * up, above * above) < sideways * sideways:
                            out[a] = True
                            break
