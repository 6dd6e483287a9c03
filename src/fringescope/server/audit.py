"""The log judged from outside: every chain, every word, every case that a checkpoint knows; nothing is written.

It works beside a running hub: entries are only ever added, so what a checkpoint said before must still be there.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa
from alembic.migration import MigrationContext

from fringescope.errors import FormatError
from fringescope.server import checkpoints as kept
from fringescope.server import database as db
from fringescope.wire.record import Record, check_chain

_PAGE = 500
_KEPT = ("case_id", "seq", "at_ns", "said_ns", "actor", "role", "client", "number", "kind", "refused", "digest",
         "prev", "hash")  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What an audit found. `covered_ns`: a tail that was cut off before this time would have been missed."""

    cases: int
    events: int
    faults: tuple[str, ...]
    checkpoints: int = 0
    covered_ns: int = 0
    key: str = ""  #: of the hub, hex

    @property
    def whole(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def open_readonly(data: Path, url: str | None = None) -> sa.Engine:
    """The database of a hub, to look at: no lock, no migration, no change. Raises FormatError where there is none."""
    if url is not None and sa.make_url(url).get_backend_name() != "sqlite":
        engine = db.open_engine(url)
        return engine.execution_options(postgresql_readonly=True)
    file = data / "hub.sqlite" if url is None else Path(sa.make_url(url).database or "")
    if not file.is_file():
        raise FormatError(f"{file}: no hub's database; name its folder with --data, or its --database")
    # a log ahead that nobody holds open needs its folder to be writable; without one the file alone is all there is
    alone = not file.with_name(file.name + "-wal").exists()
    mode = "mode=ro" + ("&immutable=1" if alone and not _writable(file.parent) else "")

    def connect() -> sqlite3.Connection:
        made = sqlite3.connect(f"file:{quote(str(file.resolve()))}?{mode}", uri=True, check_same_thread=False)
        made.execute("PRAGMA query_only=ON")
        made.execute("PRAGMA busy_timeout=10000")
        return made

    return sa.create_engine("sqlite://", creator=connect, poolclass=sa.NullPool)


def _writable(folder: Path) -> bool:
    import os

    return os.access(folder, os.W_OK)


def verify(
    engine: sa.Engine, data: Path, places: Sequence[Path] = (), key: str | None = None, files: bool = False
) -> Found:
    """Checks a hub's log against itself and against checkpoints. Raises FormatError where there is no log.

    `places`: files and folders of checkpoints beside the hub's own. `key`: the public key (hex) that must have signed
    them, None for the one in the hub's folder. `files`: whether the files of all scans are read and compared, too.
    """
    try:
        with db.reading(engine) as c:
            if MigrationContext.configure(c).get_current_revision() is None:
                raise FormatError(f"{data}: the database is no hub's")
    except sa.exc.DatabaseError as e:
        raise FormatError(f"{data}: the database cannot be read: {e.orig}") from e
    if key is None and (data / kept.PUBLIC).exists():
        key = kept.raw(kept.read_public(data / kept.PUBLIC))
    own = [data / kept.FOLDER] if (data / kept.FOLDER).is_dir() else []
    points = kept.read([*own, *places], key or "")  # before the log: what it says must be there already
    faults = [f"checkpoint {p.where}: {p.fault}" for p in points if p.fault]
    if points and key is None:
        faults.append(f"{data}: the hub's public key is missing, so no checkpoint can be believed; give it with --key")
    wanted: dict[str, dict[int, dict[str, str]]] = {}
    for p in points:
        for case, (seq, head) in p.heads.items():
            wanted.setdefault(case, {}).setdefault(seq, {}).setdefault(head, p.where)
    cases, strays = _cases(engine)
    faults += strays
    count = 0
    for case in cases:
        n, wrong = _case(engine, case, wanted.pop(case, {}))
        count, faults = count + n, faults + wrong
    faults += [f"case {case}: it is missing; checkpoint {_where(v)} knows {max(v)} events of it"
               for case, v in sorted(wanted.items())]  # fmt: skip
    faults += _stray_words(engine)
    if files:
        faults += _files(engine, data)
    good = [p for p in points if p.heads]
    covered = max((p.at_ns for p in good), default=0)
    return Found(len(cases), count, tuple(faults), len(good), covered, key or "")


def _where(seen: dict[int, dict[str, str]]) -> str:
    return next(iter(seen[max(seen)].values()))


def _cases(engine: sa.Engine) -> tuple[list[str], list[str]]:
    with db.reading(engine) as c:
        cases = [str(r.id) for r in c.execute(sa.select(db.cases.c.id).order_by(db.cases.c.id))]
        of = sa.select(db.events.c.case_id).distinct()
        strays = sorted({str(r.case_id) for r in c.execute(of)} - set(cases))
    return cases, [f"case {s}: there are events of it and no case" for s in strays]


def _case(engine: sa.Engine, case: str, wanted: dict[int, dict[str, str]]) -> tuple[int, list[str]]:
    count, last = 0, 0
    faults: list[str] = []

    def passing() -> Iterator[Record]:
        nonlocal count, last
        for r in _records(engine, case):
            count, last = count + 1, max(last, r.seq if isinstance(r.seq, int) else 0)
            for head, where in wanted.pop(r.seq, {}).items():
                if head != r.hash:
                    faults.append(f"case {case}, event {r.seq}: not the one that checkpoint {where} has seen; the log "
                                  "was rewritten")  # fmt: skip
            yield r

    try:
        chain = check_chain(passing(), case)
    except (TypeError, ValueError, AttributeError, OverflowError) as e:
        return count, [*faults, f"case {case}, after event {last}: an entry that cannot be read ({e}); it was altered"]
    if not count:
        faults.append(f"case {case}: it has no event, not even that it was opened; they were removed")
    if missing := {k: v for k, v in wanted.items() if k > last}:
        faults.append(f"case {case}: its log ends with event {last}; checkpoint {_where(missing)} has seen event "
                      f"{max(missing)}: the tail was cut off")  # fmt: skip
    return count, chain + faults


def _records(engine: sa.Engine, case: str) -> Iterator[Record]:
    """Entries as they stand, words that are no JSON and all: nothing is held open between pages."""
    e, p = db.events, db.payloads
    joined = e.outerjoin(p, (e.c.case_id == p.c.case_id) & (e.c.seq == p.c.seq))
    words = sa.cast(p.c.body, sa.Text).label("words")
    columns = [e.c[k] for k in _KEPT]
    asked = sa.select(*columns, p.c.seq.label("there"), p.c.salt, words).select_from(joined).order_by(e.c.seq)
    since: Any = None
    while True:
        page = asked.where(e.c.case_id == case, *([e.c.seq > since] if since is not None else [])).limit(_PAGE)
        with db.reading(engine) as c:
            rows = list(c.execute(page))
        for r in rows:
            payload = None if r.there is None else _words(r.words)
            yield Record(
                r.case_id, r.seq, r.at_ns, r.said_ns, r.actor, r.role, r.client, r.number, r.kind, r.refused,
                str(r.salt or ""), payload, r.digest, r.prev, r.hash,
            )  # fmt: skip
        if len(rows) < _PAGE:
            return
        since = rows[-1].seq


def _words(text: Any) -> dict[str, Any]:
    try:
        value = json.loads(text, parse_constant=_no_number)
    except (ValueError, TypeError, RecursionError):
        value = None
    return value if isinstance(value, dict) else {"\x00": "these words cannot be read"}


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _stray_words(engine: sa.Engine) -> list[str]:
    e, p = db.events, db.payloads
    joined = p.outerjoin(e, (e.c.case_id == p.c.case_id) & (e.c.seq == p.c.seq))
    asked = sa.select(p.c.case_id, p.c.seq).select_from(joined).where(e.c.seq.is_(None)).limit(1000)
    with db.reading(engine) as c:
        return [f"case {r.case_id}, event {r.seq}: there are words of it and no event" for r in c.execute(asked)]


def _files(engine: sa.Engine, data: Path) -> list[str]:
    faults = []
    with db.reading(engine) as c:
        asked = sa.select(db.blobs.c.sha256, sa.func.min(db.blobs.c.case_id).label("case"),
                          sa.func.min(db.blobs.c.name).label("name")).group_by(db.blobs.c.sha256)  # fmt: skip
        rows = list(c.execute(asked))
    for r in rows:
        path = data / "files" / r.sha256[:2] / r.sha256
        name = f"case {r.case}, file {r.name}"
        try:
            with path.open("rb") as f:
                if hashlib.file_digest(f, "sha256").hexdigest() != r.sha256:
                    faults.append(f"{name}: its content was altered")
        except OSError as e:
            faults.append(f"{name}: cannot be read: {e.strerror}")
    return faults
