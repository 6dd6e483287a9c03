"""The verb that compares two scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Force, Json, Out, Progress, SetOption, SettingsFile, emit, existing, load_settings
from fringescope.errors import FormatError

if TYPE_CHECKING:
    from fringescope.settings import Settings
    from fringescope.store import StoredScan
    from fringescope.types import F64, Cloud, Rig


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
    first, second = (export.read_ply(x.cloud) for x in scans)
    names, strokes, notes = ([], [], []) if guidelines is None else _drawn(guidelines, scans[0], first, r, s)
    c = comparing.compare_scans(
        first, second, r, s, moved=register, strokes=strokes, names=names, progress=progress.share
    )
    surface = None if scans[1].surface is None else export.read_glb(scans[1].surface)
    title = f"{before.resolve().name} to {after.resolve().name}"
    doc: dict[str, Any] = progress.run(
        "writing",
        lambda: store.put_comparison(
            folder,
            comparing.figures(c, names, notes),
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


def _drawn(
    guidelines: Path, before: StoredScan, cloud: Cloud, rig: Rig | None, s: Settings
) -> tuple[list[str], list[F64], list[str]]:
    """The strokes of a file as they lie on the first scan: names, polylines in mm, a line about each that is left out.

    With a rig guidelines are drawn as `guide` draws them; without one, and of a pattern.json, their points are joined.
    """
    from fringescope import export, store
    from fringescope.pipeline import comparing
    from fringescope.pipeline import guidance as recipe

    hashes = str(before.document.get("hash")), str(before.document.get("rig"))
    if rig is not None and before.surface is not None and store.is_guidelines(guidelines):
        asked = store.read_guidelines(guidelines)
        recipe.check_bound(asked, *hashes)
        grids = store.read_scan(before.folder, check=False).grids
        tissue = recipe.tissue_of(grids, export.read_glb(before.surface), rig, s)
        names, lines, words = comparing.traced(recipe.project_guidance(asked, tissue, s))
        words += [f"{k}: not compared: {v}" for k, v in asked.refused.items()]
        if not lines:
            raise FormatError(f"{guidelines}: nothing to compare the cut with; " + "; ".join(words[:3]))
        return names, lines, words
    drawn, refused = store.read_strokes(guidelines, *hashes)
    grids = store.read_scan(before.folder, check=False).grids if any("pixels" in x for x in drawn) else ()
    words = [f"{k}: not compared: {v}" for k, v in refused.items()]
    return [x["id"] for x in drawn], comparing.world_strokes(drawn, cloud, grids, rig), words
