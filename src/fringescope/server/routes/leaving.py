"""Cases as files: out, back in, scans from elsewhere; and erasure."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from fringescope.errors import FormatError, FringescopeError, UsageError
from fringescope.server import cases as kept
from fringescope.server import leaving as work
from fringescope.server.asking import CaseId, Who, problems
from fringescope.wire import Case, Job
from fringescope.wire.documents import AskedErasure, Erased

router = APIRouter(prefix="/api/cases", tags=["leaving"])
ZIP = "application/zip"
_BODY: dict[str, Any] = {
    "requestBody": {"required": True, "content": {ZIP: {"schema": {"type": "string", "format": "binary"}}}}
}


@router.get(
    "/{case}/bundle",
    response_class=FileResponse,
    responses={200: {"content": {ZIP: {}}, "description": "The bundle."}, **problems(401, 403, 404, 409, 507)},
)
async def bundle(
    case: CaseId,
    who: Who,
    patient: Annotated[bool, Query(description="With the patient's name: for operators alone.")] = False,
) -> FileResponse:
    """A case as one file: surfaces, photographs, strokes, the log with its chain, a report. By pseudonym if not asked.

    What people wrote into texts themselves goes with it as it is.
    """
    await run_in_threadpool(who.case, case, "case.bundle")
    if patient:
        who.must("case.patient")
    found = await run_in_threadpool(kept.get, who.site.engine, case, patient)
    if found is None:
        raise HTTPException(404, "there is no such case")
    taking, person, most = who.site.leaving.taking, who.speaker.person, who.site.config.limits.bundles_each
    if taking[person] >= most:
        raise HTTPException(429, f"you are taking {most} bundles already; wait until one of them has come")
    taking[person] += 1
    folder = Path(tempfile.mkdtemp(dir=_work(who), prefix="bundle-"))

    def over() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        taking[person] -= 1

    try:
        file = await who.site.leaving.bundle(found, found.patient, folder)
    except BaseException as e:
        over()
        if isinstance(e, UsageError):
            raise HTTPException(410, str(e)) from None
        raise
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", found.specimen.pseudonym or found.accession).strip("-.") or "case"
    passing = _Passing(file, media_type=ZIP, filename=f"{name[:60]}-{case[-6:]}.zip")
    passing.over = over
    return passing


class _Passing(FileResponse):
    """A file whose folder goes when it was sent, or when nobody takes it."""

    over: Callable[[], None]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self.over()


def _work(who: Who) -> Path:
    folder = who.site.config.data / "work"
    folder.mkdir(exist_ok=True)
    return folder


@asynccontextmanager
async def _upload(request: Request, who: Who) -> AsyncIterator[Path]:
    """The body as a file, which goes at the end unless somebody takes its folder."""
    length = request.headers.get("content-length", "0")
    who.site.leaving.check_room(int(length) if length.isdigit() else 0)
    folder = Path(tempfile.mkdtemp(dir=_work(who), prefix="upload-"))
    try:
        try:
            await work.received(request.stream(), folder / "upload.zip", who.site.config.limits.upload_bytes)
        except ClientDisconnect:
            raise HTTPException(400, "the connection ended before all of it had come; nothing was kept") from None
        except FormatError as e:
            raise HTTPException(413, str(e)) from None
        yield folder / "upload.zip"
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


@router.post("/import", status_code=201, responses=problems(400, 401, 403, 409, 413, 507), openapi_extra=_BODY)
async def take_in(request: Request, who: Who) -> Case:
    """A bundle becomes a case again, with the same events, files and scans, if all of it is as it was exported."""
    who.must("case.import")
    async with _upload(request, who) as file:
        try:
            case = await who.site.leaving.take_in(file, who.speaker.person, who.speaker.role.value)
        except FormatError as e:
            raise HTTPException(400, str(e)) from None
        finally:
            shutil.rmtree(file.parent, ignore_errors=True)
    found = await run_in_threadpool(kept.get, who.site.engine, case, True)
    if found is None:
        raise HTTPException(409, "the case was taken away again")
    return found


@router.post(
    "/{case}/scans/import",
    status_code=202,
    tags=["scans"],
    responses=problems(400, 401, 403, 404, 409, 413, 507),
    openapi_extra=_BODY,
)
async def add_scan(
    case: CaseId,
    request: Request,
    who: Who,
    label: Annotated[str, Query(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")] = "",
    present: Annotated[
        bool | None, Query(description="Whether the case goes on with it; if not said, where it has no scan yet.")
    ] = None,
) -> Job:
    """The folder of a scan, as a zip file, into a case, as a job: also one of an earlier version of the software."""
    await run_in_threadpool(who.case, case, "scan.add")
    leaving = who.site.leaving
    async with _upload(request, who) as file:

        async def add(tell: Any) -> dict[str, Any]:
            try:
                return await leaving.add_scan(case, file, label, present, tell)
            finally:
                shutil.rmtree(file.parent, ignore_errors=True)

        try:
            return await who.site.jobs.begin("add scan", case, who.speaker.person, add)
        except UsageError as e:
            raise HTTPException(409, str(e)) from None


@router.post("/{case}/erase", responses=problems(401, 403, 404, 409, 507))
async def erase(case: CaseId, asked: AskedErasure, who: Who) -> Erased:
    """Erases a case: words, patient, specimen, scans, files. Its events stay, empty, so that the log still verifies.

    Backups and bundles that were made before still have it.
    """
    await run_in_threadpool(who.case, case, "case.erase")
    try:
        done = await who.site.leaving.erase(case, who.speaker.person, who.speaker.role.value, asked.why)
    except UsageError as e:
        raise HTTPException(409, str(e)) from None
    except FringescopeError as e:
        raise HTTPException(507, str(e)) from None
    return Erased(**done)
