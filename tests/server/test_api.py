"""The whole API against its own description, for everybody: whatever is asked, no fault of ours, and what was promised.

Schemathesis makes the requests from `/openapi.json`, good ones and bad ones; half of them are about things that are
really there, so that they come past the front door.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import requests
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fringescope.client import Client
from fringescope.server.accounts import SignInError
from fringescope.server.config import Config, Limits
from fringescope.server.running import Server
from tests.server.conftest import PASSWORD, checked, database, populate
from tests.server.test_hub import SCAN, invite, scanned, stroke

schemathesis = pytest.importorskip("schemathesis", reason="needs fringescope[dev]")

ROLES = ("operator", "expert", "observer", "admin", "guest", "stranger")
CHECKED = ("not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
           "response_headers_conformance")  # fmt: skip


@dataclass
class World:
    """A hub with a case in it, and what is there to be asked about."""

    server: Server
    schema: Any
    real: dict[str, list[str]]
    guest: tuple[str, str]
    answers: dict[tuple[str, int], int] = field(default_factory=dict)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[World]:
    limits = Limits(requests_per_s=1e6, requests_burst=10**6, ops_per_s=1e6, ops_burst=10**6, log_bytes_burst=10**9,
                    logins_per_minute=1e7, failures=10**6)  # fmt: skip
    config = Config(tmp_path_factory.mktemp("api"), port=0, database=database(request), limits=limits)
    with Server(config, fast_passwords=True) as server, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tool, about itself
        populate(server)
        with Client(server.url, "operator", PASSWORD) as operator, Client(server.url, "admin", PASSWORD) as admin:
            case, other = scanned(server, operator), scanned(server, operator)
            for role in ("expert", "observer"):
                with Client(server.url, role, PASSWORD) as somebody:
                    invite(case, somebody)
            pen = admin.add_person("pen", PASSWORD, "expert")
            with case.enter() as room:
                room.draw(stroke("s"))
                room.comment("here")
                room.submit()
            guest = case.invite("guest")
            invitation = case.invite("nobody yet")
            job = case.scan(wait=False)  # there is no instrument: it fails, and stays to be asked about
            schema = schemathesis.openapi.from_url(f"{server.url}/openapi.json")
            blob, size = server.site.blobs.put(b"0123456789" * 100)
            add_file(server, case.id, blob, size)
        assert guest.token is not None
        assert guest.code is not None
        real = {
            "case": [case.id, other.id], "person": [pen.id], "invitation": [invitation.id], "job": [job.id],
            "sha256": [blob],
        }  # fmt: skip
        yield World(server, schema, real, (guest.token, guest.code))


def add_file(server: Server, case: str, blob: str, size: int) -> None:
    from fringescope.server import cases
    from fringescope.server import database as db
    from fringescope.wire import ScanFile

    with db.writing(server.site.engine) as c:
        cases.insert_files(c, case, SCAN, [ScanFile(name="a.bin", sha256=blob, size=size, type="application/x-bin")])


class People:
    """One of each, signed in again where a request has signed them out; a guest comes in once."""

    def __init__(self, world: World) -> None:
        self._world, self._clients = world, {role: self._enter(world, role) for role in ROLES}

    @staticmethod
    def _enter(world: World, role: str) -> Client:
        if role == "stranger":
            return Client(world.server.url)
        if role == "guest":
            client = Client(world.server.url)
            client.accept(*world.guest)
            return client
        return Client(world.server.url, role, PASSWORD)

    def __getitem__(self, role: str) -> Client:
        client = self._clients[role]
        if role not in ("guest", "stranger"):
            try:
                world_session(self._world, client)
            except SignInError:
                client.sign_in(role, PASSWORD)
        return client

    def close(self) -> None:
        for client in self._clients.values():
            client.close()


def world_session(world: World, client: Client) -> None:
    world.server.site.accounts.session(client.http.cookies.get("fringescope", ""))


schemathesis.openapi.media_type("application/zip", st.binary(max_size=2000))


@schemathesis.serializer("application/zip")
def as_it_is(_ctx: Any, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


def everything(world: World, examples: int) -> None:
    """Each operation, by everybody."""
    from schemathesis.checks import CHECKS

    checks = [c for c in CHECKS.get_all() if c.__name__ in CHECKED]
    assert len(checks) == len(CHECKED)
    people = People(world)
    with requests.Session() as session:
        for result in world.schema.get_all_operations():
            one(world, result.ok(), people, session, checks, examples)
    people.close()


def one(
    world: World, operation: Any, people: People, session: requests.Session, checks: list[Any], examples: int
) -> None:
    """Good requests about what is there, then bad ones, also about what is not, and without the token."""
    name = f"{operation.method.upper()} {operation.path}"
    good = operation.as_strategy(generation_mode=schemathesis.GenerationMode.POSITIVE)
    bad = (
        operation.as_strategy(generation_mode=schemathesis.GenerationMode.NEGATIVE) if _can_be_bad(operation) else good
    )

    def ask(case: Any, real: int) -> None:
        for key in case.path_parameters or {}:
            if real and key in world.real and not operation.path.endswith("/erase"):  # the others need it yet
                case.path_parameters[key] = world.real[key][real == 9 and -1]
        for role in ROLES:
            if (role, operation.path) == ("guest", "/api/logout"):
                continue
            client = people[role]
            token = {"X-CSRF-Token": client.account.csrf} if client.account and real != 1 else {}
            cookies = {c.name: c.value for c in client.http.cookies.jar}
            headers = {**(case.headers or {}), **token}
            answer = case.call(base_url=world.server.url, session=session, headers=headers, cookies=cookies)
            session.cookies.clear()
            world.answers[name, answer.status_code] = world.answers.get((name, answer.status_code), 0) + 1
            case.validate_response(answer, checks=checks)
            if answer.status_code >= 400:
                why = answer.json()["detail"]
                assert why
                assert "\n" not in why
                assert "Traceback" not in why

    how = settings(max_examples=examples, deadline=None, database=None, derandomize=True,
                   suppress_health_check=list(HealthCheck))  # fmt: skip
    for strategy, real in ((good, st.integers(2, 9)), (bad, st.integers(0, 9))):
        how(given(case=strategy, real=real)(ask))()


def _can_be_bad(operation: Any) -> bool:
    """Where nothing is asked for, or any bytes are taken, nothing can be wrong."""
    if operation.path.endswith("/import"):
        return False
    return bool(operation.body) or any(len(list(group)) for group in (operation.path_parameters, operation.query))


def judged(world: World) -> None:
    """Not only closed doors: each operation was also carried out, by who may; and the log is whole."""
    done = {name for (name, status) in world.answers if status < 300}
    asked = {name for (name, _) in world.answers}
    never = {  # without an instrument, a stale version, the right password or code
        "POST /api/password", "POST /api/confirm", "POST /api/login", "POST /api/invitations/accept",
        "POST /api/cases/{case}/carry_over", "POST /api/instrument/simulate", "POST /api/cases/import",
        "POST /api/cases/{case}/erase", "POST /api/passkeys", "POST /api/passkeys/login", "POST /api/passkeys/confirm",
        "DELETE /api/passkeys/{key}", "GET /api/provider/begin", "GET /api/provider/callback",
        "POST /api/people",  # whose names are judged by what they look like
    }  # fmt: skip
    assert asked - done - never == set()
    assert checked(world.server.site.engine)[2] == []


@pytest.mark.parametrize("world", ["sqlite"], indirect=True)
def test_the_api_does_what_it_says(world: World) -> None:
    everything(world, 4)
    judged(world)


@pytest.mark.verify
@pytest.mark.parametrize("world", ["sqlite", "postgres"], indirect=True)
def test_the_api_does_what_it_says_at_length(world: World) -> None:
    everything(world, 40)
    judged(world)
