"""A comparison's folder: compare.json, the maps as TIFF, the coloured surface.

The PLY and GLB writers are handed in (`export.write_ply`, `export.write_glb`): files know data, not each other.
"""

from __future__ import annotations

import datetime
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
