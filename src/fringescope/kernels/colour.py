"""Loops over pictures: raw samples to linear light, distance from highlights, gaps, colours of points.

Arrays and scalars only; pictures (H, W, 3) float32, linear light 0..1.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows

GAP = 3  #: pixels around a gap in the blending that tell what blending does there

_f = np.float32
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


@njit(cache=True, inline="always", error_model="numpy")
def tone(light, table):
    """Linear light 0..1 to a code of `table` (4097,); NaN is black."""
    return table[int(min(max(light if light == light else _ZERO, _ZERO), _ONE) * _f(4096) + _HALF)]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _numbers(light, at, gain, n, out):
    """Places in a table of 4097 of light, from `at` on, times `gain`, clipped to 0..1; NaN is black."""
    for k in range(n):
        x = light[at + np.uintp(k)] * gain[k]
        x = x if x > _ZERO else _ZERO
        out[k] = np.int32(min(x, _ONE) * _f(4096) + _HALF)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _grey_numbers(light, at, gain, n, out):
    for k in range(n):
        x = light[at + np.uintp(k)] * gain
        x = x if x > _ZERO else _ZERO
        out[k] = np.int32(min(x, _ONE) * _f(4096) + _HALF)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _places(light, n, out):
    for k in range(n):
        x = light[k] if light[k] > _ZERO else _ZERO
        out[k] = np.int32(min(x, _ONE) * _f(4096) + _HALF)


@njit(cache=True, nogil=True, error_model="numpy")
def codes_of(light, table, n, out):
    """Codes (n,) int32 of light."""
    _places(light, n, out)
    for k in range(n):
        out[k] = table[np.uintp(out[k])]


@njit(cache=True, nogil=True, error_model="numpy")
def encode_tile(side, top, end, left, right, factors, table, scratch, picture):
    """A tile of a view's picture (see `fusing.Side`), times its gains, to codes of `table` (4097,) in `picture`, flat.

    `factors` are the gains over and over; `scratch` int32, both as long as three rows of the tile.
    """
    n, gain = right - left, side.gain
    alike = gain[0] == gain[1] and gain[0] == gain[2]
    for i in range(top, end):
        p = np.uintp(i * side.width + left)
        q = p + p + p
        if side.channels == 3:
            _numbers(side.rgb, q, factors, 3 * n, scratch)
            for k in range(3 * n):
                picture[q + np.uintp(k)] = table[np.uintp(scratch[k])]
        elif alike:
            _grey_numbers(side.rgb, p, gain[0], n, scratch)
            for k in range(n):
                code, to = table[np.uintp(scratch[k])], q + np.uintp(3 * k)
                picture[to] = picture[to + np.uintp(1)] = picture[to + np.uintp(2)] = code
        else:
            for c in range(3):
                _grey_numbers(side.rgb, p, gain[c], n, scratch)
                for k in range(n):
                    picture[q + np.uintp(3 * k + c)] = table[np.uintp(scratch[k])]


@by_rows(lambda out, *_: out.shape[0])
def spread(first, last, out, coarse, step):
    """`coarse` (h, w), 0..1, one value per square of `step` pixels and one more all round, to 0..255 (H, W), bilinear.
    """
    W = out.shape[1]
    line = np.empty(coarse.shape[1], np.float32)
    per, half = _ONE / _f(step), _HALF / _f(step) + _HALF
    for i in range(first, last):
        y = _f(i) * per + half
        a = int(y)
        fy = y - _f(a)
        for q in range(len(line)):
            line[q] = (coarse[a, q] + fy * (coarse[a + 1, q] - coarse[a, q])) * _f(255) + _HALF
        row = out[i]
        if step == 1:
            for j in range(W):
                row[j] = np.uint8(line[j + 1])
            continue
        for q in range(len(line) - 1):  # from the middle of square q - 1 to that of square q
            begin = math.ceil((q - _HALF) * step - _HALF)
            low, slope = line[q], line[q + 1] - line[q]
            if slope == _ZERO:
                row[max(begin, 0) : min(begin + step, W)] = np.uint8(low)
                continue
            for j in range(max(begin, 0), min(begin + step, W)):
                row[j] = np.uint8(low + slope * (_f(j) * per + half - _f(q)))


@by_rows(lambda light, *_: light.shape[0])
def encode(first, last, light, gain, table, out):
    """A picture times `gain` (3,) to the codes of `table` (4097,)."""
    for i in range(first, last):
        for j in range(light.shape[1]):
            for c in range(3):
                out[i, j, c] = tone(light[i, j, c] * gain[c], table)


@by_rows(lambda raw, *_: raw.shape[0])
def scale(first, last, raw, gain, out):
    """Codes (H, W, channels) to light: times `gain` (channels,) float32."""
    channels = raw.shape[2]
    for i in range(first, last):
        if channels == 1:
            for j in range(raw.shape[1]):
                out[i, j, 0] = _f(raw[i, j, 0]) * gain[0]
            continue
        for j in range(raw.shape[1]):
            for c in range(channels):
                out[i, j, c] = _f(raw[i, j, c]) * gain[c]


@by_rows(lambda raw, *_: raw.shape[0])
def full(first, last, raw, top, reach, out):
    """Pixels (H, W) where a sample (H, W, C), or one within `reach` pixels, is at `top` or above."""
    H, W, C = raw.shape
    for i in range(first, last):
        for j in range(W):
            out[i, j] = False
        for ii in range(max(i - reach, 0), min(i + reach + 1, H)):
            for j in range(W):
                for c in range(C):
                    if raw[ii, j, c] >= top:
                        for jj in range(max(j - reach, 0), min(j + reach + 1, W)):
                            out[i, jj] = True


@by_rows(lambda background, *_: background.shape[0])
def share_codes(first, last, background, scale_, near_full, out, saturated):
    """Background (H, W), codes, to 16 bits of full scale = 1 / `scale_`, and where it is `near_full`; NaN is dark."""
    for i in range(first, last):
        for j in range(background.shape[1]):
            a = background[i, j] * scale_
            a = min(max(a, _ZERO), _ONE) if a == a else _ZERO
            out[i, j] = np.uint16(a * _f(65535) + _HALF)
            saturated[i, j] = a >= near_full


@by_rows(lambda saturated, *_: saturated.shape[0])
def clearness(first, last, saturated, width, out):
    """How far (H, W) a pixel is from saturated ones and the picture's edge: 0 on them, smoothly to 255 at `width`."""
    H, W = saturated.shape
    reach = math.ceil(width)
    squared = np.empty(W, np.float32)
    side = np.empty(W, np.int32)
    for i in range(first, last):
        edge = min(i + 1, H - i)
        for j in range(W):
            d = _f(min(edge, min(j + 1, W - j)))
            squared[j] = d * d
        for ii in range(max(i - reach, 0), min(i + reach + 1, H)):
            some = False
            for j in range(W):
                some = some or saturated[ii, j]
            if not some:
                continue
            away = reach + 1
            for j in range(W):
                away = 0 if saturated[ii, j] else away + 1
                side[j] = away
            away = reach + 1
            for j in range(W - 1, -1, -1):
                away = 0 if saturated[ii, j] else away + 1
                d = _f(min(side[j], away))
                squared[j] = min(squared[j], d * d + _f((ii - i) * (ii - i)))
        for j in range(W):
            x = min(math.sqrt(squared[j]) / _f(max(width, 1)), _ONE)
            out[i, j] = np.uint8(x * x * (_f(3) - x - x) * _f(255) + _HALF)


@by_rows(lambda marks, *_: marks.shape[0])
def fill_gaps(first, last, marks, bit, near, tile, own, channels, gain, codes, light, picture):
    """Carry what blending did to a picture into its gaps: pixels where no other view sees the place, but around which
    others do, as single pixels without a point in a highlight. They get their own colour times the ratio of blended to
    own colour around them.

    `marks` (H, W) have `bit` where blended; only squares of `tile` pixels that are `near` are looked at. `own`
    (H * W * channels,) is the view's picture before `gain` (3,); `codes` (4097,) turn light into a picture's codes,
    `light` (256,) these into light.
    """
    H, W = marks.shape
    least = int(0.3 * (2 * GAP + 1) * (2 * GAP + 1))
    sums = np.empty(tile + 2 * GAP, np.uint8)
    for i in range(first, last):
        top, end = max(i - GAP, 0), min(i + GAP + 1, H)
        for q in range(near.shape[1]):
            if near[i // tile, q] == 0:
                continue
            left, right = q * tile, min((q + 1) * tile, W)
            blended = 0
            for j in range(left, right):
                blended += 1 if (marks[i, j] & bit) != 0 else 0
            if blended == right - left:
                continue
            sums[:] = 0
            for ii in range(top, end):
                a, b = max(left - GAP, 0), min(right + GAP, W)
                part, target = marks[ii, a:b], sums[a - left + GAP :]
                for k in range(b - a):
                    target[k] += 1 if (part[k] & bit) != 0 else 0
            for j in range(left, right):
                if (marks[i, j] & bit) != 0:
                    continue
                n = 0
                for k in range(2 * GAP + 1):
                    n += sums[j - left + k]
                if n <= least:
                    continue
                for c in range(3):
                    after = before = _ZERO
                    for ii in range(top, end):
                        for jj in range(max(j - GAP, 0), min(j + GAP + 1, W)):
                            if (marks[ii, jj] & bit) != 0:
                                after += light[picture[ii, jj, c]]
                                before += own[channels * (ii * W + jj) + c % channels] * gain[c]
                    ratio = min(max(after / max(before, _f(1e-6)), _ZERO), _f(4))
                    picture[i, j, c] = tone(own[channels * (i * W + j) + c % channels] * gain[c] * ratio, codes)


@by_rows(lambda rows, *_: rows.shape[0])
def count_points(first, last, rows, out):
    """How many points each row (3 W,) of `rows` holds."""
    for i in range(first, last):
        n = 0
        for j in range(rows.shape[1] // 3):
            n += rows[i, 3 * j] == rows[i, 3 * j]
        out[i] = n


@by_rows(lambda xyz, *_: xyz.shape[0])
def pack(first, last, xyz, sigma, normal, light, gain, table, start, xyz_out, normal_out, sigma_out, rgb_out):
    """Points of row i, with their colours times `gain` (3,), to start[i] and on of the outputs."""
    for i in range(first, last):
        at = start[i]
        for j in range(xyz.shape[1]):
            if xyz[i, j, 0] != xyz[i, j, 0]:
                continue
            for c in range(3):
                xyz_out[at, c] = xyz[i, j, c]
                normal_out[at, c] = normal[i, j, c]
                rgb_out[at, c] = tone(light[i, j, c] * gain[c], table)
            sigma_out[at] = sigma[i, j]
            at += 1
