"""Is this rig still true? A verdict from one capture: a board's grid, a sphere's radius, the agreement of the views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fringescope import geometry
from fringescope.evaluate.agreement import Agreement
from fringescope.evaluate.board import BoardTrueness
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
    inter_view_median_um: float | None
    inter_view_systematic_um: float | None
    sphere_radius_error_um: float | None
    limit_um: float
    board: BoardTrueness | None
    agreement: Agreement

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)


def judge(
    rig: Rig,
    views: Agreement,
    s: VerifySettings,
    board: BoardTrueness | None = None,
    sphere_radius_error_um: float | None = None,
    doubts: tuple[str, ...] = (),
) -> Verdict:
    """The verdict, by limits that grow with the working distance: 20 um at 500 mm with the default 4e-5.

    `doubts` are things that could not be measured, in words. A verdict needs something that can fail: another view, a
    board or a sphere; else it is "unknown".
    """
    target = geometry.working_point(rig) if rig.volume is None else rig.volume.center
    far = max(float(((geometry.centre(c.pose) - target) ** 2).sum() ** 0.5) for c in rig.cameras)
    limit = 1e3 * s.limit * far
    bad: list[str] = []
    good: list[str] = []

    def weigh(value: float, most: float, what: str, unit: str, cure: str) -> None:
        text = f"{what} {value:.3g} {unit} (limit {most:.3g})"
        (bad if abs(value) > most else good).append(text + (f": {cure}" if abs(value) > most else ""))

    anew = "a device has moved or the rig is of another set-up; calibrate anew"
    if views.systematic_um is not None:
        weigh(views.systematic_um, limit, "the views' surfaces differ systematically by", "um", anew)
    if board is not None:
        most = s.limit_scale_ppm + 3 * board.scale_sigma_ppm
        weigh(board.scale_error_ppm, most, "the board is measured too large by", "ppm",
              "check the square size in board.json and the print's scale; else calibrate anew")  # fmt: skip
        weigh(board.rms_um, 2 * limit, "corners miss the board's grid by", "um rms", anew)
    if sphere_radius_error_um is not None:
        weigh(sphere_radius_error_um, limit, "the sphere's radius is off by", "um", anew)
    if not bad and not good:
        doubts = (*doubts, "nothing to compare: one view, no board, no sphere; capture the board, or use two cameras")
    verdict = "drifted" if bad else "ok" if good else "unknown"
    return Verdict(
        verdict,
        (*bad, *good, *doubts),
        None if board is None else board.rms_um,
        None if board is None else board.scale_error_ppm,
        views.median_um,
        views.systematic_um,
        sphere_radius_error_um,
        limit,
        board,
        views,
    )
