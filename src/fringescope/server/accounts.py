"""People: passwords, sessions and the roster that every message is checked against."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import threading
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import argon2
import sqlalchemy as sa

from fringescope.errors import FringescopeError, OutputError, UsageError
from fringescope.server import database as db
from fringescope.server.clock import Clock
from fringescope.server.config import Limits
from fringescope.server.lockout import Lockout
from fringescope.wire import Person, PersonRole

S = 1_000_000_000
SHORTEST = 12  #: letters of a password at least
LONGEST = 200  #: letters of a name at most
_AT_ONCE = 4  #: passwords judged at once: each takes 64 MiB meanwhile


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


def plain_name(name: str) -> str:
    """A name in its one form. Raises UsageError for letters that nobody sees: they make one name look like another."""
    made = " ".join(unicodedata.normalize("NFKC", name).split())
    if not made or len(made) > LONGEST or any(unicodedata.category(c)[0] == "C" for c in made):
        raise UsageError(f"the name {made[:40]!r}; needed 1 to {LONGEST} letters that can be seen")
    return made


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
        self._lock, self._changing = threading.Lock(), threading.Lock()
        self._few = threading.BoundedSemaphore(_AT_ONCE)
        self._lockout = Lockout(clock, limits.failures, limits.locked_s)
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

    def case_of(self, person: str) -> str | None:
        """The one case that somebody was invited to; None for who has an account of their own."""
        known = self._roster.get(person)
        return known[1] if known else None

    def allowed(self, person: str) -> bool:
        """Whether somebody still may come in: asked for each message."""
        known = self._roster.get(person)
        return known is not None and not known[0].disabled and (known[2] is None or known[2] > self._clock.now_ns())

    def add(
        self, name: str, password: str | None, role: PersonRole, *, case: str | None = None,
        expires_ns: int | None = None, subject: str | None = None,
    ) -> Person:  # fmt: skip
        """A new account; without a password one enters by another way. Raises UsageError for a name that is taken."""
        name, hashed = plain_name(name), self._hashed(password) if password is not None else ""
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
            taken = "this person of the identity provider has an account already"
            if subject is None or self.by_subject(subject) is None:
                taken = f"there is an account of the name {name!r} already; choose another name"
            raise UsageError(taken) from None
        return self._renew(str(row["id"]))

    def change(
        self, person: str, *, name: str | None = None, password: str | None = None, role: PersonRole | None = None,
        disabled: bool | None = None, keep_keys: bool = False,
    ) -> Person:  # fmt: skip
        """Changes an account; what somebody has open is closed where they lose a right. Raises UsageError.

        A new password takes passkeys away with it unless `keep_keys`: who sets one for somebody else wants nobody in
        who was in before.
        """
        name = None if name is None else plain_name(name)
        hashed = None if password is None else self._hashed(password)
        with self._changing:  # one after the other: two administrators cannot both be the last but one
            before = self.person(person)
            if before is None:
                raise UsageError(f"nobody has the account {person}")
            ends = bool(disabled) or (role is not None and role is not before.role)
            if ends and before.role is PersonRole.ADMIN and self._admins() == {person}:
                raise UsageError("the last administrator cannot be disabled or become something else; name another")
            if role in (PersonRole.OPERATOR, PersonRole.ADMIN) and self.case_of(person) is not None:
                raise UsageError(f"a guest of one case cannot be {role}; make an account for them")
            wanted = {"name": name, "password": hashed, "role": role and role.value, "disabled": disabled}
            values = {"failures": 0, "locked_ns": 0} | {k: v for k, v in wanted.items() if v is not None}
            try:
                with db.writing(self._engine) as c:
                    c.execute(db.people.update().where(db.people.c.id == person).values(values))
                    if ends or hashed is not None:
                        c.execute(db.sessions.delete().where(db.sessions.c.person_id == person))
                    if hashed is not None and not keep_keys:
                        c.execute(db.passkeys.delete().where(db.passkeys.c.person_id == person))
            except sa.exc.IntegrityError:
                raise UsageError(f"there is an account of the name {name!r} already; choose another name") from None
            after = self._renew(person)
        if hashed is not None or disabled is False:
            self._lockout.forget(before.name)
            self._lockout.forget(after.name)
        if ends or hashed is not None:
            self.gone(person)
        return after

    def by_subject(self, subject: str) -> Person | None:
        """Whose account an identity provider's subject is."""
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.people.c.id).where(db.people.c.subject == subject)).first()
        return self.person(row.id) if row else None

    # ------------------------------------------------------------------------------------------------------ signing in

    def check(self, name: str, password: str, address: str = "") -> str:
        """Whose name and password these are, tried from an address; their identifier.

        Raises SignInError: the same words, after the same work, for an unknown name, a wrong password, an account that
        is disabled or was tried too often.
        """
        try:
            name = plain_name(name)
        except UsageError:
            name = ""
        free = self._lockout.begin(name, address)
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.people).where(db.people.c.name == name)).first()
        right = self._fits(row.password if row and row.password else self._nobody, password)
        if not free or not right or row is None or not row.password or not self.allowed(row.id):
            raise SignInError(
                f"name and password do not fit, or the account is locked; after {self._limits.failures} wrong "
                f"passwords it stays locked for {self._limits.locked_s / 60:.0f} minutes"
            )
        self._lockout.right(name, address)
        if self._hasher.check_needs_rehash(row.password):
            values = {"password": self._hasher.hash(password)}
            with db.writing(self._engine) as c:
                c.execute(db.people.update().where(db.people.c.id == row.id).values(values))
        return str(row.id)

    def sign_in(self, name: str, password: str, address: str = "") -> tuple[str, Session]:
        """A new session: the secret for the cookie, and what it stands for. Raises SignInError as `check` does."""
        return self.open_session(self.check(name, password, address))

    def open_session(self, person: str, confirmed: bool = True) -> tuple[str, Session]:
        """A session for somebody who has proved who they are, just now if `confirmed`.

        Raises SignInError if they may not come in.
        """
        if not self.allowed(person):
            raise SignInError("this account is disabled or has expired; ask whoever made it")
        secret, now = secrets.token_urlsafe(32), self._clock.now_ns()
        row = {
            "digest": digest(secret), "person_id": person, "csrf": secrets.token_urlsafe(24), "created_ns": now,
            "seen_ns": now, "confirmed_ns": now if confirmed else 0,
        }  # fmt: skip
        limits = self._limits
        s = db.sessions.c
        over = (s.created_ns < now - int(limits.session_s * S)) | (s.seen_ns < now - int(limits.idle_s * S))
        with db.writing(self._engine) as c:
            c.execute(db.sessions.delete().where(over))
            c.execute(db.sessions.insert().values(row))
        return secret, self.session(secret)

    def session(self, secret: str) -> Session:
        """Who a cookie stands for. Raises SignInError."""
        found, idle_ns = self._session(digest(secret))
        if idle_ns > 60 * S:
            with contextlib.suppress(OutputError), db.writing(self._engine) as c:  # a full disk keeps nobody out
                row = db.sessions.c.digest == found.digest
                c.execute(db.sessions.update().where(row).values(seen_ns=self._clock.now_ns()))
        return found

    def session_of(self, session: str) -> Session:
        """A session by its digest, as it stands; looking is no use of it. Raises SignInError where it has ended."""
        return self._session(session)[0]

    def _session(self, session: str) -> tuple[Session, int]:
        now = self._clock.now_ns()
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.sessions).where(db.sessions.c.digest == session)).first()
        old = row is None or row.created_ns < now - self._limits.session_s * S
        if row is None or old or row.seen_ns < now - self._limits.idle_s * S or not self.allowed(row.person_id):
            raise SignInError("you are not signed in, or not any more; sign in")
        person, case, _ = self._roster[row.person_id]
        return Session(row.digest, person, row.csrf, row.confirmed_ns, case), now - row.seen_ns

    def ended(self, seen: dict[str, bool]) -> set[str]:
        """Which sessions (by digest) are over; those marked True were used just now and go on."""
        now, s = self._clock.now_ns(), db.sessions.c
        alive = s.seen_ns >= now - int(self._limits.idle_s * S)
        young = s.created_ns >= now - int(self._limits.session_s * S)
        if used := [d for d, active in seen.items() if active]:
            with db.writing(self._engine) as c:
                c.execute(db.sessions.update().where(s.digest.in_(used), alive).values(seen_ns=now))
        with db.reading(self._engine) as c:
            found = {r.digest for r in c.execute(sa.select(s.digest).where(s.digest.in_(list(seen)), young, alive))}
        return set(seen) - found

    def sign_out(self, session: Session) -> None:
        """Ends a session."""
        with db.writing(self._engine) as c:
            c.execute(db.sessions.delete().where(db.sessions.c.digest == session.digest))

    def confirm(self, session: Session, password: str, address: str = "") -> None:
        """The person of a session proves once more who they are. Raises SignInError."""
        self.check(session.person.name, password, address)
        self.confirmed(session)

    def confirmed(self, session: Session) -> None:
        """The person of a session has proved once more who they are."""
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
            with self._few:
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
