"""demo: the whole story on the simulated instrument, from patterns to a surface that is judged against its truth."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.capturing import make_plan, make_world, simulate_into
from fringescope.cli.common import Force, Json, Progress, SetOption, SettingsFile, emit, load_settings
from fringescope.cli.scanning import scan_into, scan_summary

if TYPE_CHECKING:
    from fringescope.devices.simulated import World
    from fringescope.settings import Settings
    from fringescope.types import F64, Scan


def errors(scan: Scan, world: World) -> tuple[F64, F64]:
    """Where the points of all views lie, (n, 2) world mm, and how far above the nearest true surface, (n,) um.

    Along the surface's normal: at a silhouette a point that lies on the surface may be millimetres off along its ray.
    """
    import numpy as np

    from fringescope.twin.shapes import offsets

    xyz = np.concatenate([g.xyz[g.valid] for g in scan.grids]).astype(np.float64)
    return xyz[:, :2], 1000 * offsets(world.scene.shapes, xyz)


def judge(folder: Path, scan: Scan, world: World) -> dict[str, Any]:
    """Writes error_map.png, surface.png and relief.png; returns the errors against the truth in figures."""
    import numpy as np

    from fringescope import evaluate, report, store

    where, error = errors(scan, world)
    s = evaluate.spread(error / 1000)
    figures = [
        ("points", f"{s.points:,}"),
        ("std", f"{s.std_um:.1f} um"),
        ("p99", f"{s.p99_um:.0f} um"),
        ("bias", f"{s.bias_um:+.2f} um"),
    ]
    picture = report.error_map(where, error, f"{world.scene.name}: measured minus true, along the normal", figures)
    store.write_png(folder / "error_map.png", picture)
    if scan.surface is not None:
        store.write_png(folder / "surface.png", report.render_surface(scan.surface))
        store.write_png(folder / "relief.png", report.render_surface(scan.surface, coloured=False))
    return {
        "points": s.points,
        "std_um": s.std_um,
        "rms_um": s.rms_um,
        "p99_um": s.p99_um,
        "bias_um": s.bias_um,
        "flying_ppm": 1e6 * float(np.mean(np.abs(error) > 1000 * evaluate.BAND_MM)),
    }


def draw_and_land(folder: Path, scan: Scan, world: World, doc: dict[str, Any], s: Settings) -> dict[str, Any]:
    """A line is drawn in the first camera's photograph, projected onto the specimen, and found where it landed.

    Writes guidelines.json, pattern.png, pattern.json, guidance.png and landed.png; returns what became of the line.
    """
    import numpy as np

    from fringescope import store
    from fringescope.devices import simulated
    from fringescope.pipeline import closing, guidance

    grid, rig = scan.grids[0], world.instrument.rig
    rows, columns = np.nonzero(grid.valid)
    (top, bottom), (left, right) = np.percentile(rows, [10, 90]), np.percentile(columns, [10, 90])
    t = np.linspace(0.2, 0.8, 60)
    across, down = left + (right - left) * t, top + (bottom - top) * (0.5 + 0.06 * np.sin(14 * t))
    pixels = np.round(np.stack([across, down], 1), 2).tolist()
    stroke = {"id": "cut-1", "camera": grid.camera, "pixels": pixels, "width_mm": 0.8, "color": "#ffffff"}
    asked = {"format": "fringescope-guidelines", "version": 1, "scan": doc["hash"], "rig": doc["rig"]}
    store.write_json(folder / "guidelines.json", {**asked, "strokes": [stroke]})
    tissue = guidance.tissue_of(scan.grids, scan.surface, rig, s)
    made = guidance.project_guidance(store.read_guidelines(folder / "guidelines.json"), tissue, s)
    with simulated.station(world) as station:
        closed = closing.close_loop(made, tissue, station, s)
    told = store.pattern_document(made, {}, closed.landings)
    store.write_json(folder / "pattern.json", told)
    store.write_png(folder / "pattern.png", made.image)
    store.write_png(folder / "guidance.png", guidance.previews(made, tissue, scan.pictures, s)[grid.camera])
    store.write_png(folder / "landed.png", closing.landing_pictures(closed, rig, s)[grid.camera])
    line: dict[str, Any] = told["strokes"][0]
    return {k: line.get(k) for k in ("length_mm", "visible", "expected_error_um", "landed", "refused")}


def _has_screen() -> bool:
    """Whether a browser could open a window here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Where everything goes: a new or empty folder.")] = Path(
        "fringescope-demo"
    ),
    headless: Annotated[bool, typer.Option("--headless", help="Only leave the files; open nothing.")] = False,
    scene: Annotated[str, typer.Option(help="What to scan: see `simulate`.")] = "tissue-domed",
    preset: Annotated[str, typer.Option(help="Instrument: paper, single, pair or five.")] = "paper",
    scale: Annotated[float, typer.Option(help="Of the sensors' pixels: 0.125 is 684 x 456.")] = 0.125,
    seed: Annotated[int, typer.Option(help="Of the scene and all noise.", min=0)] = 0,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The simulated instrument scans a wet specimen: capture, scan, error map against the truth, rendered pictures."""
    from fringescope import store, warmup
    from fringescope.evaluate import BAND_MM

    s = load_settings(settings, set_)
    with (
        store.new_folder(out, marker="demo.json", force=force) as tmp,
        warmup.in_background() as compiling,
        Progress() as progress,
    ):
        world = progress.run("scene", lambda: make_world(scene, preset, scale, seed, "diamond", 0, "checkerboard"))
        (tmp / "capture").mkdir()
        (tmp / "scan").mkdir()
        simulate_into(tmp / "capture", world, make_plan(world, s), s, progress)
        rig = tmp / "capture" / "truth" / "rig.json"
        progress.run("kernels", compiling.wait)
        scan, doc = scan_into(tmp / "scan", tmp / "capture", rig, s, progress)
        found = progress.run("judging", lambda: judge(tmp, scan, world))
        line = None
        if scan.surface is not None:
            line = progress.run("guidance", lambda: draw_and_land(tmp, scan, world, doc, s))
        words = [w for v in doc["views"] for w in v.get("words", ())]
        told = {
            "format": "fringescope-demo",
            "version": 1,
            "scene": scene,
            "preset": preset,
            "scale": scale,
            "seed": seed,
            "scan": doc["hash"],
            "error": found,
            "guidance": line,
            "verdict": words,
        }
        store.write_json(tmp / "demo.json", store.plain(told))
    lines = scan_summary(doc, out / "scan")
    lines.append(
        f"against the true surface, along its normal: std {found['std_um']:.1f} um, rms {found['rms_um']:.1f} um, "
        f"99 % within {found['p99_um']:.0f} um, bias {found['bias_um']:+.2f} um; {found['flying_ppm']:.0f} of a "
        f"million points fly, farther than {BAND_MM:g} mm from it ({found['points']} points of all views)"
    )
    if line and line["landed"] and line["landed"]["median_um"] is not None:
        lines.append(
            f"a line of {line['length_mm']:.1f} mm, drawn in a photograph and projected onto the specimen, lies "
            f"{line['landed']['median_um']:.0f} um (p95 {line['landed']['p95_um']:.0f} um) from where it was drawn"
        )
    names = ("capture", "scan", "error_map.png", "surface.png", "relief.png", "landed.png")
    lines += [f"{out / n}" for n in names if (out / n).exists()]
    page = out / "scan" / "view.html"
    lines += [f"look at it: {page}"] if page.exists() else []
    emit({"demo": str(out), **told}, json, lines)
    if not headless and page.exists() and _has_screen():
        typer.launch(page.resolve().as_uri())
