"""Loops that settle who owns a place: owners of cells, marks of pixels, doubles. Arrays and scalars only."""

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.surface import locate
from fringescope.kernels.views import split
from fringescope.threads import by_rows

BLOCK = 256  #: pixels of a row that are worked on together


@njit(cache=True, error_model="numpy")
def bin_weights(weight, row, column, group, total, count):
    """Add up weights (n,) and how many there are in groups of `group` x `group` cells (row, column)."""
    for k in range(weight.shape[0]):
        w = weight[k]
        if row[k] >= 0 and w == w:
            total[row[k] // group, column[k] // group] += w
            count[row[k] // group, column[k] // group] += 1.0


@by_rows(lambda there, *_: there.shape[1])
def owners(first, last, there, score, group, out):
    """One plus the view (rows, cols) with the largest score among those with a point `there` (V, rows, cols); 0: none.

    `score` (V, h, w) holds the middles of groups of `group` x `group` cells, one more all round; between them bilinear.
    """
    V, _rows, cols = there.shape
    for i in range(first, last):
        y = (i + 0.5) / group + 0.5
        a = int(y)
        fy = y - a
        for j in range(cols):
            owner, best = -1, -1.0
            x = (j + 0.5) / group + 0.5
            b = int(x)
            fx = x - b
            for v in range(V):
                if there[v, i, j] != 0:
                    s = (1.0 - fy) * ((1.0 - fx) * score[v, a, b] + fx * score[v, a, b + 1])
                    s += fy * ((1.0 - fx) * score[v, a + 1, b] + fx * score[v, a + 1, b + 1])
                    if s > best:
                        owner, best = v, s
            out[i, j] = owner + 1


@by_rows(lambda flat, *_: flat.shape[0])
def mark(first, last, flat, raster, owner, bits, tile, marks, owned, close, near):
    """Give points the `bits` (256,) of their cell's `owner` (rows, cols) uint8, in `marks` (H, W).

    4 are points, 1 is owned, 2 owned and at an edge.

    `owned`, `close` (H,) count both; `near` (h, w), zeros, gets 1 for squares of `tile` pixels with an owned point.
    """
    W = marks.shape[1]
    f = np.float32
    X, Y, Z = np.empty(BLOCK, f), np.empty(BLOCK, f), np.empty(BLOCK, f)
    row, column = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    rows, cols = owner.shape
    table = owner.reshape(-1)
    for i in range(first, last):
        owned[i] = close[i] = 0
        for col in range(0, W, BLOCK):
            n = min(BLOCK, W - col)
            part = marks[i, col : col + n]
            part[:] = 0
            if split(flat[i], col, n, X, Y, Z) == 0:
                continue
            locate(X, Y, Z, raster, rows, cols, n, row, column)
            for k in range(n):
                if row[k] >= 0:
                    part[k] = bits[table[np.uintp(row[k] * cols + column[k])]]
            for left in range(col, col + n, tile):
                mine = brink = 0
                for k in range(left - col, min(left - col + tile, n)):
                    mine += part[k] & 1
                    brink += (part[k] >> 1) & 1
                owned[i] += mine
                close[i] += brink
                if mine > 0:
                    near[i // tile, left // tile] = 1


@by_rows(lambda xyz, *_: xyz.shape[0])
def place(first, last, xyz, raster, rows, cols, ab, cell):
    """Ideal coordinates `ab` (n, 2) of points (n, 3), and the number of the `raster`'s cell (see `surface.locate`)."""
    r, low_a, low_b, scale = raster, raster[12], raster[13], raster[14]
    for k in range(first, last):
        x, y, z = float(xyz[k, 0]), float(xyz[k, 1]), float(xyz[k, 2])
        depth = r[6] * x + r[7] * y + r[8] * z + r[11]
        a = (r[0] * x + r[1] * y + r[2] * z + r[9]) / depth
        b = (r[3] * x + r[4] * y + r[5] * z + r[10]) / depth
        ab[k, 0], ab[k, 1] = a, b
        column = min(max(int((a - low_a) * scale), 0), cols - 1)
        cell[k] = min(max(int((b - low_b) * scale), 0), rows - 1) * cols + column


@njit(cache=True, nogil=True, error_model="numpy")
def sort_cells(cell, start, order):
    """Points (n,) sorted by `cell`: those of cell c are `order`[`start`[c] : `start`[c + 1]], in the order they came.

    `start` (cells + 2,) comes as zeros; its last number serves the counting.
    """
    for c in cell:
        start[c + 2] += 1
    for c in range(2, len(start)):
        start[c] += start[c - 1]
    for k in range(len(cell)):
        order[start[cell[k] + 1]] = k
        start[cell[k] + 1] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def doubles(ab, xyz, normal, view, reach, sideways, near, cell, rows, cols, start, order, out):
    """Which points (n,) lie too near a kept point of another view.

    Too near is less than `reach` in the plane `ab` (n, 2), or a distance below `near` in space of which less than
    `sideways` lies in the tangent plane of one of the two (`xyz`, `normal` (n, 3), mm).

    Points lie in cells, at least `reach` wide, of a raster of `rows` x `cols`; `start` and `order` are those of
    `sort_cells`. Cell by cell, the first kept point wins.
    """
    for a in order:
        row, col = cell[a] // cols, cell[a] % cols
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            if out[a]:
                break
            for m in range(start[r * cols + max(col - 1, 0)], start[r * cols + min(col + 1, cols - 1) + 1]):
                b = order[m]
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


@by_rows(lambda marks, *_: marks.shape[0])
def unmark(first, last, marks, bit, start, gone):
    """Leave bit 4 alone to the pixels with `bit` in `marks` (H, W) that are `gone` (n,): row i's from start[i] on."""
    for i in range(first, last):
        at = start[i]
        if at == start[i + 1]:
            continue
        for j in range(marks.shape[1]):
            if (marks[i, j] & bit) != 0:
                if gone[at]:
                    marks[i, j] = 4
                at += 1


@by_rows(lambda marks, *_: marks.shape[0])
def count_marked(first, last, marks, bit, out):
    """How many pixels of each row (H,) have `bit`."""
    for i in range(first, last):
        n = 0
        for j in range(marks.shape[1]):
            n += (marks[i, j] & bit) != 0
        out[i] = n


@njit(cache=True, nogil=True, error_model="numpy")
def number(marks, bit, stride, first, out):
    """Numbers, from `first` on, of the pixels with `bit` in `marks` (H, W), row by row; returns the next one.

    `out` (h, w) gets those of every `stride`-th pixel, -1 where it has not the bit.
    """
    for i in range(marks.shape[0]):
        for j in range(marks.shape[1]):
            has = (marks[i, j] & bit) != 0
            if i % stride == 0 and j % stride == 0:
                out[i // stride, j // stride] = first if has else -1
            first += has
    return first
