"""Somebody's loose images: files in natural order, or a stack's pages, as frames of a plan."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fringescope.errors import CaptureError, UsageError
from fringescope.store.files import CAPTURE
from fringescope.store.images import Images, check_frame, quiet, stack_axes
from fringescope.types import (
    AnyArray,
    FrameKey,
    FringeSet,
    GraySet,
    Layout,
    PixelFormat,
    ViewPlan,
    plane_size,
)

READ_BY_STORE = (".png", ".tif", ".tiff")
READ_BY_OPENCV = (".bmp", ".pgm", ".ppm", ".jpg", ".jpeg", ".webp")
LOSSY = (".jpg", ".jpeg", ".webp")


@dataclass(frozen=True)
class Gray:
    """Gray-code frames that follow the fringe frames: white and black first where they exist, then the bits.

    `inverse`: "none", "pairs" (bit, its inverse, bit ..) or "after" (all bits, then all inverse).
    """

    axis: str
    cell: float
    bits: int
    inverse: str = "none"
    white_black: bool = False

    def __post_init__(self) -> None:
        if self.inverse not in ("none", "pairs", "after"):
            raise UsageError(f"--gray-inverse {self.inverse}; needed none, pairs or after")

    @property
    def set(self) -> GraySet:
        """As a set of a plan."""
        return GraySet(self.axis, self.cell, self.bits, self.inverse != "none", self.white_black, self.white_black)

    @property
    def order(self) -> list[int]:
        """Which file, counted from the first of this code, each frame of `ViewPlan.keys` is."""
        n, first = self.bits, 2 if self.white_black else 0
        out = list(range(first))
        for k in range(n):
            out.append(first + (2 * k if self.inverse == "pairs" else k))
            if self.inverse != "none":
                out.append(first + (2 * k + 1 if self.inverse == "pairs" else n + k))
        return out


@dataclass(frozen=True)
class Recipe:
    """What somebody says about the images: sets in the order of the files.

    `steps` and `periods` have one entry per set (one entry of `steps` serves all); `directions` are unit gradients on
    the projector plane, the list of periods repeats for each. `interleaved`: files hold step 0 of every set, then
    step 1 .. `step_order` picks a set's files in another order (empty: as they come). Then file j of a set shows
    `A + B cos(Phi - first_phase - 2 pi j / N)`, or with `+ 2 pi j / N` for the sets named in `reverse`.
    """

    steps: tuple[int, ...]
    periods: tuple[float, ...]
    directions: tuple[tuple[float, float], ...] = ((1.0, 0.0),)
    projector: tuple[int, int] = (912, 1140)
    layout: Layout = Layout.GRID
    interleaved: bool = False
    step_order: tuple[int, ...] = ()
    reverse: tuple[int, ...] = ()
    first_phase_deg: float = 0.0
    gray: Gray | None = None

    @property
    def sets(self) -> tuple[FringeSet, ...]:
        """The fringe sets, in the order of the files. Raises UsageError where the numbers do not fit each other."""
        n = len(self.periods) * len(self.directions)
        if len(self.steps) not in (1, len(self.periods), n):
            raise UsageError(f"--steps: {len(self.steps)} entries, --periods: {len(self.periods)}; needed as many")
        steps = self.steps if len(self.steps) == n else self.steps * (n // len(self.steps))
        out = []
        for i, (d, p) in enumerate((d, p) for d in self.directions for p in self.periods):
            if not (math.isfinite(p) and p > 1):
                raise UsageError(f"--periods {p:g}; needed more than one projector-plane unit")
            if steps[i] < 3:
                raise UsageError(f"--steps {steps[i]}; phase shifting needs at least 3")
            out.append(FringeSet((d[0] / p, d[1] / p), steps[i]))
        return tuple(out)

    def reversed(self) -> Recipe:
        """The same with the steps of every set running the other way."""
        return replace(self, reverse=tuple(i for i in range(len(self.sets)) if i not in self.reverse))

    @property
    def files_needed(self) -> int:
        """Images that the recipe takes."""
        return sum(s.steps for s in self.sets) + (0 if self.gray is None else len(self.gray.order))

    def of_set(self, i: int) -> list[int]:
        """Which files frames 0 .. N-1 of fringe set i are, counted from 0."""
        sets = self.sets
        if self.interleaved:
            if len({s.steps for s in sets}) != 1:
                raise UsageError("--order interleaved needs sets of equally many steps")
            mine = [i + len(sets) * n for n in range(sets[i].steps)]
        else:
            start = sum(s.steps for s in sets[:i])
            mine = list(range(start, start + sets[i].steps))
        n = sets[i].steps
        if self.step_order:
            if sorted(self.step_order) != list(range(n)):
                came = ",".join(map(str, self.step_order))
                raise UsageError(f"--step-order {came}; needed each of 0 to {n - 1} once")
            mine = [mine[k] for k in self.step_order]
        first = self.first_phase_deg * n / 360
        if not math.isfinite(first) or abs(first - round(first)) > 1e-6:
            raise UsageError(f"--first-phase {self.first_phase_deg:g}; needed a multiple of {360 / n:g} degrees")
        m = round(first)
        return [mine[(m - k) % n if i in self.reverse else (k - m) % n] for k in range(n)]

    def plan(self, camera: str, fmt: PixelFormat) -> ViewPlan:
        """The plan of a view."""
        extra = () if self.gray is None else (self.gray.set,)
        return ViewPlan(camera, fmt, (*self.sets, *extra), plane_size(*self.projector, self.layout))

    def order(self) -> list[int]:
        """Which file each frame of `ViewPlan.keys` is, counted from 0."""
        out = [f for i in range(len(self.sets)) for f in self.of_set(i)]
        if self.gray is not None:
            start = len(out)
            out += [start + k for k in self.gray.order]
        return out


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which frame2 comes before frame10."""
    return [(int(t), "") if t.isdigit() else (-1, t.casefold()) for t in re.split(r"(\d+)", name)]


def image_files(folder: Path, pattern: str = "*") -> list[Path]:
    """The images of a folder in natural order. Raises CaptureError where the folder cannot be read."""
    known = READ_BY_STORE + READ_BY_OPENCV
    try:
        found = [p for p in folder.glob(pattern) if p.suffix.lower() in known and p.is_file() and p.name[0] != "."]
    except (OSError, ValueError, NotImplementedError) as e:
        raise CaptureError(f"{folder}: cannot list the images: {e}") from e
    return sorted(found, key=lambda p: natural(p.name))


class LooseFrames:
    """Images (files, or pages of a stack) read as frames of one pixel format; each is checked as it is read."""

    def __init__(
        self, folder: Path, names: Sequence[str], *, left_aligned: int = 0, fmt: PixelFormat | None = None
    ) -> None:
        self.folder, self.names, self.left_aligned = folder, list(names), left_aligned
        self._images = Images(folder)
        first = self.raw(0)
        self.size = (first.shape[1], first.shape[0])
        self.fmt = fmt or self._guess(first)

    def _guess(self, a: AnyArray) -> PixelFormat:
        if a.ndim == 3 and a.shape[2] >= 3 and a.dtype == np.uint8 and not (a[..., :1] == a[..., :3]).all():
            return PixelFormat.RGB8
        return PixelFormat.MONO8 if a.dtype == np.uint8 else PixelFormat.MONO16

    def raw(self, i: int) -> AnyArray:
        """Image i as stored. Raises CaptureError."""
        name = self.names[i]
        if Path(name).suffix.lower() in READ_BY_OPENCV:
            try:
                data = np.fromfile(self.folder / name, np.uint8)
                with quiet():
                    a = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
            except (OSError, cv2.error) as e:
                raise CaptureError(f"{self.folder / name}: cannot read: {str(e).splitlines()[0]}") from e
            if a is None:
                raise CaptureError(f"{self.folder / name}: truncated or not an image; copy it again from the camera")
            return np.ascontiguousarray(a if a.ndim == 2 else a[:, :, 2::-1])
        return self._images.raw(name)

    def __getitem__(self, i: int) -> AnyArray:
        a = self.raw(i)
        if self.left_aligned:
            a = a >> self.left_aligned
        return check_frame(a, self.fmt, self.size, str(self.folder / self.names[i]))

    def __len__(self) -> int:
        return len(self.names)

    def digest(self) -> str:
        """sha256 of the first image's file, hexadecimal."""
        return self._images.digest(self.names[0])


class RecipeFrames:
    """Frames of a plan out of loose images, in the order of `plan.keys`; may be iterated again."""

    def __init__(self, images: LooseFrames, recipe: Recipe, plan: ViewPlan) -> None:
        self._images, self._order, self._plan = images, recipe.order(), plan

    def __iter__(self) -> Iterator[tuple[FrameKey, AnyArray]]:
        for key, i in zip(self._plan.keys, self._order, strict=True):
            yield key, self._images[i]


# -------------------------------------------------------------------------------------------------------------- stacks


@dataclass(frozen=True)
class Stack:
    """Pages of a multi-page TIFF that are the frames, in order; and what had to be chosen to find them."""

    path: Path
    names: tuple[str, ...]
    note: str


def the_stack(path: Path) -> Path | None:
    """The TIFF stack that somebody means: the file itself, or the only stack in a folder without capture.json.

    None where there is none: `path` is a capture, or nothing. Raises CaptureError where the folder holds several.
    """
    if not path.is_dir():
        return path if path.suffix.lower() in (".tif", ".tiff") else None
    if (path / CAPTURE).exists():
        return None
    tiffs = [p for p in image_files(path) if p.suffix.lower() in (".tif", ".tiff")]
    stacks = [p for p in tiffs if stack_axes(p)[1] > 1]
    if len(stacks) > 1:
        names = ", ".join(p.name for p in stacks[:8]) + (" .." if len(stacks) > 8 else "")
        raise CaptureError(f"{path}: no {CAPTURE}, and {len(stacks)} TIFF stacks ({names}); needed one: name its file")
    return stacks[0] if stacks else None


def stack_pages(path: Path, needed: int | None, axis: str | None, time: int | None) -> Stack:
    """The pages of an (ImageJ) stack along `axis`, of one `time` (default 0).

    `needed`: how many frames the recipe takes; None: as many as the axis has. Without `axis` the frames lie along the
    one axis besides time, y and x, or along the pages. Raises CaptureError or UsageError, naming the stack's axes.
    """
    sizes, pages = stack_axes(path)
    told = " x ".join(f"{a} {n}" for a, n in sizes.items()) or "one page"
    if math.prod(sizes.values()) != pages:
        raise CaptureError(f"{path}: {pages} pages for axes {told}; needed a page per picture: save it as plain pages")
    if axis is None:
        along = [a for a in sizes if a != "T" and sizes[a] > 1] or [a for a in sizes if sizes[a] > 1]
        if len(along) != 1:
            raise UsageError(f"{path}: axes {told}; say along which the steps lie, as in --axis Z")
        axis = along[0]
    axis = axis.upper()
    if axis not in sizes:
        raise UsageError(f"{path}: no axis {axis}; it has {told}")
    others = [a for a in sizes if a != axis and sizes[a] > 1]
    if others not in ([], ["T"]):
        raise UsageError(f"{path}: axes {told}; needed only {axis} and time T: split the stack first")
    n = sizes[axis]
    needed = n if needed is None else needed
    if n != needed and (others or n % needed):
        raise CaptureError(f"{path}: {n} pictures along {axis}, the sets need {needed}; mend --steps or --axis")
    times = sizes["T"] if others else n // needed
    time_ = 0 if time is None else time
    if not 0 <= time_ < times:
        raise UsageError(f"{path}: --time {time_}; needed 0 to {times - 1}")
    grid = np.arange(pages).reshape(tuple(sizes.values()))
    if others:
        picked = np.moveaxis(grid, (list(sizes).index("T"), list(sizes).index(axis)), (0, 1)).reshape(times, n)[time_]
    else:
        picked = grid.ravel()[time_ * needed : (time_ + 1) * needed]
    note = f"{path.name}: axes {told}; steps along {axis}"
    if times > 1:
        note += f"; time {time_} of 0 to {times - 1}" + (" (choose with --time)" if time is None else "")
    return Stack(path, tuple(f"{path.name}#{int(p)}" for p in picked), note)
