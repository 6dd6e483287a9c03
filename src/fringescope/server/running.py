"""A hub started: sockets, TLS, the first account, and an orderly end."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
import os
import secrets
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import uvicorn

from fringescope.errors import OutputError, UsageError
from fringescope.server.app import make_app
from fringescope.server.config import LOOPBACK, Config
from fringescope.server.connections import Door, Http, WebSocket, more_files
from fringescope.server.site import Site
from fringescope.wire import PersonRole

_DEAF_MS = 60_000  #: a connection through which nothing can be sent for so long is given up
_BACKLOG = 2048  #: connections that wait to be taken
_FILES = 8192  #: open files that are asked for
_OWN_FILES = 200  #: of them for the database, scans, processes and this machine's own connections
DAYS = 397  #: how long a self-made certificate is good


class Server:
    """A hub in a thread of this process, or in this one: `url` is where it answers, `close` ends it."""

    def __init__(self, config: Config, *, fast_passwords: bool = False) -> None:
        import argon2

        self._socket = _bind(config)
        self._sockets = [self._socket]
        port, local = self._socket.getsockname()[1], config.local_port
        if local is not None:
            try:
                near = replace(config, host="127.0.0.1", port=local, behind_proxy=False, local_port=None)
                self._sockets.append(_bind(near))
            except BaseException:
                self._socket.close()
                raise
            local = self._sockets[1].getsockname()[1]
        self.config = replace(config, port=port, local_port=local)
        hasher = argon2.PasswordHasher(1, 8, 1) if fast_passwords else None
        try:
            self.app = make_app(self.config, hasher)
        except BaseException:
            for made in self._sockets:
                made.close()
            raise
        self.site: Site = self.app.state.site
        for made in self._sockets:
            made.listen(_BACKLOG)  # who comes before it is ready waits, instead of being told that nobody is here
        scheme = "https" if config.tls else "http"
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.url = f"{scheme}://{host}:{port}"
        limits = config.limits
        self._uvicorn = uvicorn.Server(
            uvicorn.Config(
                self.app, http=partial(Http, door=self._socket), ws=partial(WebSocket, door=self._socket),  # type: ignore[arg-type]
                log_level="warning", ssl_certfile=config.certificate, ssl_keyfile=config.key,
                ws_max_size=4 * limits.message_bytes, ws_ping_interval=20, ws_ping_timeout=20, proxy_headers=False,
                server_header=False, timeout_graceful_shutdown=5, timeout_keep_alive=30, ws_per_message_deflate=False,
            )
        )  # fmt: skip
        self.site.end = self._end
        self._thread: threading.Thread | None = None
        self.loop: asyncio.AbstractEventLoop | None = None  #: that of the hub, while it runs

    def check(self) -> None:
        """Raises UsageError where others could come in and nobody has an account."""
        if self.config.host not in LOOPBACK and not self.site.accounts.any():
            raise UsageError(
                f"--host {self.config.host}: nobody has an account yet; make one first: fringescope person add NAME "
                "--role admin --data FOLDER"
            )

    def run(self) -> None:
        """Serves until it is told to end."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self.loop = asyncio.get_running_loop()
        await self._uvicorn.serve(list(self._sockets))

    def start(self, timeout_s: float = 60.0) -> Server:
        """Serves in a thread; returns once it answers. Raises OutputError if it does not."""
        self._thread = threading.Thread(target=self.run, name="hub", daemon=True)
        self._thread.start()
        end = threading.Event()
        for _ in range(int(timeout_s / 0.02)):
            if self._uvicorn.started:
                return self
            if not self._thread.is_alive():
                break
            end.wait(0.02)
        raise OutputError("the hub did not start; see what it printed above")

    def _end(self) -> None:
        self._uvicorn.should_exit = True

    def close(self) -> None:
        """Ends it: dark, rooms closed, what waits is written."""
        self._end()
        if self._thread is not None:
            self._thread.join(60)

    def __enter__(self) -> Server:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()


def _bind(config: Config) -> Door:
    host, port, limits = config.host, config.port, config.limits
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    most = min(limits.connections, more_files(_FILES) - _OWN_FILES)
    made = Door(family, most, limits.connections_each, config.behind_proxy)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # who takes nothing for so long is cut off, closed or not
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAF_MS)
    try:
        made.bind((host, port))
    except (OSError, OverflowError) as e:
        made.close()
        why = getattr(e, "strerror", None) or e
        raise OutputError(f"{host}:{port}: {why}; choose another --port, 0 for any that is free") from None
    return made


def first_admin(site: Site, say: Callable[[str], None]) -> None:
    """An account for who starts a hub for the first time; its password is said once."""
    if site.accounts.any():
        return
    password = secrets.token_urlsafe(12)
    site.accounts.add("admin", password, PersonRole.ADMIN)
    say(f"first start: the account 'admin' has the password {password} (said only now; change it)")


def self_signed(folder: Path, host: str) -> tuple[Path, Path]:
    """A certificate and key for this machine in `folder`, made anew when it is about to expire: to try it."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    now = datetime.datetime.now(datetime.UTC)
    names: list[x509.GeneralName] = [x509.DNSName("localhost")]
    wanted = {"127.0.0.1", "::1", host, *([] if host in LOOPBACK else [socket.gethostname()])}
    for name in sorted(wanted - {"0.0.0.0", "::", "localhost"}):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(name)))
        except ValueError:
            names.append(x509.DNSName(name))
    if certificate.exists() and key.exists():
        with contextlib.suppress(ValueError, x509.ExtensionNotFound):  # of files that are none: made anew
            old = x509.load_pem_x509_certificate(certificate.read_bytes())
            mine = serialization.load_pem_private_key(key.read_bytes(), None).public_key()
            known = old.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            young = old.not_valid_after_utc > now + datetime.timedelta(days=7)
            if young and set(known) >= set(names) and mine == old.public_key():
                key.chmod(0o600)
                return certificate, key
    private = ec.generate_private_key(ec.SECP256R1())
    me = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fringescope hub, self-signed")])
    made = (
        x509.CertificateBuilder()
        .subject_name(me)
        .issuer_name(me)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))
        .not_valid_after(now + datetime.timedelta(days=DAYS))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(private, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    plain = serialization.PrivateFormat.PKCS8
    _write(key, private.private_bytes(pem, plain, serialization.NoEncryption()), 0o600)
    _write(certificate, made.public_bytes(pem), 0o644)
    return certificate, key


def _write(path: Path, data: bytes, mode: int) -> None:
    """A file that has its mode before it has its first byte, and takes its place whole."""
    new = path.with_suffix(".new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as f:
        f.write(data)
    new.replace(path)
