"""Markers of a ChArUco board: read where the lattice says that they are, so that each tells the board's numbering."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

import cv2
import numpy as np

from fringescope.calibrate.corners import Corners
from fringescope.calibrate.numbering import QUARTER, Turn
from fringescope.errors import CalibrationError
from fringescope.types import F32, I32, U8, Board

OTHERS = (*(f"DICT_{n}X{n}_{m}" for n in (4, 5, 6, 7) for m in (50, 100, 250, 1000)), "DICT_ARUCO_ORIGINAL")


def dictionary(name: str) -> Any:
    """OpenCV's marker dictionary. Raises CalibrationError for an unknown name."""
    if not hasattr(cv2.aruco, name):
        raise CalibrationError(f"ArUco dictionary '{name}' is unknown; needed a name such as DICT_5X5_100")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def number(found: Corners, image: F32, board: Board, name: str) -> tuple[Turn, tuple[str, ...]]:
    """The numbering that the markers tell. Raises CalibrationError if there are none or others than board.json says."""
    words = dictionary(board.dictionary)
    where = _positions(board)
    seen = _read(found, image, board, words)
    votes = _votes(seen, where)
    if not votes or max(votes.values()) < 2:
        raise CalibrationError(_why_none(found, image, board, name))
    (best, count), *rest = votes.most_common(2)
    turn = _turn(best)
    notes = []
    against = sum(votes.values()) - count
    if count < 2 or (rest and rest[0][1] > 0.5 * count) or not _on_board(turn, found, board):
        raise CalibrationError(
            f"{name}: the markers contradict each other ({count} for one place of the board, {against} for others); "
            f"check squares and dictionary in board.json ({board.squares[0]} x {board.squares[1]}, {board.dictionary})"
        )
    if against:
        notes.append(f"{against} markers at places that are not theirs")
    doubled = [m for m, n in Counter(m for _, m, _ in seen).items() if n > 1]
    if doubled:
        notes.append(f"markers seen more than once: {', '.join(map(str, doubled[:5]))}")
    return turn, tuple(notes)


def _on_board(turn: Turn, found: Corners, board: Board) -> bool:
    at = turn.corner(found.index)
    return bool((at >= 0).all() and (at < np.array(board.inner_corners)).all())


def _positions(board: Board) -> list[dict[int, tuple[int, int]]]:
    """Square of each marker: as OpenCV counts them, and as it did before 4.6 (a white first square)."""
    out = []
    for odd in (1, 0):
        white = [(c, r) for r in range(board.squares[1]) for c in range(board.squares[0]) if (c + r) % 2 == odd]
        out.append(dict(enumerate(white)))
    return out


def _read(found: Corners, image: F32, board: Board, words: Any, mirrored: bool = False) -> list[tuple[I32, int, int]]:
    """(lattice square, marker, quarter turns of the lattice's picture of it) of every marker that can be read."""
    out = []
    low, high = found.index.min(0), found.index.max(0) + 1
    squares = np.array([(c, r) for r in range(low[1], high[1] + 1) for c in range(low[0], high[0] + 1)], dtype=np.int32)
    for square in squares[found.is_white(squares)]:
        bits = _bits(found, image, board, square, words.markerSize + 2)
        if bits is None:
            continue
        bits = bits[:, ::-1].copy() if mirrored else bits
        border = np.concatenate([bits[0], bits[-1], bits[1:-1, 0], bits[1:-1, -1]])
        if border.mean() > 0.2:
            continue
        ok, marker, quarter = words.identify(bits[1:-1, 1:-1].copy(), 0.25)
        if ok:
            out.append((square, int(marker), int(quarter)))
    return out


def _bits(found: Corners, image: F32, board: Board, square: I32, cells: int) -> U8 | None:
    """The marker's cells (cells, cells) as 0 or 1, sampled through the lattice's map; None outside the picture."""
    share = board.marker_mm / board.square_mm
    fine = 3
    t = ((np.arange(cells * fine) + 0.5) / (cells * fine) - 0.5) * share
    x, y = np.meshgrid(t, t)
    at = np.asarray(square, dtype=np.float64) - 0.5 + np.column_stack([x.ravel(), y.ravel()])
    p = found.smooth(at).astype(np.float32)
    if (p < 1).any() or (p > np.array(image.shape[::-1]) - 2).any():
        return None
    v = cv2.remap(image, p[:, :1], p[:, 1:], cv2.INTER_LINEAR).reshape(cells, fine, cells, fine).mean((1, 3))
    near = np.argsort(np.abs(found.index - square + 0.5).sum(1))[:4]
    level = float(np.mean(found.level[near]))
    return np.asarray((v > level), dtype=np.uint8)


def _votes(
    seen: list[tuple[I32, int, int]], where: list[dict[int, tuple[int, int]]]
) -> Counter[tuple[int, int, int]]:
    """Votes for (quarter turns, offset) of the lattice on the board; the counting of squares with more of them."""
    best: Counter[tuple[int, int, int]] = Counter()
    for places, sense in itertools.product(where, (1, -1)):
        votes: Counter[tuple[int, int, int]] = Counter()
        for square, marker, quarter in seen:
            if marker in places:
                q = (sense * quarter) % 4
                R = np.linalg.matrix_power(QUARTER, q)
                t = np.round(np.array(places[marker]) - 0.5 - (square - 0.5) @ R.T).astype(int)
                votes[q, int(t[0]), int(t[1])] += 1
        if votes and (not best or max(votes.values()) > max(best.values())):
            best = votes
    return best


def _turn(vote: tuple[int, int, int]) -> Turn:
    R = np.linalg.matrix_power(QUARTER, vote[0]).astype(np.int32)
    return Turn(R, np.array(vote[1:], dtype=np.int32))


def _why_none(found: Corners, image: F32, board: Board, name: str) -> str:
    if len(_read(found, image, board, dictionary(board.dictionary), mirrored=True)) >= 2:
        return f"{name}: the markers are mirrored: the camera's pictures are flipped; turn the flip off"
    counts = {n: len(_read(found, image, board, dictionary(n))) for n in OTHERS if hasattr(cv2.aruco, n)}
    other = max(counts, key=lambda n: counts[n])
    if counts[other] >= 3:
        return f"{name}: the markers are of {other}, board.json says {board.dictionary}; correct board.json"
    return (
        f"{name}: a chequerboard without readable markers of {board.dictionary}; is it a plain chequerboard, is "
        f"marker_mm ({board.marker_mm}) right, is the picture sharp enough?"
    )
