"""What a look at the specimen found, drawn on the scan's pictures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fringescope.report.sighting import LONGEST, grey_picture
from fringescope.types import U8, Picture, TileState, Watched

COLOURS = {
    TileState.STILL: (70, 170, 90),
    TileState.SHIFTED: (255, 196, 0),
    TileState.MOVED: (255, 60, 60),
    TileState.CHANGED: (225, 90, 255),
}
TIMES = 8.0  #: arrows are so many times as long as the shift in the picture


def watched_picture(found: Watched, pictures: Sequence[Picture]) -> U8:
    """Every camera's picture of the scan, side by side (h, w, 3) uint8, with the finest tiles of `found`.

    Green dots: still. Yellow and red arrows, eight times as long as the shift: beyond the limit of SUSPECT and of
    STALE; of a re-measurement, which has depths, squares. Purple squares: no longer what was scanned. Coarser tiles are
    drawn where no finer one moved.
    """
    by_name = {p.camera: p for p in pictures}
    parts = []
    for c in found.cameras:
        grey = grey_picture(by_name[c.camera].frame)
        k = LONGEST / 2 / max(grey.shape)
        size = (max(1, round(grey.shape[1] * k)), max(1, round(grey.shape[0] * k)))
        out = cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB)
        t = c.tiles
        finest = t.size <= (t.size.min() if len(t.size) else 0)
        for state, colour in COLOURS.items():
            those = (t.state == state) & (finest | (state >= TileState.SHIFTED))
            for n in np.flatnonzero(those):
                x, y = (t.centre[n] + 0.5) * k - 0.5
                at, half = (round(float(x)), round(float(y))), 0.5 * float(t.size[n]) * k
                if state is TileState.STILL:
                    cv2.circle(out, at, 1, colour, -1, cv2.LINE_AA)
                elif state is TileState.CHANGED or found.by == "fringes":
                    low, high = (round(x - half), round(y - half)), (round(x + half), round(y + half))
                    cv2.rectangle(out, low, high, colour, 1)
                else:
                    scale = TIMES * k * float(t.size[n] / max(t.width_mm[n], 1e-9))
                    end = (round(x + scale * t.shift_mm[n, 0]), round(y + scale * t.shift_mm[n, 1]))
                    cv2.arrowedLine(out, at, end, colour, 1, cv2.LINE_AA, tipLength=0.3)
        words = f"{c.camera}  {c.shift_mm:.2f} mm" + (f"  {c.note}" if c.note else "")
        cv2.putText(out, words, (8, size[1] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
        parts.append(out)
    height = max(p.shape[0] for p in parts)
    return np.concatenate([np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0))) for p in parts], axis=1)
