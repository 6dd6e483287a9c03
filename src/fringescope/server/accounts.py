"""People: passwords, sessions and the roster that every message is checked against."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import argon2
import sqlalchemy as sa

from fringescope.errors import FringescopeError, OutputError, UsageError
from fringescope.server import database as db
from fringescope.server.clock import Clock
from fringescope.server.config import Limits
from fringescope.wire import Person, PersonRole

S = 1_000_000_000
SHORTEST = 12  #: letters of a password at least


class SignInError(FringescopeError):
    """Nobody is signed in, or not any more: a sentence for the screen."""


@dataclass(frozen=True)
class Session:
    """Somebody who is signed in."""

    digest: str
    person: Person
    csrf: str
    confirmed_ns: int
    case: str | None


def new_id(kind: str) -> str:
    """An identifier that nobody can guess, as person-4f…"""
    return f"{kind}-{secrets.token_hex(10)}"


def digest(secret: str) -> str:
    """What is kept of a cookie or a link: it opens nothing."""
    return hashlib.sha256(secret.encode()).hexdigest()


class Accounts:
    """All people with an account, and who of them is signed in. May be used from several threads.

    `gone` is called with a person's identifier when they lose a right: what they have open must be closed.
    """

    def __init__(self, engine: sa.Engine, clock: Clock, limits: Limits, hasher: argon2.PasswordHasher | None = None):
        self._engine, self._clock, self._limits = engine, clock, limits
        self._hasher = hasher or argon2.PasswordHasher()
        self._lock = threading.Lock()
        self._roster: dict[str, tuple[Person, str | None, int | None]] = {}
        self.gone: Callable[[str], None] = lambda _person: None
        self._nobody = self._hasher.hash(secrets.token_hex(16))  # so that an unknown name takes as long as a known one
        with db.reading(engine) as c:
            for row in c.execute(sa.select(db.people)):
                self._keep(row)

    # ---------------------------------------------------------------------------------------------------------- people

    def any(self) -> bool:
        """Whether somebody has an account."""
        return bool(self._roster)

    def people(self) -> list[Person]:
        """Everybody, by name."""
        return sorted((p for p, _, _ in self._roster.values()), key=lambda p: p.name)

    def person(self, person: str) -> Person | None:
        """One of them."""
        known = self._roster.get(person)
        return known[0] if known else None

    def allowed(self, person: str) -> bool:
        """Whether somebody still may come in: asked for each message."""
        known = self._roster.get(person)
        return known is not None and not known[0].disabled and (known[2] is None or known[2] > self._clock.now_ns())

    def add(
        self, name: str, password: str | None, role: PersonRole, *, case: str | None = None,
        expires_ns: int | None = None, subject: str | None = None,
    ) -> Person:  # fmt: skip
        """A new account; without a password one enters by another way. Raises UsageError for a name that is taken."""
        hashed = self._hashed(password) if password is not None else ""
        row = {
            "id": new_id("person"), "name": name, "role": role.value, "password": hashed, "disabled": False,
            "failures": 0, "locked_ns": 0, "created_ns": self._clock.now_ns(), "case_id": case,
            "expires_ns": expires_ns, "subject": subject,
        }  # fmt: skip
        try:
            with db.writing(self._engine) as c:
                c.execute(db.people.insert().values(row))
                if case is not None:
                    c.execute(db.members.insert().values(case_id=case, person_id=row["id"]))
        except sa.exc.IntegrityError:
            raise UsageError(f"there is an account of the name {name!r} already; choose another name") from None
        return self._renew(str(row["id"]))

    def change(
        self, person: str, *, name: str | None = None, password: str | None = None, role: PersonRole | None = None,
        disabled: bool | None = None,
    ) -> Person:  # fmt: skip
        """Changes an account; what somebody has open is closed where they lose a right. Raises UsageError."""
        before = self.person(person)
        if before is None:
            raise UsageError(f"nobody has the account {person}")
        ends = bool(disabled) or (role is not None and role is not before.role)
        if ends and before.role is PersonRole.ADMIN and self._admins() == {person}:
            raise UsageError("the last administrator cannot be disabled or become something else; name another first")
        values: dict[str, Any] = {"failures": 0, "locked_ns": 0}
        if name is not None:
            values["name"] = name
        if password is not None:
            values["password"] = self._hashed(password)
        if role is not None:
            values["role"] = role.value
        if disabled is not None:
            values["disabled"] = disabled
        try:
            with db.writing(self._engine) as c:
                c.execute(db.people.update().where(db.people.c.id == person).values(values))
                if ends or password is not None:
                    c.execute(db.sessions.delete().where(db.sessions.c.person_id == person))
        except sa.exc.IntegrityError:
            raise UsageError(f"there is an account of the name {name!r} already; choose another name") from None
        after = self._renew(person)
        if ends or password is not None:
            self.gone(person)
        return after

    def by_subject(self, subject: str) -> Person | None:
        """Whose account an identity provider's subject is."""
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.people.c.id).where(db.people.c.subject == subject)).first()
        return self.person(row.id) if row else None

    # ------------------------------------------------------------------------------------------------------ signing in

    def sign_in(self, name: str, password: str) -> tuple[str, Session]:
        """A new session: the secret for the cookie, and what it stands for.

        Raises SignInError: the same words for an unknown name, a wrong password and an account that is locked.
        """
        now = self._clock.now_ns()
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.people).where(db.people.c.name == name)).first()
        right = self._fits(row.password if row and row.password else self._nobody, password)
        if row is None or not row.password or row.disabled or row.locked_ns > now:
            right = False
        if row is not None and row.locked_ns <= now and not right:
            failures = row.failures + 1
            locked = now + int(self._limits.locked_s * S) if failures >= self._limits.failures else 0
            with db.writing(self._engine) as c:
                values = {"failures": 0 if locked else failures, "locked_ns": locked}
                c.execute(db.people.update().where(db.people.c.id == row.id).values(values))
        if not right or row is None or not self.allowed(row.id):
            raise SignInError(
                f"name and password do not fit, or the account is locked; after {self._limits.failures} wrong "
                f"passwords it stays locked for {self._limits.locked_s / 60:.0f} minutes"
            )
        if row.failures or self._hasher.check_needs_rehash(row.password):
            again = self._hasher.check_needs_rehash(row.password)
            values = {"failures": 0, **({"password": self._hasher.hash(password)} if again else {})}
            with db.writing(self._engine) as c:
                c.execute(db.people.update().where(db.people.c.id == row.id).values(values))
        return self.open_session(row.id)

    def open_session(self, person: str) -> tuple[str, Session]:
        """A session for somebody who has proved who they are. Raises SignInError if they may not come in."""
        if not self.allowed(person):
            raise SignInError("this account is disabled or has expired; ask whoever made it")
        secret, now = secrets.token_urlsafe(32), self._clock.now_ns()
        row = {
            "digest": digest(secret), "person_id": person, "csrf": secrets.token_urlsafe(24), "created_ns": now,
            "seen_ns": now, "confirmed_ns": now,
        }  # fmt: skip
        with db.writing(self._engine) as c:
            c.execute(db.sessions.delete().where(db.sessions.c.created_ns < now - int(self._limits.session_s * S)))
            c.execute(db.sessions.insert().values(row))
        return secret, self.session(secret)

    def session(self, secret: str) -> Session:
        """Who a cookie stands for. Raises SignInError."""
        now = self._clock.now_ns()
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.sessions).where(db.sessions.c.digest == digest(secret))).first()
        old = row is None or row.created_ns < now - self._limits.session_s * S
        if row is None or old or row.seen_ns < now - self._limits.idle_s * S or not self.allowed(row.person_id):
            raise SignInError("you are not signed in, or not any more; sign in")
        if row.seen_ns < now - 60 * S:
            with contextlib.suppress(OutputError), db.writing(self._engine) as c:  # a full disk keeps nobody out
                c.execute(db.sessions.update().where(db.sessions.c.digest == row.digest).values(seen_ns=now))
        person, case, _ = self._roster[row.person_id]
        return Session(row.digest, person, row.csrf, row.confirmed_ns, case)

    def sign_out(self, session: Session) -> None:
        """Ends a session."""
        with db.writing(self._engine) as c:
            c.execute(db.sessions.delete().where(db.sessions.c.digest == session.digest))

    def confirm(self, session: Session, password: str) -> None:
        """The person of a session proves once more who they are. Raises SignInError."""
        self.sign_out(self.sign_in(session.person.name, password)[1])
        with db.writing(self._engine) as c:
            row = db.sessions.c.digest == session.digest
            c.execute(db.sessions.update().where(row).values(confirmed_ns=self._clock.now_ns()))

    # ---------------------------------------------------------------------------------------------------------- inside

    def _admins(self) -> set[str]:
        return {k for k, (p, _, _) in self._roster.items() if p.role is PersonRole.ADMIN and not p.disabled}

    def _hashed(self, password: str) -> str:
        if len(password) < SHORTEST:
            raise UsageError(f"a password of {len(password)} letters; needed at least {SHORTEST}")
        return self._hasher.hash(password)

    def _fits(self, hashed: str, password: str) -> bool:
        try:
            return self._hasher.verify(hashed, password)
        except (argon2.exceptions.VerificationError, argon2.exceptions.InvalidHashError):
            return False

    def _renew(self, person: str) -> Person:
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.people).where(db.people.c.id == person)).one()
        return self._keep(row)

    def _keep(self, row: Any) -> Person:
        made = Person(
            id=row.id, name=row.name, role=PersonRole(row.role), disabled=row.disabled, created_ns=row.created_ns
        )
        with self._lock:
            self._roster[row.id] = (made, row.case_id, row.expires_ns)
        return made


def confirmed_ns(engine: sa.Engine, session: str) -> int:
    """When the person of a session (its digest) last proved who they are; 0 where the session has ended."""
    with db.reading(engine) as c:
        row = c.execute(sa.select(db.sessions.c.confirmed_ns).where(db.sessions.c.digest == session)).first()
    return int(row.confirmed_ns) if row else 0
