"""The API of a hub, as methods."""

from __future__ import annotations

import contextlib
import shutil
import ssl
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import httpx

from fringescope.errors import FringescopeError
from fringescope.wire import Account, Case, CaseList, Invitation, Job, JobState, Person, ScanInfo
from fringescope.wire.documents import CaseState, Erased, InstrumentState
from fringescope.wire.room import Event, Said

if TYPE_CHECKING:
    from fringescope.client.room import Room


class HubError(FringescopeError):
    """A hub said no, or does not answer; `status` is that of HTTP, 0 without an answer."""

    def __init__(self, message: str, status: int = 0) -> None:
        super().__init__(message)
        self.status = status


class Client:
    """Somebody who is signed in at a hub. Raises HubError, with the hub's own sentence.

    `verify`: False or a file with a certificate, for a hub that made its own. `http`: another transport, for tests.
    """

    def __init__(
        self,
        url: str,
        name: str | None = None,
        password: str | None = None,
        *,
        verify: bool | str = True,
        timeout_s: float = 30.0,
        http: httpx.Client | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self.verify: bool | ssl.SSLContext = verify if isinstance(verify, bool) else _trusting(verify)
        self.http = http or httpx.Client(base_url=self.url, verify=self.verify, timeout=timeout_s)
        self.account: Account | None = None
        if name is not None:
            self.sign_in(name, password or "")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; the session goes on until it is signed out or has expired."""
        self.http.close()

    # --------------------------------------------------------------------------------------------------------- asking

    def ask(self, method: str, path: str, body: Any = None, **query: Any) -> Any:
        """One request, its answer as plain values."""
        answer = self.raw(method, path, body, **query)
        return answer.json() if answer.content else None

    def raw(
        self, method: str, path: str, body: Any = None, content: bytes | Iterable[bytes] | None = None,
        headers: Mapping[str, str] | None = None, **query: Any,
    ) -> httpx.Response:  # fmt: skip
        """One request, its answer as it came."""
        headers = dict(headers or {})
        if self.account and method != "GET":
            headers["X-CSRF-Token"] = self.account.csrf
        params = {k: v for k, v in query.items() if v is not None}
        try:
            answer = self.http.request(method, path, json=body, content=content, params=params, headers=headers)
        except httpx.HTTPError as e:
            raise HubError(f"{self.url}: {e or type(e).__name__}; is the hub there?") from e
        if answer.status_code >= 400:
            raise HubError(_why(answer, f"{method} {path}"), answer.status_code)
        return answer

    # ---------------------------------------------------------------------------------------------------------- people

    def sign_in(self, name: str, password: str) -> Account:
        """Signs in."""
        self.account = Account(**self.ask("POST", "/api/login", {"name": name, "password": password}))
        return self.account

    def accept(self, token: str, code: str) -> Account:
        """Comes in as a guest, by an invitation."""
        self.account = Account(**self.ask("POST", "/api/invitations/accept", {"token": token, "code": code}))
        return self.account

    def sign_out(self) -> None:
        """Signs out."""
        self.ask("POST", "/api/logout")
        self.account = None

    def confirm(self, password: str) -> None:
        """The password once more, before a signature."""
        self.ask("POST", "/api/confirm", {"password": password})

    @property
    def me(self) -> Account:
        """Who is signed in."""
        if self.account is None:
            raise HubError("nobody is signed in; sign in first", 401)
        return self.account

    def people(self) -> list[Person]:
        """Everybody with an account."""
        return [Person(**p) for p in self.ask("GET", "/api/people")]

    def add_person(self, name: str, password: str, role: str) -> Person:
        """A new account."""
        return Person(**self.ask("POST", "/api/people", {"name": name, "password": password, "role": role}))

    # ----------------------------------------------------------------------------------------------------------- cases

    def cases(self, q: str = "", status: str | None = None, limit: int = 50, offset: int = 0) -> CaseList:
        """Cases that you may see, the latest first."""
        return CaseList(**self.ask("GET", "/api/cases", q=q, status=status, limit=limit, offset=offset))

    def open_case(
        self,
        accession: str,
        specimen: Mapping[str, str] | None = None,
        patient: Mapping[str, str] | None = None,
    ) -> HubCase:
        """A new case."""
        body = {"accession": accession, "specimen": dict(specimen or {}), "patient": dict(patient) if patient else None}
        return HubCase(self, Case(**self.ask("POST", "/api/cases", body)).id)

    def case(self, case: str) -> HubCase:
        """A case by its identifier."""
        return HubCase(self, Case(**self.ask("GET", f"/api/cases/{case}")).id)

    def import_case(self, bundle: Path) -> HubCase:
        """A bundle becomes a case again."""
        return HubCase(self, Case(**self.send("/api/cases/import", bundle).json()).id)

    def send(self, path: str, file: Path, **query: Any) -> httpx.Response:
        """A file as the body of a request, a piece at a time."""
        with file.open("rb") as f:
            size = {"content-length": str(file.stat().st_size), "content-type": "application/zip"}
            return self.raw("POST", path, content=iter(lambda: f.read(1 << 20), b""), headers=size, **query)

    def fetch(self, path: str, to: Path, **query: Any) -> Path:
        """An answer into a file, a piece at a time; the file is there whole or not at all."""
        part = to.with_name(f".{to.name}.part")
        try:
            with self._streamed(path, query) as answer, part.open("wb") as out:
                for piece in answer.iter_bytes(1 << 20):
                    out.write(piece)
            part.replace(to)
        except httpx.HTTPError as e:
            raise HubError(f"{self.url}: {e or type(e).__name__}; is the hub there?") from e
        finally:
            part.unlink(missing_ok=True)
        return to

    @contextlib.contextmanager
    def _streamed(self, path: str, query: Mapping[str, Any]) -> Iterator[httpx.Response]:
        params = {k: v for k, v in query.items() if v is not None}
        with self.http.stream("GET", path, params=params, timeout=600) as answer:
            if answer.status_code >= 400:
                answer.read()
                raise HubError(_why(answer, f"GET {path}"), answer.status_code)
            yield answer

    # -------------------------------------------------------------------------------------------------- the instrument

    def instrument(self) -> InstrumentState:
        """The instrument: is it there, what does it do."""
        return InstrumentState(**self.ask("GET", "/api/instrument"))

    def pose(self, board: Mapping[str, Any] | None = None) -> Job:
        """Photographs the calibration board where it lies now; the first pose of a session says which board it is."""
        return self.wait(Job(**self.ask("POST", "/api/instrument/poses", {"board": dict(board) if board else None})))

    def calibrate(self) -> Job:
        """The poses so far to a rig, which is used from then on; the result holds the verdict."""
        return self.wait(Job(**self.ask("POST", "/api/instrument/calibrate")))

    def stop(self) -> None:
        """Dark, whatever is projected."""
        self.ask("POST", "/api/instrument/stop")

    def befall(self, **what: str) -> None:
        """For the simulated instrument: something happens to the specimen, as move="0.3,0,0"."""
        self.ask("POST", "/api/instrument/simulate", what)

    def wait(self, job: Job, tell: Callable[[Job], None] | None = None, timeout_s: float = 600.0) -> Job:
        """Until a job has ended. Raises HubError if it failed."""
        end = time.monotonic() + timeout_s
        while True:
            job = Job(**self.ask("GET", f"/api/jobs/{job.id}"))
            if tell is not None:
                tell(job)
            if job.state in (JobState.DONE, JobState.CANCELLED, JobState.FAILED):
                break
            if time.monotonic() > end:
                raise HubError(f"job {job.id} has not ended in {timeout_s:g} s; it is {job.stage}")
            time.sleep(0.05)
        if job.state is not JobState.DONE:
            raise HubError(f"{job.kind}: {job.why}")
        return job


def _trusting(certificate: str) -> ssl.SSLContext:
    """TLS that believes one certificate. Raises HubError for a file that holds none."""
    try:
        return ssl.create_default_context(cafile=certificate)
    except OSError as e:  # an SSLError is one, too
        raise HubError(f"{certificate}: {e.strerror or e}; needed a certificate (PEM) of the hub") from e


def _why(answer: httpx.Response, asked: str) -> str:
    try:
        return str(answer.json()["detail"])
    except (ValueError, KeyError, TypeError):
        return f"{asked}: status {answer.status_code}"


class HubCase:
    """One case of a hub."""

    def __init__(self, hub: Client, case: str) -> None:
        self.hub, self.id = hub, case
        self._path = f"/api/cases/{case}"

    def get(self) -> Case:
        """What it is."""
        return Case(**self.hub.ask("GET", self._path))

    def change(self, **what: Any) -> Case:
        """Changes status, specimen or patient."""
        return Case(**self.hub.ask("PATCH", self._path, what))

    def state(self) -> CaseState:
        """Where it stands."""
        return CaseState(**self.hub.ask("GET", f"{self._path}/state"))

    def events(self, since: int = 0, limit: int = 2000) -> list[Event]:
        """The log behind number `since`."""
        return [Event(**e) for e in self.hub.ask("GET", f"{self._path}/events", since=since, limit=limit)]

    def say(self, ops: Sequence[Mapping[str, Any]]) -> list[Said]:
        """Ops, each with client, number and what, as after a time offline."""
        return [Said(**x) for x in self.hub.ask("POST", f"{self._path}/ops", [dict(o) for o in ops])]

    def scan(self, label: str = "", wait: bool = True, tell: Callable[[Job], None] | None = None) -> Job:
        """Takes a scan."""
        job = Job(**self.hub.ask("POST", f"{self._path}/scans", {"label": label}))
        return self.hub.wait(job, tell) if wait else job

    def compare(self, before: str, after: str, version: int | None = None) -> Job:
        """What was cut from one scan to another, and how far from the lines of a version."""
        body = {"before": before, "after": after, "version": version}
        return self.hub.wait(Job(**self.hub.ask("POST", f"{self._path}/compare", body)))

    def scans(self) -> list[ScanInfo]:
        """Its scans, with their files."""
        return [ScanInfo(**s) for s in self.hub.ask("GET", f"{self._path}/scans")]

    def fetch(self, sha256: str, to: Path | None = None) -> bytes:
        """A file by its content, kept in a file if you like."""
        data = self.hub.raw("GET", f"{self._path}/files/{sha256}").content
        if to is not None:
            to.write_bytes(data)
        return data

    def add_scan(self, scan: Path, label: str = "", present: bool | None = None, wait: bool = True) -> Job:
        """A scan that was made elsewhere: its folder, or that as a zip file."""
        with tempfile.TemporaryDirectory() as aside:
            file = scan
            if scan.is_dir():
                file = Path(shutil.make_archive(str(Path(aside) / "scan"), "zip", scan))
            told = None if present is None else str(present).lower()
            job = Job(**self.hub.send(f"{self._path}/scans/import", file, label=label, present=told).json())
        return self.hub.wait(job) if wait else job

    def bundle(self, to: Path, patient: bool = False) -> Path:
        """All of it as one file; with `patient` for operators, it names the patient."""
        return self.hub.fetch(f"{self._path}/bundle", to, patient="true" if patient else None)

    def erase(self, why: str) -> Erased:
        """Takes it out for good, for administrators; the log still verifies."""
        return Erased(**self.hub.ask("POST", f"{self._path}/erase", {"why": why}))

    def invite(self, name: str, role: str = "expert", hours: float = 72) -> Invitation:
        """Invites somebody; the answer alone holds token and code."""
        body = {"name": name, "role": role, "hours": hours}
        return Invitation(**self.hub.ask("POST", f"{self._path}/invitations", body))

    def revoke(self, invitation: str) -> Invitation:
        """Takes an invitation back: the guest is out."""
        return Invitation(**self.hub.ask("DELETE", f"{self._path}/invitations/{invitation}"))

    def enter(self, since: int = 0) -> Room:
        """Enters its room."""
        from fringescope.client.room import Room

        return Room(self, since)
