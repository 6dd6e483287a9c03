"""What a case's log amounts to: the examination, strokes, layers, comments and signatures, folded event by event.

Pure logic, as `examination` is: the same events give the same truth, so a replay is free and a log can be judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fringescope import examination
from fringescope.errors import FormatError, GuidanceError
from fringescope.settings import ExaminationSettings
from fringescope.store import check_stroke
from fringescope.types.examination import (
    Acknowledge,
    Arm,
    CarryOver,
    Effect,
    Event,
    Examination,
    Put,
    Remove,
    Role,
    Start,
    Stop,
    Submit,
    What,
)
from fringescope.wire.record import Record, content_of_stroke

ERASED = "the case was erased; open another"
MOST = 5000  #: strokes, layers or comments of a case
UNDOABLE = 500  #: the latest ops of a case that can be taken back; a case that goes on for days stays as small

Item = tuple[str, str]  #: ("stroke" | "layer" | "comment", identifier)


@dataclass(frozen=True)
class Done:
    """What an event changed, so that it can be taken back: an item, before and after."""

    actor: str
    item: Item
    before: Mapping[str, Any] | None
    after: Mapping[str, Any] | None
    undone: bool = False
    backward: bool = False  #: it took something back: what is undone next lies before it


@dataclass(frozen=True)
class Truth:
    """Where a case stands. `items`: what is drawn and said, by kind and identifier; each knows its author."""

    exam: Examination = field(default_factory=Examination)
    items: Mapping[Item, Mapping[str, Any]] = field(default_factory=dict)
    done: Mapping[int, Done] = field(default_factory=dict)
    versions: Mapping[int, tuple[Mapping[str, Any], ...]] = field(default_factory=dict)  #: strokes as submitted
    signatures: tuple[Mapping[str, Any], ...] = ()
    scans: tuple[str, ...] = ()
    erased: bool = False
    brought: int = 0  #: versions up to this number were checked on another instrument: not to be shown on this one

    def of_kind(self, kind: str) -> dict[str, Mapping[str, Any]]:
        """The strokes, layers or comments, by identifier."""
        return {name: value for (k, name), value in self.items.items() if k == kind}


@dataclass(frozen=True)
class Fold:
    """What an event made of a truth: with the payload as the log keeps it, which names what was taken back."""

    truth: Truth
    payload: dict[str, Any]
    effects: tuple[Effect, ...] = ()
    refused: str = ""


class _NoError(Exception):
    """Why nothing comes of an event."""


def follow(truth: Truth, r: Record, settings: ExaminationSettings | None = None) -> Fold:
    """The truth after an event. Never raises for what an event says: see `Fold.refused`."""
    payload = dict(r.payload or {})
    if truth.erased:
        return Fold(truth, {}, refused=r.refused or ERASED)  # what comes too late is not kept
    if r.payload is None:
        return Fold(truth, payload, refused=r.refused or ERASED)
    try:
        return _follow(truth, r, payload, settings or ExaminationSettings())
    except _NoError as e:
        return Fold(truth, payload, refused=str(e))


def _follow(truth: Truth, r: Record, payload: dict[str, Any], s: ExaminationSettings) -> Fold:
    match r.kind:
        case "put":
            return _put(truth, r, payload, s)
        case "remove":
            return _item(truth, r, payload, ("stroke", payload["stroke"]), None, s)
        case "layer":
            value = {"name": payload["name"], "hidden": payload["hidden"], "author": r.actor}
            return _item(truth, r, payload, ("layer", payload["layer"]), value, s)
        case "comment":
            if ("comment", payload["comment"]) in truth.items:
                raise _NoError(f"comment {payload['comment']} is there already; give the new one another id")
            value = {k: payload.get(k) for k in ("text", "stroke", "version", "place_mm")}
            value |= {"author": r.actor, "at_ns": r.at_ns}
            return _item(truth, r, payload, ("comment", payload["comment"]), value, s)
        case "withdraw":
            return _item(truth, r, payload, ("comment", payload["comment"]), None, s)
        case "undo":
            return _undo(truth, r, payload, s)
        case "sign":
            return _sign(truth, r, payload)
        case "preview" | "arm" | "start" if payload["version"] <= truth.brought:
            raise _NoError(f"version {payload['version']} was checked on another instrument; submit its strokes anew")
        case "preview" | "opened" | "changed" | "invited" | "revoked" | "joined":
            return Fold(truth, payload)
        case "evidence":  # may name a scan that is not the present one
            more = (payload["scan"],) if "scan" in payload else ()
            return Fold(replace(truth, scans=(*truth.scans, *more)), payload)
        case "imported":
            return Fold(replace(truth, brought=len(truth.exam.versions)), payload)
        case "erased":
            return Fold(Truth(erased=True), {**payload, "through": r.seq - 1})
        case _:
            return _word(truth, r, payload, s)


# -------------------------------------------------------------------------------------------------- what can be undone


def _put(truth: Truth, r: Record, payload: dict[str, Any], s: ExaminationSettings) -> Fold:
    document = payload["stroke"]
    try:
        check_stroke(document)
    except (GuidanceError, FormatError) as e:
        raise _NoError(f"stroke {document.get('id', '')}: {e}") from None
    meaning = payload.get("meaning", "cut")
    value = {
        "stroke": document, "meaning": meaning, "layer": payload.get("layer", ""), "scan": payload["scan"],
        "author": r.actor, "content": content_of_stroke(document, meaning),
    }  # fmt: skip
    return _item(truth, r, payload, ("stroke", document["id"]), value, s)


def _item(
    truth: Truth, r: Record, payload: dict[str, Any], item: Item, value: Mapping[str, Any] | None,
    s: ExaminationSettings,
) -> Fold:  # fmt: skip
    """An item made, changed or (None) taken away by its author."""
    kind, name = item
    before = truth.items.get(item)
    if before is None and value is None:
        raise _NoError(f"no {kind} {name}; it may be removed already")
    if before is not None and before["author"] != r.actor:
        raise _NoError(f"{kind} {name} is {before['author']}'s; only its author changes it")
    exam, effects = _tell_exam(truth.exam, r, item, value, s)
    items = dict(truth.items)
    _place(items, item, value)
    if len(items) > MOST:
        raise _NoError(f"more than {MOST} strokes, layers and comments in one case; remove some first")
    done = _latest({**truth.done, r.seq: Done(r.actor, item, before, value)})
    return Fold(replace(truth, exam=exam, items=items, done=done), payload, effects)


def _latest(done: dict[int, Done]) -> dict[int, Done]:
    while len(done) > UNDOABLE:
        del done[next(iter(done))]
    return done


def _place(items: dict[Item, Mapping[str, Any]], item: Item, value: Mapping[str, Any] | None) -> None:
    if value is None:
        items.pop(item, None)
    else:
        items[item] = value


def _tell_exam(
    exam: Examination, r: Record, item: Item, value: Mapping[str, Any] | None, s: ExaminationSettings
) -> tuple[Examination, tuple[Effect, ...]]:
    """The examination knows strokes alone."""
    if item[0] != "stroke":
        return exam, ()
    what: What = Remove(item[1]) if value is None else Put(item[1], value["content"], value["scan"])
    return _applied(exam, r, what, s)


def _undo(truth: Truth, r: Record, payload: dict[str, Any], s: ExaminationSettings) -> Fold:
    of = payload.get("of")
    if of is None:
        of = max(
            (n for n, d in truth.done.items() if d.actor == r.actor and not (d.undone or d.backward)), default=None
        )
        if of is None:
            raise _NoError("nothing of yours is left to undo")
    done = truth.done.get(of)
    if done is None:
        raise _NoError(f"event {of} cannot be undone; strokes, layers and comments of the last {UNDOABLE} ops can")
    if done.actor != r.actor:
        raise _NoError(f"event {of} is {done.actor}'s; only its author undoes it")
    if done.undone:
        raise _NoError(f"event {of} is undone already")
    if truth.items.get(done.item) != done.after:
        raise _NoError(f"{done.item[0]} {done.item[1]} was changed since event {of}; undo that first")
    exam, effects = _tell_exam(truth.exam, r, done.item, done.before, s)
    items = dict(truth.items)
    _place(items, done.item, done.before)
    back = Done(r.actor, done.item, done.after, done.before, backward=not done.backward)
    marked = _latest({**truth.done, of: replace(done, undone=True), r.seq: back})
    was = {"kind": done.item[0], "id": done.item[1], "value": None if done.before is None else dict(done.before)}
    return Fold(replace(truth, exam=exam, items=items, done=marked), {**payload, "of": of, "does": was}, effects)


def _sign(truth: Truth, r: Record, payload: dict[str, Any]) -> Fold:
    version = next((v for v in truth.exam.versions if v.number == payload["version"]), None)
    if version is None:
        raise _NoError(f"no version {payload['version']}; there are {len(truth.exam.versions)}")
    if version.content != payload["content"]:
        raise _NoError(f"version {version.number} is not what you saw; look at it again and sign then")
    signed = {**payload, "actor": r.actor, "role": r.role, "at_ns": r.at_ns, "seq": r.seq}
    return Fold(replace(truth, signatures=(*truth.signatures, signed)), payload)


# ------------------------------------------------------------------------------------------- words of the examination


def _word(truth: Truth, r: Record, payload: dict[str, Any], s: ExaminationSettings) -> Fold:
    what = word_of(r.kind, payload)
    before = truth.exam
    exam, effects = _applied(before, r, what, s)
    changed = replace(truth, exam=exam)
    if isinstance(what, Submit):
        drawn = truth.of_kind("stroke")
        taken = tuple({**drawn[name], "id": name} for name, _ in what.strokes)
        changed = replace(changed, versions={**truth.versions, exam.versions[-1].number: taken})
    elif isinstance(what, CarryOver):
        items = dict(truth.items)
        for document in payload["strokes"]:
            meaning = document.get("meaning", "cut")
            items["stroke", document["stroke"]["id"]] = {
                **document, "scan": what.scan, "author": r.actor, "layer": "",
                "content": content_of_stroke(document["stroke"], meaning),
            }  # fmt: skip
        changed = replace(changed, items=items)
    elif r.kind == "ScanTaken":
        changed = replace(changed, scans=(*truth.scans, payload["scan"]))
    return Fold(changed, payload, effects)


def word_of(kind: str, payload: Mapping[str, Any]) -> What:
    """The word of an examination that an event of the log stands for."""
    match kind:
        case "submit":
            pairs = tuple((str(a), str(b)) for a, b in payload["strokes"])
            return Submit(pairs, payload["scan"], payload["rig"])
        case "arm":
            return Arm(payload["version"], payload["content"], payload["pattern"])
        case "start":
            return Start(payload["version"], payload["pattern"])
        case "acknowledge":
            return Acknowledge(int(payload["suspect"]))
        case "stop":
            return Stop(payload.get("version"), payload.get("why", ""))
        case "carry_over":
            strokes = tuple(
                (x["stroke"]["id"], content_of_stroke(x["stroke"], x.get("meaning", "cut"))) for x in payload["strokes"]
            )
            return CarryOver(payload["version"], strokes, payload["scan"], payload["residual_um"])
    try:
        word: What = examination.from_dict({**payload, "kind": kind})
    except FormatError as e:
        raise _NoError(str(e)) from None
    return word


def _applied(
    exam: Examination, r: Record, what: What, s: ExaminationSettings
) -> tuple[Examination, tuple[Effect, ...]]:
    """The log's order and its identifiers make every event new: its number in the log is its number there."""
    role = Role.OBSERVER if r.role == "admin" else Role(r.role)
    event = Event(r.at_ns, r.actor, role, "log", r.seq, what)
    outcome = examination.apply(exam, event, s)
    if outcome.refused:
        raise _NoError(outcome.refused)
    return outcome.state, outcome.effects


def standing(truth: Truth) -> dict[str, Any]:
    """What people need to know of an examination, as plain values."""
    e = examination.to_dict(truth.exam)
    keep = ("rig", "scan", "validity", "acknowledged", "guarded", "lost", "versions")
    shown = examination.shown(truth.exam)
    return {
        **{k: e[k] for k in keep},
        "suspect": str(truth.exam.suspect_ns),
        "shown": None if shown is None else {"version": shown.version, "pattern": shown.pattern},
        "signatures": [dict(x) for x in truth.signatures],
    }
