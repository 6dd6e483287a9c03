"""What a state means: which picture is on, what the clock makes true, and why a version may not be shown."""

from __future__ import annotations

import hashlib
import json
import math

from fringescope.settings import ExaminationSettings
from fringescope.types.examination import (
    Examination,
    Expired,
    GuardLost,
    Phase,
    Show,
    Standing,
    Term,
    Version,
    What,
)

NS = 1e-9
LIT = (Phase.ARMED, Phase.PROJECTING)


def shown(state: Examination) -> Show | None:
    """The one picture that belongs on the projector, None = dark."""
    for v in state.versions:
        if v.phase is Phase.PROJECTING:
            return Show(v.number, v.dashed if state.validity is Standing.SUSPECT else v.pattern)
    return None


def due(
    state: Examination,
    now_ns: int,
    settings: ExaminationSettings | None = None,
    beat_ns: int | None = None,
    deadline_ms: float = math.inf,
) -> tuple[What, ...]:
    """What the clock says has come true: events for the instrument to report, the gravest first.

    `beat_ns`: when the watchdog gave its last sign of life, which must not be more than `deadline_ms` ago.
    """
    s = settings or ExaminationSettings()
    out: list[What] = []
    if state.guarded and beat_ns is not None and (now_ns - beat_ns) * NS * 1e3 > deadline_ms:
        out.append(GuardLost(f"no heartbeat for {(now_ns - beat_ns) * NS * 1e3:.0f} ms"))
    lit = [v for v in state.versions if v.phase in LIT]
    if lit and (now_ns - state.verdict_ns) * NS > s.verdict_s:
        out.append(Expired(Term.VERDICT))
    waits = state.validity is Standing.SUSPECT and not state.acknowledged
    if waits and any(v.phase is Phase.PROJECTING for v in lit) and (now_ns - state.suspect_ns) * NS > s.suspect_s:
        out.append(Expired(Term.ACKNOWLEDGEMENT))
    if any(v.phase is Phase.ARMED and (now_ns - v.since_ns) * NS > s.arm_s for v in lit):
        out.append(Expired(Term.ARM))
    return tuple(out)


def content_of(strokes: tuple[tuple[str, str], ...], scan: str, rig: str) -> str:
    """The hash (SHA-256, hex) that binds strokes, by identifier and content, to a scan and a rig."""
    text = json.dumps([[list(p) for p in strokes], scan, rig], ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def hindrance(state: Examination, version: Version, now_ns: int, settings: ExaminationSettings | None = None) -> str:
    """Why a version may not be projected now, in one line; "" if it may."""
    s = settings or ExaminationSettings()
    n = f"version {version.number}"
    if version.scan != state.scan:
        return f"{n} was drawn on scan {version.scan}; the present one is {state.scan or 'none'}: submit it anew"
    if version.rig != state.rig:
        return f"{n} was made for rig {version.rig}; the present one is {state.rig}: scan again"
    if state.lost:
        return f"no answer from {', '.join(state.lost)}; nothing is projected until it is back"
    if not state.guarded:
        return "no watchdog runs; nothing is projected without one"
    if state.validity is None or state.validity is Standing.STALE:
        seen = "has moved or changed" if state.validity else "was not looked at"
        return f"the specimen {seen} since scan {state.scan}; {'scan again' if state.validity else 'look first'}"
    if (now_ns - state.verdict_ns) * NS > s.verdict_s:
        return f"nobody has looked at the specimen for {(now_ns - state.verdict_ns) * NS:.1f} s; look again"
    if state.validity is Standing.SUSPECT and not state.acknowledged:
        return "the specimen may have moved; the operator must say first whether to go on"
    return ""
