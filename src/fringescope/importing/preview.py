"""One picture of an import: for each set its first image, its phase and what the samples miss of a sinusoid."""

from __future__ import annotations

import cv2
import numpy as np

from fringescope.importing.evidence import SetEvidence
from fringescope.importing.order import Evidence
from fringescope.types import U8, AnyArray

TILE = 360  #: pixels, width of a picture
LINE = 22  #: pixels, height of a line of text
INK, PAPER, UNLIT = (30, 30, 30), 255, (205, 205, 205)
FULL_RESIDUAL = 0.2  #: share of the modulation that is drawn brightest


def draw(evidence: Evidence, title: str) -> U8:
    """The preview as an RGB picture: the verdict, a row per set, what speaks for and against the order."""
    rows = [_line(f"{title}: the order is {evidence.verdict}", 3 * TILE, bold=True)]
    rows += [_row(s) for s in evidence.sets]
    marks = {"+": evidence.proved, "-": evidence.against, "?": evidence.notes, "use": evidence.options}
    for mark, words in marks.items():
        for w in words:
            rows += [_line(text, 3 * TILE) for text in _broken(f"{mark}  {w}", 118)]
    return np.concatenate(rows, axis=0)


def _row(s: SetEvidence) -> U8:
    white = max(float(np.percentile(s.first, 99.5)), 1.0)
    grey = np.asarray(255 * np.clip(s.first / white, 0, 1), np.uint8)
    turn = np.asarray(255 * (s.phase + np.pi) / (2 * np.pi), np.uint8)
    name = f"set {s.index}: {s.set.steps} steps, period {s.set.period:g}, frame 0"
    tiles = [
        (name, np.repeat(grey[..., None], 3, axis=2)),
        ("phase: a turn of colour per fringe", _coloured(turn, cv2.COLORMAP_TWILIGHT, s)),
    ]
    if s.residual_map is None:
        tiles.append(("three steps fit in any order: no misfit", np.full((*grey.shape, 3), UNLIT, np.uint8)))
    else:
        share = np.asarray(255 * np.clip(s.residual_map / FULL_RESIDUAL, 0, 1), np.uint8)
        text = f"misfit {100 * s.residual:.1f} % (yellow: {100 * FULL_RESIDUAL:.0f} %)"
        tiles.append((text, _coloured(share, cv2.COLORMAP_INFERNO, s)))
    return np.concatenate([_tile(text, image) for text, image in tiles], axis=1)


def _coloured(x: U8, table: int, s: SetEvidence) -> U8:
    rgb: U8 = np.ascontiguousarray(cv2.applyColorMap(x, table)[..., ::-1])
    rgb[~s.lit] = UNLIT
    return rgb


def _tile(text: str, image: U8) -> U8:
    h, w = image.shape[:2]
    height = max(1, round((TILE - 8) * h / w))
    out = np.full((height + 8, TILE, 3), PAPER, np.uint8)
    out[4 : 4 + height, 4 : TILE - 4] = cv2.resize(image, (TILE - 8, height), interpolation=cv2.INTER_AREA)
    return np.concatenate([_line(text, TILE), out], axis=0)


def _line(text: str, width: int, bold: bool = False) -> U8:
    strip: AnyArray = np.full((LINE + 8 * bold, width, 3), PAPER, np.uint8)
    plain = text.encode("ascii", "replace").decode()
    size = 0.55 if bold else 0.42
    cv2.putText(strip, plain, (6, LINE - 6 + 4 * bold), cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
    return strip


def _broken(text: str, length: int) -> list[str]:
    lines = [""]
    for word in text.split(" "):
        if len(lines[-1]) + len(word) > length:
            lines.append("    ")
        lines[-1] += word + " "
    return lines
