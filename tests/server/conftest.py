"""A hub that runs in this process, and people who are signed in at it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs fringescope[server]")

from sqlalchemy import Engine

from fringescope.client import Client
from fringescope.server import audit
from fringescope.server.config import Config
from fringescope.server.running import Server
from fringescope.wire import PersonRole
from tests.server.postgres import Cluster

#: for tests that hold whatever the database is
both = pytest.mark.parametrize("hub", ["sqlite", "postgres"], indirect=True)
PASSWORD = "correct horse battery"  # of everybody in these tests
DEVICE = "sim://paper/tissue-domed?scale=0.06&seed=3"


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster]:
    """A PostgreSQL server; skipped by name where there is none."""
    made = Cluster()
    yield made
    made.close()


def database(request: pytest.FixtureRequest) -> str | None:
    """The URL of an empty database, of the kind that a test was parametrised with; None for SQLite in the folder."""
    if getattr(request, "param", "sqlite") == "sqlite":
        return None
    url: str = request.getfixturevalue("cluster").new()
    return url


@pytest.fixture
def hub(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Server]:
    """A hub without an instrument; somebody of each role has an account, by the name of the role.

    On SQLite, or as in `@both`.
    """
    with Server(Config(tmp_path / "hub", port=0, database=database(request)), fast_passwords=True) as server:
        populate(server)
        yield server


def populate(server: Server) -> None:
    for role in PersonRole:
        server.site.accounts.add(role.value, PASSWORD, role)


SignIn = Callable[[str], Client]


@pytest.fixture
def sign_in(hub: Server) -> Iterator[SignIn]:
    """Somebody by the name of their role."""
    opened: list[Client] = []

    def enter(name: str) -> Client:
        opened.append(Client(hub.url, name, PASSWORD))
        return opened[-1]

    yield enter
    for client in opened:
        client.close()


@pytest.fixture(scope="session")
def scan_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scan of a wet specimen, as `fringescope reconstruct` leaves it: not to be changed."""
    from fringescope import cli

    at = tmp_path_factory.mktemp("small")
    made = ["simulate", "tissue-domed", "--scale", "0.06", "--seed", "3", "--out", str(at / "capture")]
    assert cli.run(made) == 0
    rig = at / "capture" / "truth" / "rig.json"
    assert cli.run(["reconstruct", str(at / "capture"), "--rig", str(rig), "--out", str(at / "scan")]) == 0
    return at / "scan"


def checked(engine: Engine) -> tuple[int, int, list[str]]:
    """Cases, events and faults of a hub's log, by itself: no checkpoints."""
    found = audit.verify(engine, Path("nowhere"))
    return found.cases, found.events, list(found.faults)
