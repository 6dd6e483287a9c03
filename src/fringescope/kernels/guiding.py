"""The surface as the projector sees it, strokes dropped onto a camera's points, ribbons on the projector's lattice."""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows

BANDS = 16


@by_rows(lambda *_: BANDS)
def relief(first, last, screen, faces, depth):
    """Depth (h, w) of the nearest triangle at each unit of the projector's plane; starts at infinity.

    `screen` (n, 3): (u, v, depth) of the vertices, `faces` (m, 3). Perspective-correct; triangles that reach behind the
    device or beyond what its lens images (NaN) are left out.
    """
    h, w = depth.shape
    for band in range(first, last):
        top, bottom = band * h // BANDS, (band + 1) * h // BANDS
        for f in range(faces.shape[0]):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, az = screen[a, 0], screen[a, 1], screen[a, 2]
            bx, by, bz = screen[b, 0], screen[b, 1], screen[b, 2]
            cx, cy, cz = screen[c, 0], screen[c, 1], screen[c, 2]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if not (az > 0.0 and bz > 0.0 and cz > 0.0 and math.isfinite(area)) or area == 0.0:
                continue
            v0, v1 = max(top, math.ceil(min(ay, by, cy))), min(bottom - 1, math.floor(max(ay, by, cy)))
            u0, u1 = max(0, math.ceil(min(ax, bx, cx))), min(w - 1, math.floor(max(ax, bx, cx)))
            for v in range(v0, v1 + 1):
                for u in range(u0, u1 + 1):
                    wa = ((bx - u) * (cy - v) - (by - v) * (cx - u)) / area
                    wb = ((cx - u) * (ay - v) - (cy - v) * (ax - u)) / area
                    wc = 1.0 - wa - wb
                    if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                        continue
                    z = 1.0 / (wa / az + wb / bz + wc / cz)
                    if z < depth[v, u]:
                        depth[v, u] = z


@by_rows(
    lambda _xyz, _reasons, _sigma, pixels, _origin, _rays, half, *_: (
        pixels.shape[0],
        pixels.shape[0] * (2 * half + 1) ** 2,
    )
)
def drape(first, last, xyz, reasons, sigma, pixels, origin, rays, half, slope, lit, places, errors):
    """Places of a picture on the surface that its camera measured: on their own rays, at the range of a local plane.

    `xyz` (H, W, 3), `reasons` and `sigma` (H, W): the camera's points; `pixels` (n, 2) with their unit `rays` (n, 3)
    from `origin` (3,). Points within `half` pixels that continue the nearest one (their range differs by no more than
    `slope` of their sideways distance, and five sigma) take part. `places` (n, 3) are NaN where the nearest pixel has
    no point: nothing is carried over a hole. But where all its reasons are among `lit`, which only lit pixels have, and
    five of its eight neighbours have points, these serve. `errors` (n,): standard deviation of the range.
    """
    H, W = reasons.shape
    for i in range(first, last):
        u, v = pixels[i, 0], pixels[i, 1]
        places[i, 0] = places[i, 1] = places[i, 2] = errors[i] = math.nan
        if not (-0.5 <= u < W - 0.5 and -0.5 <= v < H - 0.5):
            continue
        c, r = math.floor(u + 0.5), math.floor(v + 0.5)
        alone = False
        if reasons[r, c] != 0:
            if (reasons[r, c] & ~np.uint16(lit)) != 0:
                continue
            alone = True
            around, nr, nc, nearest = 0, r, c, math.inf
            for row in range(max(r - 1, 0), min(r + 1, H - 1) + 1):
                for col in range(max(c - 1, 0), min(c + 1, W - 1) + 1):
                    if reasons[row, col] == 0:
                        around += 1
                        d = (row - v) ** 2 + (col - u) ** 2
                        if d < nearest:
                            nearest, nr, nc = d, row, col
            if around < 5:
                continue
            r, c = nr, nc
        x0, y0, z0 = xyz[r, c, 0] - origin[0], xyz[r, c, 1] - origin[1], xyz[r, c, 2] - origin[2]
        near = math.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        if not math.isfinite(near):
            continue
        # least squares of range - near = a + b du + c dv, du and dv from the place itself
        n = sx = sy = sxx = sxy = syy = sz = sxz = syz = ss = 0.0
        for row in range(max(r - half, 0), min(r + half, H - 1) + 1):
            for col in range(max(c - half, 0), min(c + half, W - 1) + 1):
                if reasons[row, col] != 0:
                    continue
                x, y, z = xyz[row, col, 0] - origin[0], xyz[row, col, 1] - origin[1], xyz[row, col, 2] - origin[2]
                far = math.sqrt(x * x + y * y + z * z)
                along = (x * x0 + y * y0 + z * z0) / (near * far)
                aside = near * math.sqrt(max(1.0 - along * along, 0.0))
                s = sigma[row, col]
                if not abs(far - near) <= slope * aside + 5.0 * s:
                    continue
                du, dv, d = col - u, row - v, far - near
                n += 1.0
                sx += du
                sy += dv
                sz += d
                sxx += du * du
                sxy += du * dv
                syy += dv * dv
                sxz += du * d
                syz += dv * d
                ss += s * s
        m00, m01, m02 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
        det = n * m00 + sx * m01 + sy * m02
        if n >= 4.0 and det > 1e-6 * n * (sxx + 1e-9) * (syy + 1e-9):
            reach = near + (m00 * sz + m01 * sxz + m02 * syz) / det
            errors[i] = math.sqrt(max(ss / n * m00 / det, 0.0))
        elif alone:
            continue
        else:
            reach, errors[i] = near, sigma[r, c]
        for k in range(3):
            places[i, k] = origin[k] + reach * rays[i, k]


@njit(cache=True, inline="always", error_model="numpy")
def _within(u, v, ribbon, pitch):
    """Share of a mirror at (u, v) that a ribbon covers: of its extent `pitch` across the ribbon."""
    u0, v0, h0, u1, v1, h1 = ribbon[0], ribbon[1], ribbon[2], ribbon[3], ribbon[4], ribbon[5]
    du, dv = u1 - u0, v1 - v0
    length2 = du * du + dv * dv
    t = 0.0 if length2 == 0.0 else min(max(((u - u0) * du + (v - v0) * dv) / length2, 0.0), 1.0)
    d = math.sqrt((u - u0 - t * du) ** 2 + (v - v0 - t * dv) ** 2)
    h = h0 + t * (h1 - h0)
    return max(min(h, d + 0.5 * pitch) - max(-h, d - 0.5 * pitch), 0.0) / pitch


@by_rows(lambda _ribbons, _diamond, _top, out: out.shape[0])
def ribbons(first, last, parts, diamond, top, out):
    """Share of each device pixel that ribbons cover: `out` (h, w) float32, of rows from `top` on, grows to it.

    `parts` (m, 6): u, v, half width at both ends, projector-plane units. `diamond`: the pixels' layout; a mirror's
    extent is then the square root of two units, else one.
    """
    w = out.shape[1]
    pitch = math.sqrt(2.0) if diamond else 1.0
    step = 2.0 if diamond else 1.0
    for i in range(parts.shape[0]):
        ribbon = parts[i]
        reach = max(ribbon[2], ribbon[5]) + 0.5 * pitch
        v0, v1 = min(ribbon[1], ribbon[4]) - reach, max(ribbon[1], ribbon[4]) + reach
        u0, u1 = min(ribbon[0], ribbon[3]) - reach, max(ribbon[0], ribbon[3]) + reach
        for row in range(max(first, math.ceil(v0) - top), min(last - 1, math.floor(v1) - top) + 1):
            shift = (row + top) % 2 if diamond else 0
            c0, c1 = max(0, math.ceil((u0 - shift) / step)), min(w - 1, math.floor((u1 - shift) / step))
            for c in range(c0, c1 + 1):
                share = np.float32(_within(step * c + shift, float(row + top), ribbon, pitch))
                if share > out[row, c]:
                    out[row, c] = share


@by_rows(lambda share, *_: share.shape[0])
def paint(first, last, share, color, out):
    """A colour (3,) over a picture (h, w, 3), as much of it as `share` (h, w) says; float32."""
    for row in range(first, last):
        for c in range(share.shape[1]):
            a = share[row, c]
            if a > 0.0:
                for i in range(3):
                    out[row, c, i] += a * (color[i] - out[row, c, i])
