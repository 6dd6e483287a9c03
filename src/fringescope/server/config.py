"""How a hub is set up: where its data lies, where it listens, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from fringescope.errors import UsageError
from fringescope.settings import Settings

LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True)
class Limits:
    """What one person, one message and one room may ask for."""

    message_bytes: int = 1_000_000  #: longest message through a room
    body_bytes: int = 4_000_000  #: longest body of a request
    upload_bytes: int = 16_000_000_000  #: longest bundle: a scan of full size has about 2 GB
    ops_per_s: float = 40.0  #: ops of one connection, on average
    ops_burst: int = 400  #: and at once, as after a time offline
    log_bytes_per_s: float = 20_000.0  #: what one person writes into the logs, on average: 1.7 GB a day at most
    log_bytes_burst: int = 8_000_000  #: and at once
    live_per_s: float = 120.0  #: pointers, views and ink of one connection
    requests_per_s: float = 100.0  #: requests of one address
    requests_burst: int = 500
    logins_per_minute: float = 20.0  #: of one address
    failures: int = 8  #: wrong passwords in a row that lock an account
    locked_s: float = 300.0  #: for so long
    session_s: float = 12 * 3600.0  #: a session ends after
    idle_s: float = 3600.0  #: or after so long without a request
    doors_s: float = 5.0  #: open rooms are looked through so often for sessions that are over
    messages_per_s: float = 600.0  #: messages of any kind of one connection, before it is closed
    messages_burst: int = 4000
    waiting: int = 4000  #: messages that wait for a browser that does not read before it is let go
    waiting_letters: int = 16_000_000  #: and how long they may be together
    present: int = 400  #: connections to one room
    videos: int = 40  #: streams of video
    videos_each: int = 10  #: of one person: two pages with all cameras
    peers: int = 6  #: of these by WebRTC: each is encoded by itself
    bundles_each: int = 2  #: bundles that one person takes at once: each lies on the disk meanwhile
    connections: int = 2000  #: open connections from other machines
    connections_each: int = 500  #: of one address
    body_s: float = 30.0  #: a body may pause for so long, and has 1 kB a second on average after that


@dataclass(frozen=True)
class Provider:
    """An identity provider (OpenID Connect) whose people may come in. Raises UsageError where something is missing.

    `role_claim` names the claim whose value is the role (a word of ours, or a list of which the first of ours counts);
    `role` is that of people without one, None: they stay out. `admit`: whether unknown people get an account.
    """

    issuer: str
    client: str
    secret: str = field(repr=False)
    role_claim: str | None = None
    role: str | None = None
    admit: bool = False
    scope: str = "openid profile"

    def __post_init__(self) -> None:
        parts = urlsplit(self.issuer)
        near = parts.scheme == "http" and parts.hostname in LOOPBACK
        if parts.scheme != "https" and not near:
            raise UsageError(f"--oidc-issuer {self.issuer}; needed an address that begins with https://")
        if not self.client or not self.secret:
            raise UsageError(
                "--oidc-issuer needs --oidc-client and its secret: --oidc-secret FILE, or FRINGESCOPE_OIDC_SECRET"
            )
        if self.role not in (None, "operator", "expert", "observer"):
            raise UsageError(f"--oidc-role {self.role}; needed operator, expert or observer")
        if self.admit and self.role is None and self.role_claim is None:
            raise UsageError("--oidc-admit needs --oidc-role or --oidc-role-claim: what new people may do")


@dataclass(frozen=True)
class Config:
    """A hub. `instrument` is the URI of the devices, None for a hub without; `rig` the rig.json they are used with.

    Raises UsageError for an address that others reach without TLS.
    """

    data: Path
    host: str = "127.0.0.1"
    port: int = 8017
    database: str | None = None  #: URL; None = SQLite in `data`
    instrument: str | None = None
    rig: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    origins: tuple[str, ...] = ()  #: further origins of pages that may talk to it, as https://hub.hospital.example
    behind_proxy: bool = False  #: another server hands requests on: nobody is local by their address alone
    local_port: int | None = None  #: behind a proxy: a port of this machine alone, for who stands at the instrument
    settings: Settings = field(default_factory=Settings)
    limits: Limits = Limits()
    provider: Provider | None = None
    checkpoint_s: float = 300.0  #: a signed checkpoint of the log so often, if it has moved

    def __post_init__(self) -> None:
        if self.provider is not None and self.host not in LOOPBACK and not self.origins:
            raise UsageError("--oidc-issuer needs --origin: where the provider sends people back to")
        if (self.certificate is None) != (self.key is None):
            raise UsageError("--certificate and --key belong together; give both, or --self-signed")
        if self.local_port is not None and not self.behind_proxy:
            raise UsageError("--local-port is for a hub --behind-proxy; without one its own port is local already")
        if self.host not in LOOPBACK and self.certificate is None:
            raise UsageError(
                f"--host {self.host}: others could listen in; needed a certificate and its key (--certificate, --key), "
                "or --self-signed to try it"
            )

    @property
    def tls(self) -> bool:
        """Whether it speaks https."""
        return self.certificate is not None

    @property
    def url(self) -> str:
        """SQLAlchemy's URL of the database."""
        return self.database or f"sqlite:///{(self.data / 'hub.sqlite').resolve()}"

    @property
    def origin(self) -> str:
        """The first origin of its pages: never taken from what a request says of itself."""
        return self.origins[0] if self.origins else f"http{'s' if self.tls else ''}://localhost:{self.port}"

    @property
    def own_origins(self) -> tuple[str, ...]:
        """Origins of its own pages."""
        scheme = "https" if self.tls else "http"
        names = {self.host, *(LOOPBACK if self.host in LOOPBACK else ())} - {"0.0.0.0", "::"}
        pages = [(n, self.port) for n in sorted(names)]
        if self.local_port is not None:
            pages += [(n, self.local_port) for n in LOOPBACK]
        return (*(f"{scheme}://{f'[{n}]' if ':' in n else n}:{port}" for n, port in pages), *self.origins)
