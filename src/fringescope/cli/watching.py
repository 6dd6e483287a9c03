"""The verb that asks whether a specimen is still where it was scanned: watch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fringescope.cli.app import app
from fringescope.cli.common import (
    Force,
    Json,
    Progress,
    ResponseFile,
    SetOption,
    SettingsFile,
    emit,
    existing,
    load_response,
    load_settings,
)
from fringescope.errors import FormatError, UsageError

if TYPE_CHECKING:
    from fringescope.types import Watched


@app.command()
def watch(
    scan: Annotated[Path, typer.Argument(help="A scan folder.")],
    rig: Annotated[Path, typer.Option(help="The rig.json of this instrument, the scan's.")],
    device: Annotated[
        str | None, typer.Option(help="The instrument, by URI (default: the one that took the scan, where it tells).")
    ] = None,
    remeasure: Annotated[
        bool, typer.Option("--remeasure", help="Also measure the surface again, with three fringe images a camera.")
    ] = False,
    picture: Annotated[Path | None, typer.Option(help="Write a PNG of what each camera found.")] = None,
    response: ResponseFile = None,
    settings: SettingsFile = None,
    set_: SetOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Is the specimen still where it was scanned? VALID, SUSPECT or STALE, in one line with the reason.

    Exit status 0 if VALID, 1 if not.
    """
    from fringescope import store
    from fringescope.devices import registry
    from fringescope.pipeline import watching
    from fringescope.types import Standing

    s = load_settings(settings, set_)
    stored = store.read_scan(existing(scan, "a scan folder"))
    if (hash_ := store.hash_rig(rig)) != stored.document.get("rig"):
        raise FormatError(f"{rig}: not the rig that this scan was made with ({hash_[:19]}..); needed that one")
    uri = device or stored.instrument
    if uri is None:
        raise UsageError("the scan does not tell which instrument took it; needed --device URI: fringescope devices")
    pictures = stored.every_picture()
    with Progress() as progress, registry.open_station(uri) as station:
        found = progress.run(
            "looking",
            lambda: watching.watch(
                station, stored.grids, pictures, store.read_rig(rig), s, noise=stored.noise(),
                gradients=stored.gradients() if remeasure else None, freed_by=load_response(response),
            ),
        )  # fmt: skip
    if picture is not None:
        from fringescope import report

        with store.new_file(picture, force=force) as tmp:
            store.write_png(tmp, report.watched_picture(found, pictures))
    emit(told(found), json, [f"{found.verdict.value}: {found.why}"])
    if found.verdict is not Standing.VALID:
        raise typer.Exit(1)


def told(found: Watched) -> dict[str, Any]:
    """A verdict as JSON values."""
    m = found.motion
    return {
        "verdict": found.verdict.value,
        "why": found.why,
        "by": found.by,
        "shift_mm": found.shift_mm,
        "p": found.p,
        "judged": found.judged,
        "motion": None
        if m is None
        else {
            "about": m.about,
            "move_mm": m.move_mm,
            "sigma_move_mm": m.sigma_move_mm,
            "turn_rad": m.turn_rad,
            "sigma_turn_rad": m.sigma_turn_rad,
            "largest_mm": m.largest_mm,
            "p": m.p,
        },
        "cameras": [
            {
                "camera": c.camera,
                "shift_mm": c.shift_mm,
                "at": c.at,
                "judged": c.judged,
                "changed": c.changed,
                "gain": c.gain,
                "note": c.note,
            }
            for c in found.cameras
        ],
    }
