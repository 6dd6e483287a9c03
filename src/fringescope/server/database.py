"""The tables of a hub, on SQLite or PostgreSQL, and the way from one version of them to the next."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from alembic import command
from alembic.config import Config as AlembicConfig
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError

from fringescope.errors import FormatError, OutputError

metadata = sa.MetaData()
Text, Big, Flag = sa.Text(), sa.BigInteger(), sa.Boolean()

people = sa.Table(
    "people", metadata,
    sa.Column("id", Text, primary_key=True),
    sa.Column("name", Text, nullable=False, unique=True),
    sa.Column("role", Text, nullable=False),
    sa.Column("password", Text, nullable=False),  # argon2id, with its parameters
    sa.Column("disabled", Flag, nullable=False),
    sa.Column("failures", sa.Integer, nullable=False),
    sa.Column("locked_ns", Big, nullable=False),
    sa.Column("created_ns", Big, nullable=False),
    sa.Column("case_id", Text),  # of a guest: the one case that they were invited to
    sa.Column("expires_ns", Big),
    sa.Column("subject", Text, unique=True),  # of an identity provider: issuer and subject
)  # fmt: skip

passkeys = sa.Table(
    "passkeys", metadata,
    sa.Column("id", Text, primary_key=True),  # the credential's, base64url
    sa.Column("person_id", Text, sa.ForeignKey("people.id"), nullable=False, index=True),
    sa.Column("public_key", sa.LargeBinary, nullable=False),
    sa.Column("sign_count", Big, nullable=False),
    sa.Column("label", Text, nullable=False),
    sa.Column("created_ns", Big, nullable=False),
)  # fmt: skip

sessions = sa.Table(
    "sessions", metadata,
    sa.Column("digest", Text, primary_key=True),  # SHA-256 of the cookie: a stolen database opens no session
    sa.Column("person_id", Text, sa.ForeignKey("people.id"), nullable=False, index=True),
    sa.Column("csrf", Text, nullable=False),
    sa.Column("created_ns", Big, nullable=False),
    sa.Column("seen_ns", Big, nullable=False),
    sa.Column("confirmed_ns", Big, nullable=False),  # when the person last proved who they are
)  # fmt: skip

cases = sa.Table(
    "cases", metadata,
    sa.Column("id", Text, primary_key=True),
    sa.Column("accession", Text, nullable=False, index=True),
    sa.Column("status", Text, nullable=False, index=True),
    sa.Column("specimen", sa.JSON, nullable=False),
    sa.Column("created_ns", Big, nullable=False),
    sa.Column("changed_ns", Big, nullable=False),
)  # fmt: skip

patients = sa.Table(
    "patients", metadata,
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
    sa.Column("name", Text, nullable=False),
    sa.Column("identifier", Text, nullable=False, index=True),
    sa.Column("born", Text, nullable=False),
)  # fmt: skip

members = sa.Table(
    "members", metadata,
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
    sa.Column("person_id", Text, sa.ForeignKey("people.id"), primary_key=True),
)  # fmt: skip

invitations = sa.Table(
    "invitations", metadata,
    sa.Column("id", Text, primary_key=True),
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), nullable=False, index=True),
    sa.Column("digest", Text, nullable=False, unique=True),  # of the link's token
    sa.Column("code", Text, nullable=False),  # argon2id of what is told by telephone
    sa.Column("failures", sa.Integer, nullable=False),
    sa.Column("role", Text, nullable=False),
    sa.Column("name", Text, nullable=False),
    sa.Column("expires_ns", Big, nullable=False),
    sa.Column("revoked", Flag, nullable=False),
    sa.Column("used_ns", Big),
    sa.Column("person_id", Text, sa.ForeignKey("people.id")),
    sa.Column("made_by", Text, nullable=False),
)  # fmt: skip

events = sa.Table(
    "events", metadata,
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
    sa.Column("seq", Big, primary_key=True, autoincrement=False),
    sa.Column("at_ns", Big, nullable=False),
    sa.Column("said_ns", Big, nullable=False),
    sa.Column("actor", Text, nullable=False),
    sa.Column("role", Text, nullable=False),
    sa.Column("client", Text, nullable=False),
    sa.Column("number", Big, nullable=False),
    sa.Column("kind", Text, nullable=False),
    sa.Column("refused", Text, nullable=False),
    sa.Column("digest", Text, nullable=False),
    sa.Column("prev", Text, nullable=False),
    sa.Column("hash", Text, nullable=False),
    sa.UniqueConstraint("case_id", "actor", "client", "number", name="said_once"),
)  # fmt: skip

payloads = sa.Table(
    "payloads", metadata,
    sa.Column("case_id", Text, primary_key=True),
    sa.Column("seq", Big, primary_key=True, autoincrement=False),
    sa.Column("salt", Text, nullable=False),
    sa.Column("body", sa.JSON, nullable=False),
    sa.ForeignKeyConstraint(["case_id", "seq"], ["events.case_id", "events.seq"]),
)  # fmt: skip

scans = sa.Table(
    "scans", metadata,
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
    sa.Column("id", Text, primary_key=True),
    sa.Column("rig", Text, nullable=False),
    sa.Column("label", Text, nullable=False),
    sa.Column("taken_ns", Big, nullable=False),
    sa.Column("figures", sa.JSON, nullable=False),
)  # fmt: skip

blobs = sa.Table(
    "blobs", metadata,
    sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
    sa.Column("owner", Text, primary_key=True),  # a scan, a pattern, a picture
    sa.Column("name", Text, primary_key=True),
    sa.Column("sha256", Text, nullable=False, index=True),
    sa.Column("size", Big, nullable=False),
    sa.Column("type", Text, nullable=False),
)  # fmt: skip

jobs = sa.Table(
    "jobs", metadata,
    sa.Column("id", Text, primary_key=True),
    sa.Column("kind", Text, nullable=False),
    sa.Column("case_id", Text),
    sa.Column("person_id", Text, nullable=False),
    sa.Column("state", Text, nullable=False),
    sa.Column("stage", Text, nullable=False),
    sa.Column("share", sa.Float, nullable=False),
    sa.Column("why", Text, nullable=False),
    sa.Column("result", sa.JSON),
    sa.Column("created_ns", Big, nullable=False),
    sa.Column("ended_ns", Big),
)  # fmt: skip

_PAGES_AT_WORST = 8000  #: of SQLite's log ahead, before a commit stops to bring them into its file
_HELD = 0x6672696E67650001  #: the number of our lock among a database's advisory ones
MIGRATIONS = Path(__file__).with_name("migrations")


def open_engine(url: str) -> sa.Engine:
    """A database by its URL. SQLite keeps a journal ahead, waits for the disk at each commit, and holds references.

    Raises FormatError for a URL that is none.
    """
    try:
        parsed = sa.make_url(url)
        if parsed.get_backend_name() == "postgresql" and parsed.drivername == "postgresql":
            parsed = parsed.set(drivername="postgresql+psycopg")
        engine = sa.create_engine(parsed, pool_pre_ping=True, pool_size=8, max_overflow=24)
    except (sa.exc.ArgumentError, sa.exc.NoSuchModuleError, ModuleNotFoundError) as e:
        raise FormatError(f"database {url!r}: {e}; needed a URL as postgresql://user@host/name") from e
    if engine.dialect.name == "sqlite":
        sa.event.listen(engine, "connect", _set_up_sqlite)
        sa.event.listen(engine, "begin", _begin_at_once)
    return engine


def _set_up_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # transactions begin where `_begin_at_once` says, not where the driver guesses
    cursor = connection.cursor()
    for line in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=10000",
                 f"wal_autocheckpoint={_PAGES_AT_WORST}",
                 "secure_delete=ON"):  # fmt: skip  # what is erased is overwritten
        cursor.execute(f"PRAGMA {line}")
    cursor.close()


def _begin_at_once(connection: sa.Connection) -> None:
    options = connection.get_execution_options()
    if options.get("reads", False):
        connection.exec_driver_sql("BEGIN")
        return
    connection.exec_driver_sql(f"PRAGMA synchronous={'NORMAL' if options.get('early', False) else 'FULL'}")
    connection.exec_driver_sql("BEGIN IMMEDIATE")


@contextmanager
def writing(engine: sa.Engine, early: bool = False) -> Iterator[sa.Connection]:
    """A transaction that changes something. Raises OutputError where the disk is full or nobody answers.

    `early`: SQLite does not wait for the disk. What was written outlives this process, however it ends, but a power cut
    only once `flush` has returned.
    """
    try:
        with engine.connect().execution_options(early=early) as connection, connection.begin():
            yield connection
    except sa.exc.OperationalError as e:
        raise OutputError(f"the database cannot be written: {e.orig}; nothing was changed") from e


@contextmanager
def reading(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A transaction that only looks."""
    with engine.connect().execution_options(reads=True) as connection:
        yield connection


def flush(engine: sa.Engine) -> None:
    """Waits until all that was written early is on the disk. Raises OutputError."""
    if engine.dialect.name != "sqlite":
        return
    try:
        number = os.open(_ahead(engine), os.O_RDWR)
    except FileNotFoundError:
        return  # nothing waits
    except OSError as e:
        raise OutputError(f"{_ahead(engine)}: {e.strerror}") from e
    try:
        getattr(os, "fdatasync", os.fsync)(number)
    except OSError as e:
        raise OutputError(f"{_ahead(engine)}: the disk did not take it: {e.strerror}") from e
    finally:
        os.close(number)


def tidy(engine: sa.Engine) -> None:
    """Brings SQLite's log ahead into its file, beside the commits: so none of them has to stop for that."""
    if engine.dialect.name == "sqlite":
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as c:
            connection: Any = c.connection.dbapi_connection
            connection.execute("PRAGMA wal_checkpoint(PASSIVE)")


def _ahead(engine: sa.Engine) -> Path:
    return Path(f"{engine.url.database}-wal")


def forget_erased(engine: sa.Engine) -> None:
    """SQLite's log ahead may still hold what was erased: it is written back and emptied, if nobody reads just now."""
    if engine.dialect.name == "sqlite":
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as c:
            connection: Any = c.connection.dbapi_connection
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


class Held:
    """A database that others can reach, held by one hub: a lock that lasts as long as a connection does."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._connection: sa.Connection | None = None

    def take(self) -> None:
        """Takes hold of it. Raises OutputError if another hub has it, or nobody answers."""
        try:
            self._connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            self._connection.detach()  # it is no part of the pool: when it is closed the lock is gone
            ours = self._connection.execute(sa.select(sa.func.pg_try_advisory_lock(_HELD))).scalar()
        except sa.exc.OperationalError as e:
            self.let_go()
            raise OutputError(f"the database cannot be reached: {' '.join(str(e.orig).split())}; is it there?") from e
        if not ours:
            self.let_go()
            raise HeldError("another hub runs on this database; stop it first, or give this one a database of its own")

    def renew(self) -> None:
        """Takes hold anew where the database was started anew meanwhile. Raises HeldError if another hub was quicker,
        OutputError while nobody answers.
        """
        if self._connection is not None:
            try:
                self._connection.execute(sa.select(1))
                return
            except sa.exc.DBAPIError:
                self.let_go()
        self.take()

    def let_go(self) -> None:
        """Others may have it."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(sa.exc.DBAPIError):
                connection.close()


class HeldError(OutputError):
    """Another hub has the database."""


def hold(engine: sa.Engine) -> Held | None:
    """Takes hold of a database that others can reach, one hub at a time; None for SQLite, whose folder is held.

    Raises OutputError if another hub has it.
    """
    if engine.dialect.name == "sqlite":
        return None
    held = Held(engine)
    held.take()
    return held


def _alembic(engine: sa.Engine) -> AlembicConfig:
    config = AlembicConfig()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.attributes["engine"] = engine
    return config


def migrate(engine: sa.Engine) -> tuple[str | None, str]:
    """Brings the tables to the present version; returns the versions before and after.

    Raises FormatError for a database of a later version of this software, OutputError where it cannot be reached.
    """
    config = _alembic(engine)
    head = ScriptDirectory.from_config(config).get_current_head()
    assert head is not None
    try:
        with reading(engine) as connection:
            before = MigrationContext.configure(connection).get_current_revision()
        command.upgrade(config, "head")
    except sa.exc.OperationalError as e:
        raise OutputError(f"the database cannot be reached: {e.orig}") from e
    except CommandError as e:
        raise FormatError(f"the database is of a later version than this software: {e}; use that version") from e
    return before, head
