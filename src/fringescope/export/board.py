"""Calibration boards to print at true scale: one vector page, PDF or SVG, with measuring bars along both directions."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope.errors import UsageError
from fringescope.types import F64, Board

PAPERS: dict[str, tuple[float, float]] = {
    "a5": (148.0, 210.0),
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}  #: width and height in mm, upright
EDGE_MM = 6.0  #: what printers leave white
SIDE_MM, FOOT_MM = 12.0, 15.0  #: left and right of the board, above and below it, for bars, text and a quiet border
SQUARES = (12, 9)  #: where nothing else is asked: the ends differ, and most corners lie inside
MARKER_SHARE = 0.75  #: of a square's width
DICTIONARIES = ("DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000")
SMALLEST_MM = 1.0  #: squares below this are no use on paper
POINT = 72 / 25.4  #: PDF units per mm


@dataclass(frozen=True)
class Text:
    """A line of text: where it begins (x, y) in mm from the page's top left, its size in mm, quarter turns."""

    x: float
    y: float
    size: float
    words: str
    upright: bool = True


@dataclass(frozen=True, eq=False)
class Page:
    """A drawn board. Rectangles are (n, 4): x, y, width, height in mm from the page's top left corner.

    `pattern` is drawn in grey `1 - ink`, `marks` in black; `origin` is the board's first inner corner on the page.
    """

    width: float
    height: float
    board: Board
    origin: tuple[float, float]
    ink: float
    pattern: F64
    marks: F64
    texts: tuple[Text, ...]
    bar_mm: tuple[float, float]  #: length of the measuring bars along x and y


def paper_size(name: str, landscape: bool | None = None) -> tuple[float, float]:
    """Width and height in mm of "A4", "letter", "300x200" ..; None = as named. Raises UsageError."""
    size = PAPERS.get(name.strip().lower())
    if size is None:
        w, _, h = name.strip().lower().removesuffix("mm").rstrip("_ ").partition("x")
        try:
            size = float(w), float(h)
        except ValueError:
            size = 0.0, 0.0
        if not (all(map(math.isfinite, size)) and min(size) >= 40 and max(size) <= 5000):
            known = ", ".join(n.upper() if n[0] == "a" else n for n in PAPERS)
            raise UsageError(f"--paper {name}; needed {known}, or WIDTHxHEIGHT in mm from 40 to 5000")
    if landscape is None:
        return size
    return (max(size), min(size)) if landscape else (min(size), max(size))


def room(paper: tuple[float, float]) -> tuple[float, float]:
    """Width and height in mm that a board may take on a page."""
    return paper[0] - 2 * (EDGE_MM + SIDE_MM), paper[1] - 2 * (EDGE_MM + FOOT_MM)


def design(
    paper: tuple[float, float],
    squares: tuple[int, int] | None = None,
    square_mm: float | None = None,
    pattern: str = "checkerboard",
    marker_mm: float | None = None,
    dictionary: str | None = None,
) -> Board:
    """The board for a page of `paper` (width, height) mm; what is not given is chosen as large as fits.

    Squares are then a whole number of half millimetres, and so many that half a turn changes the picture. Raises
    UsageError where it does not fit or cannot be a board.
    """
    if pattern not in ("checkerboard", "charuco"):
        raise UsageError(f"--pattern {pattern}; needed checkerboard or charuco")
    if pattern == "checkerboard" and (marker_mm is not None or dictionary is not None):
        raise UsageError("--marker-mm and --dictionary belong to --pattern charuco")
    if square_mm is not None and not (math.isfinite(square_mm) and square_mm >= SMALLEST_MM):
        raise UsageError(f"--square-mm {square_mm:g}; needed at least {SMALLEST_MM:g}")
    if squares is not None and (min(squares) < 3 or max(squares) > 200):
        raise UsageError(f"--squares {squares[0]}x{squares[1]}; needed 3 to 200 each way")
    w, h = room(paper)
    if squares is None and square_mm is not None:
        squares = _most(w, h, square_mm)
    squares = squares or (SQUARES if w >= h else SQUARES[::-1])
    fits = math.floor(2 * min(w / squares[0], h / squares[1]) + 1e-9) / 2
    size = f"{squares[0]} x {squares[1]} squares"
    if fits < SMALLEST_MM:
        raise UsageError(f"{size} on paper of {paper[0]:g} x {paper[1]:g} mm would be smaller than 1 mm; take fewer")
    if square_mm is not None and (squares[0] * square_mm > w + 1e-9 or squares[1] * square_mm > h + 1e-9):
        need = f"{squares[0] * square_mm:g} x {squares[1] * square_mm:g} mm"
        raise UsageError(f"{size} of {square_mm:g} mm need {need}; the page has {w:g} x {h:g} mm for them: "
                         f"squares up to {fits:g} mm fit, or take larger paper, or turn it")  # fmt: skip
    square_mm = square_mm or fits
    if pattern == "checkerboard":
        return Board(squares, square_mm)
    if marker_mm is None:
        marker_mm = math.floor(10 * MARKER_SHARE * square_mm + 1e-9) / 10
    if not 0 < marker_mm < square_mm:
        raise UsageError(f"--marker-mm {marker_mm:g}; needed less than the squares' {square_mm:g} mm")
    return Board(squares, square_mm, marker_mm, _dictionary(squares[0] * squares[1] // 2, dictionary))


def best_board(
    paper: str,
    landscape: bool | None = None,
    squares: tuple[int, int] | None = None,
    square_mm: float | None = None,
    pattern: str = "checkerboard",
    marker_mm: float | None = None,
    dictionary: str | None = None,
) -> tuple[Board, tuple[float, float]]:
    """`design` on a named paper: the board and the page's size.

    Where `landscape` is None, a WIDTHxHEIGHT stands as it is, and a named paper is turned so that the board is larger;
    upright only where that gains a tenth. Raises UsageError.
    """
    made: list[tuple[Board, tuple[float, float]]] = []
    first: UsageError | None = None
    ways: tuple[bool | None, ...] = (landscape,)
    if landscape is None and paper.strip().lower() in PAPERS:
        ways = (True, False)
    for turned in ways:
        size = paper_size(paper, turned)
        try:
            made.append((design(size, squares, square_mm, pattern, marker_mm, dictionary), size))
        except UsageError as e:
            first = first or e
    if not made:
        raise first or UsageError(f"--paper {paper}: nothing fits")
    return max(made, key=lambda m: m[0].square_mm**2 * m[0].squares[0] * m[0].squares[1] * (1 + 0.1 * (m is made[0])))


def _most(w: float, h: float, square_mm: float) -> tuple[int, int]:
    """As many squares as fit, one fewer along the longer side where half a turn would not change the picture."""
    c, r = int(w / square_mm + 1e-9), int(h / square_mm + 1e-9)
    if (c + r) % 2 == 0:
        c, r = (c - 1, r) if c >= r else (c, r - 1)
    if min(c, r) < 3:
        raise UsageError(f"--square-mm {square_mm:g}: fewer than 3 fit into {w:g} x {h:g} mm; take smaller ones")
    return min(c, 200 - (r % 2 == 0)), min(r, 200)


def _dictionary(markers: int, name: str | None) -> str:
    if name is None:
        name = next((d for d in DICTIONARIES if _words(d).bytesList.shape[0] >= markers), DICTIONARIES[-1])
    held = _words(name).bytesList.shape[0]
    if held < markers:
        raise UsageError(f"{name} has {held} markers; this board needs {markers}: name a larger one, or fewer squares")
    return name


def _words(name: str) -> Any:
    if not (name.startswith("DICT_") and hasattr(cv2.aruco, name)):
        raise UsageError(f"--dictionary {name}; needed one of OpenCV's names, such as DICT_5X5_100")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


# ------------------------------------------------------------------------------------------------------------- drawing


def rectangles(board: Board, invert: bool = False) -> F64:
    """The dark rectangles (n, 4) of a board: x, y, width, height in mm, from its outer top left corner.

    Markers stand row by row in the white squares, as OpenCV's `CharucoBoard` counts them.
    """
    s, (columns, rows) = board.square_mm, board.squares
    out = [(c * s, r * s, s, s) for r in range(rows) for c in range(columns) if (c + r) % 2 == int(invert)]
    if board.dictionary:
        words = _words(board.dictionary)
        n = words.markerSize + 2
        cell, gap = board.marker_mm / n, (s - board.marker_mm) / 2
        white = [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == 1]
        for k, (c, r) in enumerate(white):
            dark = np.asarray(cv2.aruco.generateImageMarker(words, k, n)) == 0
            out += [(c * s + gap + a * cell, r * s + gap + j * cell, (b - a) * cell, cell)
                    for j, row in enumerate(dark) for a, b in _runs(row)]  # fmt: skip
    return np.array(out, dtype=np.float64)


def _runs(row: Any) -> Iterable[tuple[int, int]]:
    """First and past-last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def draw(board: Board, paper: tuple[float, float], invert: bool = False, ink: float = 1.0) -> Page:
    """The board in the middle of its page, with measuring bars along x (below) and y (left) and a line of words.

    `ink` from 0.1 (pale grey) to 1 (black) is the darkness of the squares: grey squares still show fringes. `invert`
    swaps dark and light squares. Raises UsageError.
    """
    if not 0.1 <= ink <= 1:
        raise UsageError(f"--ink {ink:g}; needed 0.1 (pale grey) to 1 (black)")
    if invert and board.dictionary:
        raise UsageError("--invert goes with a chequerboard only: markers have to be dark on white")
    w, h = board.squares[0] * board.square_mm, board.squares[1] * board.square_mm
    x0, y0 = (paper[0] - w) / 2, (paper[1] - h) / 2
    along_x, along_y = (_bar_length(free) for free in room(paper))
    bar_x = x0 if x0 + along_x <= paper[0] - EDGE_MM - SIDE_MM else (paper[0] - along_x) / 2
    bar_y = y0 + h + FOOT_MM - 9.0
    tick_x = min(x0, bar_x) - 6.0
    tick_y = y0 if y0 + along_y <= paper[1] - EDGE_MM - FOOT_MM else (paper[1] - along_y) / 2
    marks = [*_bar(along_x, bar_x, bar_y, turned=False), *_bar(along_y, tick_x, tick_y, turned=True)]
    texts = [
        _line(bar_x, bar_y + 4.2, f"{along_x:g} mm: print at 100 %, then measure both bars", paper[0]),
        _line(bar_x, bar_y + 7.8, describe(board, ink), paper[0]),
        Text(tick_x - 3.0, tick_y + along_y, 2.3, f"{along_y:g} mm", upright=False),
    ]
    s, pattern = board.square_mm, rectangles(board, invert) + np.array([x0, y0, 0.0, 0.0])
    return Page(*paper, board, (x0 + s, y0 + s), ink, pattern, np.array(marks), tuple(texts), (along_x, along_y))


def _line(x: float, y: float, words: str, page_width: float) -> Text:
    """Words as large as 2.3 mm or as the page is wide; a letter takes 0.75 of a capital's height."""
    return Text(x, y, min(2.3, (page_width - x - EDGE_MM) / (0.75 * len(words))), words)


def describe(board: Board, ink: float = 1.0) -> str:
    """The board in one line."""
    c, r = board.squares
    grey = "" if ink == 1 else f", ink {100 * ink:.0f} %"
    if board.dictionary:
        markers = f"markers {board.marker_mm:g} mm {board.dictionary}"
        return f"charuco, {c} x {r} squares of {board.square_mm:g} mm, {markers}{grey}"
    return f"checkerboard, {c} x {r} squares of {board.square_mm:g} mm, {c - 1} x {r - 1} inner corners{grey}"


def _bar_length(space: float) -> float:
    """The longest of the plain lengths that fits."""
    return next((b for b in (200.0, 100.0, 50.0, 20.0) if b <= space), 10.0)


def _bar(length: float, x: float, y: float, turned: bool) -> list[tuple[float, float, float, float]]:
    """A measuring bar from (x, y): a thin line whose ticks begin exactly at 0 and at `length`; longer ones every 10."""
    thin = 0.15
    out = [(0.0, -thin / 2, length, thin)]
    for k in range(int(length) + 1):
        tall = 2.4 if k % 10 == 0 else 1.6 if k % 5 == 0 else 0.9
        out.append((k - thin / 2, -tall, thin, tall))
    return [(x + b, y + a, d, c) if turned else (x + a, y + b, c, d) for a, b, c, d in out]


# ------------------------------------------------------------------------------------------------------------- writing


def _number(x: float) -> str:
    return f"{x:.4f}".rstrip("0").rstrip(".")


def pdf_bytes(page: Page) -> bytes:
    """The page as a PDF that asks viewers not to scale it; the same page gives the same bytes."""
    k = POINT
    lines = [f"{_number(1 - page.ink)} g"]
    lines += _paths(page.pattern, page.height)
    lines += ["0 g", *_paths(page.marks, page.height)]
    for t in page.texts:
        turn = "1 0 0 1" if t.upright else "0 1 -1 0"
        words = t.words.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        at = f"{_number(t.x * k)} {_number((page.height - t.y) * k)}"
        lines.append(f"BT /F1 {_number(t.size * k / 0.72)} Tf {turn} {at} Tm ({words}) Tj ET")
    content = "\n".join(lines).encode("latin-1", "replace")
    box = f"[0 0 {_number(page.width * k)} {_number(page.height * k)}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None /PickTrayByPDFSize true >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        f"/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title (Calibration board) /Producer (fringescope) >>",
    ]
    out, places = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n", []
    for i, body in enumerate(objects, 1):
        places.append(len(out))
        out += f"{i} 0 obj\n".encode() + body + b"\nendobj\n"
    table = "".join(f"{p:010d} 00000 n \n" for p in places)
    count = len(objects) + 1
    tail = f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R /Info 6 0 R >>\n"
    return out + tail.encode() + f"startxref\n{len(out)}\n%%EOF\n".encode()


def _paths(rects: F64, height: float) -> list[str]:
    """Rectangles as one filled path, so that touching ones leave no hairline between them."""
    k = POINT
    out = [
        f"{_number(x * k)} {_number((height - y - h) * k)} {_number(w * k)} {_number(h * k)} re"
        for x, y, w, h in rects.tolist()
    ]
    return [*out, "f"]


def svg_text(page: Page) -> str:
    """The page as SVG, one user unit = 1 mm."""
    grey = round(255 * (1 - page.ink))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{page.width:g}mm" height="{page.height:g}mm" '
        f'viewBox="0 0 {page.width:g} {page.height:g}">',
        f'<rect width="{page.width:g}" height="{page.height:g}" fill="#fff"/>',
        f'<path fill="rgb({grey},{grey},{grey})" d="{_moves(page.pattern)}"/>',
        f'<path fill="#000" d="{_moves(page.marks)}"/>',
    ]
    for t in page.texts:
        turn = "" if t.upright else f' transform="rotate(-90 {t.x:g} {t.y:g})"'
        parts.append(
            f'<text x="{t.x:g}" y="{t.y:g}" font-family="Helvetica, Arial, sans-serif" '
            f'font-size="{t.size / 0.72:.3f}"{turn}>{html.escape(t.words)}</text>'
        )
    return "\n".join([*parts, "</svg>", ""])


def _moves(rects: F64) -> str:
    n = _number
    return "".join(f"M{n(x)} {n(y)}h{n(w)}v{n(h)}h{n(-w)}z" for x, y, w, h in rects.tolist())
