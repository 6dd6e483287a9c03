"""A hub that is there to be killed: python -m tests.server.hub_process FOLDER PORT [DATABASE].

It keeps one made-up scan after the other in the case `SCANS`, and prints the identifier of each once it is kept.
"""

from __future__ import annotations

import asyncio
import hashlib
import secrets
import sys
import tempfile
from pathlib import Path

from fringescope.server import cases
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from fringescope.types.examination import RigChanged, ScanTaken
from fringescope.wire import PersonRole, Specimen
from tests.server.conftest import PASSWORD

STROKES, SCANS = "case-" + 20 * "a", "case-" + 20 * "b"
FILES = 6


def main(folder: Path, port: int, database: str | None) -> None:
    limits = Limits(ops_per_s=1e6, ops_burst=10**6, log_bytes_burst=10**9, logins_per_minute=1e6)
    with Server(Config(folder, port=port, database=database, limits=limits), fast_passwords=True) as server:
        if not server.site.accounts.any():
            for role in PersonRole:
                server.site.accounts.add(role.value, PASSWORD, role)
            run(server, furnish(server))
        print("ready", flush=True)
        while True:
            print(run(server, keep_one(server)), flush=True)


def run(server: Server, work: object) -> object:
    assert server.loop is not None
    return asyncio.run_coroutine_threadsafe(work, server.loop).result(60)  # type: ignore[arg-type]


async def furnish(server: Server) -> None:
    """Two cases, one with a scan to draw on."""
    hub = server.site.hub
    for name in (STROKES, SCANS):

        def insert(c: object, name: str = name) -> None:
            cases.insert(c, name, name, Specimen(), None, 1)  # type: ignore[arg-type]

        await hub.note(name, "hub", "operator", "opened", {}, insert)
        await hub.tell(name, RigChanged("rig"))
    await hub.tell(STROKES, ScanTaken("scan", "rig"))


async def keep_one(server: Server) -> str:
    """A scan of random files, kept as a real one is."""
    with tempfile.TemporaryDirectory(dir=server.config.data) as name:
        folder = Path(name)
        for k in range(FILES):
            (folder / f"part{k}.npy").write_bytes(secrets.token_bytes(150_000))
        scan = "sha256:" + hashlib.sha256((folder / "part0.npy").read_bytes()).hexdigest()
        await server.site.lab.keep(SCANS, "", folder, {"hash": scan, "rig": "rig"})
    return scan


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)
