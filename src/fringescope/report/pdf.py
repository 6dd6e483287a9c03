"""Pages of A4 as PDF: headings, paragraphs, tables and pictures that flow from page to page, each page with its number.

Set with Matplotlib, without pyplot and without its global state; words stay words, so they can be searched and copied.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D

from fringescope.report.figures import INK, PALE
from fringescope.types import U8

WIDTH, HEIGHT = 210.0, 297.0  #: mm
LEFT, TOP, BOTTOM = 20.0, 20.0, 24.0  #: margins, mm
ROOM = WIDTH - 2 * LEFT
MM = 72 / 25.4
RULE = "#c9ced6"
PIXELS = 1500  #: a picture's longer side at most
_STYLE: Any = {"font.family": "DejaVu Sans", "pdf.fonttype": 42, "pdf.compression": 6, "text.parse_math": False}


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture (h, w, 3) with a line below it."""

    image: U8
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Part:
    """A heading and what stands under it, in this order: paragraphs, table, pictures (`across` of them in a row).

    `columns` are the widths of the table's columns, in shares; without a `head` it has none.
    """

    title: str
    lines: Sequence[str] = ()
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    columns: Sequence[float] = ()
    pictures: Sequence[Shown] = ()
    across: int = 1
    level: int = 1


@functools.lru_cache(8)
def _face(bold: bool) -> Any:
    return get_font(findfont(FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")))


@functools.lru_cache(20_000)
def _advance(letter: str, bold: bool) -> float:
    """Of one letter, in its size."""
    font = _face(bold)
    font.set_size(100, 72)
    if font.get_char_index(ord(letter)) == 0:
        return 0.6  # the empty box that stands for it
    return float(font.load_char(ord(letter)).linearHoriAdvance) / 65536 / 100


def width_mm(text: str, size: float, bold: bool = False) -> float:
    """How wide a line is set in `size` points."""
    return sum(_advance(c, bold) for c in text) * size / MM


def wrapped(text: str, size: float, room: float, bold: bool = False) -> list[str]:
    """Lines that fit into `room` mm; a word that is longer is broken."""
    out: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}" if line else word
            if width_mm(longer, size, bold) <= room:
                line = longer
                continue
            if line:
                out.append(line)
            line = word
            while width_mm(line, size, bold) > room and len(line) > 1:
                n = len(line) - 1
                while n > 1 and width_mm(line[:n], size, bold) > room:
                    n -= 1
                out.append(line[:n])
                line = line[n:]
        out.append(line)
    return out


def _clean(text: object) -> str:
    """Without letters that have no shape."""
    return "".join(c if c.isprintable() or c == "\n" else " " for c in str(text))


@dataclass(eq=False)
class _Pages:
    figures: list[Figure] = field(default_factory=list)
    y: float = 0.0  #: mm below the page's upper edge, where the next thing goes

    def new(self) -> None:
        self.figures.append(Figure(figsize=(WIDTH / 25.4, HEIGHT / 25.4)))
        self.y = TOP

    def need(self, height: float) -> None:
        if not self.figures or self.y + height > HEIGHT - BOTTOM:
            self.new()

    def put(self, x: float, y: float, text: str, size: float, bold: bool = False, colour: str = INK) -> None:
        weight = "bold" if bold else "normal"
        self.figures[-1].text(
            x / WIDTH, 1 - y / HEIGHT, text, fontsize=size, fontweight=weight, color=colour, va="baseline",
            parse_math=False,
        )  # fmt: skip

    def rule(self, y: float, colour: str = RULE, width: float = 0.5) -> None:
        at = 1 - y / HEIGHT
        line = Line2D([LEFT / WIDTH, 1 - LEFT / WIDTH], [at, at], color=colour, linewidth=width)
        self.figures[-1].add_artist(line)

    def text(self, text: str, size: float = 9.5, bold: bool = False, colour: str = INK, after: float = 1.5) -> None:
        step = 1.4 * size / MM
        for line in wrapped(_clean(text), size, ROOM, bold):
            self.need(step)
            self.y += step
            self.put(LEFT, self.y - 0.28 * step, line, size, bold, colour)
        self.y += after

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]], columns: Sequence[float]) -> None:
        n = max((len(r) for r in [head, *rows]), default=0)
        shares = list(columns) or [1.0] * n
        widths = [ROOM * s / sum(shares) for s in shares]
        size, gap = 8.5, 2.0
        step = 1.32 * size / MM

        def row(cells: Sequence[str], bold: bool, ruled: bool) -> None:
            lines = [wrapped(_clean(c), size, w - gap, bold) for c, w in zip(cells, widths, strict=False)]
            most = int((HEIGHT - BOTTOM - TOP - 12) / step)
            while lines:  # a row that is higher than a page goes on on the next one
                high = min(most, max((len(x) for x in lines), default=1))
                before = len(self.figures)
                self.need(high * step + 1.6)
                if head and len(self.figures) > before and not bold:
                    row(head, True, True)
                x = LEFT
                for cell, w in zip(lines, widths, strict=False):
                    for k, line in enumerate(cell[:high]):
                        self.put(x, self.y + (k + 0.78) * step, line, size, bold, PALE if bold else INK)
                    x += w
                self.y += high * step + 1.2
                lines = [x[high:] for x in lines] if any(len(x) > high for x in lines) else []
            if ruled:
                self.rule(self.y - 0.4)
            self.y += 0.4

        if head:
            self.need(3 * step)
            row(head, True, True)
        for r in rows:
            row(r, False, True)
        self.y += 2.5

    def pictures(self, shown: Sequence[Shown], across: int) -> None:
        gap = 5.0
        wide = (ROOM - gap * (across - 1)) / across
        for i in range(0, len(shown), across):
            some = shown[i : i + across]
            sizes = []
            for s in some:
                h, w = s.image.shape[:2]
                k = min(wide / w, 0.62 * (HEIGHT - TOP - BOTTOM) / h)
                sizes.append((w * k, h * k))
            captions = [wrapped(_clean(s.caption), 8, wide) if s.caption else [] for s in some]
            words = max(len(c) for c in captions) * 1.35 * 8 / MM
            high = max(h for _, h in sizes)
            self.need(high + words + 4)
            for k, (s, (w, h), lines) in enumerate(zip(some, sizes, captions, strict=True)):
                x = LEFT + k * (wide + gap)
                box = (x / WIDTH, 1 - (self.y + h) / HEIGHT, w / WIDTH, h / HEIGHT)
                ax = self.figures[-1].add_axes(box)
                ax.imshow(_fitted(s.image), interpolation="bilinear", aspect="auto")
                ax.set_axis_off()
                for n, line in enumerate(lines):
                    self.put(x, self.y + h + (n + 1.1) * 1.35 * 8 / MM, line, 8, colour=PALE)
            self.y += high + words + 4

    def part(self, p: Part) -> None:
        size = 14 if p.level == 0 else 12 if p.level == 1 else 10
        words = sum(len(wrapped(_clean(x), 9.5, ROOM)) * 4.8 + 1.5 for x in p.lines)
        self.need(min(12 + words + (20 if p.rows else 75 if p.pictures else 0), 180))
        if self.y > TOP:
            self.y += 4 if p.level < 2 else 2
        self.text(p.title, size, True, after=2.0)
        for line in p.lines:
            self.text(line)
        if p.rows:
            self.table(p.head, p.rows, p.columns)
        if p.pictures:
            self.pictures(p.pictures, max(1, p.across))


def _fitted(image: U8) -> U8:
    h, w = image.shape[:2]
    k = PIXELS / max(h, w)
    if k >= 1:
        return image
    small = cv2.resize(image, (max(1, round(w * k)), max(1, round(h * k))), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def write_pdf(path: Path | str, title: str, foot: str, parts: Sequence[Part]) -> int:
    """Writes the parts one below the other; returns how many pages there are. `foot` stands on each beside its number.

    The same parts give the same file.
    """
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # an empty box stands for it
        pages = _Pages()
        pages.new()
        for p in parts:
            pages.part(p)
        number = len(pages.figures)
        told = {"Title": _clean(title)[:200], "Creator": "Fringescope", "Producer": "Fringescope", "CreationDate": None}
        with PdfPages(path, metadata=told) as out:
            for i, fig in enumerate(pages.figures, 1):
                _foot(fig, foot, f"page {i} of {number}")
                out.savefig(fig)
    return number


def _foot(fig: Figure, foot: str, number: str) -> None:
    size, y = 7.5, HEIGHT - 13
    fig.add_artist(Line2D([LEFT / WIDTH, 1 - LEFT / WIDTH], [1 - (y - 4.5) / HEIGHT] * 2, color=RULE, linewidth=0.5))
    room = ROOM - width_mm(number, size) - 4
    for k, line in enumerate(wrapped(_clean(foot), size, room)[:2]):
        fig.text(LEFT / WIDTH, 1 - (y + 3.6 * k) / HEIGHT, line, fontsize=size, color=PALE, parse_math=False)
    fig.text(1 - LEFT / WIDTH, 1 - y / HEIGHT, number, fontsize=size, color=PALE, ha="right", parse_math=False)
