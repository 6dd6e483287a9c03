"""One entry of a case's log, and the chain of hashes that holds the entries together.

An entry's hash covers all of it but the words of its payload; for these stands a salted digest. So the words can be
erased when a patient asks for it, and the chain still verifies; nobody can guess short words from the digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

GENESIS = "0" * 64  #: what the first entry of a case follows


@dataclass(frozen=True)
class Record:
    """An event as the log keeps it. `actor` is an identifier of a person or "instrument", never a name.

    `at_ns` is the server's wall clock, `said_ns` that of the client (0: unknown); the order is that of `seq` alone.
    `refused`: why nothing came of it, "" where something did. `payload` is None once it was erased.
    """

    case: str
    seq: int
    at_ns: int
    said_ns: int
    actor: str
    role: str
    client: str
    number: int
    kind: str
    refused: str
    salt: str
    payload: dict[str, Any] | None
    digest: str
    prev: str
    hash: str = ""


def canonical(value: Any) -> bytes:
    """JSON in one form: keys sorted, no spaces, ASCII, no NaN. Raises ValueError for what JSON cannot hold."""
    text = json.dumps(value, sort_keys=True, ensure_ascii=True, separators=(",", ":"), allow_nan=False)
    return text.encode()


def digest_of(salt: str, payload: dict[str, Any]) -> str:
    """SHA-256, hex, of a payload with its salt."""
    return hashlib.sha256(salt.encode() + b"\n" + canonical(payload)).hexdigest()


def content_of_stroke(document: Mapping[str, Any], meaning: str = "cut") -> str:
    """The hash (SHA-256, hex) of a stroke and what it stands for: what its author submits and the operator confirms."""
    kept = {k: v for k, v in document.items() if v is not None}
    return hashlib.sha256(canonical({"stroke": kept, "meaning": meaning})).hexdigest()


def hash_of(r: Record) -> str:
    """SHA-256, hex, of all of an entry but the words of its payload."""
    covered = [r.case, r.seq, r.at_ns, r.said_ns, r.actor, r.role, r.client, r.number, r.kind, r.refused, r.digest]
    return hashlib.sha256(canonical([*covered, r.prev])).hexdigest()


def link(r: Record, prev: str) -> Record:
    """The entry, bound to the one before it."""
    bound = replace(r, prev=prev, digest=digest_of(r.salt, r.payload or {}))
    return replace(bound, hash=hash_of(bound))


def check_chain(records: Iterable[Record], case: str) -> list[str]:
    """What is wrong with the log of a case, in its order, a line each; nothing where it is whole.

    A payload that is missing is in order if an entry of kind "erased" says so. A tail that was cut off cannot be seen
    here: compare with a checkpoint.
    """
    faults: list[str] = []
    prev, seq, missing, erased_to = GENESIS, 0, [], 0
    for r in records:
        seq += 1
        name = f"case {case}, event {r.seq}"
        if r.case != case or r.seq != seq:
            faults.append(f"{name}: stands where event {seq} should; events were removed, added or moved")
            seq = r.seq
        if r.prev != prev:
            faults.append(f"{name}: does not follow the event before it; one of both was altered or removed")
        if hash_of(r) != r.hash:
            faults.append(f"{name}: its hash does not fit its contents; it was altered")
        if r.payload is None:
            missing.append(r.seq)
        elif digest_of(r.salt, r.payload) != r.digest:
            faults.append(f"{name}: its words were altered")
        if r.kind == "erased" and r.payload is not None:
            erased_to = max(erased_to, int(r.payload.get("through", 0)))
        prev = r.hash
    faults += [f"case {case}, event {n}: its words are missing and no event says that they were erased"
               for n in missing if n > erased_to]  # fmt: skip
    return faults
