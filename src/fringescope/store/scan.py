"""A scan's folder: scan.json, cloud.ply, surface.glb and the organised grids; and a decoded capture's folder.

The PLY and GLB writers are handed in (`export.write_ply`, `export.write_glb`): files know data, not each other.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fringescope import __version__
from fringescope.errors import CaptureError, FormatError
from fringescope.store import files
from fringescope.store.images import Images, write_png, write_tiff
from fringescope.types import (
    F32,
    U8,
    U16,
    Cloud,
    Decoded,
    Grid,
    NoiseModel,
    Picture,
    PixelFormat,
    Reason,
    Scan,
    Surface,
)

FORMAT, VERSION = "fringescope-scan", 1
DECODED_FORMAT, DECODED_VERSION = "fringescope-decoded", 1

WRITERS = 4  #: files that are written at once

WritePly = Callable[[Cloud, Path], None]
WriteGlb = Callable[[Surface, Path, Mapping[str, Any]], None]


@dataclass(frozen=True, eq=False)
class StoredScan:
    """A scan read back: its folder, scan.json, the grids of its views, and the photograph of each: None where the scan
    was made before scans kept them.
    """

    folder: Path
    document: Mapping[str, Any]
    grids: tuple[Grid, ...]
    pictures: tuple[Picture | None, ...] = ()

    @property
    def cloud(self) -> Path:
        """Its cloud.ply."""
        return self.folder / "cloud.ply"

    @property
    def surface(self) -> Path | None:
        """Its surface.glb, where it has one."""
        path = self.folder / "surface.glb"
        return path if path.is_file() else None

    @property
    def instrument(self) -> str | None:
        """The URI of the instrument that took it, where the scan tells it."""
        told = self.document.get("instrument")
        return told if isinstance(told, str) else None

    def noise(self) -> dict[str, NoiseModel]:
        """Of one raw sample, by camera, where the scan tells it."""
        out = {}
        for camera, v in self._figures().items():
            told = v.get("noise")
            a, b = (told.get("a"), told.get("b")) if isinstance(told, dict) else (None, None)
            if isinstance(a, (int, float)) and isinstance(b, (int, float)):
                out[camera] = NoiseModel(float(a), float(b), "scan.json")
        return out

    def gradients(self) -> dict[str, tuple[tuple[float, float], ...]]:
        """Of the finest fringes of each direction, cycles per projector-plane unit, by camera."""
        out = {}
        for camera, v in self._figures().items():
            told = v.get("directions")
            pairs = [g for g in told if isinstance(g, list) and len(g) == 2] if isinstance(told, list) else []
            if pairs and all(isinstance(x, (int, float)) for g in pairs for x in g):
                out[camera] = tuple((float(a), float(b)) for a, b in pairs)
        return out

    def _figures(self) -> dict[str, dict[str, Any]]:
        figures = self.document.get("figures")
        views = figures.get("views") if isinstance(figures, dict) else None
        return {c: v for c, v in views.items() if isinstance(v, dict)} if isinstance(views, dict) else {}

    def every_picture(self) -> tuple[Picture, ...]:
        """The photograph of each grid. Raises FormatError where the scan keeps none."""
        without = [g.camera for g, p in zip(self.grids, self.pictures, strict=True) if p is None]
        if without:
            raise FormatError(f"{self.folder}: the scan keeps no picture of {', '.join(without)}; reconstruct it again")
        return tuple(p for p in self.pictures if p is not None)


def plain(value: Any) -> Any:
    """What JSON can hold: arrays to lists, NaN and infinity to None, dataclasses to objects, others to text."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def sha256(path: Path) -> str:
    """ "sha256:..." of a file."""
    with path.open("rb") as f:
        return "sha256:" + hashlib.file_digest(f, "sha256").hexdigest()


# ------------------------------------------------------------------------------------------------------------ writing


def put_scan(
    folder: Path,
    scan: Scan,
    *,
    settings: Mapping[str, Any],
    capture_hash: str,
    rig_hash: str,
    write_ply: WritePly,
    write_glb: WriteGlb,
    write_preview: WriteGlb | None = None,
    grids: bool = False,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes a scan into an existing folder and returns its scan.json.

    `scan.all_points`, where there is one, takes the place of the fused cloud in cloud.ply. `grids` writes the organised
    grids as TIFF and PNG and the pictures as PNG, else as .npy. `write_preview` writes the small level, preview.glb.
    `extra` adds keys to scan.json; `scan.figures["times_s"]` stands beside its "figures". "hash" identifies the scan:
    sha256 over the hashes of capture and rig, settings, program version and cloud.ply; the GLB carries it in
    `asset.extras`.
    """
    cloud = scan.cloud if scan.all_points is None else scan.all_points
    preview = scan.preview if write_preview else None
    with ThreadPoolExecutor(WRITERS) as pool:
        tasks = [pool.submit(_put_grid, folder / g.camera, g, grids) for g in scan.grids]
        tasks += [pool.submit(_put_picture, folder / p.camera, p, grids) for p in scan.pictures]
        write_ply(cloud, folder / "cloud.ply")
        identity = {
            "capture": capture_hash,
            "rig": rig_hash,
            "settings": plain(settings),
            "software": __version__,
            "cloud": sha256(folder / "cloud.ply"),
        }
        hash_ = files.canonical_hash(identity)
        extras = {"scan": hash_, "rig": rig_hash, "units": "mm", "generator": f"fringescope {__version__}"}
        if scan.surface is not None:
            tasks.append(pool.submit(write_glb, scan.surface, folder / "surface.glb", extras))
        if preview is not None and write_preview is not None:
            tasks.append(pool.submit(write_preview, preview, folder / "preview.glb", extras))
        for task in tasks:
            task.result()
        written = [p for p in sorted(folder.rglob("*")) if p.is_file()]
        names = [str(p.relative_to(folder).as_posix()) for p in written]
        digests = dict(zip(names, pool.map(sha256, written), strict=True))
    verdicts = {v.camera: plain(v) for v in scan.verdicts}
    photos = {
        p.camera: {
            "file": f"{p.camera}/picture.{'png' if grids else 'npy'}",
            "pixel_format": p.pixel_format.value,
            "light": p.light,
        }
        for p in scan.pictures
    }
    doc = {
        "format": FORMAT,
        "version": VERSION,
        "hash": hash_,
        "software": {"name": "fringescope", "version": __version__},
        "created": _now(),
        "capture": capture_hash,
        "rig": rig_hash,
        "units": "mm",
        "cloud": {"points": len(cloud), "kind": "fused" if scan.all_points is None else "all-points"},
        "surface": None
        if scan.surface is None
        else {
            "vertices": len(scan.surface.vertices),
            "triangles": scan.surface.n_faces,
            "textures": [list(p.texture.shape[1::-1]) for p in scan.surface.parts],
        },
        "preview": None
        if preview is None
        else {"vertices": len(preview.vertices), "triangles": preview.n_faces},
        "grids": "tif" if grids else "npy",
        "views": [
            {
                "view": g.view,
                "camera": g.camera,
                "size": list(g.reasons.shape[::-1]),
                **verdicts.get(g.camera, {}),
                "picture": photos.get(g.camera),
            }
            for g in scan.grids
        ],
        "filters": plain(scan.figures.get("filters", [])),
        "figures": {k: v for k, v in plain(scan.figures).items() if k != "times_s"},
        "times_s": plain(scan.figures.get("times_s", {})),
        "settings": plain(settings),
        "files": digests,
        **plain(extra or {}),
    }
    files.write_json(folder / files.SCAN, doc)
    return doc


def _put_grid(folder: Path, g: Grid, tif: bool) -> None:
    folder.mkdir(exist_ok=True)
    xyz, sigma = np.asarray(g.xyz, np.float32), np.asarray(g.sigma, np.float32)
    reasons = np.asarray(g.reasons, np.uint16)
    if tif:
        write_tiff(folder / "xyz.tif", xyz)
        write_tiff(folder / "sigma.tif", sigma)
        write_png(folder / "reasons.png", reasons)
        return
    for name, a in (("xyz", xyz), ("sigma", sigma), ("reasons", reasons)):
        with (folder / f"{name}.npy").open("wb") as f:
            np.save(f, a)


def _put_picture(folder: Path, p: Picture, png: bool) -> None:
    folder.mkdir(exist_ok=True)
    if png:
        write_png(folder / "picture.png", p.frame)
        return
    with (folder / "picture.npy").open("wb") as f:
        np.save(f, p.frame)


def write_scan(folder: Path | str, scan: Scan, *, force: bool = False, **how: Any) -> dict[str, Any]:
    """A new scan folder, whole or not at all: `new_folder` with `put_scan`, whose arguments it takes."""
    with files.new_folder(folder, marker=files.SCAN, force=force) as tmp:
        return put_scan(tmp, scan, **how)


# ------------------------------------------------------------------------------------------------------------ reading


def read_scan(folder: Path | str, *, grids: bool = True, check: bool = True) -> StoredScan:
    """A scan's folder read back; `grids=False` leaves the organised grids on disk, `check=False` the checksums unread.

    Raises FormatError where it is no scan, of a higher version, or a file that scan.json lists is missing or changed.
    """
    folder = Path(folder)
    path = folder / files.SCAN if folder.is_dir() else folder
    doc = files.read_json(path, "a scan (a folder with scan.json)")
    files.check_format(doc, path, FORMAT, VERSION)
    folder = path.parent
    for key, kind, needed in (("files", dict, "an object {...}"), ("views", list, "a list [...]")):
        if not isinstance(doc.get(key), kind):
            came = f"is {files.shown(doc[key])}" if key in doc else "is missing"
            raise FormatError(f'{path}: "{key}" {came}; needed {needed}: copy the whole scan again')
    listed = doc["files"]
    for name, digest in listed.items():
        if files.check_relative(name) is not None or not (folder / name).is_file():
            raise FormatError(f"{folder}: {files.shown(name)} is missing; scan.json lists it: copy the whole folder")
        if check and sha256(folder / name) != digest:
            raise FormatError(f"{folder / name}: changed since the scan was written; reconstruct it again")
    out = [_read_grid(folder, entry, doc.get("grids") == "tif", path) for entry in doc["views"]] if grids else []
    pictures = [_read_picture(folder, entry, g, path) for entry, g in zip(doc["views"], out, strict=bool(out))]
    return StoredScan(folder, doc, tuple(out), tuple(pictures))


def _read_grid(folder: Path, entry: Any, tif: bool, path: Path) -> Grid:
    if not (isinstance(entry, dict) and isinstance(entry.get("camera"), str) and isinstance(entry.get("view"), int)):
        raise FormatError(f"{path}: views: {files.shown(entry)}; needed camera and view")
    camera = entry["camera"]
    if bad := files.check_name(camera):
        raise FormatError(f"{path}: views: camera {files.shown(camera)}: {bad}")
    sub = folder / camera
    if tif:
        images = Images(sub)
        xyz, sigma, reasons = (images.array(n) for n in ("xyz.tif", "sigma.tif", "reasons.png"))
    else:
        try:
            xyz, sigma, reasons = (np.load(sub / f"{n}.npy", allow_pickle=False) for n in ("xyz", "sigma", "reasons"))
        except (OSError, ValueError, EOFError) as e:
            raise FormatError(f"{sub}: grids missing or broken: {str(e).splitlines()[0][:120]}") from e
    h, w = reasons.shape[:2]
    if xyz.shape != (h, w, 3) or sigma.shape != (h, w) or xyz.dtype != np.float32 or reasons.dtype != np.uint16:
        raise FormatError(f"{sub}: grids of shapes {xyz.shape}, {sigma.shape}, {reasons.shape}; needed one size")
    return Grid(entry["view"], camera, xyz, sigma, reasons)


def _read_picture(folder: Path, entry: Mapping[str, Any], g: Grid, path: Path) -> Picture | None:
    told = entry.get("picture")
    if told is None:
        return None
    names = [told.get(k) for k in ("file", "pixel_format", "light")] if isinstance(told, dict) else []
    formats = {f.value: f for f in PixelFormat}
    if len(names) != 3 or not all(isinstance(n, str) for n in names) or names[1] not in formats:
        raise FormatError(f"{path}: views: picture {files.shown(told)}; needed file, pixel_format and light")
    file, fmt, light = str(names[0]), formats[names[1]], str(names[2])
    if bad := files.check_relative(file):
        raise FormatError(f"{path}: views: picture {files.shown(file)}: {bad}")
    try:
        png = file.endswith(".png")
        frame = Images(folder).frame(file, fmt) if png else np.load(folder / file, allow_pickle=False)
        picture = Picture(g.camera, frame, fmt, light)
    except (OSError, ValueError, EOFError, CaptureError) as e:
        raise FormatError(f"{folder / file}: picture missing or broken: {str(e).splitlines()[0][:160]}") from e
    if frame.shape[:2] != g.reasons.shape:
        raise FormatError(f"{folder / file}: a picture of {frame.shape[:2]}; its grid has {g.reasons.shape}")
    return picture


# ------------------------------------------------------------------------------------------------ a decoded capture


def put_decoded(
    folder: Path,
    views: Iterable[tuple[Decoded, F32, F32]],
    *,
    settings: Mapping[str, Any],
    capture_hash: str,
    pictures: Callable[[Decoded], Mapping[str, U8]] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes decoded views, each with its projector coordinates (u, v), into an existing folder; returns decoded.json.

    Per camera: phase_0.tif .. (one per direction, absolute radians) and u, v, NaN wherever a reason is set; modulation,
    background (all float32), reasons.png (16 bits); and preview-NAME.png of what `pictures` draws for people.
    """
    entries = []
    for d, u, v in views:
        sub = folder / d.camera
        sub.mkdir()
        lines = {f"phase_{i}": x.phase for i, x in enumerate(d.directions)} | {"u": u, "v": v}
        layers = {n: np.where(d.reasons == 0, a, np.float32(np.nan)) for n, a in lines.items()}
        layers |= {"modulation": d.modulation, "background": d.background}
        for name, a in layers.items():
            write_tiff(sub / f"{name}.tif", np.asarray(a, np.float32))
        write_png(sub / "reasons.png", np.asarray(d.reasons, np.uint16))
        for name, image in (pictures(d) if pictures else {}).items():
            write_png(sub / f"preview-{name}.png", image, 4)
        entries.append(
            {
                "camera": d.camera,
                "size": list(d.shape[::-1]),
                "directions": [
                    {
                        "cycles_per_pixel": list(x.g),
                        "file": f"phase_{i}.tif",
                        "valid": int((np.isfinite(x.phase) & (d.reasons == 0)).sum()),
                    }
                    for i, x in enumerate(d.directions)
                ],
                "pixels": int(d.reasons.size),
                "valid": int((d.reasons == 0).sum()),
                "lost": lost(d.reasons),
                "noise": plain(d.noise),
            }
        )
    doc = {
        "format": DECODED_FORMAT,
        "version": DECODED_VERSION,
        "software": {"name": "fringescope", "version": __version__},
        "created": _now(),
        "capture": capture_hash,
        "views": entries,
        "settings": plain(settings),
        **plain(extra or {}),
    }
    files.write_json(folder / files.DECODED, doc)
    return doc


def write_decoded(
    folder: Path | str, views: Iterable[tuple[Decoded, F32, F32]], *, force: bool = False, **how: Any
) -> dict[str, Any]:
    """A new folder of a decoded capture, whole or not at all: `new_folder` with `put_decoded`."""
    with files.new_folder(folder, marker=files.DECODED, force=force) as tmp:
        return put_decoded(tmp, views, **how)


def lost(reasons: U16) -> dict[str, int]:
    """Pixels per reason, by its label; a pixel may count under several."""
    return {r.label: n for r in Reason if (n := int(np.count_nonzero(reasons & np.uint16(r.value))))}
