"""Passkeys: made by who is signed in, and a way to come in."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Request, Response

from fringescope.errors import UsageError
from fringescope.server.accounts import SignInError
from fringescope.server.asking import Parts, Who, problems
from fringescope.server.rights import CONFIRMED_S
from fringescope.server.routes.signing import account_of, let_in, not_too_often
from fringescope.server.site import Site
from fringescope.wire import Account
from fringescope.wire.documents import Ended, KeyAnswer, KeyOptions, Passkey

router = APIRouter(prefix="/api/passkeys", tags=["signing in"])
KeyId = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]{1,1400}$", description="Identifier of a passkey.")]


def _origin(request: Request, site: Site) -> str:
    """The page that asks, which must be one that whoever runs the hub has named: a key is bound to it for good.

    A program without a page stands for the first of them.
    """
    origin = request.headers.get("origin", site.config.origin)
    if origin not in (site.config.origin, *site.config.own_origins):
        raise HTTPException(409, f"passkeys need to know their page; start the hub with --origin {origin[:200]}")
    return origin


def _may(who: Who) -> None:
    who.must("passkey")
    if who.session.case is not None:
        raise HTTPException(403, "a guest of one case has no passkey; come in by the link")


def _lately(who: Who) -> None:
    """A new key is a new way in: who found an open page must not make one."""
    if who.site.clock.now_ns() - who.session.confirmed_ns > CONFIRMED_S * 1e9:
        raise HTTPException(403, "a new passkey needs your password once more; confirm it and begin again")


@router.get("", responses=problems(401, 403))
def mine(who: Who) -> list[Passkey]:
    """The passkeys of who is signed in."""
    _may(who)
    return who.site.passkeys.of(who.session.person.id)


@router.post("/new", responses=problems(401, 403, 409))
def offer(who: Who, request: Request) -> KeyOptions:
    """What the browser needs to make a passkey."""
    _may(who)
    _lately(who)
    return KeyOptions(options=who.site.passkeys.offer(who.session, _origin(request, who.site)))


@router.post("", status_code=201, responses=problems(400, 401, 403))
def add(asked: KeyAnswer, who: Who) -> Passkey:
    """Keeps a passkey that the browser made."""
    _may(who)
    _lately(who)
    try:
        return who.site.passkeys.add(who.session, asked.credential, asked.label)
    except UsageError as e:
        raise HTTPException(400, str(e)) from None


@router.delete("/{key}", responses=problems(401, 403, 404))
def remove(key: KeyId, who: Who) -> Ended:
    """Takes a passkey away."""
    _may(who)
    if not who.site.passkeys.remove(who.session.person.id, key):
        raise HTTPException(404, "you have no such passkey")
    return Ended()


@router.post("/ask", responses=problems(409))
def ask(request: Request, site: Parts) -> KeyOptions:
    """What the browser needs to sign in by a passkey, or to confirm who you are."""
    not_too_often(request, site)
    return KeyOptions(options=site.passkeys.ask(_origin(request, site)))


@router.post("/login", responses=problems(401))
def login(asked: KeyAnswer, request: Request, response: Response, site: Parts) -> Account:
    """Signs in by a passkey."""
    not_too_often(request, site)
    try:
        secret, session = site.accounts.open_session(site.passkeys.check(asked.credential))
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    let_in(request, response, site, secret)
    return account_of(request, site, session)


@router.post("/confirm", responses=problems(401, 403))
def confirm(asked: KeyAnswer, who: Who, request: Request) -> Ended:
    """A passkey instead of the password once more, before a signature."""
    _may(who)
    not_too_often(request, who.site)
    try:
        if who.site.passkeys.check(asked.credential) != who.session.person.id:
            raise SignInError("this passkey is not yours; use one of yours")
    except SignInError as e:
        raise HTTPException(401, str(e)) from None
    who.site.accounts.confirmed(who.session)
    return Ended()
