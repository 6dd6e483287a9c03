"""A whole hub kept elsewhere, and back again; it may run meanwhile.

A backup is a zip file, or a folder that holds one backup after another: each with its own copy of the database, all
with one store of scans' files, into which only what is new is copied. It holds all that a hub knows: patients, the
hashes of passwords, and the key that signs checkpoints. Keep it as you keep the hub. It does not hold sessions, TLS
keys, or work that was not done.

The order makes it whole: first key and checkpoints, then the database at one instant (SQLite's own backup), then the
files that it names, which never change. What is erased on the hub later stays in backups made before: throw them away.

With PostgreSQL the database is not in here: dump it with pg_dump first, then make this backup, which then holds every
file that the dump names; to come back, restore this folder, then the dump with pg_restore.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import secrets
import shutil
import sqlite3
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa

from fringescope import __version__
from fringescope.errors import FormatError, OutputError
from fringescope.server import audit, checkpoints
from fringescope.server import database as db
from fringescope.server.unpacking import Unpacked, parsed
from fringescope.store.files import check_relative, new_file, read_json

FORMAT, VERSION = "fringescope-backup", 1
MANIFEST, DATABASE, BLOBS = "backup.json", "hub.sqlite", "files"
_BESIDE = (checkpoints.KEY, checkpoints.PUBLIC, "twin-rig.json")
_PIECE = 1 << 20
_TRIES = 3
_MANY = 1 << 62


@dataclass
class Kept:
    """What a backup holds. `damaged`: files that are no longer on the hub's disk as they should be."""

    where: str
    database: str
    files: int = 0
    new: int = 0
    bytes: int = 0
    damaged: list[str] = field(default_factory=list)


class _ErasedMeanwhileError(Exception):
    """A case was erased between the copy of the database and that of its files: once more."""


def back_up(data: Path, out: Path, url: str | None = None) -> Kept:
    """Makes a backup of the hub in `data`: a new zip file, or one more backup in a folder.

    Raises FormatError where there is no hub, OutputError where it cannot be written.
    """
    postgres = url is not None and sa.make_url(url).get_backend_name() != "sqlite"
    source = None if postgres else (data / DATABASE if url is None else Path(sa.make_url(url).database or ""))
    if source is not None and not source.is_file():
        raise FormatError(f"{source}: no hub's database; name its folder with --data")
    try:
        for _ in range(_TRIES):
            try:
                if out.suffix == ".zip":
                    with new_file(out) as tmp:
                        tmp.touch(0o600)
                        found = _into_zip(data, tmp, source, url)
                    out.chmod(0o600)
                    found.where = str(out)
                    return found
                return _into_folder(data, out, source, url)
            except _ErasedMeanwhileError:
                continue
    except OSError as e:
        raise OutputError(f"{out}: {e.strerror or e}; the backup is not whole: make room, and make it again") from e
    raise OutputError(f"{out}: cases were erased while the backup was made; make it again")


@contextmanager
def _staged(
    data: Path, source: Path | None, url: str | None, near: Path
) -> Iterator[tuple[Path, list[tuple[str, int]]]]:
    """A folder with all that is small, and the files that the database names."""
    near.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=near, prefix=".staged-") as name:
        stage = Path(name)
        for beside in _BESIDE:
            if (data / beside).is_file():
                shutil.copyfile(data / beside, stage / beside)
        if (data / "rigs").is_dir():
            shutil.copytree(data / "rigs", stage / "rigs")
        for file in sorted((data / checkpoints.FOLDER).glob("*.jsonl")):
            whole = file.read_bytes()
            (stage / checkpoints.FOLDER).mkdir(exist_ok=True)
            (stage / checkpoints.FOLDER / file.name).write_bytes(whole[: whole.rfind(b"\n") + 1])
        if source is not None:
            _copy_database(source, stage / DATABASE)
        engine = audit.open_readonly(stage if source is not None else data, None if source is not None else url)
        try:
            with db.reading(engine) as c:
                asked = sa.select(db.blobs.c.sha256, sa.func.max(db.blobs.c.size)).group_by(db.blobs.c.sha256)
                yield stage, [(str(s), int(n)) for s, n in c.execute(asked.order_by(db.blobs.c.sha256))]
        except sa.exc.DatabaseError as e:
            raise FormatError(f"{data}: the database cannot be read: {e.orig}") from e
        finally:
            engine.dispose()


def _copy_database(source: Path, to: Path) -> None:
    """One instant of a database that may be written meanwhile, without its sessions."""
    try:
        with (
            closing(sqlite3.connect(f"file:{quote(str(source.resolve()))}?mode=ro", uri=True, timeout=30)) as live,
            closing(sqlite3.connect(to)) as copy,
        ):
            live.backup(copy)
            copy.execute("PRAGMA secure_delete=ON")
            copy.execute("PRAGMA journal_mode=DELETE")
            with copy:
                copy.execute("DELETE FROM sessions")
            if (found := copy.execute("PRAGMA integrity_check").fetchone()[0]) != "ok":
                raise FormatError(f"{source}: SQLite finds it damaged: {str(found).splitlines()[0][:200]}")
    except sqlite3.Error as e:
        raise FormatError(f"{source}: cannot be copied: {e}") from e


def _manifest(stage: Path, blobs: list[tuple[str, int]], database: str) -> dict[str, Any]:
    small = [p for p in sorted(stage.rglob("*")) if p.is_file()]
    files = [{"path": p.relative_to(stage).as_posix(), "sha256": _hash(p), "size": p.stat().st_size} for p in small]
    return {"format": FORMAT, "version": VERSION, "software": f"fringescope {__version__}", "made_ns": time.time_ns(),
            "database": database, "files": files, "blobs": [list(b) for b in blobs]}  # fmt: skip


def _hash(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def _blob(data: Path, sha256: str, url: str | None) -> Path:
    """Where a file lies. Raises _ErasedMeanwhileError if the hub does not know it any more."""
    path = data / BLOBS / sha256[:2] / sha256
    if not path.is_file():
        engine = audit.open_readonly(data, url)
        try:
            with db.reading(engine) as c:
                known = c.execute(sa.select(db.blobs.c.name).where(db.blobs.c.sha256 == sha256).limit(1)).first()
        finally:
            engine.dispose()
        if known is None:
            raise _ErasedMeanwhileError
    return path


def _into_zip(data: Path, tmp: Path, source: Path | None, url: str | None) -> Kept:
    with _staged(data, source, url, tmp.parent) as (stage, blobs), zipfile.ZipFile(tmp, "w", allowZip64=True) as z:
        found = Kept(str(tmp), "sqlite" if source is not None else "postgresql")
        doc = _manifest(stage, blobs, found.database)
        for f in doc["files"]:
            z.write(stage / f["path"], f["path"], zipfile.ZIP_DEFLATED)
        for sha256, size in blobs:
            path = _blob(data, sha256, url)
            digest = hashlib.sha256()
            try:
                with path.open("rb") as content, z.open(f"{BLOBS}/{sha256}", "w", force_zip64=True) as to:
                    while piece := content.read(_PIECE):
                        digest.update(piece)
                        to.write(piece)
            except FileNotFoundError:
                found.damaged.append(sha256)
                continue
            if digest.hexdigest() != sha256:
                found.damaged.append(sha256)
            found.files, found.new, found.bytes = found.files + 1, found.new + 1, found.bytes + size
        z.writestr(MANIFEST, json.dumps({**doc, "damaged": found.damaged}))
    return found


def _into_folder(data: Path, out: Path, source: Path | None, url: str | None) -> Kept:
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; needed a folder, or a name that ends with .zip")
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    now = datetime.datetime.now(datetime.UTC)
    target = out / f"{now:%Y%m%dT%H%M%S.%f}-{secrets.token_hex(3)}"
    with _staged(data, source, url, out) as (stage, blobs):
        found = Kept(str(target), "sqlite" if source is not None else "postgresql")
        doc = _manifest(stage, blobs, found.database)
        for sha256, size in blobs:
            to = out / BLOBS / sha256[:2] / sha256
            if to.is_file() and to.stat().st_size == size:
                found.files += 1
                continue
            path = _blob(data, sha256, url)
            to.parent.mkdir(parents=True, exist_ok=True)
            part = to.with_name(f".{sha256}.{secrets.token_hex(4)}")
            try:
                shutil.copyfile(path, part)
                if _hash(part) != sha256:
                    found.damaged.append(sha256)
                    continue
                part.replace(to)
            except FileNotFoundError:
                found.damaged.append(sha256)
                continue
            finally:
                part.unlink(missing_ok=True)
            found.files, found.new, found.bytes = found.files + 1, found.new + 1, found.bytes + size
        (stage / MANIFEST).write_text(json.dumps({**doc, "damaged": found.damaged}))
        stage.rename(target)  # whole or not at all
        stage.mkdir()  # for who takes it away
    return found


# ------------------------------------------------------------------------------------------------------------ restoring


@dataclass
class Restored:
    """What was restored; `faults` are those of the log itself, as `fringescope audit verify` tells them."""

    where: str
    database: str
    made_ns: int
    files: int
    missing: list[str]
    faults: tuple[str, ...] = ()
    events: int = 0


def restore(source: Path, data: Path) -> Restored:
    """A hub's folder out of a backup: a zip file, one backup of a folder, or that folder (its latest).

    Each file is compared with its hash; `data` must be new or empty, and appears whole or not at all. Raises
    FormatError and OutputError.
    """
    if data.exists() and (not data.is_dir() or any(data.iterdir())):
        raise OutputError(f"{data}: there is something already; needed a new or empty folder")
    data.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=data.resolve().parent, prefix=f".{data.name}-"))
    work.chmod(0o700)
    try:
        doc, missing = _from_folder(source, work) if source.is_dir() else _from_zip(source, work)
        found = Restored(str(data), doc["database"], int(doc.get("made_ns") or 0), len(doc["blobs"]), missing)
        if doc["database"] == "sqlite":
            engine = audit.open_readonly(work)
            try:
                judged = audit.verify(engine, work)
            finally:
                engine.dispose()
            found.faults, found.events = judged.faults, judged.events
        for secret in (checkpoints.KEY, DATABASE):
            if (work / secret).exists():
                (work / secret).chmod(0o600)
        if data.exists():
            data.rmdir()
        work.rename(data)
    except OSError as e:
        raise OutputError(f"{data}: {e.strerror or e}; nothing was restored") from e
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return found


def _checked(doc: dict[str, Any], what: str) -> dict[str, Any]:
    if doc.get("format") != FORMAT:
        raise FormatError(f"{what}: no backup of a hub")
    if not isinstance(doc.get("version"), int) or doc["version"] > VERSION:
        raise FormatError(f"{what}: version {str(doc.get('version'))[:20]}; this program reads {VERSION}: update it")
    try:
        for f in doc["files"]:
            if check_relative(f["path"]) or f["path"].split("/")[0] in (BLOBS, MANIFEST) or len(f["sha256"]) != 64:
                raise FormatError(f"{what}: a file of the name {str(f['path'])[:80]!r}")
        for sha256, size in doc["blobs"]:
            if len(sha256) != 64 or set(sha256) - set("0123456789abcdef") or not isinstance(size, int):
                raise FormatError(f"{what}: {str(sha256)[:80]!r} is no hash")
        if doc["database"] not in ("sqlite", "postgresql"):
            raise FormatError(f"{what}: a database of kind {str(doc['database'])[:40]!r}")
    except (KeyError, TypeError, ValueError, AttributeError):
        raise FormatError(f"{what}: its {MANIFEST} is not in order") from None
    return doc


def _place(work: Path, sha256: str) -> Path:
    to = work / BLOBS / sha256[:2] / sha256
    to.parent.mkdir(parents=True, exist_ok=True)
    return to


def _from_zip(source: Path, work: Path) -> tuple[dict[str, Any], list[str]]:
    if not source.is_file():
        raise FormatError(f"{source}: not found; needed a backup")
    missing = []
    with Unpacked(source, _MANY, str(source), _MANY) as z:
        doc = _checked(parsed(z.read(MANIFEST, 1 << 30), f"{source}: {MANIFEST}"), str(source))
        for f in doc["files"]:
            if z.extract(f["path"], work / f["path"]) != f["sha256"]:
                raise FormatError(f"{source}: {f['path']} was altered or damaged; take another backup")
        for sha256, _ in doc["blobs"]:
            name = f"{BLOBS}/{sha256}"
            if name not in z.entries or sha256 in doc.get("damaged", ()):
                missing.append(sha256)
            elif z.extract(name, _place(work, sha256)) != sha256:
                raise FormatError(f"{source}: file {sha256[:16]}.. was altered or damaged; take another backup")
    return doc, missing


def _from_folder(source: Path, work: Path) -> tuple[dict[str, Any], list[str]]:
    if not (source / MANIFEST).is_file():
        made = sorted(p.parent for p in source.glob(f"[0-9]*/{MANIFEST}"))
        if not made:
            raise FormatError(f"{source}: no backup is in it")
        source = made[-1]
    doc = _checked(read_json(source / MANIFEST, "a backup"), str(source))
    missing = []
    for f in doc["files"]:
        (work / f["path"]).parent.mkdir(parents=True, exist_ok=True)
        if not (source / f["path"]).is_file():
            raise FormatError(f"{source}: {f['path']} is missing; take another backup")
        shutil.copyfile(source / f["path"], work / f["path"])
        if _hash(work / f["path"]) != f["sha256"]:
            raise FormatError(f"{source}: {f['path']} was altered or damaged; take another backup")
    for sha256, _ in doc["blobs"]:
        at = source.parent / BLOBS / sha256[:2] / sha256
        if not at.is_file():
            missing.append(sha256)
            continue
        to = _place(work, sha256)
        shutil.copyfile(at, to)
        if _hash(to) != sha256:
            raise FormatError(f"{source}: file {sha256[:16]}.. was altered or damaged; take another backup")
    return doc, missing
