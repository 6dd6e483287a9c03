"""The neighbours' vote on the order of a pixel's phase, in the tiles where they are not of one mind (equation 5).

Arrays and scalars only; `looked` (h, w) are the tiles (see `tiles.py`) that a kernel looks at. Elsewhere it writes
nothing.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.raw import unowned
from fringescope.kernels.tiles import TILE, among
from fringescope.threads import by_rows

MOST = 8  #: turns by which a vote may change an order
CONFIRMED, SPLIT = 127, -128  #: in `changed`: the majority is for the own order; no order has the majority

_BLOCK = 512
_TWO_PI = 2.0 * math.pi
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)
_CONTRACT = {"contract"}


@njit(cache=True, inline="always", error_model="numpy")
def _run_end(looked, t, u, most):
    """The end of the run of at most `most` tiles that are looked at, from u on; u if that one is not."""
    end = u
    while end < looked.shape[1] and end - u < most and looked[t, end]:
        end += 1
    return end


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _widen(phase, sigma, most, m, low, high):
    """Take a row's voters into the least and greatest phase per column."""
    for j in range(m):
        p, a, b = phase[j], low[j] + _ZERO, high[j] + _ZERO  # zero: see tiles.py
        votes = sigma[j] < most
        low[j] = p if votes & (p < a) else a
        high[j] = p if votes & (p > b) else b


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _shifted(low, high, other_low, other_high, n):
    for j in range(n):
        a, b, p, q = low[j] + _ZERO, high[j] + _ZERO, other_low[j], other_high[j]
        low[j] = p if p < a else a
        high[j] = q if q > b else b


@njit(cache=True, nogil=True, error_model="numpy")
def _torn_row(phase, sigma, most, reasons, weak, radius, range_, i, begin, end, low, high, least, greatest, asked):
    """See `torn`: columns begin..end-1 (at most _BLOCK) of row i."""
    H, W = phase.shape
    left, right = max(begin - radius, 0), min(end + radius, W)
    skip, n = left - (begin - radius), end - begin  # columns of the scratch that lie outside the picture
    low[:] = _INF
    high[:] = -_INF
    for y in range(max(i - radius, 0), min(i + radius + 1, H)):
        _widen(phase[y, left:right], sigma[y, left:right], most, right - left, low[skip:], high[skip:])
    least[:n] = _INF
    greatest[:n] = -_INF
    for x in range(2 * radius + 1):
        _shifted(least, greatest, low[x : x + n], high[x : x + n], n)
    some = np.uint8(0)
    row, own = reasons[i, begin:end], sigma[i, begin:end]
    for j in range(n):
        matters = ((row[j] & weak) == 0) | (own[j] < most)
        out = np.uint8(1) if (greatest[j] - least[j] >= range_) & matters else np.uint8(0)
        asked[j] = out
        some |= out
    return some != 0


@by_rows(lambda _phase, _sigma, _most, _reasons, _weak, _radius, _range, looked, *_: among(looked))
def torn(first, last, phase, sigma, most, reasons, weak, radius, range_, looked, asked, changed, some):
    """Pixels whose order the neighbours' vote may change: 1 in `asked` (H, W); `some` (h, w) are their tiles.

    `changed` gets 0. Where the phases in the window of `radius` differ by less than `range_` (pi), every voter is for
    the own order. A
    pixel votes if its `sigma` is below `most`; one that does not, and is `weak` by its reasons, does not matter.
    """
    phase, sigma, reasons = unowned(phase), unowned(sigma), unowned(reasons)
    H, W = phase.shape
    low, high = np.empty(_BLOCK + 2 * radius, np.float32), np.empty(_BLOCK + 2 * radius, np.float32)
    least, greatest = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    range_, most = np.float32(range_), np.float32(most)
    for t in range(first, last):
        u = 0
        while u < looked.shape[1]:
            end = _run_end(looked, t, u, _BLOCK // TILE)
            if end > u:
                a, b = u * TILE, min(end * TILE, W)
                found = False
                for i in range(t * TILE, min(t * TILE + TILE, H)):
                    out = asked[i, a:b]
                    changed[i, a:b] = 0
                    found |= _torn_row(phase, sigma, most, reasons, weak, radius, range_, i, a, b, low, high, least,
                                       greatest, out)  # fmt: skip
                some[t, u:end] = found
            else:
                some[t, u] = False
            u = max(end, u + 1)


@by_rows(lambda _moved, _mark, _radius, looked, _asked: among(looked))
def near(first, last, moved, mark, radius, looked, asked):
    """Pixels within `radius` of one whose `moved` has `mark`: 1 in `asked` (H, W); others' votes stay as they were.

    Such a pixel is `looked` at itself, and so are all near it.
    """
    H, W = moved.shape
    for t in range(first, last):
        top, end = t * TILE, min(t * TILE + TILE, H)
        for u in range(looked.shape[1]):
            if looked[t, u]:
                for i in range(top, end):
                    asked[i, u * TILE : min(u * TILE + TILE, W)] = 0
        for s in range(max(top - radius, 0) // TILE, min((end + radius - 1) // TILE + 1, looked.shape[0])):
            for u in range(looked.shape[1]):
                if not looked[s, u]:
                    continue
                for y in range(max(s * TILE, top - radius), min(s * TILE + TILE, end + radius, H)):
                    for x in range(u * TILE, min(u * TILE + TILE, W)):
                        if moved[y, x] & mark:
                            left, right = max(x - radius, 0), min(x + radius + 1, W)
                            for i in range(max(y - radius, top), min(y + radius + 1, end)):
                                asked[i, left:right] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def _poll(phase, sigma, most, doubt, i, j, radius, least, majority, max_slope, counts):
    """The vote on one pixel; see `poll`."""
    H, W = phase.shape
    p = phase[i, j]
    votes = own = 0
    for y in range(max(i - radius, 0), min(i + radius + 1, H)):
        for x in range(max(j - radius, 0), min(j + radius + 1, W)):
            q = phase[y, x]
            if (y == i and x == j) or not sigma[y, x] < most or q != q or (doubt.size > 0 and doubt[y, x] != 0):
                continue
            limit = max_slope * max(abs(y - i), abs(x - j))
            if abs(q - p) < math.pi:
                if abs(q - p) <= limit:
                    votes += 1
                    own += 1
                continue
            turns = math.floor((q - p) / _TWO_PI + 0.5)
            if abs(q - p - _TWO_PI * turns) > limit:
                continue
            votes += 1
            if turns >= -MOST and turns <= MOST:
                counts[int(turns) + MOST] += 1
    if own == votes:
        return CONFIRMED if votes >= least else 0
    result, top = 0, MOST
    if votes >= least:
        counts[MOST] += own
        for t in range(2 * MOST + 1):
            if counts[t] > counts[top]:
                top = t
        if counts[top] >= majority * votes:
            result = CONFIRMED if top == MOST else top - MOST
        elif counts[MOST] < (1.0 - majority) * votes:
            result = SPLIT
    counts[:] = 0
    return result


@by_rows(lambda _phase, _sigma, _most, _doubt, _asked, looked, *_: among(looked))
def poll(first, last, phase, sigma, most, doubt, asked, looked, radius, least, majority, max_slope, changed):
    """Let the neighbours vote on the order of each pixel whose lowest bit is set in `asked` (H, W).

    Each neighbour of a `sigma` below `most`, and not in `doubt` (H, W; or empty), votes for the order that brings this
    pixel nearest to it, if the wrapped difference is below `max_slope` times the distance. The own order stays unless
    another, at most 8 away, holds `majority` of at least `least` votes. `changed` (int8) gets the elected change of
    order, CONFIRMED where the majority is for the own order, SPLIT where no order has the majority, 0 where too few
    voted; it stays what it was where nobody asked.
    """
    phase, sigma = unowned(phase), unowned(sigma)
    doubt, changed = unowned(doubt), unowned(changed)
    H, W = phase.shape
    counts = np.zeros(2 * MOST + 1, np.int64)
    for t in range(first, last):
        for u in range(looked.shape[1]):
            if not looked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    if not asked[i, j] & 1:
                        continue
                    changed[i, j] = 0
                    if phase[i, j] == phase[i, j]:
                        changed[i, j] = _poll(
                            phase, sigma, most, doubt, i, j, radius, least, majority, max_slope, counts
                        )


@by_rows(lambda _changed, _asked, looked, *_: among(looked))
def move(first, last, changed, asked, looked, bit, mark, phase, reasons, moved, some):
    """Change orders as elected: `phase` by turns; `moved` (H, W) gets `mark`, `bit` is taken from `reasons`.

    `some` (h, w) are the tiles in which an order has changed.
    """
    H, W = phase.shape
    for t in range(first, last):
        for u in range(looked.shape[1]):
            some[t, u] = False
            if not looked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    n = changed[i, j]
                    if asked[i, j] & 1 and n != 0 and n >= -MOST and n <= MOST:
                        phase[i, j] = phase[i, j] + _TWO_PI * n
                        reasons[i, j] &= ~bit
                        moved[i, j] |= mark
                        some[t, u] = True


@njit(cache=True, nogil=True, error_model="numpy")
def usual_step(phase, sigma, most, stride, down, across):
    """The median step, without its sign, from every `stride`-th pixel in row and column to the one `down` and `across`
    from it, where both have a `sigma` below `most`; 0 where there is none.
    """
    H, W = phase.shape
    found = np.empty((H // stride + 1) * (W // stride + 1), np.float32)
    n = 0
    for i in range(0, H - down, stride):
        for j in range(0, W - across, stride):
            d = abs(phase[i + down, j + across] - phase[i, j])
            if sigma[i, j] < most and sigma[i + down, j + across] < most and d < _INF:
                found[n] = d
                n += 1
    return np.median(found[:n]) if n > 0 else _ZERO


@njit(cache=True, nogil=True, error_model="numpy")
def collect(moved, looked):
    """Rows and columns of the pixels that have moved, all in tiles that are looked at."""
    H, W = moved.shape
    rows, columns = np.empty(0, np.int64), np.empty(0, np.int64)
    for go in range(2):
        n = 0
        for t in range(looked.shape[0]):
            for u in range(looked.shape[1]):
                if not looked[t, u]:
                    continue
                for i in range(t * TILE, min(t * TILE + TILE, H)):
                    for j in range(u * TILE, min(u * TILE + TILE, W)):
                        if moved[i, j] != 0:
                            if go == 1:
                                rows[n], columns[n] = i, j
                            n += 1
        if go == 0:
            rows, columns = np.empty(n, np.int64), np.empty(n, np.int64)
    return rows, columns


@by_rows(lambda _sigma, _most, _reasons, _bit, _weak, _changed, looked, *_: among(looked))
def doubts(first, last, sigma, most, reasons, bit, weak, changed, looked, doubt, some):
    """1 in `doubt` (H, W) where `reasons` have `bit`, 4 where that does not matter (see `torn`); 2 more where the vote
    was SPLIT; `some` (h, w): tiles with a 1.
    """
    H, W = reasons.shape
    for t in range(first, last):
        u = 0
        while u < looked.shape[1]:
            end = _run_end(looked, t, u, looked.shape[1])
            some[t, u : max(end, u + 1)] = False
            a, b = u * TILE, min(end * TILE, W)
            for i in range(t * TILE, min(t * TILE + TILE, H) if end > u else 0):
                row, own, out, votes = reasons[i, a:b], sigma[i, a:b], doubt[i, a:b], changed[i, a:b]
                for j in range(b - a):
                    matters = ((row[j] & weak) == 0) | (own[j] < most)
                    kind = np.uint8(1) if matters else np.uint8(4)
                    kind = kind if row[j] & bit else np.uint8(0)
                    out[j] = kind | (np.uint8(2) if votes[j] == SPLIT else np.uint8(0))
                for v in range(end - u):
                    found = np.uint8(0)
                    for j in range(v * TILE, min(v * TILE + TILE, b - a)):
                        found |= out[j]
                    some[t, u + v] |= (found & 1) != 0
            u = max(end, u + 1)


@by_rows(lambda _changed, _doubt, looked, *_: among(looked))
def confirm(first, last, changed, doubt, looked, some):
    """Take the 1 from `doubt` where the vote has CONFIRMED the order; `some` (h, w): tiles in which it has."""
    H, W = changed.shape
    for t in range(first, last):
        for u in range(looked.shape[1]):
            some[t, u] = False
            if not looked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    if doubt[i, j] & 1 and changed[i, j] == CONFIRMED:
                        doubt[i, j] &= np.uint8(2)
                        some[t, u] = True


@by_rows(lambda _doubt, looked, *_: among(looked))
def note_doubts(first, last, doubt, looked, bit, reasons):
    """`bit` in `reasons` (H, W) where there is `doubt`, and nowhere else in the tiles that are looked at."""
    H, W = reasons.shape
    for t in range(first, last):
        u = 0
        while u < looked.shape[1]:
            end = _run_end(looked, t, u, looked.shape[1])
            a, b = u * TILE, min(end * TILE, W)
            for i in range(t * TILE, min(t * TILE + TILE, H) if end > u else 0):
                row, out = doubt[i, a:b], reasons[i, a:b]
                for j in range(b - a):
                    r = out[j] & ~bit
                    out[j] = r | bit if row[j] != 0 else r
            u = max(end, u + 1)


@by_rows(lambda reasons, *_: reasons.shape[0])
def outweigh(first, last, reasons, bit, weak, dark, inconsistent):
    """Take `bit` from the reasons of pixels that are `weak` anyway, and `inconsistent` from `dark` ones."""
    for i in range(first, last):
        row = reasons[i]
        for j in range(len(row)):
            r = row[j]
            r = r & ~bit if r & weak else r
            row[j] = r & ~inconsistent if r & dark else r
