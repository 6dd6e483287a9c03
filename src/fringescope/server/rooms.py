"""Who listens to which case, and what each of them has still to be sent.

Events are never dropped: a listener that does not read is let go, and comes back with the number of the last event
that it has seen. Pointers, views and ink are dropped first: only the latest of each person waits.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from fringescope.server.rights import Speaker
from fringescope.wire import PersonRole
from fringescope.wire.room import Event, Presence, Relayed, Standing, Warned

TOO_SLOW = (1013, "you read too slowly; come back with the number of the last event that you have seen")
EXPELLED = (4403, "your right to see this case has ended")
FLOOD = (1008, "too many messages at once; come back, and say less")
SIGNED_OUT = (4401, "you are not signed in any more; sign in and come back")
ERASED = (4410, "this case was erased")
OVER = (1012, "the hub stops; come back")


class Listener:
    """One connection to a room: a queue with an end."""

    def __init__(self, speaker: Speaker, most: int, most_letters: int, session: str = "") -> None:
        self.speaker, self.session = speaker, session
        self.active = False  #: whether the person said something lately
        self.ended: tuple[int, str] | None = None
        self.on_end: Callable[[], None] = lambda: None
        self._most, self._most_letters = most, most_letters
        self._letters = 0  #: of the lines that wait
        self._lines: deque[str] = deque()
        self._live: dict[tuple[str, str], str] = {}  #: the latest pointer, view or ink of each person
        self._wake = asyncio.Event()

    def send(self, line: str) -> None:
        """A message that must arrive."""
        if self.ended is None:
            self._wait(line)
            if len(self._lines) > self._most or self._letters > self._most_letters:
                self.end(TOO_SLOW)
            self._wake.set()

    def send_live(self, key: tuple[str, str], line: str) -> None:
        """A message of which only the latest counts. Ink is a line of pieces: it waits in order while there is room."""
        if self.ended is not None:
            return
        if key[1] == "ink" and len(self._lines) < self._most // 4 and self._letters < self._most_letters // 4:
            self._wait(line)
        else:
            self._live[key] = line
        self._wake.set()

    def _wait(self, line: str) -> None:
        self._lines.append(line)
        self._letters += len(line)

    def end(self, why: tuple[int, str]) -> None:
        """No more messages: code and reason for the browser."""
        if self.ended is None:
            self.ended = why
            self._clear()
            self.on_end()
        self._wake.set()

    def end_soon(self, why: tuple[int, str]) -> None:
        """No more messages after those that wait."""
        if self.ended is None:
            self.ended = why
        self._wake.set()

    def _clear(self) -> None:
        self._lines.clear()
        self._live.clear()
        self._letters = 0

    async def next(self) -> list[str]:
        """What waits, once something does; nothing at all when it has ended."""
        while not (self._lines or self._live or self.ended):
            self._wake.clear()
            await self._wake.wait()
        out = [*self._lines, *self._live.values()]
        self._clear()
        return out


class Rooms:
    """The listeners of all cases. Lives on one event loop."""

    def __init__(self, most: int = 4000, most_letters: int = 16_000_000) -> None:
        self._most, self._most_letters = most, most_letters
        self._rooms: dict[str, set[Listener]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None

    def join(self, case: str, speaker: Speaker, session: str = "") -> Listener:
        """A new listener; the others hear of it."""
        self._loop = asyncio.get_running_loop()
        made = Listener(speaker, self._most, self._most_letters, session)
        self._rooms.setdefault(case, set()).add(made)
        self._presence(case)
        return made

    def leave(self, case: str, listener: Listener) -> None:
        """One listener less."""
        room = self._rooms.get(case, set())
        room.discard(listener)
        if room:
            self._presence(case)
        else:
            self._rooms.pop(case, None)

    def present(self, case: str) -> list[str]:
        """Who is there."""
        return sorted({x.speaker.person for x in self._rooms.get(case, ())})

    def count(self, case: str, person: str | None = None) -> int:
        """How many connections there are, of all or of one person."""
        return sum(person in (None, x.speaker.person) for x in self._rooms.get(case, ()))

    def expel(self, person: str, case: str | None = None, session: str | None = None) -> None:
        """Closes whatever somebody has open, in one case or all, of one session or all. May be called by any thread."""
        try:
            here = asyncio.get_running_loop()
        except RuntimeError:
            here = None
        if self._loop is None or here is self._loop:
            self._expel(person, case, session)
        elif not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._expel, person, case, session)

    def _expel(self, person: str, case: str | None, session: str | None) -> None:
        for name, room in list(self._rooms.items()):
            for listener in list(room):
                wanted = case in (None, name) and session in (None, listener.session)
                if listener.speaker.person == person and wanted:
                    listener.end(EXPELLED)

    def sessions(self) -> dict[str, bool]:
        """The sessions (by digest) that have a connection open, and whether they were used since the last time."""
        out: dict[str, bool] = {}
        for room in self._rooms.values():
            for listener in room:
                out[listener.session] = out.get(listener.session, False) or listener.active
                listener.active = False
        return out

    def end_sessions(self, ended: set[str]) -> None:
        """Closes the connections of sessions that are over."""
        for room in self._rooms.values():
            for listener in room:
                if listener.session in ended:
                    listener.end(SIGNED_OUT)

    def close(self, case: str, why: tuple[int, str]) -> None:
        """Closes one room, once everybody in it has been sent what waits for them."""
        for listener in self._rooms.get(case, ()):
            listener.end_soon(why)

    def end(self) -> None:
        """Closes all."""
        for room in self._rooms.values():
            for listener in room:
                listener.end(OVER)

    def event(self, case: str, event: Event) -> None:
        """An event, for all."""
        self._all(case, event.model_dump_json())

    def standing(self, case: str, standing: Standing) -> None:
        """How things stand, for all."""
        self._all(case, standing.model_dump_json())

    def warn(self, case: str, warned: Warned) -> None:
        """A warning, for the operators."""
        line = warned.model_dump_json()
        for listener in list(self._rooms.get(case, ())):
            if listener.speaker.role is PersonRole.OPERATOR:
                listener.send(line)

    def relay(self, case: str, sender: Listener, relayed: Relayed) -> None:
        """What somebody points at, sees or draws, for the others."""
        line, key = relayed.model_dump_json(), (relayed.person, relayed.what.type)
        for listener in self._rooms.get(case, ()):
            if listener is not sender:
                listener.send_live(key, line)

    def _presence(self, case: str) -> None:
        line = Presence(present=self.present(case)).model_dump_json()
        for listener in self._rooms.get(case, ()):
            listener.send_live(("", "presence"), line)

    def _all(self, case: str, line: str) -> None:
        for listener in list(self._rooms.get(case, ())):
            listener.send(line)
