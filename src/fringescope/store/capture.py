"""capture.json and its frames: a folder to `ViewInput`s whose frames are read one at a time, and back."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from fringescope.errors import CaptureError, RigError
from fringescope.store import files
from fringescope.store.images import Images, check_frame, check_header, split_page, write_png
from fringescope.store.rig import parse_layout, read_model
from fringescope.store.spool import Spool
from fringescope.types import (
    AnyArray,
    FrameKey,
    FringeSet,
    GraySet,
    Layout,
    NoiseModel,
    PatternPlan,
    PixelFormat,
    Response,
    Rig,
    Role,
    ViewInput,
    ViewPlan,
    plane_size,
)

FORMAT, VERSION = "fringescope-capture", 1
LEAST_CYCLES = 1e-9  #: per projector-plane unit; less is no fringe
LITTLE = 50_000_000  #: pixels of all frames of a capture that may be read ahead
READERS = 4  #: threads that do it
LEAST_SIDE = 2  #: rows and columns of a frame: a pixel is judged by its neighbours


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True, allow_inf_nan=False)


class _Noise(_Model):
    a: float = Field(ge=0)
    b: float = Field(ge=0)


class _Projector(_Model):
    width: int = Field(ge=1, le=1_000_000)
    height: int = Field(ge=1, le=1_000_000)
    layout: str = "grid"


class _Set(_Model):
    frames: list[str] = Field(max_length=1000)
    cycles_per_pixel: list[float] | None = None
    steps: int | None = None
    exposure_us: float | None = Field(default=None, gt=0)
    gray: str | None = None
    cell: float | None = None
    inverse: list[str] | None = None
    white: str | None = None
    black: str | None = None


class _View(_Model):
    camera: str
    pixel_format: str
    sets: list[_Set] = Field(max_length=1000)
    color: str | None = None
    noise: _Noise | None = None


class _Capture(_Model):
    format: str
    version: int
    projector: _Projector
    views: list[_View] = Field(min_length=1, max_length=254)
    noise: _Noise | None = None


@dataclass(frozen=True, eq=False)
class CaptureView:
    """One camera of a capture: its plan, the files of `plan.keys` in that order, and what else its entry says."""

    plan: ViewPlan
    files: tuple[str, ...]  #: relative to the capture's folder; "file.tif#3" names a page
    size: tuple[int, int]  #: (width, height) of every frame
    color: str | None = None
    noise: NoiseModel | None = None

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self.plan.camera


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture on disk. Frames are read when asked for, one at a time."""

    folder: Path
    document: Path  #: its capture.json
    projector_width: int  #: device pixels
    projector_height: int
    layout: Layout
    views: tuple[CaptureView, ...]
    extra: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))  #: keys that we do not use
    images: Images = field(repr=False, kw_only=True)

    def view(self, camera: str) -> CaptureView:
        """The view of `camera`. Raises CaptureError if the capture lacks it."""
        for v in self.views:
            if v.camera == camera:
                return v
        raise CaptureError(f"{self.document}: no view of '{camera}'; it has {', '.join(v.camera for v in self.views)}")

    def only(self, cameras: Sequence[str]) -> Capture:
        """The capture with the views of some cameras alone, in its own order. Raises as `view`."""
        names = {self.view(c).camera for c in cameras}
        return replace(self, views=tuple(v for v in self.views if v.camera in names))


class Frames:
    """The frames of one view, (key, array) in the order of `plan.keys`, read one at a time; may be iterated again."""

    def __init__(self, capture: Capture, view: CaptureView) -> None:
        self._capture, self._view = capture, view
        self._ahead: list[Future[AnyArray]] = []

    def __len__(self) -> int:
        return len(self._view.files)

    def __iter__(self) -> Iterator[tuple[FrameKey, AnyArray]]:
        images = Images(self._capture.folder)  # its own, so that views may be read in parallel
        view, ahead, self._ahead = self._view, self._ahead, []
        for n, (key, name) in enumerate(zip(view.plan.keys, view.files, strict=True)):
            yield key, ahead[n].result() if ahead else self._read(name, images)

    def _read(self, name: str, images: Images) -> AnyArray:
        frame = images.frame(name, self._view.plan.pixel_format, self._view.size)
        self._capture.images.digests.update(images.digests)
        return frame

    def read_ahead(self, pool: Executor) -> None:
        """Let the pool read the frames for the next who iterates, who gets its errors; pages of a TIFF it leaves."""
        if not self._ahead and all(split_page(name)[1] is None for name in self._view.files):
            folder = self._capture.folder
            self._ahead = [pool.submit(self._read, name, Images(folder)) for name in self._view.files]

    def __getitem__(self, key: FrameKey) -> AnyArray:
        view, images = self._view, Images(self._capture.folder)
        return images.frame(view.files[view.plan.keys.index(key)], view.plan.pixel_format, view.size)


class RowedFrames(Frames):
    """As `Frames`, of which some rows can be had: from where they lie in files of plain samples (TIFF without
    compression), from a temporary file for others, which are decoded once for it.
    """

    def __init__(self, capture: Capture, view: CaptureView) -> None:
        super().__init__(capture, view)
        self._spool: Spool | None = None

    def rows(self, first: int, last: int) -> Iterator[tuple[FrameKey, AnyArray]]:
        """Rows first to last - 1 of each frame. Raises as reading a frame does, and OutputError as `Spool`."""
        view, images = self._view, Images(self._capture.folder)
        plain = [images.plain(name) for name in view.files]
        frames = list(zip(view.plan.keys, view.files, plain, strict=True))
        if self._spool is None:
            self._spool = Spool((key, self._read(name, images)) for key, name, lies in frames if lies is None)
        spooled = self._spool.rows(first, last)
        for key, name, lies in frames:
            if lies is None:
                yield next(spooled)
                continue
            some = lies.rows(first, last)
            size = view.size if len(some) == lies.height else None
            yield key, check_frame(some, view.plan.pixel_format, size, str(images.folder / name))


# ------------------------------------------------------------------------------------------------------------ reading


def read_capture(path: Path | str) -> Capture:
    """The capture in a folder, or of a `capture.json`.

    Checks everything short of the samples: keys, versions, that each frame's file is there, and that its size, bits
    and channels fit the view. File names must stay inside the folder. Raises FormatError for the document, CaptureError
    for plans and frames.
    """
    capture, lost = read_usable(path)
    for why in lost.values():
        raise CaptureError(why)
    return capture


def read_usable(path: Path | str) -> tuple[Capture, dict[str, str]]:
    """As `read_capture`, less the views of which a frame is missing or does not fit; these by name, with the reason."""
    path = Path(path)
    document = path / files.CAPTURE if path.is_dir() else path
    m = read_model(document, "a capture (a folder with capture.json)", FORMAT, VERSION, _Capture)
    p = m.projector
    layout = parse_layout(p.layout, document)
    images = Images(document.parent)
    size = plane_size(p.width, p.height, layout)
    views: list[CaptureView] = []
    lost: dict[str, str] = {}
    for i, v in enumerate(m.views):
        plan, named = _plan(v, i, size, document)
        try:
            views.append(_view(v, plan, named, v.noise or m.noise, f"{document}: views[{i}]", images))
        except CaptureError as e:
            lost[v.camera] = str(e)
    names = [v.camera for v in m.views]
    if len(set(names)) != len(names):
        raise CaptureError(f"{document}: cameras {', '.join(names)}: not unique; needed one view per camera")
    extra = MappingProxyType(dict(m.model_extra or {}))
    return Capture(document.parent, document, p.width, p.height, layout, tuple(views), extra, images=images), lost


def _plan(m: _View, i: int, size: tuple[int, int], document: Path) -> tuple[ViewPlan, tuple[str, ...]]:
    """The plan of a view and the files of its frames, whether they are there or not."""
    where = f"{document}: views[{i}]"
    if bad := files.check_name(m.camera):
        raise CaptureError(f"{where}.camera {files.shown(m.camera)}: {bad}")
    try:
        fmt = PixelFormat(m.pixel_format)
    except ValueError:
        known = ", ".join(f.value for f in PixelFormat)
        raise CaptureError(f"{where}.pixel_format {files.shown(m.pixel_format)}; needed one of {known}") from None
    sets: list[FringeSet | GraySet] = []
    names: list[str] = []
    for k, s in enumerate(m.sets):
        try:
            one, of_set = _set(s)
        except CaptureError as e:
            raise CaptureError(f"{where}.sets[{k}]: {e}") from None
        if len(set(of_set)) != len(of_set):
            twice = next(n for n in of_set if of_set.count(n) > 1)
            raise CaptureError(f"{where}.sets[{k}]: frame {files.shown(twice)} is named twice")
        sets.append(one)
        names += of_set
    try:
        plan = ViewPlan(m.camera, fmt, tuple(sets), size)
    except CaptureError as e:
        raise CaptureError(f"{where}: {e}") from None
    every = names if m.color is None else [*names, m.color]
    for n in every:
        if bad := files.check_relative(n):
            raise CaptureError(f"{where}: frame {files.shown(n)}: {bad}")
    return plan, tuple(names)


def _view(
    m: _View, plan: ViewPlan, names: tuple[str, ...], noise: _Noise | None, where: str, images: Images
) -> CaptureView:
    every = names if m.color is None else (*names, m.color)
    view_size: tuple[int, int] | None = None
    for n in every:
        head = images.header(n)
        check_header(head, plan.pixel_format, view_size, str(images.folder / n))
        view_size = view_size or (head.width, head.height)
    model = None if noise is None else NoiseModel(noise.a, noise.b, files.CAPTURE)
    assert view_size is not None  # a plan has at least one frame
    if min(view_size) < LEAST_SIDE:
        came = f"frames of {view_size[0]} x {view_size[1]} pixels"
        raise CaptureError(f"{where}: {came}; needed at least {LEAST_SIDE} rows and columns of an area camera")
    return CaptureView(plan, names, view_size, m.color, model)


def _set(s: _Set) -> tuple[FringeSet | GraySet, list[str]]:
    if (s.gray is None) == (s.cycles_per_pixel is None):
        raise CaptureError('needed either "cycles_per_pixel" (fringes) or "gray" (Gray code)')
    if s.gray is not None:
        if s.cell is None:
            raise CaptureError('a Gray code without "cell"; needed the width of one code value')
        if s.inverse is not None and len(s.inverse) != len(s.frames):
            raise CaptureError(f"{len(s.inverse)} inverse frames for {len(s.frames)} frames; needed as many")
        gray = GraySet(s.gray, s.cell, len(s.frames), s.inverse is not None, s.white is not None, s.black is not None)
        pick: dict[Role, Callable[[int], str | None]] = {
            Role.WHITE: lambda _: s.white,
            Role.BLACK: lambda _: s.black,
            Role.BIT: lambda n: s.frames[n],
            Role.INVERSE: lambda n: (s.inverse or [])[n],
        }
        keys = ViewPlan("x", PixelFormat.MONO8, (gray,), (1, 1)).keys
        return gray, [str(pick[k.role](k.number)) for k in keys]
    steps = len(s.frames) if s.steps is None else s.steps
    if s.steps is not None and s.steps != len(s.frames):
        raise CaptureError(f'"steps" is {s.steps} but it names {len(s.frames)} frames; needed as many')
    g = s.cycles_per_pixel
    if g is None or len(g) != 2:
        raise CaptureError(f"cycles_per_pixel {files.shown(g)}; needed two numbers")
    if not math.hypot(*g) < 1:
        raise CaptureError(f"cycles_per_pixel {files.shown(g)}; needed a period of more than one projector-plane unit")
    if not math.hypot(*g) > LEAST_CYCLES:
        raise CaptureError(f"cycles_per_pixel {files.shown(g)}; needed fringes: more than {LEAST_CYCLES:g} cycles")
    return FringeSet((g[0], g[1]), steps, s.exposure_us), list(s.frames)


def view_inputs(
    capture: Capture, response: Response | None = None, *, ahead: bool = False, rowed: bool = False
) -> tuple[ViewInput, ...]:
    """What the pipeline takes: per view its plan, its frames (read lazily, may be iterated again) and its picture.

    `response` is the one that all views are to be freed from. `ahead` has the frames of a little capture read by other
    threads from now on, in place of when they are asked for. `rowed`: of frames that do not fit into memory, rows can
    be had (`RowedFrames`).
    The ring-light picture is read at once. Raises CaptureError here, or while frames are read, naming the file.
    """
    frames = {v.camera: (RowedFrames if rowed else Frames)(capture, v) for v in capture.views}
    if ahead and sum(len(v.files) * math.prod(v.size) for v in capture.views) <= LITTLE:
        pool = ThreadPoolExecutor(READERS)
        for one in frames.values():
            one.read_ahead(pool)
        pool.shutdown(wait=False)
    out = []
    for v in capture.views:
        color = None if v.color is None else capture.images.frame(v.color, v.plan.pixel_format, v.size)
        out.append(ViewInput(v.plan, frames[v.camera], color, v.noise, response))
    return tuple(out)


def hash_capture(capture: Capture) -> str:
    """ "sha256:..." over capture.json (as a JSON object) and the content of every file that it names.

    Frames that were read already are not read again.
    """
    total = hashlib.sha256(files.canonical_hash(files.read_json(capture.document, "a capture")).encode())
    names = {split_page(n)[0] for v in capture.views for n in (*v.files, *([v.color] if v.color else []))}
    for name in sorted(names):
        total.update(f"\n{name} {capture.images.digest(name)}".encode())
    return "sha256:" + total.hexdigest()


# ------------------------------------------------------------------------------------------------------------ writing


def put_capture(
    folder: Path,
    width: int,
    height: int,
    layout: Layout,
    views: Iterable[ViewInput],
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Writes a capture into an existing folder, frame by frame as `views` hand them out (any order within a view).

    `width` x `height` are the projector's device pixels. Frames become `<camera>/NN.png`, NN their place in
    `plan.keys`. Raises CaptureError where a frame is missing, doubled or does not fit its plan.
    """
    entries = [_put_view(folder, v) for v in views]
    if not entries:
        raise CaptureError("a capture without views; needed at least one")
    projector = {"width": width, "height": height, "layout": layout.value}
    doc = {"format": FORMAT, "version": VERSION, "projector": projector, "views": entries, **(extra or {})}
    files.write_json(folder / files.CAPTURE, doc)


def _frame_names(plan: ViewPlan) -> dict[FrameKey, str]:
    if bad := files.check_name(plan.camera):
        raise CaptureError(f"camera {files.shown(plan.camera)}: {bad}")
    digits = max(2, len(str(len(plan.keys) - 1)))
    return {k: f"{plan.camera}/{i:0{digits}d}.png" for i, k in enumerate(plan.keys)}


def put_patterns(folder: Path, plan: PatternPlan, images: Iterable[tuple[str, FrameKey, AnyArray]]) -> dict[str, Any]:
    """Writes what to project into an existing folder: `<camera>/NN.png` as the device needs them, and plan.json.

    `images` are (camera, key, image). Returns plan.json, whose views are laid out as in capture.json.
    """
    names = {v.camera: _frame_names(v) for v in plan.views}
    for camera in names:
        (folder / camera).mkdir()
    for camera, key, image in images:
        write_png(folder / names[camera][key], image)
    device = {"width": plan.projector_width, "height": plan.projector_height, "layout": plan.layout.value}
    views = [
        {"camera": v.camera, "pixel_format": v.pixel_format.value, "sets": _sets_document(v, names[v.camera])}
        for v in plan.views
    ]
    doc = {"format": "fringescope-plan", "version": 1, "projector": device, "views": views}
    files.write_json(folder / files.PLAN, doc)
    return doc


def check_rig(capture: Capture, rig: Rig) -> None:
    """Refuses a capture that this rig cannot have taken. Raises RigError where it lacks a camera, else CaptureError."""
    p = rig.projector
    came = (capture.projector_width, capture.projector_height, capture.layout)
    if came != (p.width, p.height, p.layout):
        raise CaptureError(
            f"{capture.document}: projector {came[0]} x {came[1]} {came[2].value}; the rig has {p.width} x {p.height} "
            f'{p.layout.value}: use the rig of this instrument, or mend "projector"'
        )
    there = [c.name for c in rig.cameras]
    for v in capture.views:
        if v.camera not in there:
            raise RigError(
                f"{capture.document}: the rig lacks camera '{v.camera}', it has {', '.join(there)}: use the rig of "
                "this instrument, or pick views with --view"
            )
        lens = rig.camera(v.camera).lens
        if v.size != (lens.width, lens.height):
            raise CaptureError(
                f"{capture.document}: frames of {v.camera} have {v.size[0]} x {v.size[1]} pixels; "
                f"the rig's have {lens.width} x {lens.height}: use the rig of this instrument"
            )


def _put_view(folder: Path, view: ViewInput) -> dict[str, Any]:
    plan = view.plan
    keys, names = plan.keys, _frame_names(plan)
    (folder / plan.camera).mkdir()
    size: tuple[int, int] | None = None
    seen: set[FrameKey] = set()
    for key, frame in view.frames:
        if key not in names:
            raise CaptureError(f"view '{plan.camera}': a frame {key} that its plan lacks")
        if key in seen:
            raise CaptureError(f"view '{plan.camera}': frame {keys.index(key)} came twice")
        checked = check_frame(frame, plan.pixel_format, size, names[key])
        size = (checked.shape[1], checked.shape[0])
        write_png(folder / names[key], checked)
        seen.add(key)
    if len(seen) < len(keys):
        missing = [i for i, k in enumerate(keys) if k not in seen]
        raise CaptureError(f"view '{plan.camera}': {len(seen)} frames came, not {len(keys)}; missing {missing[:8]}")
    entry: dict[str, Any] = {
        "camera": plan.camera,
        "pixel_format": plan.pixel_format.value,
        "sets": _sets_document(plan, names),
    }
    if view.color is not None:
        entry["color"] = f"{plan.camera}/color.png"
        write_png(folder / entry["color"], check_frame(view.color, plan.pixel_format, size, entry["color"]))
    if view.noise is not None:
        entry["noise"] = {"a": view.noise.a, "b": view.noise.b}
    return entry


def _sets_document(plan: ViewPlan, names: Mapping[FrameKey, str]) -> list[dict[str, Any]]:
    out = []
    for i, s in enumerate(plan.sets):
        of = {(k.role, k.number): names[k] for k in plan.keys if k.set_index == i}
        if isinstance(s, FringeSet):
            one: dict[str, Any] = {
                "cycles_per_pixel": list(s.cycles_per_pixel),
                "steps": s.steps,
                "frames": [of[Role.STEP, n] for n in range(s.steps)],
            }
            if s.exposure_us is not None:
                one["exposure_us"] = s.exposure_us
        else:
            one = {"gray": s.axis, "cell": s.cell, "frames": [of[Role.BIT, n] for n in range(s.bits)]}
            if s.inverse:
                one["inverse"] = [of[Role.INVERSE, n] for n in range(s.bits)]
            one |= {r.value: of[r, 0] for r in (Role.WHITE, Role.BLACK) if (r, 0) in of}
        out.append(one)
    return out


def write_capture(
    folder: Path | str,
    width: int,
    height: int,
    layout: Layout,
    views: Iterable[ViewInput],
    *,
    force: bool = False,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """A new capture folder, whole or not at all: `new_folder` with `put_capture`. Raises OutputError, CaptureError."""
    with files.new_folder(folder, marker=files.CAPTURE, force=force) as tmp:
        put_capture(tmp, width, height, layout, views, extra)
