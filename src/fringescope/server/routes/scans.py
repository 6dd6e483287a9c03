"""Scans and their files, jobs, and the instrument."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Query
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool

from fringescope.errors import UsageError
from fringescope.server import cases as kept
from fringescope.server.asking import CaseId, Who, may_see, problems
from fringescope.server.jobs import Work
from fringescope.wire import Job, Op, ScanFile, ScanInfo
from fringescope.wire.documents import AskedCarry, AskedCompare, Ended, InstrumentState, NewPose, NewScan
from fringescope.wire.room import Said

router = APIRouter(prefix="/api")
Hash = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the file, in hex.")]
JobId = Annotated[str, Path(pattern=r"^job-[0-9a-f]{20}$")]
_INLINE = ("image/jpeg", "image/png", "model/gltf-binary", "application/json")


@router.get("/cases/{case}/scans", tags=["scans"], responses=problems(401, 403, 404))
def scans(case: CaseId, who: Who) -> list[ScanInfo]:
    """The scans of a case, in the order in which they were taken, with their files."""
    who.case(case, "case.read")
    return kept.scans_of(who.site.engine, case)


@router.post("/cases/{case}/scans", status_code=202, tags=["scans"], responses=problems(401, 403, 404, 409))
async def scan(case: CaseId, asked: NewScan, who: Who) -> Job:
    """Takes a scan, as a job: for the operator at the instrument, it projects fringes."""
    await run_in_threadpool(who.case, case, "scan.take")
    return await _begin(who, "scan", case, lambda tell: who.site.lab.scan(case, asked.label, tell))


async def _begin(who: Who, kind: str, case: str | None, work: Work) -> Job:
    """A job, or 409 where too many wait."""
    try:
        return await who.site.jobs.begin(kind, case, who.speaker.person, work)
    except UsageError as e:
        raise HTTPException(409, str(e)) from None


@router.post("/cases/{case}/carry", status_code=202, tags=["scans"], responses=problems(401, 403, 404, 409))
async def carry(case: CaseId, asked: AskedCarry, who: Who) -> Job:
    """Lays the strokes of a stale version on the present scan, as a job: for the operator to look at."""
    await run_in_threadpool(who.case, case, "carry_over")
    return await _begin(who, "carry", case, lambda tell: who.site.lab.carry(case, asked.version, tell))


@router.post("/cases/{case}/carry_over", tags=["scans"], responses=problems(400, 401, 403, 404))
async def carry_over(case: CaseId, op: Op, who: Who) -> Said:
    """The operator takes what job `job` laid on the present scan; the strokes become theirs."""
    await run_in_threadpool(who.case, case, "carry_over")
    if op.what.kind != "carry_over":
        raise HTTPException(400, f"an op of kind {op.what.kind}; needed carry_over")
    found = await run_in_threadpool(who.site.jobs.get, op.what.job)
    result = found.result if found is not None and found.case == case and found.kind == "carry" else None
    if result is None or result["version"] != op.what.version or result["scan"] != op.what.scan:
        raise HTTPException(400, "no such job laid this version on this scan; let it be laid there first")
    extra = {"strokes": result["strokes"], "residual_um": result["residual_um"]}
    return await who.site.hub.say(case, who.speaker, op, extra)


@router.post("/cases/{case}/compare", status_code=202, tags=["scans"], responses=problems(401, 403, 404, 409))
async def compare(case: CaseId, asked: AskedCompare, who: Who) -> Job:
    """What was cut from one scan of a case to another, as a job; its maps and figures go into the case."""
    await run_in_threadpool(who.case, case, "scan.compare")
    return await _begin(
        who, "compare", case,
        lambda tell: who.site.lab.compare(case, asked.before, asked.after, asked.version, tell),
    )  # fmt: skip


@router.get("/cases/{case}/files", tags=["scans"], responses=problems(401, 403, 404))
def files(case: CaseId, who: Who) -> dict[str, list[ScanFile]]:
    """All files of a case, by what they belong to: a scan, a version, an event."""
    who.case(case, "case.read")
    return kept.files_of(who.site.engine, case)


@router.get(
    "/cases/{case}/files/{sha256}",
    tags=["scans"],
    response_class=FileResponse,
    responses={
        200: {"content": {"*/*": {}}, "description": "The file."},
        206: {"content": {"*/*": {}}, "description": "A range of it."},
        **problems(401, 403, 404, 416),
    },
)
def file(case: CaseId, sha256: Hash, who: Who) -> FileResponse:
    """A file by its content: it never changes. Ranges are answered."""
    who.case(case, "case.read")
    found = kept.file_type(who.site.engine, case, sha256)
    if found is None or not who.site.blobs.has(sha256):
        raise HTTPException(404, "this case has no such file")
    name, kind = found
    plain = re.sub(r"[^A-Za-z0-9._-]", "-", name.rsplit("/", 1)[-1]) or "file"
    return FileResponse(
        who.site.blobs.path(sha256),
        media_type=kind,
        filename=plain,
        content_disposition_type="inline" if kind in _INLINE else "attachment",
        headers={"cache-control": "private, max-age=31536000, immutable", "etag": f'"{sha256}"'},
    )


# --------------------------------------------------------------------------------------------------------------- jobs


@router.get("/jobs", tags=["jobs"], responses=problems(401, 403, 404))
def jobs(who: Who, case: Annotated[str | None, Query(pattern=r"^case-[0-9a-f]{20}$")] = None) -> list[Job]:
    """The latest jobs: of one case, or of all for operators."""
    if case is not None:
        who.case(case, "job.read")
    else:
        who.must("job.cancel")
    return who.site.jobs.all(case)


def _job(job: str, who: Who, what: str) -> Job:
    who.must(what)
    found = who.site.jobs.get(job)
    if found is None or (found.case is not None and not may_see(who.site, who.speaker, found.case)):
        raise HTTPException(404, "there is no such job")
    return found


@router.get("/jobs/{job}", tags=["jobs"], responses=problems(401, 403, 404))
def job(job: JobId, who: Who) -> Job:
    """How far a job is."""
    return _job(job, who, "job.read")


@router.delete("/jobs/{job}", tags=["jobs"], responses=problems(401, 403, 404))
async def cancel(job: JobId, who: Who) -> Job:
    """Cancels a job; nothing of it is kept."""
    found = await run_in_threadpool(_job, job, who, "job.cancel")
    who.site.jobs.cancel(job)
    return found


# --------------------------------------------------------------------------------------------------------- instrument


@router.get("/instrument", tags=["instrument"], responses=problems(401, 403))
async def instrument(who: Who) -> InstrumentState:
    """The instrument: is it there, what does it do."""
    who.must("instrument.read")
    state = who.site.instrument.state()
    seen = state.case is None or await run_in_threadpool(may_see, who.site, who.speaker, state.case)
    return state if seen else state.model_copy(update={"case": None, "projecting": None})


@router.post("/instrument/stop", tags=["instrument"], responses=problems(401, 403))
async def stop(who: Who) -> Ended:
    """Dark, whatever is projected: for everybody, at any time."""
    who.must("instrument.stop")
    await who.site.instrument.stop_all(who.speaker)
    return Ended()


@router.post("/instrument/poses", status_code=202, tags=["instrument"], responses=problems(401, 403, 409))
async def pose(asked: NewPose, who: Who) -> Job:
    """Photographs the calibration board where it lies now, as a job; the first pose says which board it is."""
    who.must("instrument.calibrate")
    return await _begin(who, "pose", None, lambda tell: who.site.lab.pose(asked.board, tell))


@router.post("/instrument/calibrate", status_code=202, tags=["instrument"], responses=problems(401, 403, 409))
async def calibrate(who: Who) -> Job:
    """The poses so far to a rig, as a job; scans are made with it from then on."""
    who.must("instrument.calibrate")
    return await _begin(who, "calibrate", None, who.site.lab.calibrate)


@router.post("/instrument/simulate", tags=["instrument"], responses=problems(401, 409))
async def simulate(what: dict[str, str], who: Who) -> Ended:
    """For the simulated instrument alone: something happens to the specimen, as {"move": "0.3,0,0"}."""
    who.must("scan.take")
    try:
        await who.site.instrument.befall(what)
    except UsageError as e:
        raise HTTPException(400, str(e)) from None
    return Ended()
