"""The verb that brings an expert's strokes back onto the tissue: guide."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Force, Json, Progress, SetOption, SettingsFile, emit, existing, load_settings
from fringescope.errors import EmptyResultError, FormatError, UsageError

if TYPE_CHECKING:
    from fringescope.types import Guidance


@app.command()
def guide(
    scan: Annotated[Path, typer.Argument(help="A scan: a folder with scan.json.")],
    guidelines: Annotated[Path, typer.Argument(help="The strokes: a file of format fringescope-guidelines.")],
    rig: Annotated[Path, typer.Option(help="The rig.json that the scan was made with.")],
    out: Annotated[Path, typer.Option(help="The device's picture, as pattern.png; pattern.json comes beside it.")],
    preview: Annotated[
        bool, typer.Option(help="Also write how it will look in each camera: pattern-camera1.png ..")
    ] = True,
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
    existing(guidelines, "a file with guidelines")
    with Progress() as progress:
        asked = store.read_guidelines(guidelines)
        stored = progress.run("reading the scan", lambda: store.read_scan(scan))
        r = store.read_rig(rig)
        hashes = str(stored.document.get("hash")), store.hash_rig(rig)
        if stored.document.get("rig") != hashes[1]:
            raise FormatError(f"{rig}: is not the rig that {scan} was made with; reconstruct with this rig first")
        from fringescope import export
        from fringescope.pipeline import guidance as recipe

        recipe.check_bound(asked, *hashes)
        if stored.surface is None:
            raise EmptyResultError(f"{scan}: the scan has no surface, so nothing can be drawn on it; scan again")
        tissue = recipe.tissue_of(stored.grids, export.read_glb(stored.surface), r, s)
        made = progress.run("strokes", lambda: recipe.project_guidance(asked, tissue, s, dashed=dashed))
        pictures = {}
        if preview and all(p is not None for p in stored.pictures):
            pictures = progress.run("previews", lambda: recipe.previews(made, tissue, stored.every_picture(), s))
    doc = store.pattern_document(made, asked.refused, {"scan": hashes[0], "rig": hashes[1]})
    lines = [*summary(made), *(f"{k}: not shown: {v}" for k, v in asked.refused.items())]
    if not asked.strokes and not asked.refused:
        lines.append("no strokes: the picture is dark")
    if not any(g.segments for g in made.strokes) and (made.strokes or asked.refused):
        raise EmptyResultError("nothing can be shown; " + "; ".join(lines[:5]))
    with ExitStack() as files:
        beside = {camera: out.with_name(f"{out.stem}-{camera}.png") for camera in pictures}
        image = files.enter_context(store.new_file(out, force=force))
        text = files.enter_context(store.new_file(out.with_suffix(".json"), force=force))
        views = {c: files.enter_context(store.new_file(p, force=force)) for c, p in beside.items()}
        store.write_png(image, made.image)
        store.write_json(text, doc)
        for camera, path in views.items():
            store.write_png(path, pictures[camera])
    result: dict[str, Any] = {"pattern": str(out), **doc, "previews": {c: str(p) for c, p in beside.items()}}
    emit(result, json, [f"{out}: {len(made.strokes) + len(asked.refused)} strokes", *lines])


def summary(made: Guidance) -> list[str]:
    """A line for people per stroke, and its notes."""
    from fringescope.report import guidance_caption

    return [line for g in made.strokes for line in (guidance_caption(g), *(f"  {n}" for n in g.notes))]
