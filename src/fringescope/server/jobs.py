"""Work that takes long: one at a time, with progress for who waits and an end for who does not."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

import sqlalchemy as sa

from fringescope.errors import FringescopeError, UsageError
from fringescope.server import database as db
from fringescope.server.accounts import new_id
from fringescope.server.clock import Clock
from fringescope.wire import Job, JobState

Tell = Callable[[str, float], None]
Work = Callable[[Tell], Awaitable[dict[str, Any]]]
_WAITING = 20  #: jobs that may wait


class Jobs:
    """The jobs of a hub. Lives on one event loop."""

    def __init__(self, engine: sa.Engine, clock: Clock) -> None:
        self._engine, self._clock = engine, clock
        self._now: dict[str, Job] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._turn = asyncio.Lock()
        with db.writing(engine) as c:  # of a hub that was killed
            left = db.jobs.c.state.in_(("waiting", "running"))
            values = {"state": "failed", "why": "the hub ended before it was done; start it anew",
                      "ended_ns": clock.now_ns()}  # fmt: skip
            c.execute(db.jobs.update().where(left).values(values))

    async def begin(self, kind: str, case: str | None, person: str, work: Work) -> Job:
        """A new job, which begins when those before it have ended. Raises UsageError where too many wait."""
        if len(self._now) >= _WAITING:
            raise UsageError(f"{len(self._now)} jobs wait already; try again when one has ended")
        job = Job(
            id=new_id("job"), kind=kind, case=case, state=JobState.WAITING, stage="", share=0.0,
            created_ns=self._clock.now_ns(),
        )  # fmt: skip
        row = {**job.model_dump(mode="json", exclude={"case"}), "case_id": case, "person_id": person}
        self._now[job.id] = job  # it counts from now on
        try:
            await asyncio.to_thread(self._insert, row)  # a database may be busy for seconds: nobody else waits for it
        except BaseException:
            del self._now[job.id]
            raise
        self._tasks[job.id] = asyncio.create_task(self._run(job, work), name=job.id)
        return job

    def _insert(self, row: dict[str, Any]) -> None:
        with db.writing(self._engine) as c:
            c.execute(db.jobs.insert().values(row))

    async def _run(self, job: Job, work: Work) -> None:
        def tell(stage: str, share: float) -> None:
            job.stage, job.share = stage, share

        try:
            async with self._turn:
                job.state = JobState.RUNNING
                job.result = await work(tell)
            job.state, job.share = JobState.DONE, 1.0
        except asyncio.CancelledError:
            job.state, job.why = JobState.CANCELLED, "cancelled"
        except FringescopeError as e:
            job.state, job.why = JobState.FAILED, str(e)
        except OSError as e:
            job.state, job.why = JobState.FAILED, f"{e.strerror or e}; nothing was kept"
        except Exception as e:
            job.state, job.why = JobState.FAILED, f"{type(e).__name__}: {e}: this is a bug; report it"
        finally:
            job.ended_ns = self._clock.now_ns()
            with contextlib.suppress(FringescopeError):
                await asyncio.shield(asyncio.to_thread(self._keep, job))
            self._now.pop(job.id, None)
            self._tasks.pop(job.id, None)

    def _keep(self, job: Job) -> None:
        row = job.model_dump(mode="json", include={"state", "stage", "share", "why", "result", "ended_ns"})
        with db.writing(self._engine) as c:
            c.execute(db.jobs.update().where(db.jobs.c.id == job.id).values(row))

    def get(self, job: str) -> Job | None:
        """A job, as it stands."""
        if job in self._now:
            return self._now[job]
        with db.reading(self._engine) as c:
            row = c.execute(sa.select(db.jobs).where(db.jobs.c.id == job)).mappings().first()
        return None if row is None else _job(row)

    def all(self, case: str | None, limit: int = 100) -> list[Job]:
        """The latest jobs, of one case or of all."""
        asked = sa.select(db.jobs).order_by(db.jobs.c.created_ns.desc()).limit(limit)
        if case is not None:
            asked = asked.where(db.jobs.c.case_id == case)
        with db.reading(self._engine) as c:
            rows = [_job(row) for row in c.execute(asked).mappings()]
        return [self._now.get(j.id, j) for j in rows]

    def cancel(self, job: str) -> bool:
        """Ends a job; whether it was still going."""
        task = self._tasks.get(job)
        return task is not None and task.cancel()

    async def cancel_all(self, case: str) -> None:
        """Ends all jobs of a case, and waits until they have."""
        tasks = [self._tasks[j.id] for j in list(self._now.values()) if j.case == case and j.id in self._tasks]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def stop(self) -> None:
        """Ends all."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _job(row: Any) -> Job:
    values = {k: v for k, v in row.items() if k not in ("case_id", "person_id")}
    return Job(**values, case=row["case_id"])
