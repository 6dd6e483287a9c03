"""A case as a report for people: specimen, pictures with strokes, measurements, versions, words, signatures."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fringescope.report.pdf import Part, Shown, write_pdf
from fringescope.types import U8

NOTICE = "Research use only. Not a medical device; not for diagnosis or treatment."
_DRAWN_AT = 1000, 1400  #: pixels: a picture is made this wide, least and most, before strokes are drawn on it
_MOST_STROKES = 60  #: that have a line of their own in a table


def write_case(path: Path | str, doc: Mapping[str, Any], pictures: Mapping[str, U8]) -> int:
    """Writes the report of a case; returns how many pages it has.

    `doc` is what `server.bundle` tells of a case, in plain values; `pictures` are those that it names, (h, w, 3) RGB.
    """
    name = doc["specimen"].get("pseudonym") or doc["accession"]
    foot = f"{NOTICE} Case {doc['case']}, log to event {doc['seq']} ({str(doc['head'])[:16]}…)"
    parts = [
        Part("Examination with Fringescope", [NOTICE], level=0),
        Part("Case", rows=_facts(doc), columns=(1, 3)),
        *(p for i, s in enumerate(doc["scans"], 1) for p in _scan(i, s, pictures)),
        *_versions(doc, pictures),
        *_comments(doc),
        *_signatures(doc),
        _about(doc),
    ]
    return write_pdf(path, f"Fringescope, {name}", foot, parts)


def when(ns: int | None) -> str:
    """A time in UTC, for people."""
    if not ns:
        return "unknown"
    return f"{datetime.datetime.fromtimestamp(ns / 1e9, datetime.UTC):%Y-%m-%d %H:%M:%S} UTC"


def _facts(doc: Mapping[str, Any]) -> list[list[str]]:
    s = doc["specimen"]
    rows = [["Accession number", doc["accession"]], ["Pseudonym", s.get("pseudonym", "")]]
    if (p := doc.get("patient")) is not None:
        rows += [["Patient", p["name"]], ["Patient's number", p["identifier"]], ["Born", p["born"]]]
    rows += [[k.capitalize(), s.get(k, "")] for k in ("organ", "side", "kind", "notes")]
    rows += [["Status", doc["status"]], ["Opened", when(doc["created_ns"])], ["Report made", when(doc["made_ns"])]]
    return [[k, v] for k, v in rows if v]


# --------------------------------------------------------------------------------------------------------------- scans


def _scan(n: int, s: Mapping[str, Any], pictures: Mapping[str, U8]) -> list[Part]:
    label = f": {s['label']}" if s["label"] else ""
    lines = [f"Taken {when(s['taken_ns'])}. {s['id']}", *s["words"]]
    rows = _measured(s.get("specimen") or {})
    out = [Part(f"Scan {n}{label}", lines)]
    if rows:
        head = ("Specimen", "Value", "Uncertainty (1 s.d.)")
        out.append(Part("Measurements", head=head, rows=rows, columns=(3, 2, 2), level=2))
    shown = [
        Shown(drawn(pictures[p["file"]], p["strokes"], p["size"]), _caption(p))
        for p in s["pictures"] if p["file"] in pictures
    ]  # fmt: skip
    if shown:
        out.append(Part("Photographs with what is drawn on them", pictures=shown, across=1 + (len(shown) > 1), level=2))
    return out


def _caption(p: Mapping[str, Any]) -> str:
    n = len(p["strokes"])
    left = p.get("left_out", 0)
    return f"{p['camera']}: " + (f"{n} stroke{'s' if n != 1 else ''}" if n else "nothing is drawn on it") + (
        f"; {left} more cannot be shown here" if left else ""
    )  # fmt: skip


_QUANTITIES = (("length", "mm", 2), ("width", "mm", 2), ("height", "mm", 3), ("footprint", "mm2", 1),
               ("surface", "mm2", 1), ("volume", "mm3", 1))  # fmt: skip
_UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³"}


def _measured(said: Mapping[str, Any]) -> list[list[str]]:
    rows: list[list[str]] = []
    pieces = said.get("pieces") or []
    for i, p in enumerate(pieces[:10], 1):
        of = f"piece {i}: " if len(pieces) > 1 else ""
        for name, unit, digits in _QUANTITIES:
            value, sigma = p.get(f"{name}_{unit}"), p.get(f"{name}_sigma_{unit}")
            if isinstance(value, (int, float)):
                told = f"± {sigma:.{digits}f} {_UNITS[unit]}" if isinstance(sigma, (int, float)) else "not known"
                rows.append([of + name, f"{value:.{digits}f} {_UNITS[unit]}", told])
        for name, words in (("filled", "not seen, interpolated"), ("cut_off", "outline outside the measured field")):
            if isinstance(p.get(name), (int, float)) and p[name] >= 0.005:
                rows.append([of + words, f"{100 * p[name]:.0f} %", ""])
    if not rows and said.get("why"):
        rows.append(["not measured", str(said["why"]), ""])
    return rows


def drawn(picture: U8, strokes: Sequence[Mapping[str, Any]], size: Sequence[int]) -> U8:
    """A photograph with strokes on it; their pixels are those of a camera of `size` (width, height)."""
    h, w = picture.shape[:2]
    k = min(max(1.0, _DRAWN_AT[0] / w), _DRAWN_AT[1] / w)
    how = cv2.INTER_AREA if k < 1 else cv2.INTER_CUBIC
    out = cv2.resize(picture, (max(1, round(w * k)), max(1, round(h * k))), interpolation=how)
    out = np.ascontiguousarray(out)
    per = np.array([out.shape[1] / size[0], out.shape[0] / size[1]])
    wide = max(1, round(out.shape[1] / 450))
    for s in strokes:
        at = (np.asarray(s["pixels"], np.float64).reshape(-1, 2) + 0.5) * per - 0.5
        at = np.clip(at, -1e4, 1e4)
        points = np.round(at).astype(np.int32)
        rgb = tuple(int(c) for c in s["color"])
        closed = bool(s.get("closed")) or s.get("kind") == "region"
        for colour, more in (((0, 0, 0), 2), (rgb, 0)):  # a dark rim, so that it is seen on any tissue
            if len(points) == 1:
                cv2.circle(out, points[0].tolist(), 6 * wide, colour, wide + more, cv2.LINE_AA)
            elif s.get("kind") == "arrow":
                cv2.polylines(out, [points[:-1]], False, colour, wide + more, cv2.LINE_AA)
                cv2.arrowedLine(out, points[-2].tolist(), points[-1].tolist(), colour, wide + more, cv2.LINE_AA)
            else:
                cv2.polylines(out, [points], closed, colour, wide + more, cv2.LINE_AA)
        words = str(s.get("text") or s.get("id", ""))[:24].encode("ascii", "replace").decode()
        where = (int(points[0, 0]) + 4 * wide, int(points[0, 1]) - 4 * wide)
        scale = out.shape[1] / 1400
        for colour, more in (((0, 0, 0), 2), (rgb, 0)):
            cv2.putText(out, words, where, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, wide + more, cv2.LINE_AA)
    return np.asarray(out, np.uint8)


# ----------------------------------------------------------------------------------------------- versions and words


def _name(doc: Mapping[str, Any], person: str) -> str:
    if person == "instrument":
        return "the instrument"
    return str(doc["people"].get(person, {}).get("name") or person)


def _named(doc: Mapping[str, Any], text: str) -> str:
    """A sentence with names in the place of identifiers."""
    return re.sub(r"person-[0-9a-f]{20}", lambda m: _name(doc, m.group()), text)


def _versions(doc: Mapping[str, Any], pictures: Mapping[str, U8]) -> list[Part]:
    if not doc["versions"]:
        return [Part("Guidelines", ["None was submitted."])]
    rows = [
        [str(v["number"]), _name(doc, v["author"]), when(v["since_ns"]),
         v["phase"] + (f": {_named(doc, v['why'])}" if v["why"] else ""), str(v["strokes"]), f"{v['content'][:12]}…"]
        for v in doc["versions"]
    ]  # fmt: skip
    head = ("No.", "By", "Since", "State", "Strokes", "Content")
    out = [Part("Guidelines that were submitted", head=head, rows=rows, columns=(1.4, 3.6, 6, 6, 2.4, 5))]
    for v in doc["versions"]:
        lines = [f"Problem: {p}" for p in v["problems"][:20]]
        measured = [_stroke_row(m) for m in v["measured"][:_MOST_STROKES]]
        if (more := len(v["measured"]) - _MOST_STROKES) > 0:
            lines.append(f"And {more} strokes more, in the file of version {v['number']}.")
        shown = [
            Shown(pictures[f], f"version {v['number']}, as it is projected: {of}")
            for of, f in v["previews"]
            if f in pictures
        ]
        shown += [
            Shown(pictures[f], f"projected on the specimen, {when(at)}: {of}")
            for of, f, at in v["shown"]
            if f in pictures
        ]
        if lines or measured or shown:
            out.append(
                Part(f"Version {v['number']}", lines, ("Stroke", "Length", "Area", "Expected error", "Visible"),
                     measured, (4, 4, 4, 3, 2), shown,
                     min(3, max(1, len(shown))), 2)
            )  # fmt: skip
    return out


def _stroke_row(m: Mapping[str, Any]) -> list[str]:
    def pair(name: str, unit: str, digits: int) -> str:
        value, sigma = m.get(f"{name}_{unit}"), m.get(f"{name}_sigma_{unit}")
        if not isinstance(value, (int, float)):
            return ""
        doubt = f" ± {sigma:.{digits}f}" if isinstance(sigma, (int, float)) else ""
        return f"{value:.{digits}f}{doubt} {_UNITS[unit]}"

    error, seen = m.get("expected_error_um"), m.get("visible")
    return [
        str(m.get("id", "")), pair("length", "mm", 2), pair("area", "mm2", 1),
        f"{error:.0f} µm" if isinstance(error, (int, float)) else str(m.get("refused") or ""),
        f"{100 * seen:.0f} %" if isinstance(seen, (int, float)) else "",
    ]  # fmt: skip


def _comments(doc: Mapping[str, Any]) -> list[Part]:
    rows = []
    for c in doc["comments"]:
        about = [f"stroke {c['stroke']}"] if c.get("stroke") else []
        about += [f"version {c['version']}"] if c.get("version") else []
        rows.append([when(c["at_ns"]), _name(doc, c["author"]), ", ".join(about), c["text"]])
    if not rows:
        return []
    return [Part("Comments", head=("Time", "By", "About", "Words"), rows=rows, columns=(5.5, 4, 3.5, 9))]


def _signatures(doc: Mapping[str, Any]) -> list[Part]:
    if not doc["signatures"]:
        return [Part("Signatures", ["Nothing was signed."])]
    rows = [
        [_name(doc, s["actor"]), s["role"], when(s["at_ns"]), f"{s['meaning']}, version {s['version']}"]
        for s in doc["signatures"]
    ]
    line = "Each was given with the password of the person, and is bound to the content hash of the version."
    bound = {(s["version"], s["content"]): None for s in doc["signatures"]}
    return [
        Part("Signatures", [line], ("Printed name", "Role", "Time", "Meaning"), rows, (5, 3, 5, 5)),
        Part("What was signed", (), ("Version", "Content hash"), [[str(v), c] for v, c in bound], (1, 7), level=2),
    ]


def _about(doc: Mapping[str, Any]) -> Part:
    lines = [
        f"This report was made by Fringescope {doc['software']} out of the log of case {doc['case']}: {doc['seq']} "
        f"events, of which the last has the hash {doc['head']}.",
        "The hash covers all events before it. Compare it with the events.jsonl beside this report, or with a signed "
        "checkpoint of the hub (fringescope audit verify).",
    ]
    if doc.get("patient") is None:
        lines.append(
            "The patient is not named here. The accession number and what people wrote may still point to them."
        )
    return Part("About this report", lines)
