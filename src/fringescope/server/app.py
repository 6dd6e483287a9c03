"""The web application: the parts, the routes, and what every answer has in common."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import argon2
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException as RawHTTPException

from fringescope import __version__
from fringescope.errors import FringescopeError, OutputError
from fringescope.server.asking import one_line
from fringescope.server.config import Config
from fringescope.server.database import HeldError
from fringescope.server.routes import audit, cases, leaving, passkeys, people, room, scans, signing, video
from fringescope.server.security import Guarded
from fringescope.server.site import Site, open_site


def make_app(config: Config, hasher: argon2.PasswordHasher | None = None) -> FastAPI:
    """A hub as an ASGI application; its parts live in `app.state.site`. Raises OutputError and FormatError."""
    site = open_site(config, hasher)

    @asynccontextmanager
    async def life(_app: FastAPI) -> AsyncIterator[None]:
        await site.hub.start()
        await site.instrument.start()
        doors = asyncio.create_task(_watch_doors(site), name="doors")
        points = asyncio.create_task(site.checkpoints.run(config.checkpoint_s), name="checkpoints")
        hold = asyncio.create_task(_keep_hold(site), name="hold")
        try:
            yield
        finally:
            for task in (doors, points, hold):
                task.cancel()
            await asyncio.gather(doors, points, hold, return_exceptions=True)
            site.rooms.end()
            await site.jobs.stop()
            await site.leaving.stop()
            await site.hub.stop()
            await site.checkpoints.try_to_write()
            await site.instrument.stop()
            await _quiet(site)
            site.close()

    app = FastAPI(
        title="Fringescope hub",
        version=__version__,
        summary="One shared truth about each case: scans, strokes, and what is projected.",
        lifespan=life,
        docs_url=None,
        redoc_url=None,
        openapi_url="/openapi.json",
    )
    app.state.site = site
    for part in (signing, passkeys, people, leaving, cases, scans, audit, room, video):
        app.include_router(part.router)
    _explain(app)
    app.add_middleware(Guarded, config=config, requests=site.requests)
    return app


async def _watch_doors(site: Site) -> None:
    """A session that has expired is over in open rooms, too."""
    while True:
        await asyncio.sleep(site.config.limits.doors_s)
        seen = site.rooms.sessions()
        if seen:
            with contextlib.suppress(FringescopeError):
                site.rooms.end_sessions(await run_in_threadpool(site.accounts.ended, seen))


async def _quiet(site: Site) -> None:
    """Lets whoever still reads or writes finish, though nobody waits for it any more: then no connection is lost."""
    await asyncio.get_running_loop().shutdown_default_executor()
    for _ in range(100):
        if not site.engine.pool.checkedout():
            return
        await asyncio.sleep(0.05)


async def _keep_hold(site: Site) -> None:
    """The database stays this hub's, also when it was started anew; if another hub was quicker, this one ends."""
    while site.held is not None:
        await asyncio.sleep(site.config.limits.doors_s)
        try:
            await run_in_threadpool(site.held.renew)
        except HeldError as e:
            logging.getLogger("uvicorn.error").error("the hub ends: %s", e)
            site.end()
            return
        except OutputError:
            continue  # it is away: nothing can be written meanwhile, and it is asked again


def _explain(app: FastAPI) -> None:
    """Whatever goes wrong is told in one sentence, in one form."""

    @app.exception_handler(RawHTTPException)
    async def raw(_request: Request, e: RawHTTPException) -> JSONResponse:
        headers = dict(e.headers) if e.headers else None
        return JSONResponse({"detail": str(e.detail)}, e.status_code, headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(_request: Request, e: RequestValidationError) -> JSONResponse:
        said = []
        for one in e.errors()[:5]:
            where = ".".join(str(x) for x in one["loc"][1:]) or str(one["loc"][0])
            said.append(f"{where}: {one['msg']}")
        return JSONResponse({"detail": one_line("; ".join(said), 1000)}, 422)

    @app.exception_handler(OutputError)
    async def unwritten(_request: Request, e: OutputError) -> JSONResponse:
        return JSONResponse({"detail": str(e)}, 507)

    @app.exception_handler(FringescopeError)
    async def failed(_request: Request, e: FringescopeError) -> JSONResponse:
        return JSONResponse({"detail": str(e)}, 409)
