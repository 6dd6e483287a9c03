"""Loops over triangles: which of them lie on the surface, and where the surface touches itself in a single vertex.

`faces` (m, 3) index into points `xyz` (n, 3) world mm with unit `normal` (n, 3), `sigma` (n,) in mm.
"""

import math

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True, error_model="numpy")
def on_surface(faces, xyz, normal, sigma, reach, max_edge, jump_slope, jump_sigma, out):
    """Whether (m,) each triangle lies on the surface: no edge bridges a hole, a shadow or a jump.

    `reach` (n,) is the sampling at a point in mm. An edge d between a and b is too long if it exceeds `max_edge` times
    the larger reach. It is a jump if it leaves the plane perpendicular to the mean normal m, which the chord of any
    surface of second order lies in: abs(d . m) > jump_slope |d| + jump_sigma sqrt(sa^2 + sb^2).
    """
    for f in prange(faces.shape[0]):
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


@njit(cache=True, parallel=True, error_model="numpy")
def areas(faces, xyz, out):
    """Area (m,) of each triangle, mm^2."""
    for f in prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        out[f] = 0.5 * math.sqrt(x * x + y * y + z * z)


@njit(cache=True, parallel=True, error_model="numpy")
def facing(faces, xyz, centre, out):
    """Cosine (m,) between each triangle's right-handed normal and the direction to `centre`; 0 without area."""
    for f in prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        dx, dy, dz = centre[0] - xyz[a, 0], centre[1] - xyz[a, 1], centre[2] - xyz[a, 2]
        s = math.sqrt((x * x + y * y + z * z) * (dx * dx + dy * dy + dz * dz))
        out[f] = (x * dx + y * dy + z * dz) / s if s > 0.0 else np.float64(0.0)
