"""Who may do what: one table, and the question asked of it for every request and every message."""

from __future__ import annotations

from dataclasses import dataclass

from fringescope.types.examination import Role
from fringescope.wire import PersonRole

OPERATOR, EXPERT, OBSERVER, ADMIN = PersonRole.OPERATOR, PersonRole.EXPERT, PersonRole.OBSERVER, PersonRole.ADMIN
EVERYBODY = frozenset(PersonRole)

#: what -> who may, in a case that they can see. What is not here nobody may.
MAY: dict[str, frozenset[PersonRole]] = {
    # words of the log
    "put": frozenset({OPERATOR, EXPERT}),
    "remove": frozenset({OPERATOR, EXPERT}),
    "layer": frozenset({OPERATOR, EXPERT}),
    "undo": frozenset({OPERATOR, EXPERT}),
    "submit": frozenset({OPERATOR, EXPERT}),
    "comment": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "withdraw": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "sign": frozenset({OPERATOR, EXPERT}),
    "preview": frozenset({OPERATOR}),
    "arm": frozenset({OPERATOR}),
    "start": frozenset({OPERATOR}),
    "acknowledge": frozenset({OPERATOR}),
    "carry_over": frozenset({OPERATOR}),
    "stop": EVERYBODY,
    # messages that are not kept
    "pointer": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "view": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "ink": frozenset({OPERATOR, EXPERT}),
    "ping": EVERYBODY,
    # cases
    "case.list": EVERYBODY,
    "case.read": EVERYBODY,
    "case.open": frozenset({OPERATOR}),
    "case.change": frozenset({OPERATOR}),
    "case.patient": frozenset({OPERATOR}),
    "case.erase": frozenset({ADMIN}),
    "case.bundle": frozenset({OPERATOR, EXPERT}),
    "case.import": frozenset({OPERATOR}),
    "case.invite": frozenset({OPERATOR}),
    # the instrument
    "scan.take": frozenset({OPERATOR}),
    "scan.add": frozenset({OPERATOR}),
    "scan.compare": frozenset({OPERATOR}),
    "instrument.calibrate": frozenset({OPERATOR}),
    "instrument.read": frozenset({OPERATOR, EXPERT, OBSERVER, ADMIN}),
    "instrument.stop": EVERYBODY,
    "video": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "job.read": frozenset({OPERATOR, EXPERT, OBSERVER}),
    "job.cancel": frozenset({OPERATOR}),
    # people and the hub itself
    "passkey": EVERYBODY,
    "people.list": frozenset({OPERATOR, ADMIN}),
    "people.change": frozenset({ADMIN}),
    "audit": frozenset({ADMIN}),
}

#: how it is called on a screen, where that is not its name
WORDS = {
    "case.open": "to open a case", "case.change": "to change a case", "case.patient": "to name the patient",
    "case.erase": "to erase a case", "case.bundle": "to take a case away", "case.import": "to bring a case in",
    "case.invite": "to invite somebody", "case.read": "to read a case", "case.list": "to list cases",
    "scan.take": "to scan", "scan.add": "to add a scan", "scan.compare": "to compare scans",
    "instrument.calibrate": "to calibrate", "instrument.read": "to look at the instrument", "job.read": "to see jobs",
    "job.cancel": "to see all jobs or end one", "people.list": "to see who has an account",
    "people.change": "to change accounts", "audit": "to judge the log", "carry_over": "to carry strokes over",
}  # fmt: skip

#: what only somebody at the instrument itself may do: all that projects, and the look that comes before it
LOCAL = frozenset({"preview", "arm", "start", "acknowledge", "scan.take", "instrument.calibrate"})

#: what needs the password once more, not long ago
CONFIRMED = frozenset({"sign"})
CONFIRMED_S = 300.0


@dataclass(frozen=True)
class Speaker:
    """Who asks: a person with a role, where they are, and the one case that a guest is bound to."""

    person: str
    role: PersonRole
    local: bool = False
    case: str | None = None
    confirmed_ns: int = 0

    @property
    def as_role(self) -> Role:
        """What they are to an examination: an administrator watches."""
        return Role.OBSERVER if self.role is ADMIN else Role(self.role.value)


def refusal(speaker: Speaker, what: str, now_ns: int = 0) -> str:
    """Why somebody may not do something, in a sentence; "" where they may."""
    words = WORDS.get(what, what)
    if speaker.role not in MAY.get(what, frozenset()):
        return f"{words} is not for the {speaker.role.value} to do"
    if what in LOCAL and not speaker.local:
        return f"{words} is for the operator at the instrument; from afar you can propose and stop"
    if what in CONFIRMED and (now_ns - speaker.confirmed_ns) > CONFIRMED_S * 1e9:
        return f"{what} needs your password once more; confirm it and sign again"
    return ""
