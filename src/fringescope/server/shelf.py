"""Where scans and rigs lie, for who reads folders: laid out from the files of a case when they are asked for."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa

from fringescope.errors import DeviceError, UsageError
from fringescope.server import cases
from fringescope.server.blobs import Blobs
from fringescope.store import hash_rig


class Shelf:
    """The folders of a hub. `rig` is the file of the rig in use, None where there is none yet."""

    def __init__(self, data: Path, engine: sa.Engine, blobs: Blobs, rig: Path | None) -> None:
        self.data, self._engine, self._blobs = data, engine, blobs
        active = data / "rigs" / "active"
        self.rig = active.with_name(active.read_text()) if rig is None and active.exists() else rig

    @contextmanager
    def work(self, prefix: str) -> Iterator[Path]:
        """A folder for work under way, gone afterwards."""
        (self.data / "work").mkdir(exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=self.data / "work", prefix=f"{prefix}-"))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def rig_file(self) -> Path:
        """The rig in use. Raises DeviceError where there is none."""
        if self.rig is None:
            raise DeviceError("this hub has no rig; calibrate the instrument, or name its rig with --rig")
        return self.rig

    def use_rig(self, made: Path, page: Path) -> None:
        """Keeps a new rig with its report, and uses it from now on."""
        rigs = self.data / "rigs"
        rigs.mkdir(exist_ok=True)
        kept = rigs / f"{hash_rig(made).removeprefix('sha256:')}.json"
        shutil.copyfile(made, kept)
        shutil.copyfile(page, kept.with_suffix(".html"))
        (rigs / "active").write_text(kept.name)
        self.rig = kept

    async def rig_of(self, case: str, scan: str) -> Path:
        """The rig that a scan was made with. Raises UsageError if it is not here."""
        found = await asyncio.to_thread(cases.scans_of, self._engine, case)
        rig = next((x.rig for x in found if x.id == scan), "")
        kept = self.data / "rigs" / f"{rig.removeprefix('sha256:')}.json"
        if kept.exists():
            return kept
        if hash_rig(self.rig_file()) != rig:
            raise UsageError(f"scan {scan[7:19]} was made with another rig, which is not here; scan again")
        return self.rig_file()

    async def scan(self, case: str, scan: str) -> Path:
        """A scan of a case as a folder. Raises UsageError where there is none."""
        files = (await asyncio.to_thread(cases.files_of, self._engine, case, scan)).get(scan)
        if not files:
            raise UsageError(f"case {case} has no scan {scan[:19]}; scan again")
        return await asyncio.to_thread(cases.lay_out, self._blobs, files, self.data, case, scan)
