"""The hub's side of the instrument: carries out what an examination asks for, and reports what happened.

The devices belong to the instrument's process, the computing to the workshop's. Everything that is projected is the
file with the hash that was confirmed. Darkness goes two ways at once: a word to the process, and the stop button.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from fringescope.devices.watchdog import StopButton, rebuilt
from fringescope.errors import DeviceError, DeviceLostError, FringescopeError, UsageError
from fringescope.server import cases
from fringescope.server import database as db
from fringescope.server.accounts import new_id
from fringescope.server.blobs import Blobs
from fringescope.server.config import Config
from fringescope.server.hub import INSTRUMENT, Hub
from fringescope.server.jobs import Tell
from fringescope.server.processes.parent import Child
from fringescope.server.truth import Fold, Truth
from fringescope.settings import to_dict
from fringescope.store import hash_rig
from fringescope.types.examination import (
    Check,
    Checked,
    Dark,
    DeviceBack,
    DeviceLost,
    Guarded,
    GuardLost,
    Previewed,
    RigChanged,
    ScanTaken,
    Show,
    Standing,
    Watched,
)
from fringescope.wire import Record, ScanFile, ScanInfo
from fringescope.wire.documents import InstrumentState

_BEAT_S = 0.1
_TELL_S = 1.5  #: a verdict that is like the one before is written down so often
_DARK_S = 0.04  #: the stop button is pressed if the process does not say in this time that it is dark
_IDLE_S = 600.0  #: the watchdog rests when nothing was projected for so long


class Instrument:
    """The one instrument of a hub, in the hands of one case at a time."""

    def __init__(self, hub: Hub, blobs: Blobs, config: Config) -> None:
        self._hub, self._blobs, self._config = hub, blobs, config
        self._devices = Child("fringescope.server.processes.instrument", self._heard, self._devices_ended)
        self._workshop = Child("fringescope.server.processes.workshop")
        self._settings = to_dict(config.settings)
        self._rig: Path | None = config.rig
        self._tasks: set[asyncio.Task[Any]] = set()
        self._case: str | None = None  #: whose scan is ready
        self._button: StopButton | None = None
        self._shown: tuple[str, str] | None = None  #: case and picture
        self._said = (0.0, "")
        self._lit_s = 0.0
        self._busy = ""
        self._why = ""
        self._open = False
        self.watching = 0  #: streams of video
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
            await self._devices.call("open", uri=uri)
            if self._rig is None:
                made = self._config.data / "twin-rig.json"
                await self._devices.call("twin_rig", out=str(made))
                self._rig = made
        except FringescopeError as e:
            self._why = str(e)
            raise
        self._open, self._why = True, ""

    async def stop(self) -> None:
        """Dark, and the processes end."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._devices.stop()
        await self._workshop.kill()

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

    async def stop_all(self, why: str) -> None:
        """Dark, and every case that had something lit hears of it."""
        case = self._shown[0] if self._shown is not None else self._case
        self.dark(why)
        if case is not None:
            await self._hub.tell(case, GuardLost(" ".join(why.split())[:190]))

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
                self._begin(self._reported(case, self._show(effect.version, fold.truth)))
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
        folder = Path(tempfile.mkdtemp(dir=self._work(), prefix="check-"))
        try:
            made = await self._workshop.call(
                "guide", scan=str(await self._scan_folder(case, v.scan)), rig=str(self._rig_file()),
                settings=json.dumps(self._settings), strokes=strokes, out=str(folder),
            )  # fmt: skip
            named = {name: folder / file for name, file in made["files"].items()}
            files = await asyncio.to_thread(cases.keep_files, self._blobs, named)
        except FringescopeError as e:
            await self._hub.tell(case, Checked(version, v.content, "", "", (str(e)[:190],)))
            return
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        by_name = {f.name: f.sha256 for f in files}
        files = [f.model_copy(update={"name": made["files"][f.name], "type": cases.type_of(made["files"][f.name])})
                 for f in files]  # fmt: skip
        with db.writing(self._hub.engine) as c:
            cases.insert_files(c, case, f"version-{version}", files)
        problems = tuple(" ".join(p.split())[:190] for p in made["problems"])
        word = Checked(version, v.content, by_name.get("pattern", ""), by_name.get("dashed", ""), problems)
        await self._hub.tell(case, word)

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
                files = {h: str(self._blobs.path(h)) for h in pictures}
                found = await self._devices.call(
                    "ready", scan=str(await self._scan_folder(case, scan)), scan_id=scan, rig=str(self._rig_file()),
                    pictures=files, settings=self._settings,
                )  # fmt: skip
            finally:
                self._busy = ""
            self._case, self._lit_s = case, time.monotonic()
            self._button = StopButton(rebuilt(found["stop"]["switch"]), found["stop"]["patience_ms"])
        await self._hub.tell(case, Guarded())
        if found["validity"] is not None:
            await self._hub.tell(case, Watched(scan, Standing(found["validity"])))

    async def _show(self, version: int, truth: Truth) -> None:
        v = next(x for x in truth.exam.versions if x.number == version)
        try:
            await self._devices.call("show", whole=v.pattern, dashed=v.dashed)
        except FringescopeError as e:
            self._shown = None
            await self._lost(str(e))
            raise

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

    # ----------------------------------------------------------------------------------------------------------- scans

    async def scan(self, case: str, label: str, tell: Tell) -> dict[str, Any]:
        """Takes a scan for a case: fringes, surface, files, and the word that there is a new one."""
        if self._shown is not None:
            raise UsageError("the projector shows a guideline; stop it, then scan")
        folder = Path(tempfile.mkdtemp(dir=self._work(), prefix="scan-"))
        try:
            async with self._hand:
                self._busy, self._button, self._case = "scanning", None, None
                try:
                    await self.open()
                    await self._devices.call(
                        "capture", lambda stage, share: tell(stage, 0.4 * share), rig=str(self._rig_file()),
                        out=str(folder / "capture"), settings=self._settings,
                    )  # fmt: skip
                except DeviceLostError:
                    self._open = False
                    raise
                finally:
                    self._busy = ""
            try:
                doc = await self._workshop.call(
                    "reconstruct", lambda stage, share: tell(stage, 0.4 + 0.5 * share),
                    capture=str(folder / "capture"), rig=str(self._rig_file()), out=str(folder / "scan"),
                    settings=self._settings,
                )  # fmt: skip
                await self._workshop.call("photographs", scan=str(folder / "scan"))
            except asyncio.CancelledError:
                await self._workshop.kill()
                raise
            tell("keeping", 0.9)
            return await self.keep(case, label, folder / "scan", doc)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    async def keep(self, case: str, label: str, folder: Path, doc: dict[str, Any]) -> dict[str, Any]:
        """A scan's folder into the case: its files first, then one transaction with the event."""
        named = {str(p.relative_to(folder)): p for p in sorted(folder.rglob("*")) if p.is_file()}
        files: list[ScanFile] = await asyncio.to_thread(cases.keep_files, self._blobs, named)
        kept = ("figures", "views", "cloud", "surface", "created", "instrument")
        info = ScanInfo(
            id=doc["hash"], case=case, rig=doc["rig"], label=label, taken_ns=self._hub.clock.now_ns(), files=files,
            figures={k: doc[k] for k in kept if k in doc},
        )  # fmt: skip
        truth, _ = await self._hub.truth_of(case)
        if truth.exam.rig not in ("", doc["rig"]):
            await self._hub.tell(case, RigChanged(doc["rig"]))
        word = {"scan": info.id, "rig": info.rig, "label": label, "files": len(files)}
        said = await self._hub.note(
            case, INSTRUMENT, INSTRUMENT, ScanTaken.__name__, word,
            lambda c: cases.insert_scan(c, info),
        )  # fmt: skip
        if said.refused:
            raise UsageError(said.refused)
        if truth.exam.lost:
            for device in truth.exam.lost:
                await self._hub.tell(case, DeviceBack(device))
        self._begin(self._prepare(case, info.id))
        return {"scan": info.id, "seq": said.seq}

    async def _prepare(self, case: str, scan: str) -> None:
        with contextlib.suppress(FringescopeError):
            await self._workshop.call(
                "prepare", scan=str(await self._scan_folder(case, scan)), rig=str(self._rig_file()),
                settings=json.dumps(self._settings),
            )  # fmt: skip

    async def carry(self, case: str, version: int, tell: Tell) -> dict[str, Any]:
        """Strokes of a stale version laid on the present scan, for the operator to look at."""
        truth, _ = await self._hub.truth_of(case)
        v = next((x for x in truth.exam.versions if x.number == version), None)
        if v is None or not truth.exam.scan or v.scan == truth.exam.scan:
            raise UsageError(f"version {version} has nothing to carry over to another scan")
        tell("registration", 0.1)
        found = await self._workshop.call(
            "carry", old=str(await self._scan_folder(case, v.scan)),
            new=str(await self._scan_folder(case, truth.exam.scan)), rig=str(self._rig_file()),
            settings=json.dumps(self._settings), strokes=[dict(x["stroke"]) for x in truth.versions[version]],
        )  # fmt: skip
        meaning = {x["stroke"]["id"]: x["meaning"] for x in truth.versions[version]}
        strokes = []
        for document in found["strokes"]:
            of = meaning.get(document["id"], "cut")
            strokes.append({"stroke": {**document, "id": f"{document['id']}-{new_id('c')[-6:]}"}, "meaning": of})
        return {**found, "strokes": strokes, "version": version, "scan": truth.exam.scan}

    async def live(self, camera: str, width: int, quality: int) -> dict[str, Any]:
        """What a camera sees now. Raises DeviceError."""
        if self._busy == "scanning":
            raise DeviceError("the instrument is scanning; there is no live picture meanwhile")
        await self.open()
        found: dict[str, Any] = await self._devices.call("live", camera=camera, width=width, quality=quality)
        return found

    async def befall(self, what: dict[str, str]) -> None:
        """For the simulated instrument: something happens to the specimen."""
        await self.open()
        await self._devices.call("befall", what=what)

    # ----------------------------------------------------------------------------------------------------- small things

    def _work(self) -> Path:
        folder = self._config.data / "work"
        folder.mkdir(exist_ok=True)
        return folder

    def _rig_file(self) -> Path:
        if self._rig is None:
            raise DeviceError("this hub has no rig; calibrate the instrument, and name its rig with --rig")
        return self._rig

    def rig_hash(self) -> str:
        """Of the rig in use."""
        return hash_rig(self._rig_file())

    async def _scan_folder(self, case: str, scan: str) -> Path:
        files = (await asyncio.to_thread(cases.files_of, self._hub.engine, case, scan)).get(scan)
        if not files:
            raise UsageError(f"case {case} has no scan {scan[:19]}; scan again")
        folder = self._config.data / "laid-out" / scan.replace("sha256:", "")[:32]
        return await asyncio.to_thread(cases.laid_out, self._blobs, files, folder)
