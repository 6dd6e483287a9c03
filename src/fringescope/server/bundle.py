"""A case as one zip file that people and programs can use without a hub, and back in.

manifest.json     what it is, each file with its SHA-256, signed with the hub's key
events.jsonl      the log with its chain, an entry a line
report.pdf        for people
strokes/          guidelines files: one a version that was submitted, and the draft
scans/1/ ..       the folder of each scan: cloud.ply, surface.glb, surface.stl, photographs, grids
kept/OWNER/       what was made on the way: pictures for the projector, previews
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fringescope import __version__
from fringescope.errors import FormatError, FringescopeError, OutputError, UsageError
from fringescope.server import cases, journal, truth
from fringescope.server.blobs import Blobs
from fringescope.server.checkpoints import signature_fits, signed
from fringescope.server.unpacking import Unpacked, parsed
from fringescope.settings import ExaminationSettings
from fringescope.store import check_stroke
from fringescope.store.files import check_relative
from fringescope.wire import Case, Record, ScanFile, ScanInfo, Specimen
from fringescope.wire.documents import Line, Name, Patient
from fringescope.wire.record import GENESIS, canonical, check_chain

FORMAT, VERSION = "fringescope-bundle", 1
MANIFEST, EVENTS, REPORT = "manifest.json", "events.jsonl", "report.pdf"
_LONGEST = 64 << 20  #: of the manifest
_ENTRY = 8 << 20  #: of one entry of the log
_PIECE = 1 << 20
_SHOWN = 9  #: photographs of a projection in the report, the latest
_SMALL = (".json", ".jsonl")  #: what is worth compressing

Hex = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0, lt=2**63)]
ScanId = Annotated[str, Field(pattern=r"^sha256:[0-9a-f]{64}$")]
Short = Annotated[str, Field(max_length=1000)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Kept(_Model):
    """A file of a bundle; without an `owner` it was made for people alone and is not taken back in."""

    path: Annotated[str, Field(max_length=600)]
    sha256: Hex
    size: Count
    owner: Annotated[str, Field(pattern=r"^([A-Za-z0-9:._-]{1,200})?$")] = ""
    name: Annotated[str, Field(max_length=300)] = ""


class BundledScan(_Model):
    """A scan of it; `folder` is where its files lie."""

    id: ScanId
    rig: Annotated[str, Field(max_length=200)]
    label: Line
    taken_ns: Count
    figures: dict[str, Any]
    folder: Annotated[str, Field(max_length=200)]


class BundledCase(_Model):
    """What the case is."""

    id: Annotated[str, Field(pattern=r"^case-[0-9a-f]{20}$")]
    accession: Name
    status: Literal["open", "done", "archived"]
    specimen: Specimen
    created_ns: Count
    changed_ns: Count


class Printed(_Model):
    """Who an identifier in the log is."""

    name: Name
    role: Short


class Manifest(_Model):
    """manifest.json of a bundle."""

    format: Literal["fringescope-bundle"]
    version: int
    software: Short
    made_ns: Count
    case: BundledCase
    patient: Patient | None = None
    seq: Count
    head: Hex
    people: dict[Annotated[str, Field(max_length=200)], Printed]
    scans: list[BundledScan]
    files: list[Kept]
    key: Hex
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")]


class _Entry(_Model):
    """A line of events.jsonl."""

    case: Short
    seq: Count
    at_ns: Count
    said_ns: Count
    actor: Annotated[str, Field(max_length=200)]
    role: Annotated[str, Field(max_length=50)]
    client: Annotated[str, Field(max_length=200)]
    number: Count
    kind: Annotated[str, Field(max_length=50)]
    refused: Annotated[str, Field(max_length=4000)]
    salt: Annotated[str, Field(max_length=100)]
    payload: dict[str, Any]
    digest: Hex
    prev: Hex
    hash: Hex


@dataclass(frozen=True, eq=False)
class Gathered:
    """A case as it leaves, at one point of its log."""

    case: Case
    truth: truth.Truth
    seq: int
    head: str
    opened_ns: int
    actors: Mapping[str, str]  #: person -> role
    brought: Mapping[str, Any]  #: people that an earlier bundle named
    scans: Sequence[ScanInfo]
    kept: Mapping[str, Sequence[ScanFile]]  #: other files, by owner
    shown: Sequence[Mapping[str, Any]] = ()  #: what was photographed while it was projected


# ------------------------------------------------------------------------------------------------------------ leaving


def gather(engine: sa.Engine, case: Case, log: Path, settings: ExaminationSettings) -> Gathered:
    """Writes the log of a case to `log`, and tells what it amounts to. Raises UsageError for one that was erased."""
    now, seq, head, opened = truth.Truth(), 0, GENESIS, 0
    actors: dict[str, str] = {}
    brought: dict[str, Any] = {}
    shown = []
    with log.open("wb") as out:
        for r in journal.entries(engine, case.id):
            if r.payload is None or r.kind == "erased":
                raise UsageError("the case was erased; nothing of it is left to export")
            out.write(canonical(asdict(r)) + b"\n")
            if not r.refused:
                now = truth.follow(now, r, settings).truth
            seq, head, opened = r.seq, r.hash, opened or r.at_ns
            actors.setdefault(r.actor, r.role)
            if r.kind == "imported":
                brought |= r.payload.get("people", {})
            elif r.kind == "evidence" and not r.refused and isinstance(r.payload.get("pictures"), dict):
                shown.append(r.payload)
    if not seq:
        raise UsageError(f"case {case.id} has no log")
    files = cases.files_of(engine, case.id)
    scans = [s for s in cases.scans_of(engine, case.id) if s.id in now.scans]
    known = {v.number for v in now.exam.versions}
    taken = {s.id for s in scans}
    kept = {
        owner: found for owner, found in files.items()
        if owner not in taken and not (owner.startswith("version-") and owner[8:] not in map(str, known))
        and not owner.startswith("sha256:")
    }  # fmt: skip
    return Gathered(case, now, seq, head, opened, actors, brought, scans, kept, shown)


def people_of(g: Gathered, names: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Printed names of whoever the log names, by identifier; `names` are those of this hub."""
    out = {}
    for person, role in g.actors.items():
        name = names.get(person) or (g.brought.get(person) or {}).get("name")
        if name:
            out[person] = {"name": name, "role": role}
    return out


def strokes_files(g: Gathered) -> dict[str, dict[str, Any]]:
    """Guidelines files, by name: one a version, and the draft of each scan that has one."""
    out = {}
    rig = {s.id: s.rig for s in g.scans}
    for v in g.truth.exam.versions:
        out[f"strokes/version-{v.number}.json"] = _guidelines(g.truth.versions[v.number], v.scan, v.rig)
    drafts: dict[str, list[Mapping[str, Any]]] = {}
    for value in g.truth.of_kind("stroke").values():
        drafts.setdefault(value["scan"], []).append(value)
    for scan, values in drafts.items():
        n = next((i for i, s in enumerate(g.scans, 1) if s.id == scan), 0)
        out[f"strokes/draft-scan-{n}.json"] = _guidelines(values, scan, rig.get(scan, ""))
    return out


def _guidelines(values: Sequence[Mapping[str, Any]], scan: str, rig: str) -> dict[str, Any]:
    meaning = {v["stroke"]["id"]: v["meaning"] for v in values}
    author = {v["stroke"]["id"]: v["author"] for v in values}
    return {"format": "fringescope-guidelines", "version": 1, "scan": scan, "rig": rig,
            "strokes": [dict(v["stroke"]) for v in values], "meaning": meaning, "author": author}  # fmt: skip


def report_document(
    g: Gathered,
    people: Mapping[str, Any],
    made_ns: int,
    patient: Patient | None,
    blobs: Blobs,
    laid: Mapping[str, Path],
) -> dict[str, Any]:
    """What the report of a case tells, in plain values; files by their paths. `laid`: the folder of each scan."""
    c = g.case
    strokes = list(g.truth.of_kind("stroke").values())
    return {
        "case": c.id, "accession": c.accession, "status": c.status.value, "specimen": c.specimen.model_dump(),
        "patient": None if patient is None else patient.model_dump(), "created_ns": g.opened_ns or c.created_ns,
        "made_ns": made_ns, "seq": g.seq, "head": g.head, "software": __version__, "people": dict(people),
        "scans": [_scan_part(s, g, strokes, laid[s.id]) for s in g.scans],
        "versions": [_version_part(v, g, blobs) for v in g.truth.exam.versions],
        "comments": sorted((dict(x) for x in g.truth.of_kind("comment").values()), key=lambda x: x["at_ns"]),
        "signatures": [dict(x) for x in g.truth.signatures],
    }  # fmt: skip


def _scan_part(s: ScanInfo, g: Gathered, strokes: Sequence[Mapping[str, Any]], folder: Path) -> dict[str, Any]:
    on_it = [x for x in strokes if x["scan"] == s.id]
    known = {x["stroke"]["id"] for x in on_it}
    for v in g.truth.exam.versions:  # of a scan that is not the present one nothing else is left
        if v.scan == s.id:
            on_it += [x for x in g.truth.versions[v.number] if x["stroke"]["id"] not in known]
            known |= {x["stroke"]["id"] for x in on_it}
    by_camera: dict[str, list[dict[str, Any]]] = {}
    world = []
    for x in on_it:
        try:
            st = check_stroke(x["stroke"])
        except FringescopeError:
            continue
        told = {"id": st.id, "kind": st.kind.value, "color": list(st.color), "closed": st.closed, "text": st.text}
        if st.pixels is not None:
            by_camera.setdefault(str(st.camera), []).append({**told, "pixels": st.pixels.tolist()})
        else:
            world.append({**told, "world_mm": st.points.tolist()})
    figures = s.figures.get("figures")
    views = s.figures.get("views")
    pictures, words = [], []
    for view in views if isinstance(views, list) else []:
        camera, size = view.get("camera"), view.get("size")
        if (folder / f"photo-{camera}.jpg").is_file() and isinstance(size, list) and len(size) == 2 and min(size) > 0:
            pictures.append({"camera": camera, "file": str(folder / f"photo-{camera}.jpg"), "size": size,
                             "strokes": by_camera.get(str(camera), [])})  # fmt: skip
        words += [w for w in view.get("words", ()) if isinstance(w, str)][:5]
    measured = figures.get("specimen") if isinstance(figures, dict) else None
    return {
        "id": s.id, "label": s.label, "taken_ns": s.taken_ns, "words": words, "pictures": pictures, "world": world,
        "specimen": measured if isinstance(measured, dict) else None, "folder": str(folder),
    }  # fmt: skip


def _version_part(v: Any, g: Gathered, blobs: Blobs) -> dict[str, Any]:
    files = {f.name: blobs.path(f.sha256) for f in g.kept.get(f"version-{v.number}", ())}
    measured: list[Any] = []
    if (record := files.get("pattern.json")) is not None:
        try:
            measured = json.loads(record.read_text())["strokes"]
        except (OSError, ValueError, KeyError, TypeError):
            measured = []
    known = {f.sha256 for found in g.kept.values() for f in found}
    taken = [
        (Path(name).stem, str(blobs.path(sha256)), x.get("shown_ns")) for x in g.shown if x.get("version") == v.number
        for name, sha256 in sorted(x["pictures"].items()) if sha256 in known
    ]  # fmt: skip
    previews = [(n[8:-4], str(p)) for n, p in files.items() if n.startswith("preview-") and n.endswith(".jpg")]
    return {
        "number": v.number, "author": v.author, "phase": v.phase.value, "why": v.why, "content": v.content,
        "since_ns": v.since_ns, "strokes": len(v.strokes), "problems": list(v.problems), "previews": sorted(previews),
        "shown": taken[-_SHOWN:],
        "measured": [m for m in measured if isinstance(m, dict)],
    }  # fmt: skip


def write(
    path: Path, g: Gathered, made: Mapping[str, Path], blobs: Blobs, head: Mapping[str, Any], key: Ed25519PrivateKey
) -> None:
    """Writes a bundle: the files of the case, and `made`, those for people. Never holds one of them whole.

    Raises FormatError for a file that was damaged on this hub's disk, OutputError where the disk is full.
    """
    files: list[dict[str, Any]] = []
    folders = {s.id: f"scans/{n}" for n, s in enumerate(g.scans, 1)}
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as z:
            for name, source in made.items():
                sha256, size = _add(z, name, source)
                files.append({"path": name, "sha256": sha256, "size": size, "owner": "", "name": ""})
            owned = [(s.id, f) for s in g.scans for f in s.files]
            owned += [(owner, f) for owner, found in g.kept.items() for f in found]
            for owner, f in owned:
                name = f"{folders.get(owner) or 'kept/' + owner.replace(':', '-')}/{f.name}"
                sha256, size = _add(z, name, blobs.path(f.sha256))
                if sha256 != f.sha256:
                    raise FormatError(f"{f.name} of {owner} was damaged on the hub's disk; restore it from a backup")
                files.append({"path": name, "sha256": sha256, "size": size, "owner": owner, "name": f.name})
            scans = [{**s.model_dump(include={"id", "rig", "label", "taken_ns", "figures"}), "folder": folders[s.id]}
                     for s in g.scans]  # fmt: skip
            c = g.case
            case = c.model_dump(mode="json", include={"id", "accession", "status", "specimen", "created_ns",
                                                      "changed_ns"})  # fmt: skip
            doc = {"format": FORMAT, "version": VERSION, "software": f"fringescope {__version__}", "case": case,
                   "seq": g.seq, "head": g.head, "scans": scans, "files": files, **head}  # fmt: skip
            z.writestr(_info(MANIFEST), json.dumps(signed(doc, key), indent=1).encode())
    except OSError as e:
        raise OutputError(f"the bundle cannot be written: {e.strerror or e}; nothing was kept of it") from e


def _info(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    info.compress_type = zipfile.ZIP_DEFLATED if name.endswith(_SMALL) else zipfile.ZIP_STORED
    info.external_attr = 0o100640 << 16
    return info


def _add(z: zipfile.ZipFile, name: str, source: Path) -> tuple[str, int]:
    digest, size = hashlib.sha256(), 0
    with source.open("rb") as f, z.open(_info(name), "w", force_zip64=True) as out:
        while piece := f.read(_PIECE):
            digest.update(piece)
            size += len(piece)
            out.write(piece)
    return digest.hexdigest(), size


# ---------------------------------------------------------------------------------------------------------- coming in


def read_manifest(z: Unpacked) -> Manifest:
    """The manifest of a bundle, with each of its files compared. Raises FormatError, in a sentence for the screen."""
    doc = z.json(MANIFEST, _LONGEST)
    if doc.get("format") != FORMAT:
        raise FormatError(f"{z.what}: no bundle of a case; needed one that a hub has exported")
    version = doc.get("version")
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise FormatError(f"{z.what}: version {str(version)[:20]}; needed a whole number from 1 to {VERSION}")
    if version > VERSION:
        raise FormatError(f"{z.what}: version {version} is higher than this program reads ({VERSION}); update it")
    try:
        found = Manifest.model_validate(doc)
    except ValidationError as e:
        raise FormatError(f"{z.what}: its manifest is not in order: {_why(e)}") from None
    if not signature_fits(doc):
        raise FormatError(f"{z.what}: the signature of its manifest does not fit; it was altered since it was exported")
    listed = {f.path for f in found.files}
    if len(listed) != len(found.files) or (extra := set(z.entries) - listed - {MANIFEST}):
        more = f": {min(extra)[:80]!r}" if len(listed) == len(found.files) else ""
        raise FormatError(f"{z.what}: holds files that its manifest does not list, or lists twice{more}")
    scans = {s.id for s in found.scans}
    if len(scans) != len(found.scans) or len({(f.owner, f.name) for f in found.files if f.owner}) != sum(
        bool(f.owner) for f in found.files
    ):
        raise FormatError(f"{z.what}: a scan or a file is listed twice")
    for f in found.files:
        if f.owner and (bad := check_relative(f.name)):
            raise FormatError(f"{z.what}: a file of the name {f.name[:80]!r}: {bad}")
        if f.owner.startswith("sha256:") and f.owner not in scans:
            raise FormatError(f"{z.what}: {f.path[:80]!r} is of a scan that the manifest does not list")
        if z.sha256(f.path) != (f.sha256, f.size):
            raise FormatError(f"{z.what}: {f.path[:80]!r} was altered since it was exported")
    return found


def _why(e: ValidationError) -> str:
    one = e.errors()[0]
    return f"{'.'.join(str(x) for x in one['loc'])[:100]}: {one['msg'][:100]}"


def records(z: Unpacked, case: str) -> Iterator[Record]:
    """The log of a bundle. Raises FormatError."""
    number = 0
    with z.open(EVENTS) as f:
        while line := f.readline(_ENTRY + 1):
            number += 1
            if len(line) > _ENTRY:
                raise FormatError(f"{z.what}: event {number} is longer than {_ENTRY} bytes")
            try:
                e = _Entry.model_validate(parsed(line, f"{z.what}: event {number}"))
            except ValidationError as wrong:
                raise FormatError(f"{z.what}: event {number} is not in order: {_why(wrong)}") from None
            if e.case != case:
                raise FormatError(f"{z.what}: event {number} is of another case")
            yield Record(**{k: getattr(e, k) for k in _Entry.model_fields})


def check_log(z: Unpacked, m: Manifest, settings: ExaminationSettings, now_ns: int) -> truth.Truth:
    """What the log of a bundle amounts to, if its chain holds and it can be followed here. Raises FormatError."""
    now, seq, head = truth.Truth(), 0, GENESIS

    def passing() -> Iterator[Record]:
        nonlocal now, seq, head
        for r in records(z, m.case.id):
            if r.at_ns > now_ns + 3600 * 10**9:
                raise FormatError(f"{z.what}: event {r.seq} is of the future; set the clocks of both hubs")
            if r.kind == "erased":
                raise FormatError(f"{z.what}: the case was erased")
            if not r.refused:
                try:
                    fold = truth.follow(now, r, settings)
                except Exception as e:  # whatever a made-up event does, it must not do it at the hub's next start
                    raise FormatError(f"{z.what}: event {r.seq} makes no sense ({type(e).__name__})") from None
                if fold.refused:
                    raise FormatError(f"{z.what}: event {r.seq} could not happen here: {fold.refused}")
                now = fold.truth
            seq, head = r.seq, r.hash
            yield r

    faults = check_chain(passing(), m.case.id)
    if faults:
        raise FormatError(f"{z.what}: the log was altered: {faults[0]}")
    if (seq, head) != (m.seq, m.head) or not seq:
        raise FormatError(f"{z.what}: the log ends with event {seq}; its manifest says {m.seq}: it was cut or altered")
    return now
