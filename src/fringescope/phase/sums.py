"""Frames into sums, one by one: N-step sets to least-squares sinusoids, Gray codes to cell numbers (equations 3, 4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fringescope.errors import CaptureError
from fringescope.kernels import fringes as k
from fringescope.kernels import raw
from fringescope.types import (
    F32,
    F64,
    AnyArray,
    FrameKey,
    FringeSet,
    GrayCode,
    GraySet,
    NoiseModel,
    PixelFormat,
    Role,
    ViewPlan,
)


def unpacked(frame: AnyArray, pixel_format: PixelFormat) -> AnyArray:
    """A frame with one sample per element: packed 12-bit frames (H, W / 2, 3) become (H, W) uint16."""
    if not pixel_format.packs(frame):
        return frame
    out = np.empty((frame.shape[0], 2 * frame.shape[1]), np.uint16)
    raw.unpack_frame(np.ascontiguousarray(frame), out)
    return out


def thinned(frame: AnyArray, pixel_format: PixelFormat, every: int) -> AnyArray:
    """Every so many-th row and column of a frame (H, W), unpacked."""
    return unpacked(frame[::every], pixel_format)[:, ::every]


def intensity(frame: AnyArray, pixel_format: PixelFormat) -> AnyArray:
    """One sample per pixel: raw Bayer and mono frames as they are, RGB as the sum of its channels (uint16).

    A pixel with one saturated channel counts as saturated: it gets the largest sum. Raises CaptureError if the frame is
    not (H, W), or (H, W, 3) for RGB, is empty, or holds neither unsigned integers nor floating-point numbers.
    """
    if frame.dtype.kind not in "uf" or frame.size == 0:
        raise CaptureError(f"a frame of shape {frame.shape}, {frame.dtype}; needed pixels, as uint8 or uint16")
    if not frame.dtype.isnative:
        frame = frame.astype(frame.dtype.newbyteorder("="))
    frame = unpacked(frame, pixel_format)
    rgb = pixel_format is PixelFormat.RGB8
    if frame.ndim != (3 if rgb else 2) or (rgb and frame.shape[2] != 3):
        needed = "(H, W, 3)" if rgb else "(H, W)"
        raise CaptureError(f"a frame of shape {frame.shape}; {pixel_format.value} needs {needed}")
    if not rgb:
        return np.ascontiguousarray(frame)
    total: AnyArray = frame.astype(np.uint16).sum(axis=2, dtype=np.uint16)
    total[(frame >= pixel_format.max_value).any(axis=2)] = 3 * pixel_format.max_value
    return total


def mean_picture(frames: Iterable[tuple[FrameKey, AnyArray]], plan: ViewPlan) -> F32:
    """The mean (H, W) of all steps of all fringe sets, codes: the scene without fringes (all frames if none)."""
    steps, others = [np.zeros((0, 0), np.float32)] * 2
    n = m = 0
    for key, frame in frames:
        light = intensity(frame, plan.pixel_format)
        if key.role is Role.STEP:
            steps, n = (steps + light if n else light.astype(np.float32)), n + 1
        elif not n:
            others, m = (others + light if m else light.astype(np.float32)), m + 1
    return np.asarray(steps / np.float32(n) if n else others / np.float32(max(m, 1)))


@dataclass(frozen=True, eq=False)
class Measured:
    """One N-step set, fitted, before the noise is known. Arrays (H, W); `variance` is NaN where no sample is left over.

    `poor` lists the pixels that kept two samples only, as flat indices with their sums of I cos and I sin: no sinusoid
    of its own fits there, but one with the background of a finer set does (see `rescue`).
    """

    fringe_set: FringeSet
    phase: F32
    background: F32
    modulation: F32
    variance: F32
    clipped: AnyArray  #: uint64, bit n = sample n was saturated
    poor: tuple[AnyArray, AnyArray, AnyArray]
    lent: AnyArray | None = None  #: true where the background is another set's

    @property
    def steps(self) -> int:
        """N."""
        return self.fringe_set.steps


class FringeSums:
    """Accumulator of one N-step set: `add` its frames in any order, then `finish`. Holds sums, never frames."""

    def __init__(self, fringe_set: FringeSet, max_value: int) -> None:
        self.fringe_set = fringe_set
        self.max_value = max_value
        self._seen: set[int] = set()
        self._sums: list[F32 | F64] = []
        self._clipped = np.zeros((0, 0), np.uint64)

    def add(self, n: int, frame: AnyArray) -> None:
        """Add frame n, (H, W) unsigned integers. Raises CaptureError for a second frame n or another size."""
        N = self.fringe_set.steps
        if n in self._seen or not 0 <= n < N:
            raise CaptureError(f"frame {n} of a {N}-step set came twice or is out of range; each of 0..{N - 1} once")
        if not self._sums:
            kind = np.float32 if self.max_value < 1024 else np.float64
            self._sums = [np.zeros(frame.shape, kind) for _ in range(4)]
            self._clipped = np.zeros(frame.shape, np.uint64)
        if frame.shape != self._clipped.shape:
            raise CaptureError(
                f"frame {n} is {frame.shape[1]} x {frame.shape[0]} pixels; the set began with "
                f"{self._clipped.shape[1]} x {self._clipped.shape[0]}"
            )
        delta = 2 * math.pi * n / N
        k.accumulate(frame, n, math.cos(delta), math.sin(delta), self.max_value, *self._sums, self._clipped)
        self._seen.add(n)

    @property
    def complete(self) -> bool:
        """Whether every frame has come."""
        return len(self._seen) == self.fringe_set.steps

    def finish(self) -> Measured:
        """The least-squares sinusoid of each pixel's unsaturated samples.

        Where all are saturated the background is full scale. Raises CaptureError if frames are missing.
        """
        N = self.fringe_set.steps
        missing = sorted(set(range(N)) - self._seen)
        if missing:
            raise CaptureError(f"a {N}-step set got {len(self._seen)} frames; missing {missing}")
        shape = self._clipped.shape
        phase, background, modulation, variance = (np.empty(shape, np.float32) for _ in range(4))
        k.wrap(*self._sums, self._clipped, N, phase, background, modulation, variance)
        background[np.isinf(background)] = self.max_value
        index = np.flatnonzero(_left(self._clipped, N) == 2) if (self._clipped != 0).any() else np.zeros(0, np.intp)
        poor = (index, self._sums[1].ravel()[index], self._sums[2].ravel()[index])
        self._sums = []
        return Measured(self.fringe_set, phase, background, modulation, variance, self._clipped, poor)


def _left(clipped: AnyArray, steps: int) -> AnyArray:
    """Samples of each pixel that are not saturated."""
    return np.asarray(steps - np.bitwise_count(clipped).astype(np.int64))


def rescue(measured: Sequence[Measured]) -> list[Measured]:
    """Two samples and the background of the set that has most samples left make a phase that tells the order."""
    out = []
    for m in measured:
        index, p, q = m.poor
        if len(index) == 0 or len(measured) == 1:
            out.append(m)
            continue
        left = np.stack([_left(o.clipped.ravel()[index], o.steps) for o in measured])
        exposure = [o.fringe_set.exposure_us == m.fringe_set.exposure_us for o in measured]
        left[~np.array(exposure)] = 0
        donor = left.argmax(0)
        A = np.choose(donor, [o.background.ravel()[index] for o in measured]).astype(np.float64)
        good = left.max(0) > 3
        n = np.arange(m.steps)
        there = ((m.clipped.ravel()[index][:, None] >> n.astype(np.uint64)) & np.uint64(1)) == 0
        cos, sin = np.cos(2 * np.pi * n / m.steps), np.sin(2 * np.pi * n / m.steps)
        m11, m12, m22 = there @ (cos * cos), there @ (cos * sin), there @ (sin * sin)
        p, q = p - A * (there @ cos), q - A * (there @ sin)
        det = m11 * m22 - m12 * m12
        good &= det > 1e-9
        index, A, det = index[good], A[good], det[good]
        c = (m22[good] * p[good] - m12[good] * q[good]) / det
        s = (m11[good] * q[good] - m12[good] * p[good]) / det
        phase, background, modulation = m.phase.copy(), m.background.copy(), m.modulation.copy()
        phase.ravel()[index] = np.arctan2(s, c)
        background.ravel()[index] = A
        modulation.ravel()[index] = np.hypot(c, s)
        lent = np.zeros(m.phase.shape, bool)
        lent.ravel()[index] = True
        out.append(replace(m, phase=phase, background=background, modulation=modulation, lent=lent))
    return out


class GrayBits:
    """Accumulator of one Gray code; frames in any order, kept until `finish` (they are few)."""

    def __init__(self, gray_set: GraySet) -> None:
        self.gray_set = gray_set
        self._frames: dict[tuple[Role, int], AnyArray] = {}

    def add(self, role: Role, n: int, frame: AnyArray) -> None:
        """Add one frame (H, W). Raises CaptureError for a second one of its kind or another size."""
        if (role, n) in self._frames:
            raise CaptureError(f"{role.value} frame {n} of a Gray code came twice; each once")
        for other in self._frames.values():
            if other.shape != frame.shape:
                raise CaptureError(
                    f"a Gray code frame is {frame.shape[1]} x {frame.shape[0]} pixels; the set began with "
                    f"{other.shape[1]} x {other.shape[0]}"
                )
            break
        self._frames[role, n] = frame

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W) of the frames that came."""
        return next((f.shape for f in self._frames.values()), (0, 0))

    def finish(self, noise: NoiseModel) -> GrayCode:
        """Decode: each bit against its inverse, or the mean of white and black, or the mean of all bits.

        Raises CaptureError if frames that the set promises are missing.
        """
        s, f = self.gray_set, self._frames
        needed = [(Role.BIT, n) for n in range(s.bits)]
        needed += [(Role.INVERSE, n) for n in range(s.bits)] if s.inverse else []
        needed += [(role, 0) for role, there in ((Role.WHITE, s.white), (Role.BLACK, s.black)) if there]
        missing = ", ".join(f"{role.value} {n}" for role, n in needed if (role, n) not in f)
        if missing:
            raise CaptureError(f"a Gray code of {s.bits} bits got {len(f)} of {len(needed)} frames; missing {missing}")
        first = f[Role.BIT, 0]
        none = np.zeros((0, 0), first.dtype)
        if (Role.WHITE, 0) in f and (Role.BLACK, 0) in f:
            threshold = 0.5 * (f[Role.WHITE, 0].astype(np.float32) + f[Role.BLACK, 0].astype(np.float32))
        else:
            bits = [f[Role.BIT, n].astype(np.float32) for n in range(s.bits)]
            threshold = 0.5 * (np.maximum.reduce(bits) + np.minimum.reduce(bits))
        code = np.zeros(first.shape, np.int32)
        contrast = np.zeros(first.shape, np.float32)
        level = math.sqrt(float(noise.variance(np.median(threshold))))
        for n in range(s.bits):
            inverse = f.get((Role.INVERSE, n), none)
            k.gray_bit(f[Role.BIT, n], inverse, threshold.astype(np.float32), 2.0 * level, n, code, contrast)
        self._frames = {}
        return GrayCode(s.axis, s.cell, code, contrast)
