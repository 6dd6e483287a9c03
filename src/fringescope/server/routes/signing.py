"""In and out: passwords, sessions, invitations."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException, Request, Response

from fringescope.errors import UsageError
from fringescope.server.accounts import Session, SignInError
from fringescope.server.asking import Parts, Who, cookie_of, problems
from fringescope.server.security import is_local
from fringescope.server.site import Site
from fringescope.wire import Account
from fringescope.wire.documents import Accept, Confirm, Ended, Login, PasswordChange

router = APIRouter(prefix="/api", tags=["signing in"])


def _account(request: Request, site: Site, session: Session) -> Account:
    local = is_local(request.scope, site.config)
    return Account(person=session.person, csrf=session.csrf, local=local, case=session.case)


def _cookie(response: Response, site: Site, secret: str) -> None:
    tls = site.config.tls
    age = int(site.config.limits.session_s)
    response.set_cookie(cookie_of(tls), secret, max_age=age, httponly=True, secure=tls, samesite="strict", path="/")


def _not_too_often(request: Request, site: Site) -> None:
    wait = site.logins.take(request.client.host if request.client else "")
    if wait:
        headers = {"retry-after": f"{wait:.0f}"}
        raise HTTPException(429, f"too many tries from here; wait {wait:.0f} s", headers=headers)


@router.post("/login", responses=problems(401))
def login(asked: Login, request: Request, response: Response, site: Parts) -> Account:
    """Signs in; the session's cookie cannot be read by a page."""
    _not_too_often(request, site)
    try:
        secret, session = site.accounts.sign_in(asked.name, asked.password)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    _cookie(response, site, secret)
    return _account(request, site, session)


@router.post("/invitations/accept", responses=problems(401))
async def accept(asked: Accept, request: Request, response: Response, site: Parts) -> Account:
    """A guest comes in, by the link's token and the code that was told."""
    from starlette.concurrency import run_in_threadpool

    _not_too_often(request, site)
    try:
        secret, session, made = await run_in_threadpool(site.invitations.accept, asked.token, asked.code)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    p = session.person
    await site.hub.note(made.case, p.id, p.role.value, "joined", {"invitation": made.id})
    _cookie(response, site, secret)
    return _account(request, site, session)


@router.post("/logout", responses=problems(401, 403))
def logout(who: Who, response: Response) -> Ended:
    """Signs out."""
    who.site.accounts.sign_out(who.session)
    who.site.rooms.expel(who.speaker.person)
    response.delete_cookie(cookie_of(who.site.config.tls), path="/")
    return Ended()


@router.get("/me", responses=problems(401))
def me(who: Who, request: Request) -> Account:
    """Who is signed in here."""
    return _account(request, who.site, who.session)


@router.post("/confirm", responses=problems(401, 403))
def confirm(asked: Confirm, who: Who, request: Request) -> Ended:
    """The password once more, before a signature."""
    _not_too_often(request, who.site)
    try:
        who.site.accounts.confirm(who.session, asked.password)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    return Ended()


@router.post("/password", responses=problems(400, 401, 403))
def password(asked: PasswordChange, who: Who, request: Request) -> Ended:
    """A new password; all sessions end."""
    _not_too_often(request, who.site)
    try:
        who.site.accounts.confirm(who.session, asked.old)
        who.site.accounts.change(who.session.person.id, password=asked.new)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    except UsageError as e:
        raise HTTPException(400, str(e)) from None
    return Ended()
