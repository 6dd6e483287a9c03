"""Cases, their scans and files: what lies beside the log."""

from __future__ import annotations

import mimetypes
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from fringescope.errors import UsageError
from fringescope.server import database as db
from fringescope.server.blobs import Blobs
from fringescope.wire import Case, ScanFile, ScanInfo, Specimen, Status
from fringescope.wire.documents import Patient

LAID_OUT = "laid-out"  #: folders of scans, for who reads folders
_TYPES = {".glb": "model/gltf-binary", ".ply": "application/octet-stream", ".npy": "application/octet-stream",
          ".json": "application/json"}  # fmt: skip


def type_of(name: str) -> str:
    """The media type of a file."""
    return _TYPES.get(Path(name).suffix.lower()) or mimetypes.guess_type(name)[0] or "application/octet-stream"


def insert(c: sa.Connection, case: str, accession: str, specimen: Specimen, patient: Patient | None, at: int) -> None:
    """A new case."""
    c.execute(
        db.cases.insert().values(
            id=case, accession=accession, status="open", specimen=specimen.model_dump(), created_ns=at, changed_ns=at
        )
    )
    if patient is not None:
        c.execute(db.patients.insert().values(case_id=case, **patient.model_dump()))


def change(
    c: sa.Connection, case: str, status: str | None, specimen: Specimen | None, patient: Patient | None, at: int
) -> None:
    """What changes of a case."""
    values: dict[str, Any] = {"changed_ns": at}
    if status is not None:
        values["status"] = status
    if specimen is not None:
        values["specimen"] = specimen.model_dump()
    c.execute(db.cases.update().where(db.cases.c.id == case).values(values))
    if patient is not None:
        c.execute(db.patients.delete().where(db.patients.c.case_id == case))
        c.execute(db.patients.insert().values(case_id=case, **patient.model_dump()))


def _select() -> Any:
    counted = (
        sa.select(sa.func.count()).select_from(db.scans).where(db.scans.c.case_id == db.cases.c.id).scalar_subquery()
    )
    last = sa.select(sa.func.max(db.events.c.seq)).where(db.events.c.case_id == db.cases.c.id).scalar_subquery()
    return sa.select(db.cases, counted.label("scans"), sa.func.coalesce(last, 0).label("seq"))


def _case(row: Any, patient: Patient | None) -> Case:
    return Case(
        id=row.id, accession=row.accession, status=Status(row.status), specimen=Specimen(**row.specimen),
        patient=patient, created_ns=row.created_ns, changed_ns=row.changed_ns, scans=row.scans, seq=row.seq,
    )  # fmt: skip


def get(engine: sa.Engine, case: str, with_patient: bool = False) -> Case | None:
    """A case."""
    with db.reading(engine) as c:
        row = c.execute(_select().where(db.cases.c.id == case)).first()
        if row is None:
            return None
        p = c.execute(sa.select(db.patients).where(db.patients.c.case_id == case)).first() if with_patient else None
    return _case(row, Patient(name=p.name, identifier=p.identifier, born=p.born) if p else None)


def search(
    engine: sa.Engine,
    words: str,
    status: str | None,
    limit: int,
    offset: int,
    member: str | None,
    patients: bool,
    only: str | None = None,
) -> tuple[int, list[Case]]:
    """Cases whose accession number, specimen or (for who may see it) patient holds all the words, the latest first.

    `member`: those that this person was let into; `only`: the one that a guest was invited to.
    """
    where: list[Any] = []
    text = sa.cast(db.cases.c.specimen, sa.Text)
    for word in words.split()[:10]:
        like = f"%{word.replace('!', '!!').replace('%', '!%').replace('_', '!_')}%"
        found = [db.cases.c.accession.ilike(like, escape="!"), text.ilike(like, escape="!")]
        if patients:
            named = sa.or_(db.patients.c.name.ilike(like, escape="!"), db.patients.c.identifier.ilike(like, escape="!"))
            found.append(db.cases.c.id.in_(sa.select(db.patients.c.case_id).where(named)))
        where.append(sa.or_(*found))
    if status is not None:
        where.append(db.cases.c.status == status)
    if member is not None:
        where.append(db.cases.c.id.in_(sa.select(db.members.c.case_id).where(db.members.c.person_id == member)))
    if only is not None:
        where.append(db.cases.c.id == only)
    with db.reading(engine) as c:
        total = c.execute(sa.select(sa.func.count()).select_from(db.cases).where(*where)).scalar() or 0
        asked = _select().where(*where).order_by(db.cases.c.changed_ns.desc(), db.cases.c.id)
        rows = list(c.execute(asked.limit(limit).offset(offset)))
    return total, [_case(r, None) for r in rows]


def is_member(engine: sa.Engine, case: str, person: str) -> bool:
    """Whether somebody was let into a case."""
    with db.reading(engine) as c:
        asked = sa.select(db.members).where(db.members.c.case_id == case, db.members.c.person_id == person)
        return c.execute(asked).first() is not None


def members_of(engine: sa.Engine, case: str) -> list[str]:
    """Who was let into a case."""
    with db.reading(engine) as c:
        asked = sa.select(db.members.c.person_id).where(db.members.c.case_id == case).order_by(db.members.c.person_id)
        return [r.person_id for r in c.execute(asked)]


def let_in(c: sa.Connection, case: str, person: str) -> None:
    """One member more."""
    c.execute(db.members.insert().values(case_id=case, person_id=person))


def let_out(c: sa.Connection, case: str, person: str) -> None:
    """One member less."""
    c.execute(db.members.delete().where(db.members.c.case_id == case, db.members.c.person_id == person))


def erase(c: sa.Connection, case: str, at: int) -> None:
    """Takes out all that says something of a case but its events: words, patient, specimen, scans, what jobs found."""
    of_it = (db.events.c.case_id == case, db.events.c.kind == "erased", db.events.c.refused == "")
    last = sa.select(sa.func.max(db.events.c.seq)).where(*of_it).scalar_subquery()
    for table in (db.payloads, db.patients, db.scans, db.blobs, db.members):
        kept = [table.c.seq < last] if table is db.payloads else []  # the erasure itself tells why
        c.execute(table.delete().where(table.c.case_id == case, *kept))
    c.execute(db.invitations.update().where(db.invitations.c.case_id == case).values(name="", revoked=True))
    ended = {"result": sa.null(), "why": "", "stage": ""}
    c.execute(db.jobs.update().where(db.jobs.c.case_id == case).values(ended))
    values = {"accession": f"erased {case[-6:]}", "status": "erased", "specimen": Specimen().model_dump(),
              "changed_ns": at}  # fmt: skip
    c.execute(db.cases.update().where(db.cases.c.id == case).values(values))


def is_erased(engine: sa.Engine, case: str) -> bool:
    """Whether a case was erased."""
    with db.reading(engine) as c:
        return c.execute(sa.select(db.cases.c.status).where(db.cases.c.id == case)).scalar() == Status.ERASED.value


# -------------------------------------------------------------------------------------------------------------- files


def drop_files(engine: sa.Engine, blobs: Blobs, hashes: Sequence[str]) -> int:
    """Removes files that no case has any more; returns how many."""
    gone = 0
    for sha256 in set(hashes):
        with db.reading(engine) as c:
            used = c.execute(sa.select(db.blobs.c.case_id).where(db.blobs.c.sha256 == sha256).limit(1)).first()
        if used is None:
            blobs.remove(sha256)
            gone += 1
    return gone


def keep_files(blobs: Blobs, files: dict[str, Path]) -> list[ScanFile]:
    """Takes files in, by name. Raises OutputError where the disk is full."""
    out = []
    for name, path in files.items():
        sha256, size = blobs.put(path)
        out.append(ScanFile(name=name, sha256=sha256, size=size, type=type_of(name)))
    return out


def insert_files(c: sa.Connection, case: str, owner: str, files: Sequence[ScanFile]) -> None:
    """Files of a case, known by their owner and name."""
    if files:
        rows = [{"case_id": case, "owner": owner, **f.model_dump()} for f in files]
        c.execute(db.blobs.insert(), rows)


def files_of(engine: sa.Engine, case: str, owner: str | None = None) -> dict[str, list[ScanFile]]:
    """Files of a case, by owner."""
    asked = sa.select(db.blobs).where(db.blobs.c.case_id == case).order_by(db.blobs.c.owner, db.blobs.c.name)
    if owner is not None:
        asked = asked.where(db.blobs.c.owner == owner)
    out: dict[str, list[ScanFile]] = {}
    with db.reading(engine) as c:
        for r in c.execute(asked):
            out.setdefault(r.owner, []).append(ScanFile(name=r.name, sha256=r.sha256, size=r.size, type=r.type))
    return out


def file_type(engine: sa.Engine, case: str, sha256: str) -> tuple[str, str] | None:
    """Name and type of a file, if it belongs to a case."""
    with db.reading(engine) as c:
        r = c.execute(sa.select(db.blobs).where(db.blobs.c.case_id == case, db.blobs.c.sha256 == sha256)).first()
    return (r.name, r.type) if r else None


def insert_scan(c: sa.Connection, scan: ScanInfo) -> None:
    """A scan and its files."""
    row = scan.model_dump(exclude={"files", "case"})
    c.execute(db.scans.insert().values(**row, case_id=scan.case))
    insert_files(c, scan.case, scan.id, scan.files)


def scans_of(engine: sa.Engine, case: str) -> list[ScanInfo]:
    """The scans of a case, in the order in which they were taken."""
    with db.reading(engine) as c:
        rows = list(c.execute(sa.select(db.scans).where(db.scans.c.case_id == case).order_by(db.scans.c.taken_ns)))
    files = files_of(engine, case)  # behind the scans: each came together with its files
    return [
        ScanInfo(id=r.id, case=case, rig=r.rig, label=r.label, taken_ns=r.taken_ns, files=files.get(r.id, []),
                 figures=r.figures)
        for r in rows
    ]  # fmt: skip


def lay_out(blobs: Blobs, files: Sequence[ScanFile], data: Path, case: str, scan: str) -> Path:
    """The folder of a scan under a hub's `data`: each case has its own, so that none can slip a file under another's.

    Raises UsageError for identifiers that would lead elsewhere.
    """
    names = case, scan.replace("sha256:", "")[:32]
    if not all(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9-]*", n) for n in names):
        raise UsageError(f"case {case[:80]!r}, scan {scan[:80]!r}: needed identifiers")
    return laid_out(blobs, files, data / LAID_OUT / names[0] / names[1])


def laid_out(blobs: Blobs, files: Sequence[ScanFile], folder: Path) -> Path:
    """Files as a folder, for who reads folders: links to the same content where the disk can do that.

    Raises UsageError for a name that would lie outside.
    """
    import os
    import shutil

    folder.mkdir(parents=True, exist_ok=True)
    for f in files:
        target = folder / f.name
        if not target.resolve().is_relative_to(folder.resolve()):
            raise UsageError(f"a file of the name {f.name!r}; needed one inside its scan")
        if target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(blobs.path(f.sha256), target)
        except OSError:
            half = target.with_name(f"{target.name}.{os.getpid()}.half")  # whole or not at all, whenever we are killed
            shutil.copyfile(blobs.path(f.sha256), half)
            half.replace(target)
    return folder
