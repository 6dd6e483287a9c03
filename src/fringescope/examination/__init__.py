"""The state of an examination: what becomes of a guideline between the expert's pen and the light on the tissue.

Pure logic: an event and a state make a new state and effects that others carry out; there is no clock, no file and no
device here. A log of all events, the refused ones too, gives the same state again.

    draft -> submitted -> checked -> previewed -> armed -> projecting -> stopped | stale | superseded

- Only the operator arms and starts; anybody stops, at any time.
- What is projected is exactly the picture that was checked, previewed and confirmed, of one version, for this scan and
  rig. `shown` says which; the light follows from what it said before and after, and from nothing else.
- Whatever casts doubt (another scan or rig, a stale or an old verdict, a watchdog or device that does not answer) makes
  dark at once. A suspect specimen gets dashed lines, and dark if the operator does not say in time to go on.
- A new submission supersedes its author's older ones, but for the one that is projected: that stays as the operator
  confirmed it, since nothing may change or go out under a knife unasked. The operator is told, and the older one goes
  when the newer is started.
- What was stopped may be shown again by way of preview and arming. Stale and superseded are for good.
- The same word twice, or words out of order, do nothing; a word that makes dark is obeyed even late.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from fringescope.examination.conditions import content_of, due, hindrance, shown
from fringescope.examination.rules import RefusalError, follow, is_word
from fringescope.examination.wire import from_dict, to_dict
from fringescope.settings import ExaminationSettings
from fringescope.types.examination import (
    Acknowledge,
    Arm,
    CarryOver,
    Client,
    Dark,
    DeviceLost,
    Effect,
    Event,
    Examination,
    GuardLost,
    Outcome,
    Put,
    Remove,
    Role,
    Standing,
    Start,
    Stop,
    Submit,
    Watched,
    What,
)

__all__ = ["apply", "content_of", "due", "from_dict", "hindrance", "replay", "shown", "to_dict"]

_DRAWS = {Role.EXPERT, Role.OPERATOR}
_SAYS: dict[type, set[Role]] = {
    Put: _DRAWS,
    Remove: _DRAWS,
    Submit: _DRAWS,
    CarryOver: {Role.OPERATOR},
    Arm: {Role.OPERATOR},
    Start: {Role.OPERATOR},
    Acknowledge: {Role.OPERATOR},
    Stop: set(Role),
}  #: who may say what; the rest is the instrument's


def apply(state: Examination, event: Event, settings: ExaminationSettings | None = None) -> Outcome:
    """What an event makes of a state. Never raises for what an event says: see `Outcome.refused`.

    A refused event leaves its number behind, so that it cannot come true when it arrives once more.
    """
    s, what = settings or ExaminationSettings(), event.what
    name = type(what).__name__
    counted = type(event.number) is int and event.number >= 1 and type(event.at_ns) is int
    if not (counted and is_word(event.who) and is_word(event.client)):
        return Outcome(state, refused=f"{name} without a sender, a number from 1 or a time; send it again with them")
    known = next((c for c in state.clients if c.client == event.client), Client(event.client, 0, 0))
    dark = _darkens(what)
    if (event.number == known.dark) if dark else (event.number <= known.number):
        return Outcome(state, refused=f"{name} {event.number} of {event.client} came before; nothing is done twice")
    now = Client(event.client, max(known.number, event.number), event.number if dark else known.dark)
    heard = replace(state, clients=(*(c for c in state.clients if c.client != event.client), now))
    if event.role not in _SAYS.get(type(what), {Role.INSTRUMENT}):
        return Outcome(heard, refused=f"{name} is not for the {event.role.value} to say")
    try:
        after, words = follow(heard, event, s)
    except RefusalError as e:
        return Outcome(heard, refused=str(e))
    return Outcome(after, words + _light(state, after, dark))


def replay(events: Iterable[Event], settings: ExaminationSettings | None = None) -> Examination:
    """The state after a log of events."""
    state = Examination()
    for event in events:
        state = apply(state, event, settings).state
    return state


def _darkens(what: What) -> bool:
    return isinstance(what, (Stop, GuardLost, DeviceLost)) or (
        isinstance(what, Watched) and what.validity is Standing.STALE
    )


def _light(before: Examination, after: Examination, dark: bool) -> tuple[Effect, ...]:
    """What has to happen to the light: from what is shown before and after alone."""
    was, now = shown(before), shown(after)
    if now is not None:
        return (now,) if now != was else ()
    if was is None and not dark:
        return ()
    why = next((v.why for v in after.versions if was and v.number == was.version), "")
    return (Dark(why or "to be sure"),)
