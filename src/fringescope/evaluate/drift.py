"""Is this rig still true? A verdict from one capture: a board's grid, a sphere's radius, the agreement of the views."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fringescope import geometry
from fringescope.evaluate.agreement import Agreement
from fringescope.evaluate.board import BoardTrueness
from fringescope.evaluate.epipolar import EpipolarResidual
from fringescope.evaluate.statistics import plain
from fringescope.settings import VerifySettings
from fringescope.types import Rig


@dataclass(frozen=True)
class Verdict:
    """`verdict` is "ok", "drifted" or "unknown", `words` say why and what to do. Lengths in um, None = not measured."""

    verdict: str
    words: tuple[str, ...]
    board_rms_um: float | None
    scale_error_ppm: float | None
    inter_view_median_um: float | None  #: one view's share: see `Agreement.one_view_um`
    inter_view_systematic_um: float | None
    epipolar_systematic_um: float | None  #: the largest of the views
    sphere_radius_error_um: float | None
    limit_um: float
    promised_views_um: float | None  #: what the rig's own calibration predicts between the views
    board: BoardTrueness | None
    agreement: Agreement
    epipolar: tuple[EpipolarResidual, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)


def judge(
    rig: Rig,
    views: Agreement,
    s: VerifySettings,
    board: BoardTrueness | None = None,
    sphere_radius_error_um: float | None = None,
    epipolar: tuple[EpipolarResidual, ...] = (),
    blind: tuple[str, ...] = (),
    doubts: tuple[str, ...] = (),
) -> Verdict:
    """The verdict, by limits that grow with the working distance: 20 um at 500 mm with the default 4e-5.

    A rig that was worse than that from the first day is held to what its own calibration promised (`promised_um`).
    Views that differ by less than the limit, but by far more than a rig's calibration predicted, get a warning.
    `blind` are cameras without a point, `doubts` other things that could not be measured, in words. A verdict needs
    something that can fail: another view, a second fringe direction, a board or a sphere; else it is "unknown".
    """
    target = geometry.working_point(rig) if rig.volume is None else rig.volume.center
    far = max(float(((geometry.centre(c.pose) - target) ** 2).sum() ** 0.5) for c in rig.cameras)
    limit = max(1e3 * s.limit * far, promised_um(rig))
    moved: tuple[str, ...] = ()
    bad: list[str] = []
    good: list[str] = []

    def weigh(value: float, most: float, what: str, unit: str, cure: str) -> None:
        text = f"{what} {_figure(value)} {unit} (limit {_figure(most)})"
        (bad if abs(value) > most else good).append(text + (f": {cure}" if abs(value) > most else ""))

    anew = "a device has moved or the rig is of another set-up; calibrate anew"
    if views.systematic_um is not None:
        weigh(views.systematic_um, limit, "the views' surfaces differ systematically by", "um", anew)
        promised = promised_views_um(rig)
        usual = max(1e3 * s.warn * far, s.warn_promised * (promised or 0), promised_um(rig))
        if promised is not None and usual < views.systematic_um <= limit:
            moved = (f"warning: the views differ by {_figure(views.systematic_um)} um, the calibration promised "
                     f"{_figure(promised)}: something has moved; calibrate anew if that is too much",)  # fmt: skip
    for e in epipolar:
        weigh(e.systematic_um, limit, f"light that {e.camera} sees misses its place by", "um", anew)
    if board is not None:
        most = s.limit_scale_ppm + 3 * board.scale_sigma_ppm
        size = "small" if board.scale_error_ppm < 0 else "large"
        weigh(abs(board.scale_error_ppm), most, f"the board is measured too {size} by", "ppm",
              "check the square size in board.json and the print's scale; else calibrate anew")  # fmt: skip
        weigh(board.rms_um, 2 * limit, "corners miss the board's grid by", "um rms", anew)
    if sphere_radius_error_um is not None:
        size = "small" if sphere_radius_error_um < 0 else "large"
        weigh(abs(sphere_radius_error_um), limit, f"the sphere's radius is measured too {size} by", "um", anew)
    if not bad and not good:
        doubts = (*doubts, "nothing to compare: one view, no board, no sphere; capture the board, or use two cameras")
    if blind:
        doubts = (*doubts, f"no surface came of {', '.join(blind)}: too dark, or the rig is far off")
    verdict = "drifted" if bad else "ok" if good and not blind else "unknown"
    return Verdict(
        verdict,
        (*bad, *moved, *good, *doubts),
        None if board is None else board.rms_um,
        None if board is None else board.scale_error_ppm,
        views.one_view_um,
        views.systematic_um,
        max((e.systematic_um for e in epipolar), default=None),
        sphere_radius_error_um,
        limit,
        promised_views_um(rig),
        board,
        views,
        epipolar,
    )


def _figure(x: float) -> str:
    """Three digits, without an exponent."""
    return f"{x:.3g}" if abs(x) < 999.5 else f"{x:.0f}"


def promised_um(rig: Rig) -> float:
    """How well the calibration measured boards that it did not use (rms of the poses, um), if the rig's file tells."""
    carried = rig.extra.get("calibration")
    poses = carried.get("held_out") if isinstance(carried, dict) else None
    values = [p.get("corner_mm_rms") for p in poses if isinstance(p, dict)] if isinstance(poses, list) else []
    finite = [v for v in values if isinstance(v, (int, float)) and math.isfinite(v)]
    return 1e3 * math.sqrt(sum(v * v for v in finite) / len(finite)) if finite else 0.0


def promised_views_um(rig: Rig) -> float | None:
    """The largest error between two views that the calibration predicted (median over the volume, um); None untold."""
    carried = rig.extra.get("calibration")
    told = carried.get("predicted_views_um") if isinstance(carried, dict) else None
    values = list(told.values()) if isinstance(told, dict) else []
    finite = [v for v in values if isinstance(v, (int, float)) and math.isfinite(v)]
    return float(max(finite)) if finite else None
