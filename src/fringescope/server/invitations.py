"""Guests: invited to one case by a link, let in with a code that was told another way, out again when time is over."""

from __future__ import annotations

import secrets
from typing import Any

import argon2
import sqlalchemy as sa

from fringescope.server import database as db
from fringescope.server.accounts import LONGEST, Accounts, S, Session, SignInError, digest, new_id, plain_name
from fringescope.server.clock import Clock
from fringescope.wire import Invitation, PersonRole
from fringescope.wire.documents import NewInvitation

_TRIES = 5  #: wrong codes that end an invitation
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"  #: none that sounds or looks like another
_WRONG = "link and code do not fit, or the invitation was used, has expired or was revoked; ask for another"


class Invitations:
    """The invitations of a hub."""

    def __init__(self, engine: sa.Engine, clock: Clock, accounts: Accounts) -> None:
        self._engine, self._clock, self._accounts = engine, clock, accounts
        self._hasher = argon2.PasswordHasher(time_cost=1, memory_cost=19_456, parallelism=1)

    def make(self, case: str, by: str, asked: NewInvitation) -> tuple[Invitation, Any]:
        """An invitation with its link's token and its code, told this once, and its row. Raises UsageError."""
        name = plain_name(asked.name)[: LONGEST - 20]
        token = secrets.token_urlsafe(24)
        code = "".join(secrets.choice(_LETTERS) for _ in range(8))
        row = {
            "id": new_id("invitation"), "case_id": case, "digest": digest(token), "code": self._hasher.hash(code),
            "failures": 0, "role": asked.role, "name": name,
            "expires_ns": self._clock.now_ns() + int(asked.hours * 3600 * S), "revoked": False, "used_ns": None,
            "person_id": None, "made_by": by,
        }  # fmt: skip
        made = _told(row)
        return made.model_copy(update={"token": token, "code": code}), row

    def of(self, case: str) -> list[Invitation]:
        """The invitations to a case."""
        asked = sa.select(db.invitations).where(db.invitations.c.case_id == case)
        with db.reading(self._engine) as c:
            return [_told(r) for r in c.execute(asked.order_by(db.invitations.c.expires_ns)).mappings()]

    def get(self, invitation: str) -> Invitation | None:
        """One of them."""
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.invitations).where(db.invitations.c.id == invitation)).mappings().first()
        return None if row is None else _told(row)

    def revoke(self, invitation: str) -> str | None:
        """Ends an invitation; the guest's identifier if somebody came in by it. What they have open is closed."""
        i = db.invitations
        with db.writing(self._engine) as c:
            c.execute(i.update().where(i.c.id == invitation).values(revoked=True))
            row = c.execute(sa.select(i.c.person_id).where(i.c.id == invitation)).first()
        person = row.person_id if row else None
        if person is not None:
            self._accounts.change(person, disabled=True)
        return person

    def accept(self, token: str, code: str) -> tuple[str, Session, Invitation]:
        """A guest comes in: a session for the one case. Raises SignInError, in the same words whatever is wrong."""
        i, now = db.invitations, self._clock.now_ns()
        good = (i.c.digest == digest(token)) & i.c.used_ns.is_(None) & i.c.revoked.is_(False) & (i.c.expires_ns >= now)
        with db.writing(self._engine) as c:  # each try is counted before it is judged
            tried = i.update().where(good, i.c.failures < _TRIES).values(failures=i.c.failures + 1)
            row = None
            if c.execute(tried).rowcount == 1:
                row = c.execute(sa.select(i).where(good)).mappings().one()
        if row is None:
            raise SignInError(_WRONG)
        try:
            self._hasher.verify(row["code"], code.strip().upper())
        except argon2.exceptions.VerificationError:
            with db.writing(self._engine) as c:
                c.execute(i.update().where(i.c.id == row["id"], i.c.failures >= _TRIES).values(revoked=True))
            raise SignInError(_WRONG) from None
        with db.writing(self._engine) as c:  # of two who come at once, one
            first = c.execute(i.update().where(good).values(used_ns=now))
        if first.rowcount != 1:
            raise SignInError(_WRONG)
        person = self._accounts.add(
            f"{row['name']} ({row['id'][-6:]})", None, PersonRole(row["role"]), case=row["case_id"],
            expires_ns=row["expires_ns"],
        )  # fmt: skip
        with db.writing(self._engine) as c:
            c.execute(i.update().where(i.c.id == row["id"]).values(person_id=person.id))
            revoked = c.execute(sa.select(i.c.revoked).where(i.c.id == row["id"])).scalar_one()
        if revoked:  # while they came in
            self._accounts.change(person.id, disabled=True)
        secret, session = self._accounts.open_session(person.id)
        return secret, session, _told({**row, "used_ns": now})


def _told(row: Any) -> Invitation:
    return Invitation(
        id=row["id"], case=row["case_id"], role=PersonRole(row["role"]), name=row["name"],
        expires_ns=row["expires_ns"], revoked=row["revoked"], used_ns=row["used_ns"],
    )  # fmt: skip


def keep(c: sa.Connection, row: Any) -> None:
    """Writes an invitation down, as part of a transaction."""
    c.execute(db.invitations.insert().values(row))
