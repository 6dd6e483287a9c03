"""The simulated instrument: projector, cameras and ring light of one world, on one virtual clock and trigger line.

A camera records what the projector shows and the ring light gives at the moment of the edge. Time is virtual: nothing
waits for the exposure to pass. Faults can be injected to see that they are found.
"""

from __future__ import annotations

import itertools
import queue
import threading
import time
import urllib.parse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fringescope.devices import base
from fringescope.errors import DeviceLostError, DeviceTimeoutError, RejectedError, UsageError
from fringescope.twin import presets, render, scene
from fringescope.types import U8, AnyArray, PixelFormat, Rig


@dataclass(frozen=True)
class Faults:
    """What goes wrong, per camera name: numbers of the edges (from 0, since the camera was armed) that it strikes.

    `drop`: exposed, but the frame is lost on its way. `miss`: the edge is not seen. `late`: the exposure starts half a
    period late. `corrupt`: part of the buffer never comes. `lost`: the camera vanishes. `repeat`: edges at which the
    projector shows the pattern before once more.
    """

    drop: Mapping[str, frozenset[int]] = field(default_factory=dict)
    miss: Mapping[str, frozenset[int]] = field(default_factory=dict)
    late: Mapping[str, frozenset[int]] = field(default_factory=dict)
    corrupt: Mapping[str, frozenset[int]] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    repeat: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class _Edge:
    """What the world looks like at an edge."""

    number: int
    at_ns: int
    period_ns: int
    image: U8 | None
    leds: float
    lit_us: int
    ring: float


class World:
    """What simulated devices share: scene, clock, trigger line, lights, faults, and the seed of all noise.

    `noise` off makes every sensor exact but for rounding. The renderer keeps geometry for each camera.
    """

    def __init__(
        self,
        view: scene.Scene,
        instrument: presets.Instrument,
        seed: int = 0,
        noise: bool = True,
        faults: Faults | None = None,
        rays: int | None = None,
    ) -> None:
        self.scene, self.instrument, self.seed, self.noise = view, instrument, seed, noise
        self.faults = faults or Faults()
        self.renderer = render.Renderer(view, instrument, rays)
        self.ring = 0.0
        self._clock_ns = 1_000_000_000
        self._armed: dict[str, _SimulatedAcquisition] = {}
        self._lock = threading.RLock()
        self._render_lock = threading.Lock()

    def advance(self, ns: int) -> int:
        """Moves the clock on; returns the time before, ns."""
        with self._lock:
            now = self._clock_ns
            self._clock_ns += ns
            return now

    def attach(self, name: str, acquisition: _SimulatedAcquisition) -> None:
        """Connects an armed camera to the trigger line. Raises RejectedError if it is armed already."""
        with self._lock:
            if name in self._armed:
                raise RejectedError(f"{name} is armed already; cancel that acquisition first")
            self._armed[name] = acquisition

    def detach(self, name: str, acquisition: _SimulatedAcquisition) -> None:
        """Takes an acquisition off the trigger line."""
        with self._lock:
            if self._armed.get(name) is acquisition:
                del self._armed[name]

    def raise_edge(self, edge: _Edge) -> None:
        """An edge on the line: every armed camera sees it."""
        with self._lock:
            waiting = list(self._armed.values())
        for a in waiting:
            a.edge(edge)

    def picture(self, camera: str, edge: _Edge, settings: base.CameraSettings, key: int) -> AnyArray:
        """The frame that `camera` exposes at an edge; `key` seeds its noise together with the world's seed."""
        index = self.instrument.rig.index(camera)
        rng = np.random.default_rng([self.seed, 77, index, key]) if self.noise else None
        lit = (
            min(edge.lit_us, settings.exposure_us) / settings.exposure_us
        )  # the projector is dark outside its exposure
        with self._render_lock:
            full = self.renderer.frame(
                camera,
                edge.image,
                rng,
                settings.exposure_us,
                edge.ring,
                settings.gain,
                edge.leds * lit,
                settings.pixel_format,
            )
        r = settings.roi
        return full if r is None else full[r.top : r.top + r.height, r.left : r.left + r.width]


class SimulatedProjector(base.Projector):
    """A DLP4500 that plays any number of 8-bit patterns."""

    def __init__(self, world: World, uri: str) -> None:
        super().__init__()
        self._world, self._loaded = world, -1
        self._tokens = itertools.count()
        p = world.instrument.rig.projector
        self._info = base.ProjectorInfo(uri, "simulated DLP4500", "sim", p.width, p.height, p.layout, 8333, 4096)

    @property
    def info(self) -> base.ProjectorInfo:
        """What it is."""
        return self._info

    def _load(self, shot: base.Shot) -> base.LoadedShot:
        self._loaded = next(self._tokens)
        return base.LoadedShot(shot, shot.exposure, self._loaded)

    def _fire(self, loaded: base.LoadedShot) -> base.Running:
        if loaded.token != self._loaded:
            raise RejectedError(f"{self._info.uri}: this shot is no longer loaded; load it again")
        return _SimulatedRunning(self._world, loaded)


class _SimulatedRunning(base.Running):
    """Plays its edges in a thread of its own."""

    def __init__(self, world: World, loaded: base.LoadedShot) -> None:
        self._world, self._loaded = world, loaded
        self._edges: list[int] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, name="simulated projector", daemon=True)
        self._thread.start()

    def _play(self) -> None:
        shot, period = self._loaded.shot, self._loaded.exposure.period_us * 1000
        leds = (shot.leds.red + shot.leds.green + shot.leds.blue) / 3
        for k, p in enumerate(shot.patterns):
            if self._stop.is_set():
                return
            shown = shot.patterns[k - 1] if k and k in self._world.faults.repeat else p
            at = self._world.advance(period)
            self._edges.append(at)
            self._world.raise_edge(
                _Edge(k, at, period, shown.image, leds, self._loaded.exposure.duration_us, self._world.ring)
            )

    def wait(self, timeout_s: float) -> None:
        """See `base.Running`."""
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise DeviceTimeoutError(f"the projector did not finish its shot in {timeout_s} s")

    def cancel(self) -> None:
        """See `base.Running`."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    @property
    def edges(self) -> tuple[int, ...]:
        """See `base.Running`."""
        return tuple(self._edges)


class SimulatedCamera(base.Camera):
    """A camera that photographs the world."""

    def __init__(self, world: World, name: str, uri: str) -> None:
        super().__init__()
        self._world, self.name = world, name
        inst = world.instrument
        lens, own = inst.rig.camera(name).lens, inst.pixel_formats[inst.rig.index(name)]
        kind = "BayerRG" if own.is_bayer else "Mono"
        formats = tuple(f for f in PixelFormat if f.value.startswith(kind))
        info = base.CameraInfo(
            uri, "simulated IMX183", name, lens.width, lens.height, formats, base.Shutter.ROLLING, inst.readout_us
        )
        self._info = info
        self._settings = base.CameraSettings(own, inst.standard_exposure_us)
        self._acquisition: _SimulatedAcquisition | None = None
        self._block = 0

    @property
    def info(self) -> base.CameraInfo:
        """What it is."""
        return self._info

    @property
    def settings(self) -> base.CameraSettings:
        """What it is set to."""
        return self._settings

    def _configure(self, settings: base.CameraSettings) -> base.CameraSettings:
        self._settings = settings
        return settings

    def _arm(self, n: int, trigger: base.Trigger) -> base.Acquisition:
        a = _SimulatedAcquisition(self, self._world, n, trigger, self._settings)
        self._world.attach(self.name, a)
        self._acquisition = a
        return a

    def next_block(self) -> int:
        """Number of the exposure that begins now."""
        with self._lock:
            self._block += 1
            return self._block

    def _close(self) -> None:
        if self._acquisition is not None:
            self._acquisition.cancel()


class _SimulatedAcquisition(base.Acquisition):
    """Edges wait in a queue; the frame is rendered when it is taken."""

    def __init__(
        self, camera: SimulatedCamera, world: World, n: int, trigger: base.Trigger, settings: base.CameraSettings
    ) -> None:
        self._camera, self._world, self._n, self._trigger, self._settings = camera, world, n, trigger, settings
        self._queue: queue.SimpleQueue[tuple[_Edge, int, int] | None] = queue.SimpleQueue()
        self._seen = itertools.count()
        self._taken = 0
        self._cancelled = threading.Event()

    def edge(self, edge: _Edge) -> None:
        """The line rose."""
        f, name, k = self._world.faults, self._camera.name, next(self._seen)
        if self._cancelled.is_set() or k in f.miss.get(name, ()):
            return
        self._queue.put((edge, k, self._camera.next_block()))

    def trigger(self) -> None:
        """See `base.Acquisition`."""
        if self._trigger.source is not base.TriggerSource.SOFTWARE:
            raise RejectedError(
                f"{self._camera.info.uri}: armed for the line; a software trigger needs TriggerSource.SOFTWARE"
            )
        period = self._settings.exposure_us * 1000
        self.edge(
            _Edge(0, self._world.advance(period), period, None, 0.0, self._settings.exposure_us, self._world.ring)
        )

    def __iter__(self) -> Iterator[base.Frame]:
        uri, f, name = self._camera.info.uri, self._world.faults, self._camera.name
        while self._taken < self._n and not self._cancelled.is_set():
            item = self._next(self._trigger.timeout_s)
            if item is None:
                return
            edge, k, block = item
            if f.lost.get(name) == k:
                raise DeviceLostError(f"{uri}: the camera no longer answers; check its cable and open it again")
            if k in f.drop.get(name, ()):
                continue
            self._taken += 1
            yield self._frame(edge, k, block)

    def _next(self, timeout_s: float) -> tuple[_Edge, int, int] | None:
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            raise DeviceTimeoutError(
                f"{self._camera.info.uri}: no frame {self._taken + 1} of {self._n} in {timeout_s} s; "
                "is the trigger connected?"
            ) from None

    def _frame(self, edge: _Edge, k: int, block: int) -> base.Frame:
        f, name = self._world.faults, self._camera.name
        pixels = self._world.picture(name, edge, self._settings, block)
        at = edge.at_ns + (edge.period_ns // 2 if k in f.late.get(name, ()) else 0)
        complete = k not in f.corrupt.get(name, ())
        if not complete:
            pixels[pixels.shape[0] // 2 :] = 0
        chunks = {"ExposureTime": self._settings.exposure_us, "BlockId": block}
        return base.Frame(pixels, self._settings.pixel_format, block, at, time.monotonic_ns(), complete, chunks)

    def surplus(self, wait_s: float) -> int:
        """See `base.Acquisition`. Virtual time: `wait_s` need not pass."""
        del wait_s
        n = 0
        while True:
            try:
                item = self._queue.get_nowait()
            except queue.Empty:
                return n
            n += item is not None

    def cancel(self) -> None:
        """See `base.Acquisition`."""
        if not self._cancelled.is_set():
            self._cancelled.set()
            self._world.detach(self._camera.name, self)
            self._queue.put(None)


class SimulatedLight(base.Light):
    """The ring light."""

    def __init__(self, world: World, uri: str) -> None:
        super().__init__()
        self._world, self._info = world, base.LightInfo(uri, "simulated ring light")

    @property
    def info(self) -> base.LightInfo:
        """What it is."""
        return self._info

    @property
    def level(self) -> float:
        """Its level, 0..1."""
        return self._world.ring

    def _set(self, level: float) -> None:
        self._world.ring = float(level)

    def _close(self) -> None:
        self._world.ring = 0.0


# ---------------------------------------------------------------------------------------------------------- by name


def parse(uri: str) -> World:
    """The world of `sim://PRESET/SCENE?scale=0.125&seed=1&lift=0&pose=0&board=charuco&noise=0&rays=4`; a fragment is
    ignored.

    Raises UsageError for a name or option that there is not.
    """
    u = urllib.parse.urlsplit(uri)
    name = u.path.strip("/")
    known: dict[str, float | int | str] = {
        "scale": 0.125,
        "seed": 0,
        "lift": 0.0,
        "pose": 0,
        "board": "checkerboard",
        "noise": 1,
        "rays": 0,
    }
    options = dict(known)
    for key, text in urllib.parse.parse_qsl(u.query, keep_blank_values=True):
        if key not in known:
            raise UsageError(f"{uri}: unknown option '{key}'; there are {', '.join(known)}")
        try:
            options[key] = type(known[key])(text)
        except ValueError as e:
            raise UsageError(f"{uri}: {key}={text}; needed a number") from e
    if u.scheme != "sim" or not u.netloc or not name:
        raise UsageError(f"{uri}: needed sim://PRESET/SCENE, for example sim://paper/tissue-domed?scale=0.125")
    instrument = presets.instrument(u.netloc, float(options["scale"]))
    view = scene.make(name, int(options["seed"]), float(options["lift"]), int(options["pose"]), str(options["board"]))
    return World(view, instrument, int(options["seed"]), bool(options["noise"]), rays=int(options["rays"]) or None)


@dataclass(frozen=True, eq=False)
class SimulatedStation(base.Station):
    """A station whose world can be looked into: scene with truth, instrument, renderer."""

    world: World

    @property
    def rig(self) -> Rig:
        """The true rig."""
        return self.world.instrument.rig


def station(world: World, uri: str = "sim://") -> SimulatedStation:
    """All devices of a world."""
    stem = uri.split("#")[0]
    cameras = tuple(SimulatedCamera(world, c.name, f"{stem}#{c.name}") for c in world.instrument.rig.cameras)
    return SimulatedStation(
        SimulatedProjector(world, f"{stem}#projector"), cameras, SimulatedLight(world, f"{stem}#light"), world
    )
