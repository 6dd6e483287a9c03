"""The hub's side of the instrument: carries out what an examination asks for, and reports what happened.

The devices belong to the instrument's process, the computing to the workshop's. Everything that is projected is the
file with the hash that was confirmed. Darkness goes two ways at once: a word to the process, and the stop button.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import time
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from fringescope import examination
from fringescope.devices.watchdog import StopButton, rebuilt
from fringescope.errors import DeviceError, DeviceLostError, FringescopeError, UsageError
from fringescope.server import cases
from fringescope.server.blobs import Blobs
from fringescope.server.config import Config
from fringescope.server.hub import INSTRUMENT, Hub
from fringescope.server.processes.child import STOPPED
from fringescope.server.processes.parent import Child
from fringescope.server.rights import Speaker
from fringescope.server.shelf import Shelf
from fringescope.server.truth import Fold, Truth
from fringescope.settings import to_dict
from fringescope.types.examination import (
    Check,
    Checked,
    Dark,
    DeviceLost,
    Guarded,
    GuardLost,
    Previewed,
    Show,
    Standing,
    Watched,
)
from fringescope.wire import Record, ScanFile
from fringescope.wire.documents import InstrumentState

_BEAT_S = 0.1
_TELL_S = 1.5  #: a verdict that is like the one before is written down so often
_DARK_S = 0.04  #: the stop button is pressed if the process does not say in this time that it is dark
_BEFALLS = ("move", "turn", "dent", "dry", "ring", "cover", "scene", "pose", "board")
_IDLE_S = 600.0  #: the watchdog rests when nothing was projected for so long


class Instrument:
    """The one instrument of a hub, in the hands of one case at a time."""

    def __init__(self, hub: Hub, blobs: Blobs, shelf: Shelf, workshop: Child, config: Config) -> None:
        self._hub, self._blobs, self._shelf, self._config = hub, blobs, shelf, config
        self._devices = Child("fringescope.server.processes.instrument", self._heard, self._devices_ended)
        self._workshop = workshop
        self._settings = to_dict(config.settings)
        self._tasks: set[asyncio.Task[Any]] = set()
        self._case: str | None = None  #: whose scan is ready
        self._button: StopButton | None = None
        self._shown: tuple[str, str] | None = None  #: case and picture
        self._said = (0.0, "")
        self._lit_s = 0.0
        self._busy = ""
        self._why = ""
        self._open = False
        self._cameras: tuple[str, ...] = ()
        self.watching: Counter[str] = Counter()  #: streams of video, by who watches
        self.peers = 0  #: of these by WebRTC
        self._frames: dict[tuple[str, int, int], asyncio.Task[Any]] = {}  #: that are being taken for who watches
        self._filming = asyncio.Lock()
        self._hand = asyncio.Lock()  #: one thing at a time is done with the devices
        hub.carry_out = self.carry_out
        hub.dark = self.dark

    # ------------------------------------------------------------------------------------------------------ its life

    async def start(self) -> None:
        """Opens the devices, where there are some; what is wrong with them is told by `state`."""
        self._begin(self._beat())
        if self._config.instrument is not None:
            with contextlib.suppress(FringescopeError):
                await self.open()

    async def open(self) -> None:
        """Opens the devices. Raises DeviceError."""
        uri = self._config.instrument
        if uri is None:
            raise DeviceError("this hub has no instrument; start it with --device URI")
        if self._open and self._devices.alive:
            return
        try:
            found = await self._devices.call("open", uri=uri)
            self._cameras = tuple(c["name"] for c in found["cameras"])
            if self._shelf.rig is None:
                made = self._config.data / "twin-rig.json"
                await self._devices.call("twin_rig", out=str(made))
                self._shelf.rig = made
        except FringescopeError as e:
            self._why = str(e)
            raise
        self._open, self._why = True, ""

    async def stop(self) -> None:
        """Dark, and the processes end."""
        self.dark("the hub ends")
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._devices.stop()
        await self._workshop.kill()

    @property
    def pid(self) -> int | None:
        """The process that holds the devices."""
        return self._devices.pid

    @property
    def button(self) -> StopButton | None:
        """The stop button of the watchdog, while there is one."""
        return self._button

    def state(self) -> InstrumentState:
        """How it is, for the operator's screen."""
        return InstrumentState(
            uri=self._config.instrument or "", there=self._open and self._devices.alive, busy=self._busy,
            projecting=None if self._shown is None else self._shown[1], guarded=self._button is not None,
            case=self._case, why=self._why,
        )  # fmt: skip

    async def _beat(self) -> None:
        """Tells the instrument that the hub lives: a hub that hangs leaves nothing lit."""
        while True:
            if self._button is not None:
                self._devices.post({"id": 0, "call": "beat", "args": {}})
                if self._shown is None and time.monotonic() - self._lit_s > _IDLE_S and not self._hand.locked():
                    self._begin(self._rest())
                    self._lit_s = time.monotonic()
            await asyncio.sleep(_BEAT_S)

    def _begin(self, work: Any) -> asyncio.Task[Any]:
        task: asyncio.Task[Any] = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    # ------------------------------------------------------------------------------------------------------ darkness

    def dark(self, _why: str) -> None:
        """Dark, at once: by the process, and by the stop button if that does not answer."""
        self._shown = None
        if self._devices.alive:
            self._begin(self._darken())

    async def stop_all(self, speaker: Speaker) -> None:
        """Dark, and the case that had something armed or lit hears who stopped it."""
        case = self._shown[0] if self._shown is not None else self._case
        self.dark(f"stopped by {speaker.person}")
        if case is not None and self._hub.can_stop(case):
            await self._hub.note(case, speaker.person, speaker.role.value, "stop", {"version": None, "why": ""})

    async def _darken(self) -> None:
        asked = asyncio.ensure_future(self._devices.call("dark"))
        try:
            await asyncio.wait_for(asyncio.shield(asked), _DARK_S)
        except (TimeoutError, FringescopeError):
            if self._button is not None:
                await asyncio.to_thread(self._button.press)
                await self._lost("the instrument did not answer in time, and the stop button was pressed")
        finally:
            with contextlib.suppress(FringescopeError):
                await asked

    async def _rest(self) -> None:
        async with self._hand:
            self._button, self._case = None, None
            with contextlib.suppress(FringescopeError):
                await self._devices.call("rest")

    # -------------------------------------------------------------------------------------------------------- effects

    async def carry_out(self, record: Record, fold: Fold) -> None:
        """What an event of a case's log asks of the instrument."""
        case = record.case
        for effect in fold.effects:
            if isinstance(effect, Check):
                self._begin(self._reported(case, self._check(case, effect.version, fold.truth)))
            elif isinstance(effect, Show):
                self._shown, self._lit_s = (case, effect.pattern), time.monotonic()
                self._begin(self._reported(case, self._show(case, effect, fold.truth)))
            elif isinstance(effect, Dark) and self._shown is not None and self._shown[0] == case:
                self.dark(effect.why)
        if record.kind == "preview":
            version = int((record.payload or {})["version"])
            self._begin(self._reported(case, self._preview(case, version)))

    async def _reported(self, case: str, work: Any) -> None:
        """Whatever goes wrong with it is said in the room."""
        from fringescope.wire.room import Warned

        try:
            await work
        except FringescopeError as e:
            self._hub.rooms.warn(case, Warned(text=str(e)))

    async def _check(self, case: str, version: int, truth: Truth) -> None:
        v = next(x for x in truth.exam.versions if x.number == version)
        strokes = [dict(x["stroke"]) for x in truth.versions[version]]
        with self._shelf.work("check") as folder:
            try:
                made = await self._guide(case, v.scan, strokes, folder)
            except FringescopeError as e:
                await self._hub.tell(case, Checked(version, v.content, "", "", (str(e)[:190],)))
                return
            files = []
            for name, file in made["files"].items():
                sha256, size = await asyncio.to_thread(self._blobs.put, folder / file)
                files.append((name, ScanFile(name=file, sha256=sha256, size=size, type=cases.type_of(file))))
        by_name = {name: f.sha256 for name, f in files}
        problems = tuple(" ".join(p.split())[:190] for p in made["problems"])
        word = Checked(version, v.content, by_name.get("pattern", ""), by_name.get("dashed", ""), problems)
        plain = examination.to_dict(word)
        said = await self._hub.note(
            case, INSTRUMENT, INSTRUMENT, plain.pop("kind"), plain,
            lambda c: cases.insert_files(c, case, f"version-{version}", [f for _, f in files]),
        )  # fmt: skip
        if said.refused:
            await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, [f.sha256 for _, f in files])

    async def _guide(self, case: str, scan: str, strokes: list[dict[str, Any]], out: Path) -> Any:
        """The pictures of strokes; once more if somebody ended the workshop for another reason meanwhile."""
        how: dict[str, Any] = {
            "scan": str(await self._shelf.scan(case, scan)), "rig": str(await self._shelf.rig_of(case, scan)),
            "settings": json.dumps(self._settings), "strokes": strokes, "out": str(out),
        }  # fmt: skip
        try:
            return await self._workshop.call("guide", **how)
        except DeviceLostError:
            return await self._workshop.call("guide", **how)

    async def _preview(self, case: str, version: int) -> None:
        truth, _ = await self._hub.truth_of(case)
        v = next((x for x in truth.exam.versions if x.number == version), None)
        if v is None or not v.pattern:
            raise UsageError(f"version {version} was not checked, or nothing of it can be shown")
        await self.make_ready(case, v.scan, {v.pattern, v.dashed})
        await self._hub.tell(case, Previewed(version, v.pattern))

    async def make_ready(self, case: str, scan: str, pictures: set[str]) -> None:
        """Watchdog and looking begin, and pictures are loaded. Raises UsageError while another case is projected."""
        if self._shown is not None and self._shown[0] != case:
            raise UsageError("the instrument projects for another case; stop that first")
        async with self._hand:
            self._busy = "getting ready"
            try:
                await self.open()
                how: dict[str, Any] = {
                    "scan": str(await self._shelf.scan(case, scan)), "scan_id": scan,
                    "rig": str(self._shelf.rig_file()), "settings": self._settings,
                    "pictures": {h: str(self._blobs.path(h)) for h in pictures},
                }  # fmt: skip
                try:
                    found = await self._devices.call("ready", **how)
                except DeviceLostError:  # a busy machine kept the watchdog waiting: nothing is lit yet, so once more
                    await self.open()
                    found = await self._devices.call("ready", **how)
            finally:
                self._busy = ""
            self._case, self._lit_s = case, time.monotonic()
            self._button = StopButton(rebuilt(found["stop"]["switch"]), found["stop"]["patience_ms"])
        await self._hub.tell(case, Guarded())
        if found["validity"] is not None:
            await self._hub.tell(case, Watched(scan, Standing(found["validity"])))

    async def _show(self, case: str, effect: Show, truth: Truth) -> None:
        v = next(x for x in truth.exam.versions if x.number == effect.version)
        try:
            made = await self._devices.call("show", whole=v.pattern, dashed=v.dashed)
        except FringescopeError as e:
            self._shown = None
            if str(e) != STOPPED:
                await self._lost(str(e))
                raise
            return
        await self._testify(case, effect, made["shown_ns"])

    async def _testify(self, case: str, effect: Show, shown_ns: int) -> None:
        """Photographs of what was projected go into the case, with when it was."""
        files = []
        for camera in self._cameras:
            with contextlib.suppress(FringescopeError):
                frame = await self._devices.call("live", camera=camera, width=1280, quality=85)
                data = base64.b64decode(frame["jpeg"])
                sha256, size = await asyncio.to_thread(self._blobs.put, data)
                files.append(ScanFile(name=f"{camera}.jpg", sha256=sha256, size=size, type="image/jpeg"))
        told = {"version": effect.version, "pattern": effect.pattern, "shown_ns": shown_ns,
                "pictures": {f.name: f.sha256 for f in files}}  # fmt: skip
        owner = f"evidence-{shown_ns}"
        said = await self._hub.note(
            case, INSTRUMENT, INSTRUMENT, "evidence", told, lambda c: cases.insert_files(c, case, owner, files)
        )
        if said.refused:
            await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, [f.sha256 for f in files])

    # ----------------------------------------------------------------------------------------------------- what it says

    def _heard(self, event: dict[str, Any]) -> None:
        self._begin(self._follow(event))

    async def _follow(self, event: dict[str, Any]) -> None:
        case = self._case
        if case is None:
            return
        if "watched" in event:
            now = time.monotonic()
            if event["validity"] == self._said[1] and now - self._said[0] < _TELL_S:
                return
            self._said = now, event["validity"]
            if event["validity"] == Standing.STALE.value:
                self._shown = None
            note = " ".join(event["note"].split())
            await self._hub.tell(case, Watched(event["watched"], Standing(event["validity"]), note[:190]))
        elif "guard" in event:
            await self._lost(event["why"])
        elif "lost" in event:
            self._shown = None
            await self._hub.tell(case, DeviceLost(event["lost"]))

    async def _lost(self, why: str) -> None:
        guarded, self._shown, self._button = self._button is not None, None, None
        if self._case is not None and guarded:
            await self._hub.tell(self._case, GuardLost(" ".join(why.split())[:190]))

    def _devices_ended(self) -> None:
        """The instrument's process is gone: its watchdog has made dark."""
        self._open = False
        self._why = "the instrument's process ended; it is started again when it is needed"
        self._begin(self._lost("the instrument's process ended"))

    async def forget(self, case: str) -> None:
        """Nothing of a case stays in the memory of its processes. Raises UsageError while it is projected."""
        if self._shown is not None and self._shown[0] == case:
            raise UsageError("a guideline of this case is projected; stop it first")
        if self._case == case:
            await self._rest()
        if self._workshop.alive:
            self._begin(self._reported(case, self._workshop.call("forget")))  # once it has done what it does

    # ---------------------------------------------------------------------------------------------------- being busy

    @contextlib.asynccontextmanager
    async def busy(self, what: str) -> AsyncIterator[Child]:
        """The devices, for something else than projecting. Raises UsageError while something is projected."""
        if self._shown is not None:
            raise UsageError("the projector shows a guideline; stop it first")
        async with self._hand:
            self._busy, self._button, self._case = what, None, None
            try:
                await self.open()
                yield self._devices
            except DeviceLostError:
                self._open = False
                raise
            finally:
                self._busy = ""

    async def live(self, camera: str, width: int, quality: int) -> dict[str, Any]:
        """What a camera sees now. Raises DeviceError."""
        if self._busy == "scanning":
            raise DeviceError("the instrument is scanning; there is no live picture meanwhile")
        key = camera, width, quality
        if key not in self._frames:  # who asks meanwhile for the same gets the same
            self._frames[key] = self._begin(self._film(*key))
            self._frames[key].add_done_callback(lambda task: task.cancelled() or task.exception())
        found: dict[str, Any] = await asyncio.shield(self._frames[key])
        return found

    async def _film(self, camera: str, width: int, quality: int) -> Any:
        """One frame. One waits for the devices at a time, however many watch: a start waits for no more than that."""
        try:
            async with self._filming:
                await self.open()
                return await self._devices.call("live", camera=camera, width=width, quality=quality)
        finally:
            del self._frames[camera, width, quality]

    async def shown(self) -> int:
        """Since when (`time.monotonic_ns`) the projector itself says that it holds a picture; 0 = it is dark.

        Raises DeviceError.
        """
        return int(await self._devices.call("shown"))

    async def befall(self, what: dict[str, str]) -> None:
        """For the simulated instrument: something happens to the specimen. Raises UsageError for what cannot."""
        if unknown := sorted(set(what) - set(_BEFALLS)):
            raise UsageError(f"{unknown[0][:40]!r} befalls no specimen; needed some of {', '.join(_BEFALLS)}")
        await self.open()
        await self._devices.call("befall", what=what)
