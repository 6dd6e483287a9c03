"""The wire: one set of types for hub, page and programs; hashes that outsiders can compute again."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from fringescope.types import examination
from fringescope.wire import GENESIS, Op, Record, check_chain, link
from fringescope.wire.ops import Said
from fringescope.wire.room import FromClient

ROOT = Path(__file__).resolve().parents[2]


def maker() -> Any:
    spec = importlib.util.spec_from_file_location("make_typescript", ROOT / "tools" / "make_typescript.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_types_are_those_of_the_hub() -> None:
    there = (ROOT / "frontend" / "src" / "wire.ts").read_text()
    assert there == maker().typescript(), "run: python tools/make_typescript.py"


def test_every_word_that_people_say_is_in_the_types() -> None:
    there = (ROOT / "frontend" / "src" / "wire.ts").read_text()
    for kind in TypeAdapter(Said).json_schema()["discriminator"]["mapping"]:
        assert f'kind: "{kind}";' in there
    for kind in TypeAdapter(FromClient).json_schema()["discriminator"]["mapping"]:
        assert f'type: "{kind}";' in there


def test_a_compiler_takes_them(tmp_path: Path) -> None:
    tsc = next((p for p in (ROOT / "frontend" / "node_modules" / ".bin" / "tsc",) if p.exists()), None)
    found = str(tsc) if tsc else shutil.which("tsc")
    if found is None:
        pytest.skip("no TypeScript compiler here: make setup, with Node.js (tools/system_packages.sh)")
    sample = tmp_path / "sample.ts"
    sample.write_text(
        f'import type {{ Op, FromServer }} from "{ROOT / "frontend" / "src" / "wire"}";\n'
        'export const op: Op = { client: "c", number: 1, what: { kind: "stop" } };\n'
        'export function seq(m: FromServer): number { return m.type === "event" ? m.seq : 0; }\n'
    )
    strict = ["--noEmit", "--strict", "--noUncheckedIndexedAccess", "--exactOptionalPropertyTypes"]

    def compiled() -> subprocess.CompletedProcess[str]:
        return subprocess.run([found, *strict, str(sample)], capture_output=True, text=True, check=False)

    done = compiled()
    assert done.returncode == 0, done.stdout
    sample.write_text(sample.read_text().replace('kind: "stop"', 'kind: "stopp"'))
    assert compiled().returncode != 0  # it looks


def test_what_is_said_is_no_word_of_the_instrument() -> None:
    """Whatever people send, it is never taken for a word of the instrument: the log keeps both by their kind."""
    said = set(TypeAdapter(Said).json_schema()["discriminator"]["mapping"])
    instrument = {n for n, k in vars(examination).items() if isinstance(k, type)}
    assert not said & instrument


def test_ops_that_cannot_mean_anything_are_refused() -> None:
    good = {"client": "c-1", "number": 1, "what": {"kind": "stop"}}
    assert Op(**good).what.kind == "stop"
    for bad in (
        {"number": 0}, {"number": 1.5}, {"number": -1}, {"client": ""}, {"client": "a b"}, {"client": "x" * 65},
        {"what": {"kind": "ScanTaken", "scan": "s", "rig": "r"}}, {"what": {"kind": "stop", "extra": 1}},
        {"what": {}}, {"at_ns": 2**70},
    ):  # fmt: skip
        with pytest.raises(ValidationError):
            Op(**{**good, **bad})


# ---------------------------------------------------------------------------------------------------------- the chain


def outside_hash(r: Record) -> str:
    """The hash of an entry, computed as docs/hub.md says, without our code."""
    row = [r.case, r.seq, r.at_ns, r.said_ns, r.actor, r.role, r.client, r.number, r.kind, r.refused, r.digest, r.prev]
    return hashlib.sha256(json.dumps(row, separators=(",", ":")).encode()).hexdigest()


def chain(n: int, case: str = "case-1") -> list[Record]:
    out: list[Record] = []
    for k in range(1, n + 1):
        bare = Record(
            case, k, 1000 + k, 0, "p", "expert", "c", k, "comment", "", f"{k:032x}", {"text": f"é {k}"}, "", ""
        )
        out.append(link(bare, out[-1].hash if out else GENESIS))
    return out


def test_anybody_can_compute_the_hashes() -> None:
    for r in chain(3):
        assert r.hash == outside_hash(r)
        words = r.salt.encode() + b"\n" + json.dumps(r.payload, sort_keys=True, separators=(",", ":")).encode()
        assert r.digest == hashlib.sha256(words).hexdigest()


FIELDS = ("seq", "at_ns", "said_ns", "actor", "role", "client", "number", "kind", "refused", "salt", "payload",
          "digest", "prev", "hash")  # fmt: skip


@pytest.mark.parametrize("name", FIELDS)
def test_any_altered_field_is_found(name: str) -> None:
    whole = chain(5)
    assert not check_chain(whole, "case-1")
    for k in range(5):
        old = getattr(whole[k], name)
        new: Any = {"text": "other"} if name == "payload" else old + 1 if isinstance(old, int) else old + "0"
        faults = check_chain([*whole[:k], replace(whole[k], **{name: new}), *whole[k + 1 :]], "case-1")
        assert faults, (name, k)


@given(st.lists(st.integers(0, 7), min_size=1, max_size=12))
def test_any_other_order_or_choice_of_entries_is_found(order: list[int]) -> None:
    whole = chain(8)
    picked = [whole[k] for k in order]
    is_start = order == list(range(len(order)))  # a tail that is cut off shows in a checkpoint alone
    assert bool(check_chain(picked, "case-1")) != is_start


def test_words_may_be_missing_where_an_entry_says_that_they_were_erased() -> None:
    whole = chain(4)
    bare = [replace(r, payload=None) for r in whole]
    assert len(check_chain(bare, "case-1")) == 4
    told = Record(
        "case-1", 5, 2000, 0, "a", "admin", "hub", 1, "erased", "", "00", {"through": 4, "why": "asked"}, "", ""
    )
    assert not check_chain([*bare, link(told, whole[-1].hash)], "case-1")
    short = replace(told, payload={"through": 3, "why": "asked"})
    assert len(check_chain([*bare, link(short, whole[-1].hash)], "case-1")) == 1
