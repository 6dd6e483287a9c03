"""Which corner of the board a corner of the picture is: by the board's ends, its colours, and the projector."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fringescope.calibrate.corners import Corners
from fringescope.calibrate.lattice import apply, homography
from fringescope.errors import CalibrationError
from fringescope.types import F32, F64, I32, Board, Bool, Sighting

AGREE = 0.35  #: squares: cameras whose projector coordinates differ less than this see the same numbering
OPEN = "numberings fit"  #: in the words of a sighting whose numbering is not settled
QUARTER = np.array([[0, -1], [1, 0]])  #: a quarter turn of the lattice


@dataclass(frozen=True, eq=False)
class Turn:
    """Corner (i, j) of the lattice is corner `R (i, j) + t` of the board; squares turn about the corners' offsets."""

    R: I32
    t: I32

    @property
    def stays(self) -> bool:
        """Whether it changes nothing."""
        return not (self.R - np.eye(2)).any() and not self.t.any()

    def corner(self, index: I32) -> I32:
        """Board indices of corners (n, 2)."""
        return np.asarray(index @ self.R.T + self.t, dtype=np.int32)

    def square(self, index: I32) -> I32:
        """Board indices of squares (n, 2): a square's centre lies half a step before its corner."""
        return np.asarray(np.round((index - 0.5) @ self.R.T + self.t + 0.5), dtype=np.int32)


def turns(index: I32, inner: tuple[int, int]) -> list[Turn]:
    """Every quarter turn and offset that puts lattice corners (n, 2) on a board of `inner` corners."""
    out = []
    for quarter in range(4):
        R = np.linalg.matrix_power(QUARTER, quarter).astype(np.int32)
        turned = index @ R.T
        low, high = turned.min(0), turned.max(0)
        room = np.array(inner) - (high - low + 1)
        if (room < 0).any():
            continue
        for a, b in itertools.product(range(room[0] + 1), range(room[1] + 1)):
            out.append(Turn(R, np.asarray(np.array([a, b]) - low, dtype=np.int32)))
    return out


def number(found: Corners, image: F32, board: Board, name: str) -> tuple[Turn, tuple[str, ...]]:
    """The numbering of a plain board in one picture, and what remains open.

    By the lattice's extent, by the board's ends where they are in view, and by the colours: square (0, 0) is black
    where the colours tell the ends apart. Raises CalibrationError if the lattice is not that of the board.
    """
    _plain(found, image, name)
    possible = turns(found.index, board.inner_corners)
    ends = _ends(found, image)
    extent = np.ptp(found.index, axis=0) + 1
    if not possible:
        raise CalibrationError(_other_board(extent, board, name))
    fitting = [t for t in possible if _ends_fit(t, found, ends, board)]
    if not fitting:
        if ends.all():
            raise CalibrationError(_other_board(extent, board, name))
        fitting = possible
    black_first = [t for t in fitting if _black_first(t, found)]
    if board.ends_differ and not black_first:
        black_first = [t for t in possible if _black_first(t, found)]
        if not black_first:
            raise CalibrationError(
                f"{name}: the colours do not fit a board of {board.squares[0]} x {board.squares[1]} squares; "
                "check the number of squares in board.json"
            )
    chosen = black_first or fitting
    best = min(chosen, key=lambda t: _untidiness(t, found, board))
    if len(chosen) <= 2 or len(possible) <= 4:  # all of it is in view: turns that change nothing
        return best, ()
    of = f"{board.inner_corners[0]} x {board.inner_corners[1]}"
    return best, (f"{extent[0]} x {extent[1]} of {of} inner corners are in view: {len(chosen)} {OPEN}",)


def _plain(found: Corners, image: F32, name: str) -> None:
    """Raise CalibrationError if most white squares hold something dark."""
    low, high = found.index.min(0), found.index.max(0)
    squares = np.array([(c, r) for r in range(low[1] + 1, high[1] + 1) for c in range(low[0] + 1, high[0] + 1)])
    squares = squares[found.is_white(squares)]
    if not len(squares):
        return
    t = np.linspace(-0.3, 0.3, 9)
    grid = np.stack(np.meshgrid(t, t), -1).reshape(-1, 2)
    p = found.smooth((squares[:, None] - 0.5 + grid).reshape(-1, 2)).astype(np.float32)
    v = cv2.remap(image, p[:, :1], p[:, 1:], cv2.INTER_LINEAR).reshape(len(squares), -1)
    dark = (v < float(np.median(found.level))).mean(1)
    if float(np.median(dark)) > 0.15 and float((v.max(1) > np.median(found.level)).mean()) > 0.5:
        raise CalibrationError(
            f"{name}: most white squares hold something dark (markers?), board.json says a plain chequerboard; "
            "give pattern, marker_mm and dictionary of the ChArUco board"
        )


def _untidiness(t: Turn, found: Corners, board: Board) -> tuple[float, ...]:
    """Prefers the board upright in the picture, then in the middle of what is possible."""
    x = found.smooth.steps(np.array([[0.0, 0.0]]))
    along = np.stack([v[0] for v in x], 1) @ t.R.T[:, 0]  # picture direction of the board's x
    spare = np.abs(t.corner(found.index).mean(0) - (np.array(board.inner_corners) - 1) / 2).sum()
    return (float(-np.sign(np.round(along[0] + along[1], 6))), float(spare))


def _black_first(t: Turn, found: Corners) -> bool:
    """Whether this numbering makes square (0, 0) black: dark squares are those of even column plus row."""
    even = t.corner(np.zeros((1, 2), np.int32)).sum() % 2 == 0
    turned = round(float(np.trace(t.R))) == 0  # a quarter turn exchanges the signs of the offsets' product
    return bool((found.dark > 0) == (even != turned))


def _ends(found: Corners, image: F32) -> Bool:
    """Whether the board's end is in view beyond the lattice's (first column, last column, first row, last row)."""
    out = np.zeros(4, bool)
    low, high = found.index.min(0), found.index.max(0)
    light = float(np.median(found.level + found.half))
    half = float(np.median(found.half))
    for side in range(4):
        axis, last = side // 2, side % 2 == 1
        along = np.arange(low[1 - axis], high[1 - axis] + 2)  # squares along this side
        rings = []
        for n in (1, 2):
            at = np.empty((len(along), 2))
            at[:, axis] = high[axis] + n if last else low[axis] + 1 - n
            at[:, 1 - axis] = along
            rings.append(_brightness(image, found, at))
        sign = np.where((along + (high[axis] + 1 if last else low[axis])) % 2 == 0, -1.0, 1.0) * found.dark
        near, far = rings
        there, beyond = np.isfinite(near), np.isfinite(far)
        if there.sum() < 2 or beyond.sum() < max(2, 0.6 * len(along)):
            continue
        swing = float(np.mean((near * sign)[there]) - np.mean(near[there]) * np.mean(sign[there])) / half
        after = float(np.mean((far * -sign)[beyond]) - np.mean(far[beyond]) * np.mean(sign[beyond]) * -1) / half
        lit = float(np.median(far[beyond])) > 0.3 * light
        out[side] = swing > 0.6 and abs(after) < 0.3 and lit
    return out


def _brightness(image: F32, found: Corners, square: F64) -> F64:
    """Median brightness at the middle of lattice squares (n, 2); NaN outside the picture."""
    p = found.smooth(square - 0.5)
    a, b = found.smooth.steps(square - 0.5)
    r = max(int(0.15 * float(np.median(np.minimum(np.hypot(*a.T), np.hypot(*b.T))))), 1)
    out = np.full(len(p), np.nan)
    for n, (x, y) in enumerate(p):
        if not (r <= x < image.shape[1] - r - 1 and r <= y < image.shape[0] - r - 1):
            continue
        i, j = round(y), round(x)
        out[n] = np.median(image[i - r : i + r + 1, j - r : j + r + 1])
    return out


def _ends_fit(t: Turn, found: Corners, ends: Bool, board: Board) -> bool:
    """Whether the ends in view are ends of the board in this numbering."""
    low, high = found.index.min(0), found.index.max(0)
    for side in np.flatnonzero(ends):
        axis, last = side // 2, side % 2 == 1
        a, b = low.copy(), high.copy()
        (a if last else b)[axis] = (high if last else low)[axis]
        corners = t.corner(np.array([a, b]))
        fixed = int(np.argmax(np.abs(t.R[:, axis])))
        if corners[0, fixed] not in (0, board.inner_corners[fixed] - 1):
            return False
        outward = t.R[fixed, axis] * (1 if last else -1)
        if corners[0, fixed] != (board.inner_corners[fixed] - 1 if outward > 0 else 0):
            return False
    return True


def _other_board(extent: I32, board: Board, name: str) -> str:
    return (
        f"{name}: the picture shows {max(extent)} x {min(extent)} inner corners, board.json says "
        f"{board.inner_corners[0]} x {board.inner_corners[1]}; count them and correct board.json, or "
        "show more of the board if a part of it is hidden"
    )


# --------------------------------------------------------------------------------------------- cameras among themselves


def agree(sightings: Sequence[Sighting], board: Board) -> tuple[Sighting, ...]:
    """The sightings of one pose, renumbered so that all cameras call a corner the same.

    The projector's coordinate at the corners, from the samples' phases, of the surest sighting foretells that of the
    others; among all quarter turns and offsets that the board and its colours allow, each takes the one that fits. A
    sighting that fits in no way keeps its numbering and says so in its words, as does one without two directions.
    """
    if len(sightings) < 2:
        return tuple(sightings)
    seen = [_corner_uv(s) for s in sightings]
    order = sorted(range(len(sightings)), key=lambda n: (seen[n] is None, *_doubt(sightings[n])))
    first = sightings[order[0]]
    uv = seen[order[0]]
    if uv is None:
        return tuple(sightings)
    out = {order[0]: first}
    index = first.corner
    for n in order[1:]:
        other = seen[n]
        if other is None:
            word = f"the projector's phases do not tell whether the numbering is that of {first.camera}"
            out[n] = replace(sightings[n], words=(*sightings[n].words, word))
            continue
        out[n], fits = _renumber(sightings[n], other, index, uv, first.camera, board)
        if fits:
            index, uv = np.concatenate([index, out[n].corner]), np.concatenate([uv, other])
    if len(index) > len(first.corner):
        out[order[0]] = replace(first, words=tuple(w for w in first.words if OPEN not in w))
    return tuple(out[n] for n in range(len(sightings)))


def _doubt(s: Sighting) -> tuple[bool, int]:
    """Sorts the surest sighting first: numbering not in doubt, then many corners."""
    return any(OPEN in w for w in s.words), -len(s.corner)


def _corner_uv(s: Sighting) -> F64 | None:
    """Projector coordinates (n, 2) at the corners, to a fraction of a square; None where the samples do not tell."""
    g = s.directions
    if len(g) < 2 or np.linalg.matrix_rank(g, tol=1e-3 * float(np.abs(g).max())) < 2 or len(s.corner) < 4:
        return None
    ok = np.isfinite(s.sample_phase).all(1)
    px = s.sample_px[ok]
    if len(px) < 12 or np.linalg.matrix_rank(px - px.mean(0), tol=1.0) < 2:
        return None
    uv = s.sample_phase[ok] / (2 * np.pi) @ np.linalg.pinv(g).T
    return apply(homography(px, uv), s.corner_px)


def _renumber(
    s: Sighting, seen: F64, index: I32, uv: F64, first: str, board: Board
) -> tuple[Sighting, bool]:
    """A sighting in the numbering of corners `index` (n, 2) seen at `uv` (n, 2), and whether one fits."""
    H = homography(index.astype(np.float64), uv)
    middle = index.mean(0)
    p = apply(H, middle + np.array([(0, 0), (1, 0), (0, 1)]))
    unit = float(np.sqrt(abs(np.linalg.det(p[1:] - p[0])))) or 1.0
    ranked = []
    for t in turns(s.corner, board.inner_corners):
        if _colours_stay(t, board):
            off = np.hypot(*((apply(H, t.corner(s.corner).astype(np.float64)) - seen) / unit).T)
            ranked.append((float(np.median(off)), t))
    ranked.sort(key=lambda r: r[0])
    if not ranked or not ranked[0][0] < AGREE:
        off = ranked[0][0] if ranked else float("nan")
        word = f"numbering does not agree with {first} ({off:.1f} squares off): another pose or camera?"
        return replace(s, words=(*s.words, word)), False
    t = ranked[0][1]
    words = tuple(w for w in s.words if OPEN not in w)
    if t.stays and words == s.words:
        return s, True
    return replace(s, corner=t.corner(s.corner), square=t.square(s.square), words=words), True


def _colours_stay(t: Turn, board: Board) -> bool:
    """Whether black squares stay black; boards with markers do not turn at all."""
    if board.dictionary:
        return t.stays
    return not board.ends_differ or bool(t.square(np.zeros((1, 2), np.int32)).sum() % 2 == 0)
