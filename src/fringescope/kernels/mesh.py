"""Loops over triangles: which lie on the surface, what hangs together, and what a coarser surface would miss.

`faces` (m, 3) index into points `xyz` (n, 3) world mm with unit `normal` (n, 3), `sigma` (n,) in mm.
"""

import math

import numpy as np
from numba import njit

from fringescope.threads import by_rows


@by_rows(lambda faces, *_: faces.shape[0])
def on_surface(first, last, faces, xyz, normal, sigma, reach, max_edge, jump_slope, jump_sigma, out):
    """Whether (m,) each triangle lies on the surface: no edge bridges a hole, a shadow or a jump.

    `reach` (n,) is the sampling at a point in mm. An edge d between a and b is too long if it exceeds `max_edge` times
    the larger reach. It is a jump if it leaves the plane perpendicular to the mean normal m, which the chord of any
    surface of second order lies in: abs(d . m) > jump_slope |d| + jump_sigma sqrt(sa^2 + sb^2).
    """
    for f in range(first, last):
        good = True
        for e in range(3):
            a, b = faces[f, e], faces[f, (e + 1) % 3]
            dx, dy, dz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length > max_edge * max(reach[a], reach[b]):
                good = False
                break
            mx, my, mz = normal[a, 0] + normal[b, 0], normal[a, 1] + normal[b, 1], normal[a, 2] + normal[b, 2]
            m = math.sqrt(mx * mx + my * my + mz * mz)
            noise = math.sqrt(sigma[a] * sigma[a] + sigma[b] * sigma[b])
            if not (m > 0.2 and abs(dx * mx + dy * my + dz * mz) <= m * (jump_slope * length + jump_sigma * noise)):
                good = False
                break
        out[f] = good


@njit(cache=True, error_model="numpy")
def bow_ties(faces, start, around, fan, drop):
    """Mark triangles to drop so that around each vertex one fan stays: the largest.

    Triangles around vertex v are around[start[v]:start[v + 1]]; `fan` is scratch (as long as `around`). Two of them
    belong to one fan if they share an edge at v. Returns the number of triangles marked in `drop` (m,).
    """
    marked = 0
    for v in range(start.shape[0] - 1):
        first, last = start[v], start[v + 1]
        count = last - first
        if count < 2:
            continue
        for k in range(first, last):
            fan[k] = k - first
        changed = True
        while changed:
            changed = False
            for k in range(first, last):
                for m in range(first, k):
                    if fan[k] == fan[m]:
                        continue
                    shared = 0
                    for x in range(3):
                        for y in range(3):
                            if faces[around[k], x] == faces[around[m], y]:
                                shared += 1
                    if shared >= 2:
                        low = min(fan[k], fan[m])
                        fan[k] = low
                        fan[m] = low
                        changed = True
        best, best_count = 0, 0
        for label in range(count):
            c = 0
            for k in range(first, last):
                if fan[k] == label:
                    c += 1
            if c > best_count:
                best, best_count = label, c
        if best_count == count:
            continue
        for k in range(first, last):
            if fan[k] != best and not drop[around[k]]:
                drop[around[k]] = True
                marked += 1
    return marked


@by_rows(lambda faces, *_: faces.shape[0])
def areas(first, last, faces, xyz, out):
    """Area (m,) of each triangle, mm^2."""
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        out[f] = 0.5 * math.sqrt(x * x + y * y + z * z)


@by_rows(lambda faces, *_: faces.shape[0])
def facing(first, last, faces, xyz, centre, out):
    """Cosine (m,) between each triangle's right-handed normal and the direction to `centre`; 0 without area."""
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        dx, dy, dz = centre[0] - xyz[a, 0], centre[1] - xyz[a, 1], centre[2] - xyz[a, 2]
        s = math.sqrt((x * x + y * y + z * z) * (dx * dx + dy * dy + dz * dz))
        out[f] = (x * dx + y * dy + z * dz) / s if s > 0.0 else np.float64(0.0)


@njit(cache=True)
def incident(faces, n):
    """Triangles around each of `n` vertices: start (n + 1,), around (3 m,); those of v in start[v]..start[v + 1]."""
    start = np.zeros(n + 1, np.int64)
    for f in range(faces.shape[0]):
        for c in range(3):
            start[faces[f, c] + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    fill = start[:-1].copy()
    around = np.empty(3 * faces.shape[0], np.int64)
    for f in range(faces.shape[0]):
        for c in range(3):
            v = faces[f, c]
            around[fill[v]] = f
            fill[v] += 1
    return start, around


@njit(cache=True)
def pieces(faces, n):
    """Label (m,) of the connected piece of each triangle: the smallest of its vertices, of `n`. Union-find."""
    parent = np.arange(n)
    for f in range(faces.shape[0]):
        for c in range(2):
            a, b = faces[f, c], faces[f, c + 1]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[max(a, b)] = min(a, b)
    label = np.empty(faces.shape[0], np.int64)
    for f in range(faces.shape[0]):
        a = faces[f, 0]
        while parent[a] != a:
            a = parent[a]
        label[f] = a
    return label


@by_rows(lambda *args: args[-1].shape[0])
def ring_mean(first, last, faces, start, around, value, out):
    """Mean (n,) of `value` (n,) over the corners of the triangles around each vertex; its own value without any."""
    for v in range(first, last):
        total, count = 0.0, 0
        for k in range(start[v], start[v + 1]):
            for c in range(3):
                total += value[faces[around[k], c]]
                count += 1
        if count == 0:
            total, count = total + value[v], 1
        out[v] = total / count


@by_rows(lambda points, *_: points.shape[0])
def locate(first, last, points, corners, simplices, neighbours, out):
    """The Delaunay triangle (q,) that holds each of `points` (q, 2), -1 for points outside.

    Walks from triangle to triangle across the edge that has the point on its far side; `simplices` (m, 3) into
    `corners` (n, 2) are counter-clockwise, neighbours[t, k] lies opposite corner k of t, -1 beyond the hull. Points
    that follow each other should lie near each other.
    """
    t = 0
    for i in range(first, last):
        x, y = points[i, 0], points[i, 1]
        found = -1
        for _ in range(simplices.shape[0]):
            step, worst = -1, 0.0
            for c in range(3):
                p, q = simplices[t, (c + 1) % 3], simplices[t, (c + 2) % 3]
                ex, ey = corners[q, 0] - corners[p, 0], corners[q, 1] - corners[p, 1]
                side = ex * (y - corners[p, 1]) - ey * (x - corners[p, 0])
                if side < worst - 1e-12 * (ex * ex + ey * ey):
                    step, worst = c, side
            if step < 0:
                found = t
                break
            if neighbours[t, step] < 0:
                break
            t = neighbours[t, step]
        out[i] = found


@by_rows(lambda xyz, *_: xyz.shape[0])
def deviations(first, last, xyz, triangle, faces, out):
    """Signed distance (n,) of each point from the plane of its `triangle` (n,) of `faces`, mm; 0 where that is -1."""
    for i in range(first, last):
        f = triangle[i]
        out[i] = 0.0
        if f < 0:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        s = math.sqrt(x * x + y * y + z * z)
        dx, dy, dz = xyz[i, 0] - xyz[a, 0], xyz[i, 1] - xyz[a, 1], xyz[i, 2] - xyz[a, 2]
        if s > 0.0:
            out[i] = (x * dx + y * dy + z * dz) / s


@njit(cache=True)
def best_of_each(group, score, best):
    """Index of the highest `score` (n,) in each group, into `best` (m,), -1 where there is none; `group` -1 = none."""
    best[:] = -1
    for i in range(group.shape[0]):
        g = group[i]
        if g >= 0 and (best[g] < 0 or score[i] > score[best[g]]):
            best[g] = i
