"""The one place where words get their order: rights, log, truth, and everybody in the room hears of it.

Words of all cases wait in one queue; one task takes what waits, folds it into a copy of the truth, writes it in one
transaction, and only then makes the copy the truth, answers and tells the rooms. What cannot be written did not happen,
and nobody ever saw it. A stop does not wait for the disk: the projector is dark before it is written down.

What people draw and remark is told once the operating system has it, which outlives this process however it ends; the
disk has it an instant later. All else, what bears on light, rights and signatures, waits for the disk itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import sqlalchemy as sa

from fringescope import examination
from fringescope.errors import FringescopeError, OutputError
from fringescope.server import database as db
from fringescope.server import journal, truth
from fringescope.server.accounts import Accounts
from fringescope.server.clock import Clock
from fringescope.server.rights import Speaker, refusal
from fringescope.server.rooms import EXPELLED, Rooms
from fringescope.settings import ExaminationSettings
from fringescope.types.examination import Dark, GuardLost, Phase, Warn, What
from fringescope.wire.ops import Op
from fringescope.wire.record import GENESIS, Record, link
from fringescope.wire.room import Event, Said, Standing, Warned

INSTRUMENT = "instrument"
_BATCH = 256  #: words written at once
_BOOKS = 64  #: cases whose truth is kept ready
_SAID = 1000  #: answers of each client that are kept ready; older ones are looked up in the log
_EARLY = frozenset({"put", "remove", "layer", "comment", "withdraw", "undo"})  #: told before the disk has them
_INVITED = ("expert", "observer")  #: who sees a case by invitation alone
_TIDY = 256  #: so many words, and the database's log ahead is brought into its file
_OWED_S = 1.0  #: a stop that could not be written down is tried again so often
_LOG = logging.getLogger("fringescope.hub")

CarryOut = Callable[[Record, truth.Fold], Awaitable[None]]


@dataclass(eq=False)
class Heard:
    """What a client has said in a case: the latest answers by number, and how many are no longer kept here."""

    latest: dict[int, tuple[int, str]] = field(default_factory=dict)  #: number -> (event, refused)
    highest: int = 0
    dropped: bool = False

    def keep(self, number: int, seq: int, refused: str) -> None:
        """One answer more."""
        self.latest[number] = (seq, refused)
        self.highest = max(self.highest, number)
        if len(self.latest) > _SAID:
            del self.latest[next(iter(self.latest))]
            self.dropped = True


@dataclass(eq=False)
class Book:
    """A case that is open: its truth as it is written, the end of its chain, and what was said in it already."""

    truth: truth.Truth
    seq: int
    head: str
    said: dict[tuple[str, str], Heard]  #: by person and client
    gone: frozenset[str] = frozenset()  #: whose right to see it was taken away

    def admit(self, kind: str, payload: dict[str, Any]) -> None:
        """Who comes and goes."""
        person = payload.get("person")
        if person and kind in ("invited", "joined", "revoked"):
            self.gone = self.gone | {person} if kind == "revoked" else self.gone - {person}


@dataclass(eq=False)
class _Waiting:
    """A word that waits for its place."""

    case: str
    actor: str
    role: str
    kind: str
    payload: dict[str, Any]
    client: str
    number: int
    said_ns: int
    refused: str
    answer: asyncio.Future[Said]
    beside: Callable[[sa.Connection], None] | None = None  #: written in the same transaction, before the event
    after: Callable[[sa.Connection], None] | None = None  #: and behind it, as the last of all


@dataclass(eq=False)
class _Batch:
    books: dict[str, Book] = field(default_factory=dict)  #: as they will be
    said: dict[tuple[str, str, str, int], tuple[int, str]] = field(default_factory=dict)
    records: list[Record] = field(default_factory=list)
    beside: list[Callable[[sa.Connection], None]] = field(default_factory=list)
    after: list[Callable[[sa.Connection], None]] = field(default_factory=list)
    folds: list[tuple[_Waiting, Record, truth.Fold]] = field(default_factory=list)
    answers: list[tuple[_Waiting, Said]] = field(default_factory=list)
    early: bool = False  #: told before the disk has it


class Hub:
    """The shared truth of all cases. Lives on one event loop; `start` and `stop` frame its life."""

    def __init__(
        self, engine: sa.Engine, clock: Clock, accounts: Accounts, rooms: Rooms,
        settings: ExaminationSettings | None = None,
    ):  # fmt: skip
        self.engine, self.clock, self.accounts, self.rooms = engine, clock, accounts, rooms
        self._settings = settings or ExaminationSettings()
        self._queue: asyncio.Queue[_Waiting] = asyncio.Queue()
        self._books: dict[str, Book] = {}
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="log")
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="disk")
        self._flushing: asyncio.Task[None] | None = None
        self._unflushed = self._untidy = 0  #: words that the disk may not have, and all since it was last tidied up
        self._cautious = False  #: the disk refused what was told: from then on every word waits for it
        self._task: asyncio.Task[None] | None = None
        self._ticks: asyncio.Task[None] | None = None
        self._numbers = 0
        self._run = secrets.token_hex(8)  #: this run of the hub, the client of its own words
        self._owed: set[str] = set()  #: cases that are dark although their log could not say so
        self.carry_out: CarryOut = _nobody
        self.dark: Callable[[str], None] = lambda _why: None  #: darkness at once, from any thread

    async def start(self) -> None:
        """Begins to take words. What was lit when the hub last ended is stopped: nobody watched over it."""
        self._task = asyncio.create_task(self._write(), name="hub")
        self._ticks = asyncio.create_task(self._tick(), name="hub clock")
        for case in await self._in_thread(lambda: list(journal.heads(self.engine))):
            book = await self._book(case)
            lit = [v for v in book.truth.exam.versions if v.phase in (Phase.ARMED, Phase.PROJECTING)]
            if lit or book.truth.exam.guarded:
                await self.tell(case, GuardLost("the hub was started anew"))

    async def stop(self) -> None:
        """Takes no more words; what waits is still written."""
        if self._ticks is not None:
            self._ticks.cancel()
        if self._task is not None:
            await self._queue.join()
            self._task.cancel()
        if self._flushing is not None:
            await self._flushing
        self._writer.shutdown()
        self._disk.shutdown()

    # ------------------------------------------------------------------------------------------------------- saying

    async def say(self, case: str, speaker: Speaker, op: Op, extra: dict[str, Any] | None = None) -> Said:
        """A person's op: its place in the log, or why nothing came of it. Said twice it is answered twice, done once.

        `extra`: what the hub itself adds to it.
        """
        what = op.what
        payload = what.model_dump(mode="json", exclude={"kind"}, exclude_none=what.kind in ("put", "undo"))
        payload |= extra or {}
        if what.kind == "put":
            payload["stroke"] = {k: v for k, v in payload["stroke"].items() if v is not None}
        why = refusal(speaker, what.kind, self.clock.now_ns())
        if not self.accounts.allowed(speaker.person):
            why = "your account was closed, or your invitation has ended"
        if why:
            payload = {}
        dark = what.kind == "stop" and not why and self.lit(case)
        if dark:
            self.dark(f"stopped by {speaker.person}")
        said = await self._put(
            case, speaker.person, speaker.role.value, what.kind, payload, op.client, op.number, op.at_ns, why
        )
        if dark and said.seq is None:
            self._owed.add(case)
        return said

    async def tell(self, case: str, word: What) -> Said:
        """A word of the instrument, for the examination of a case."""
        plain = examination.to_dict(word)
        return await self.note(case, INSTRUMENT, INSTRUMENT, plain.pop("kind"), plain)

    async def note(
        self, case: str, actor: str, role: str, kind: str, payload: dict[str, Any],
        beside: Callable[[sa.Connection], None] | None = None, after: Callable[[sa.Connection], None] | None = None,
    ) -> Said:  # fmt: skip
        """An event that the hub itself writes down, with what `beside` and `after` change in the same transaction."""
        self._numbers += 1
        return await self._put(case, actor, role, kind, payload, self._run, self._numbers, 0, "", beside, after)

    async def _put(
        self, case: str, actor: str, role: str, kind: str, payload: dict[str, Any], client: str, number: int,
        said_ns: int, refused: str, beside: Callable[[sa.Connection], None] | None = None,
        after: Callable[[sa.Connection], None] | None = None,
    ) -> Said:  # fmt: skip
        answer: asyncio.Future[Said] = asyncio.get_running_loop().create_future()
        self._queue.put_nowait(
            _Waiting(case, actor, role, kind, payload, client, number, said_ns, refused, answer, beside, after)
        )
        return await answer

    # ------------------------------------------------------------------------------------------------------ knowing

    async def truth_of(self, case: str) -> tuple[truth.Truth, int]:
        """Where a case stands, and after which event."""
        book = await self._book(case)
        return book.truth, book.seq

    async def take_in(self, case: str, write: Callable[[sa.Connection], None]) -> None:
        """Writes a case that comes from elsewhere, between two batches of words. Raises OutputError and what it raises.

        What was lit or armed there is stopped: nobody watches over it here.
        """

        def work() -> None:
            with db.writing(self.engine) as c:
                write(c)

        await self._in_thread(work)
        self._books.pop(case, None)
        book = await self._book(case)
        if book.truth.exam.guarded or any(v.phase in (Phase.ARMED, Phase.PROJECTING) for v in book.truth.exam.versions):
            await self.tell(case, GuardLost("the case was brought in from elsewhere"))

    def forget(self, case: str) -> None:
        """Lets go of what is known of a case; it is read again when somebody asks."""
        self._books.pop(case, None)

    def open_cases(self) -> list[str]:
        """Cases whose truth is at hand: those that anybody has looked at lately."""
        return list(self._books)

    def lit(self, case: str) -> bool:
        """Whether something of a case may be on the projector."""
        book = self._books.get(case)
        return book is not None and any(v.phase is Phase.PROJECTING for v in book.truth.exam.versions)

    def can_stop(self, case: str) -> bool:
        """Whether something of a case is armed or lit."""
        book = self._books.get(case)
        phases = (Phase.ARMED, Phase.PROJECTING)
        return book is not None and any(v.phase in phases for v in book.truth.exam.versions)

    async def _book(self, case: str) -> Book:
        if case not in self._books:
            made = await self._in_thread(lambda: self._read(case))
            self._books.setdefault(case, made)
        book = self._books.pop(case)
        self._books[case] = book  # the latest used stays longest
        for old in list(self._books)[: max(0, len(self._books) - _BOOKS)]:
            if not self.lit(old) and not self._books[old].truth.exam.guarded:
                del self._books[old]
        return book

    def _read(self, case: str) -> Book:
        book = Book(truth.Truth(), 0, GENESIS, {})
        for r in journal.entries(self.engine, case):
            if not r.refused:
                book.truth = truth.follow(book.truth, r, self._settings).truth
                book.admit(r.kind, r.payload or {})
            book.seq, book.head = r.seq, r.hash
            if r.actor != INSTRUMENT:  # it never says anything twice
                book.said.setdefault((r.actor, r.client), Heard()).keep(r.number, r.seq, r.refused)
        return book

    async def _in_thread(self, work: Callable[[], Any]) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._writer, work)

    # ------------------------------------------------------------------------------------------------------ writing

    async def _write(self) -> None:
        while True:
            waiting = [await self._queue.get()]
            while len(waiting) < _BATCH and not self._queue.empty():
                waiting.append(self._queue.get_nowait())
            try:
                await self._take(waiting)
            except Exception as e:  # a fault of ours must not end the hub: these words did not happen
                _LOG.exception("words were not taken")
                self._refuse(waiting, f"{type(e).__name__}: this is a bug; report it. Nothing was changed")
            finally:
                for _ in waiting:
                    self._queue.task_done()

    async def _take(self, waiting: list[_Waiting], again: bool = True) -> None:
        batch = _Batch(early=not self._cautious and all(w.kind in _EARLY for w in waiting))
        try:
            for w in waiting:
                if w.case not in batch.books:
                    batch.books[w.case] = replace(await self._book(w.case))
                self._place(batch, w, await self._earlier(batch, w))
            await self._in_thread(lambda: self._commit(batch))
        except OutputError as e:
            caught_up = await self._catch_up(batch)
            if caught_up and again:  # the answer of the database was lost, not the words
                await self._take(waiting, again=False)
            else:
                self._refuse(waiting, str(e))
            return
        except Exception as e:
            if len(waiting) > 1:  # one word that cannot be written takes no other down with it
                for w in waiting:
                    await self._take([w])
                return
            if not isinstance(e, (FringescopeError, sa.exc.DatabaseError)):
                raise
            why = f"it cannot be written: {e.orig}" if isinstance(e, sa.exc.DatabaseError) else str(e)
            await self._catch_up(batch)
            self._refuse(waiting, f"{why}; nothing was changed")
            return
        self._keep(batch)
        self._untidy += len(batch.records)
        if batch.early or self._untidy >= _TIDY:
            self._flush_soon(len(batch.records))
        for w, said in batch.answers:
            if not w.answer.done():
                w.answer.set_result(said)
        for w, record, fold in batch.folds:
            self.rooms.event(w.case, as_event(record))
            if record.kind == "revoked" and not record.refused and w.payload.get("person"):
                self.rooms.expel(w.payload["person"], w.case)
            try:
                await self._follow_up(w.case, record, fold)
            except Exception:  # the next ones are told all the same
                _LOG.exception("event %d of case %s was not carried out", record.seq, w.case)

    @staticmethod
    def _refuse(waiting: list[_Waiting], why: str) -> None:
        for w in waiting:
            if not w.answer.done():
                w.answer.set_result(Said(client=w.client, number=w.number, seq=None, refused=why))

    def _keep(self, batch: _Batch) -> None:
        """What was written is the truth from now on."""
        self._books.update(batch.books)
        for (case, actor, client, number), (seq, refused) in batch.said.items():
            batch.books[case].said.setdefault((actor, client), Heard()).keep(number, seq, refused)

    async def _catch_up(self, batch: _Batch) -> bool:
        """After a failure: reads cases anew whose log goes on behind what is known here; whether there was one."""
        found = False
        for case in batch.books:
            book = await self._book(case)
            try:
                unknown = await self._in_thread(partial(self._behind, case, book.seq))
                if not unknown:
                    continue
                self._books[case] = book = await self._in_thread(partial(self._read, case))
            except (FringescopeError, sa.exc.SQLAlchemyError):
                continue  # it does not answer at all
            for r in unknown:
                self.rooms.event(case, as_event(r))
            self.rooms.standing(case, Standing(seq=book.seq, state=truth.standing(book.truth)))
            found = True
        return found

    def _behind(self, case: str, seq: int) -> list[Record]:
        return list(journal.entries(self.engine, case, seq))

    async def _earlier(self, batch: _Batch, w: _Waiting) -> tuple[int, str] | None:
        """The answer that a word was given before, if it was said before."""
        if (found := batch.said.get((w.case, w.actor, w.client, w.number))) is not None:
            return found
        heard = batch.books[w.case].said.get((w.actor, w.client))
        if heard is None:
            return None
        if heard.dropped and w.number <= heard.highest and w.number not in heard.latest:
            asked = (self.engine, w.case, w.actor, w.client, w.number)
            kept: tuple[int, str] | None = await self._in_thread(lambda: journal.answer(*asked))
            return kept
        return heard.latest.get(w.number)

    def _place(self, batch: _Batch, w: _Waiting, earlier: tuple[int, str] | None) -> None:
        """Gives a word its place, unless it has one."""
        if earlier is not None:
            said = Said(client=w.client, number=w.number, seq=earlier[0], refused=earlier[1])
            batch.answers.append((w, said))
            return
        book = batch.books[w.case]
        if w.actor in book.gone and w.role in _INVITED and not w.refused:  # it waited behind the word that ended that
            w.refused, w.payload = EXPELLED[1], {}
        bare = Record(
            w.case, book.seq + 1, self.clock.now_ns(), w.said_ns, w.actor, w.role, w.client, w.number, w.kind,
            w.refused, secrets.token_hex(16), w.payload, "", "",
        )  # fmt: skip
        fold = truth.Fold(book.truth, w.payload, refused=w.refused)
        if not w.refused:
            fold = truth.follow(book.truth, bare, self._settings)
        record = link(replace(bare, payload=fold.payload, refused=fold.refused), book.head)
        book.truth, book.seq, book.head = fold.truth, record.seq, record.hash
        if not record.refused:
            book.admit(record.kind, record.payload or {})
        if w.client != self._run:
            batch.said[w.case, w.actor, w.client, w.number] = (record.seq, record.refused)
        batch.records.append(record)
        if w.beside is not None and not record.refused:
            batch.beside.append(w.beside)
        if w.after is not None and not record.refused:
            batch.after.append(w.after)
        batch.folds.append((w, record, fold))
        said = Said(client=w.client, number=w.number, seq=record.seq, refused=record.refused)
        batch.answers.append((w, said))

    def _commit(self, batch: _Batch) -> None:
        with db.writing(self.engine, batch.early) as c:
            for beside in batch.beside:
                beside(c)
            journal.append(c, batch.records)
            for after in batch.after:
                after(c)

    def _flush_soon(self, words: int) -> None:
        """Brings what was told to the disk, all that there is at once."""
        self._unflushed += words
        if self._flushing is None or self._flushing.done():
            self._flushing = asyncio.create_task(self._flush(), name="disk")

    async def _flush(self) -> None:
        while self._unflushed:
            self._unflushed = 0
            tidy, self._untidy = self._untidy >= _TIDY, self._untidy % _TIDY
            try:
                await asyncio.get_running_loop().run_in_executor(self._disk, self._to_disk, tidy)
            except (OutputError, sa.exc.SQLAlchemyError) as e:
                self._cautious = True
                _LOG.error("what was told may not be on the disk: %s; from now on every word waits for it", e)

    def _to_disk(self, tidy: bool) -> None:
        db.flush(self.engine)
        if tidy:
            db.tidy(self.engine)

    async def _follow_up(self, case: str, record: Record, fold: truth.Fold) -> None:
        if fold.refused:
            return
        for effect in fold.effects:
            if isinstance(effect, Warn):
                self.rooms.warn(case, Warned(text=effect.text))
            elif isinstance(effect, Dark):
                self.dark(effect.why)
        if record.kind not in _DRAWN:
            self.rooms.standing(case, Standing(seq=record.seq, state=truth.standing(fold.truth)))
        if fold.effects or record.kind == "preview":
            await self.carry_out(record, fold)

    async def _tick(self) -> None:
        """What the clock makes true."""
        owed_s = 0.0
        while True:
            await asyncio.sleep(0.05)
            with contextlib.suppress(FringescopeError):
                for case, book in list(self._books.items()):
                    if any(v.phase in (Phase.ARMED, Phase.PROJECTING) for v in book.truth.exam.versions):
                        for word in examination.due(book.truth.exam, self.clock.now_ns(), self._settings):
                            await self.tell(case, word)
            if self._owed and time.monotonic() - owed_s > _OWED_S:
                owed_s = time.monotonic()
                for case in list(self._owed):
                    said = await self.tell(case, GuardLost("stopped; it could not be written down at once"))
                    if said.seq is not None:
                        self._owed.discard(case)


_DRAWN = ("put", "remove", "layer", "comment", "withdraw", "undo", "opened", "changed", "invited", "joined")


def as_event(r: Record) -> Event:
    """An entry of the log as the room hears it."""
    return Event(
        seq=r.seq, at_ns=r.at_ns, actor=r.actor, role=r.role, client=r.client, number=r.number, kind=r.kind,
        refused=r.refused, payload=r.payload, hash=r.hash,
    )  # fmt: skip


async def _nobody(_record: Record, _fold: truth.Fold) -> None:
    """A hub without an instrument carries out nothing."""
