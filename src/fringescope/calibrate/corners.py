"""Inner corners of the board in one picture: found on reduced pictures, fitted at full size, judged one by one."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope.calibrate.lattice import LatticeMap, complete, fit_map, grow
from fringescope.calibrate.picture import reduced
from fringescope.calibrate.saddles import find_saddles
from fringescope.errors import CalibrationError
from fringescope.kernels import corners as k
from fringescope.settings import BoardSettings
from fringescope.types import F32, F64, I32, AnyArray, Board, Bool

WIDTHS = (1200, 600, 2400, 300)  #: longer sides of the reduced pictures, in the order in which they are tried
X, Y, SIGMA, BLUR, LEVEL, HALF, MISFIT, EDGE1, EDGE2, PIXELS, DARK = range(11)  #: columns of a fit


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a picture in the lattice's own numbering: index (n, 2), place (n, 2), its standard deviation (n,).

    `level`, `half` (n,): mean brightness and half the contrast; `dark`: the sign of the offsets' product in the dark
    squares at even lattice points; `blur`: of the picture, pixels; `smooth`: the map from lattice to pixels.
    """

    index: I32
    px: F64
    sigma: F64
    level: F64
    half: F64
    dark: int
    blur: float
    smooth: LatticeMap
    words: tuple[str, ...]

    def is_white(self, square: I32) -> Bool:
        """Whether squares (n, 2) of the lattice, (c, r) ending at corner (c, r), are white."""
        return np.asarray(np.where(square.sum(1) % 2 == 0, 1, -1) * self.dark < 0)


def find(image: F32, weights: F64, saturated: Bool, board: Board, name: str, s: BoardSettings) -> Corners:
    """Fits every inner corner of the board that a picture (H, W) shows.

    `weights` (2, 2): of the sites of a mosaic; `saturated` (H, W). Raises CalibrationError if there is no board, if it
    is blurred, or if its lattice is larger than the board.
    """
    wanted = board.inner_corners[0] * board.inner_corners[1]
    best: Corners | None = None
    failure = ""
    for width in WIDTHS:
        if width != min(WIDTHS) and width > 2 * max(image.shape):
            continue
        started = _rough(image, width)
        if started is None:
            continue
        try:
            found = _refine(image, weights, saturated, started, board, name, s)
        except CalibrationError as e:
            failure = failure or str(e)
            continue
        if best is None or len(found.px) > len(best.px):
            best = found
        if sorted(np.ptp(best.index, axis=0) + 1) == sorted(board.inner_corners):
            break  # every place of the board was looked at
    least = max(4, min(9, wanted // 2))
    if best is None or len(best.px) < least:
        if failure:  # the first one: of the finest look at it
            raise CalibrationError(failure)
        seen = 0 if best is None else len(best.px)
        raise CalibrationError(
            f"{name}: no board found ({seen} inner corners that fit a lattice; the board has "
            f"{board.inner_corners[0]} x {board.inner_corners[1]}, at least {least} are needed); show more of it, "
            "in focus and evenly lit"
        )
    if best.blur > s.max_blur * _square(best):
        raise CalibrationError(
            f"{name}: the picture is blurred: edges {best.blur:.1f} px wide (one sigma) in squares of "
            f"{_square(best):.0f} px; needed at most {s.max_blur} squares: focus, stop down or move nearer to focus"
        )
    return best


def _square(c: Corners) -> float:
    a, b = c.smooth.steps(c.index.astype(np.float64))
    return float(np.median(np.minimum(np.hypot(*a.T), np.hypot(*b.T))))


def _rough(image: F32, width: int) -> tuple[I32, LatticeMap] | None:
    """Lattice indices (n, 2) found on a reduced picture, and their map to pixels of the whole one."""
    small, factor = reduced(image, width)
    saddles = find_saddles(small)
    member, index = grow(saddles)
    if len(member) < 4:
        return None
    member, index, _ = complete(saddles, member, index)
    if len(member) < 4 or np.ptp(index, axis=0).min() < 1:
        return None
    px = (saddles.place[member] + 0.5) / factor - 0.5
    return index, fit_map(index.astype(np.float64), px)[0]


def _all_points(index: I32, board: Board) -> I32:
    """Every lattice point that may be a corner: the lattice's extent, and one more row where the board is larger."""
    low, high = index.min(0), index.max(0)
    long, short = max(board.inner_corners), min(board.inner_corners)
    extent = high - low + 1
    for axis in (0, 1):
        if extent[axis] < (long if extent[1 - axis] <= short else short):
            low[axis] -= 1
            high[axis] += 1
    i, j = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="ij")
    return np.column_stack([i.ravel(), j.ravel()]).astype(np.int32)


def _refine(
    image: F32, weights: F64, saturated: Bool, rough: tuple[I32, LatticeMap], board: Board, name: str, s: BoardSettings
) -> Corners:
    index, smooth = _trim(rough[0], board), rough[1]
    blur = float(np.clip(0.05 * np.median(np.hypot(*smooth.steps(index.astype(np.float64))[0].T)), 0.4, 3.0))
    dark, why = 1, np.zeros(0, dtype=np.object_)
    out = np.zeros((0, 11))
    points = index
    for turn in range(3):
        points = _all_points(index, board) if turn else index
        at = points.astype(np.float64)
        start, (step1, step2) = smooth(at), smooth.steps(at)
        if turn == 0:
            dark = _dark_sign(image, at, smooth)
        out = np.empty((len(points), 11))
        signs = dark * np.where(points.sum(1) % 2 == 0, 1.0, -1.0)
        clear = _clear(board, s, step1, step2)
        window = s.corner_reach, clear, signs, s.corner_radius
        k.fit_corners(image, weights, start, step1, step2, _bend(at, smooth), blur, *window, out)
        why = _judge(out, start, (step1, step2), signs, saturated, s)
        good = why == ""
        if good.sum() < 4 or np.ptp(points[good], axis=0).min() < 1:
            raise CalibrationError(_unusable(why, name))
        if turn == 2:
            _, miss = fit_map(points[good].astype(np.float64), out[good, :2], out[good, SIGMA])
            scale = np.maximum(float(np.median(miss)), out[good, SIGMA])
            why[np.flatnonzero(good)[miss > s.corner_outlier * scale + 0.02]] = "off the board's lattice"
            good = why == ""
        index = _trim(points[good], board)
        good[good] &= (points[good][:, None] == index[None]).all(2).any(1)
        smooth, _ = fit_map(points[good].astype(np.float64), out[good, :2], out[good, SIGMA])
        blur = float(np.median(out[good, BLUR]))
    fit = out[good]
    inside = (points >= index.min(0)).all(1) & (points <= index.max(0)).all(1)
    counts = Counter(str(w) for w in why[inside] if w)
    words = tuple(f"{n} corner{'s' if n > 1 else ''} left out: {w}" for w, n in counts.items())
    return Corners(points[good], fit[:, :2], fit[:, SIGMA], fit[:, LEVEL], fit[:, HALF], dark, blur, smooth, words)


def _unusable(why: AnyArray, name: str) -> str:
    counts = Counter(str(w) for w in why if w)
    if counts["saturated"] > 0.5 * len(why):
        return f"{name}: the board is saturated ({counts['saturated']} of {len(why)} corners); expose it less"
    listed = "".join(f"; {n}: {w}" for w, n in counts.most_common(3))
    good = len(why) - sum(counts.values())
    found = f"{good} of {len(why)} likely corners are real{listed}"
    return f"{name}: no board found: {found}; show it in focus, evenly lit, hardly hidden"


def _trim(index: I32, board: Board) -> I32:
    """Without the sparse outer rows that make a lattice larger than the board: shadows' edges, things beside it."""
    long, short = max(board.inner_corners), min(board.inner_corners)
    while True:
        extent = np.ptp(index, axis=0) + 1
        if max(extent) <= long and min(extent) <= short:
            return index
        axis = int(np.argmax(extent)) if max(extent) > long else int(np.argmin(extent))
        sides = [(int((index[:, axis] == end).sum()), int(end)) for end in (index[:, axis].min(), index[:, axis].max())]
        count, end = min(sides)
        if count > 0.34 * extent[1 - axis]:
            return index
        index = index[index[:, axis] != end]


def _dark_sign(image: F32, at: F64, smooth: LatticeMap) -> int:
    """+1 if the squares whose offsets from even lattice points have one sign are the dark ones."""
    vote = 0.0
    for da, db in ((0.25, 0.25), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25)):
        p = smooth(at + np.array([da, db]))
        x = np.clip(np.round(p).astype(int), 0, np.array(image.shape[::-1]) - 1)
        parity = np.where(at.sum(1) % 2 == 0, 1.0, -1.0)
        vote -= float((image[x[:, 1], x[:, 0]] * parity).sum()) * np.sign(da * db)
    return 1 if vote > 0 else -1


def _clear(board: Board, s: BoardSettings, step1: F64, step2: F64) -> float:
    """Squares from an edge up to which a white square is free of its marker."""
    if not board.dictionary:
        return s.corner_reach
    square = float(np.median(np.minimum(np.hypot(*step1.T), np.hypot(*step2.T))))
    return max(0.5 * (1 - board.marker_mm / board.square_mm) - 1.5 / square, 0.03)


def _bend(at: F64, smooth: LatticeMap) -> F64:
    """Curvature (n, 2), 1/pixel, of the lattice's two lines through lattice points: what the lens bends."""
    out = np.empty((len(at), 2))
    for axis in (0, 1):
        d = np.eye(2)[axis] * 0.5
        second = (smooth(at + d) - 2 * smooth(at) + smooth(at - d)) / 0.25
        along = smooth.steps(at)[axis]
        length = np.hypot(*along.T)
        out[:, axis] = (second[:, 1] * along[:, 0] - second[:, 0] * along[:, 1]) / length**3
    return out


class _Verdicts:
    """Why each of n fits is not used: a word each, empty as long as it is good; the first word counts."""

    def __init__(self, n: int) -> None:
        self.why: AnyArray = np.full(n, "", dtype=np.object_)

    @property
    def good(self) -> Bool:
        return np.asarray(self.why == "", dtype=bool)

    def because(self, bad: Bool, word: str) -> None:
        self.why[bad & self.good] = word

    def usual(self, values: F64, otherwise: float) -> float:
        """Median over what is still good."""
        return float(np.median(values[self.good])) if self.good.any() else otherwise


def _judge(
    out: F64, start: F64, steps: tuple[F64, F64], signs: F64, saturated: Bool, s: BoardSettings
) -> AnyArray:
    """Why each fit (n, 11) is not used: words (n,), empty where it is good."""
    v = _Verdicts(len(out))
    square = np.minimum(*(np.hypot(*step.T) for step in steps))
    size = np.array(saturated.shape[::-1])
    with np.errstate(all="ignore"):
        margin = np.minimum(s.corner_reach * (np.abs(steps[0]) + np.abs(steps[1])), s.corner_radius) + 1
        outside = (start - margin < 0).any(1) | (start + margin > size - 1).any(1)
        finite = np.isfinite(out[:, X])
        v.because(~finite & outside, "too near the picture's border")
        v.because(~finite | (np.hypot(*(out[:, :2] - start).T) > 0.25 * square), "no corner there")
        v.because(out[:, DARK] != signs, "no corner there")
        turned = [_turned(out[:, edge], step) for edge, step in zip((EDGE1, EDGE2), steps, strict=True)]
        v.because(np.maximum(*turned) > np.radians(12), "edges do not run along the board")
        contrast = out[:, HALF] / np.maximum(out[:, LEVEL], 1e-9)
        v.because((contrast < 0.5 * v.usual(contrast, 1.0)) | (out[:, LEVEL] <= 0), "low contrast")
        misfit = out[:, MISFIT] / out[:, HALF]
        most = max(s.corner_misfit_factor * v.usual(misfit, 0.0), s.corner_misfit)
        v.because(misfit > most, "does not look like a corner (shadow, highlight, dirt)")
        v.because(out[:, BLUR] > 3 * v.usual(out[:, BLUR], 1.0) + 0.5, "blurred")
        v.because(out[:, SIGMA] > 0.1 * square, "too noisy")
    if saturated.any():
        side = int(np.clip(np.median(square) * 0.6, 3, 301)) | 1
        share = cv2.blur(saturated.astype(np.float32), (side, side))
        x = np.clip(np.round(start).astype(int), 0, size - 1)
        v.because(share[x[:, 1], x[:, 0]] > s.corner_saturated, "saturated")
    return v.why


def _turned(angle: F64, step: F64) -> F64:
    """Angle between fitted edges (n,) and the lattice's steps (n, 2), radians."""
    d = angle - np.arctan2(step[:, 1], step[:, 0])
    return np.asarray(np.abs((d + np.pi / 2) % np.pi - np.pi / 2))
