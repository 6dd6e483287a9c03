"""audit: the hub's log judged from outside, its signed checkpoints, and the key that they are believed by."""

from __future__ import annotations

import datetime
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Json, emit
from fringescope.cli.serving import HOME, Data, Database, needs_extra
from fringescope.errors import OutputError, UsageError

if TYPE_CHECKING:
    from fringescope.server.audit import Found


@app.command()
def audit(
    what: Annotated[str, typer.Argument(help="verify, checkpoint or key.")],
    data: Data = HOME,
    database: Database = None,
    checkpoints: Annotated[
        list[Path] | None, typer.Option(metavar="PATH", help="verify: also against this file or folder of checkpoints.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="PUBLIC.pem", help="verify: the key as you keep it, not as it lies there.")
    ] = None,
    files: Annotated[bool, typer.Option("--files", help="verify: read and compare the files of scans, too.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="checkpoint: the folder, key: the file, to keep elsewhere.")
    ] = None,
    json: Json = False,
) -> None:
    """A hub's log, judged: was any event altered, removed or added? Signed checkpoints of it; it may run meanwhile.

    Checkpoints and key that are kept on another machine also show what somebody did who rules this one.
    """
    needs_extra()
    from fringescope.server import audit as judge
    from fringescope.server import checkpoints as points

    if what not in ("verify", "checkpoint", "key"):
        raise UsageError(f"audit {what}; needed verify, checkpoint or key")
    if what == "verify" and out is not None:
        raise UsageError("audit verify takes no --out; checkpoint and key do")
    if what != "verify" and (checkpoints or key or files):
        raise UsageError(f"audit {what} takes no --checkpoints, --key or --files; verify does")
    if what == "key":
        _key(data, out, json)
        return
    engine = judge.open_readonly(data, database)
    try:
        if what == "verify":
            wanted = None if key is None else points.raw(points.read_public(key))
            found = judge.verify(engine, data, checkpoints or [], wanted, files)
            emit({**vars(found), "whole": found.whole}, json, _lines(found))
            if not found.whole:
                raise typer.Exit(1)
            return
        if out is None:
            raise UsageError("audit checkpoint: needed --out FOLDER, best on another machine's disk")
        file = points.export(engine, points.own_key(data), out, time.time_ns())
    finally:
        engine.dispose()
    emit({"checkpoint": str(file)}, json, [str(file)])


def _lines(found: Found) -> list[str]:
    if found.faults:
        return [*found.faults, f"NOT WHOLE: {len(found.faults)} faults in {found.events} events of {found.cases} cases"]
    when = "no checkpoint: a tail that was cut off would not be seen"
    if found.checkpoints:
        at = datetime.datetime.fromtimestamp(found.covered_ns / 1e9, datetime.UTC)
        when = f"{found.checkpoints} checkpoints, the latest of {at:%Y-%m-%d %H:%M:%S} UTC"
    return [f"whole: {found.events} events of {found.cases} cases; {when}"]


def _key(data: Path, out: Path | None, json: bool) -> None:
    from fringescope.server import checkpoints as points
    from fringescope.store import new_file

    if not data.is_dir():
        raise UsageError(f"{data}: no hub's folder; start one first: fringescope serve --data {data}")
    public = points.own_key(data).public_key()
    pem, name = points.public_pem(public).decode(), points.fingerprint(points.raw(public))
    if out is not None:
        if out.exists():
            raise OutputError(f"{out}: exists; choose another name")
        with new_file(out) as tmp:
            tmp.write_text(pem)
    lines = [pem.strip() if out is None else str(out), f"fingerprint: {name}"]
    emit({"key": pem, "fingerprint": name, "file": None if out is None else str(out)}, json, lines)
