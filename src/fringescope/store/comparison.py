"""A comparison's folder: compare.json, the maps as TIFF, the coloured surface; and strokes read from guideline files.

The PLY and GLB writers are handed in (`export.write_ply`, `export.write_glb`): files know data, not each other.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fringescope import __version__
from fringescope.errors import FormatError, UsageError
from fringescope.store import files
from fringescope.store.images import write_png, write_tiff
from fringescope.store.scan import StoredScan, WriteGlb, WritePly, plain, sha256
from fringescope.types import F64, U8, AnyArray, Cloud, Surface

FORMAT, VERSION = "fringescope-comparison", 1
_MOST = 2_000_000  #: points of all strokes together


def check_pair(before: StoredScan, after: StoredScan, rig_hash: str | None = None) -> None:
    """Raises UsageError for a scan with itself, FormatError for scans (or a rig) of different instruments."""
    a, b = before.document, after.document
    if before.folder.resolve() == after.folder.resolve() or a.get("hash") == b.get("hash"):
        raise UsageError(f"{before.folder} and {after.folder} are one and the same scan; needed two: before and after")
    if a.get("rig") != b.get("rig"):
        raise FormatError(
            f"{before.folder} and {after.folder}: made with different rigs ({files.shown(a.get('rig'), 24)} and "
            f"{files.shown(b.get('rig'), 24)}), so their worlds differ; reconstruct both with one rig.json"
        )
    if rig_hash is not None and rig_hash != a.get("rig"):
        raise FormatError(
            f"--rig {rig_hash[:24]}..: the scans were made with {files.shown(a.get('rig'), 24)}; give that one"
        )


def put_comparison(
    folder: Path,
    figures: Mapping[str, Any],
    before: StoredScan,
    after: StoredScan,
    maps: Mapping[str, F64],
    labels: AnyArray,
    picture: U8,
    cloud: Cloud,
    surface: Surface | None,
    *,
    settings: Mapping[str, Any],
    write_ply: WritePly,
    write_glb: WriteGlb,
) -> dict[str, Any]:
    """Writes a comparison into an existing folder and returns its compare.json.

    `maps` (h, w) become NAME.tif, float32, row 0 the lowest y; `labels` regions.png, 16 bits; `picture` map.png.
    """
    identity = {
        "before": before.document.get("hash"),
        "after": after.document.get("hash"),
        "settings": plain(settings),
        "software": __version__,
    }
    hash_ = files.canonical_hash(identity)
    for name, a in maps.items():
        write_tiff(folder / f"{name}.tif", np.asarray(a, np.float32))
    write_png(folder / "regions.png", np.asarray(labels, np.uint16))
    write_png(folder / "map.png", picture)
    write_ply(cloud, folder / "cloud.ply")
    if surface is not None:
        extras = {"comparison": hash_, "units": "mm", "generator": f"fringescope {__version__}"}
        write_glb(surface, folder / "surface.glb", extras)
    doc = {
        "format": FORMAT,
        "version": VERSION,
        "hash": hash_,
        "software": {"name": "fringescope", "version": __version__},
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "before": before.document.get("hash"),
        "after": after.document.get("hash"),
        "rig": before.document.get("rig"),
        "units": "mm",
        **plain(figures),
        "settings": plain(settings),
        "files": {p.name: sha256(p) for p in sorted(folder.iterdir()) if p.is_file()},
    }
    files.write_json(folder / files.COMPARISON, doc)
    return doc


def read_strokes(path: Path | str, scan_hash: str | None, rig_hash: str | None) -> list[dict[str, Any]]:
    """The strokes of a guidelines file, or of a pattern.json: dictionaries with "id" and one of "world_mm" (m, 3),
    "pixels" (m, 2) with "camera", or "segments" (k of (m, 2)) on the projector's plane; and "closed".

    Raises FormatError for another scan or rig than given, for a stroke that has none of these, or no finite numbers.
    """
    path = Path(path)
    doc = files.read_json(path, "guidelines or a pattern.json")
    if "format" in doc and doc["format"] == "fringescope-guidelines":
        files.check_format(doc, path, "fringescope-guidelines", 1)
    for key, ours in (("scan", scan_hash), ("rig", rig_hash)):
        if isinstance(doc.get(key), str) and ours is not None and doc[key] != ours:
            raise FormatError(f"{path}: drawn on another {key} ({doc[key][:24]}..); needed that of the scan before")
    strokes = doc.get("strokes")
    if not isinstance(strokes, list) or not strokes:
        raise FormatError(f'{path}: "strokes" is missing or empty; needed a list of strokes')
    out, total = [], 0
    for n, one in enumerate(strokes):
        if not isinstance(one, dict):
            raise FormatError(f"{path}: stroke {n + 1} is {files.shown(one)}; needed an object")
        name = str(one.get("id", n + 1))[:80]
        if one.get("kind", "line") not in ("line", "region", "arrow") and "segments" not in one:
            kind = files.shown(one.get("kind"))
            raise FormatError(f"{path}: stroke '{name}' is of the kind {kind}; add --rig rig.json, which draws it")
        stroke: dict[str, Any] = {"id": name, "closed": one.get("closed") is True or one.get("kind") == "region"}
        if "world_mm" in one:
            stroke["world_mm"] = _points(one["world_mm"], 3, path, name)
        elif "pixels" in one:
            if not isinstance(one.get("camera"), str):
                raise FormatError(f"{path}: stroke '{name}' has pixels but no camera; say which camera they belong to")
            stroke |= {"pixels": _points(one["pixels"], 2, path, name), "camera": one["camera"]}
        elif isinstance(one.get("segments"), list):
            stroke["segments"] = [_points(x, 2, path, name) for x in one["segments"]]
        else:
            raise FormatError(f"{path}: stroke '{name}' has no world_mm, pixels or segments; needed one of them")
        total += sum(len(x) for x in stroke.get("segments", [stroke.get("world_mm", stroke.get("pixels"))]))
        out.append(stroke)
    if total > _MOST:
        raise FormatError(f"{path}: {total} points; needed at most {_MOST} in all strokes")
    return out


def _points(value: Any, columns: int, path: Path, name: str) -> F64:
    try:
        a = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        a = np.zeros(0)
    if a.ndim != 2 or a.shape[1] != columns or len(a) < 1 or not all(math.isfinite(x) for x in (a.min(), a.max())):
        raise FormatError(f"{path}: stroke '{name}': {files.shown(value)}; needed points of {columns} finite numbers")
    return a
