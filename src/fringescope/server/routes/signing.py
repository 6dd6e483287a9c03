"""In and out: passwords, sessions, invitations, the identity provider."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from fringescope.errors import UsageError
from fringescope.server.accounts import Session, SignInError
from fringescope.server.asking import Parts, Who, cookie_of, is_secure, problems, secret_of
from fringescope.server.openid import GOOD_S, OpenId, ProviderError
from fringescope.server.security import address_of, is_local
from fringescope.server.site import Site
from fringescope.wire import Account
from fringescope.wire.documents import Accept, Confirm, Ended, Login, PasswordChange, Ways

router = APIRouter(prefix="/api", tags=["signing in"])
_BROWSER = "-provider"  #: what the cookie of a browser at the provider's page is called beside the session's


def account_of(request: Request, site: Site, session: Session) -> Account:
    """Who is signed in, for a page or program."""
    local = is_local(request.scope, site.config)
    return Account(person=session.person, csrf=session.csrf, local=local, case=session.case)


def let_in(request: Request, response: Response, site: Site, secret: str) -> None:
    """The cookie of a new session; the one before it in this browser has ended."""
    try:
        before = site.accounts.session(secret_of(request, site.config))
        site.accounts.sign_out(before)
        site.rooms.expel(before.person.id, session=before.digest)
    except SignInError:
        pass
    tls = is_secure(request, site.config)
    age = int(site.config.limits.session_s)
    response.set_cookie(cookie_of(tls), secret, max_age=age, httponly=True, secure=tls, samesite="strict", path="/")


def not_too_often(request: Request, site: Site) -> str:
    """From where a try to come in comes. Raises 429 where there were too many from there."""
    address = address_of(request.scope, site.config)
    wait = site.logins.take(address)
    if wait:
        headers = {"retry-after": f"{wait:.0f}"}
        raise HTTPException(429, f"too many tries from here; wait {wait:.0f} s", headers=headers)
    return address


@router.get("/ways", responses=problems())
def ways(site: Parts) -> Ways:
    """How one may sign in here."""
    return Ways(provider=None if site.provider is None else "/api/provider/begin")


@router.post("/login", responses=problems(401))
def login(asked: Login, request: Request, response: Response, site: Parts) -> Account:
    """Signs in; the session's cookie cannot be read by a page."""
    address = not_too_often(request, site)
    try:
        secret, session = site.accounts.sign_in(asked.name, asked.password, address)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    let_in(request, response, site, secret)
    return account_of(request, site, session)


@router.post("/invitations/accept", responses=problems(401))
async def accept(asked: Accept, request: Request, response: Response, site: Parts) -> Account:
    """A guest comes in, by the link's token and the code that was told."""
    not_too_often(request, site)
    try:
        secret, session, made = await run_in_threadpool(site.invitations.accept, asked.token, asked.code)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    p = session.person
    await site.hub.note(made.case, p.id, p.role.value, "joined", {"invitation": made.id})
    await run_in_threadpool(let_in, request, response, site, secret)
    return account_of(request, site, session)


# -------------------------------------------------------------------------------------------------- identity provider


def _provider(site: Site) -> OpenId:
    if site.provider is None:
        raise HTTPException(404, "this hub has no identity provider; sign in by password or passkey")
    return site.provider


@router.get("/provider/begin", status_code=303, response_class=Response, responses=problems(404, 503))
def begin(request: Request, site: Parts) -> Response:
    """On to the page of the identity provider."""
    provider = _provider(site)
    not_too_often(request, site)
    try:
        where, browser = provider.begin()
    except ProviderError as e:
        raise HTTPException(503, str(e)) from None
    response = Response(status_code=303, headers={"location": where})
    tls = is_secure(request, site.config)
    response.set_cookie(
        cookie_of(tls) + _BROWSER, browser, max_age=int(GOOD_S), httponly=True, secure=tls, samesite="lax", path="/"
    )
    return response


@router.get("/provider/callback", status_code=303, response_class=Response, responses=problems(401, 404, 503))
def callback(
    request: Request,
    site: Parts,
    state: Annotated[str, Query(max_length=200)] = "",
    code: Annotated[str, Query(max_length=4000)] = "",
    iss: Annotated[str | None, Query(max_length=1000)] = None,
) -> Response:
    """Back from the identity provider: in, and on to the first page."""
    provider = _provider(site)
    not_too_often(request, site)
    tls = is_secure(request, site.config)
    name = cookie_of(tls) + _BROWSER
    if not code:
        raise HTTPException(401, "the identity provider did not let you in; begin again")
    try:
        person, fresh = provider.finish(state, code, request.cookies.get(name, ""), iss)
        secret, _ = site.accounts.open_session(person.id, confirmed=fresh)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    except ProviderError as e:
        raise HTTPException(503, str(e)) from None
    response = Response(status_code=303, headers={"location": "/"})  # nowhere else: no address from outside is followed
    let_in(request, response, site, secret)
    response.delete_cookie(name, path="/", secure=tls, httponly=True, samesite="lax")
    return response


# ---------------------------------------------------------------------------------------------------------- signed in


@router.post("/logout", responses=problems(401, 403))
def logout(who: Who, request: Request, response: Response) -> Ended:
    """Signs out."""
    who.site.accounts.sign_out(who.session)
    who.site.rooms.expel(who.speaker.person, session=who.session.digest)
    for tls in {is_secure(request, who.site.config), who.site.config.tls}:
        response.delete_cookie(cookie_of(tls), path="/", secure=tls, httponly=True, samesite="strict")
    return Ended()


@router.get("/me", responses=problems(401))
def me(who: Who, request: Request) -> Account:
    """Who is signed in here."""
    return account_of(request, who.site, who.session)


@router.post("/confirm", responses=problems(401, 403))
def confirm(asked: Confirm, who: Who, request: Request) -> Ended:
    """The password once more, before a signature."""
    address = not_too_often(request, who.site)
    try:
        who.site.accounts.confirm(who.session, asked.password, address)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    return Ended()


@router.post("/password", responses=problems(400, 401, 403))
def password(asked: PasswordChange, who: Who, request: Request) -> Ended:
    """A new password; all sessions end."""
    address = not_too_often(request, who.site)
    try:
        who.site.accounts.confirm(who.session, asked.old, address)
        who.site.accounts.change(who.session.person.id, password=asked.new, keep_keys=True)
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    except UsageError as e:
        raise HTTPException(400, str(e)) from None
    return Ended()
