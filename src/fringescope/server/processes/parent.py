"""The parent's side of a child process: calls that can be awaited, watched and cancelled."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Callable
from typing import Any

from fringescope import errors
from fringescope.errors import DeviceLostError, FringescopeError

Progress = Callable[[str, float], None]
_LINE = 64 << 20  #: longest answer


class Child:
    """A child process, started when it is first needed and again when it has ended.

    `event` hears what it says unasked, `lost` that it has ended without being asked to.
    """

    def __init__(
        self, module: str, event: Callable[[dict[str, Any]], None] | None = None,
        lost: Callable[[], None] | None = None,
    ):  # fmt: skip
        self._module, self._event, self._lost = module, event or (lambda _e: None), lost or (lambda: None)
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._starting = asyncio.Lock()
        self._calls: dict[int, tuple[asyncio.Future[Any], Progress, dict[str, Any]]] = {}  #: and how it was asked for
        self._number = 0
        self._ending = self._again = False

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process is not None and self._process.returncode is None

    @property
    def pid(self) -> int | None:
        """Its number, while it runs."""
        return self._process.pid if self._process is not None and self.alive else None

    async def start(self) -> None:
        """Makes sure that it runs."""
        async with self._starting:
            await self._start()

    async def _start(self) -> None:
        if not self.alive:
            self._ending = False
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "fringescope.server.processes.child", self._module,
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=_LINE, process_group=0,
            )  # fmt: skip
            self._reader = asyncio.create_task(self._read(self._process), name=f"hears {self._module}")

    async def call(self, name: str, progress: Progress | None = None, **args: Any) -> Any:
        """Has something done. Raises what it raised; DeviceLostError if the process ends meanwhile.

        When the awaiting task is cancelled, so is the work.
        """
        await self.start()
        self._number += 1
        number = self._number
        answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        message = {"id": number, "call": name, "args": args}
        self._calls[number] = answer, progress or (lambda _s, _x: None), message
        self.post(message)
        try:
            return await answer
        except asyncio.CancelledError:
            self.post({"cancel": number})
            raise
        finally:
            self._calls.pop(number, None)

    def post(self, message: dict[str, Any]) -> None:
        """A line to the process, if it runs."""
        p = self._process
        if p is not None and p.stdin is not None and p.returncode is None and not p.stdin.is_closing():
            with contextlib.suppress(OSError, RuntimeError):
                p.stdin.write(json.dumps(message, allow_nan=False).encode() + b"\n")

    async def restart(self) -> None:
        """Ends what it does, at once, for a call that nobody waits for any more; the others are begun anew."""
        async with self._starting:
            if self._process is None or not self.alive:
                return
            self._again = True
            try:
                with contextlib.suppress(ProcessLookupError):
                    self._process.kill()
                await self._ended()
            finally:
                self._again = False
            waiting = [message for answer, _, message in self._calls.values() if not answer.done()]
            if waiting and not self._ending:
                await self._start()
                for message in waiting:
                    self.post(message)

    async def kill(self) -> None:
        """Ends it at once; whoever waits for it hears that the work was cancelled."""
        self._ending = True
        if self._process is not None and self.alive:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
        await self._ended()

    async def stop(self) -> None:
        """Closes its pipe, and waits for it to end."""
        self._ending = True
        p = self._process
        if p is None or not self.alive:
            return
        assert p.stdin is not None
        p.stdin.close()
        try:
            await asyncio.wait_for(p.wait(), 10)
        except TimeoutError:
            p.kill()
        await self._ended()

    async def _ended(self) -> None:
        if self._reader is not None:
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader
            self._reader = None

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            message = json.loads(line)
            if "event" in message:
                self._event(message["event"])
            elif "id" in message:
                self._answer(message)
        await process.wait()
        if self._again:
            return
        why = "cancelled" if self._ending else f"the {self._module.rsplit('.', 1)[-1]}'s process ended; try again"
        for answer, _, _ in self._calls.values():
            if not answer.done():
                answer.set_exception(DeviceLostError(why))
        if not self._ending:
            self._lost()

    def _answer(self, message: dict[str, Any]) -> None:
        answer, progress, _ = self._calls.get(message["id"], (None, None, None))
        if answer is None or progress is None or answer.done():
            return
        if "progress" in message:
            progress(*message["progress"])
        elif "error" in message:
            kind = getattr(errors, message["kind"], FringescopeError)
            answer.set_exception(kind(message["error"]))
        else:
            answer.set_result(message["result"])
