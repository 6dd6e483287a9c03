"""Somebody's loose images to a capture, with a preview and a proof that the order is right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fringescope import store
from fringescope.errors import CaptureError, UsageError
from fringescope.importing.loose import (
    LOSSY,
    Gray,
    LooseFrames,
    Recipe,
    RecipeFrames,
    image_files,
    stack_pages,
    the_stack,
)
from fringescope.importing.order import Evidence, look
from fringescope.importing.preview import draw
from fringescope.types import PixelFormat, ViewInput

__all__ = [
    "Evidence",
    "Gray",
    "ImportedView",
    "LooseFrames",
    "Recipe",
    "draw",
    "find_views",
    "look",
    "put_import",
    "stack_view",
    "the_stack",
]

ONE_FRINGE = 1000  #: period given to a stack's only set; the field is a little shorter, so that no order is in doubt


@dataclass(frozen=True, eq=False)
class ImportedView:
    """One camera's loose images, ready to be weighed (`look(view.images, recipe)`) and written."""

    camera: str
    images: LooseFrames
    notes: tuple[str, ...]
    color: LooseFrames | None = None

    def view_input(self, recipe: Recipe) -> ViewInput:
        """As the pipeline takes it; frames are read when asked for."""
        plan = recipe.plan(self.camera, self.images.fmt)
        color = None if self.color is None else self.color[0]
        return ViewInput(plan, RecipeFrames(self.images, recipe, plan), color)


def find_views(
    source: Path | str,
    recipe: Recipe,
    *,
    camera: str = "camera1",
    pattern: str = "*",
    pixel_format: PixelFormat | None = None,
    left_aligned: bool = False,
    color: str | None = None,
    axis: str | None = None,
    time: int | None = None,
) -> tuple[ImportedView, ...]:
    """The views in a folder of images, in a folder of such folders (one per camera), or in a TIFF stack.

    `color` is the ring-light picture's file name in the folder, apart from the frames. Raises CaptureError where the
    images do not suffice or cannot be read, UsageError where the recipe or the options cannot mean anything.
    """
    source = Path(source)
    shift = 0
    if left_aligned:
        if pixel_format is None or not 8 < pixel_format.bits < 16:
            raise UsageError("--left-aligned needs --pixel-format with 10 or 12 bits, such as Mono12")
        shift = 16 - pixel_format.bits
    if source.is_file():
        stack = stack_pages(source, recipe.files_needed, axis, time)
        images = LooseFrames(source.parent, stack.names, left_aligned=shift, fmt=pixel_format)
        return (ImportedView(camera, images, (stack.note, *_depth_note(images))),)
    if not source.is_dir():
        raise CaptureError(f"{source}: not found; needed a folder of images or a TIFF stack")
    folders = {camera: source}
    if not image_files(source, pattern):
        folders = {p.name: p for p in sorted(source.iterdir()) if p.is_dir() and image_files(p, pattern)}
    if not folders:
        raise CaptureError(f"{source}: holds no images ({pattern}); needed PNG, TIFF, BMP or PGM files")
    return tuple(_view(p, n, recipe, pattern, pixel_format, shift, color) for n, p in folders.items())


def stack_view(
    path: Path | str, steps: int | None, axis: str | None, time: int | None, fmt: PixelFormat | None
) -> tuple[ViewInput, str, str]:
    """A TIFF stack of one set as a view without a known period: what was chosen, and the file's hash, with it.

    The set counts as one fringe across the field, so that its phase comes out wrapped, in 0 .. 2 pi. Raises as
    `find_views`.
    """
    path = Path(path)
    stack = stack_pages(path, steps, axis, time)
    images = LooseFrames(path.parent, stack.names, fmt=fmt)
    recipe = Recipe((len(stack.names),), (float(ONE_FRINGE),), projector=(round(0.98 * ONE_FRINGE), 1))
    plan = recipe.plan("camera1", images.fmt)
    note = f"{stack.note}; no period is known: the phase is wrapped, 0 to 2 pi"
    return ViewInput(plan, RecipeFrames(images, recipe, plan)), note, f"sha256:{images.digest()}"


def _view(
    folder: Path, camera: str, recipe: Recipe, pattern: str, fmt: PixelFormat | None, shift: int, color: str | None
) -> ImportedView:
    names = [p.name for p in image_files(folder, pattern) if p.name != color]
    lossy = sum(n.lower().endswith(LOSSY) for n in names)
    if len(names) != recipe.files_needed:
        of_them = f" ({lossy} of them JPEG or WebP, which lose what phase needs)" if lossy else ""
        raise CaptureError(
            f"{folder}: {len(names)} images{of_them}, --steps and --periods need {recipe.files_needed}: mend them, "
            "pick files with --glob, name the ring-light picture with --color and Gray code with --gray"
        )
    images = LooseFrames(folder, names, left_aligned=shift, fmt=fmt)
    notes = [f"{len(names)} images, {names[0]} to {names[-1]}", *_depth_note(images)]
    if lossy:
        notes.append(f"{lossy} images are JPEG or WebP, which lose what phase needs: record PNG or TIFF")
    picture = None if color is None else LooseFrames(folder, [color], left_aligned=shift, fmt=images.fmt)
    return ImportedView(camera, images, tuple(notes), picture)


def _depth_note(images: LooseFrames) -> tuple[str, ...]:
    if images.fmt is not PixelFormat.MONO16:
        return ()
    top = max(int(images[i].max()) for i in range(len(images)))
    for fmt in (PixelFormat.MONO10, PixelFormat.MONO12):
        if top <= fmt.max_value:
            return (f"taken as Mono16, but no value exceeds {top}: with --pixel-format {fmt.value} saturation is seen",)
    return ()


def put_import(folder: Path, views: tuple[ImportedView, ...], recipe: Recipe, evidence: Mapping[str, Evidence]) -> None:
    """Writes the capture, and `import-<camera>.png` beside it, into a folder that is being made."""
    w, h = recipe.projector
    extra: dict[str, Any] = {"imported": {c: store.plain(e.figures()) for c, e in evidence.items()}}
    store.put_capture(folder, w, h, recipe.layout, (v.view_input(recipe) for v in views), extra)
    for camera, e in evidence.items():
        store.write_png(folder / f"import-{camera}.png", draw(e, camera))
