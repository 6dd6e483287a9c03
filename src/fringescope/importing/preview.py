"""One picture of an import: for each set its first image, its phase and what the samples miss of a sinusoid."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fringescope.importing.order import Evidence


def draw(evidence: Evidence, path: Path, title: str) -> None:
    """Writes the preview as PNG. Raises OSError if it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    n = len(evidence.sets)
    fig = Figure(figsize=(10.5, 2.9 * n + 0.9), layout="constrained")
    FigureCanvasAgg(fig)
    axes = np.asarray(fig.subplots(n, 3, squeeze=False))
    for row, s in zip(axes, evidence.sets, strict=True):
        name = f"set {s.index}: {s.set.steps} steps, period {s.set.period:g}"
        row[0].imshow(s.first, cmap="gray")
        row[0].set_title(name + ", frame 0", fontsize=9)
        phase = np.where(s.lit, s.phase, np.nan)
        row[1].imshow(phase, cmap="twilight", vmin=-np.pi, vmax=np.pi, interpolation="nearest")
        row[1].set_title("phase, one turn of colour per fringe", fontsize=9)
        if s.residual_map is None:
            row[2].text(0.5, 0.5, "three steps fit in any order:\nno residual", ha="center", va="center", fontsize=9)
        else:
            shown = row[2].imshow(np.where(s.lit, 100 * s.residual_map, np.nan), cmap="magma", vmin=0, vmax=20)
            row[2].set_title(f"misfit, % of modulation (median {100 * s.residual:.1f})", fontsize=9)
            fig.colorbar(shown, ax=row[2], shrink=0.8)
        for ax in row:
            ax.set_axis_off()
    fig.suptitle(f"{title}: the order is {evidence.verdict}", fontsize=11)
    fig.savefig(path, dpi=90, format="png")
