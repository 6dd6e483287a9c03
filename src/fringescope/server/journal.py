"""The log of all cases on the database: entries in their order, written many at once, and read back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import sqlalchemy as sa

from fringescope.server import database as db
from fringescope.wire.record import Record

_PAGE = 500
_KEPT = ("case_id", "seq", "at_ns", "said_ns", "actor", "role", "client", "number", "kind", "refused", "digest",
         "prev", "hash")  # fmt: skip


def append(c: sa.Connection, records: Sequence[Record]) -> None:
    """Adds entries, as part of a transaction."""
    if not records:
        return
    rows = [{k: r.case if k == "case_id" else getattr(r, k) for k in _KEPT} for r in records]
    c.execute(db.events.insert(), rows)
    c.execute(
        db.payloads.insert(),
        [{"case_id": r.case, "seq": r.seq, "salt": r.salt, "body": r.payload} for r in records],
    )


def read(c: sa.Connection, case: str, since: int = 0, limit: int | None = None) -> list[Record]:
    """Entries of a case behind number `since`, in order."""
    e, p = db.events, db.payloads
    joined = e.outerjoin(p, (e.c.case_id == p.c.case_id) & (e.c.seq == p.c.seq))
    asked = (
        sa.select(*[e.c[k] for k in _KEPT], p.c.salt, p.c.body)
        .select_from(joined)
        .where(e.c.case_id == case, e.c.seq > since)
        .order_by(e.c.seq)
        .limit(limit)
    )
    return [
        Record(
            r.case_id, r.seq, r.at_ns, r.said_ns, r.actor, r.role, r.client, r.number, r.kind, r.refused,
            r.salt or "", r.body, r.digest, r.prev, r.hash,
        )
        for r in c.execute(asked)
    ]  # fmt: skip


def entries(engine: sa.Engine, case: str, since: int = 0) -> Iterator[Record]:
    """All entries of a case behind `since`, a page at a time: nothing is held open between pages."""
    while True:
        with db.reading(engine) as c:
            page = read(c, case, since, _PAGE)
        yield from page
        if len(page) < _PAGE:
            return
        since = page[-1].seq


def answer(engine: sa.Engine, case: str, actor: str, client: str, number: int) -> tuple[int, str] | None:
    """What became of the `number`-th op of a client: its entry, and why it was refused."""
    e = db.events
    asked = sa.select(e.c.seq, e.c.refused).where(
        e.c.case_id == case, e.c.actor == actor, e.c.client == client, e.c.number == number
    )
    with db.reading(engine) as c:
        r = c.execute(asked).first()
    return None if r is None else (int(r.seq), str(r.refused))


def last_ns(engine: sa.Engine) -> int:
    """When the latest entry was made; 0 without any."""
    with db.reading(engine) as c:
        return int(c.execute(sa.select(sa.func.max(db.events.c.at_ns))).scalar() or 0)


def heads(engine: sa.Engine) -> dict[str, tuple[int, str]]:
    """Number and hash of the last entry of each case that has one."""
    e = db.events
    last = sa.select(e.c.case_id, sa.func.max(e.c.seq).label("seq")).group_by(e.c.case_id).subquery()
    asked = sa.select(e.c.case_id, e.c.seq, e.c.hash).join(
        last, (e.c.case_id == last.c.case_id) & (e.c.seq == last.c.seq)
    )
    with db.reading(engine) as c:
        return {r.case_id: (r.seq, r.hash) for r in c.execute(asked)}
