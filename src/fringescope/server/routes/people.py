"""Accounts, for administrators."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException
from starlette.concurrency import run_in_threadpool

from fringescope.errors import UsageError
from fringescope.server.asking import Who, problems
from fringescope.wire import Person
from fringescope.wire.documents import NewPerson, PersonChange

router = APIRouter(prefix="/api/people", tags=["people"])


@router.get("", responses=problems(401, 403))
def everybody(who: Who) -> list[Person]:
    """Everybody with an account, by name."""
    who.must("people.list")
    return who.site.accounts.people()


@router.post("", status_code=201, responses=problems(400, 401, 403))
def add(asked: NewPerson, who: Who) -> Person:
    """A new account."""
    who.must("people.change")
    try:
        if asked.password is None and asked.subject is None:
            raise UsageError("neither a password nor a subject of the identity provider; needed one of them")
        subject = None
        if asked.subject is not None:
            if who.site.provider is None:
                raise UsageError("a subject and no identity provider; start the hub with --oidc-issuer")
            subject = who.site.provider.subject(asked.subject)
        return who.site.accounts.add(asked.name, asked.password, asked.role, subject=subject)
    except UsageError as e:
        raise HTTPException(400, str(e)) from None


@router.patch("/{person}", responses=problems(400, 401, 403, 404))
async def change(person: str, asked: PersonChange, who: Who) -> Person:
    """Changes an account; who loses a right is out at once, from every room."""
    who.must("people.change")
    if who.site.accounts.person(person) is None:
        raise HTTPException(404, "nobody has this account")
    try:
        return await run_in_threadpool(
            lambda: who.site.accounts.change(
                person, name=asked.name, password=asked.password, role=asked.role, disabled=asked.disabled
            )
        )
    except UsageError as e:
        raise HTTPException(400, str(e)) from None
