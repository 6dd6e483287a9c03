"""What an examination passes on: events that happen to it, effects that it asks for, and the state in between.

Hashes, identifiers and names are opaque words. Times are nanoseconds of one monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fringescope.types.watching import Standing as Standing


class Role(Enum):
    """Who says something: only the operator starts, anybody stops."""

    EXPERT = "expert"
    OPERATOR = "operator"  #: stands at the instrument
    OBSERVER = "observer"
    INSTRUMENT = "instrument"  #: its software: checks, previews, verdicts, the watchdog


class Phase(Enum):
    """How far one version of a guideline has come."""

    DRAFT = "draft"  #: nothing of it can be shown: back with its author
    SUBMITTED = "submitted"
    CHECKED = "checked"
    PREVIEWED = "previewed"
    ARMED = "armed"
    PROJECTING = "projecting"
    STOPPED = "stopped"
    STALE = "stale"
    SUPERSEDED = "superseded"


@dataclass(frozen=True)
class DraftStroke:
    """A stroke that its author works on: the hash of what it is, and of the scan that it is drawn on."""

    stroke: str
    author: str
    content: str
    scan: str


@dataclass(frozen=True)
class Version:
    """Strokes as they were submitted, bound to scan and rig; `content` is the hash of all that."""

    number: int  #: 1, 2, ..: in the order of submission
    author: str
    strokes: tuple[tuple[str, str], ...]  #: identifier and content of each
    scan: str
    rig: str
    content: str
    phase: Phase
    since_ns: int  #: of the phase
    pattern: str = ""  #: hash of the picture for the projector, once it is checked
    dashed: str = ""  #: hash of the same with dashed lines, for a specimen that may have moved
    problems: tuple[str, ...] = ()  #: what of it is not shown, and why
    why: str = ""  #: what brought it into its phase, in one line


@dataclass(frozen=True)
class Client:
    """The highest number that came from one program, and the last one of an event that makes dark."""

    client: str
    number: int
    dark: int


@dataclass(frozen=True)
class Examination:
    """The state: frozen, comparable, made anew by every event."""

    rig: str = ""
    scan: str = ""
    validity: Standing | None = None  #: of the scan; None: nobody has looked yet
    verdict_ns: int = 0  #: when somebody looked last
    suspect_ns: int = 0  #: since when it is suspect
    acknowledged: bool = False  #: the operator goes on with what is suspect
    guarded: bool = False  #: the watchdog runs
    lost: tuple[str, ...] = ()  #: devices that do not answer
    strokes: tuple[DraftStroke, ...] = ()
    versions: tuple[Version, ...] = ()
    clients: tuple[Client, ...] = ()


# ------------------------------------------------------------------------------------------------------------- events


@dataclass(frozen=True)
class ScanTaken:
    """There is a new scan, made with this rig."""

    scan: str
    rig: str


@dataclass(frozen=True)
class RigChanged:
    """The instrument is another one than before."""

    rig: str


@dataclass(frozen=True)
class Put:
    """A stroke was drawn or changed."""

    stroke: str
    content: str
    scan: str


@dataclass(frozen=True)
class Remove:
    """A stroke was taken out of its author's draft."""

    stroke: str


@dataclass(frozen=True)
class CarryOver:
    """The operator takes the strokes of a stale version over to the present scan, by a registration of this residual:
    they become the operator's own draft.
    """

    version: int
    strokes: tuple[tuple[str, str], ...]
    scan: str
    residual_um: float


@dataclass(frozen=True)
class Submit:
    """The author asks for exactly these strokes, identifier and content, on this scan and rig."""

    strokes: tuple[tuple[str, str], ...]
    scan: str
    rig: str


@dataclass(frozen=True)
class Checked:
    """What can be shown of a version: hashes of its pictures, "" if nothing can, and what is left out of them."""

    version: int
    content: str
    pattern: str
    dashed: str
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class Previewed:
    """The operator has the preview of this picture before them."""

    version: int
    pattern: str


@dataclass(frozen=True)
class Arm:
    """The operator confirms what the preview showed: this version, of this content, by this picture."""

    version: int
    content: str
    pattern: str


@dataclass(frozen=True)
class Start:
    """The operator turns on the light."""

    version: int
    pattern: str


@dataclass(frozen=True)
class Acknowledge:
    """The operator goes on although the specimen is suspect since then."""

    suspect_ns: int


@dataclass(frozen=True)
class Stop:
    """Dark: one version, or (None) whatever is armed or projected."""

    version: int | None = None
    why: str = ""


@dataclass(frozen=True)
class Watched:
    """Somebody looked whether the specimen still is as in the scan."""

    scan: str
    validity: Standing
    note: str = ""


@dataclass(frozen=True)
class Guarded:
    """The watchdog runs."""


@dataclass(frozen=True)
class GuardLost:
    """The watchdog has turned the projector dark, or does not answer."""

    why: str


@dataclass(frozen=True)
class DeviceLost:
    """A device does not answer."""

    device: str


@dataclass(frozen=True)
class DeviceBack:
    """It answers again."""

    device: str


class Term(Enum):
    """What ends by itself when its time is over."""

    VERDICT = "verdict"  #: nobody has looked at the specimen for too long
    ACKNOWLEDGEMENT = "acknowledgement"  #: the operator has not said whether to go on
    ARM = "arm"  #: armed and not started


@dataclass(frozen=True)
class Expired:
    """A time is over, as `examination.due` says."""

    term: Term


What = (
    ScanTaken | RigChanged | Put | Remove | CarryOver | Submit | Checked | Previewed | Arm | Start | Acknowledge | Stop
    | Watched | Guarded | GuardLost | DeviceLost | DeviceBack | Expired
)  # fmt: skip


@dataclass(frozen=True)
class Event:
    """What happened, as a log keeps it: `who` said it, as the `number`-th word (1, 2, ..) of a `client`, which is one
    program that they use, from its start to its end.
    """

    at_ns: int
    who: str
    role: Role
    client: str
    number: int
    what: What


# ------------------------------------------------------------------------------------------------------------ effects


@dataclass(frozen=True)
class Check:
    """Find out what of a version can be shown."""

    version: int


@dataclass(frozen=True)
class Preview:
    """Show the operator how this picture will look."""

    version: int
    pattern: str


@dataclass(frozen=True)
class Show:
    """Project exactly the picture with this hash."""

    version: int
    pattern: str


@dataclass(frozen=True)
class Dark:
    """Project nothing, at once."""

    why: str


@dataclass(frozen=True)
class Warn:
    """Tell the operator, with a sound."""

    text: str


Effect = Check | Preview | Show | Dark | Warn


@dataclass(frozen=True)
class Outcome:
    """What an event led to. `refused`: one line that says why nothing came of it, "" where something did."""

    state: Examination
    effects: tuple[Effect, ...] = ()
    refused: str = ""
