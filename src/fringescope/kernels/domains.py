"""Contiguous domains of the phase (III-D 3), by union-find over nodes: a calm tile is one, elsewhere each pixel.

The `kind` (h, w) of each tile says which: CALM, one node; VOID, one as well, without a pixel; or PIXELS, one each.
Bands of tiles are linked by themselves, on all cores, then band to band. Arrays and scalars only.
"""

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.links import largest_step, linked
from fringescope.kernels.tiles import TILE

PIXELS, CALM, VOID = 0, 1, 2

_REST = TILE - 1
_BITS = _REST.bit_length()


@njit(cache=True, inline="always", error_model="numpy")
def _node_of(node, kind, i, j):
    t, u = i >> _BITS, j >> _BITS
    return node[t, u] + (0 if kind[t, u] != PIXELS else ((i & _REST) << _BITS) + (j & _REST))


@njit(cache=True, inline="always", error_model="numpy")
def label_of(node, label, kind, i, j):
    """The domain of a pixel; -1 where it is masked."""
    t, u = i >> _BITS, j >> _BITS
    return label[node[t, u] + (0 if kind[t, u] != PIXELS else ((i & _REST) << _BITS) + (j & _REST))]


@njit(cache=True, nogil=True, error_model="numpy")
def number(kind, node):
    """The first node (h, w) of each tile; returns the number of nodes."""
    n = 0
    for t in range(kind.shape[0]):
        for u in range(kind.shape[1]):
            node[t, u] = n
            n += TILE * TILE if kind[t, u] == PIXELS else 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _root(parent, a):
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True, nogil=True, error_model="numpy")
def _join(parent, a, b):
    a, b = _root(parent, a), _root(parent, b)
    if a < b:
        parent[b] = a
    else:
        parent[a] = b


@njit(cache=True, nogil=True, error_model="numpy")
def _link_pixel(phase, sigma, reasons, field, factor, floor, noise, kind, node, parent, i, j, up, left):
    """Join a pixel with the next one above and to the left, over one masked pixel with the next but one."""
    if reasons[i, j] != 0:
        return
    step = -1.0
    for side in range(2):
        if not (up if side == 0 else left):
            continue
        y, x = (i - 1, j) if side == 0 else (i, j - 1)
        if y >= 0 and x >= 0 and reasons[y, x] != 0:
            y, x = (i - 2, j) if side == 0 else (i, j - 2)
        if y < 0 or x < 0 or reasons[y, x] != 0:
            continue
        if step < 0.0:
            step = largest_step(field, factor, floor, i, j, phase.shape[0], phase.shape[1])
        if linked(phase, sigma, step, noise, i, j, y, x):
            _join(parent, _node_of(node, kind, i, j), _node_of(node, kind, y, x))


@njit(cache=True, nogil=True, error_model="numpy")
def link(first, last, phase, sigma, reasons, field, factor, floor, noise, kind, node, parent):
    """Join the nodes of rows of tiles first..last-1 with each other, as far as they are `linked`.

    Calm tiles next to each other are: the steps between them are among those that make them calm.
    """
    H, W = phase.shape
    for t in range(first, last):
        inside = t > first
        for u in range(node.shape[1]):
            if kind[t, u] == VOID:
                continue
            if kind[t, u] == PIXELS:
                for i in range(t * TILE, min(t * TILE + TILE, H)):
                    up = inside or i > t * TILE + 1  # what a row's second pixel sees above may lie beyond the first
                    for j in range(u * TILE, min(u * TILE + TILE, W)):
                        _link_pixel(phase, sigma, reasons, field, factor, floor, noise, kind, node, parent, i, j,
                                    up or (i > t * TILE and reasons[i - 1, j] == 0), True)  # fmt: skip
                continue
            if u > 0 and kind[t, u - 1] == CALM:
                _join(parent, node[t, u], node[t, u - 1])
            elif u > 0:
                for i in range(t * TILE, min(t * TILE + TILE, H)):
                    _link_pixel(phase, sigma, reasons, field, factor, floor, noise, kind, node, parent, i, u * TILE,
                                False, True)  # fmt: skip
            if inside and kind[t - 1, u] == CALM:
                _join(parent, node[t, u], node[t - 1, u])
            elif inside:
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    _link_pixel(phase, sigma, reasons, field, factor, floor, noise, kind, node, parent, t * TILE, j,
                                True, False)  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def link_up(t, phase, sigma, reasons, field, factor, floor, noise, kind, node, parent):
    """Join a row of tiles with what lies above it: what `link` leaves out for the first of its rows."""
    H, W = phase.shape
    for u in range(node.shape[1]):
        if kind[t, u] == VOID:
            continue
        if kind[t, u] == CALM and kind[t - 1, u] == CALM:
            _join(parent, node[t, u], node[t - 1, u])
            continue
        for j in range(u * TILE, min(u * TILE + TILE, W)):
            for i in range(t * TILE, min(t * TILE + (1 if kind[t, u] == CALM else 2), H)):
                _link_pixel(phase, sigma, reasons, field, factor, floor, noise, kind, node, parent, i, j, True,
                            False)  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def settle(reasons, kind, node, parent, label):
    """Labels of all nodes, counted from 0, -1 for masked pixels; returns the number of pixels of each."""
    H, W = reasons.shape
    sizes = np.zeros(len(parent), np.int64)
    count = 0
    for t in range(node.shape[0]):
        rows = min(TILE, H - t * TILE)
        for u in range(node.shape[1]):
            columns = min(TILE, W - u * TILE)
            first = node[t, u]
            if kind[t, u] == VOID:
                label[first] = -1
                continue
            if kind[t, u] == CALM:
                r = _root(parent, first)
                if r == first:
                    label[first] = count
                    count += 1
                else:
                    label[first] = label[r]
                sizes[label[first]] += rows * columns
                continue
            for k in range(TILE * TILE):
                label[first + k] = -1
            for y in range(rows):
                for x in range(columns):
                    if reasons[t * TILE + y, u * TILE + x] != 0:
                        continue
                    a = first + y * TILE + x
                    r = _root(parent, a)
                    if r == a:
                        label[a] = count
                        count += 1
                    else:
                        label[a] = label[r]
                    sizes[label[a]] += 1
    return sizes[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def mark_small(node, label, kind, sizes, least, bit, reasons):
    """Give `bit` to the pixels without a reason of domains of fewer than `least` pixels."""
    H, W = reasons.shape
    for t in range(node.shape[0]):
        for u in range(node.shape[1]):
            if kind[t, u] != PIXELS and (label[node[t, u]] < 0 or sizes[label[node[t, u]]] >= least):
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    own = label_of(node, label, kind, i, j)
                    if own >= 0 and sizes[own] < least and reasons[i, j] == 0:
                        reasons[i, j] = bit
