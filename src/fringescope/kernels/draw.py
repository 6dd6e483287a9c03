"""Z-buffered pictures of points and textured triangles. Arrays and scalars only.

Every buffer is (h, w): `depth` (distance along the viewing axis, start with infinity), `colour` (h, w, 3) linear light,
`normal` (h, w, 3). A point on the screen is (x, y, z): pixels right and down with (0, 0) the centre of the top-left
pixel, and depth. Bands of rows are drawn in parallel, each by one thread, so that a picture never depends on timing.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows

BANDS = 16


@by_rows(lambda *_: BANDS)
def splat(first, last, screen, radius, colours, normals, depth, colour, normal):
    """Points (n, 3) on the screen as discs of `radius` (n,) pixels that face the viewer; the nearest wins.

    A disc's depth grows slightly to its rim, so that overlapping discs meet halfway.
    """
    h, w = depth.shape
    for band in range(first, last):
        top, bottom = band * h // BANDS, (band + 1) * h // BANDS
        for i in range(screen.shape[0]):
            x, y, z, r = screen[i, 0], screen[i, 1], screen[i, 2], radius[i]
            if not (z > 0.0 and math.isfinite(x) and math.isfinite(y)):
                continue
            if x + r < 0 or x - r > w - 1 or y + r < top or y - r > bottom - 1:
                continue
            for v in range(max(top, math.ceil(y - r)), min(bottom - 1, math.floor(y + r)) + 1):
                for u in range(max(0, math.ceil(x - r)), min(w - 1, math.floor(x + r)) + 1):
                    d2 = ((u - x) ** 2 + (v - y) ** 2) / (r * r)
                    if d2 > 1.0:
                        continue
                    near = z * (1.0 + 1e-5 * d2)
                    if near < depth[v, u]:
                        depth[v, u] = near
                        for k in range(3):
                            colour[v, u, k] = colours[i, k]
                            normal[v, u, k] = normals[i, k]


@njit(cache=True, inline="always", error_model="numpy")
def _texel(texture, x, y, k):
    """Bilinear sample of one channel at texel coordinates, clamped at the borders."""
    th, tw = texture.shape[0], texture.shape[1]
    x = min(max(x, 0.0), tw - 1.0)
    y = min(max(y, 0.0), th - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, tw - 1), min(y0 + 1, th - 1)
    a, b = x - x0, y - y0
    top = texture[y0, x0, k] * (1.0 - a) + texture[y0, x1, k] * a
    low = texture[y1, x0, k] * (1.0 - a) + texture[y1, x1, k] * a
    return top * (1.0 - b) + low * b


@by_rows(lambda *_: BANDS)
def triangles(first, last, screen, faces, normals, uv, texture, depth, colour, normal):
    """Textured triangles, perspective-correct; the nearest wins.

    `screen` (n, 3), `normals` (n, 3) and `uv` (n, 2, in 0..1 from the texture's top-left corner) belong to vertices,
    `faces` (m, 3) index them; `texture` (th, tw, 3) is linear light. Triangles that reach behind the viewer are left
    out.
    """
    h, w = depth.shape
    th, tw = texture.shape[0], texture.shape[1]
    for band in range(first, last):
        top, bottom = band * h // BANDS, (band + 1) * h // BANDS
        for f in range(faces.shape[0]):
            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, az = screen[ia, 0], screen[ia, 1], screen[ia, 2]
            bx, by, bz = screen[ib, 0], screen[ib, 1], screen[ib, 2]
            cx, cy, cz = screen[ic, 0], screen[ic, 1], screen[ic, 2]
            if not (az > 0.0 and bz > 0.0 and cz > 0.0):
                continue
            v0, v1 = max(top, math.ceil(min(ay, by, cy))), min(bottom - 1, math.floor(max(ay, by, cy)))
            u0, u1 = max(0, math.ceil(min(ax, bx, cx))), min(w - 1, math.floor(max(ax, bx, cx)))
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if v1 < v0 or u1 < u0 or area == 0.0:
                continue
            for v in range(v0, v1 + 1):
                for u in range(u0, u1 + 1):
                    wa = ((bx - u) * (cy - v) - (by - v) * (cx - u)) / area
                    wb = ((cx - u) * (ay - v) - (cy - v) * (ax - u)) / area
                    wc = 1.0 - wa - wb
                    if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                        continue
                    qa, qb, qc = wa / az, wb / bz, wc / cz
                    z = 1.0 / (qa + qb + qc)
                    if z >= depth[v, u]:
                        continue
                    depth[v, u] = z
                    qa, qb, qc = qa * z, qb * z, qc * z
                    x = (qa * uv[ia, 0] + qb * uv[ib, 0] + qc * uv[ic, 0]) * tw - 0.5
                    y = (qa * uv[ia, 1] + qb * uv[ib, 1] + qc * uv[ic, 1]) * th - 0.5
                    for k in range(3):
                        colour[v, u, k] = _texel(texture, x, y, k)
                        normal[v, u, k] = qa * normals[ia, k] + qb * normals[ib, k] + qc * normals[ic, k]


@njit(cache=True, error_model="numpy")
def bin_mean(x, y, value, out, count):
    """Mean of `value` (n,) in cells: x, y (n,) are cell coordinates; `out` and `count` (h, w) start at zero."""
    h, w = out.shape
    for i in range(x.shape[0]):
        if not (math.isfinite(x[i]) and math.isfinite(y[i]) and math.isfinite(value[i])):
            continue
        u, v = math.floor(x[i]), math.floor(y[i])
        if 0 <= u < w and 0 <= v < h:
            out[v, u] += value[i]
            count[v, u] += 1
    for v in range(h):
        for u in range(w):
            out[v, u] = out[v, u] / count[v, u] if count[v, u] else np.nan


@by_rows(lambda *args: args[-1].shape[0])
def light(first, last, depth, colour, normal, shade, ss, forward, key, up, half, strength, out, alpha):
    """Light on the buffers of a picture that is `ss` times supersampled, and the mean over each pixel's samples.

    Normals and the unit vectors `forward` (viewing direction), `key`, `up`, `half` (3,) are in the world. `shade`
    (h, w) of the final picture: 1 in the open, less in hollows. `strength` = key, sky, gloss, exponent of the shade.
    `out` (h, w, 3) linear, premultiplied; `alpha` (h, w).
    """
    _h, w = alpha.shape
    for v in range(first, last):
        for u in range(w):
            hits = 0
            r = g = b = 0.0
            s = shade[v, u]
            soft = s ** strength[3]
            for y in range(v * ss, (v + 1) * ss):
                for x in range(u * ss, (u + 1) * ss):
                    if not math.isfinite(depth[y, x]):
                        continue
                    hits += 1
                    nx, ny, nz = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
                    length = math.sqrt(nx * nx + ny * ny + nz * nz)
                    if length > 0.0:
                        nx, ny, nz = nx / length, ny / length, nz / length
                    if nx * forward[0] + ny * forward[1] + nz * forward[2] > 0.0:
                        nx, ny, nz = -nx, -ny, -nz
                    lambert = max(nx * key[0] + ny * key[1] + nz * key[2], 0.0)
                    sky = 0.5 + 0.5 * (nx * up[0] + ny * up[1] + nz * up[2])
                    shine = max(nx * half[0] + ny * half[1] + nz * half[2], 0.0)
                    shine = shine * shine * shine
                    shine = shine * shine
                    shine = shine * shine
                    shine = strength[2] * s * shine * shine * shine * shine
                    level = strength[0] * lambert * (0.5 + 0.5 * s) + strength[1] * sky * soft
                    r += colour[y, x, 0] * level + shine
                    g += colour[y, x, 1] * level + shine
                    b += colour[y, x, 2] * level + shine
            n = ss * ss
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = r / n, g / n, b / n
            alpha[v, u] = hits / n


@by_rows(lambda _depth, _ss, out, *_: out.shape[0])
def reduce_depth(first, last, depth, ss, out, weight):
    """Mean depth (h, w) of each pixel's `ss` x `ss` samples that hit something, times the share that did."""
    _h, w = out.shape
    for v in range(first, last):
        for u in range(w):
            total, hits = 0.0, 0
            for y in range(v * ss, (v + 1) * ss):
                for x in range(u * ss, (u + 1) * ss):
                    if math.isfinite(depth[y, x]):
                        total += depth[y, x]
                        hits += 1
            out[v, u], weight[v, u] = total / (ss * ss), hits / (ss * ss)
