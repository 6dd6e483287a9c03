"""Who asks, and may they: what routes need before they do anything."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Path, Request, WebSocket

from fringescope.server import cases
from fringescope.server.accounts import Session, SignInError
from fringescope.server.rights import Speaker, refusal
from fringescope.server.security import is_local
from fringescope.server.site import Site
from fringescope.wire import PersonRole, Problem

CaseId = Annotated[str, Path(pattern=r"^case-[0-9a-f]{20}$", description="Identifier of a case.")]
_SAFE = ("GET", "HEAD", "OPTIONS")


def cookie_of(tls: bool) -> str:
    """The name of the session's cookie: with TLS browsers refuse it from anywhere else."""
    return "__Host-fringescope" if tls else "fringescope"


def problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """What may go wrong with a route, for its description: what is named, and what may befall any."""
    words = {
        400: "the request makes no sense as it stands", 401: "nobody is signed in", 403: "not for this role",
        404: "there is none", 409: "not now", 410: "it was erased", 413: "too long", 416: "no such range",
        422: "the request is not what is described here", 429: "too often", 507: "the disk is full",
    }  # fmt: skip
    return {c: {"model": Problem, "description": words[c]} for c in sorted({*codes, 400, 403, 413, 422, 429, 507})}


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

    def say_so_many(self, n: int) -> None:
        """Raises 429 where somebody says more than they may."""
        if n and (wait := self.site.ops.take(self.speaker.person, n)):
            raise HTTPException(429, f"too many ops; wait {wait:.0f} s", headers={"retry-after": f"{wait:.0f}"})

    def case(self, case: str, what: str) -> None:
        """Raises 403 unless they may do it in a case, 404 where there is none, or none that they may see."""
        self.must(what)
        if not may_see(self.site, self.speaker, case):
            raise HTTPException(404, "there is no such case, or you were not invited to it")


def may_see(site: Site, speaker: Speaker, case: str) -> bool:
    """Operators see all cases, guests the one that they were invited to, others those that they are members of."""
    if speaker.case is not None:
        return speaker.case == case
    if speaker.role in (PersonRole.OPERATOR, PersonRole.ADMIN):
        return cases.get(site.engine, case) is not None
    return cases.is_member(site.engine, case, speaker.person)


def asking_of(request: Request | WebSocket) -> Asking:
    """Who a cookie stands for. Raises SignInError."""
    site: Site = request.app.state.site
    secret = request.cookies.get(cookie_of(site.config.tls), "")
    session = site.accounts.session(secret)
    p = session.person
    local = is_local(request.scope, site.config)
    return Asking(site, session, Speaker(p.id, p.role, local, session.case, session.confirmed_ns))


def signed_in(request: Request) -> Asking:
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
