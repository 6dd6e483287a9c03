"""Verbs that bring an expert's strokes back onto the tissue, and prove where: guide, carry, selftest."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.common import (
    Force,
    Json,
    Progress,
    SetOption,
    SettingsFile,
    emit,
    existing,
    load_settings,
    say,
    until_interrupted,
)
from fringescope.errors import EmptyResultError, FormatError, GuidanceError, UsageError

if TYPE_CHECKING:
    from fringescope.guide import Tissue
    from fringescope.settings import Settings
    from fringescope.store import StoredScan
    from fringescope.types import U8, Guidance, Landing


@app.command()
def guide(
    scan: Annotated[Path, typer.Argument(help="A scan: a folder with scan.json.")],
    guidelines: Annotated[Path, typer.Argument(help="The strokes: a file of format fringescope-guidelines.")],
    rig: Annotated[Path, typer.Option(help="The rig.json that the scan was made with.")],
    out: Annotated[Path, typer.Option(help="The device's picture, as pattern.png; pattern.json comes beside it.")],
    preview: Annotated[
        bool, typer.Option(help="Also write how it will look in each camera: pattern-camera1.png ..")
    ] = True,
    verify: Annotated[
        bool, typer.Option("--verify", help="Show it on the instrument, photograph it, and say where it lands.")
    ] = False,
    device: Annotated[
        str | None, typer.Option(metavar="URI", help="The instrument for --verify; default: that of the scan.")
    ] = None,
    show: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Project it for so long (0: until Ctrl-C), and watch the specimen."),
    ] = None,
    dashed: Annotated[
        bool, typer.Option("--dashed", help="Draw dashes: it is in doubt whether the strokes still fit.")
    ] = False,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Guidelines to the picture that the projector shows, and what of them is visible and how exact."""
    from fringescope import store

    s = load_settings(settings, set_)
    if out.suffix.lower() != ".png":
        raise UsageError(f"--out {out}; needed the name of a PNG file, as pattern.png")
    if show is not None and not 0 <= show < math.inf:
        raise UsageError(f"--show {show:g}; needed seconds, 0 for until Ctrl-C")
    existing(guidelines, "a file with guidelines")
    record = out.with_name("pattern.json")
    if record.exists() and record.samefile(guidelines):
        raise UsageError(f"{guidelines} would be replaced by the record, pattern.json; choose another folder for --out")
    store.check_replaced(record, force)
    for path in (out, record):  # before anything is projected
        store.check_new(path, force)
    with Progress() as progress:
        asked = store.read_guidelines(guidelines)
        stored = progress.run("reading the scan", lambda: store.read_scan(scan))
        uri = instrument_of(device, stored) if verify or show is not None else ""
        r = store.read_rig(rig)
        hashes = str(stored.document.get("hash")), store.hash_rig(rig)
        if stored.document.get("rig") != hashes[1]:
            raise FormatError(f"{rig}: is not the rig that {scan} was made with; reconstruct with this rig first")
        from fringescope import export
        from fringescope.devices import registry
        from fringescope.pipeline import closing
        from fringescope.pipeline import guidance as recipe

        recipe.check_bound(asked, *hashes)
        if stored.surface is None:
            raise EmptyResultError(f"{scan}: the scan has no surface, so nothing can be drawn on it; scan again")
        tissue = recipe.tissue_of(stored.grids, export.read_glb(stored.surface), r, s)
        made = recipe.project_guidance(asked, tissue, s, dashed=dashed, progress=progress.of("strokes"))
        doubtful = made
        if show is not None and not dashed:
            doubtful = recipe.project_guidance(asked, tissue, s, dashed=True, progress=progress.of("dashed, in case"))
        pictures: dict[str, U8] = {}
        landings: Sequence[Landing] = ()
        if verify:
            with registry.open_station(uri) as station:
                closed = progress.run("closed loop", lambda: closing.close_loop(made, tissue, station, s))
            landings = closed.landings
            pictures = {f"{c}-landed": p for c, p in closing.landing_pictures(closed, r, s).items()}
        if preview and all(p is not None for p in stored.pictures):
            seen = progress.run("previews", lambda: recipe.previews(made, tissue, stored.every_picture(), s))
            pictures |= seen
    doc = store.pattern_document(made, asked.refused, landings, {"scan": hashes[0], "rig": hashes[1]})
    lines = [*summary(made, landings), *(f"{k}: not shown: {v}" for k, v in asked.refused.items())]
    if not asked.strokes and not asked.refused:
        lines.append("no strokes: the picture is dark")
    if not any(g.segments for g in made.strokes) and (made.strokes or asked.refused):
        raise EmptyResultError("nothing can be shown; " + "; ".join(lines[:5]))
    with ExitStack() as files:
        beside = {camera: out.with_name(f"{out.stem}-{camera}.png") for camera in pictures}
        image = files.enter_context(store.new_file(out, force=force))
        text = files.enter_context(store.new_file(record, force=force))
        views = {c: files.enter_context(store.new_file(p, force=force)) for c, p in beside.items()}
        store.write_png(image, made.image)
        store.write_json(text, doc)
        for camera, path in views.items():
            store.write_png(path, pictures[camera])
    result: dict[str, Any] = {"pattern": str(out), **doc, "previews": {c: str(p) for c, p in beside.items()}}
    emit(result, json, [f"{out}: {len(made.strokes) + len(asked.refused)} strokes", *lines])
    if show is not None:
        _project(uri, stored, tissue, made, doubtful, show, s)
    far = [x for x in landings if x.p95_um is not None and x.p95_um > s.loop.accept_um]
    if far:
        raise GuidanceError(
            f"{far[0].id} lands {far[0].p95_um:.0f} um (p95) from where it was asked for; needed "
            f"{s.loop.accept_um:.0f}: verify the rig, and scan again if the specimen moved"
        )
    if landings and all(x.median_um is None for x in landings):
        raise EmptyResultError("no projected line was found in any picture; " + "; ".join(landings[0].words))


def _project(
    uri: str, stored: StoredScan, tissue: Tissue, made: Guidance, dashed: Guidance, seconds: float, s: Settings
) -> None:
    """Shows guidance under a watchdog for `seconds`, or until Ctrl-C. Raises GuidanceError where it had to go dark."""
    from fringescope.devices import registry
    from fringescope.devices.watchdog import Guard
    from fringescope.pipeline import closing, projecting, watching

    pictures, masks = stored.every_picture(), projecting.lit_masks(made, tissue)
    end = None if seconds <= 0 else time.monotonic() + seconds

    with until_interrupted() as interrupted, registry.open_station(uri) as station:
        closing.check_device(made, tissue.rig, station)

        def stop() -> bool:
            return interrupted() or (end is not None and time.monotonic() > end)

        ended = projecting.hold(
            station, lambda: Guard(station.projector, s.guard), made, dashed,
            lambda: watching.watch(station, stored.grids, pictures, tissue.rig, s, noise=stored.noise(), masks=masks),
            stop, s, lambda v: say(f"{v.verdict.value}: {v.why}"),
        )  # fmt: skip
    if ended.ended != "stopped":
        raise GuidanceError(f"the projector is dark: {ended.ended}: {ended.why}")
    say("the projector is dark: stopped, as was asked")


def instrument_of(device: str | None, scan: StoredScan) -> str:
    """The URI that was given, or that of the instrument that a scan was made with. Raises UsageError without both."""
    uri = device or scan.instrument
    if uri is None:
        raise UsageError("which instrument made this scan is not known; name it with --device URI")
    return uri


def summary(made: Guidance, landings: Sequence[Landing] = ()) -> list[str]:
    """A line for people per stroke, its notes, and where it landed."""
    from fringescope.report import guidance_caption, landing_caption

    landed = {x.id: x for x in landings}
    out = []
    for g in made.strokes:
        out += [guidance_caption(g), *(f"  {n}" for n in g.notes)]
        if g.stroke.id in landed:
            out.append(f"  landed: {landing_caption(landed[g.stroke.id])}")
    return out


@app.command()
def carry(
    old: Annotated[Path, typer.Argument(help="The scan that the guidelines were drawn on.")],
    new: Annotated[Path, typer.Argument(help="The scan made since, of the same specimen and rig.")],
    guidelines: Annotated[Path, typer.Argument(help="The strokes: a file of format fringescope-guidelines.")],
    rig: Annotated[Path, typer.Option(help="The rig.json of both scans.")],
    out: Annotated[Path, typer.Option(help="The guidelines for the new scan, a JSON file, in mm.")],
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Guidelines of one scan carried over to the next by registration, for the operator to look at and decide.

    Nothing is projected: preview the new file with `guide`, and use it if it is right.
    """
    from fringescope import export, store
    from fringescope.pipeline import carrying
    from fringescope.pipeline import guidance as recipe

    s = load_settings(settings, set_)
    asked = store.read_guidelines(existing(guidelines, "a file with guidelines"))
    with Progress() as progress:
        r, was = store.read_rig(rig), store.read_scan(old)
        now = store.read_scan(new, grids=False)
        store.check_pair(was, now, store.hash_rig(rig))
        recipe.check_bound(asked, str(was.document.get("hash")), store.hash_rig(rig))
        if was.surface is None:
            raise EmptyResultError(f"{old}: the scan has no surface, so nothing was drawn on it")
        tissue = recipe.tissue_of(was.grids, export.read_glb(was.surface), r, s)
        clouds = [export.read_ply(x.cloud) for x in (was, now)]
        found = progress.run("carrying over", lambda: carrying.carry_over(asked, tissue, clouds[0], clouds[1], r, s))
    if not found.guidelines.strokes:
        why = "; ".join(f"{k}: {v}" for k, v in found.guidelines.refused.items())
        raise EmptyResultError(f"nothing can be carried over; {why or 'there are no strokes'}")
    g = found.registration
    told = {
        "moved_mm": g.shift_mm, "turned_rad": g.turn_rad, "residual_um": 1e3 * g.rms_mm, "unchanged": g.inliers,
        "expected_error_um": found.expected_error_um, "refused": found.guidelines.refused, "words": g.words,
    }  # fmt: skip
    bound = replace(found.guidelines, scan=now.document.get("hash"), rig=store.hash_rig(rig))
    with store.new_file(out, force=force) as file:
        store.write_json(file, store.guidelines_document(bound, {"carried_over": told}))
    worst = max(found.expected_error_um.values())
    lines = [
        f"{out}: {len(bound.strokes)} strokes; the specimen moved by {g.shift_mm:.2f} mm and "
        f"{math.degrees(g.turn_rad):.2f} degrees, {g.inliers:.0%} of it fits within {1e3 * g.rms_mm:.0f} um (rms); "
        f"expected error up to {worst:.0f} um",
        *g.words,
        *(f"{k}: left behind: {v}" for k, v in bound.refused.items()),
        "look at it before you use it: fringescope guide " + f"{new} {out} --rig {rig} --out pattern.png",
    ]
    emit({"guidelines": str(out), **told}, json, lines)


@app.command()
def selftest(
    rig: Annotated[Path, typer.Option(help="The rig.json of this instrument, just calibrated.")],
    device: Annotated[str, typer.Option(metavar="URI", help="The instrument, with the board lying under it.")],
    out: Annotated[Path, typer.Option(help="A new folder for selftest.json and a picture of each camera.")],
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Projects a cross grid on the calibration board and measures where its lines land: after each calibration.

    Exit status 1 if they lie farther than loop.accept_um (p95) from where they were asked for.
    """
    from fringescope import store
    from fringescope.devices import registry
    from fringescope.pipeline import closing
    from fringescope.pipeline.selftest import self_test

    s = load_settings(settings, set_)
    r = store.read_rig(rig)
    with store.new_folder(out, marker="selftest.json", force=force) as tmp, Progress() as progress:
        with registry.open_station(device) as station:
            found = progress.run("self-test", lambda: self_test(station, r, s))
        doc = store.pattern_document(found.guidance, {}, found.closed.landings, {"rig": store.hash_rig(rig)})
        told = {
            "format": "fringescope-selftest", "version": 1, "ok": found.ok, "median_um": found.median_um,
            "p95_um": found.p95_um, "max_um": found.max_um, "limit_um": s.loop.accept_um, "strokes": doc["strokes"],
            "rig": doc["rig"], "device": device,
        }  # fmt: skip
        store.write_json(tmp / "selftest.json", store.plain(told))
        for camera, picture in closing.landing_pictures(found.closed, r, s).items():
            store.write_png(tmp / f"{camera}.png", picture)
    emit({"selftest": str(out), **told}, json, [found.words(s.loop.accept_um)])
    if not found.ok:
        raise typer.Exit(1)
