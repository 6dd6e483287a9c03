"""What travels between the hub, the expert's page, the operator's screen and programs: one set of types for all.

`ops` is what people say for good, `room` what goes through a case's room, `documents` what the API returns, `record`
one entry of the log and the chain that holds it. The page's TypeScript is made from these (`tools/make_typescript.py`).
"""

from fringescope.wire.documents import (
    Account,
    Case,
    CaseList,
    Invitation,
    Job,
    JobState,
    Person,
    PersonRole,
    Problem,
    ScanFile,
    ScanInfo,
    Specimen,
    Status,
)
from fringescope.wire.ops import Op, StrokeDocument
from fringescope.wire.record import GENESIS, Record, check_chain, digest_of, link

__all__ = [
    "GENESIS",
    "Account",
    "Case",
    "CaseList",
    "Invitation",
    "Job",
    "JobState",
    "Op",
    "Person",
    "PersonRole",
    "Problem",
    "Record",
    "ScanFile",
    "ScanInfo",
    "Specimen",
    "Status",
    "StrokeDocument",
    "check_chain",
    "digest_of",
    "link",
]
