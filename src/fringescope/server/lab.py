"""Work that takes long: scans, comparisons, strokes carried over, calibration; each a job with progress and an end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import shutil
from pathlib import Path
from typing import Any

from fringescope.errors import DeviceLostError, FringescopeError, UsageError
from fringescope.server import cases
from fringescope.server.accounts import new_id
from fringescope.server.blobs import Blobs
from fringescope.server.config import Config
from fringescope.server.hub import INSTRUMENT, Hub
from fringescope.server.instrument import Instrument
from fringescope.server.jobs import Tell
from fringescope.server.processes.parent import Child
from fringescope.server.shelf import Shelf
from fringescope.settings import to_dict
from fringescope.store import parse_board, write_json
from fringescope.types.examination import DeviceBack, RigChanged, ScanTaken
from fringescope.wire import ScanFile, ScanInfo

_PACKED_S = 30.0  #: a scan waits no longer for the levels that are sent: the plain files serve as well
_LOG = logging.getLogger("fringescope.lab")


class Lab:
    """What is done with the instrument and in the workshop, for one case after the other."""

    def __init__(
        self, hub: Hub, blobs: Blobs, shelf: Shelf, instrument: Instrument, workshop: Child, packer: Child,
        config: Config,
    ) -> None:  # fmt: skip
        self._hub, self._blobs, self._shelf = hub, blobs, shelf
        self._instrument, self._workshop, self._packer = instrument, workshop, packer
        self._settings = to_dict(config.settings)
        self._tasks: set[asyncio.Task[None]] = set()

    async def scan(self, case: str, label: str, tell: Tell) -> dict[str, Any]:
        """Takes a scan for a case: fringes, surface, files, and the word that there is a new one."""
        with self._shelf.work("scan") as folder:
            async with self._instrument.busy("scanning") as devices:
                await devices.call(
                    "capture", lambda stage, share: tell(stage, 0.4 * share), rig=str(self._shelf.rig_file()),
                    out=str(folder / "capture"), settings=self._settings,
                )  # fmt: skip
            rig = str(self._shelf.rig_file())
            doc = await self._computed(
                "reconstruct", lambda stage, share: tell(stage, 0.4 + 0.5 * share), capture=str(folder / "capture"),
                rig=rig, out=str(folder / "scan"), settings=self._settings,
            )  # fmt: skip
            packed = asyncio.create_task(self._pack(folder / "scan", folder / "packed"))
            try:
                await self._computed("photographs", tell, scan=str(folder / "scan"))
                await packed
            finally:
                packed.cancel()
            tell("keeping", 0.9)
            return await self.keep(case, label, folder / "scan", doc)

    async def _pack(self, scan: Path, out: Path) -> None:
        """The levels of a scan's surface that are sent, into its folder; without them the plain files have to do."""
        try:
            async with asyncio.timeout(_PACKED_S):
                try:
                    names = await self._packer.call("levels", scan=str(scan), out=str(out))
                except DeviceLostError:  # somebody ended it for another reason
                    names = await self._packer.call("levels", scan=str(scan), out=str(out))
        except (TimeoutError, FringescopeError) as e:
            _LOG.warning("the surface was not packed for the wire: %s", e or "the packer was busy")
            return
        for name in names:
            (out / name).replace(scan / name)

    async def _computed(self, what: str, tell: Tell, **how: Any) -> Any:
        """Has the workshop compute something; who cancels that ends it at once, and all else begins anew."""
        try:
            return await self._workshop.call(what, tell, **how)
        except asyncio.CancelledError:
            await asyncio.shield(self._workshop.restart())
            raise

    async def keep(
        self, case: str, label: str, folder: Path, doc: dict[str, Any], taken_ns: int | None = None,
        present: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """A scan's folder into the case: its files first, then one transaction with the event.

        Without `present` it is there to look at, and the case stays at the scan that it has.
        """
        named = {str(p.relative_to(folder)): p for p in sorted(folder.rglob("*")) if p.is_file()}
        files: list[ScanFile] = await asyncio.to_thread(cases.keep_files, self._blobs, named)
        kept = ("figures", "views", "cloud", "surface", "created", "instrument")
        info = ScanInfo(
            id=doc["hash"], case=case, rig=doc["rig"], label=label, taken_ns=taken_ns or self._hub.clock.now_ns(),
            files=files, figures={k: doc[k] for k in kept if k in doc},
        )  # fmt: skip
        truth, _ = await self._hub.truth_of(case)
        if present and truth.exam.rig not in ("", doc["rig"]):
            await self._hub.tell(case, RigChanged(doc["rig"]))
        word = {"scan": info.id, "rig": info.rig, "label": label, "files": len(files)}
        said = await self._hub.note(
            case, INSTRUMENT, INSTRUMENT, ScanTaken.__name__ if present else "evidence", word,
            lambda c: cases.insert_scan(c, info),
        )  # fmt: skip
        if said.refused:
            await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, [f.sha256 for f in files])
            raise UsageError(said.refused)
        if truth.exam.lost:
            for device in truth.exam.lost:
                await self._hub.tell(case, DeviceBack(device))
        if present:
            task = asyncio.create_task(self._prepare(case, info.id))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        return {"scan": info.id, "seq": said.seq}

    async def _prepare(self, case: str, scan: str) -> None:
        with contextlib.suppress(FringescopeError):
            await self._workshop.call(
                "prepare", scan=str(await self._shelf.scan(case, scan)), rig=str(self._shelf.rig_file()),
                settings=json.dumps(self._settings),
            )  # fmt: skip

    async def carry(self, case: str, version: int, tell: Tell) -> dict[str, Any]:
        """Strokes of a stale version laid on the present scan, for the operator to look at."""
        truth, _ = await self._hub.truth_of(case)
        v = next((x for x in truth.exam.versions if x.number == version), None)
        if v is None or not truth.exam.scan or v.scan == truth.exam.scan:
            raise UsageError(f"version {version} has nothing to carry over to another scan")
        tell("registration", 0.1)
        found = await self._computed(
            "carry", tell, old=str(await self._shelf.scan(case, v.scan)),
            new=str(await self._shelf.scan(case, truth.exam.scan)), rig=str(await self._shelf.rig_of(case, v.scan)),
            settings=json.dumps(self._settings), strokes=[dict(x["stroke"]) for x in truth.versions[version]],
        )  # fmt: skip
        meaning = {x["stroke"]["id"]: x["meaning"] for x in truth.versions[version]}
        strokes = []
        for document in found["strokes"]:
            of = meaning.get(document["id"], "cut")
            strokes.append({"stroke": {**document, "id": f"{document['id']}-{new_id('c')[-6:]}"}, "meaning": of})
        return {**found, "strokes": strokes, "version": version, "scan": truth.exam.scan}

    async def compare(self, case: str, before: str, after: str, version: int | None, tell: Tell) -> dict[str, Any]:
        """What changed from one scan of a case to another; its files go into the case."""
        truth, _ = await self._hub.truth_of(case)
        strokes = [dict(x["stroke"]) for x in truth.versions.get(version, ())] if version is not None else []
        with self._shelf.work("compare") as folder:
            doc: dict[str, Any] = await self._computed(
                "compare", tell, before=str(await self._shelf.scan(case, before)),
                after=str(await self._shelf.scan(case, after)),
                rig=str(await self._shelf.rig_of(case, before)), out=str(folder / "out"), settings=self._settings,
                strokes=strokes,
            )  # fmt: skip
            named = {p.name: p for p in sorted((folder / "out").iterdir())}
            files = await asyncio.to_thread(cases.keep_files, self._blobs, named)
        owner = f"comparison-{before[7:19]}-{after[7:19]}-{self._hub.clock.now_ns()}"
        said = await self._hub.note(
            case, INSTRUMENT, INSTRUMENT, "evidence", {"compared": [before, after], "owner": owner},
            lambda c: cases.insert_files(c, case, owner, files),
        )  # fmt: skip
        if said.refused:
            await asyncio.to_thread(cases.drop_files, self._hub.engine, self._blobs, [f.sha256 for f in files])
            raise UsageError(said.refused)
        kept = ("words", "registration", "change", "guidelines", "specimen")
        return {"owner": owner, **{k: doc[k] for k in kept if k in doc}}

    # ----------------------------------------------------------------------------------------------------- calibration

    async def pose(self, board: dict[str, Any] | None, tell: Tell) -> dict[str, Any]:
        """Photographs the board where it lies now, as the next pose; `board` begins a new session."""
        session = self._shelf.data / "session"
        if board is not None:
            parse_board(board, session / "board.json")  # before the poses of the session before are let go
            shutil.rmtree(session, ignore_errors=True)
            session.mkdir()
            write_json(session / "board.json", board)
        elif not (session / "board.json").exists():
            raise UsageError("no session was begun; say which board it is with its first pose")
        poses = len([p for p in session.iterdir() if p.name.startswith("pose")])
        async with self._instrument.busy("photographing the board") as devices:
            out = str(session / f"pose{poses:02d}")
            await devices.call("capture", tell, rig=None, out=out, settings=self._settings)
        return {"poses": poses + 1}

    async def calibrate(self, tell: Tell) -> dict[str, Any]:
        """The poses so far to a rig, which is used from now on; all that was drawn before is for the old one."""
        session = self._shelf.data / "session"
        if not (session / "board.json").exists():
            raise UsageError("no board was photographed; photograph it in eight poses or more first")
        made, page = session / "rig.json", session / "report.html"
        found: dict[str, Any] = await self._computed(
            "calibrate", tell, session=str(session), rig=str(made), page=str(page), settings=self._settings
        )
        async with self._instrument.busy("taking the new rig") as devices:
            await devices.call("rest")
            try:
                found["selftest"] = await devices.call("selftest", tell, rig=str(made), settings=self._settings)
            except FringescopeError as e:
                found["selftest"] = {"ok": False, "words": f"no self-test: {e}"}
            self._shelf.use_rig(made, page)
        for case in self._hub.open_cases():
            truth, _ = await self._hub.truth_of(case)
            if truth.exam.rig not in ("", found["rig"]):
                await self._hub.tell(case, RigChanged(found["rig"]))
        return found
