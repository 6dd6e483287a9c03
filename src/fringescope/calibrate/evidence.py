"""The evidence behind a calibration: figures, a verdict in plain words, and what to photograph next (III-B, V-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fringescope import geometry
from fringescope.calibrate import coverage, prediction, scatter
from fringescope.settings import EvidenceSettings
from fringescope.types import (
    F64,
    Calibration,
    Camera,
    Evidence,
    FieldTest,
    HeldOut,
    Layout,
    PoseFigures,
    Prediction,
)

GOOD, USABLE, BAD = "good", "usable", "do not use"
LISTED = 12  #: pairs of parameters that are listed at most


@dataclass
class _Words:
    """What speaks for and against, as it is found; `serious` and `fatal` count what lowers the verdict."""

    good: list[str] = field(default_factory=list)
    weak: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)
    serious: int = 0
    fatal: int = 0

    def against(self, text: str, level: int = 1) -> None:
        """`level` 0: worth knowing; 1: no longer good; 2: not to be used."""
        self.weak.append(text)
        self.serious += level == 1
        self.fatal += level == 2

    @property
    def verdict(self) -> str:
        return BAD if self.fatal else USABLE if self.serious else GOOD


def evidence(calibration: Calibration, held_out: Sequence[HeldOut], s: EvidenceSettings) -> Evidence:
    """Judges a calibration by its residuals, its coverage, its covariance and poses that it did not use.

    Nothing here can tell a wrong square size: that scales everything alike. `held_out` may be empty.
    """
    fields = tuple(scatter.field_test(v, s) for v in scatter.by_device(calibration))
    covered = coverage.coverage(calibration)
    inside = coverage.filled(calibration)
    predicted = prediction.predict(calibration)
    poses = pose_figures(calibration, held_out)
    footprint = {c.name: pixel_mm(calibration, c) for c in calibration.rig.cameras}
    figures = _figures(calibration, held_out, fields, predicted)
    w = _Words()
    _judge_residuals(w, fields, s)
    _judge_held_out(w, held_out, figures, float(np.median(list(footprint.values()))), s)
    _judge_prediction(w, predicted, footprint, s)
    _judge_poses(w, calibration, s)
    coverage.judge(w, calibration, covered, s)
    _judge_layout(w, calibration, s)
    for word in _said(calibration):
        w.against(word, 0)
    pairs = correlations(calibration, s.tight_correlation)
    return Evidence(
        w.verdict,
        tuple(w.good),
        tuple(w.weak),
        tuple(dict.fromkeys(w.next)),
        fields,
        covered,
        poses,
        pairs,
        predicted,
        figures | {"volume reached": inside.share},
        inside,
    )


def _said(calibration: Calibration) -> list[str]:
    """What the solve itself says of the pictures."""
    words = calibration.figures.get("words", ())
    return [words] if isinstance(words, str) else [str(w) for w in words]


# ------------------------------------------------------------------------------------------------------------- figures


def rms(a: F64) -> float:
    """Root of the mean square of the finite ones; NaN if there are none."""
    v = a[np.isfinite(a)]
    return float(np.sqrt((v**2).mean())) if v.size else float("nan")


def pixel_mm(calibration: Calibration, camera: Camera) -> float:
    """Width of a camera's pixel on the board, mm, in the middle of the measuring volume."""
    middle = geometry.transform(camera.pose, prediction.space(calibration).center)
    return float(abs(middle[2]) / np.sqrt(camera.lens.K[0, 0] * camera.lens.K[1, 1]))


def pose_figures(calibration: Calibration, held_out: Sequence[HeldOut]) -> tuple[PoseFigures, ...]:
    """One row per pose that was solved or left out, in order of their names."""
    left = {h.pose: h for h in held_out}
    pairs = scatter.paired(calibration)
    names = {s.pose for s in calibration.sightings} | set(calibration.boards) | {o.pose for o in calibration.left_out}
    out = []
    for pose in sorted(names):
        mine = [(s, r) for s, r in pairs if s.pose == pose]
        tilt, depth = float("nan"), float("nan")
        if pose in calibration.boards:
            points = [calibration.board.corner_mm(s.corner) for s, _ in mine if len(s.corner)]
            middle = np.concatenate(points).mean(axis=0) if points else np.zeros(3)
            tilt, depth = coverage.lean(calibration, pose, middle)
        out.append(PoseFigures(
            pose,
            {s.camera: rms(np.hypot(*r.corner.T)) for s, r in mine if len(r.corner)},
            {s.camera: rms(np.hypot(*scatter.along(s.directions, r.sample).T)) for s, r in mine if r.sample.size},
            sum(int(np.isfinite(r.corner).all(axis=1).sum()) for _, r in mine),
            sum(int(np.isfinite(r.sample).any(axis=1).sum()) for _, r in mine if r.sample.size),
            left.get(pose),
            tilt,
            depth,
            tuple(told(o.camera, o.points, o.why) for o in calibration.left_out if o.pose == pose),
        ))  # fmt: skip
    return tuple(out)


def told(camera: str | None, points: int | None, why: str) -> str:
    """What was left out, in words."""
    where = f"{camera}: " if camera else ""
    whole = "the whole sighting" if camera else "the whole pose"
    what = whole if points is None else f"{points} point{'s' if points != 1 else ''}"
    return f"{where}{what} left out: {why}"


def correlations(calibration: Calibration, least: float) -> tuple[tuple[str, str, float], ...]:
    """Pairs of free parameters whose |rho| exceeds `least`, tightest first."""
    free = [p for p in calibration.parameters if not p.fixed]
    C = calibration.covariance[: len(free), : len(free)]
    if len(C) != len(free) or not len(free):
        return ()
    sigma = np.sqrt(np.maximum(np.diag(C), 1e-300))
    rho = C / np.outer(sigma, sigma)
    at = [(i, j) for i, j in np.argwhere(np.triu(np.abs(rho), 1) > least).tolist()]
    at.sort(key=lambda ij: -abs(rho[ij[0], ij[1]]))
    names = [f"{p.device} {p.name}" for p in free]
    return tuple((names[i], names[j], float(rho[i, j])) for i, j in at[:LISTED])


def _figures(
    calibration: Calibration, held_out: Sequence[HeldOut], fields: Sequence[FieldTest], predicted: Prediction | None
) -> dict[str, float]:
    pairs = scatter.paired(calibration)
    used = sum(int(np.isfinite(r.corner).all(axis=1).sum()) for _, r in pairs)
    seen = sum(len(s.corner) for s in calibration.sightings)
    out = {
        "poses": float(len(calibration.boards)),
        "pictures": float(len(pairs)),
        "corners": float(used),
        "corners used": used / seen if seen else float("nan"),
    }
    for f in fields:
        out[f"{f.device} {f.kind} rms {f.unit}"] = f.rms
    corners = np.concatenate([np.zeros(0), *(np.hypot(*r.corner.T) for _, r in pairs if len(r.corner))])
    out["corners rms px"] = rms(corners)
    if held_out:
        mean = {n: rms(np.array([getattr(h, n) for h in held_out], dtype=np.float64)) for n in
                ("corner_mm_rms", "corner_px_rms", "sample_rms", "sample_um_rms")}  # fmt: skip
        out["held out corners mm"], out["held out corners px"] = mean["corner_mm_rms"], mean["corner_px_rms"]
        out["held out phase units"], out["held out phase um"] = mean["sample_rms"], mean["sample_um_rms"]
        off = np.array([1e6 * (h.scale - 1) for h in held_out])
        off = off[np.isfinite(off)]
        out["held out scale ppm"] = float(np.abs(off).max()) if off.size else float("nan")
    if predicted is not None:
        out["predicted median um"] = float(np.nanmedian([v[0] for v in predicted.per_camera.values()]))
        out["predicted largest um"] = float(np.nanmax([v[2] for v in predicted.per_camera.values()]))
    return out


# ------------------------------------------------------------------------------------------------------------ judgment


def _judge_residuals(w: _Words, fields: Sequence[FieldTest], s: EvidenceSettings) -> None:
    for f in fields:
        who, unit = f.device, "px" if f.unit == "px" else "projector units"
        what = "corners" if f.kind == "corners" else "phase"
        if f.kind == "corners" and f.rms > s.max_corner_px:
            level = 2 if f.rms > 4 * s.max_corner_px else 1
            w.against(f"{who}: {what} miss by {f.rms:.2g} px; {s.max_corner_px:g} px or less is usual", level)
            w.next.append(f"check that the board is flat, the pictures of {who} are sharp, and nothing moved")
        real = f.field_p <= max(s.max_p, 2.0 ** (1 - f.sightings)) and f.field_f_p <= s.max_p
        if real and f.field_rms > s.max_field * f.rms:
            w.against(f"{who}: {what} residuals repeat over the image ({f.field_rms:.2g} of {f.rms:.2g} {unit}): "
                      "the lens model does not fit")  # fmt: skip
        elif f.asymmetry_p <= s.max_p and f.asymmetry > 0.02:
            w.against(f"{who}: {what} residuals are not centrosymmetric (asymmetry {100 * f.asymmetry:.1f} %, "
                      f"p = {f.asymmetry_p:.2g})", 0)  # fmt: skip
    corners = [f for f in fields if f.kind == "corners"]
    phase = [f for f in fields if f.kind == "phase"]
    if corners and max(f.rms for f in corners) <= s.max_corner_px:
        ends = min(f.rms for f in corners), max(f.rms for f in corners)
        spread = " to ".join(dict.fromkeys(f"{v:.2g}" for v in ends))
        more = f", the projected phase to {phase[0].rms:.2g} units of the projector's plane" if phase else ""
        w.good.append(f"Corners fit to {spread} px{more}.")
    if fields and not any("repeat over" in t or "centrosymmetric" in t for t in w.weak):
        few = min(f.sightings for f in fields)
        told = f", as far as {few} poses can tell" if 2.0 ** (1 - few) > s.max_p else ""
        w.good.append("Residuals scatter evenly about zero: no pattern over any image that repeats from pose to pose"
                      f"{told}.")  # fmt: skip
    if not phase:
        w.against("no projected phase was used: nothing ties the projector", 2)


def _judge_held_out(
    w: _Words, held_out: Sequence[HeldOut], figures: dict[str, float], footprint: float, s: EvidenceSettings
) -> None:
    if not held_out:
        w.against("no pose was held out: nothing tells how well a board that was not used fits", 0)
        return
    mm, px, scale = (figures[f"held out {n}"] for n in ("corners mm", "corners px", "scale ppm"))
    if mm > s.max_held_out_px * footprint:
        level = 2 if mm > 3 * s.max_held_out_px * footprint else 1
        w.against(f"boards that were not used are measured {1000 * mm:.0f} um off ({mm / footprint:.1f} pixels)", level)
    elif np.isfinite(mm):
        w.good.append(f"Boards that were not used are measured to {_um(1000 * mm)}"
                      f"{f', their size to {scale:.0f} ppm' if scale <= s.max_scale_ppm else ''}.")  # fmt: skip
    if px > s.max_held_out * figures["corners rms px"]:
        w.against(f"boards that were not used fit {px / figures['corners rms px']:.1f} times worse than those used")
        w.next.append("take more poses: the solve leans on single ones")
    if scale > s.max_scale_ppm:
        off = max(held_out, key=lambda h: np.nan_to_num(abs(h.scale - 1)))
        w.against(f"the board of {off.pose}, when it is not used, comes out {scale / 1e4:.2f} % off in size")
    worst = max(held_out, key=lambda h: np.nan_to_num(h.corner_px_rms))
    if len(held_out) > 2 and worst.corner_px_rms > 3 * np.nanmedian([h.corner_px_rms for h in held_out]):
        w.against(f"{worst.pose} fits {worst.corner_px_rms:.2g} px when it is left out, the others far better", 0)
        w.next.append(f"look at {worst.pose}: take it again, or leave it out")


def _um(x: float) -> str:
    return f"{x:.0f} um" if x >= 10 else f"{x:.2g} um"


def _judge_prediction(
    w: _Words, predicted: Prediction | None, footprint: dict[str, float], s: EvidenceSettings
) -> None:
    if predicted is None:
        w.against("no covariance: the error of points cannot be predicted")
        return
    weak: dict[str, float] = {}
    for camera, (middle, _, _) in predicted.per_camera.items():
        share = middle / (1000 * footprint[camera])
        if not np.isfinite(middle):
            w.against(f"{camera} and the projector share no view of the measuring volume")
        elif share > s.max_predicted_px:
            weak[camera] = share
    if weak:
        worst = max(weak.values())
        figures = ", ".join(f"{c} {_um(predicted.per_camera[c][0])}" for c in weak)
        w.against(f"the calibration alone makes points uncertain: {figures} ({worst:.2g} of a pixel on the board)",
                  2 if worst > 10 * s.max_predicted_px else 1)  # fmt: skip
    finite = [v for v in predicted.per_camera.values() if np.isfinite(v[0])]
    if weak:
        w.next.append("take more poses, tilted by 20 to 30 degrees to all sides, near and far in the measuring volume")
    elif finite:
        w.good.append(f"The calibration alone makes points uncertain by {_um(max(v[0] for v in finite))} (median), "
                      f"at most {_um(max(v[2] for v in finite))}.")  # fmt: skip


def _judge_layout(w: _Words, calibration: Calibration, s: EvidenceSettings) -> None:
    """The units of a diamond device's plane are square: focal lengths that differ tell another layout."""
    p = calibration.rig.projector
    ratio = float(p.lens.K[1, 1] / p.lens.K[0, 0])
    if p.layout is Layout.DIAMOND and abs(ratio - 1) > s.max_anisotropy:
        w.against(f"projector: fy is {ratio:.2f} fx, but the units of a diamond layout are square: is its layout grid?")
        w.next.append("check the projector's layout in capture.json: with a wrong one guidelines come out elsewhere")


def _judge_poses(w: _Words, calibration: Calibration, s: EvidenceSettings) -> None:
    n = len(calibration.boards)
    if n < s.good_poses:
        w.against(f"{n} poses; eight to ten make a calibration that can be trusted", 1 if n < s.good_poses - 2 else 0)
        w.next.append(f"take {s.good_poses - n} more pose{'s' if s.good_poses - n > 1 else ''}")
    whole = sorted({o.pose for o in calibration.left_out if o.camera is None and o.points is None})
    if whole:
        w.against(f"left out altogether: {', '.join(whole)}", 0)
    part = sorted({f"{o.pose}/{o.camera}" for o in calibration.left_out if o.camera and o.points is None})
    if part:
        w.against(f"left out: {', '.join(part)}", 0)
