"""Cases: the list, what lies under the cameras, the log, and who was invited."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import sqlalchemy as sa
from fastapi import APIRouter, HTTPException, Query, Request
from starlette.concurrency import run_in_threadpool

from fringescope.server import cases as kept
from fringescope.server import database as db
from fringescope.server import invitations as invited
from fringescope.server import journal, truth
from fringescope.server.accounts import new_id
from fringescope.server.asking import CaseId, Who, problems, still
from fringescope.server.hub import as_event
from fringescope.server.rights import MAY
from fringescope.wire import Case, CaseList, Invitation, Op, Person, PersonRole, Status
from fringescope.wire.documents import CaseChange, CaseState, Ended, NewCase, NewInvitation
from fringescope.wire.room import Event, Said

router = APIRouter(prefix="/api/cases", tags=["cases"])


def _sees_patients(who: Who) -> bool:
    return who.speaker.role in MAY["case.patient"]


@router.get("", responses=problems(401, 403))
def search(
    who: Who,
    q: Annotated[str, Query(max_length=200, description="Words to find: accession number, specimen ..")] = "",
    status: Status | None = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0,
) -> CaseList:
    """Cases that somebody may see, the latest first."""
    who.must("case.list")
    s = who.speaker
    member = None if s.role in (PersonRole.OPERATOR, PersonRole.ADMIN) and s.case is None else s.person
    total, found = kept.search(
        who.site.engine, q.replace("\x00", ""), status.value if status else None, limit, offset, member,
        _sees_patients(who), s.case,
    )  # fmt: skip
    return CaseList(total=total, cases=found)


@router.post("", status_code=201, responses=problems(400, 401, 403, 507))
async def open_case(asked: NewCase, who: Who) -> Case:
    """Opens a case."""
    who.must("case.open")
    case, at = new_id("case"), who.site.clock.now_ns()
    said = await who.site.hub.note(
        case, who.speaker.person, who.speaker.role.value, "opened",
        {"accession": asked.accession, "specimen": asked.specimen.model_dump()},
        lambda c: kept.insert(c, case, asked.accession, asked.specimen, asked.patient, at),
    )  # fmt: skip
    if said.refused:
        raise HTTPException(507, said.refused)
    return await _get(who, case)


async def _get(who: Who, case: str) -> Case:
    found = await run_in_threadpool(kept.get, who.site.engine, case, _sees_patients(who))
    if found is None:
        raise HTTPException(404, "there is no such case")
    return found


@router.get("/{case}", responses=problems(401, 403, 404))
async def read(case: CaseId, who: Who) -> Case:
    """A case."""
    await run_in_threadpool(who.case, case, "case.read")
    return await _get(who, case)


@router.patch("/{case}", responses=problems(401, 403, 404, 409, 507))
async def change(case: CaseId, asked: CaseChange, who: Who) -> Case:
    """Changes status, specimen or patient; the patient never goes into the log."""
    await run_in_threadpool(who.case, case, "case.change")
    at = who.site.clock.now_ns()
    told = asked.model_dump(exclude={"patient"}, exclude_none=True)
    said = await who.site.hub.note(
        case, who.speaker.person, who.speaker.role.value, "changed",
        told | ({"patient": "changed"} if asked.patient else {}),
        lambda c: kept.change(c, case, asked.status, asked.specimen, asked.patient, at),
    )  # fmt: skip
    if said.refused:
        raise HTTPException(409 if said.seq else 507, said.refused)
    return await _get(who, case)


@router.get("/{case}/events", responses=problems(401, 403, 404))
async def events(
    case: CaseId,
    who: Who,
    since: Annotated[int, Query(ge=0, le=2**53)] = 0,
    limit: Annotated[int, Query(ge=1, le=2000)] = 500,
) -> list[Event]:
    """The log of a case behind number `since`, in its order."""
    await run_in_threadpool(who.case, case, "case.read")

    def page() -> list[Event]:
        with db.reading(who.site.engine) as c:
            return [as_event(r) for r in journal.read(c, case, since, limit)]

    return await run_in_threadpool(page)


@router.get("/{case}/state", responses=problems(401, 403, 404))
async def state(case: CaseId, who: Who) -> CaseState:
    """Where a case stands after its last event: what is drawn, said, submitted, shown."""
    await run_in_threadpool(who.case, case, "case.read")
    now, seq = await who.site.hub.truth_of(case)
    return CaseState(
        seq=seq,
        standing=truth.standing(now),
        strokes={k: dict(v) for k, v in now.of_kind("stroke").items()},
        layers={k: dict(v) for k, v in now.of_kind("layer").items()},
        comments={k: dict(v) for k, v in now.of_kind("comment").items()},
        versions={n: [dict(x) for x in v] for n, v in now.versions.items()},
        scans=list(now.scans),
    )


@router.post("/{case}/ops", responses=problems(401, 403, 404))
async def say(case: CaseId, ops: list[Op], who: Who, request: Request) -> list[Said]:
    """Ops for the log, in order, as after a time offline: each is done once, however often it is said."""
    await run_in_threadpool(who.case, case, "case.read")
    if len(ops) > 1000:
        raise HTTPException(413, f"{len(ops)} ops at once; at most 1000 are taken")
    stops = who.site.hub.can_stop(case)  # a stop of something that is armed or lit is never too often
    counted = [op for op in ops if not (stops and op.what.kind == "stop")]
    if counted:
        who.say_so_many(len(counted), len(await request.body()))
    out: list[Said] = []
    for op in ops:
        if op.what.kind == "carry_over":
            raise HTTPException(422, "carry_over: use the route of that name, which looks the job up")
        if out and not await run_in_threadpool(still, who, case):
            raise HTTPException(403, "your right to see this case has ended; what you said before that is written down")
        out.append(await who.site.hub.say(case, who.speaker, op))
    return out


async def _invited(who: Who, case: str, told: dict[str, Any], beside: Callable[[sa.Connection], None]) -> None:
    """Writes down that somebody was invited, and `beside` with it. Raises 409 or 507 where nothing came of it."""
    said = await who.site.hub.note(case, who.speaker.person, who.speaker.role.value, "invited", told, beside)
    if said.refused:
        raise HTTPException(409 if said.seq else 507, said.refused)


@router.get("/{case}/members", responses=problems(401, 403, 404))
def members(case: CaseId, who: Who) -> list[Person]:
    """Who was let into a case, beside operators."""
    who.case(case, "case.invite")
    found = (who.site.accounts.person(p) for p in kept.members_of(who.site.engine, case))
    return [p for p in found if p is not None]


@router.put("/{case}/members/{person}", responses=problems(401, 403, 404, 409, 507))
async def let_in(case: CaseId, person: str, who: Who) -> Person:
    """Lets somebody who has an account into a case."""
    await run_in_threadpool(who.case, case, "case.invite")
    known = who.site.accounts.person(person)
    if known is None:
        raise HTTPException(404, "nobody has this account")
    if who.site.accounts.case_of(person) not in (None, case):
        raise HTTPException(409, "a guest sees the one case of their invitation; invite them to this one, too")
    if not await run_in_threadpool(kept.is_member, who.site.engine, case, person):
        await _invited(who, case, {"person": person}, lambda c: kept.let_in(c, case, person))
    return known


@router.delete("/{case}/members/{person}", responses=problems(401, 403, 404, 507))
async def let_out(case: CaseId, person: str, who: Who) -> Ended:
    """Takes somebody's way into a case away: they are out at once; what they proposed stays."""
    await run_in_threadpool(who.case, case, "case.invite")
    if not await run_in_threadpool(kept.is_member, who.site.engine, case, person):
        raise HTTPException(404, "they were not let into this case")
    who.site.rooms.expel(person, case)  # nothing of theirs comes behind the word that they are out
    said = await who.site.hub.note(
        case, who.speaker.person, who.speaker.role.value, "revoked", {"person": person},
        lambda c: kept.let_out(c, case, person),
    )  # fmt: skip
    if said.seq is None:
        raise HTTPException(507, said.refused)
    who.site.rooms.expel(person, case)  # who came back meanwhile
    return Ended()


@router.get("/{case}/invitations", responses=problems(401, 403, 404))
def invitations(case: CaseId, who: Who) -> list[Invitation]:
    """Who was invited to a case."""
    who.case(case, "case.invite")
    return who.site.invitations.of(case)


@router.post("/{case}/invitations", status_code=201, responses=problems(401, 403, 404, 409, 507))
async def invite(case: CaseId, asked: NewInvitation, who: Who) -> Invitation:
    """Invites somebody to a case: the answer alone holds the link's token, and the code to tell by telephone."""
    await run_in_threadpool(who.case, case, "case.invite")
    made, row = await run_in_threadpool(who.site.invitations.make, case, who.speaker.person, asked)
    told = {"invitation": made.id, "role": asked.role, "expires_ns": made.expires_ns}
    await _invited(who, case, told, lambda c: invited.keep(c, row))
    return made


@router.delete("/{case}/invitations/{invitation}", responses=problems(401, 403, 404, 507))
async def revoke(case: CaseId, invitation: str, who: Who) -> Invitation:
    """Revokes an invitation: the guest is out at once; what they proposed stays."""
    await run_in_threadpool(who.case, case, "case.invite")
    found = await run_in_threadpool(who.site.invitations.get, invitation)
    if found is None or found.case != case:
        raise HTTPException(404, "there is no such invitation to this case")
    person = await run_in_threadpool(who.site.invitations.revoke, invitation)
    if person is not None:
        who.site.rooms.expel(person)
    told = {"invitation": invitation, "person": person}
    await who.site.hub.note(case, who.speaker.person, who.speaker.role.value, "revoked", told)
    return found.model_copy(update={"revoked": True})
