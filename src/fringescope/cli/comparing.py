"""The verb that compares two scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Force, Json, Out, Progress, SetOption, SettingsFile, emit, existing, load_settings

if TYPE_CHECKING:
    from fringescope.settings import Settings


@app.command()
def compare(
    before: Annotated[Path, typer.Argument(help="The scan before: a folder with scan.json.")],
    after: Annotated[Path, typer.Argument(help="The scan after, of the same specimen and rig.")],
    out: Out,
    rig: Annotated[
        Path | None, typer.Option(help="The rig.json of both: says where the projector is, and drapes a pattern.json.")
    ] = None,
    guidelines: Annotated[
        Path | None, typer.Option(help="Guidelines drawn on the scan before, or their pattern.json.")
    ] = None,
    register: Annotated[
        bool, typer.Option("--register/--no-register", help="Whether the specimen may have moved.")
    ] = True,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Two scans, before and after a cut: what was removed, where, how surely, and how far from the guideline.

    Writes compare.json, depth.tif and sigma.tif (float32 maps), regions.png, map.png (for people), and the surface
    after as cloud.ply and surface.glb, coloured by the depth removed.
    """
    from fringescope import store

    s = load_settings(settings, set_)
    with store.new_folder(out, marker="compare.json", force=force) as tmp, Progress() as progress:
        doc = compare_into(tmp, before, after, s, progress, rig=rig, guidelines=guidelines, register=register)
    emit({"comparison": str(out), **doc}, json, [f"{out}: {doc['words'][0]}", *doc["words"][1:]])


def compare_into(
    folder: Path, before: Path, after: Path, s: Settings, progress: Progress, *, rig: Path | None = None,
    guidelines: Path | None = None, register: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Compares two scans and writes what came of it into a folder that is being made; returns its compare.json."""
    from fringescope import export, store
    from fringescope.pipeline import comparing
    from fringescope.settings import to_dict

    scans = [store.read_scan(existing(p, "a scan folder"), grids=False) for p in (before, after)]
    r = None if rig is None else store.read_rig(rig)
    store.check_pair(scans[0], scans[1], None if rig is None else store.hash_rig(rig))
    document = scans[0].document
    drawn = [] if guidelines is None else store.read_strokes(guidelines, document.get("hash"), document.get("rig"))
    first, second = (export.read_ply(x.cloud) for x in scans)
    grids = store.read_scan(before, check=False).grids if any("pixels" in x for x in drawn) else ()
    strokes = comparing.world_strokes(drawn, first, grids, r)
    c = comparing.compare_scans(first, second, r, s, moved=register, strokes=strokes, progress=progress.share)
    surface = None if scans[1].surface is None else export.read_glb(scans[1].surface)
    title = f"{before.resolve().name} to {after.resolve().name}"
    doc: dict[str, Any] = progress.run(
        "writing",
        lambda: store.put_comparison(
            folder,
            comparing.figures(c, [x["id"] for x in drawn]),
            scans[0],
            scans[1],
            {"depth": c.change.depth, "sigma": c.change.sigma},
            c.change.labels,
            comparing.picture(c, title),
            comparing.coloured_cloud(second, c),
            None if surface is None else comparing.coloured_surface(surface, c),
            settings=to_dict(s),
            write_ply=export.write_ply,
            write_glb=export.write_glb,
        ),
    )
    return doc
