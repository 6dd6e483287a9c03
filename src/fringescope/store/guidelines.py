"""Guidelines: the strokes that an expert drew, and `pattern.json`, which tells what became of them on the projector."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import numpy as np

from fringescope import __version__
from fringescope.errors import FormatError, GuidanceError, OutputError
from fringescope.store import files
from fringescope.store.scan import plain
from fringescope.types import Fill, Guidance, Guided, Guidelines, Landing, Side, Stroke, StrokeKind
from fringescope.types.guidance import stroke_points

FORMAT, VERSION = "fringescope-guidelines", 1
PATTERN_FORMAT, PATTERN_VERSION = "fringescope-pattern", 1

T = TypeVar("T")

MOST_POINTS = 2_000_000  #: of all lines together that a cut is compared with
NO_ID = "has no id (a word of printable letters); needed one"

#: names of colours that a file may use beside #rrggbb
COLOURS = {
    "red": "#ff3030",
    "green": "#00ff80",
    "blue": "#4080ff",
    "yellow": "#ffe000",
    "cyan": "#00e0ff",
    "magenta": "#ff40ff",
    "orange": "#ff9000",
    "white": "#ffffff",
}


def read_guidelines(path: Path | str) -> Guidelines:
    """The strokes of a guidelines file. What a single stroke has wrong is told in `refused`; the others are read.

    Of two with one id the first counts. Raises FormatError for a file that is none, or of a higher version.
    """
    path = Path(path)
    return parse_guidelines(files.read_json(path, "guidelines (a file with strokes)"), path)


def is_guidelines(path: Path | str) -> bool:
    """Whether a file says that it holds guidelines; a pattern.json does not. Raises FormatError for what is no JSON."""
    return files.read_json(Path(path), "guidelines or a pattern.json").get("format") == FORMAT


def parse_guidelines(doc: Mapping[str, Any], path: Path) -> Guidelines:
    """As `read_guidelines`, of a JSON object; `path` names it in messages."""
    files.check_format(doc, path, FORMAT, VERSION)
    listed = _listed(doc, path)
    for key in ("scan", "rig"):
        if not isinstance(doc.get(key), (str, type(None))):
            raise FormatError(f'{path}: "{key}" is {files.shown(doc[key])}; needed a hash ("sha256:..") or nothing')
    strokes, refused = _each(listed, _stroke)
    return Guidelines(tuple(strokes), doc.get("scan"), doc.get("rig"), refused)


def _listed(doc: Mapping[str, Any], path: Path) -> list[Any]:
    listed = doc.get("strokes")
    if not isinstance(listed, list):
        raise FormatError(f'{path}: "strokes" is {files.shown(listed)}; needed a list of strokes')
    return listed


def _each(listed: Sequence[Any], read: Callable[[str, Mapping[str, Any]], T]) -> tuple[list[T], dict[str, str]]:
    """What `read` makes of each stroke of a file, and why it makes nothing of the others. Of two with one id the first
    counts.
    """
    out: list[T] = []
    refused: dict[str, str] = {}
    seen: set[str] = set()
    for i, entry in enumerate(listed):
        name = entry.get("id") if isinstance(entry, Mapping) else None
        if not is_id(name):
            refused[f"strokes[{i}]"] = NO_ID
            continue
        if name in seen:
            refused[f"strokes[{i}]"] = f"has the id {files.shown(name)} of a stroke before it; needed one of its own"
            continue
        seen.add(name)
        try:
            out.append(read(name, entry))
        except GuidanceError as e:
            refused[name] = str(e)
    return out, refused


def read_strokes(
    path: Path | str, scan_hash: str | None, rig_hash: str | None
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The lines of a guidelines file, or of a pattern.json, that need no surface to be drawn on: dictionaries with "id"
    and one of "world_mm" (m, 3), "pixels" (m, 2) with "camera", or "segments" (k of (m, 2)) on the projector's plane;
    and "closed". With them, as of `read_guidelines`, the strokes that are refused, and why.

    Raises FormatError for another scan or rig than given, and where no stroke is left.
    """
    path = Path(path)
    doc = files.read_json(path, "guidelines or a pattern.json")
    for form, version in ((FORMAT, VERSION), (PATTERN_FORMAT, PATTERN_VERSION)):
        if doc.get("format") == form:
            files.check_format(doc, path, form, version)
    for key, ours in (("scan", scan_hash), ("rig", rig_hash)):
        if isinstance(doc.get(key), str) and ours is not None and doc[key] != ours:
            raise FormatError(f"{path}: drawn on another {key} ({doc[key][:24]}..); needed that of the scan before")
    listed = _listed(doc, path)
    out, refused = _each(listed, _plain_line)
    if not out:
        why = "; ".join(f"{k}: {v}" for k, v in list(refused.items())[:3])
        raise FormatError(f"{path}: nothing to compare the cut with; {why or 'there are no strokes'}")
    total = sum(len(x) for one in out for x in one.get("segments", [one.get("world_mm", one.get("pixels"))]))
    if total > MOST_POINTS:
        raise FormatError(f"{path}: {total} points; needed at most {MOST_POINTS} in all strokes")
    return out, refused


def _plain_line(name: str, d: Mapping[str, Any]) -> dict[str, Any]:
    """A stroke as a line. Raises GuidanceError for one that is more than the line through its points."""
    if isinstance(d.get("refused"), str):  # a record of what was not shown
        raise GuidanceError(f"was not shown: {d['refused']}")
    if isinstance(d.get("segments"), list):
        if not d["segments"]:
            raise GuidanceError("no part of it was shown")
        return {"id": name, "closed": False, "segments": [stroke_points(x, "segments", 2) for x in d["segments"]]}
    stroke = _stroke(name, d)
    if stroke.kind in (StrokeKind.CIRCLE, StrokeKind.OFFSETS, StrokeKind.TEXT):
        raise GuidanceError(f"is of the kind {stroke.kind.value}; add --rig rig.json, which draws it")
    line: dict[str, Any] = {"id": name, "closed": stroke.closed or stroke.kind is StrokeKind.REGION}
    if stroke.pixels is not None:
        return {**line, "pixels": stroke.pixels, "camera": stroke.camera}
    return {**line, "world_mm": stroke.points}


def check_stroke(entry: Mapping[str, Any]) -> Stroke:
    """One stroke of a guidelines file. Raises GuidanceError, which says what is wrong with it."""
    name = entry.get("id")
    if not is_id(name):
        raise GuidanceError(NO_ID)
    return _stroke(name, entry)


def is_id(name: object) -> TypeGuard[str]:
    """Whether it can be the id of a stroke."""
    return isinstance(name, str) and bool(name.strip()) and name.isprintable() and len(name) <= 200


def guidelines_document(guidelines: Guidelines, extra: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Guidelines as their file; `extra` adds keys."""
    bound = {k: v for k, v in (("scan", guidelines.scan), ("rig", guidelines.rig)) if v is not None}
    strokes = [_written(x) for x in guidelines.strokes]
    return {"format": FORMAT, "version": VERSION, **bound, "strokes": strokes, **plain(extra or {})}


def _written(x: Stroke) -> dict[str, Any]:
    out: dict[str, Any] = {"id": x.id, "kind": x.kind.value}
    if x.pixels is not None:
        out |= {"camera": x.camera, "pixels": np.round(x.pixels, 3).tolist()}
    else:
        out["world_mm"] = np.round(x.points, 4).tolist()
    usual = {f.name: f.default for f in dataclasses.fields(Stroke)}
    for key in ("width_mm", "width_px", "closed", "spacing_mm", "count", "radius_mm", "head_mm", "text", "size_mm"):
        if getattr(x, key) != usual[key]:
            out[key] = getattr(x, key)
    for key in ("fill", "side"):
        if getattr(x, key) is not usual[key]:
            out[key] = getattr(x, key).value
    return {**out, "color": "#{:02x}{:02x}{:02x}".format(*x.color)}


def _stroke(name: str, d: Mapping[str, Any]) -> Stroke:
    numbers = {k: _number(d, k) for k in ("width_mm", "width_px", "spacing_mm", "radius_mm", "head_mm", "size_mm")}
    given: dict[str, Any] = {k: v for k, v in numbers.items() if v is not None}
    if d.get("count") is not None:
        if not isinstance(d["count"], int) or isinstance(d["count"], bool):
            raise GuidanceError(f"count is {files.shown(d['count'])}; needed a whole number")
        if abs(d["count"]) > 1_000_000:
            raise GuidanceError(f"count is {files.shown(d['count'])}; needed 1 to 100 parallel lines")
        given["count"] = d["count"]
    for key, kind in (("kind", StrokeKind), ("fill", Fill), ("side", Side)):
        if d.get(key) is not None:
            given[key] = _choice(key, d[key], kind)
    for key, kinds, needed in (("closed", bool, "true or false"), ("text", str, "words"), ("camera", str, "a name")):
        if d.get(key) is not None:
            if not isinstance(d[key], kinds):
                raise GuidanceError(f"{key} is {files.shown(d[key])}; needed {needed}")
            given[key] = d[key]
    if "color" in d:
        given["color"] = parse_colour(d["color"])
    return Stroke(name, pixels=_list(d, "pixels"), world_mm=_list(d, "world_mm"), **given)


def _list(d: Mapping[str, Any], key: str) -> Any:
    value = d.get(key)
    if value is not None and not isinstance(value, list):
        raise GuidanceError(f"{key} is {files.shown(value)}; needed a list of points")
    return value


def _number(d: Mapping[str, Any], key: str) -> float | None:
    value = d.get(key)
    if value is None:
        return None
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise GuidanceError(f"{key} is {files.shown(value)}; needed a number")
    try:
        return float(value)
    except OverflowError:  # a whole number beyond what floats hold
        raise GuidanceError(f"{key} is {files.shown(value)}; needed a number of an everyday size") from None


def _choice(key: str, value: Any, kind: type[StrokeKind] | type[Fill] | type[Side]) -> Any:
    try:
        return kind(value)
    except ValueError:
        raise GuidanceError(f"{key} is {files.shown(value)}; there are {', '.join(k.value for k in kind)}") from None


def parse_colour(value: Any) -> tuple[int, int, int]:
    """ "#ff3030", "#f33" or a name to red, green, blue, 0..255 of sRGB. Raises GuidanceError."""
    text = COLOURS.get(value.strip().lower(), value.strip()) if isinstance(value, str) else ""
    if re.fullmatch(r"#[0-9a-fA-F]{3}", text):
        text = "#" + "".join(2 * c for c in text[1:])
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        raise GuidanceError(f"color is {files.shown(value)}; needed #rrggbb or one of {', '.join(COLOURS)}")
    r, g, b = (int(text[i : i + 2], 16) for i in (1, 3, 5))
    return r, g, b


# ------------------------------------------------------------------------------------------------------------ pattern


def pattern_document(
    guidance: Guidance,
    refused: Mapping[str, str],
    landings: Sequence[Landing] = (),
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """`pattern.json`: per stroke its visible pieces on the projector's plane, what is hidden and why, how exact.

    With `landings` each stroke also tells where it was found to land.
    """
    found = {x.id: x for x in landings}
    strokes = [_entry(g, found.get(g.stroke.id)) for g in guidance.strokes]
    strokes += [{"id": k, "segments": [], "hidden": [], "expected_error_um": None, "refused": v}
                for k, v in refused.items()]  # fmt: skip
    return {
        "format": PATTERN_FORMAT,
        "version": PATTERN_VERSION,
        "software": {"name": "fringescope", "version": __version__},
        "scan": guidance.scan,
        "rig": guidance.rig,
        "device": {"width": guidance.image.shape[1], "height": guidance.image.shape[0]},
        "strokes": strokes,
        **plain(extra or {}),
    }


def check_replaced(record: Path, force: bool) -> None:
    """Raises OutputError where `force` would replace a file that is no record of guidance."""
    if not force or not record.exists():
        return
    try:
        doc = files.read_json(record, "a record of guidance")
    except FormatError:
        doc = {}
    if doc.get("format") != PATTERN_FORMAT:
        raise OutputError(f"{record}: is no record of guidance and is not replaced; choose another folder for --out")


def _entry(g: Guided, landed: Landing | None) -> dict[str, Any]:
    out: dict[str, Any] = {
        "id": g.stroke.id,
        "kind": g.stroke.kind.value,
        "segments": [_rounded(s) for s in g.segments],
        "hidden": [
            {"segment": _rounded(h.segment), "why": h.why.value, "length_mm": round(h.length_mm, 3)} for h in g.hidden
        ],
        "expected_error_um": None if g.expected_error_um is None else round(g.expected_error_um, 2),
    }
    if g.refused is not None:
        return {**out, "refused": g.refused}
    out |= {"visible": round(g.visible, 4), "length_mm": round(g.length_mm, 3)}
    out |= {"length_sigma_mm": round(g.length_sigma_mm, 4)}
    if g.area_mm2 is not None and g.area_sigma_mm2 is not None:
        out |= {"area_mm2": round(g.area_mm2, 3), "area_sigma_mm2": round(g.area_sigma_mm2, 4)}
    if landed is not None:
        figures = {k: getattr(landed, k) for k in ("median_um", "p95_um", "max_um")}
        out["landed"] = {
            **{k: None if v is None else round(v, 2) for k, v in figures.items()},
            "share": round(landed.share, 3),
            "words": list(landed.words),
        }
    return {**out, "notes": list(g.notes)}


def _rounded(points: Any) -> list[list[float]]:
    """Plane coordinates to a thousandth of a unit: a twentieth of a micrometre on the tissue."""
    rounded: list[list[float]] = np.round(np.asarray(points, np.float64), 3).tolist()
    return rounded
