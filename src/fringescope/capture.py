"""Plays patterns, collects the frames of each view, and proves that frame n is pattern n.

Cameras are armed before the projector fires. Proof: counts, contiguous block numbers, complete buffers, one period
between exposures, no frame too many, and for every N-step set a misfit that no single frame explains. Any failure is an
IncompleteShotError that names the frames; nothing is ever interpolated.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from fringescope.devices.base import (
    Acquisition,
    Camera,
    CameraSettings,
    Exposure,
    Frame,
    Light,
    PatternRef,
    Projector,
    Shot,
    Shutter,
    Trigger,
    TriggerSource,
)
from fringescope.errors import CaptureError, DeviceTimeoutError, IncompleteShotError, RejectedError
from fringescope.settings import CaptureSettings
from fringescope.types import (
    F64,
    U8,
    AnyArray,
    FrameKey,
    FringeSet,
    PatternPlan,
    PixelFormat,
    Role,
    ViewInput,
    ViewPlan,
)

_SAMPLES = 40_000  #: pixels at which a set's misfit is looked at


def timing(projector: Projector, cameras: Sequence[Camera], s: CaptureSettings | None = None) -> Exposure:
    """The shortest period at which every camera sees each pattern whole and alone.

    A rolling shutter exposes all rows together only between readouts, so its period is exposure plus readout; a global
    one may read while the next pattern is shown. Raises RejectedError if the projector cannot show a pattern that
    short.
    """
    s = s or CaptureSettings()
    if s.exposure_us < projector.info.min_exposure_us:
        raise RejectedError(
            f"exposure {s.exposure_us} us; {projector.info.uri} shows 8-bit patterns for at least "
            f"{projector.info.min_exposure_us} us: set capture.exposure_us higher"
        )
    seen = s.exposure_us + s.margin_us
    need = seen
    for c in cameras:
        readout = c.info.readout_of(c.settings.roi)
        need = max(need, seen + readout if c.info.shutter is Shutter.ROLLING else max(seen, readout))
    return Exposure(s.exposure_us, max(need, s.exposure_us + 230))


def collect(
    projector: Projector,
    cameras: Sequence[Camera],
    light: Light | None,
    images: Sequence[Iterable[tuple[FrameKey, U8]]],
    plan: PatternPlan,
    settings: CaptureSettings | None = None,
) -> tuple[ViewInput, ...]:
    """Records every view of a plan with its own patterns, then the ring-light pictures; all frames are kept.

    `images`: per view of the plan, its frames in the plan's order as the device shows them. `cameras` in the order of
    the views. A view whose proof fails is played again, at most `retries` times. Returns one ViewInput per view,
    `color` None without a light. Raises IncompleteShotError, DeviceLostError, RejectedError, and CaptureError if images
    and plan differ.
    """
    s = settings or CaptureSettings()
    _check(cameras, images, plan)
    out: list[ViewInput] = []
    for view, camera, pictures in zip(plan.views, cameras, images, strict=True):
        shown = list(pictures)
        for attempt in range(s.retries + 1):
            try:
                out.append(ViewInput(view, list(stream(projector, camera, shown, view, s))))
                break
            except IncompleteShotError:
                if attempt == s.retries:
                    raise
    if light is None:
        return tuple(out)
    photos = photograph(projector, cameras, light, [v.pixel_format for v in plan.views], s)
    return tuple(ViewInput(v.plan, v.frames, p) for v, p in zip(out, photos, strict=True))


def stream(
    projector: Projector,
    camera: Camera,
    images: Iterable[tuple[FrameKey, U8]],
    view: ViewPlan,
    settings: CaptureSettings | None = None,
) -> Iterator[tuple[FrameKey, AnyArray]]:
    """Plays one view's patterns and yields its frames as they arrive, so that decoding can run meanwhile.

    What was yielded is proven only once the iterator has ended without an error. See `collect` for errors.
    """
    s = settings or CaptureSettings()
    shown = list(images)
    keys = view.keys
    if tuple(k for k, _ in shown) != keys:
        raise CaptureError(
            f"view '{view.camera}': {len(shown)} images that are not the plan's {len(keys)} frames in order"
        )
    camera.configure(CameraSettings(view.pixel_format, s.exposure_us + s.margin_us))
    exposure = timing(projector, [camera], s)
    loaded = projector.load(Shot(tuple(PatternRef(i, label(k)) for k, i in shown), exposure))
    proof = _Proof(
        view, camera, exposure.period_us * 1000 if loaded.exposure == exposure else loaded.exposure.period_us * 1000, s
    )
    with camera.arm(len(keys), Trigger(timeout_s=s.timeout_s)) as acquisition, projector.fire(loaded) as running:
        for key, frame in zip(keys, _expect(acquisition, keys, camera), strict=True):
            proof.add(key, frame)
            yield key, frame.pixels
        running.wait(s.timeout_s)
        proof.end(acquisition.surplus(2e-6 * exposure.period_us))


def photograph(
    projector: Projector,
    cameras: Sequence[Camera],
    light: Light,
    pixel_formats: Sequence[PixelFormat] | None = None,
    settings: CaptureSettings | None = None,
) -> tuple[AnyArray, ...]:
    """The ring-light picture of every camera at once, the projector dark: raw frames (H, W). The light is off
    afterwards.
    """
    s = settings or CaptureSettings()
    formats = list(pixel_formats) if pixel_formats is not None else [c.settings.pixel_format for c in cameras]
    for c, f in zip(cameras, formats, strict=True):
        c.configure(CameraSettings(f, s.exposure_us + s.margin_us))
    dark = np.zeros((projector.info.height, projector.info.width), dtype=np.uint8)
    loaded = projector.load(Shot((PatternRef(dark, "ring light"),), timing(projector, cameras, s)))
    light.set(1.0)
    armed: list[Acquisition] = []
    try:
        armed = [c.arm(1, Trigger(timeout_s=s.timeout_s)) for c in cameras]
        with projector.fire(loaded) as running:
            running.wait(s.timeout_s)
            frames = []
            for c, a in zip(cameras, armed, strict=True):
                try:
                    frames.append(next(iter(a)))
                except (DeviceTimeoutError, StopIteration) as e:
                    raise IncompleteShotError(f"{c.info.uri}: no ring-light picture came; check its trigger") from e
    finally:
        for a in armed:
            a.cancel()
        light.set(0.0)
    for c, frame in zip(cameras, frames, strict=True):
        if not frame.complete:
            raise IncompleteShotError(f"{c.info.uri}: the ring-light picture came incomplete; take it again")
    return tuple(f.pixels for f in frames)


def look(
    cameras: Sequence[Camera],
    light: Light | None,
    pixel_formats: Sequence[PixelFormat],
    settings: CaptureSettings | None = None,
) -> tuple[AnyArray, ...]:
    """One raw frame of each camera, triggered by software with the exposure of a scan, whatever the projector shows
    meanwhile; under the ring light, if it is given. The light is as bright afterwards as before.

    Raises CaptureError unless there is a format for each camera, IncompleteShotError where a camera gives no frame or
    a part of one, and what devices raise.
    """
    s = settings or CaptureSettings()
    if len(cameras) != len(pixel_formats):
        raise CaptureError(f"{len(cameras)} cameras for {len(pixel_formats)} pixel formats; needed one each")
    for c, f in zip(cameras, pixel_formats, strict=True):
        c.configure(CameraSettings(f, s.exposure_us + s.margin_us))
    before = light.level if light is not None else 0.0
    armed: list[Acquisition] = []
    out = []
    try:
        if light is not None:
            light.set(1.0)
        for c in cameras:
            armed.append(c.arm(1, Trigger(TriggerSource.SOFTWARE, s.timeout_s)))
        for a in armed:
            a.trigger()
        for c, a in zip(cameras, armed, strict=True):
            try:
                frame = next(iter(a))
            except (DeviceTimeoutError, StopIteration) as e:
                raise IncompleteShotError(f"{c.info.uri}: no picture came; check the camera and look again") from e
            if not frame.complete:
                raise IncompleteShotError(f"{c.info.uri}: the picture came incomplete; look again")
            out.append(frame.pixels)
    finally:
        for a in armed:
            a.cancel()
        if light is not None:
            light.set(before)
    return tuple(out)


def label(key: FrameKey) -> str:
    """A frame's name for people: "set 1 step 3"."""
    return f"set {key.set_index + 1} {key.role.value} {key.number}"


def _check(cameras: Sequence[Camera], images: Sequence[object], plan: PatternPlan) -> None:
    if not len(cameras) == len(images) == len(plan.views):
        raise CaptureError(
            f"{len(cameras)} cameras and images for {len(images)} views; the plan has {len(plan.views)} views"
        )


def _expect(acquisition: Acquisition, keys: tuple[FrameKey, ...], camera: Camera) -> Iterator[Frame]:
    """The frames of an acquisition; one that ends early names what is missing."""
    n = 0
    try:
        for frame in acquisition:
            n += 1
            yield frame
    except DeviceTimeoutError as e:
        raise IncompleteShotError(_short(camera, keys, n)) from e
    if n < len(keys):
        raise IncompleteShotError(_short(camera, keys, n))


def _short(camera: Camera, keys: tuple[FrameKey, ...], n: int) -> str:
    return (
        f"{camera.info.uri}: {n} frames came; the plan needs {len(keys)}: missing from {label(keys[n])} on, "
        "or a trigger before it was lost: check the trigger line and take the shot again"
    )


class _Proof:
    """Watches one view's frames go by and raises as soon as one is not what it should be."""

    def __init__(self, view: ViewPlan, camera: Camera, period_ns: int, s: CaptureSettings) -> None:
        self._view, self._camera, self._period, self._s = view, camera, period_ns, s
        self._first: Frame | None = None
        self._count = 0
        self._samples: dict[int, list[AnyArray]] = {}

    def _fail(self, what: str) -> IncompleteShotError:
        return IncompleteShotError(f"{self._camera.info.uri}: {what}; take the shot again")

    def add(self, key: FrameKey, frame: Frame) -> None:
        first = self._first = self._first or frame
        n, self._count = self._count, self._count + 1
        if frame.block_id != first.block_id + n:
            gap = frame.block_id - first.block_id - n
            names = ", ".join(label(k) for k in self._view.keys[n : n + max(gap, 0)])
            raise self._fail(
                f"frame lost: {names}" if gap > 0 else f"block {frame.block_id} came twice or out of order"
            )
        if not frame.complete:
            raise self._fail(f"{label(key)} came incomplete")
        if frame.device_ns is not None and first.device_ns is not None:
            off = (frame.device_ns - first.device_ns) / self._period - n
            if abs(off) > self._s.timing_tolerance:
                why = "a trigger was missed" if off > 0.75 else "the exposure was late" if off > 0 else "it came early"
                raise self._fail(f"{label(key)} lies {off:+.2f} periods from its pattern: {why}")
        c = self._camera.info
        expected = (c.height, c.width) if self._camera.settings.roi is None else self._camera.settings.roi[:1:-1]
        if frame.pixels.shape[:2] != expected or frame.pixels.dtype != self._view.pixel_format.dtype:
            raise self._fail(
                f"{label(key)} is {frame.pixels.shape} {frame.pixels.dtype}; "
                f"needed {expected} {self._view.pixel_format.dtype}"
            )
        spec = self._view.sets[key.set_index]
        if isinstance(spec, FringeSet) and key.role is Role.STEP and spec.steps >= 4:
            kept = self._samples.setdefault(key.set_index, [])
            kept.append(_thin(frame.pixels))
            if len(kept) == spec.steps:
                self._content(key.set_index, spec, np.stack(self._samples.pop(key.set_index)), frame)

    def _content(self, index: int, spec: FringeSet, samples: AnyArray, frame: Frame) -> None:
        if samples.shape[1] < 100:
            return
        modulation, energy = wrong_frames(samples, float(frame.pixel_format.max_value))
        if modulation == 0:
            return
        worst = int(energy.argmax())
        limit = self._s.max_wrong_frame * modulation
        # a bent response spreads its misfit over all frames, and never so much; a wrong frame keeps most to itself
        alone = spec.steps > 4 and energy[worst] > 2.0 * np.median(energy)
        if (alone and energy[worst] > limit**2) or energy.mean() > (2.0 * limit) ** 2:
            names = label(FrameKey(index, Role.STEP, worst)) if alone else f"one of set {index + 1}"
            raise self._fail(f"{names} shows another pattern than the plan's: repeated or swapped")

    def end(self, surplus: int) -> None:
        if surplus:
            raise self._fail(f"{surplus} frames more than the {len(self._view.keys)} patterns came")


def _thin(pixels: AnyArray) -> AnyArray:
    """Pairs of like-coloured neighbours (m, 2) on a coarse lattice of a frame."""
    h, w = pixels.shape[:2]
    step = max(4, int(np.sqrt(h * w / _SAMPLES)) // 2 * 2)
    a, b = pixels[:h:step, : w - 2 : step], pixels[:h:step, 2::step]
    n = min(a.shape[1], b.shape[1])
    return np.stack([a[:, :n].reshape(-1), b[:, :n].reshape(-1)], 1)


def wrong_frames(samples: AnyArray, full_scale: float) -> tuple[float, F64]:
    """How much of each frame's misfit is not noise: what neighbouring pixels share.

    `samples` (N, m, 2): pairs of neighbouring pixels in the N frames of a set, N >= 4. Returns the typical modulation
    in codes (0: nothing lit) and, per frame, the shared misfit in codes squared (N,) after mean and first harmonic are
    fitted.
    """
    x = samples.astype(np.float64)
    n = len(x)
    a = 2 * np.pi * np.arange(n) / n
    basis = np.stack([np.ones(n), np.cos(a) * np.sqrt(2), np.sin(a) * np.sqrt(2)])
    fit = np.tensordot(basis, x, 1) / n
    rest = x - np.tensordot(basis.T, fit, 1)
    modulation = np.sqrt(2) * np.hypot(fit[1], fit[2]).min(1)
    lit = (modulation > max(4.0 * full_scale / 255, 0.3 * np.percentile(modulation, 95))) & (x.max((0, 2)) < full_scale)
    if lit.sum() < 100:
        return 0.0, np.zeros(n)
    return float(np.median(modulation[lit])), np.maximum((rest[:, lit, 0] * rest[:, lit, 1]).mean(1), 0.0)
