"""What the workshop computes: scans from captures, pictures for the projector from strokes, strokes carried over."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from fringescope import export, store
from fringescope.cli.calibrating import calibrate_into
from fringescope.cli.comparing import compare_into
from fringescope.cli.scanning import scan_into
from fringescope.errors import EmptyResultError
from fringescope.pipeline import carrying
from fringescope.pipeline import guidance as recipe
from fringescope.server.processes.child import Call
from fringescope.settings import Settings, from_dict


class _Told:
    """A call's progress in the form that scans tell it."""

    def __init__(self, call: Call) -> None:
        self._call = call
        self.times_s: dict[str, float] = {}

    def share(self, what: str, share: float) -> None:
        self._call.progress(what, 0.95 * share)

    def run(self, stage: str, work: Callable[[], Any]) -> Any:
        self._call.progress(stage, 0.95)
        return work()

    def track(self, items: Iterable[Any], stage: str, total: int) -> Iterator[Any]:
        for i, item in enumerate(items):
            self._call.progress(stage, 0.5 * i / max(1, total))
            yield item


def reconstruct(call: Call, capture: str, rig: str, out: str, settings: dict[str, Any]) -> dict[str, Any]:
    """A capture to a scan in a new folder; returns its scan.json."""
    progress: Any = _Told(call)
    with store.new_folder(Path(out), marker="scan.json") as tmp:
        _, doc = scan_into(tmp, Path(capture), Path(rig), from_dict(settings), progress, preview=False)
        call.check()
    plain: dict[str, Any] = store.plain(doc)
    return plain


@functools.lru_cache(2)
def _tissue(scan: str, rig: str, settings: str) -> tuple[store.StoredScan, Any, Settings]:
    """A scan made ready for guidance: it takes longest, and serves for all strokes on it."""
    import json

    s = from_dict(json.loads(settings))
    stored = store.read_scan(scan, check=False)
    if stored.surface is None:
        raise EmptyResultError("the scan has no surface, so nothing can be drawn on it; scan again")
    return stored, recipe.tissue_of(stored.grids, export.read_glb(stored.surface), store.read_rig(rig), s), s


def prepare(call: Call, scan: str, rig: str, settings: str) -> None:
    """Makes a scan ready for strokes, before the first comes."""
    _tissue(scan, rig, settings)
    call.check()


def forget(_call: Call) -> None:
    """Lets go of the scans that were made ready."""
    _tissue.cache_clear()


def guide(call: Call, scan: str, rig: str, settings: str, strokes: list[dict[str, Any]], out: str) -> dict[str, Any]:
    """Strokes to pattern.png, dashed.png, pattern.json and a preview for each camera, in folder `out`.

    Returns the names of the files, and what of the strokes cannot be shown.
    """
    stored, tissue, s = _tissue(scan, rig, settings)
    hashes = str(stored.document.get("hash")), str(stored.document.get("rig"))
    doc = {"format": "fringescope-guidelines", "version": 1, "scan": hashes[0], "rig": hashes[1], "strokes": strokes}
    asked = store.parse_guidelines(doc, Path("the guideline"))
    made = recipe.project_guidance(asked, tissue, s)
    dashed = recipe.project_guidance(asked, tissue, s, dashed=True)
    call.check()
    told = store.pattern_document(made, asked.refused, (), {"scan": hashes[0], "rig": hashes[1]})
    problems = [f"{k}: {v}" for k, v in asked.refused.items()]
    for g in made.strokes:
        if g.refused is not None:
            problems.append(f"{g.stroke.id}: {g.refused}")
        problems += [f"{g.stroke.id}: {h.length_mm:.1f} mm not shown: {h.why.value}" for h in g.hidden]
    shown = any(g.segments for g in made.strokes)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    store.write_json(folder / "pattern.json", told)
    names = {"record": "pattern.json"}
    if shown:
        store.write_png(folder / "pattern.png", made.image)
        store.write_png(folder / "dashed.png", dashed.image)
        names |= {"pattern": "pattern.png", "dashed": "dashed.png"}
        if all(p is not None for p in stored.pictures):
            for camera, picture in recipe.previews(made, tissue, stored.every_picture(), s).items():
                export_jpeg(folder / f"preview-{camera}.jpg", picture)
                names[f"preview-{camera}"] = f"preview-{camera}.jpg"
    return {"files": names, "problems": problems[:50]}


def carry(
    call: Call, old: str, new: str, rig: str, settings: str, strokes: list[dict[str, Any]]
) -> dict[str, Any]:  # fmt: skip
    """Strokes of an old scan laid on a new one: their documents in mm, and how well the scans fit."""
    stored, tissue, s = _tissue(old, rig, settings)
    now = store.read_scan(new, grids=False, check=False)
    doc = {"format": "fringescope-guidelines", "version": 1, "strokes": strokes}
    asked = store.parse_guidelines(doc, Path("the guideline"))
    clouds = [export.read_ply(x.cloud) for x in (stored, now)]
    found = carrying.carry_over(asked, tissue, clouds[0], clouds[1], store.read_rig(rig), s)
    call.check()
    g = found.registration
    plain: dict[str, Any] = store.plain(
        {
            "strokes": store.guidelines_document(found.guidelines)["strokes"],
            "refused": found.guidelines.refused,
            "residual_um": 1e3 * g.rms_mm,
            "moved_mm": g.shift_mm,
            "turned_rad": g.turn_rad,
            "words": g.words,
        }
    )
    return plain


def compare(
    call: Call, before: str, after: str, rig: str, out: str, settings: dict[str, Any], strokes: list[dict[str, Any]]
) -> dict[str, Any]:  # fmt: skip
    """What changed from one scan to another, and how far the cut ran from `strokes`; returns its compare.json."""
    progress: Any = _Told(call)
    guidelines = None
    if strokes:
        guidelines = Path(out).with_suffix(".strokes.json")
        scan = store.read_scan(before, grids=False, check=False).document
        bound = {"scan": scan["hash"], "rig": scan["rig"]}
        doc = {"format": "fringescope-guidelines", "version": 1, **bound, "strokes": strokes}
        store.write_json(guidelines, doc)
    with store.new_folder(Path(out), marker="compare.json") as tmp:
        doc = compare_into(
            tmp, Path(before), Path(after), from_dict(settings), progress, rig=Path(rig), guidelines=guidelines
        )
    plain: dict[str, Any] = store.plain(doc)
    return plain


def calibrate(call: Call, session: str, rig: str, page: str, settings: dict[str, Any]) -> dict[str, Any]:
    """A session of board captures to a rig and its report; returns the verdict. Raises CalibrationError."""
    progress: Any = _Told(call)
    _, evidence, why = calibrate_into(Path(rig), Path(page), Path(session), from_dict(settings), progress, force=True)
    plain: dict[str, Any] = store.plain(
        {"verdict": evidence.verdict, "good": evidence.good, "weak": evidence.weak, "next": evidence.next,
         "not_used": why, "rig": store.hash_rig(Path(rig))}
    )  # fmt: skip
    return plain


def photographs(call: Call, scan: str) -> dict[str, str]:
    """The photograph of each camera as JPEG beside the scan; the names of the files."""
    from fringescope import fuse

    stored = store.read_scan(scan, check=False)
    out = {}
    for picture in stored.pictures:
        if picture is None:
            continue
        call.check()
        photo = fuse.photo(picture.frame, picture.pixel_format, picture.camera, Settings().fuse)
        name = f"photo-{picture.camera}.jpg"
        export_jpeg(Path(scan) / name, fuse.encode_srgb(photo.rgb))
        out[picture.camera] = name
    return out


def export_jpeg(path: Path, rgb: Any, quality: int = 88) -> None:
    """A picture (h, w, 3) RGB uint8 as JPEG."""
    import cv2

    good, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert good
    path.write_bytes(data.tobytes())


class Hand:
    """The workshop's calls."""

    def __init__(self, _emit: Callable[[dict[str, Any]], None]) -> None:
        self.calls: dict[str, Callable[..., Any]] = {
            "reconstruct": reconstruct, "prepare": prepare, "guide": guide, "carry": carry, "photographs": photographs,
            "forget": forget,
            "compare": compare, "calibrate": calibrate,
        }  # fmt: skip
        self.urgent: dict[str, Callable[..., Any]] = {}

    def ended(self) -> None:
        """Nothing to tidy up: what is half made lies in folders that the next run removes."""
