"""Delaunay triangulation in the plane: points put in one by one along a Hilbert curve, edges flipped until all is well.

Coordinates `xy` (n, 2) are whole numbers from 0 to below 2^25, held as float64: then products of differences are exact,
and so is every decision here. Incremental insertion by flips: C. L. Lawson, "Software for C1 surface interpolation",
1977; the vertex at infinity: Guibas and Stolfi, doi 10.1145/282918.282923; points in rounds: Amenta, Choi and Rote,
doi 10.1145/777792.777824. Points on one circle are told apart as if each were lowered a little, the first by x, then y,
by far the most (symbolic perturbation, doi 10.1145/77635.77639): the triangulation is unique, whatever the order, and
an edge of it stays one when other points go.

A triangle t takes eight numbers of `net`, from 8 t: its corners counter-clockwise, one unused, then for each edge (from
corner k to the next) the place 8 u + j of the same edge seen from the neighbour u, and one unused. `OUT` is the vertex
at infinity: triangles that have it lie beyond the hull, so that every edge has two sides.
"""

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows

OUT = -1  #: the vertex at infinity
SIDE = 1 << 25  #: coordinates are below this
_LOW = (1 << 26) - 1
_ROUND = 8  # every round puts in this many times the points of the round before
_NEXT = (1, 2, 0)


@by_rows(lambda xy, *_: xy.shape[0])
def hilbert(first, last, xy, bits, key):
    """Position (n,) of each point along a Hilbert curve through 2^bits x 2^bits cells of the square."""
    for i in range(first, last):
        x, y = np.int64(xy[i, 0]) >> (25 - bits), np.int64(xy[i, 1]) >> (25 - bits)
        d = np.int64(0)
        for b in range(bits - 1, -1, -1):
            right, up = (x >> b) & 1, (y >> b) & 1
            d = 4 * d + ((3 * right) ^ up)
            if up == 0:  # the curve in this quarter is turned
                if right == 1:
                    x, y = ~x, ~y
                x, y = y, x
        key[i] = d


@njit(cache=True, nogil=True)
def sort_by(key, bits, order):
    """Indices (n,) of whole numbers `key` (n,) below 2^bits in ascending order, equal ones as they come. Radix sort."""
    n = key.shape[0]
    source, target = np.empty(n, np.int64), np.arange(n)
    digit = (bits + 1) // 2
    for turn in range(2):
        source, target = target, source
        start = np.zeros((1 << digit) + 1, np.int64)
        for i in range(n):
            start[((key[i] >> (turn * digit)) & ((1 << digit) - 1)) + 1] += 1
        for d in range(1 << digit):
            start[d + 1] += start[d]
        for i in range(n):
            d = (key[source[i]] >> (turn * digit)) & ((1 << digit) - 1)
            target[start[d]] = source[i]
            start[d] += 1
    for i in range(n):
        order[i] = target[i]


@njit(cache=True, nogil=True)
def side(xy, a, b, c):
    """Twice the area of the triangle a, b, c: positive where c lies left of the way from a to b. Exact."""
    return (xy[b, 0] - xy[a, 0]) * (xy[c, 1] - xy[a, 1]) - (xy[b, 1] - xy[a, 1]) * (xy[c, 0] - xy[a, 0])


@njit(cache=True, nogil=True)
def _exact(la, ma, lb, mb, lc, mc):
    """Sign of la ma + lb mb + lc mc for whole numbers below 2^52: products in three limbs of 26 bits."""
    high = (la >> 26) * (ma >> 26) + (lb >> 26) * (mb >> 26) + (lc >> 26) * (mc >> 26)
    middle = (la >> 26) * (ma & _LOW) + (lb >> 26) * (mb & _LOW) + (lc >> 26) * (mc & _LOW)
    middle += (la & _LOW) * (ma >> 26) + (lb & _LOW) * (mb >> 26) + (lc & _LOW) * (mc >> 26)
    low = (la & _LOW) * (ma & _LOW) + (lb & _LOW) * (mb & _LOW) + (lc & _LOW) * (mc & _LOW)
    middle += low >> 26
    high += middle >> 26
    if high != 0:
        return 1 if high > 0 else -1
    return 1 if (middle & _LOW) | (low & _LOW) else 0


@njit(cache=True, nogil=True)
def _before(xy, a, b):
    """Whether a comes before b: by x, then y."""
    return xy[a, 0] < xy[b, 0] or (xy[a, 0] == xy[b, 0] and xy[a, 1] < xy[b, 1])


@njit(cache=True, nogil=True)
def _tie(xy, a, b, c, d):
    """Of four points on one circle, whether the diagonal from a to d is the one that has the first of them."""
    one = a if _before(xy, a, d) else d
    two = b if _before(xy, b, c) else c
    return _before(xy, one, two)


@njit(cache=True, nogil=True)
def within(xy, a, b, c, d):
    """Whether d lies within the circle through a, b, c (counter-clockwise, none at infinity). Exact."""
    ax, ay = xy[a, 0] - xy[d, 0], xy[a, 1] - xy[d, 1]
    bx, by = xy[b, 0] - xy[d, 0], xy[b, 1] - xy[d, 1]
    cx, cy = xy[c, 0] - xy[d, 0], xy[c, 1] - xy[d, 1]
    la, lb, lc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    ma, mb, mc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    s, t, u = la * ma, lb * mb, lc * mc  # rounded; what is above is not
    total = s + t + u
    bound = 6e-16 * (abs(s) + abs(t) + abs(u))
    if total > bound or total < -bound:
        return total > 0.0
    sign = _exact(np.int64(la), np.int64(ma), np.int64(lb), np.int64(mb), np.int64(lc), np.int64(mc))
    return sign > 0 or (sign == 0 and _tie(xy, a, b, c, d))


@njit(cache=True, nogil=True)
def _wrong(xy, p, a, b, d):
    """Whether the edge a b of the triangle p, a, b must go, d beyond it. At most one of a, b, d is at infinity."""
    if d < 0:
        return side(xy, p, a, b) <= 0.0
    if a < 0:
        return side(xy, b, p, d) > 0.0
    if b < 0:
        return side(xy, p, a, d) > 0.0
    return within(xy, p, a, b, d)


@njit(cache=True, nogil=True)
def _triangle(net, t, a, b, c, x, y, z):
    """Write a triangle and what lies across its edges, and tell those."""
    net[t], net[t + 1], net[t + 2] = a, b, c
    net[t + 4], net[t + 5], net[t + 6] = x, y, z
    net[x + 4], net[y + 4], net[z + 4] = t, t + 1, t + 2


@njit(cache=True, nogil=True)
def first_triangle(xy, at, net):
    """Begin with the first three points of `at` that are not on one line, and what lies beyond.

    Returns the places in `at` of the second and the third; -1 where there is none.
    """
    n = at.shape[0]
    for j in range(1, n):
        if xy[at[j], 0] != xy[at[0], 0] or xy[at[j], 1] != xy[at[0], 1]:
            for k in range(j + 1, n):
                s = side(xy, at[0], at[j], at[k])
                if s != 0.0:
                    a, b, c = at[0], at[j], at[k]
                    if s < 0.0:
                        b, c = c, b
                    _triangle(net, 0, a, b, c, 8, 16, 24)
                    _triangle(net, 8, b, a, OUT, 0, 26, 17)
                    _triangle(net, 16, c, b, OUT, 1, 10, 25)
                    _triangle(net, 24, a, c, OUT, 2, 18, 9)
                    return j, k
            return j, -1
    return -1, -1


@njit(cache=True, nogil=True)
def _holder(xy, net, p, t):
    """The triangle that holds p, by a walk from t; one at infinity where p lies beyond the hull."""
    for k in range(3):
        if net[t + k] < 0:  # begin at the hull's inner side
            t = net[t + 4 + _NEXT[k]] & ~7
            break
    x, y = xy[p, 0], xy[p, 1]
    came = -1
    while True:
        stay = True
        for k in range(3):
            if k == came:
                continue
            a, b = net[t + k], net[t + _NEXT[k]]
            s = (xy[b, 0] - xy[a, 0]) * (y - xy[a, 1]) - (xy[b, 1] - xy[a, 1]) * (x - xy[a, 0])
            if s < 0.0:
                across = net[t + 4 + k]
                t, came = across & ~7, across & 7
                stay = False
                break
        if stay or net[t] < 0 or net[t + 1] < 0 or net[t + 2] < 0:
            return t


@njit(cache=True, nogil=True)
def _put(xy, net, used, p, t):
    """Put in the point p, near the triangle t. Returns the triangles' new end in `net` and one that has p."""
    t = _holder(xy, net, p, t)
    a, b, c = net[t], net[t + 1], net[t + 2]
    for v in (a, b, c):
        if v >= 0 and xy[v, 0] == xy[p, 0] and xy[v, 1] == xy[p, 1]:
            return used, t
    u, w = used, used + 8
    x, y, z = net[t + 4], net[t + 5], net[t + 6]
    _triangle(net, t, p, a, b, w + 2, x, u)
    _triangle(net, u, p, b, c, t + 2, y, w)
    _triangle(net, w, p, c, a, u + 2, z, t)
    while True:  # around p, whose triangles have it as their first corner
        b, across = net[t + 2], net[t + 5]
        u, j = across & ~7, across & 7
        j1 = _NEXT[j]
        j2 = _NEXT[j1]
        d = net[u + j2]
        if _wrong(xy, p, net[t + 1], b, d):
            x, y, z = net[u + 4 + j1], net[u + 4 + j2], net[t + 6]
            net[t + 2], net[t + 5], net[t + 6] = d, x, u
            net[x + 4] = t + 1
            _triangle(net, u, p, d, b, t + 2, y, z)
        else:
            if b == a:
                return used + 16, t
            t = net[t + 6] & ~7


@njit(cache=True, nogil=True)
def insert(xy, at, net, used, near, skip_j, skip_k):
    """Put in the points `at`, in rounds, except those at the places 0, `skip_j` and `skip_k` if these are not -1.

    Returns the triangles' new end in `net`, which has room for all, and a triangle at the last point.
    """
    n = at.shape[0]
    step = np.int64(1)
    while skip_j >= 0 and step * 64 < n:
        step *= _ROUND
    outer = np.int64(0)
    while step >= 1:
        for i in range(0, n, step):
            if outer > 0 and i % outer == 0:
                continue
            if skip_j >= 0 and i in (0, skip_j, skip_k):
                continue
            used, near = _put(xy, net, used, at[i], near)
        outer, step = step, step // _ROUND
    return used, near


@njit(cache=True, nogil=True)
def finite(net, used, number, simplices, neighbours):
    """The triangles that are not at infinity, counter-clockwise; -1 for a neighbour that is. Returns their number.

    `neighbours` lie opposite the corner of the same place; `number` (used / 8,) is scratch.
    """
    count = 0
    for t in range(0, used, 8):
        number[t >> 3] = -1
        if net[t] >= 0 and net[t + 1] >= 0 and net[t + 2] >= 0:
            number[t >> 3] = count
            count += 1
    for t in range(0, used, 8):
        i = number[t >> 3]
        if i >= 0:
            for k in range(3):
                simplices[i, k] = net[t + k]
                neighbours[i, k] = number[net[t + 4 + _NEXT[k]] >> 3]
    return count
