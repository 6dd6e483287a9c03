"""Verbs from a capture to a surface and what it is worth: reconstruct, decode, evaluate, export."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from fringescope.cli.app import app
from fringescope.cli.common import (
    Force,
    Json,
    Out,
    Progress,
    ResponseFile,
    SetOption,
    SettingsFile,
    Views,
    emit,
    existing,
    load_response,
    load_settings,
    numbers,
    pixel_format,
)
from fringescope.errors import EmptyResultError, UsageError

if TYPE_CHECKING:
    from fringescope.evaluate import Evaluation
    from fringescope.settings import Settings
    from fringescope.store import Capture, StoredScan
    from fringescope.types import U8, Cloud, Decoded, Scan, ViewInput


# --------------------------------------------------------------------------------------------------------- reconstruct


def scan_into(
    folder: Path,
    capture: Path,
    rig: Path,
    s: Settings,
    progress: Progress,
    *,
    grids: bool = False,
    all_points: bool = False,
    preview: bool = True,
    only: Sequence[str] | None = None,
    response: Path | None = None,
    device: str = "cpu",
) -> tuple[Scan, dict[str, Any]]:
    """Reconstructs a capture (of some cameras `only`) and writes the scan into a folder that is being made; returns it
    with its scan.json.
    """
    from fringescope import store
    from fringescope.settings import to_dict

    if device != "cpu":
        from fringescope import pipeline

        pipeline.check_device(device)
    c = picked(store.read_capture(capture), only)
    with ThreadPoolExecutor(1) as aside:
        reading = aside.submit(store.read_rig, rig)
        views = store.view_inputs(c, load_response(response), ahead=True, rowed=True)
        from fringescope import export, pipeline  # while rig and frames are read: this takes longest

        r = reading.result()
    store.check_rig(c, r)
    where = pipeline.check_device(device)
    scan = pipeline.scan(views, r, s, all_points=all_points, device=where, progress=progress.share)
    if preview and scan.preview is not None:
        page = export.viewer_page(scan.preview, title=folder_title(capture))
        (folder / "view.html").write_text(page, encoding="utf-8")
    doc = progress.run(
        "writing",
        lambda: store.put_scan(
            folder,
            scan,
            settings=to_dict(s),
            capture_hash=store.hash_capture(c),
            rig_hash=store.hash_rig(rig),
            write_ply=export.write_ply,
            write_glb=export.write_glb,
            write_preview=export.write_preview,
            grids=grids,
            extra={"instrument": c.extra["instrument"]} if isinstance(c.extra.get("instrument"), str) else None,
        ),
    )
    return scan, doc


def picked(capture: Capture, cameras: Sequence[str] | None) -> Capture:
    """The views that `--view` names, or all. Raises UsageError."""
    if not cameras:
        return capture
    there = [v.camera for v in capture.views]
    for c in cameras:
        if c not in there:
            raise UsageError(f"--view {c}: {capture.document} has no such view; it has {', '.join(there)}")
    return capture.only(cameras)


def folder_title(path: Path) -> str:
    """A name for people: that of the folder."""
    return (path.parent if path.is_file() else path).resolve().name


def scan_summary(doc: dict[str, Any], out: Path) -> list[str]:
    """A scan in lines for people: what there is, and what each view lost and why."""
    surface = doc["surface"]
    lines = [f"{out}: {doc['cloud']['points']} points" + (f", {surface['triangles']} triangles" if surface else "")]
    if isinstance(why := doc["figures"].get("surface"), str):
        lines.append(why)
    if isinstance(found := doc["figures"].get("specimen"), dict):
        from fringescope import specimen

        lines.append(specimen.words(found))
    for v in doc["views"]:
        lines += list(v.get("words", ()))
    return lines


@app.command()
def reconstruct(
    capture: Annotated[Path, typer.Argument(help="A capture: a folder with capture.json.")],
    rig: Annotated[Path, typer.Option(help="The rig.json of this instrument.")],
    out: Out,
    all_points: Annotated[
        bool, typer.Option("--all-points", help="cloud.ply holds every valid pixel of every view.")
    ] = False,
    grids: Annotated[
        bool, typer.Option("--grids", help="Also write the organised points as TIFF, the reasons as PNG.")
    ] = False,
    preview: Annotated[bool, typer.Option(help="Also write view.html, which shows the surface in a browser.")] = True,
    only: Views = None,
    response: ResponseFile = None,
    device: Annotated[
        str, typer.Option(metavar="cpu|gpu", help="Where frames become points: gpu needs fringescope[gpu].")
    ] = "cpu",
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fringe images to a clean, coloured, fused surface: scan.json, cloud.ply, surface.glb."""
    from fringescope import store

    s = load_settings(settings, set_)
    with store.new_folder(out, marker="scan.json", force=force) as tmp, Progress() as progress:
        _, doc = scan_into(
            tmp, capture, rig, s, progress,
            grids=grids, all_points=all_points, preview=preview, only=only, response=response, device=device,
        )  # fmt: skip
    emit({"scan": str(out), **doc}, json, scan_summary(doc, out))


# -------------------------------------------------------------------------------------------------------------- decode


def _pictures(d: Decoded) -> dict[str, U8]:
    """What people look at: phase, modulation and background in colour, reasons with a legend."""
    from fringescope import report

    out = {f"phase_{i}": report.phase_picture(x.phase, d.reasons == 0) for i, x in enumerate(d.directions)}
    for name, a in (("modulation", d.modulation), ("background", d.background)):
        top = max(float(np.nanpercentile(a, 99.5)), 1e-6)
        out[name] = np.asarray(255 * np.clip(np.nan_to_num(a) / top, 0, 1), np.uint8)
    return out | {"reasons": report.reasons_map(d.reasons, d.camera, d.background)}


@app.command()
def decode(
    capture: Annotated[
        Path,
        typer.Argument(metavar="CAPTURE_OR_STACK", help="A capture folder, or a TIFF stack of one set, or its folder."),
    ],
    out: Out,
    steps: Annotated[
        str | None, typer.Option(help="Of a stack: number of steps (default: all along the axis).")
    ] = None,
    axis: Annotated[str | None, typer.Option(help="Of a stack: the axis along which the steps lie, as Z.")] = None,
    time: Annotated[int | None, typer.Option(help="Of a stack: which time.")] = None,
    pixel_format_: Annotated[str | None, typer.Option("--pixel-format", help="Of a stack: as Mono12.")] = None,
    only: Views = None,
    response: ResponseFile = None,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Phase, modulation, background, projector coordinates and reasons per pixel, without a rig.

    A bare stack has no period: it is decoded as one fringe, so its phase is wrapped.
    """
    from fringescope import importing, phase, pipeline, store
    from fringescope.settings import from_dict, to_dict

    s = load_settings(settings, set_)
    existing(capture, "a capture folder or a TIFF stack")
    with store.new_folder(out, marker="decoded.json", force=force) as tmp, Progress() as progress:
        views: Sequence[ViewInput]
        extra: dict[str, Any] = {}
        if (stack := importing.the_stack(capture)) is not None:
            if only:
                raise UsageError(f"--view {only[0]}: a stack has one view; leave the option out")
            if response is not None:
                raise UsageError("--response is for captures; a bare stack has no period that it could be applied to")
            n = None if steps is None else numbers(steps, "--steps", int)[0]
            view, note, digest = importing.stack_view(stack, n, axis, time, pixel_format(pixel_format_))
            views, extra = (view,), {"source": stack.name, "note": note}
            s = from_dict({"denoise": {"jump_floor_rad": 7.0}}, s)  # a wrapped phase jumps by design
        elif (steps, axis, time, pixel_format_) != (None,) * 4:
            raise UsageError("--steps, --axis, --time, --pixel-format are for a TIFF stack; a capture says them itself")
        else:
            c = picked(store.read_capture(capture), only)
            views, digest = store.view_inputs(c, load_response(response)), ""
        decoded = []
        for v in progress.track(views, "decoding", len(views)):
            d = pipeline.decode_view(v, s)
            nowhere = np.full(d.shape, np.nan, np.float32)
            decoded.append((d, *((nowhere, nowhere) if extra else phase.projector_coordinates(d))))
        if not any((d.reasons == 0).any() for d, _, _ in decoded):
            lost = ", ".join(f"{d.camera}: {n} {r}" for d, _, _ in decoded for r, n in store.lost(d.reasons).items())
            raise EmptyResultError(f"{capture}: no pixel can be decoded ({lost}): give more light")
        digest = digest or store.hash_capture(c)
        doc = progress.run(
            "writing",
            lambda: store.put_decoded(
                tmp, decoded, settings=to_dict(s), capture_hash=digest, pictures=_pictures, extra=extra
            ),
        )
    lines = [f"{out}: {len(doc['views'])} view(s)"] + ([extra["note"]] if extra else [])
    for view in doc["views"]:
        share = 100 * view["valid"] / max(view["pixels"], 1)
        lost = ", ".join(f"{n} {r}" for r, n in view["lost"].items())
        lines.append(
            f"{view['camera']}: {view['valid']} pixels decoded ({share:.0f} %)" + (f"; lost: {lost}" if lost else "")
        )
    emit({"decoded": str(out), **doc}, json, lines)


# ------------------------------------------------------------------------------------------------- evaluate and export


def read_cloud(path: Path) -> Cloud:
    """The points of a scan's folder or of a PLY. Raises FormatError, CaptureError."""
    from fringescope import export, store

    existing(path, "a scan folder or a PLY file")
    if path.is_dir() or path.name == "scan.json":
        return export.read_ply(store.read_scan(path, grids=False).cloud)
    return export.read_ply(path)


@app.command()
def evaluate(
    scan: Annotated[Path, typer.Argument(metavar="SCAN_OR_PLY", help="A scan folder, or a PLY.")],
    fit: Annotated[str, typer.Option(help="plane, or sphere (all spheres and their base).")],
    radius: Annotated[str | None, typer.Option(help="Nominal radii of spheres in mm, as in 12,5.")] = None,
    band: Annotated[float | None, typer.Option(help="Farther than this from the form (mm) a point flies.")] = None,
    rig: Annotated[
        Path | None, typer.Option(help="With it the sigma of points is judged along the cameras' rays.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a PNG of the error map.")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fits a plane or spheres and tells how good the points are, as in section IV of the paper."""
    from fringescope import evaluate as ev
    from fringescope import geometry, store

    radii = numbers(radius, "--radius", float) if radius else ()
    cloud = read_cloud(scan)
    centres = None
    if rig is not None:
        centres = np.stack([geometry.centre(c.pose) for c in store.read_rig(rig).cameras])
    has_sigma = bool(np.isfinite(cloud.sigma).any())
    with Progress() as progress:
        found = progress.run(
            "fitting",
            lambda: ev.evaluate(
                cloud.xyz, fit, radii, cloud.sigma if has_sigma else None, cloud.view, centres, band or ev.BAND_MM
            ),
        )
        if picture is not None:
            with store.new_file(picture, force=force) as tmp:
                store.write_png(tmp, progress.run("drawing", lambda: _error_maps(found, scan.name)))
    doc = found.to_dict()
    emit({"source": str(scan), **doc}, json, _evaluation(doc))


def _error_maps(found: Evaluation, name: str) -> U8:
    """The plane's error map, or one of each sphere, one below the other."""
    from fringescope import report

    forms = (
        [("plane", found.plane)]
        if found.kind == "plane"
        else [(f"sphere {i + 1}, radius {s.radius_mm:.3f} mm", s) for i, s in enumerate(found.spheres)]
    )
    maps = []
    for what, form in forms:
        if form is None:
            continue
        s = form.spread
        figures = [("std", f"{s.std_um:.2f} um"), ("rms", f"{s.rms_um:.2f} um"), ("points", f"{s.points:,}")]
        maps.append(report.error_map(form.flat_mm, form.deviation_um, f"{name}: {what}", figures))
    width = max(m.shape[1] for m in maps)
    padded = [np.pad(m, ((0, 0), (0, width - m.shape[1]), (0, 0)), constant_values=255) for m in maps]
    return np.concatenate(padded, axis=0)


def _evaluation(doc: dict[str, Any]) -> list[str]:
    lines = [f"{doc['points']} points, {doc['flying_ppm']:.0f} ppm flying (farther than {doc['band_mm']:g} mm)"]

    def spread(d: dict[str, Any]) -> str:
        return ", ".join(
            f"{k.removesuffix('_um')} {v:.2f} um" for k, v in d.items() if k.endswith("_um") and v is not None
        )

    for name, form in (("plane", doc["plane"]), *((f"sphere {i + 1}", s) for i, s in enumerate(doc["spheres"]))):
        if form:
            radius = f"radius {form['radius_mm']:.4f} mm, " if "radius_mm" in form else ""
            lines.append(
                f"{name}: {radius}{spread(form)}" + (f", {spread(form['spread'])}" if "spread" in form else "")
            )
    lines += [f"centres of spheres {i + 1} and {j + 1}: {d:.4f} mm" for i, j, d in doc["center_distances_mm"]]
    if doc["sigma_ratio"] is not None:
        lines.append(f"error over sigma: {doc['sigma_ratio']:.2f} (1: the uncertainty is calibrated)")
    return lines + list(doc["words"])


FORMATS = ("stl", "obj", "pcd", "e57", "3mf", "ply", "glb")


@app.command()
def export(
    scan: Annotated[Path, typer.Argument(help="A scan folder.")],
    to: Annotated[str, typer.Option(help=f"{', '.join(FORMATS)}.")],
    out: Annotated[Path | None, typer.Option("--out", help="The file (default: SCAN's name with the format).")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """A scan in other people's formats: the surface (stl, obj, 3mf, glb) or the points (pcd, e57, ply), in mm.

    E57 is in metres, as its standard asks. obj comes with its material and pictures beside it.
    """
    import shutil

    from fringescope import export as ex
    from fringescope import store

    kind = to.lower().lstrip(".")
    if kind not in FORMATS:
        raise UsageError(f"--to {to}; needed one of {', '.join(FORMATS)}")
    stored = store.read_scan(existing(scan, "a scan folder"), grids=False)
    target = out or Path(f"{stored.folder.resolve().name}.{kind}")
    if kind in ("stl", "obj", "3mf", "glb") and stored.surface is None:
        raise EmptyResultError(f"{scan}: this scan has no surface; export its points with --to ply, pcd or e57")
    with Progress() as progress:
        if kind == "obj":
            written = _export_obj(stored, target, force, progress)
        else:
            with store.new_file(target, force=force) as tmp:
                if kind in ("ply", "glb"):
                    shutil.copyfile(stored.cloud if kind == "ply" else stored.folder / "surface.glb", tmp)
                elif kind in ("pcd", "e57"):
                    write_points = {"pcd": ex.write_pcd, "e57": ex.write_e57}[kind]
                    progress.run(f"writing {kind}", lambda: write_points(ex.read_ply(stored.cloud), tmp))
                else:
                    write_mesh = {"stl": ex.write_stl, "3mf": ex.write_3mf}[kind]
                    surface = ex.read_glb(stored.folder / "surface.glb")
                    progress.run(f"writing {kind}", lambda: write_mesh(surface, tmp))
            written = [target]
    emit({"scan": str(scan), "to": kind, "files": [str(f) for f in written]}, json, [str(f) for f in written])


def _export_obj(stored: StoredScan, target: Path, force: bool, progress: Progress) -> list[Path]:
    """An OBJ and the files that it names, which must keep their names: made aside, then put in place."""
    import shutil
    import tempfile

    from fringescope import export as ex
    from fringescope import store

    surface = ex.read_glb(stored.folder / "surface.glb")
    with tempfile.TemporaryDirectory() as aside:
        made = progress.run("writing obj", lambda: ex.write_obj(surface, Path(aside) / target.name))
        places = [target.with_name(f.name) for f in made]
        with ExitStack() as stack:
            work = [stack.enter_context(store.new_file(p, force=force)) for p in places]
            for f, w in zip(made, work, strict=True):
                shutil.copyfile(f, w)
    return places
