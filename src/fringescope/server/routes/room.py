"""The room of a case: one WebSocket for all that happens."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from typing import Any

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool

from fringescope.errors import FringescopeError
from fringescope.server import database as db
from fringescope.server import journal, truth
from fringescope.server.accounts import SignInError
from fringescope.server.asking import Asking, asking_of, may_see, one_line, size_of, still
from fringescope.server.hub import as_event
from fringescope.server.rights import refusal
from fringescope.server.rooms import EXPELLED, FLOOD, Listener
from fringescope.server.security import origin_fits
from fringescope.server.throttle import Bucket
from fringescope.wire.room import CaughtUp, FromClient, Ping, Pong, Refusal, Relayed, Said, Say, Standing, Welcome

router = APIRouter()
_MESSAGE: TypeAdapter[Any] = TypeAdapter(FromClient)
_CASE = re.compile(r"case-[0-9a-f]{20}")
_PAGE = 500
_LOG = logging.getLogger("fringescope.room")
_PARTING_S = 30.0  #: so long a browser may take until it reads why it was let go


async def enter(socket: WebSocket, case: str, what: str) -> Asking | None:
    """Who comes in, or None after the door was closed with a reason."""
    site = socket.app.state.site
    case = case if _CASE.fullmatch(case) else "none"
    if not origin_fits(socket.scope, site.config):
        await turn_away(socket, 4403, "this connection comes from another site's page; open the hub's own page")
        return None
    try:
        asking = await run_in_threadpool(asking_of, socket)
    except SignInError as e:
        await turn_away(socket, 4401, str(e))
        return None
    seen = await run_in_threadpool(may_see, site, asking.speaker, case)
    why = refusal(asking.speaker, what) or ("" if seen else "there is no such case, or you were not invited to it")
    if why:
        await turn_away(socket, 4404 if not seen else 4403, why)
        return None
    return asking


async def turn_away(socket: WebSocket, code: int, why: str) -> None:
    """Accepted first: a browser hears the reason only then."""
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):
        await socket.accept()
        await socket.close(code, why.encode()[:120].decode(errors="ignore"))


@router.websocket("/api/cases/{case}/room")
async def room(socket: WebSocket, case: str, since: int = 0, hash: str = "") -> None:
    """All events behind number `since`, then all that come; ops, pointers and ink the other way.

    `hash`: that of event `since`, as you had it; if the log has another there, all comes anew.
    """
    asking = await enter(socket, case, "case.read")
    if asking is None:
        return
    site = asking.site
    most, person = site.config.limits.present, asking.speaker.person
    if site.rooms.count(case) >= most or site.rooms.count(case, person) >= max(1, most // 2):
        await turn_away(socket, 1013, "this room is full; try again later")
        return
    await socket.accept()
    listener = site.rooms.join(case, asking.speaker, asking.session.digest)  # from here on nothing is missed
    if not await run_in_threadpool(still, asking, case):  # a right that was taken away while they came in
        site.rooms.leave(case, listener)
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(*EXPELLED)
        return
    sender = asyncio.create_task(_send(socket, asking, case, listener, max(0, since), hash))
    receiver = asyncio.create_task(_receive(socket, asking, case, listener))
    listener.on_end = lambda: _end(sender)  # it may hang on a browser that does not read
    try:
        await asyncio.wait({sender, receiver}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        site.rooms.leave(case, listener)
        for task in (sender, receiver):
            task.cancel()
        for fault in await asyncio.gather(sender, receiver, return_exceptions=True):
            if isinstance(fault, Exception) and not isinstance(fault, (WebSocketDisconnect, RuntimeError)):
                _LOG.error("a room was closed by a fault", exc_info=fault)
    if listener.ended is not None:
        with contextlib.suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
            await asyncio.wait_for(socket.close(*listener.ended), _PARTING_S)


def _end(task: asyncio.Task[None]) -> None:
    task.cancel()


async def _send(
    socket: WebSocket, asking: Asking, case: str, listener: Listener, since: int, known: str
) -> None:  # fmt: skip
    site, who = asking.site, asking.speaker
    now, seq = await site.hub.truth_of(case)

    def other() -> bool:
        with db.reading(site.engine) as c:
            found = journal.read(c, case, since - 1, 1)
        return not found or found[0].hash != known

    anew = since > seq or bool(since and known and await run_in_threadpool(other))
    since = 0 if anew else since
    here = site.rooms.present(case)
    hello = Welcome(person=who.person, role=who.role.value, local=who.local, seq=seq, present=here, anew=anew)
    await socket.send_text(hello.model_dump_json())

    def page(after: int) -> list[str]:
        with db.reading(site.engine) as c:
            return [as_event(r).model_dump_json() for r in journal.read(c, case, after, min(_PAGE, seq - after))]

    while since < seq:
        lines = await run_in_threadpool(page, since)
        for line in lines:
            await socket.send_text(line)
        since += len(lines)
    await socket.send_text(Standing(seq=seq, state=truth.standing(now)).model_dump_json())
    await socket.send_text(CaughtUp(seq=seq).model_dump_json())
    while True:
        for line in await listener.next():
            if line.startswith('{"type":"event"') and int(line[line.index('"seq":') + 6 :].split(",", 1)[0]) <= seq:
                continue  # was sent already
            await socket.send_text(line)
        if listener.ended is not None:
            return


async def _receive(socket: WebSocket, asking: Asking, case: str, listener: Listener) -> None:
    site, limits = asking.site, asking.site.config.limits
    live = Bucket(limits.live_per_s, 2 * limits.live_per_s)
    every = Bucket(limits.messages_per_s, limits.messages_burst)
    waiting: set[asyncio.Task[None]] = set()
    try:
        while listener.ended is None:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if listener.ended is not None:  # while this message was on its way
                return
            if not every.take(size_of(len(text or message.get("bytes") or ""))):
                listener.end(FLOOD)
                return
            if not site.accounts.allowed(asking.speaker.person):
                listener.end(EXPELLED)
                return
            if text is None:
                listener.send(refused("a message of bytes; needed one JSON object as text"))
                continue
            if len(text) > limits.message_bytes:
                listener.send(refused(f"a message of {len(text)} letters; at most {limits.message_bytes} are taken"))
                continue
            try:
                said = _MESSAGE.validate_json(text)
            except ValidationError as e:
                listener.send(refused(_why(e)))
                continue
            listener.active = listener.active or not isinstance(said, Ping)
            if isinstance(said, Ping):
                listener.send(Pong(at_ms=said.at_ms).model_dump_json())
            elif isinstance(said, Say):
                await _say(asking, case, listener, said, waiting, len(text))
            elif (why := refusal(asking.speaker, said.type)) or not live.take():
                if why:
                    listener.send(refused(why))
            else:
                site.rooms.relay(case, listener, Relayed(person=asking.speaker.person, what=said))
    finally:
        for task in waiting:
            with contextlib.suppress(Exception):
                await task


async def _say(
    asking: Asking, case: str, listener: Listener, said: Say, waiting: set[asyncio.Task[None]], size: int
) -> None:
    """An op on its way to the log; a stop of something that is armed or lit is never too often."""
    op, what = said.op, said.op.what.kind

    def refuse(why: str) -> None:
        listener.send(Said(client=op.client, number=op.number, seq=None, refused=why).model_dump_json())

    if not (what == "stop" and asking.site.hub.can_stop(case)) and (why := asking.too_much(1, size)[0]):
        refuse(why)
        return
    if what == "carry_over":
        refuse("carry_over: use the route of that name, which looks the job up")
        return

    async def answer() -> None:
        try:
            who = await _fresh(asking, what)
            if listener.ended is None:  # else they were let go meanwhile: nothing of theirs comes behind that
                listener.send((await asking.site.hub.say(case, who, op)).model_dump_json())
        except FringescopeError as e:
            refuse(str(e))

    # the queue of the hub keeps the order: the task is in it before the next message is read
    task = asyncio.create_task(answer())
    waiting.add(task)
    task.add_done_callback(waiting.discard)
    await asyncio.sleep(0)


async def _fresh(asking: Asking, what: str) -> Any:
    """The speaker, with the time of the last confirmation where it matters."""
    if what != "sign":
        return asking.speaker
    return (await run_in_threadpool(_renewed, asking)).speaker


def _renewed(asking: Asking) -> Asking:
    from dataclasses import replace

    from fringescope.server.accounts import confirmed_ns

    at = confirmed_ns(asking.site.engine, asking.session.digest)
    return replace(asking, speaker=replace(asking.speaker, confirmed_ns=at))


def refused(why: str) -> str:
    """A message for who said something, or asked for something, of which nothing comes."""
    return Refusal(why=why).model_dump_json()


def _why(e: ValidationError) -> str:
    first = e.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(x) for x in first["loc"])
    return one_line(f"a message that nobody understands: {where + ': ' if where else ''}{first['msg']}")
