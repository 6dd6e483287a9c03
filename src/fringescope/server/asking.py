"""Who asks, and may they: what routes need before they do anything."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Path, Request, Security
from fastapi.security import APIKeyCookie, APIKeyHeader
from starlette.requests import HTTPConnection

from fringescope.server import cases
from fringescope.server.accounts import Session, SignInError
from fringescope.server.config import Config
from fringescope.server.rights import Speaker, refusal
from fringescope.server.security import is_local
from fringescope.server.site import Site
from fringescope.server.truth import ERASED
from fringescope.wire import PersonRole, Problem

CaseId = Annotated[str, Path(pattern=r"^case-[0-9a-f]{20}$", description="Identifier of a case.")]
_LONG_OP = 50_000  #: bytes of an op that counts as two
_ENTRY = 500  #: bytes of an entry of the log beside its words
_OF_ERASED = ("case.read", "job.read")  #: what may still be asked of a case that was erased
_SAFE = ("GET", "HEAD", "OPTIONS")


def cookie_of(tls: bool) -> str:
    """The name of the session's cookie: with TLS browsers refuse it from anywhere else."""
    return "__Host-fringescope" if tls else "fringescope"


def is_secure(request: HTTPConnection, config: Config) -> bool:
    """Whether the browser speaks https: with the hub, or with the proxy before it."""
    said = request.headers.get("x-forwarded-proto", "").rsplit(",", 1)[-1].strip()
    return config.tls or (config.behind_proxy and said == "https")


def secret_of(request: HTTPConnection, config: Config) -> str:
    """The secret of a session's cookie; with TLS that of the one name that nobody else could set."""
    secure = request.cookies.get(cookie_of(True), "")
    return secure if secure or config.tls else request.cookies.get(cookie_of(False), "")


def problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """What may go wrong with a route, for its description: what is named, and what may befall any."""
    words = {
        400: "the request makes no sense as it stands", 401: "nobody is signed in", 403: "not for this role",
        404: "there is none", 409: "not now", 410: "it was erased", 413: "too long", 416: "no such range",
        422: "the request is not what is described here", 429: "too often", 503: "who should answer does not",
        507: "the disk is full",
    }  # fmt: skip
    more = (410,) if 404 in codes else ()  # of what was there, but was erased
    often = {400, 403, 413, 422, 429, 507}
    return {c: {"model": Problem, "description": words[c]} for c in sorted({*codes, *more, *often})}


def one_line(text: str, most: int = 300) -> str:
    """A sentence that somebody's own words are part of: on one line, and not too long."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:most]


def site_of(request: Request) -> Site:
    """The hub's parts."""
    site: Site = request.app.state.site
    return site


@dataclass(frozen=True)
class Asking:
    """Who asks."""

    site: Site
    session: Session
    speaker: Speaker

    def must(self, what: str) -> None:
        """Raises 403 unless they may."""
        why = refusal(self.speaker, what, self.site.clock.now_ns())
        if why:
            raise HTTPException(403, why)

    def say_so_many(self, n: int, size: int) -> None:
        """Raises 429 where somebody says more than they may: so many ops of so many bytes together."""
        why, wait = self.too_much(n, size)
        if why:
            raise HTTPException(429, why, headers={"retry-after": f"{wait:.0f}"})

    def too_much(self, n: int, size: int) -> tuple[str, float]:
        """Why a person must wait before they say so many ops of so many bytes, "" if they need not; how many s."""
        person, limits = self.speaker.person, self.site.config.limits
        if wait := self.site.ops.take(person, n + size // _LONG_OP):
            return f"too many ops; wait {wait:.0f} s and say it again", wait
        if wait := self.site.written.take(person, size + n * _ENTRY):
            each = f"the log takes {limits.log_bytes_per_s / 1000:g} kB a second from one person"
            return f"you have drawn and written too much at once; {each}: wait {wait:.0f} s and say it again", wait
        return "", 0.0

    def case(self, case: str, what: str) -> None:
        """Raises 403 unless they may do it in a case, 404 where there is none, or none that they may see."""
        self.must(what)
        if not may_see(self.site, self.speaker, case):
            raise HTTPException(404, "there is no such case, or you were not invited to it")
        if what not in _OF_ERASED and cases.is_erased(self.site.engine, case):
            raise HTTPException(410, ERASED)


def may_see(site: Site, speaker: Speaker, case: str) -> bool:
    """Operators see all cases, guests the one that they were invited to, others those that they are members of."""
    if speaker.case is not None and speaker.case != case:
        return False
    if speaker.case is None and speaker.role in (PersonRole.OPERATOR, PersonRole.ADMIN):
        return cases.get(site.engine, case) is not None
    return cases.is_member(site.engine, case, speaker.person)


def size_of(length: int) -> int:
    """As how many ops one of so many bytes counts: long ones fill a disk sooner."""
    return 1 + length // _LONG_OP


def still(asking: Asking, case: str) -> bool:
    """Whether somebody who came in is still signed in, as who they were, and may still see a case."""
    try:
        now = asking.site.accounts.session_of(asking.session.digest)
    except SignInError:
        return False
    return now.person.role is asking.speaker.role and may_see(asking.site, asking.speaker, case)


def asking_of(request: HTTPConnection) -> Asking:
    """Who a cookie stands for. Raises SignInError."""
    site: Site = request.app.state.site
    session = site.accounts.session(secret_of(request, site.config))
    p = session.person
    local = is_local(request.scope, site.config)
    return Asking(site, session, Speaker(p.id, p.role, local, session.case, session.confirmed_ns))


_COOKIE = APIKeyCookie(
    name="fringescope", scheme_name="session", auto_error=False,
    description="A session's cookie, as POST /api/login sets it; over https it is called __Host-fringescope.",
)  # fmt: skip
_TOKEN = APIKeyHeader(
    name="X-CSRF-Token", scheme_name="token", auto_error=False,
    description="The session's `csrf`, as POST /api/login and GET /api/me tell it: for all but GET.",
)  # fmt: skip


def signed_in(
    request: Request, _cookie: Annotated[Any, Security(_COOKIE)] = None, _token: Annotated[Any, Security(_TOKEN)] = None
) -> Asking:
    """For routes: 401 for a stranger, 403 without the token that other sites' pages do not have."""
    try:
        asking = asking_of(request)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    if request.method not in _SAFE:
        token = request.headers.get("x-csrf-token", "")
        if not hmac.compare_digest(token.encode(), asking.session.csrf.encode()):
            raise HTTPException(403, "the X-CSRF-Token header is missing or old; load the page again")
    return asking


Who = Annotated[Asking, Depends(signed_in)]
Parts = Annotated[Site, Depends(site_of)]
