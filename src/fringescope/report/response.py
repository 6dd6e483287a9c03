"""One picture of a response: the curve, the harmonics, what they do to phases, and the ripple before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from fringescope.report.figures import _FONT, INK, PALE, PAPER, _picture
from fringescope.types import U8, Response

BEFORE, AFTER = "#c4502a", "#2767b1"


@dataclass(frozen=True, eq=False)
class RippleCurve:
    """A ripple to draw: over the fringe's phase (n,) rad the error before and after correction (n,) in `unit`."""

    title: str
    phase: ArrayLike
    before: ArrayLike
    after: ArrayLike
    unit: str = "rad"


def response_picture(
    response: Response,
    curve: tuple[ArrayLike, ArrayLike],
    ripples: Sequence[RippleCurve] = (),
    title: str = "Response of camera and projector",
    path: Path | str | None = None,
) -> U8:
    """The response in pictures, (h, w, 3) uint8; `curve`: levels sent and light seen, shares 0..1."""
    rows = 1 + (len(ripples) + 2) // 3
    with mpl.rc_context(_FONT):
        fig = Figure(figsize=(12, 2.0 + 3.3 * rows), dpi=110, facecolor=PAPER)
        top = 1 - 1.5 / (2.0 + 3.3 * rows)
        grid = fig.add_gridspec(rows, 3, left=0.07, right=0.98, bottom=0.55 / (2.0 + 3.3 * rows), top=top,
                                wspace=0.36, hspace=0.5)  # fmt: skip
        fig.text(0.06, 1 - 0.35 / (2.0 + 3.3 * rows), title, fontsize=14, fontweight="bold", va="center")
        for i, line in enumerate(response.words[:3]):
            fig.text(0.06, 1 - (0.62 + 0.19 * i) / (2.0 + 3.3 * rows), line, fontsize=9.5, color=PALE, va="center")
        _curve(fig.add_subplot(grid[0, 0]), response, curve)
        _harmonics(fig.add_subplot(grid[0, 1]), response)
        _errors(fig.add_subplot(grid[0, 2]), response.error_rad, response.error_sigma)
        for i, r in enumerate(ripples):
            _ripple(fig.add_subplot(grid[1 + i // 3, i % 3]), r)
        return _picture(fig, path)


def _curve(ax: Axes, r: Response, curve: tuple[ArrayLike, ArrayLike]) -> None:
    x, y = (np.asarray(c, dtype=np.float64) for c in curve)
    ax.plot([0, 1], [0, 1], color=PALE, lw=0.8, ls=":")
    ax.plot(x, y, color=AFTER, lw=1.8)
    for level in r.levels:
        ax.axvline(level, color=PALE, lw=0.6)
    ax.set_xlabel("level sent")
    ax.set_ylabel("light seen")
    ax.set_title(f"gamma {r.gamma:.2f}", fontsize=11, loc="left")
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1.02)


def _harmonics(ax: Axes, r: Response) -> None:
    n = min(len(r.harmonics), 8)
    at = np.arange(2, 2 + n)
    h, s = np.asarray(r.harmonics[:n]), np.asarray(r.sigmas[:n])
    ax.bar(at, 100 * h, color=AFTER, width=0.6)
    ax.errorbar(at, 100 * h, yerr=200 * s, fmt="none", ecolor=INK, elinewidth=1, capsize=2)
    ax.axhline(0, color=INK, lw=0.8)
    ax.set_xticks(at)
    ax.set_xlabel("harmonic (bars: 2 sigma)")
    ax.set_ylabel("% of the fringe")


def _errors(ax: Axes, error: Mapping[int, float], sigma: Mapping[int, float]) -> None:
    steps = sorted(error)
    at = np.arange(len(steps))
    y = np.array([max(error[n], 1e-6) for n in steps])
    ax.bar(at, y, color=BEFORE, width=0.6)
    ax.errorbar(at, y, yerr=[2 * sigma.get(n, 0.0) for n in steps], fmt="none", ecolor=INK, elinewidth=1, capsize=2)
    ax.set_yscale("log")
    ax.set_ylim(1e-5, max(1.0, 2 * float(y.max())))
    ax.set_xticks(at, [f"N = {n}" for n in steps])
    ax.set_ylabel("greatest phase error (rad)")


def _ripple(ax: Axes, r: RippleCurve) -> None:
    x = np.asarray(r.phase, dtype=np.float64)
    for y, colour, name in ((r.before, BEFORE, "before"), (r.after, AFTER, "after")):
        v = np.array([np.nan if a is None else a for a in np.asarray(y, dtype=object)], dtype=np.float64)
        ax.plot(x, v, color=colour, lw=1.4, label=f"{name}: {np.nanmax(np.abs(v)):.3g} {r.unit}")
    ax.axhline(0, color=PALE, lw=0.6)
    ax.set_xlabel("phase of the fringe (rad)")
    ax.set_ylabel(r.unit)
    ax.set_title(r.title, fontsize=10, loc="left")
    ax.legend(frameon=False, fontsize=8, loc="upper right")
