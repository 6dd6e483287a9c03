"""What each kind of event makes of a state, or the line that says why nothing."""

from __future__ import annotations

import math
from dataclasses import replace

from fringescope.errors import FringescopeError
from fringescope.examination.conditions import LIT, NS, content_of, due, hindrance
from fringescope.settings import ExaminationSettings
from fringescope.types.examination import (
    Acknowledge,
    Arm,
    CarryOver,
    Check,
    Checked,
    DeviceBack,
    DeviceLost,
    DraftStroke,
    Effect,
    Event,
    Examination,
    Expired,
    Guarded,
    GuardLost,
    Phase,
    Preview,
    Previewed,
    Put,
    Remove,
    RigChanged,
    ScanTaken,
    Standing,
    Start,
    Stop,
    Submit,
    Term,
    Version,
    Warn,
    Watched,
    What,
)

WORD = 200  #: longest hash, identifier or name
OVER = (Phase.STALE, Phase.SUPERSEDED)

Step = tuple[Examination, tuple[Effect, ...]]


class RefusalError(FringescopeError):
    """Why nothing came of an event."""


def follow(state: Examination, event: Event, s: ExaminationSettings) -> Step:
    """State and words that an event leads to. Raises RefusalError."""
    if not isinstance(event.what, (Stop, GuardLost, DeviceLost)):  # these are obeyed, whatever their words
        _check_words(event.what)
    match event.what:
        case ScanTaken() as w:
            return _scan_taken(state, w, event), ()
        case RigChanged() as w:
            return _rig_changed(state, w, event)
        case Put() as w:
            return _put(state, w, event, s), ()
        case Remove() as w:
            return _remove(state, w, event), ()
        case CarryOver() as w:
            return _carry_over(state, w, event, s), ()
        case Submit() as w:
            return _submit(state, w, event)
        case Checked() as w:
            return _checked(state, w, event)
        case Previewed() as w:
            return _previewed(state, w, event), ()
        case Arm() as w:
            return _arm(state, w, event, s), ()
        case Start() as w:
            return _start(state, w, event, s), ()
        case Acknowledge() as w:
            return _acknowledge(state, w), ()
        case Stop() as w:
            return _stop(state, w, event), ()
        case Watched() as w:
            return _watched(state, w, event)
        case Guarded():
            return replace(state, guarded=True), ()
        case GuardLost() as w:
            return _guard_lost(state, w, event), ()
        case DeviceLost() as w:
            return _device_lost(state, w, event), ()
        case DeviceBack() as w:
            return _device_back(state, w), ()
        case Expired() as w:
            return _expired(state, w, event, s), ()


def _scan_taken(state: Examination, w: ScanTaken, event: Event) -> Examination:
    if (w.scan, w.rig) == (state.scan, state.rig):
        raise RefusalError(f"scan {w.scan} is the present one already")
    state = _all_stale(state, event, f"scan {w.scan} has taken the place of the one it was drawn on")
    return replace(state, scan=w.scan, rig=w.rig, validity=None, acknowledged=False)


def _rig_changed(state: Examination, w: RigChanged, event: Event) -> Step:
    if w.rig == state.rig:
        raise RefusalError(f"rig {w.rig} is the present one already")
    warn = (Warn("another rig: scan again"),) if any(v.phase in LIT for v in state.versions) else ()
    state = _all_stale(state, event, f"rig {w.rig} has taken the place of the one it was made for")
    return replace(state, rig=w.rig, scan="", validity=None, acknowledged=False), warn


def _put(state: Examination, w: Put, event: Event, s: ExaminationSettings) -> Examination:
    return _drawn(state, event.who, ((w.stroke, w.content),), w.scan, s)


def _drawn(
    state: Examination, author: str, strokes: tuple[tuple[str, str], ...], scan: str, s: ExaminationSettings
) -> Examination:
    if not state.scan or scan != state.scan:
        raise RefusalError(f"a stroke on scan {scan}; the present one is {state.scan or 'none'}: draw on that")
    draft = {d.stroke: d for d in state.strokes}
    for stroke, content in strokes:
        if stroke in draft and draft[stroke].author != author:
            raise RefusalError(f"stroke {stroke} is {draft[stroke].author}'s; only its author changes it")
        draft[stroke] = DraftStroke(stroke, author, content, scan)
    if sum(d.author == author for d in draft.values()) > s.max_strokes:
        raise RefusalError(f"more than {s.max_strokes} strokes by {author}; remove some first")
    return replace(state, strokes=tuple(draft.values()))


def _remove(state: Examination, w: Remove, event: Event) -> Examination:
    own = next((d for d in state.strokes if d.stroke == w.stroke), None)
    if own is None:
        raise RefusalError(f"no stroke {w.stroke}; it may be removed already")
    if own.author != event.who:
        raise RefusalError(f"stroke {w.stroke} is {own.author}'s; only its author removes it")
    return replace(state, strokes=tuple(d for d in state.strokes if d is not own))


def _carry_over(state: Examination, w: CarryOver, event: Event, s: ExaminationSettings) -> Examination:
    v = _version(state, w.version)
    if v.phase is not Phase.STALE:
        raise RefusalError(f"version {v.number} is {v.phase.value}; only what is stale is carried over")
    if not w.strokes:
        raise RefusalError(f"nothing of version {v.number} to carry over; draw anew")
    if type(w.residual_um) not in (int, float) or not (math.isfinite(w.residual_um) and w.residual_um >= 0):
        raise RefusalError(f"a registration with a residual of {w.residual_um} um; needed a number from 0")
    return _drawn(state, event.who, w.strokes, w.scan, s)


def _submit(state: Examination, w: Submit, event: Event) -> Step:
    if not state.scan or (w.scan, w.rig) != (state.scan, state.rig):
        raise RefusalError(
            f"a guideline for scan {w.scan} and rig {w.rig}; "
            f"the present ones are {state.scan or 'none'} and {state.rig or 'none'}: draw it on that scan"
        )
    if state.validity is Standing.STALE:
        raise RefusalError(f"the specimen has moved or changed since scan {state.scan}; scan again")
    if not w.strokes or len({i for i, _ in w.strokes}) != len(w.strokes):
        raise RefusalError("a guideline without strokes, or with one of them twice; submit each once")
    draft = {d.stroke: d for d in state.strokes if d.author == event.who}
    for stroke, content in w.strokes:
        if stroke not in draft:
            raise RefusalError(f"no stroke {stroke} by {event.who}; draw it first")
        if draft[stroke].scan != state.scan:
            raise RefusalError(f"stroke {stroke} was drawn on scan {draft[stroke].scan}; draw it on the present one")
        if draft[stroke].content != content:
            raise RefusalError(f"stroke {stroke} was changed since; submit it as it is now")
    new = Version(
        len(state.versions) + 1, event.who, w.strokes, w.scan, w.rig, content_of(w.strokes, w.scan, w.rig),
        Phase.SUBMITTED, event.at_ns,
    )  # fmt: skip
    out: list[Version] = []
    told: list[Effect] = [Check(new.number)]
    for v in state.versions:
        mine = v.author == event.who and v.phase not in OVER
        if mine and v.content == new.content and v.phase not in (Phase.DRAFT, Phase.STOPPED):
            raise RefusalError(f"version {v.number} is the same and {v.phase.value}; nothing new to submit")
        if mine and v.phase is Phase.PROJECTING:
            told.append(Warn(f"version {new.number} by {v.author} waits; version {v.number} stays as it was confirmed"))
        elif mine:
            v = _to(v, Phase.SUPERSEDED, event, f"version {new.number} has taken its place")
        out.append(v)
    return replace(state, versions=(*out, new)), tuple(told)


def _checked(state: Examination, w: Checked, event: Event) -> Step:
    v = _version(state, w.version)
    if v.phase is not Phase.SUBMITTED:
        raise RefusalError(f"version {v.number} is {v.phase.value}; only what is submitted is checked")
    if w.content != v.content:
        raise RefusalError(f"a check of content {w.content}; version {v.number} is {v.content}: check that")
    if not w.pattern:
        why = "; ".join(w.problems) or "nothing of it can be shown"
        return _with(state, replace(_to(v, Phase.DRAFT, event, why), problems=w.problems)), ()
    if not w.dashed:
        raise RefusalError(f"a picture of version {v.number} without its dashed form; draw both")
    done = _to(v, Phase.CHECKED, event, "")
    done = replace(done, pattern=w.pattern, dashed=w.dashed, problems=w.problems)
    return _with(state, done), (Preview(v.number, w.pattern),)


def _previewed(state: Examination, w: Previewed, event: Event) -> Examination:
    v = _version(state, w.version)
    if v.phase not in (Phase.CHECKED, Phase.PREVIEWED, Phase.STOPPED) or not v.pattern:
        raise RefusalError(f"version {v.number} is {v.phase.value}; needed one that is checked, or stopped after that")
    _same_picture(v, w.pattern)
    return _with(state, _to(v, Phase.PREVIEWED, event, ""))


def _arm(state: Examination, w: Arm, event: Event, s: ExaminationSettings) -> Examination:
    v = _version(state, w.version)
    if v.phase is not Phase.PREVIEWED:
        raise RefusalError(f"version {v.number} is {v.phase.value}; only what was previewed is armed")
    if w.content != v.content:
        raise RefusalError(f"content {w.content} was confirmed; version {v.number} is {v.content}: preview it again")
    _same_picture(v, w.pattern)
    if why := hindrance(state, v, event.at_ns, s):
        raise RefusalError(why)
    for other in state.versions:
        if other.phase is Phase.ARMED:
            state = _with(state, _to(other, Phase.PREVIEWED, event, f"version {v.number} was armed"))
    return _with(state, _to(v, Phase.ARMED, event, ""))


def _start(state: Examination, w: Start, event: Event, s: ExaminationSettings) -> Examination:
    v = _version(state, w.version)
    if v.phase is not Phase.ARMED:
        raise RefusalError(f"version {v.number} is {v.phase.value}; only what is armed is started")
    _same_picture(v, w.pattern)
    if (event.at_ns - v.since_ns) * NS > s.arm_s:
        raise RefusalError(f"version {v.number} was armed more than {s.arm_s:g} s ago; arm it again")
    if why := hindrance(state, v, event.at_ns, s):
        raise RefusalError(why)
    for other in state.versions:
        if other.phase is Phase.PROJECTING:
            newer = other.author == v.author and other.number < v.number
            to = Phase.SUPERSEDED if newer else Phase.STOPPED
            state = _with(state, _to(other, to, event, f"version {v.number} was started"))
    return _with(state, _to(v, Phase.PROJECTING, event, ""))


def _acknowledge(state: Examination, w: Acknowledge) -> Examination:
    if state.validity is not Standing.SUSPECT or w.suspect_ns != state.suspect_ns:
        raise RefusalError("no such warning stands; look at the present one")
    return replace(state, acknowledged=True)


def _stop(state: Examination, w: Stop, event: Event) -> Examination:
    why = f"stopped by {event.who}" + (f": {w.why}" if is_word(w.why) else "")
    one = next((v for v in state.versions if v.number == w.version), None)
    if one is None:  # also where the version is unknown: who says stop means dark
        return _stopped(state, event, why)
    return state if one.phase in OVER else _with(state, _to(one, Phase.STOPPED, event, why))


def _watched(state: Examination, w: Watched, event: Event) -> Step:
    if not state.scan or w.scan != state.scan:
        raise RefusalError(f"a verdict on scan {w.scan}; the present one is {state.scan or 'none'}")
    if state.validity is Standing.STALE:
        raise RefusalError(f"scan {state.scan} is stale for good; scan again")
    note = f" ({w.note})" if w.note else ""
    if w.validity is Standing.STALE:
        state = _all_stale(state, event, f"the specimen moved or changed{note}")
        stale = replace(state, validity=w.validity, verdict_ns=event.at_ns, acknowledged=False)
        return stale, (Warn(f"the specimen is not as it was scanned{note}: scan again"),)
    if event.at_ns < state.verdict_ns:
        raise RefusalError("a verdict older than the last one")
    state = replace(state, verdict_ns=event.at_ns)
    if w.validity is Standing.VALID:
        return replace(state, validity=w.validity, acknowledged=False), ()
    if state.validity is Standing.SUSPECT:
        return state, ()
    warn = Warn(f"the specimen may have moved{note}: look, then go on or stop")
    return replace(state, validity=w.validity, suspect_ns=event.at_ns, acknowledged=False), (warn,)


def _guard_lost(state: Examination, w: GuardLost, event: Event) -> Examination:
    return replace(_stopped(state, event, f"watchdog: {w.why}"), guarded=False)


def _device_lost(state: Examination, w: DeviceLost, event: Event) -> Examination:
    lost = tuple(sorted({*state.lost, w.device}))
    return replace(_stopped(state, event, f"no answer from {w.device}"), lost=lost)


def _device_back(state: Examination, w: DeviceBack) -> Examination:
    if w.device not in state.lost:
        raise RefusalError(f"{w.device} was not lost")
    return replace(state, lost=tuple(d for d in state.lost if d != w.device))


def _expired(state: Examination, w: Expired, event: Event, s: ExaminationSettings) -> Examination:
    if w not in due(state, event.at_ns, s):
        raise RefusalError(f"the time of the {w.term.value} is not over")
    if w.term is Term.ARM:
        for v in state.versions:
            if v.phase is Phase.ARMED and (event.at_ns - v.since_ns) * NS > s.arm_s:
                state = _with(state, _to(v, Phase.PREVIEWED, event, f"armed for {s.arm_s:g} s and not started"))
        return state
    why = {
        Term.VERDICT: f"nobody looked at the specimen for {s.verdict_s:g} s",
        Term.ACKNOWLEDGEMENT: f"the specimen may have moved, and nobody said for {s.suspect_s:g} s to go on",
    }[w.term]
    return _stopped(state, event, why)


# -------------------------------------------------------------------------------------------------------- small things


def _to(v: Version, phase: Phase, event: Event, why: str) -> Version:
    return replace(v, phase=phase, since_ns=event.at_ns, why=why)


def _with(state: Examination, version: Version) -> Examination:
    return replace(state, versions=tuple(version if v.number == version.number else v for v in state.versions))


def _stopped(state: Examination, event: Event, why: str) -> Examination:
    """All that is armed or projected, stopped."""
    return replace(
        state, versions=tuple(_to(v, Phase.STOPPED, event, why) if v.phase in LIT else v for v in state.versions)
    )


def _all_stale(state: Examination, event: Event, why: str) -> Examination:
    return replace(
        state, versions=tuple(v if v.phase in OVER else _to(v, Phase.STALE, event, why) for v in state.versions)
    )


def _version(state: Examination, number: int) -> Version:
    found = next((v for v in state.versions if v.number == number), None)
    if found is None:
        raise RefusalError(f"no version {number}; there are {len(state.versions)}")
    return found


def _same_picture(v: Version, pattern: str) -> None:
    if pattern != v.pattern:
        raise RefusalError(f"picture {pattern}; that of version {v.number} is {v.pattern or 'none'}: preview it again")


def is_word(text: object) -> bool:
    """Whether a text may be a hash, an identifier or a name."""
    return isinstance(text, str) and 0 < len(text) <= WORD and text.isprintable()


def _check_words(what: What) -> None:
    """Hashes, identifiers and names are words, what is said for people is one line; a check may find no picture."""
    for name, value in vars(what).items():
        texts = [value] if isinstance(value, str) else [w for pair in value for w in pair] if name == "strokes" else []
        for text in texts:
            free = name in ("why", "note") or (isinstance(what, Checked) and name in ("pattern", "dashed"))
            if not (is_word(text) or (free and text == "")):
                raise RefusalError(f"{name} {repr(text)[:40]}; needed 1 to {WORD} printable characters")
