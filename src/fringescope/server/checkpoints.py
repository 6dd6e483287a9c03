"""Signed checkpoints: where the log of each case ended at a time, so that a tail that was cut off is missed.

A file of checkpoints has one JSON object a line. The first of a file names the last entry of every case, the others
those that have moved since; each names the hash of the line before it and is signed with the hub's own Ed25519 key.
Whoever rules the hub's whole machine could replace log, key and checkpoints together: so take checkpoints and the
public key off it from time to time (`fringescope audit checkpoint`, `fringescope audit key`).
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import hashlib
import json
import logging
import os
import secrets
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from fringescope.errors import FormatError, FringescopeError, OutputError
from fringescope.server import database as db
from fringescope.server import journal
from fringescope.server.clock import Clock
from fringescope.wire.record import canonical

FORMAT, VERSION = "fringescope-checkpoint", 1
KEY, PUBLIC = "audit-key.pem", "audit-key.pub.pem"  #: in the hub's folder
FOLDER = "checkpoints"
_LINE = 64 << 20  #: longest checkpoint

Heads = Mapping[str, tuple[int, str]]  #: case -> number and hash of its last entry


# ----------------------------------------------------------------------------------------------------------- the key


def own_key(data: Path) -> Ed25519PrivateKey:
    """The hub's key, made once; nobody else on the machine may read it. Raises FormatError and OutputError."""
    path = data / KEY
    if not path.exists():
        made = Ed25519PrivateKey.generate()
        pem = made.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        new = data / f".{KEY}.{secrets.token_hex(6)}"
        try:
            _write_once(new, pem, 0o600)
            with contextlib.suppress(FileExistsError):
                os.link(new, path)  # of two that come at once, one
        except OSError as e:
            raise OutputError(f"{path}: {e.strerror}; needed a folder that can be written") from e
        finally:
            new.unlink(missing_ok=True)
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError) as e:
        raise FormatError(f"{path}: cannot be read as the hub's key: {e}; restore it from a backup") from e
    if not isinstance(key, Ed25519PrivateKey):
        raise FormatError(f"{path}: not an Ed25519 key; restore it from a backup")
    if not (data / PUBLIC).exists():
        with contextlib.suppress(FileExistsError):
            _write_once(data / PUBLIC, public_pem(key.public_key()), 0o644)
    return key


def _write_once(path: Path, content: bytes, mode: int) -> None:
    number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(number, "wb") as out:
        out.write(content)
        out.flush()
        os.fsync(out.fileno())


def public_pem(key: Ed25519PublicKey) -> bytes:
    """A public key as PEM."""
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def read_public(path: Path) -> Ed25519PublicKey:
    """A public key out of a PEM file, also that of a private key. Raises FormatError."""
    try:
        content = path.read_bytes()
        if b"PRIVATE" in content:
            private = serialization.load_pem_private_key(content, None)
            key: Any = private.public_key()
        else:
            key = serialization.load_pem_public_key(content)
    except OSError as e:
        raise FormatError(f"{path}: {e.strerror}; needed the hub's public key, as PEM") from e
    except (ValueError, TypeError) as e:
        raise FormatError(f"{path}: not a key in PEM; see: fringescope audit key") from e
    if not isinstance(key, Ed25519PublicKey):
        raise FormatError(f"{path}: another kind of key; needed Ed25519, as of: fringescope audit key")
    return key


def raw(key: Ed25519PublicKey) -> str:
    """The 32 bytes of a public key, hex."""
    return key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw).hex()


def fingerprint(key: str) -> str:
    """What people compare of a public key (hex): SHA-256 of it, the first 16 bytes."""
    text = hashlib.sha256(bytes.fromhex(key)).hexdigest()[:32]
    return " ".join(text[i : i + 4] for i in range(0, 32, 4))


def signed(doc: Mapping[str, Any], key: Ed25519PrivateKey) -> dict[str, Any]:
    """An object with the public key and a signature over all of it in canonical JSON."""
    whole = {**doc, "key": raw(key.public_key())}
    return {**whole, "signature": key.sign(canonical(whole)).hex()}


def signature_fits(doc: Mapping[str, Any]) -> bool:
    """Whether the key that an object names has signed it as it stands."""
    try:
        whole = {k: v for k, v in doc.items() if k != "signature"}
        key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(doc["key"]))
        key.verify(bytes.fromhex(doc["signature"]), canonical(whole))
    except (KeyError, TypeError, ValueError, AttributeError, InvalidSignature):
        return False
    return True


# -------------------------------------------------------------------------------------------------------- checkpoints


@dataclass(frozen=True)
class Checkpoint:
    """One line of a file, where it stands, and what is wrong with it ("": nothing)."""

    where: str
    at_ns: int
    heads: Heads
    key: str
    fault: str = ""


class Checkpoints:
    """Writes the checkpoints of a hub, one file a day (UTC)."""

    def __init__(self, engine: sa.Engine, clock: Clock, data: Path) -> None:
        self._engine, self._clock, self._folder = engine, clock, data / FOLDER
        self.key = own_key(data)
        self._told: Heads = {}
        self._file: Path | None = None
        self._prev = ""
        self._lock = threading.Lock()  #: one at a time, also when somebody no longer waits for the one before

    def write(self) -> Path | None:
        """A checkpoint, if any log has moved since the last one; its file. Raises OutputError."""
        with self._lock:
            return self._write()

    def _write(self) -> Path | None:
        now = self._clock.now_ns()
        heads = journal.heads(self._engine)
        db.flush(self._engine)  # a checkpoint tells of nothing that a power cut could take back
        file = self._folder / f"{datetime.datetime.fromtimestamp(now / 1e9, datetime.UTC):%Y-%m-%d}.jsonl"
        whole = self._file != file
        moved = heads if whole else {k: v for k, v in heads.items() if self._told.get(k) != v}
        if not moved:
            return None
        doc = _document(now, moved, whole, self._prev)
        line = canonical(signed(doc, self.key)) + b"\n"
        try:
            self._folder.mkdir(exist_ok=True)
            _append(file, line)
        except OSError as e:
            raise OutputError(f"{file}: the checkpoint cannot be written: {e.strerror}") from e
        self._told, self._file, self._prev = heads, file, hashlib.sha256(line.strip()).hexdigest()
        return file

    async def run(self, every_s: float) -> None:
        """One every `every_s` seconds, until it is cancelled. What fails is tried again."""
        while True:
            await asyncio.sleep(every_s)
            await self.try_to_write()

    async def try_to_write(self) -> None:
        """A checkpoint; that it could not be written is logged."""
        try:
            await asyncio.to_thread(self.write)
        except (FringescopeError, sa.exc.SQLAlchemyError) as e:
            logging.getLogger("uvicorn.error").warning("no checkpoint: %s", e)


def _append(file: Path, line: bytes) -> None:
    """A line at the end of a file, whole or not at all; what a power cut left of another goes."""
    with os.fdopen(os.open(file, os.O_RDWR | os.O_CREAT, 0o640), "r+b", buffering=0) as out:
        end = out.seek(0, os.SEEK_END)
        while end and (out.seek(end - 1), out.read(1))[1] != b"\n":
            end -= 1
        out.truncate(end)
        out.seek(end)
        try:
            left = line
            while left:
                left = left[out.write(left) or 0 :]
            os.fsync(out.fileno())
        except OSError:
            out.truncate(end)
            raise


def _document(now: int, heads: Heads, whole: bool, prev: str) -> dict[str, Any]:
    told = {k: [n, h] for k, (n, h) in heads.items()}
    return {"format": FORMAT, "version": VERSION, "at_ns": now, "whole": whole, "heads": told, "prev": prev}


def export(engine: sa.Engine, key: Ed25519PrivateKey, folder: Path, now: int) -> Path:
    """A whole checkpoint as a new file in a folder, to be kept elsewhere. Raises OutputError."""
    heads = journal.heads(engine)
    name = f"checkpoint-{datetime.datetime.fromtimestamp(now / 1e9, datetime.UTC):%Y%m%dT%H%M%S.%fZ}.jsonl"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_once(folder / name, canonical(signed(_document(now, heads, True, ""), key)) + b"\n", 0o640)
    except OSError as e:
        raise OutputError(f"{folder / name}: {e.strerror}; needed a folder that can be written") from e
    return folder / name


def read(paths: Iterable[Path], key: str) -> list[Checkpoint]:
    """The checkpoints of files and folders, each judged: signed by `key` (hex), whole, in its place.

    Raises FormatError for a path that is not there.
    """
    out: list[Checkpoint] = []
    for path in paths:
        if not path.exists():
            raise FormatError(f"{path}: not found; needed a file or folder of checkpoints")
        for file in sorted(path.glob("*.jsonl")) if path.is_dir() else [path]:
            out += _of_file(file, key)
    return out


def _of_file(file: Path, key: str) -> list[Checkpoint]:
    out: list[Checkpoint] = []
    try:
        lines = file.read_bytes().split(b"\n")
    except OSError as e:
        return [Checkpoint(str(file), 0, {}, "", f"cannot be read: {e.strerror}")]
    lines.pop()  # behind the last line's end: nothing, or what a power cut left
    prev: str | None = None
    for n, line in enumerate(lines, 1):
        if not line:
            continue
        found = _of_line(line, f"{file.name}, line {n}", key, prev)
        out.append(found)
        prev = hashlib.sha256(line).hexdigest()
    return out


def _parsed(line: bytes) -> dict[str, Any]:
    try:
        doc = json.loads(line) if len(line) <= _LINE else None
    except (ValueError, RecursionError):
        doc = None
    return doc if isinstance(doc, dict) else {}


def _of_line(line: bytes, where: str, key: str, prev: str | None) -> Checkpoint:
    doc = _parsed(line)
    if doc.get("format") != FORMAT or not isinstance(doc.get("version"), int):
        return Checkpoint(where, 0, {}, "", "it is no checkpoint; it was altered or cut off")
    if doc["version"] > VERSION:
        return Checkpoint(where, 0, {}, "", f"version {doc['version']} is higher than this program reads; update it")
    at, whole, named = doc.get("at_ns"), doc.get("whole"), str(doc.get("key"))
    if not signature_fits(doc):
        return Checkpoint(where, 0, {}, named[:64], "its signature does not fit; it was altered or forged")
    if named != key:
        return Checkpoint(where, 0, {}, named, "it is signed with another key than the hub's")
    heads = {str(k): (int(n), str(h)) for k, (n, h) in doc["heads"].items()}
    fault = ""
    if not whole and doc.get("prev") != prev:
        fault = "it does not follow the line before it; checkpoints were removed or moved"
    return Checkpoint(where, int(at or 0), heads, named, fault)
