"""backup, restore: a whole hub kept elsewhere, and back again."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Json, emit
from fringescope.cli.serving import HOME, Data, Database, needs_extra


@app.command()
def backup(
    out: Annotated[
        Path, typer.Option("--out", help="A new .zip file, or a folder that takes one backup after another.")
    ],
    data: Data = HOME,
    database: Database = None,
    json: Json = False,
) -> None:
    """All of a hub, kept elsewhere; it may run meanwhile. Keep it as safe as the hub: patients and keys are in it.

    With PostgreSQL run pg_dump first: the database is not in here then.
    """
    needs_extra()
    from fringescope.server.backup import back_up

    found = back_up(data, out, database)
    lines = [f"{found.where}: {found.files} files of scans, {found.new} of them new ({found.bytes / 1e6:.1f} MB)"]
    if found.database == "postgresql":
        lines.append("the database is not in it: keep the dump that pg_dump made before, beside it")
    lines += [f"file {x[:16]}.. is damaged or missing on the hub's disk; take it from an older backup"
              for x in found.damaged]  # fmt: skip
    emit(vars(found), json, lines)
    if found.damaged:
        raise typer.Exit(1)


@app.command()
def restore(
    backup: Annotated[Path, typer.Argument(help="A .zip file, or a folder of backups: its latest.")],
    data: Annotated[Path, typer.Option("--data", help="The hub's folder to make: a new or empty one.")],
    json: Json = False,
) -> None:
    """A hub's folder out of a backup; each file and the whole log are compared first."""
    needs_extra()
    from fringescope.server.backup import restore as bring_back

    found = bring_back(backup, data)
    made = datetime.datetime.fromtimestamp(found.made_ns / 1e9, datetime.UTC)
    lines = [f"{found.where}: as it was at {made:%Y-%m-%d %H:%M:%S} UTC; {found.events} events, {found.files} files"]
    if found.database == "postgresql":
        lines.append("now restore the database itself, with pg_restore")
    lines += [f"file {x[:16]}.. was missing already when the backup was made" for x in found.missing]
    lines += [f"the log, as it was backed up: {f}" for f in found.faults]
    emit(vars(found), json, lines)
    if found.missing or found.faults:
        raise typer.Exit(1)
