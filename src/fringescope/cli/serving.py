"""Verbs of the hub: serve, person."""

from __future__ import annotations

import contextlib
import getpass
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Json, SetOption, SettingsFile, emit, load_settings, say
from fringescope.errors import FormatError, UsageError

if TYPE_CHECKING:
    from fringescope.server.config import Config

Data = Annotated[Path, typer.Option("--data", help="The hub's folder: accounts, cases, scans.")]
Database = Annotated[
    str | None, typer.Option(metavar="URL", help="postgresql://user@host/name; default: SQLite in the folder.")
]
HOME = Path("fringescope-hub")


def needs_extra() -> None:
    """Raises UsageError where the hub's packages are missing."""
    try:
        import fastapi
        import sqlalchemy
        import uvicorn

        assert fastapi, (sqlalchemy, uvicorn)
    except ImportError as e:
        raise UsageError(f"the hub needs more packages ({e.name}): pip install 'fringescope[server]'") from None


@app.command()
def serve(
    data: Data = HOME,
    host: Annotated[str, typer.Option(help="Address to listen at; others than loopback need TLS and accounts.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="0: any that is free.", min=0, max=65535)] = 8017,
    device: Annotated[str | None, typer.Option(metavar="URI", help="The instrument, as sim://paper/tissue-domed.")] = (
        None
    ),
    rig: Annotated[Path | None, typer.Option(help="Its rig.json; the simulated one brings its own.")] = None,
    database: Database = None,
    certificate: Annotated[Path | None, typer.Option(help="TLS: the certificate, PEM.")] = None,
    key: Annotated[Path | None, typer.Option(help="TLS: its key, PEM.")] = None,
    self_signed: Annotated[bool, typer.Option("--self-signed", help="TLS with a certificate made here.")] = False,
    origin: Annotated[
        list[str] | None, typer.Option(help="Another origin of its pages, as https://hub.example.org.")
    ] = None,
    behind_proxy: Annotated[
        bool, typer.Option("--behind-proxy", help="Another server hands requests on: nobody is local by address.")
    ] = False,
    local_port: Annotated[
        int | None,
        typer.Option(help="Behind a proxy: a port of this machine alone, for who is at the instrument.", max=65535),
    ] = None,
    oidc_issuer: Annotated[
        str | None, typer.Option(metavar="URL", help="An identity provider (OpenID Connect) whose people may come in.")
    ] = None,
    oidc_client: Annotated[str, typer.Option(help="What this hub is called there.")] = "",
    oidc_secret: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Its secret there; else FRINGESCOPE_OIDC_SECRET.")
    ] = None,
    oidc_role_claim: Annotated[str | None, typer.Option(help="The claim that names the role, as roles.")] = None,
    oidc_role: Annotated[str | None, typer.Option(help="The role of people without one in the claim.")] = None,
    oidc_admit: Annotated[bool, typer.Option("--oidc-admit", help="Whom nobody knows gets an account.")] = False,
    settings: SettingsFile = None,
    set_: SetOption = None,
) -> None:
    """The hub: cases, shared drawing, and the instrument, for the operator here and experts anywhere."""
    needs_extra()
    from fringescope.server import running
    from fringescope.server.config import Config, Provider

    if self_signed:
        if certificate or key:
            raise UsageError("--self-signed makes a certificate; leave --certificate and --key away")
        certificate, key = running.self_signed(data / "tls", host)
    provider = None
    if oidc_issuer is not None:
        secret = _secret(oidc_secret)
        provider = Provider(oidc_issuer, oidc_client, secret, oidc_role_claim, oidc_role, oidc_admit)
    config = Config(
        data, host, port, database, device, rig, certificate, key, tuple(origin or ()), behind_proxy,
        local_port, load_settings(settings, set_), provider=provider,
    )  # fmt: skip
    server = running.Server(config)
    server.check()
    running.first_admin(server.site, say)
    say(f"research use only; the hub listens at {server.url} (data in {data}); Ctrl-C ends it")
    if server.config.local_port is not None:
        scheme = "https" if server.config.tls else "http"
        say(f"at the instrument itself: {scheme}://localhost:{server.config.local_port}; hand this port on to nobody")
    with contextlib.suppress(KeyboardInterrupt):  # it has ended in good order by then
        server.run()
    say("the hub has ended")


def _secret(file: Path | None) -> str:
    """The secret of the hub at its identity provider: never an argument, which everybody on the machine could read."""
    if file is None:
        return os.environ.get("FRINGESCOPE_OIDC_SECRET", "")
    try:
        return file.read_text().strip()
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"--oidc-secret {file}: {getattr(e, 'strerror', None) or e}; needed a text file") from None


def _config(data: Path, database: str | None) -> Config:
    needs_extra()
    from fringescope.server.config import Config

    if not data.is_dir() and database is None:
        raise UsageError(f"{data}: no hub's folder; start one first: fringescope serve --data {data}")
    return Config(data, database=database)


@app.command()
def person(
    what: Annotated[str, typer.Argument(help="add, list, disable, enable or password.")],
    name: Annotated[str | None, typer.Argument(help="The name to sign in with.")] = None,
    role: Annotated[str, typer.Option(help="operator, expert, observer or admin.")] = "expert",
    data: Data = HOME,
    database: Database = None,
    json: Json = False,
) -> None:
    """Accounts of a hub that does not run just now; a password is asked for, or read from a pipe."""
    needs_extra()
    from fringescope.server.site import open_site
    from fringescope.wire import PersonRole

    actions = ("add", "list", "disable", "enable", "password")
    if what not in actions:
        raise UsageError(f"person {what}; needed one of {', '.join(actions)}")
    if (name is None) == (what != "list"):
        raise UsageError(f"person {what}: " + ("needed a name" if name is None else "takes no name"))
    if role not in [r.value for r in PersonRole]:
        raise UsageError(f"--role {role}; needed one of {', '.join(r.value for r in PersonRole)}")
    if what == "add":
        data.mkdir(parents=True, exist_ok=True)
    site = open_site(_config(data, database))
    try:
        accounts = site.accounts
        if what == "list":
            people = [p.model_dump(mode="json") for p in accounts.people()]
            lines = [f"{p['name']}: {p['role']}{', disabled' if p['disabled'] else ''}" for p in people]
            emit({"people": people}, json, lines or ["nobody has an account"])
            return
        known = next((p for p in accounts.people() if p.name == name), None)
        if what == "add":
            assert name is not None
            made = accounts.add(name, _password(name), PersonRole(role))
            emit(made.model_dump(mode="json"), json, [f"{name} may come in, as {role}"])
            return
        if known is None:
            raise FormatError(f"{name}: nobody has this account; see: fringescope person list")
        if what == "password":
            known = accounts.change(known.id, password=_password(known.name))
        else:
            known = accounts.change(known.id, disabled=what == "disable")
        emit(known.model_dump(mode="json"), json, [f"{name}: done; whatever was open is closed"])
    finally:
        site.close()


def _password(name: str) -> str:
    if sys.stdin.isatty():
        first = getpass.getpass(f"password of {name}: ")
        if getpass.getpass("once more: ") != first:
            raise UsageError("the passwords differ; nothing was changed")
        return first
    line = sys.stdin.readline().rstrip("\r\n")
    if not line:
        raise UsageError("no password; type one, or send it through a pipe")
    return line
