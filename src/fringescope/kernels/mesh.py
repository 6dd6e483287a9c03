"""Loops over triangles: which lie on the surface, what hangs together, and what a coarser surface would miss.

`faces` (m, 3) index into points `xyz` (n, 3) world mm with unit `normal` (n, 3), `sigma` (n,) in mm.
"""

import math

import numpy as np

from fringescope.jit import njit
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


@njit(cache=True, nogil=True)
def border_edges(simplices, neighbours, on, leaving):
    """How many edges with surface on one side only leave each vertex (n,), counter-clockwise around the triangles `on`.

    `simplices`, `neighbours` (m, 3), each opposite the corner of the same place, -1 for none; `on` (m,) those of the
    surface. As many edges leave a vertex as there are fans of triangles around it that are not closed.
    """
    leaving[:] = 0
    for t in range(simplices.shape[0]):
        if on[t]:
            for c in range(3):
                u = neighbours[t, c]
                if u < 0 or not on[u]:
                    leaving[simplices[t, (c + 1) % 3]] += 1


@njit(cache=True, nogil=True)
def _fan(simplices, neighbours, on, t, v, keep, drop):
    """The number of triangles from t counter-clockwise around its corner v; cleared in `keep` if `drop`."""
    count = 0
    while t >= 0 and on[t]:
        count += 1
        if drop:
            keep[t] = False
        c = 0
        while simplices[t, c] != v:
            c += 1
        t = neighbours[t, (c + 1) % 3]
    return count


@njit(cache=True, nogil=True)
def bow_ties(simplices, neighbours, on, leaving, largest, keep):
    """Clear triangles in `keep` (m,) so that around each vertex one fan stays: the largest, of equal ones the first.

    As `border_edges`, whose `leaving` (n,) it needs; `largest` (n,) is scratch. Returns the number of fans cleared;
    others may have come apart by that, so call it until there is none.
    """
    largest[:] = 0
    cleared = 0
    for turn in range(2):
        for t in range(simplices.shape[0]):
            for c in range(3):
                v, u = simplices[t, c], neighbours[t, (c + 2) % 3]
                if not on[t] or leaving[v] < 2 or (u >= 0 and on[u]):
                    continue
                if turn == 0:
                    largest[v] = max(largest[v], _fan(simplices, neighbours, on, t, v, keep, False))
                elif _fan(simplices, neighbours, on, t, v, keep, False) == largest[v]:
                    largest[v] = 0  # stays
                else:
                    _fan(simplices, neighbours, on, t, v, keep, True)
                    cleared += 1
    return cleared


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
def plane_areas(first, last, faces, ab, out):
    """Area (m,) of each triangle of points `ab` (n, 2) in a plane."""
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u = (ab[b, 0] - ab[a, 0]) * (ab[c, 1] - ab[a, 1])
        out[f] = 0.5 * abs(u - (ab[b, 1] - ab[a, 1]) * (ab[c, 0] - ab[a, 0]))


@by_rows(lambda faces, *_: faces.shape[0])
def towards(first, last, faces, xyz, centre, out, area):
    """The triangles (m, 3) with their corners counter-clockwise as seen from `centre` (3,), and whether they have area.

    `area` (m,) is False where the triangle lies on a line, or on a plane through `centre`.
    """
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        side = x * (centre[0] - xyz[a, 0]) + y * (centre[1] - xyz[a, 1]) + z * (centre[2] - xyz[a, 2])
        out[f, 0], out[f, 1], out[f, 2] = a, (c if side < 0.0 else b), (b if side < 0.0 else c)
        area[f] = side != 0.0


@by_rows(lambda faces, *_: faces.shape[0])
def textured_by(first, last, faces, owner, seen, views, out):
    """The view (m,) of `views` whose picture suits each triangle: one that sees all corners, and owns most of them.

    `owner` (n,) is each vertex' view, `seen` (n,) has bit v set where view v sees it. Of equal views the first.
    """
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        all_see = seen[a] & seen[b] & seen[c]
        best = -1
        for v in range(views):
            score = (owner[a] == v) + (owner[b] == v) + (owner[c] == v) + 10 * ((all_see >> v) & 1)
            if score > best:
                best = score
                out[f] = v


@by_rows(lambda xyz, *_: xyz.shape[0])
def sampling(first, last, xyz, normal, centre, pixel_rad, out):
    """Distance (n,) on the surface between the samples of a camera at `centre` whose pixels subtend `pixel_rad`, mm."""
    for i in range(first, last):
        dx, dy, dz = centre[0] - xyz[i, 0], centre[1] - xyz[i, 1], centre[2] - xyz[i, 2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (dx * normal[i, 0] + dy * normal[i, 1] + dz * normal[i, 2]) / max(distance, 1e-9)
        out[i] = distance * pixel_rad / max(cosine, 0.2)


@njit(cache=True, nogil=True)
def incident(faces, n):
    """Triangles around each of `n` vertices: start (n + 1,), around (3 m,); those of v in start[v]..start[v + 1]."""
    start = np.zeros(n + 1, np.int32)
    for f in range(faces.shape[0]):
        for c in range(3):
            start[faces[f, c] + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    fill = start[:-1].copy()
    around = np.empty(3 * faces.shape[0], np.int32)
    for f in range(faces.shape[0]):
        for c in range(3):
            v = faces[f, c]
            around[fill[v]] = f
            fill[v] += 1
    return start, around


@njit(cache=True, nogil=True)
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


@by_rows(lambda *args: args[-1].shape[0])
def residuals(first, last, faces, start, around, xyz, normal, out):
    """Distance (n,) along its normal from the mean of the corners around each vertex to the vertex, mm; 0 without."""
    for v in range(first, last):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(start[v], start[v + 1]):
            for c in range(3):
                w = faces[around[k], c]
                x, y, z = x + xyz[w, 0], y + xyz[w, 1], z + xyz[w, 2]
        out[v] = 0.0
        count = 3 * (start[v + 1] - start[v])
        if count > 0:
            out[v] = ((xyz[v, 0] - x / count) * normal[v, 0] + (xyz[v, 1] - y / count) * normal[v, 1]
                      + (xyz[v, 2] - z / count) * normal[v, 2])


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


@njit(cache=True, nogil=True)
def best_of_each(group, score, best):
    """Index of the highest `score` (n,) in each group, into `best` (m,), -1 where there is none; `group` -1 = none."""
    best[:] = -1
    for i in range(group.shape[0]):
        g = group[i]
        if g >= 0 and (best[g] < 0 or score[i] > score[best[g]]):
            best[g] = i


@njit(cache=True, nogil=True)
def best_of_cells(ab, at, step, sides, quiet, centred, keys, best, chosen):
    """Choose one of the points `at` (k,) in each cell: the least `quiet` (k,) plus `centred` times its offset squared.

    Cells are squares of `sides[step]`, a lattice for each `step` (k,); the offset is 0 in the middle of
    a cell, 1 at its edge. `keys`, `best` are a hash table, more entries than points and a power of
    two, at least 16; `best` -1 throughout before and after. Sets `chosen` (n,) and returns the number of cells.
    """
    mask = keys.shape[0] - 1
    count = 0
    score = np.empty(at.shape[0], np.float32)
    for i in range(at.shape[0]):
        s = sides[step[i]]
        x, y = ab[at[i], 0] / s, ab[at[i], 1] / s
        column, row = np.int64(x), np.int64(y)
        off = 2.0 * max(abs(x - column - 0.5), abs(y - row - 0.5))
        score[i] = quiet[i] + centred * off * off
        key = (np.int64(step[i]) << 54) | (row << 27) | column
        tile = (key >> 2) & ~(np.int64(3) << 25)  # 4 x 4 cells lie beside each other in the table
        slot = ((tile ^ (tile >> 23)) * -7046029254386353131 >> 40) & mask & ~15 | (row & 3) << 2 | column & 3
        while best[slot] >= 0 and keys[slot] != key:
            slot = (slot + 17) & mask
        if best[slot] < 0:
            keys[slot] = key
            best[slot] = i
            count += 1
        elif score[i] < score[best[slot]]:
            best[slot] = i
    for slot in range(mask + 1):
        if best[slot] >= 0:
            chosen[at[best[slot]]] = True
            best[slot] = -1
    return count
