"""rig.json: reading with every check, writing with nothing lost."""

from __future__ import annotations

import math
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fringescope.errors import FormatError, RigError
from fringescope.store import files
from fringescope.types import F64, Camera, Layout, Lens, Pose, Projector, Rig, Volume

M = TypeVar("M", bound=BaseModel)

FORMAT, VERSION = "fringescope-rig", 1
LARGEST = 1e7  #: no number of a rig is larger: mm, pixels, distortion
SHORTEST = 1e-2  #: pixels, focal length
STEEPEST = 3.0  #: distortion stretches no place of a picture more than this; lenses as they are built stay below 2


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True)


class _Device(_Model):
    width: int = Field(ge=1, le=1_000_000)
    height: int = Field(ge=1, le=1_000_000)
    K: list[list[float]]
    distortion: list[float]
    R: list[list[float]]
    t: list[float]


class _Projector(_Device):
    layout: str = "grid"


class _Camera(_Device):
    name: str


class _Volume(_Model):
    center: list[float]
    axes: list[list[float]]
    half_size: list[float]


class _Rig(_Model):
    format: str
    version: int
    units: str = "mm"
    projector: _Projector
    cameras: list[_Camera] = Field(max_length=254)
    volume: _Volume | None = None


#: kind of a schema's error -> what was needed, in JSON's words
_NEEDED = {
    "int": "a whole number",
    "float": "a number",
    "finite_number": "a finite number",
    "string": "text in quotes",
    "bool": "true or false",
    "list": "a list [...]",
    "tuple": "a list [...]",
    "dict": "an object {{...}}",
    "model": "an object {{...}}",
    "greater_than_equal": "at least {ge:g}",
    "greater_than": "more than {gt:g}",
    "less_than_equal": "at most {le:g}",
    "less_than": "less than {lt:g}",
    "too_long": "at most {max_length} entries",
    "too_short": "at least {min_length} entries",
    "string_too_long": "at most {max_length} letters",
    "string_too_short": "at least {min_length} letters",
    "literal_error": "{expected}",
}


def explain(e: ValidationError, path: Path) -> str:
    """One line of the first thing that does not fit a file's schema: where, what was needed, what came."""
    errors = e.errors(include_url=False)
    first = errors[0]
    where = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in first["loc"]).lstrip(".")
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    place = files.shown(where)[1:-1] or "the whole"
    kind = first["type"]
    if kind == "missing":
        return f"{path}: {place} is missing{more}"
    words = _NEEDED.get(kind) or _NEEDED.get(kind.removesuffix("_type").removesuffix("_parsing"))
    needed = words.format(**first.get("ctx", {})) if words else "something else"
    return f"{path}: {place}: needed {needed}; came {files.shown(first['input'])}{more}"


def read_model(path: Path, what: str, format_: str, version: int, model: type[M]) -> M:
    """The JSON object of one of our files, checked: its format, its version, and every key that `model` knows.

    Raises FormatError, with `what` was needed.
    """
    doc = files.read_json(path, what)
    files.check_format(doc, path, format_, version)
    try:
        return model.model_validate(doc)
    except ValidationError as e:
        raise FormatError(explain(e, path)) from None


def parse_layout(name: str, path: Path) -> Layout:
    """ "grid" or "diamond". Raises FormatError."""
    try:
        return Layout(name)
    except ValueError:
        raise FormatError(f'{path}: projector.layout is {files.shown(name)}; needed "grid" or "diamond"') from None


def read_rig(path: Path | str) -> Rig:
    """The rig of a `rig.json`. Unknown keys are kept in `Rig.extra` (those of devices under "projector" and "cameras").

    Raises FormatError where it is no rig or of a higher version, RigError where it cannot be a rig (NaN, singular K).
    """
    path = Path(path)
    m = read_model(path, "a rig", FORMAT, VERSION, _Rig)
    if m.units != "mm":
        raise RigError(f'{path}: units {files.shown(m.units)}; needed "mm"')
    layout = parse_layout(m.projector.layout, path)
    where = "projector"
    try:
        p = m.projector
        w, h = (2 * p.width if layout is Layout.DIAMOND else p.width), p.height
        projector = Projector(p.width, p.height, layout, _lens(p, w, h), _pose(p))
        cameras = []
        for i, c in enumerate(m.cameras):
            where = f"cameras[{i}]"
            if bad := files.check_name(c.name):
                raise RigError(f"name {files.shown(c.name)}: {bad}")
            where = f"camera '{c.name}'"
            cameras.append(Camera(c.name, _lens(c, c.width, c.height), _pose(c)))
        where = "volume"
        v = m.volume
        volume = None if v is None else Volume(_np(v.center), _np(v.axes), _np(v.half_size))
        where = "cameras"
        return Rig(projector, tuple(cameras), volume, MappingProxyType(_extra(m)))
    except RigError as e:
        raise RigError(f"{path}: {where}: {e}") from None


def _lens(d: _Device, width: int, height: int) -> Lens:
    lens = Lens(width, height, _np(d.K), _np(d.distortion))
    if min(lens.K[0, 0], lens.K[1, 1]) < SHORTEST:
        raise RigError(f"K: focal lengths {lens.K[0, 0]:g}, {lens.K[1, 1]:g} pixels; needed at least {SHORTEST:g}")
    _check_distortion(lens)
    return lens


def _check_distortion(lens: Lens) -> None:
    """Refuses a lens that images two directions, or hardly any, in one place of its own picture. Raises RigError.

    Follows straight lines from the axis towards the picture's edge, as far as the derivative of OpenCV's five-term
    model is positive definite: a lens may fold beyond its picture.
    """
    W, H, K, (k1, k2, p1, p2, k3) = lens.width, lens.height, lens.K, lens.distortion
    along, zero = np.linspace(0.0, 1.0, 33), np.zeros(33)
    edge = np.concatenate([[along, zero], [along, zero + 1], [zero, along], [zero + 1, along]], axis=1)
    y = (edge[1] * (H - 1) - K[1, 2]) / K[1, 1]
    x = (edge[0] * (W - 1) - K[0, 2] - K[0, 1] * y) / K[0, 0]
    r = np.hypot(x, y)
    far = r > 0
    steps = r.max(initial=1e-12) * np.geomspace(1e-9, 1e2, 600)
    x, y = x[far, None] / r[far, None] * steps, y[far, None] / r[far, None] * steps
    r2 = steps * steps
    c = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    d = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    u = c * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = c * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    u, v = K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2]
    uu, uv = c + x * x * d + 2 * p1 * y + 6 * p2 * x, x * y * d + 2 * (p1 * x + p2 * y)
    vv = c + y * y * d + 6 * p1 * y + 2 * p2 * x
    middle, swing = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    inside = (u >= 0) & (u <= W - 1) & (v >= 0) & (v <= H - 1)
    folds = middle - swing <= 0
    times = np.cumsum(folds, axis=1)
    steep = (times == 0) & (middle + swing > STEEPEST)
    for wrong, what in ((folds & (times == 1), "folds"), (steep, f"stretches more than {STEEPEST:g} times")):
        if (wrong & inside).any():
            i = int(np.where(wrong & inside, steps, np.inf).argmin())
            raise RigError(
                f"distortion {lens.distortion.tolist()}: {what} at ({u.flat[i]:.0f}, {v.flat[i]:.0f}) of its "
                f"picture, {W} x {H}; needed one place per direction: calibrate anew, or mend distortion or K"
            )


def _pose(d: _Device) -> Pose:
    return Pose(_np(d.R), _np(d.t))


def _np(a: Any) -> F64:
    """Refuses numbers with which nothing can be computed; types.py makes and checks the array."""
    for x in a:
        if isinstance(x, list):
            _np(x)
        elif math.isfinite(x) and (abs(x) > LARGEST or 0 < abs(x) < 1e-100):
            raise RigError(f"the number {x!r:.30}; needed 0 or a magnitude of at most {LARGEST:g}")
    return cast(F64, a)


def _extra(m: _Rig) -> dict[str, Any]:
    out: dict[str, Any] = dict(m.model_extra or {})
    if m.projector.model_extra:
        out["projector"] = dict(m.projector.model_extra)
    cameras = {c.name: dict(c.model_extra) for c in m.cameras if c.model_extra}
    if cameras:
        out["cameras"] = cameras
    if m.volume is not None and m.volume.model_extra:
        out["volume"] = dict(m.volume.model_extra)
    return out


def rig_document(rig: Rig) -> dict[str, Any]:
    """The rig as the JSON object of its file."""
    extra = dict(rig.extra)
    of_projector, of_cameras, of_volume = extra.pop("projector", {}), extra.pop("cameras", {}), extra.pop("volume", {})

    def device(d: Camera | Projector) -> dict[str, Any]:
        arrays = {"K": d.lens.K, "distortion": d.lens.distortion, "R": d.pose.R, "t": d.pose.t}
        return {k: a.tolist() for k, a in arrays.items()}

    p = rig.projector
    doc: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "units": "mm",
        "projector": {"width": p.width, "height": p.height, "layout": p.layout.value, **device(p), **of_projector},
        "cameras": [
            {"name": c.name, "width": c.lens.width, "height": c.lens.height, **device(c), **of_cameras.get(c.name, {})}
            for c in rig.cameras
        ],
    }
    if rig.volume is not None:
        v = rig.volume
        box = {"center": v.center, "axes": v.axes, "half_size": v.half_size}
        doc["volume"] = {**{k: a.tolist() for k, a in box.items()}, **of_volume}
    return {**doc, **extra}


def write_rig(path: Path | str, rig: Rig, *, force: bool = False) -> None:
    """The rig as `rig.json`, with the keys that `Rig.extra` kept. Raises OutputError."""
    with files.new_file(path, force=force) as tmp:
        files.write_json(tmp, rig_document(rig))


def hash_rig(path: Path | str) -> str:
    """ "sha256:..." of a rig's file, whatever its white space and the order of its keys. Raises FormatError."""
    return files.canonical_hash(files.read_json(Path(path), "a rig"))
