"""The simulated instrument: projector, cameras and ring light of one world, on one virtual clock and trigger line.

A camera records what the projector shows and the ring light gives at the moment of the edge: a pattern of a shot, or,
when the camera is triggered by software, the picture that the projector holds. Time is virtual: nothing waits for the
exposure to pass. Faults can be injected to see that they are found.
"""

from __future__ import annotations

import threading
import time
import urllib.parse
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fringescope.devices import base, virtual
from fringescope.errors import DeviceLostError, DeviceTimeoutError, UsageError
from fringescope.twin import changes, presets, render, scene
from fringescope.types import AnyArray, Layout, PixelFormat, Rig


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
    held: base.Held | None  #: what the projector shows
    lit_us: int
    ring: float


class World:
    """What simulated devices share: scene, clock, trigger line, lights, faults, and the seed of all noise.

    `noise` off makes every sensor exact but for rounding. The renderer keeps geometry for each camera. `uri`: what
    opens the same instrument over the same scene once more, with other noise, where that can be said.
    """

    def __init__(
        self,
        view: scene.Scene,
        instrument: presets.Instrument,
        seed: int = 0,
        noise: bool = True,
        faults: Faults | None = None,
        rays: int | None = None,
        uri: str | None = None,
    ) -> None:
        self.scene, self.instrument, self.seed, self.noise = view, instrument, seed, noise
        self.faults, self.uri = faults or Faults(), uri
        self._rays = rays
        self.renderer = render.Renderer(view, instrument, rays)
        self.ring = 0.0
        self.projector: base.Projector | None = None  #: whose light falls on the scene
        self.line: virtual.TriggerLine[_Edge] = virtual.TriggerLine()
        self._clock_ns = 1_000_000_000
        self._lock = threading.Lock()
        self._render_lock = threading.Lock()

    def change(self, view: scene.Scene) -> None:
        """Another scene lies under the instrument from now on: frames exposed later show it. Devices stay open."""
        made = render.Renderer(view, self.instrument, self._rays)
        with self._render_lock:
            self.scene, self.renderer = view, made

    def advance(self, ns: int) -> int:
        """Moves the clock on; returns the time before, ns."""
        with self._lock:
            now = self._clock_ns
            self._clock_ns += ns
            return now

    def picture(self, camera: str, edge: _Edge, settings: base.CameraSettings, key: int) -> AnyArray:
        """The frame that `camera` exposes at an edge; `key` seeds its noise together with the world's seed."""
        index = self.instrument.rig.index(camera)
        rng = np.random.default_rng([self.seed, 77, index, key]) if self.noise else None
        lit = (
            min(edge.lit_us, settings.exposure_us) / settings.exposure_us
        )  # the projector is dark outside its exposure
        image = None if edge.held is None else edge.held.image
        leds = base.FULL if edge.held is None else edge.held.leds
        lamps = (lit * leds.red, lit * leds.green, lit * leds.blue)
        with self._render_lock:
            full = self.renderer.frame(
                camera, image, rng, settings.exposure_us, edge.ring, settings.gain, lamps, settings.pixel_format
            )
        r = settings.roi
        return full if r is None else full[r.top : r.top + r.height, r.left : r.left + r.width]


class SimulatedProjector(virtual.VirtualProjector):
    """A DLP4500 that plays any number of 8-bit patterns, and holds pictures in colour."""

    def __init__(self, world: World, uri: str) -> None:
        p = world.instrument.rig.projector
        super().__init__(
            base.ProjectorInfo(uri, "simulated DLP4500", "sim", p.width, p.height, p.layout, 8333, 4096, True)
        )
        self._world = world
        world.projector = self

    def _play(self, loaded: base.LoadedShot) -> base.Running:
        return _SimulatedRunning(self._world, self, loaded)


class _SimulatedRunning(base.Running):
    """Plays its edges in a thread of its own, until a cut."""

    def __init__(self, world: World, projector: SimulatedProjector, loaded: base.LoadedShot) -> None:
        self._world, self._projector, self._loaded = world, projector, loaded
        self._edges: list[int] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, name="simulated projector", daemon=True)
        self._thread.start()

    def _play(self) -> None:
        shot, period = self._loaded.shot, self._loaded.exposure.period_us * 1000
        for k, p in enumerate(shot.patterns):
            if self._stop.is_set() or self._projector.cut is not None:
                return
            shown = shot.patterns[k - 1] if k and k in self._world.faults.repeat else p
            at = self._world.advance(period)
            self._edges.append(at)
            held = base.Held(shown.image, shot.leds)
            self._world.line.rise(_Edge(k, at, period, held, self._loaded.exposure.duration_us, self._world.ring))

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


class SimulatedCamera(virtual.VirtualCamera[_Edge]):
    """A camera that photographs the world."""

    def __init__(self, world: World, name: str, uri: str) -> None:
        inst = world.instrument
        lens, own = inst.rig.camera(name).lens, inst.pixel_formats[inst.rig.index(name)]
        kind = "BayerRG" if own.is_bayer else "Mono"
        formats = tuple(f for f in PixelFormat if f.value.startswith(kind))
        info = base.CameraInfo(
            uri, "simulated IMX183", name, lens.width, lens.height, formats, base.Shutter.ROLLING, inst.readout_us
        )
        super().__init__(info, base.CameraSettings(own, inst.standard_exposure_us), world.line)
        self._world = world

    def _acquire(self, n: int, trigger: base.Trigger) -> virtual.VirtualAcquisition[_Edge]:
        return _SimulatedAcquisition(self, self._world, n, trigger)


class _SimulatedAcquisition(virtual.VirtualAcquisition[_Edge]):
    """The frame is rendered when it is taken, with the settings at arming."""

    def __init__(self, camera: SimulatedCamera, world: World, n: int, trigger: base.Trigger) -> None:
        super().__init__(camera, world.line, n, trigger)
        self._world, self._settings = world, camera.settings

    def _sees(self, number: int) -> bool:
        return number not in self._world.faults.miss.get(self.name, ())

    def _own_edge(self) -> _Edge:
        exposure_us = self._settings.exposure_us
        period, projector = exposure_us * 1000, self._world.projector
        held = None if projector is None else projector.held
        return _Edge(0, self._world.advance(period), period, held, exposure_us, self._world.ring)

    def _frame(self, edge: _Edge, number: int, block: int) -> base.Frame | None:
        f = self._world.faults
        if f.lost.get(self.name) == number:
            uri = self._camera.info.uri
            raise DeviceLostError(f"{uri}: the camera no longer answers; check its cable and open it again")
        if number in f.drop.get(self.name, ()):
            return None
        pixels = self._world.picture(self.name, edge, self._settings, block)
        at = edge.at_ns + (edge.period_ns // 2 if number in f.late.get(self.name, ()) else 0)
        complete = number not in f.corrupt.get(self.name, ())
        if not complete:
            pixels[pixels.shape[0] // 2 :] = 0
        chunks = {"ExposureTime": self._settings.exposure_us, "BlockId": block}
        return base.Frame(pixels, self._settings.pixel_format, block, at, time.monotonic_ns(), complete, chunks)


class SimulatedLight(virtual.VirtualLight):
    """The ring light."""

    def __init__(self, world: World, uri: str) -> None:
        super().__init__(world, base.LightInfo(uri, "simulated ring light"))


# ---------------------------------------------------------------------------------------------------------- by name


def parse(uri: str) -> World:
    """The world of `sim://PRESET/SCENE?scale=0.125&seed=1&lift=0&pose=0&board=charuco&noise=0&rays=4&layout=grid`; a
    fragment is ignored. `move=0.3,0,0&turn=0,0,0.5&dent=0.5&dry=0.3&ring=0.9&cover=10`: what befell the scene since it
    was scanned, see `twin.changes.changed`.

    `noise`: 0 none, else which draw of it; 1 is that of `fringescope simulate`. Raises UsageError for a name or option
    that there is not.
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
        "layout": "diamond",
        **dict.fromkeys(changes.OPTIONS, ""),
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
    if options["layout"] not in ("grid", "diamond"):
        raise UsageError(f"{uri}: layout={options['layout']}; needed grid or diamond")
    instrument = presets.instrument(u.netloc, float(options["scale"]), Layout(options["layout"]))
    seed, draw = int(options["seed"]), int(options["noise"])
    if min(seed, draw, int(options["pose"])) < 0:
        raise UsageError(f"{uri}: seed, noise and pose count from 0")
    view = scene.make(name, seed, float(options["lift"]), int(options["pose"]), str(options["board"]))
    view = changes.changed(view, {k: str(options[k]) for k in changes.OPTIONS})
    noise_seed = seed + 1_000_000_007 * max(draw - 1, 0)
    uri = _again(u, draw + 1 if draw else 0)
    return World(view, instrument, noise_seed, draw > 0, rays=int(options["rays"]) or None, uri=uri)


def _again(u: urllib.parse.SplitResult, draw: int) -> str:
    """A URI with this draw of noise, and without its fragment."""
    options = dict(urllib.parse.parse_qsl(u.query)) | {"noise": str(draw)}
    return f"sim://{u.netloc}{u.path}?" + "&".join(f"{k}={v}" for k, v in options.items())


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
