"""The calibration report: one page that opens in any browser without network, on a phone too, and prints well.

Its first screen says in plain words what the calibration is worth and what to photograph next; below stand residuals,
coverage, predicted uncertainty, poses, parameters and pictures. A failed calibration gets a page as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np

from fringescope import __version__, geometry
from fringescope.report import svg
from fringescope.report.page import capital, escaped, failed, figure, micro, pictures
from fringescope.report.svg import number
from fringescope.types import (
    U8,
    Calibration,
    Camera,
    Coverage,
    Evidence,
    FieldTest,
    Filled,
    Parameter,
    PoseFigures,
    Prediction,
    Projector,
    Sighting,
)

FAR = 2.0  #: a figure of a pose stands out if it exceeds the median by this factor
SAYINGS = {
    "good": ("Good", "good", "This rig can be trusted within the figures below."),
    "usable": ("Usable, with care", "usable", "It measures, but something is weak: read below before you rely on it."),
    "do not use": ("Do not use", "bad", "Measurements with this rig would be wrong or worth little. Calibrate again."),
}
LIMITS = "Squares of another size than told scale everything alike and show nowhere on this page: measure the print."


def calibration_page(
    calibration: Calibration | None,
    evidence: Evidence | None,
    sightings: Sequence[Sighting],
    failure: str | None = None,
    overlays: Mapping[str, U8] | None = None,
    title: str = "Calibration report",
    blind: Mapping[str, str] | None = None,
) -> str:
    """HTML of the report. `sightings` are all that were found, `overlays` their pictures by `Sighting.name`.

    `blind` says, by the same names, why the other pictures show no board.

    With `failure`, what went wrong in one line; `calibration` and `evidence` may then be missing. Nothing is fetched
    and no script runs. Pictures are shrunk until the page stays below six megabytes.
    """
    parts = [f"<h1>{escaped(title)}</h1>"]
    if failure is not None or calibration is None or evidence is None:
        parts += failed(failure or "no calibration came of it", sightings, overlays or {}, blind or {})
    else:
        parts += [_verdict(evidence), _words(evidence), _rig(calibration), _devices(calibration, evidence)]
        parts += [_filled(evidence.filled), _predicted(evidence.prediction), _poses(evidence.poses)]
        parts.append(_parameters(calibration, evidence))
    parts.append(pictures(calibration, sightings, overlays or {}, blind or {}))
    parts.append(f"<footer>{LIMITS} Made by Fringescope {escaped(__version__)}.</footer>")
    page = (resources.files("fringescope.report") / "calibration.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", escaped(title)).replace("@BODY@", "\n".join(p for p in parts if p))


# --------------------------------------------------------------------------------------------------------- first screen


def _verdict(e: Evidence) -> str:
    word, kind, say = SAYINGS[e.verdict]
    f = e.figures
    phase = next((t for t in e.fields if t.kind == "phase"), None)
    tiles = [
        (f"{f['poses']:.0f} · {f['pictures']:.0f}", "poses · pictures"),
        (f"{number(f['corners rms px'])} px", "corners miss by (rms)"),
        (f"{number(phase.rms)} units" if phase else "–", "of its plane: the projector’s phase"),
    ]
    if "held out corners mm" in f:
        tiles.append((f"{number(1000 * f['held out corners mm'])} µm", "boards that were not used miss by"))
        if math.isfinite(f["held out scale ppm"]):
            tiles.append((f"{number(f['held out scale ppm'])} ppm", "their size is off by, at most"))
    if "predicted median um" in f:
        tiles.append((f"{number(f['predicted median um'])} µm", "uncertainty from calibration alone"))
    shown = "".join(f'<div class="tile"><b>{escaped(b)}</b><span>{escaped(s)}</span></div>' for b, s in tiles)
    return (
        f'<section class="card verdict {kind}"><div class="word">{word}</div><p class="say">{say}</p>'
        f'<div class="tiles">{shown}</div></section>'
    )


def _words(e: Evidence) -> str:
    def block(kind: str, head: str, lines: Sequence[str], empty: str) -> str:
        items = "".join(f"<li>{micro(capital(w))}</li>" for w in lines)
        inside = f"<ul>{items}</ul>" if items else f"<p class=none>{empty}</p>"
        return f'<section class="card {kind}"><h3>{head}</h3>{inside}</section>'

    return '<div class="three">' + "".join((
        block("plus", "What is good", e.good, "Nothing that could be said for certain."),
        block("minus", "What is weak", e.weak, "Nothing was found."),
        block("next", "What to photograph next", e.next, "Nothing is needed."),
    )) + "</div>"  # fmt: skip


# -------------------------------------------------------------------------------------------------------------- the rig


def _rig(c: Calibration) -> str:
    """Devices, boards and measuring volume, seen at a slant from the side."""
    lines: list[tuple[np.ndarray, str, float, bool]] = []
    labels: list[tuple[np.ndarray, str, str]] = []
    i, j = c.board.squares
    s = c.board.square_mm
    edge = np.array([[-1.0, -1, 0], [i - 1, -1, 0], [i - 1, j - 1, 0], [-1, j - 1, 0]]) * s
    boards = [geometry.transform(T, edge) for T in c.boards.values()]
    middle = np.mean(np.concatenate(boards), axis=0) if boards else np.zeros(3)
    lines += [(b, svg.BLUE, 1.0, True) for b in boards]
    for d in c.rig.devices:
        name, colour = (d.name, svg.INK) if isinstance(d, Camera) else ("projector", svg.ORANGE)
        o = geometry.centre(d.pose)
        w, h = d.lens.width, d.lens.height
        rays = geometry.unproject(d.lens, np.array([[0.0, 0], [w, 0], [w, h], [0, h]]))
        rays = np.where(np.isfinite(rays), rays, 0.0)
        away = float(np.linalg.norm(middle - o))
        frame = geometry.transform(geometry.inverse(d.pose), np.column_stack([rays, np.ones(4)]) * 0.16 * away)
        lines += [(np.stack([o, p]), colour, 1.1, False) for p in frame]
        lines += [(frame, colour, 1.4, True), (np.stack([o, middle]), colour, 0.5, False)]
        labels.append((o, name, colour))
    p = c.rig.projector.pose.R
    across = _unit(0.88 * p[0] - 0.42 * p[1])
    up = _unit(-p[2] - 0.45 * (0.42 * p[0] + 0.88 * p[1]))
    up = _unit(up - (up @ across) * across)
    home = geometry.centre(c.rig.projector.pose)
    far = {k.name: float(np.linalg.norm(geometry.centre(k.pose) - home)) for k in c.rig.cameras}
    base = ", ".join(f"{escaped(name)} {d:.1f} mm" for name, d in far.items())
    return (
        '<h2>The instrument as it was found</h2><p class="lead">Distance of the lenses from the projector’s: '
        f'{base}. Compare it with a ruler. Blue: the boards.</p><section class="card">'
        f'<div style="max-width:760px;margin:auto">{svg.drawing(lines, labels, across, up)}</div></section>'
    )


def _unit(v: np.ndarray) -> np.ndarray:
    return v / max(float(np.linalg.norm(v)), 1e-12)


# -------------------------------------------------------------------------------------------------------------- devices


def _devices(c: Calibration, e: Evidence) -> str:
    tests = {f.device: f for f in e.fields}
    parts = [
        '<h2>Residuals and coverage</h2><p class="lead">What the measurements miss the solution by. A calibration is '
        "right only if this is small and centrosymmetric: a cloud about zero that looks the same upside down, without "
        "a pattern over the picture that repeats from pose to pose.</p>"
    ]
    devices: list[tuple[str, Camera | Projector]] = [("projector", c.rig.projector)]
    devices += [(k.name, k) for k in c.rig.cameras]
    for cover in e.coverage:
        device = next((d for n, d in devices if n == cover.device), None)
        if device is not None:
            parts.append(_device(c, cover, tests.get(cover.device), device))
    return "".join(parts)


def _device(c: Calibration, cover: Coverage, f: FieldTest | None, device: Camera | Projector) -> str:
    colour = svg.ORANGE if cover.device == "projector" else svg.BLUE
    size = device.lens.width, device.lens.height
    counted = "samples" if cover.device == "projector" else "corners"
    reached = f"<b>Coverage</b>: {counted} reached {100 * cover.share:.0f} % of the picture"
    tilt = "<b>Tilt</b>: where each board faces, seen from here"
    plots = [
        figure("wide", reached, svg.cells(cover.cells, size)),
        figure("mid", tilt, svg.compass(cover.tilts, _towards(c, cover.device))),
    ]
    if f is not None:
        unit = _unit_name(f)
        drawn = "<b>Residuals</b>, means of patches" if f.kind == "phase" else "<b>Residuals</b> of corners"
        repeats, alike = "<b>What repeats</b>, on the same scale", "<b>Distribution</b>, histograms with mirror image"
        plots = [
            figure("wide", drawn, svg.arrows(f.arrows, size, unit, colour)),
            figure("mid", repeats, svg.arrows(f.smooth, size, unit, svg.GREEN, svg.usual(f.arrows))),
            figure("slim", alike, svg.scatter(f.cloud, unit, colour, f.rms)),
            *plots,
        ]
    plots.append(f'<div class="slim figures">{_statistics(f)}</div>')
    name = "Projector" if cover.device == "projector" else escaped(cover.device)
    away = f"boards from {number(cover.near_mm, 4)} to {number(cover.far_mm, 4)} mm away"
    return (
        f'<section class="card"><h3>{name} <span class="none">{away}</span></h3>'
        f'<div class="plots">{"".join(plots)}</div></section>'
    )


def _unit_name(f: FieldTest) -> str:
    return "px" if f.unit == "px" else "units"


def _towards(c: Calibration, device: str) -> list[tuple[str, float]]:
    """Where the other cameras stand, on the projector's compass."""
    if device != "projector":
        return []
    p = c.rig.projector.pose
    out = []
    for k in c.rig.cameras:
        x, y, _ = geometry.transform(p, geometry.centre(k.pose))
        out.append((k.name, math.atan2(y, x)))
    return out


def _statistics(f: FieldTest | None) -> str:
    if f is None:
        return '<p class="none">No residuals: nothing of this device was measured.</p>'
    unit = _unit_name(f)
    rows = [
        ("samples · poses" if f.kind == "phase" else "corners · poses", f"{f.vectors} · {f.sightings}"),
        ("rms", f"<b>{number(f.rms)} {unit}</b>"),
        ("mean", f"{number(f.mean[0], 1)}, {number(f.mean[1], 1)}"),
        ("asymmetry", f"{number(100 * f.asymmetry)} %"),
        ("p, if centrosymmetric", _p(f.asymmetry_p)),
        ("smooth field", f"{number(f.field_rms)} {unit}"),
        ("noise alone makes", f"{number(f.field_noise)} {unit}"),
        ("p, if it repeats by chance", _p(f.field_p)),
        ("p of the F-test", _p(f.field_f_p)),
    ]
    return "<table>" + "".join(f"<tr><td>{a}</td><td>{b}</td></tr>" for a, b in rows) + "</table>"


def _p(p: float) -> str:
    return "–" if not math.isfinite(p) else "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


# --------------------------------------------------------------------------------------------------- volume, prediction


def _filled(f: Filled | None) -> str:
    """Layers of the measuring volume, y upwards as on the maps below."""
    if f is None:
        return ""
    w, h = f.size_mm
    plots = [
        figure("mid", f"z from <b>{number(low)}</b> to <b>{number(high)}</b> mm".replace("-", "−"),
               svg.cells(layer[::-1], (max(round(w), 1), max(round(h), 1))))
        for layer, low, high in zip(f.layers, f.edges_mm[:-1], f.edges_mm[1:], strict=True)
    ]  # fmt: skip
    return (
        f'<h2>The measuring volume</h2><p class="lead">Boards reached <b>{100 * f.share:.0f} %</b> of its cells, '
        f"{number(w)} x {number(h)} mm wide. Darker: more poses; orange: none; hatched: no camera sees it in the "
        "projector’s light. Points are worth most where boards were.</p>"
        f'<section class="card"><div class="plots">{"".join(plots)}</div></section>'
    )


def _predicted(p: Prediction | None) -> str:
    head = "<h2>Predicted uncertainty of points</h2>"
    if p is None:
        return f'{head}<p class="lead">The calibration carries no covariance: nothing can be predicted.</p>'
    values = np.array([v for slices in p.slices.values() for s in slices for row in s.sigma_um for v in row])
    values = values[np.isfinite(values)]
    if not values.size:
        return f'{head}<p class="lead">No point of the measuring volume is seen by the projector and a camera.</p>'
    low, high = float(values.min()), float(np.percentile(values, 99))
    out = [
        head,
        '<p class="lead">One standard deviation of where points come out, from the calibration alone: what averaging '
        "over more frames cannot mend. Moving everything together as one rigid body is not counted. "
        f"Overall scale: {number(p.scale_ppm)} ppm.</p>",
    ]
    for camera, slices in p.slices.items():
        middle, p95, largest = p.per_camera[camera]
        maps = "".join(
            f"<div>{svg.heat(s.sigma_um, s.extent_mm, low, high, f'z = {s.z_mm:.0f} mm')}</div>" for s in slices
        )
        out.append(
            f'<section class="card"><h3>{escaped(camera)}</h3><p>median <b>{number(middle)} µm</b> · 95 % below '
            f'{number(p95)} µm · at most {number(largest)} µm</p><div class="maps">{maps}</div>'
            f'<div class="bar">{svg.colour_bar(low, high, "µm")}</div></section>'
        )
    if p.views_um:
        rows = "".join(
            f"<tr><td>{escaped(k)}</td><td>{number(m)}</td><td>{number(x)}</td></tr>"
            for k, (m, x) in p.views_um.items()
        )
        out.append(
            '<section class="card"><h3>Between views</h3><p class="lead">How far the heights of one surface should '
            'differ between two cameras (one standard deviation).</p><div class="scroll"><table class="narrow"><tr>'
            f"<th>cameras</th><th>median, µm</th><th>largest, µm</th></tr>{rows}</table></div></section>"
        )
    return "".join(out)


# ---------------------------------------------------------------------------------------------------------------- poses


def _poses(poses: Sequence[PoseFigures]) -> str:
    cameras = list(dict.fromkeys(k for p in poses for k in (*p.corner_px, *p.sample_units)))
    columns: list[tuple[str, list[tuple[float, ...]]]] = [
        (
            f"{escaped(k)}<br>px · units",
            [(p.corner_px.get(k, math.nan), p.sample_units.get(k, math.nan)) for p in poses],
        )
        for k in cameras
    ]
    if any(p.held_out for p in poses):
        h = [p.held_out for p in poses]
        columns += [
            ("left out:<br>corners, px", [(x.corner_px_rms if x else math.nan,) for x in h]),
            ("left out:<br>corners · phase, µm", [
                (1000 * x.corner_mm_rms, x.sample_um_rms) if x else (math.nan, math.nan) for x in h
            ]),
            ("left out:<br>size, ppm", [(1e6 * (x.scale - 1) if x else math.nan, math.inf) for x in h]),
        ]  # fmt: skip
    usual = [[_median([abs(v[j]) for v in values]) for j in range(len(values[0]))] for _, values in columns]
    rows = []
    for i, p in enumerate(poses):
        figures = "".join(_cell(values[i], m) for (_, values), m in zip(columns, usual, strict=True))
        rows.append(
            f"<tr><td>{escaped(p.pose)}</td><td>{number(math.degrees(p.tilt_rad))}</td><td>{number(p.depth_mm, 4)}</td>"
            f"<td>{p.corners}</td>{figures}</tr>"
        )
        if p.notes:
            said = f"<td class=note colspan={len(columns) + 3}>{micro('; '.join(p.notes))}</td>"
            rows.append(f"<tr class=under><td></td>{said}</tr>")
    head = "".join(f"<th>{n}</th>" for n, _ in columns)
    return (
        '<h2>Pose by pose</h2><p class="lead">Root mean squares: corners in pixels of the camera, phase in units of '
        "the projector’s plane, both as lengths of vectors. Below a pose: what of it was not used, and why. Marked: "
        "more than twice what is usual. “Left out”: the pose was taken out of the "
        "solve, and its board then measured with the rig of the others.</p>"
        '<section class="card"><div class="scroll"><table><tr><th>pose</th><th>tilt, °</th><th>depth, mm</th>'
        f"<th>corners</th>{head}</tr>"
        f"{''.join(rows)}</table></div></section>"
    )


def _cell(values: Sequence[float], usual: Sequence[float]) -> str:
    """Figures of one pose; one with an infinite neighbour (an error of either sign) is never marked."""
    shown = [v for v in values if not math.isinf(v)]
    far = len(shown) == len(values) and any(v > FAR * m for v, m in zip(values, usual, strict=True))
    return f"<td{' class=far' if far else ''}>{' · '.join(number(v) for v in shown)}</td>"


def _median(values: Sequence[float]) -> float:
    v = [x for x in values if math.isfinite(x)]
    return float(np.median(v)) if v else math.inf


# ----------------------------------------------------------------------------------------------------------- parameters


def _parameters(c: Calibration, e: Evidence) -> str:
    models = c.figures.get("lens_models", {})
    out = ['<h2>Parameters</h2><p class="lead">Values with one standard deviation. Grey: held fixed.</p>']
    out.append('<div class="columns">')
    for device in dict.fromkeys(p.device for p in c.parameters):
        mine = [p for p in c.parameters if p.device == device]
        model = models.get(device) if isinstance(models, Mapping) else None
        note = f' <span class="none">lens: {escaped(model)}</span>' if model else ""
        rows = "".join(_parameter(p) for p in mine)
        out.append(f'<section class="card"><h3>{escaped(device)}{note}</h3><table>{rows}</table></section>')
    out.append("</div>")
    if e.correlations:
        rows = "".join(
            f"<tr><td>{escaped(a)}</td><td class=note>{escaped(b)}</td><td>{r:+.3f}</td></tr>"
            for a, b, r in e.correlations
        )
        out.append(
            '<section class="card"><h3>Parameters that the pictures hardly tell apart</h3><p class="lead">Their errors '
            "go together and mostly cancel; more tilt and depth separate them.</p>"
            f'<div class="scroll"><table class="narrow">{rows}</table></div></section>'
        )
    return "".join(out)


def _parameter(p: Parameter) -> str:
    if p.fixed or not p.sigma > 0:
        value = number(p.value, 6)
        unit = escaped(p.unit)
        return f"<tr class=fixed><td>{escaped(p.name)}</td><td>{value}</td><td>fixed</td><td>{unit}</td></tr>"
    places = max(0, 1 - math.floor(math.log10(p.sigma)))
    value = f"{p.value:.{min(places, 9)}f}".replace("-", "−")
    return f"<tr><td>{escaped(p.name)}</td><td>{value}</td><td>± {number(p.sigma)}</td><td>{escaped(p.unit)}</td></tr>"
