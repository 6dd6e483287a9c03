"""What is made for those elsewhere: surfaces packed for the wire, STL, the report, a look at scans that come in."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fringescope import export, report, store
from fringescope.errors import FormatError, FringescopeError
from fringescope.server.processes.child import Call
from fringescope.settings import Settings
from fringescope.types import U8

_GRID = 200_000  #: places of a view among which that of a stroke is looked for
_LEVELS = (20_000, 200_000)  #: triangles of the levels that are sent, coarse to fine; the surface itself is the last
_FIRST_BYTES = 700_000  #: of the first of them, pictures and all
_FAR_MM = 2.0  #: a place farther from all of them was not seen by that camera


def leave(call: Call, asked: str, report_pdf: str) -> list[str]:
    """The STL of each scan, as `asked` (a file) names them, and the report; returns the STLs that could be made."""
    doc: dict[str, Any] = json.loads(Path(asked).read_text())
    made = []
    for k, (glb, stl) in enumerate(doc["stl"]):
        call.progress("stl", 0.5 * k / len(doc["stl"]))
        try:
            export.write_stl(export.read_glb(glb), stl)
        except FringescopeError:
            Path(stl).unlink(missing_ok=True)
            continue
        made.append(stl)
    call.progress("report", 0.5)
    told = doc["report"]
    for scan in told["scans"]:
        _place(scan)
    report.write_case(report_pdf, told, _pictures(told))
    return made


def _pictures(told: dict[str, Any]) -> dict[str, U8]:
    import cv2

    names = {p["file"] for s in told["scans"] for p in s["pictures"]}
    names |= {x[1] for v in told["versions"] for x in (*v["previews"], *v["shown"])}
    out = {}
    for name in names:
        image = cv2.imread(name, cv2.IMREAD_COLOR)
        if image is not None:
            out[name] = np.asarray(image[..., ::-1], np.uint8)
    return out


def _place(scan: dict[str, Any]) -> None:
    """Strokes at places on the tissue, as pixels of each camera that has seen them."""
    loose = scan.pop("world", [])
    if not loose or not scan["pictures"]:
        return
    from scipy.spatial import cKDTree

    try:
        stored = store.read_scan(scan["folder"], check=False)
    except FringescopeError:
        for p in scan["pictures"]:
            p["left_out"] = len(loose)
        return
    trees = {}
    for g in stored.grids:
        step = max(1, round((g.valid.sum() / _GRID) ** 0.5))
        rows, columns = np.nonzero(g.valid[::step, ::step])
        if len(rows):
            trees[g.camera] = cKDTree(g.xyz[rows * step, columns * step]), np.stack([columns, rows], 1) * step
    for p in scan["pictures"]:
        for s in loose:
            tree, pixels = trees.get(p["camera"], (None, None))
            if tree is None or pixels is None:
                p["left_out"] = p.get("left_out", 0) + 1
                continue
            far, near = tree.query(np.asarray(s["world_mm"], np.float64))
            if np.max(far) > _FAR_MM:
                p["left_out"] = p.get("left_out", 0) + 1
                continue
            p["strokes"].append({**s, "pixels": pixels[near].tolist()})


def examine(call: Call, folder: str) -> dict[str, Any]:
    """A scan's folder that somebody handed in: its scan.json, if all of it is whole, with JPEGs where it has pictures.

    Raises FormatError.
    """
    call.progress("reading", 0.1)
    stored = store.read_scan(folder)
    doc = dict(stored.document)
    for key in ("hash", "rig"):
        if not isinstance(doc.get(key), str) or not doc[key].startswith("sha256:") or len(doc[key]) != 71:
            came = str(doc.get(key))[:80]
            raise FormatError(f'scan.json: "{key}" is {came!r}; needed sha256:..: reconstruct it again')
    if stored.surface is not None:
        export.read_glb(stored.surface)
    export.read_ply(stored.cloud)
    if any(p is not None for p in stored.pictures):
        call.progress("photographs", 0.6)
        photographs(call, stored)
    call.progress("levels", 0.9)
    levels(call, folder, folder)
    plain: dict[str, Any] = store.plain(doc)
    return plain


def photographs(call: Call, stored: store.StoredScan) -> None:
    """The photograph of each camera as JPEG beside a scan, where it keeps pictures."""
    from fringescope import fuse

    for picture in stored.pictures:
        if picture is not None:
            call.check()
            photo = fuse.photo(picture.frame, picture.pixel_format, picture.camera, Settings().fuse)
            data = export.encode_picture(fuse.encode_srgb(photo.rgb), 88)[0]
            (stored.folder / f"photo-{picture.camera}.jpg").write_bytes(data)


def levels(call: Call, scan: str, out: str) -> list[str]:
    """The surface of a scan's folder as packed GLBs for the wire, coarse to fine, in folder `out`; their names.

    None where there is no surface, or nothing that packs.
    """
    stored = store.read_scan(scan, grids=False, check=False)
    if stored.surface is None or not export.can_pack():
        return []
    surface = export.read_glb(stored.surface)
    told = {"scan": str(stored.document.get("hash")), "of_triangles": surface.n_faces}
    Path(out).mkdir(parents=True, exist_ok=True)
    first = export.coarse_bytes(surface, _LEVELS[0], _FIRST_BYTES, {**told, "level": 0})
    call.check()
    second = export.packed_bytes(
        export.thinned(surface, _LEVELS[1]), export.read_pictures(stored.surface), {**told, "level": 1}
    )
    call.check()
    made = []
    for k, data in enumerate((first, second)):
        made.append(f"level-{k}.glb")
        (Path(out) / made[-1]).write_bytes(data)
    return made


class Hand:
    """The packer's calls."""

    def __init__(self, _emit: Callable[[dict[str, Any]], None]) -> None:
        self.calls: dict[str, Callable[..., Any]] = {"leave": leave, "examine": examine, "levels": levels}
        self.urgent: dict[str, Callable[..., Any]] = {}

    def ended(self) -> None:
        """Nothing to tidy up: what is half made lies in folders that are removed."""
