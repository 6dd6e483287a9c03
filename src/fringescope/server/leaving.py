"""Cases that leave as bundles and come back in, scans that were made elsewhere, and cases that are erased.

Long work is done in a process of its own and in threads; one thing at a time. An erasure takes out the words of all
events, the patient, the specimen's texts, the scans and their files; the events themselves stay, so the chain holds.
What was exported or backed up before still has it: see `erase`.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import json
import os
import secrets
import shutil
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from fringescope.errors import FormatError, OutputError, UsageError
from fringescope.server import bundle as bundled
from fringescope.server import cases, journal
from fringescope.server import database as db
from fringescope.server.accounts import Accounts
from fringescope.server.blobs import Blobs
from fringescope.server.checkpoints import Checkpoints, fingerprint, raw
from fringescope.server.config import Config
from fringescope.server.hub import Hub
from fringescope.server.instrument import Instrument
from fringescope.server.jobs import Jobs, Tell
from fringescope.server.lab import Lab
from fringescope.server.processes.parent import Child
from fringescope.server.rooms import ERASED
from fringescope.server.unpacking import Unpacked
from fringescope.wire import Case, Record, Specimen, link
from fringescope.wire.documents import Patient

_SPARE = 256 << 20  #: bytes of the disk that must stay free
_BATCH = 500
_ERASING = "erasing-"  #: a file of the hub's folder while a case is erased: what has to go


class HereAlreadyError(UsageError):
    """A case or scan that comes in is here already."""


class Leaving:
    """What goes out of a hub and comes into it as files. Lives on one event loop."""

    def __init__(
        self, config: Config, hub: Hub, blobs: Blobs, accounts: Accounts, jobs: Jobs, instrument: Instrument,
        lab: Lab, checkpoints: Checkpoints, packer: Child,
    ):  # fmt: skip
        self._config, self._hub, self._blobs, self._accounts = config, hub, blobs, accounts
        self._jobs, self._instrument, self._lab, self._key = jobs, instrument, lab, checkpoints.key
        self._packer = packer
        self._turn = asyncio.Lock()
        self.taking: Counter[str] = Counter()  #: bundles on their way out, by who takes them

    async def stop(self) -> None:
        """Ends what is going on."""
        await self._packer.kill()

    @contextlib.contextmanager
    def folder(self) -> Iterator[Path]:
        """A folder for work, which goes at the end. Raises OutputError where it cannot be made."""
        work = self._config.data / "work"
        try:
            work.mkdir(exist_ok=True)
            made = Path(tempfile.mkdtemp(dir=work, prefix="leave-"))
        except OSError as e:
            raise OutputError(f"{work}: {e.strerror}") from e
        try:
            yield made
        finally:
            shutil.rmtree(made, ignore_errors=True)

    def check_room(self, size: int) -> None:
        """Raises OutputError where the disk has no room for so many bytes."""
        free = self._blobs.free_bytes()
        if free < size + _SPARE:
            raise OutputError(f"the hub's disk has {free} bytes left; {size + _SPARE} are needed: make room, try again")

    # -------------------------------------------------------------------------------------------------------- bundles

    async def bundle(self, case: Case, patient: Patient | None, folder: Path) -> Path:
        """A case as one file in `folder`. Raises UsageError for one that was erased, FormatError and OutputError."""
        async with self._turn:
            g = await asyncio.to_thread(
                bundled.gather, self._hub.engine, case, folder / bundled.EVENTS, self._config.settings.examination
            )
            files = [f for s in g.scans for f in s.files] + [f for found in g.kept.values() for f in found]
            self.check_room(2 * sum(f.size for f in files))
            names = {p: known.name for p in g.actors if (known := self._accounts.person(p)) is not None}
            people = bundled.people_of(g, names)
            made_ns = self._hub.clock.now_ns()
            made = await asyncio.to_thread(self._prepare, g, folder, people, made_ns, patient)
            stl = await self._packed("leave", asked=str(folder / "asked.json"), report_pdf=str(folder / bundled.REPORT))
            made |= {f"scans/{Path(x).stem}/surface.stl": Path(x) for x in stl}
            made[bundled.REPORT] = folder / bundled.REPORT
            head = {"made_ns": made_ns, "people": people,
                    "patient": None if patient is None else patient.model_dump()}  # fmt: skip
            out = folder / "bundle.zip"
            await asyncio.to_thread(bundled.write, out, g, made, self._blobs, head, self._key)
            return out

    def _prepare(
        self, g: bundled.Gathered, folder: Path, people: dict[str, Any], made_ns: int, patient: Patient | None
    ) -> dict[str, Path]:
        """The files for people that need no computing, and what the packer is asked for."""
        made = {bundled.EVENTS: folder / bundled.EVENTS}
        for k, (name, doc) in enumerate(bundled.strokes_files(g).items()):
            made[name] = folder / f"strokes-{k}.json"
            made[name].write_text(json.dumps(doc, indent=1))
        laid = {s.id: cases.lay_out(self._blobs, s.files, self._config.data, g.case.id, s.id) for s in g.scans}
        stl = [
            (str(laid[s.id] / "surface.glb"), str(folder / f"{n}.stl")) for n, s in enumerate(g.scans, 1)
            if (laid[s.id] / "surface.glb").is_file()
        ]  # fmt: skip
        told = bundled.report_document(g, people, made_ns, patient, self._blobs, laid)
        (folder / "asked.json").write_text(json.dumps({"report": told, "stl": stl}))
        return made

    async def take_in(self, file: Path, person: str, role: str) -> str:
        """A bundle becomes a case, with the same events, files and scans; its identifier.

        Raises HereAlreadyError where it is here, FormatError with a sentence for what is altered, too large or no
        bundle, OutputError where the disk is full. Nothing of it is kept then.
        """
        async with self._turn:
            found, new, write = await asyncio.to_thread(self._read, file, person, role)
            try:
                await self._hub.take_in(found.case.id, write)
            except (sa.exc.SQLAlchemyError, OverflowError) as e:
                await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, new)
                raise FormatError(f"the bundle: it cannot be kept: {type(e).__name__}; nothing was changed") from e
            except BaseException:
                await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, new)
                raise
        return found.case.id

    def _read(
        self, file: Path, person: str, role: str
    ) -> tuple[bundled.Manifest, list[str], Callable[[sa.Connection], None]]:
        limit = self._config.limits.upload_bytes
        with Unpacked(file, limit, "the bundle") as z:
            m = bundled.read_manifest(z)
            self._refuse_twice(m.case.id)
            self.check_room(sum(f.size for f in m.files))
            now = self._hub.clock.now_ns()
            bundled.check_log(z, m, self._config.settings.examination, now)
            new = []
            try:
                for f in m.files:
                    if f.owner:
                        if not self._blobs.has(f.sha256):
                            new.append(f.sha256)
                        with z.open(f.path) as source:
                            if self._blobs.put(source) != (f.sha256, f.size):  # type: ignore[arg-type]
                                raise FormatError(f"the bundle: {f.path[:80]!r} changed while it was read")
            except BaseException:
                cases.drop_files(self._hub.engine, self._blobs, new)
                raise
        own = m.key == raw(self._key.public_key())
        people = {k: v.model_dump() for k, v in m.people.items()}
        told = {"from": m.software, "made_ns": m.made_ns, "key": m.key, "fingerprint": fingerprint(m.key), "own": own,
                "people": people}  # fmt: skip

        def write(c: sa.Connection) -> None:
            self._write(c, file, m, told, person, role, now)

        return m, new, write

    def _refuse_twice(self, case: str) -> None:
        if cases.get(self._hub.engine, case) is not None:
            raise HereAlreadyError(f"case {case} is here already; nothing was changed")

    def _write(
        self, c: sa.Connection, file: Path, m: bundled.Manifest, told: dict[str, Any], person: str, role: str, now: int
    ) -> None:
        """All rows of a case that comes in, as part of a transaction."""
        case = m.case.id
        if c.execute(sa.select(db.cases.c.id).where(db.cases.c.id == case)).first() is not None:
            raise HereAlreadyError(f"case {case} is here already; nothing was changed")
        cases.insert(c, case, m.case.accession, Specimen(**m.case.specimen.model_dump()), m.patient, m.case.created_ns)
        c.execute(db.cases.update().where(db.cases.c.id == case).values(status=m.case.status, changed_ns=now))
        for s in m.scans:
            c.execute(db.scans.insert().values(case_id=case, **s.model_dump(exclude={"folder"})))
        rows = [
            {"case_id": case, "owner": f.owner, "name": f.name, "sha256": f.sha256, "size": f.size,
             "type": cases.type_of(f.name)} for f in m.files if f.owner
        ]  # fmt: skip
        if rows:
            c.execute(db.blobs.insert(), rows)
        batch: list[Record] = []
        last = 0
        with Unpacked(file, self._config.limits.upload_bytes, "the bundle") as z:
            for r in bundled.records(z, case):
                batch.append(r)
                last = max(last, r.at_ns)
                if len(batch) >= _BATCH:
                    journal.append(c, batch)
                    batch = []
        record = Record(
            case, m.seq + 1, max(now, last + 1), 0, person, role, f"import-{secrets.token_hex(8)}", 1, "imported", "",
            secrets.token_hex(16), told, "", "",
        )  # fmt: skip
        journal.append(c, [*batch, link(record, m.head)])

    # ---------------------------------------------------------------------------------------------------------- scans

    async def add_scan(self, case: str, file: Path, label: str, present: bool | None, tell: Tell) -> dict[str, Any]:
        """A scan's folder, as a zip file, into a case: also one made before scans kept photographs.

        `present`: whether the case goes on with it, so that strokes can be drawn on it; None: if it has none yet.
        Raises FormatError for what is no scan or is damaged, HereAlreadyError, UsageError and OutputError.
        """
        async with self._turn:
            truth, _ = await self._hub.truth_of(case)
            if present is None:
                present = not truth.exam.scan
            if present and self._hub.lit(case):
                raise UsageError("the projector shows a guideline of this case; stop it, then add the scan")
            with self.folder() as work:
                tell("unpacking", 0.05)
                folder = await asyncio.to_thread(self._unpack_scan, file, work / "scan")
                doc = await self._look_at(folder, tell)
                if doc["hash"] in truth.scans:
                    raise HereAlreadyError(f"scan {doc['hash'][:19]} is in this case already")
                tell("keeping", 0.9)
                taken = _time_of(doc.get("created"))
                return await self._lab.keep(case, label, folder, doc, taken, present)

    async def _look_at(self, folder: Path, tell: Tell) -> dict[str, Any]:
        doc: dict[str, Any] = await self._packed(
            "examine", lambda stage, share: tell(stage, 0.1 + 0.8 * share), folder=str(folder)
        )
        return doc

    async def _packed(self, name: str, tell: Tell | None = None, **args: Any) -> Any:
        """Has the packer do something; it ends if nobody waits for it any more."""
        try:
            return await self._packer.call(name, tell, **args)
        except asyncio.CancelledError:
            await asyncio.shield(self._packer.restart())
            raise

    def _unpack_scan(self, file: Path, to: Path) -> Path:
        with Unpacked(file, self._config.limits.upload_bytes, "the scan") as z:
            roots = [n[: -len("scan.json")] for n in z.entries if n.split("/")[-1] == "scan.json"]
            if len(roots) != 1 or roots[0].count("/") > 1:
                raise FormatError("the scan: needed one folder with its scan.json, as a zip file")
            doc = z.json(f"{roots[0]}scan.json", 64 << 20)
            listed = doc.get("files")
            if not isinstance(listed, dict):
                raise FormatError('the scan: scan.json lists no "files"; zip the whole folder')
            self.check_room(2 * sum(i.file_size for i in z.entries.values()))
            for name in [*listed, "scan.json"]:  # what else lies there is not taken
                z.extract(roots[0] + name, to / name)
        return to

    # -------------------------------------------------------------------------------------------------------- erasure

    async def erase(self, case: str, person: str, role: str, why: str) -> dict[str, int]:
        """Takes a case out, but for its chain; how many events and files were emptied. Raises UsageError.

        Bundles, exported checkpoints (hashes alone) and backups that were made before are elsewhere: backups keep
        what was erased until they are thrown away. Nobody's words are left in free pages of SQLite.
        """
        async with self._turn:
            if self._hub.lit(case):
                raise UsageError("a guideline of this case is projected; stop it, then erase the case")
            await self._jobs.cancel_all(case)
            files = await asyncio.to_thread(cases.files_of, self._hub.engine, case)
            guests = await asyncio.to_thread(self._guests, case)
            await self._instrument.forget(case)
            at = self._hub.clock.now_ns()
            hashes = [f.sha256 for found in files.values() for f in found]
            await asyncio.to_thread(_note_down, self._config.data, case, hashes)  # for who comes after a power cut
            said = await self._hub.note(
                case, person, role, "erased", {"why": why}, after=lambda c: cases.erase(c, case, at)
            )
            if said.refused:
                (self._config.data / f"{_ERASING}{case}.json").unlink(missing_ok=True)
                raise UsageError(said.refused) if said.seq else OutputError(said.refused)
            self._hub.rooms.close(case, ERASED)
            self._hub.forget(case)
            gone = await asyncio.to_thread(sweep, self._config.data, self._hub.engine, self._blobs, case, hashes)
            for guest in guests:
                await asyncio.to_thread(self._accounts.change, guest, disabled=True)
        return {"events": (said.seq or 1) - 1, "files": gone}

    def _guests(self, case: str) -> list[str]:
        with db.reading(self._hub.engine) as c:
            asked = sa.select(db.people.c.id).where(db.people.c.case_id == case, sa.not_(db.people.c.disabled))
            return [r.id for r in c.execute(asked)]


def _note_down(data: Path, case: str, hashes: list[str]) -> None:
    file = data / f"{_ERASING}{case}.json"
    try:
        with file.open("w") as out:
            json.dump(hashes, out)
            out.flush()
            os.fsync(out.fileno())
    except OSError as e:
        raise OutputError(f"{file}: {e.strerror}; nothing was erased") from e


def sweep(data: Path, engine: sa.Engine, blobs: Blobs, case: str, hashes: list[str]) -> int:
    """Takes away the files of a case that was erased; how many."""
    gone = cases.drop_files(engine, blobs, hashes)
    shutil.rmtree(data / cases.LAID_OUT / case, ignore_errors=True)
    db.forget_erased(engine)
    (data / f"{_ERASING}{case}.json").unlink(missing_ok=True)
    return gone


def finish_erasures(data: Path, engine: sa.Engine, blobs: Blobs) -> None:
    """Ends the erasures in the middle of which a hub was killed: those whose event was written."""
    for file in data.glob(f"{_ERASING}*.json"):
        case = file.stem[len(_ERASING) :]
        try:
            hashes = [str(h) for h in json.loads(file.read_text())]
        except (OSError, ValueError, TypeError):
            hashes = []  # it was killed while it wrote this down, before anything was erased
        if cases.is_erased(engine, case):
            sweep(data, engine, blobs, case, hashes)
        else:
            file.unlink(missing_ok=True)


def _time_of(created: Any) -> int | None:
    try:
        made = datetime.datetime.fromisoformat(str(created))
    except ValueError:
        return None
    return int(made.timestamp() * 1e9) if made.year > 1970 else None


async def received(stream: AsyncIterator[bytes], to: Path, most: int) -> int:
    """Writes a body to a file, a piece at a time. Raises FormatError past `most` bytes, OutputError for a full disk."""
    size = 0
    try:
        with to.open("wb") as out:
            async for piece in stream:
                size += len(piece)
                if size > most:
                    raise FormatError(f"more than {most} bytes; no more are taken")
                await asyncio.to_thread(out.write, piece)
    except OSError as e:
        raise OutputError(f"the hub's disk: {e.strerror}; nothing was kept") from e
    return size
