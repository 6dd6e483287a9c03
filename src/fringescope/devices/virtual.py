"""What devices without hardware share: one trigger line, edges that wait in a queue, and a light that is a number."""

from __future__ import annotations

import itertools
import queue
import threading
from abc import abstractmethod
from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from fringescope.devices import base
from fringescope.errors import DeviceTimeoutError, RejectedError
from fringescope.types import U8

E = TypeVar("E")  #: what an edge tells the cameras


class TriggerLine(Generic[E]):
    """The line that arms cameras see: an edge reaches every acquisition that is attached."""

    def __init__(self) -> None:
        self._armed: dict[str, VirtualAcquisition[E]] = {}
        self._lock = threading.RLock()

    def attach(self, acquisition: VirtualAcquisition[E]) -> None:
        """Connects an armed camera. Raises RejectedError if it is armed already."""
        with self._lock:
            if acquisition.name in self._armed:
                raise RejectedError(f"{acquisition.name} is armed already; cancel that acquisition first")
            self._armed[acquisition.name] = acquisition

    def detach(self, acquisition: VirtualAcquisition[E]) -> None:
        """Takes an acquisition off the line."""
        with self._lock:
            if self._armed.get(acquisition.name) is acquisition:
                del self._armed[acquisition.name]

    def rise(self, edge: E) -> None:
        """An edge on the line: every armed camera sees it."""
        with self._lock:
            waiting = list(self._armed.values())
        for a in waiting:
            a.edge(edge)


class VirtualProjector(base.Projector):
    """Remembers which shot was loaded last; a subclass says how it plays (`_play`). Its lamp burns through a latch."""

    def __init__(self, info: base.ProjectorInfo) -> None:
        super().__init__()
        self._info, self._loaded, self._tokens = info, -1, itertools.count()

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
        return self._play(loaded)

    def _show(self, image: U8, leds: base.Leds) -> None:
        """Nothing to send: cameras ask what is `held`."""

    def _dark(self) -> None:
        """Nothing to send, either."""

    def _kill_switch(self, latch: str) -> base.KillSwitch:
        return base.KillSwitch(latch)  # the lamp burns through the latch

    @abstractmethod
    def _play(self, loaded: base.LoadedShot) -> base.Running:
        """Hook: plays a shot that is loaded."""


class VirtualCamera(base.Camera, Generic[E]):
    """A camera on a `TriggerLine`, with the numbers that it gives its exposures."""

    def __init__(self, info: base.CameraInfo, settings: base.CameraSettings, line: TriggerLine[E]) -> None:
        super().__init__()
        self._info, self._settings, self._line = info, settings, line
        self._acquisition: VirtualAcquisition[E] | None = None
        self._block = 0

    @property
    def name(self) -> str:
        """Its name in the rig."""
        return self._info.serial

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
        acquisition = self._acquire(n, trigger)
        self._line.attach(acquisition)
        self._acquisition = acquisition
        return acquisition

    @abstractmethod
    def _acquire(self, n: int, trigger: base.Trigger) -> VirtualAcquisition[E]:
        """Hook: the acquisition of `n` frames."""

    def next_block(self) -> int:
        """Number of the exposure that begins now."""
        with self._lock:
            self._block += 1
            return self._block

    def _close(self) -> None:
        if self._acquisition is not None:
            self._acquisition.cancel()


class VirtualAcquisition(base.Acquisition, Generic[E]):
    """Edges wait in a queue with their number since arming and their block; a frame is made when it is taken."""

    def __init__(self, camera: VirtualCamera[E], line: TriggerLine[E], n: int, trigger: base.Trigger) -> None:
        self._camera, self._line, self._n, self._trigger = camera, line, n, trigger
        self._queue: queue.SimpleQueue[tuple[E, int, int] | None] = queue.SimpleQueue()
        self._seen, self._taken, self._cancelled = itertools.count(), 0, threading.Event()

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._camera.name

    def edge(self, edge: E) -> None:
        """The line rose."""
        number = next(self._seen)
        if not self._cancelled.is_set() and self._sees(number):
            self._queue.put((edge, number, self._camera.next_block()))

    def _sees(self, number: int) -> bool:
        """Hook: whether the camera notices edge `number` since it was armed."""
        del number
        return True

    @abstractmethod
    def _own_edge(self) -> E:
        """Hook: the edge that a software trigger makes."""

    @abstractmethod
    def _frame(self, edge: E, number: int, block: int) -> base.Frame | None:
        """Hook: the frame exposed at an edge; None if it is lost on its way."""

    def trigger(self) -> None:
        """See `base.Acquisition`."""
        if self._trigger.source is not base.TriggerSource.SOFTWARE:
            raise RejectedError(
                f"{self._camera.info.uri}: armed for the line; a software trigger needs TriggerSource.SOFTWARE"
            )
        self.edge(self._own_edge())

    def __iter__(self) -> Iterator[base.Frame]:
        while self._taken < self._n and not self._cancelled.is_set():
            try:
                item = self._queue.get(timeout=self._trigger.timeout_s)
            except queue.Empty:
                raise DeviceTimeoutError(
                    f"{self._camera.info.uri}: no frame {self._taken + 1} of {self._n} in {self._trigger.timeout_s} s; "
                    "is the trigger connected?"
                ) from None
            if item is None:
                return
            frame = self._frame(*item)
            if frame is not None:
                self._taken += 1
                yield frame

    def surplus(self, wait_s: float) -> int:
        """See `base.Acquisition`. Nothing is on its way: `wait_s` need not pass."""
        del wait_s
        n = 0
        while not self._queue.empty():
            n += self._queue.get_nowait() is not None
        return n

    def cancel(self) -> None:
        """See `base.Acquisition`."""
        if not self._cancelled.is_set():
            self._cancelled.set()
            self._line.detach(self)
            self._queue.put(None)


class Lamp(Protocol):
    """What shines while a light is on."""

    ring: float  #: level, 0..1


class VirtualLight(base.Light):
    """A light whose level is kept by what it lights."""

    def __init__(self, lit: Lamp, info: base.LightInfo) -> None:
        super().__init__()
        self._lit, self._info = lit, info

    @property
    def info(self) -> base.LightInfo:
        """What it is."""
        return self._info

    @property
    def level(self) -> float:
        """Its level, 0..1."""
        return self._lit.ring

    def _set(self, level: float) -> None:
        self._lit.ring = float(level)

    def _close(self) -> None:
        self._lit.ring = 0.0
