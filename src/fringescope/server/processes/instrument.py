"""What the instrument's process does: it holds the devices, projects under a watchdog, and keeps looking meanwhile.

It projects only pictures that were loaded before, by their hash, and only while the hub gives signs of life: without
one for a second, or when the hub is gone, it is dark. A stale or lost specimen makes dark here, before the hub hears
of it; a suspect one gets its dashed lines here.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from fringescope import capture as capturing
from fringescope import export, fuse, patterns, phase, store
from fringescope.devices import registry
from fringescope.devices.base import Station
from fringescope.devices.watchdog import Guard, described
from fringescope.errors import CaptureError, DeviceError, FringescopeError, RejectedError
from fringescope.pipeline import guidance as recipe
from fringescope.pipeline import projecting, watching
from fringescope.pipeline.selftest import self_test
from fringescope.server.processes.child import STOPPED, Call
from fringescope.settings import Settings, from_dict
from fringescope.store.images import decode_png
from fringescope.types import U8, Standing, ViewInput

Emit = Callable[[dict[str, Any]], None]
Lock = AbstractContextManager[Any]
LEASE_S = 1.0  #: how long the hub may be silent while something is projected


class _Ready:
    """What is ready to be projected: its pictures by hash, a guard, and a thread that looks at the specimen."""

    def __init__(
        self, station: Station, scan: str, look: Callable[[Any], Any], masks: Callable[[U8], Any], s: Settings,
        emit: Emit, cameras: Lock,
    ) -> None:  # fmt: skip
        self.station, self.scan, self.s = station, scan, s
        self._emit, self._cameras = emit, cameras
        self.images: dict[str, U8] = {}
        self._masks: dict[str, Any] = {}
        self._masks_of = masks
        self.pair: tuple[str, str] | None = None  #: what is shown, whole and dashed
        self.standing: Standing | None = None
        self._lit: U8 | None = None
        self._look, self._over = look, threading.Event()
        self._switch = threading.RLock()  #: nobody turns on what somebody else is turning off
        self._failed = 0
        self.guard = Guard(station.projector, s.guard)
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)

    def load(self, images: dict[str, U8]) -> None:
        """Pictures that may be shown, by hash, and where each changes what the cameras see."""
        for name, image in images.items():
            if name not in self.images:
                self._masks[name] = self._masks_of(image)
                self.images[name] = image

    def begin(self) -> None:
        """Looks for the first time, which takes longest, and only then starts what must not be kept waiting."""
        self.look()
        self.guard.start()
        self.guard.lease(LEASE_S)
        self._thread.start()

    def look(self) -> None:
        """Looks once; what is no longer true goes dark here and now."""
        before = self.pair
        try:
            with self._cameras:
                verdict = self._look(None if before is None else self._masks[before[0]])
        except FringescopeError as e:
            self._failed += 1
            if self._failed > 2:
                self.dark()
                self._emit({"lost": "cameras", "why": str(e)})
            return
        self._failed = 0
        if self.pair != before:
            return  # what was projected changed meanwhile: this picture tells nothing
        self.standing = verdict.verdict
        if verdict.verdict is Standing.STALE:
            self.pair = None
            self.station.projector.dark()
        elif self.pair is not None:
            self._show()
        self._emit({"watched": self.scan, "validity": verdict.verdict.value, "note": verdict.why[:200]})

    def show(self, whole: str, dashed: str) -> None:
        """Projects one of two loaded pictures, as the specimen's standing asks."""
        if self.standing is None or self.standing is Standing.STALE:
            raise RejectedError("the specimen is not as it was scanned; scan again")
        for h in (whole, dashed):
            if h not in self.images:
                raise RejectedError(f"picture {h[:12]} was not loaded; preview it again")
        with self._switch:
            self.pair = whole, dashed
            self._show()

    def _show(self) -> None:
        with self._switch:
            if self.pair is None:
                return
            image = self.images[self.pair[self.standing is Standing.SUSPECT]]
            grey = not self.station.projector.info.colours
            if self.station.projector.shown is None or self._lit is not image:
                self.station.projector.show(np.asarray(image.max(axis=2)) if grey else image)
                self._lit = image

    def dark(self) -> None:
        with self._switch:
            self.pair = None
            self.station.projector.dark()

    def _watch(self) -> None:
        """Looks again and again; however it ends unasked, it is dark and the hub hears of it."""
        why = "the looking ended: this is a bug; report it"
        try:
            while not self._over.wait(self.s.loop.look_s):
                if self.guard.lost:
                    why = self.guard.lost
                    return
                self.look()
        except FringescopeError as e:
            why = self.guard.lost or str(e)
        finally:
            if not self._over.is_set():
                with contextlib.suppress(FringescopeError):
                    self.dark()
                self._emit({"guard": "lost", "why": why})

    def close(self) -> None:
        self._over.set()
        self.dark()
        self.guard.close()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(self.s.loop.patience_s)


class Hand:
    """The devices, in the hand of one process; its calls come one by one, `dark` and `beat` at any time."""

    def __init__(self, emit: Emit) -> None:
        self._emit = emit
        self._cameras = threading.Lock()  #: one at a time takes pictures
        self._station: Station | None = None
        self._uri = ""
        self._ready: _Ready | None = None
        self._dark_from = 0  #: calls with a lower number were made before somebody said dark: they light nothing
        self.calls: dict[str, Callable[..., Any]] = {
            "open": self.open_, "close": self.close, "capture": self.capture, "ready": self.ready, "rest": self.rest,
            "look": self.look, "show": self.show, "befall": self.befall, "twin_rig": self.twin_rig,
            "selftest": self.selftest, "shown": self.shown,
        }  # fmt: skip
        self.urgent: dict[str, Callable[..., Any]] = {"dark": self.dark, "beat": self.beat}
        self.aside: dict[str, Callable[..., Any]] = {"live": self.live}  # who turns on the light waits for no video

    def _opened(self) -> Station:
        if self._station is None:
            raise DeviceError("the instrument is not open; open it first")
        return self._station

    def ended(self) -> None:
        """The hub is gone: dark."""
        if self._ready is not None:
            self._ready.dark()
        if self._station is not None:
            self._station.projector.dark()
            self._station.close()

    def open_(self, _call: Call, uri: str) -> dict[str, Any]:
        """Opens the devices; returns what they are."""
        if self._station is None or uri != self._uri:
            self.close(_call)
            self._station, self._uri = registry.open_station(uri), uri
        i = self._station.projector.info
        cameras = [
            {"name": c.info.serial, "width": c.info.width, "height": c.info.height,
             "pixel_format": c.info.pixel_formats[0].value}
            for c in self._station.cameras
        ]  # fmt: skip
        return {"uri": uri, "projector": {"width": i.width, "height": i.height}, "cameras": cameras}

    def close(self, _call: Call) -> None:
        """Dark, and the devices are free for others."""
        self.rest(_call)
        if self._station is not None:
            self._station.close()
        self._station, self._uri = None, ""

    def capture(self, call: Call, rig: str | None, out: str, settings: dict[str, Any]) -> dict[str, Any]:
        """Photographs what lies there and plays the fringes; a capture in a new folder.

        Without a rig: both directions, as a calibration needs them of its board.
        """
        station, s = self._opened(), from_dict(settings)
        self.rest(call)
        station.projector.release()  # after a cut it is dark, and may play fringes again
        formats = {c.info.serial: c.info.pixel_formats[0] for c in station.cameras}
        i = station.projector.info
        if rig is not None:
            plan = patterns.paper_plan(store.read_rig(Path(rig)), formats, s.patterns)
        else:
            plan = patterns.calibration_plan((i.width, i.height), i.layout, list(formats), formats, s.patterns)
        by_name = {c.info.serial: c for c in station.cameras}
        cameras = [by_name[v.camera] for v in plan.views]
        total = sum(len(v.keys) for v in plan.views)
        done = 0
        call.progress("photographs", 0.0)
        photos: tuple[Any, ...] = (None,) * len(cameras)
        if station.light is not None:
            wanted = [v.pixel_format for v in plan.views]
            with self._cameras:
                photos = capturing.photograph(station.projector, cameras, station.light, wanted, s.capture)

        def counted(frames: Any, camera: str) -> Iterator[Any]:
            nonlocal done
            for item in frames:
                done += 1
                self._not_dark(call)
                call.progress(f"fringes {camera}", 0.1 + 0.9 * done / total)
                yield item

        def views() -> Iterator[ViewInput]:
            for view, camera, photo in zip(plan.views, cameras, photos, strict=True):
                shown = [(key, image) for c, key, image in patterns.plan_images(plan, s.patterns) if c == view.camera]
                frames = capturing.stream(station.projector, camera, shown, view, s.capture)
                yield ViewInput(view, counted(frames, view.camera), photo)

        try:
            with self._cameras, store.new_folder(Path(out), marker="capture.json") as tmp:
                store.put_capture(tmp, i.width, i.height, i.layout, views(), {"instrument": self._uri})
        finally:
            station.projector.dark()
        return {"views": [v.camera for v in plan.views], "frames": total}

    def ready(
        self, call: Call, scan: str, scan_id: str, rig: str, pictures: dict[str, str], settings: dict[str, Any]
    ) -> dict[str, Any]:
        """Starts the watchdog and the looking, and loads pictures (hash to file) that may be projected later."""
        station, s = self._opened(), from_dict(settings)
        images = {h: _read_png(path, h) for h, path in pictures.items()}
        cut = station.projector.cut is not None  # by the stop button; who previews again may light it again
        if self._ready is None or self._ready.scan != scan_id or self._ready.guard.lost or cut:
            self.rest(call)
            station.projector.release()
            stored = store.read_scan(Path(scan), check=False)
            r = store.read_rig(Path(rig))
            photos, noise = stored.every_picture(), stored.noise()
            if stored.surface is None:
                raise CaptureError("the scan has no surface, so nothing was drawn on it; scan again")
            tissue = recipe.tissue_of(stored.grids, export.read_glb(stored.surface), r, s)

            def look(masks: Any) -> Any:
                return watching.watch(station, stored.grids, photos, r, s, noise=noise, masks=masks)

            made = _Ready(station, scan_id, look, lambda image: _masks(image, tissue), s, self._emit, self._cameras)
            self.live(call, station.cameras[0].info.serial, 320, 50)  # what is slow the first time is not so later
            made.load(images)
            made.begin()
            self._ready = made
        else:
            self._ready.load(images)
        standing = self._ready.standing
        return {"guarded": True, "validity": None if standing is None else standing.value, "stop": self.stop_button()}

    def stop_button(self) -> dict[str, Any]:
        """What turns the projector dark from the hub's process, whatever this one does."""
        assert self._ready is not None
        button = self._ready.guard.button()
        return {"switch": described(button.switch), "patience_ms": button.patience_ms}

    def show(self, call: Call, whole: str, dashed: str) -> dict[str, Any]:
        """Projects a loaded picture, unless somebody said dark after this was asked for."""
        self._not_dark(call)
        if self._ready is None:
            raise RejectedError("nothing is ready to be projected; preview it again")
        if self._ready.guard.lost:
            raise RejectedError(f"the projector is dark ({self._ready.guard.lost}); preview it again")
        self._ready.guard.lease(LEASE_S)
        self._ready.show(whole, dashed)
        if call.number < self._dark_from:  # while it was being turned on
            self._ready.dark()
            self._not_dark(call)
        return {"shown_ns": time.time_ns() - max(0, time.monotonic_ns() - (self.shown(call) or time.monotonic_ns()))}

    def _not_dark(self, call: Call) -> None:
        if call.number < self._dark_from:
            raise RejectedError(STOPPED)

    def shown(self, _call: Call) -> int:
        """Since when (`time.monotonic_ns`) the projector itself says that it holds a picture; 0 = it is dark."""
        held = self._opened().projector.held
        return 0 if held is None else held.at_ns

    def rest(self, _call: Call) -> None:
        """Dark, no watchdog, nobody looks: the devices are free."""
        if self._ready is not None:
            self._ready.close()
            self._ready = None

    def look(self, _call: Call) -> dict[str, Any]:
        """Looks at the specimen once, now."""
        if self._ready is None:
            raise RejectedError("nothing is ready to be projected; preview it first")
        self._ready.look()
        return {"validity": None if self._ready.standing is None else self._ready.standing.value}

    def selftest(self, call: Call, rig: str, settings: dict[str, Any]) -> dict[str, Any]:
        """Projects a cross grid on the board that lies there, and measures where its lines land."""
        s = from_dict(settings)
        call.progress("self-test", 0.0)
        station = self._opened()
        try:
            with self._cameras:
                found = self_test(station, store.read_rig(Path(rig)), s)
        finally:
            station.projector.dark()
        figures = {"median_um": found.median_um, "p95_um": found.p95_um, "max_um": found.max_um}
        return {**figures, "ok": found.ok, "words": found.words(s.loop.accept_um)}

    def live(self, _call: Call, camera: str, width: int, quality: int) -> dict[str, Any]:
        """What a camera sees now, as JPEG in base64, at most so wide."""
        import cv2

        station = self._opened()
        found = next((c for c in station.cameras if c.info.serial == camera), None)
        if found is None:
            raise DeviceError(f"no camera {camera}; there are {', '.join(c.info.serial for c in station.cameras)}")
        if station.light is None:
            raise DeviceError("this instrument has no light to see by")
        fmt = found.info.pixel_formats[0]
        at = time.time_ns()
        with self._cameras:
            frame = capturing.look([found], station.light, [fmt], Settings().capture)[0]
        photo = fuse.encode_srgb(fuse.photo(phase.unpacked(frame, fmt), fmt, camera, Settings().fuse).rgb)
        if photo.shape[1] > width:
            size = width, max(1, round(photo.shape[0] * width / photo.shape[1]))
            photo = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        good, data = cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert good
        return {"at_ns": at, "jpeg": base64.b64encode(data.tobytes()).decode()}

    def beat(self, _call: Call) -> None:
        """The hub lives. Without this for a second, what is projected goes dark."""
        now = self._ready
        if now is not None and not now.guard.lost:
            now.guard.lease(LEASE_S)

    def dark(self, call: Call) -> dict[str, Any]:
        """Dark at once, whatever is being done; what was asked for before and waits lights nothing either."""
        self._dark_from = max(self._dark_from, call.number)
        now = self._ready
        if now is not None:
            now.dark()
        if self._station is not None:
            self._station.projector.dark()
        return {"dark_ns": time.time_ns()}

    def befall(self, _call: Call, what: dict[str, str]) -> None:
        """For the simulated instrument alone: what befalls the specimen, as `twin.changes.changed` takes it."""
        from fringescope.devices.simulated import SimulatedStation
        from fringescope.twin import changes
        from fringescope.twin import scene as scenes

        station = self._opened()
        if not isinstance(station, SimulatedStation):
            raise DeviceError("this instrument is not simulated; move the specimen by hand")
        world = station.world
        if "scene" in what:  # another thing lies there now, as a board in its next pose
            name, seed = what["scene"], world.scene.seed
            pose, board = int(what.get("pose", "0")), what.get("board", "checkerboard")
            world.change(scenes.make(name, seed, pose=pose, board=board))
        else:
            world.change(changes.changed(world.scene, what))

    def twin_rig(self, _call: Call, out: str) -> str:
        """For the simulated instrument alone: its true rig, as a file."""
        from fringescope.devices.simulated import SimulatedStation

        station = self._opened()
        if not isinstance(station, SimulatedStation):
            raise DeviceError("this instrument is not simulated; calibrate it, and name its rig with --rig")
        store.write_rig(Path(out), station.rig, force=True)
        return out


def _masks(image: U8, tissue: Any) -> Any:
    from fringescope.types import Guidance

    return projecting.lit_masks(Guidance(image, ()), tissue)


def _read_png(path: str, sha256: str) -> U8:
    data = Path(path).read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise RejectedError(f"{path}: is not the picture {sha256[:12]} that was confirmed; nothing is projected")
    return np.asarray(decode_png(data, Path(path)), np.uint8)
