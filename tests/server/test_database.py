"""The tables and how they come to be, on SQLite and on PostgreSQL; what the database itself refuses."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from fringescope.client import Client
from fringescope.errors import FormatError, OutputError
from fringescope.server import database as db
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from fringescope.server.site import open_site
from tests.server.conftest import PASSWORD, SignIn, both, checked, database
from tests.server.postgres import Cluster
from tests.server.test_hub import SCAN, scanned, stroke

empty = pytest.mark.parametrize("engine", ["sqlite", "postgres"], indirect=True)


@pytest.fixture
def engine(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[sa.Engine]:
    """An empty database."""
    made = db.open_engine(database(request) or f"sqlite:///{tmp_path / 'hub.sqlite'}")
    yield made
    made.dispose()


def differences(engine: sa.Engine) -> list[Any]:
    with engine.connect() as c:
        return list(compare_metadata(MigrationContext.configure(c, opts={"compare_type": True}), db.metadata))


def soon(true: Callable[[], bool], seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    return true()


@empty
def test_migrations_make_exactly_the_tables_that_the_code_knows(engine: sa.Engine) -> None:
    assert len(differences(engine)) >= len(db.metadata.tables)  # the comparison sees what is missing
    assert db.migrate(engine) == (None, "0001")
    assert differences(engine) == []
    assert db.migrate(engine) == ("0001", "0001")


@empty
def test_down_and_up_again(engine: sa.Engine) -> None:
    db.migrate(engine)
    command.downgrade(db._alembic(engine), "base")
    assert set(sa.inspect(engine).get_table_names()) == {"alembic_version"}
    if engine.dialect.name == "postgresql":
        with engine.connect() as c:
            assert c.exec_driver_sql("SELECT count(*) FROM pg_proc WHERE proname = 'only_added'").scalar() == 0
    assert db.migrate(engine) == (None, "0001")
    assert differences(engine) == []


@empty
def test_a_database_of_a_later_version_is_left_alone(engine: sa.Engine) -> None:
    db.migrate(engine)
    with engine.begin() as c:
        c.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(FormatError, match="later version"):
        db.migrate(engine)


@pytest.mark.parametrize(
    "line",
    [
        "UPDATE events SET actor = 'somebody else' WHERE seq = 1",
        "DELETE FROM events WHERE seq = 4",
        "UPDATE payloads SET body = '{}'",
        "INSERT INTO payloads (case_id, seq, salt, body) VALUES ('case-of-nobody', 1, '', '{}')",
    ],
)
@both
def test_the_database_itself_refuses_to_alter_the_log(hub: Server, sign_in: SignIn, line: str) -> None:
    case = scanned(hub, sign_in("operator"))
    case.say([{"client": "c", "number": 1, "what": {"kind": "put", "stroke": stroke("s"), "scan": SCAN}}])
    before = case.events()
    with pytest.raises(sa.exc.DatabaseError), hub.site.engine.begin() as c:
        c.exec_driver_sql(line)
    assert case.events() == before
    assert checked(hub.site.engine)[2] == []


@both
def test_many_at_once_get_one_order(hub: Server, sign_in: SignIn) -> None:
    """Routes, rooms and accounts write at the same time: each answer names its event, and the chain is whole."""
    cases = [scanned(hub, sign_in("operator")) for _ in range(3)]
    answers: dict[int, list[int | None]] = {}

    def say(n: int) -> None:
        case = cases[n % 3]
        ops = [{"client": f"c{n}", "number": k, "what": {"kind": "put", "stroke": stroke(f"{n}-{k}"), "scan": SCAN}}
               for k in range(1, 11)]  # fmt: skip
        with Client(hub.url, "operator", PASSWORD) as me:
            answers[n] = [s.seq for s in me.case(case.id).say(ops)]

    threads = [threading.Thread(target=say, args=(n,)) for n in range(6)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    for n in range(3):
        given = sorted(s for k in (n, n + 3) for s in answers[k] if s is not None)
        assert given == list(range(4, 24))
    cases_, count, faults = checked(hub.site.engine)
    assert (cases_, count, faults) == (3, 69, [])


def test_one_hub_to_a_database(tmp_path: Path, cluster: Cluster) -> None:
    url = cluster.new()
    first = open_site(Config(tmp_path / "a", database=url))
    with pytest.raises(OutputError, match="another hub runs on this database; stop it first"):
        open_site(Config(tmp_path / "b", database=url))
    first.close()
    open_site(Config(tmp_path / "b", database=url)).close()


def test_a_database_that_was_started_anew_is_taken_again_or_the_hub_ends(tmp_path: Path) -> None:
    """The lock goes with the server; who was quicker has it, and the other hub ends instead of writing beside it."""
    cluster = Cluster()
    try:
        url = cluster.new()
        config = Config(tmp_path / "a", port=0, database=url, limits=Limits(doors_s=0.1))
        with Server(config, fast_passwords=True) as hub:
            held = hub.site.held
            assert held is not None
            before = held._connection
            cluster.stop()
            cluster.start()
            assert soon(lambda: held._connection not in (None, before))
            with pytest.raises(OutputError, match="another hub runs on this database"):
                open_site(Config(tmp_path / "b", database=url))
            engine = db.open_engine(url)
            second = db.Held(engine)
            with pytest.raises(db.HeldError, match="another hub runs on this database; stop it first"):
                second.renew()
            engine.dispose()

            def quicker() -> None:
                raise db.HeldError("another hub runs on this database")

            held.renew = quicker  # type: ignore[method-assign]
            assert soon(lambda: hub._thread is not None and not hub._thread.is_alive())
    finally:
        cluster.close()


def test_a_database_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be reached"):
        open_site(Config(tmp_path, database=f"postgresql://hub@/none?host={tmp_path}"))


def test_the_database_goes_away_and_comes_back(tmp_path: Path) -> None:
    """What is said meanwhile is refused with a sentence and did not happen; afterwards all goes on by itself."""
    cluster = Cluster()
    try:
        with Server(Config(tmp_path, port=0, database=cluster.new()), fast_passwords=True) as hub:
            from tests.server.conftest import populate

            populate(hub)
            with Client(hub.url, "operator", PASSWORD) as operator:
                case = scanned(hub, operator)
                with case.enter() as room:
                    room.draw(stroke("a"))
                    cluster.stop()
                    said = asyncio.run_coroutine_threadsafe(
                        hub.site.hub.note(case.id, "nobody", "operator", "changed", {}), hub.loop
                    ).result(20)
                    assert said.seq is None
                    assert "nothing was changed" in said.refused
                    cluster.start()
                    room.draw(stroke("b"))
                    assert [e.seq for e in room.events] == [1, 2, 3, 4, 5]
                assert checked(hub.site.engine)[1:] == (5, [])
    finally:
        cluster.close()
