"""What the API takes and returns."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fringescope.wire.ops import Word

Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Line = Annotated[str, Field(max_length=500, pattern=r"^[^\x00-\x1f\x7f]*$")]
Secret = Annotated[str, Field(min_length=1, max_length=1000)]


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Problem(_Document):
    """What went wrong, in a sentence for the screen: what came, what was needed, what to do."""

    detail: str


class PersonRole(StrEnum):
    """What somebody may do; `server.rights` says what exactly."""

    OPERATOR = "operator"
    EXPERT = "expert"
    OBSERVER = "observer"
    ADMIN = "admin"


class Person(_Document):
    """Somebody with an account."""

    id: str
    name: Name
    role: PersonRole
    disabled: bool = False
    created_ns: int = 0


class NewPerson(_Document):
    """An account to make: of who signs in by a password, by the identity provider (`subject`: who they are there)."""

    name: Name
    password: Annotated[str, Field(min_length=12, max_length=1000)] | None = None
    role: PersonRole
    subject: Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+$")] | None = None


class PersonChange(_Document):
    """What changes of an account; what is missing stays."""

    name: Name | None = None
    password: Annotated[str, Field(min_length=12, max_length=1000)] | None = None
    role: PersonRole | None = None
    disabled: bool | None = None


class Login(_Document):
    """Name and password."""

    name: Name
    password: Secret


class Confirm(_Document):
    """The password once more."""

    password: Secret


class PasswordChange(_Document):
    """The old password, and the new one."""

    old: Secret
    new: Annotated[str, Field(min_length=12, max_length=1000)]


class Ways(_Document):
    """How one may sign in here; `provider` is the page to open for the identity provider, None without one."""

    passwords: bool = True
    passkeys: bool = True
    provider: str | None = None


class KeyOptions(_Document):
    """What a page hands to navigator.credentials.create or .get, as `publicKey`; good once, and not for long."""

    options: dict[str, Any]


class KeyAnswer(_Document):
    """What navigator.credentials gave back (PublicKeyCredential.toJSON()); a name for the key where it is new."""

    credential: dict[str, Any]
    label: Line = ""


class Passkey(_Document):
    """A passkey of somebody: its public half is all that the hub has."""

    id: str
    label: str
    created_ns: int


class Account(_Document):
    """Who is signed in here; `csrf` goes into the header X-CSRF-Token of whatever changes something."""

    person: Person
    csrf: str
    local: bool  #: at the instrument itself
    case: str | None = None  #: the one case that an invited guest may see


class Status(StrEnum):
    """Where a case stands."""

    OPEN = "open"
    DONE = "done"
    ARCHIVED = "archived"
    ERASED = "erased"


class Specimen(_Document):
    """What lies under the cameras. Who it is from is kept apart and shown to operators alone."""

    pseudonym: Line = ""
    organ: Line = ""
    side: Line = ""
    kind: Line = ""
    notes: Annotated[str, Field(max_length=4000)] = ""


class Patient(_Document):
    """Who a specimen is from: kept apart from the log, and erased on request."""

    name: Line = ""
    identifier: Line = ""
    born: Line = ""


class NewCase(_Document):
    """A case to open: at least an accession number or the barcode on the vessel."""

    accession: Name
    specimen: Specimen = Specimen()
    patient: Patient | None = None


class CaseChange(_Document):
    """What changes of a case; what is missing stays."""

    status: Literal["open", "done", "archived"] | None = None
    specimen: Specimen | None = None
    patient: Patient | None = None


class Case(_Document):
    """An examination."""

    id: str
    accession: str
    status: Status
    specimen: Specimen
    patient: Patient | None = None  #: for operators alone
    created_ns: int
    changed_ns: int
    scans: int
    seq: int  #: of its last event


class CaseList(_Document):
    """Some of the cases, and how many fit the question."""

    total: int
    cases: list[Case]


class ScanFile(_Document):
    """A file of a scan, by its content: it never changes, so it may be kept for good."""

    name: str
    sha256: str
    size: int
    type: str


class ScanInfo(_Document):
    """A scan of a case."""

    id: str  #: its hash
    case: str
    rig: str
    label: str
    taken_ns: int
    files: list[ScanFile]
    figures: dict[str, Any]


class CaseState(_Document):
    """Where a case stands after event `seq`."""

    seq: int
    standing: dict[str, Any]
    strokes: dict[str, dict[str, Any]]
    layers: dict[str, dict[str, Any]]
    comments: dict[str, dict[str, Any]]
    versions: dict[int, list[dict[str, Any]]]
    scans: list[str]


class NewScan(_Document):
    """A scan to take."""

    label: Annotated[str, Field(max_length=200)] = ""


class AskedCarry(_Document):
    """A stale version whose strokes are to be laid on the present scan."""

    version: int


class AskedCompare(_Document):
    """Two scans of a case, and the version whose lines the cut should have followed."""

    before: Word
    after: Word
    version: int | None = None


class NewPose(_Document):
    """A pose of the calibration board; the first of a session says which board it is, as its board.json does."""

    board: dict[str, Any] | None = None


class JobState(StrEnum):
    """How far a job is."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Job(_Document):
    """Work that takes long."""

    id: str
    kind: str
    case: str | None
    state: JobState
    stage: str
    share: float
    why: str = ""
    result: dict[str, Any] | None = None
    created_ns: int
    ended_ns: int | None = None


class NewInvitation(_Document):
    """Somebody invited to one case, by a link and a code that is told by another way."""

    role: Literal["expert", "observer"] = "expert"
    name: Name
    hours: Annotated[float, Field(gt=0, le=24 * 90)] = 72


class Invitation(_Document):
    """An invitation; `token` and `code` are there only in the answer that made it."""

    id: str
    case: str
    role: PersonRole
    name: str
    expires_ns: int
    revoked: bool
    used_ns: int | None = None
    token: str | None = None
    code: str | None = None


class Accept(_Document):
    """A guest comes in."""

    token: Secret
    code: Secret


class InstrumentState(_Document):
    """The instrument, as the operator's screen shows it."""

    uri: str
    there: bool
    busy: str
    projecting: str | None
    guarded: bool
    case: str | None
    why: str = ""


class AuditReport(_Document):
    """What a check of the log found."""

    cases: int
    events: int
    faults: list[str]
    whole: bool
    checkpoints: int = 0
    covered_ns: int = 0  #: until then a tail that was cut off would have been missed


class AskedErasure(_Document):
    """A case to erase, and why: a request, a rule, the end of a study."""

    why: Annotated[str, Field(min_length=1, max_length=500, pattern=r"^[^\x00-\x1f\x7f]+$")]


class Erased(_Document):
    """A case was erased: so many events lost their words, so many files are gone."""

    events: int
    files: int


class Health(_Document):
    """The hub lives; `room`: there is a gigabyte left on its disk."""

    version: str
    room: bool


class Ended(_Document):
    """It is done."""

    done: Word = "done"
