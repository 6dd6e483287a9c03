"""The log judged, and the hub's own health."""

from __future__ import annotations

from fastapi import APIRouter

from fringescope import __version__
from fringescope.server.asking import Parts, Who, problems
from fringescope.server.audit import verify
from fringescope.wire.documents import AuditReport, Health

router = APIRouter(prefix="/api", tags=["hub"])


@router.get("/audit", responses=problems(401, 403))
def audit(who: Who) -> AuditReport:
    """Checks the chains of all cases, and against the hub's checkpoints; altered or removed events are named."""
    who.must("audit")
    found = verify(who.site.engine, who.site.config.data)
    return AuditReport(
        cases=found.cases, events=found.events, faults=list(found.faults[:1000]), whole=found.whole,
        checkpoints=found.checkpoints, covered_ns=found.covered_ns,
    )  # fmt: skip


@router.get("/health", responses=problems())
def health(site: Parts) -> Health:
    """Whether the hub lives. Tells nothing else to strangers."""
    return Health(version=__version__, room=site.blobs.free_bytes() > 1 << 30)
