"""Files by the hash of their content: written once, whole or not at all, never changed."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

from fringescope.errors import FormatError, OutputError

_NAME = re.compile(r"[0-9a-f]{64}")
_PIECE = 1 << 20


class Blobs:
    """A folder of files named by their SHA-256, hex."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "new").mkdir(parents=True, exist_ok=True)
        for left in (folder / "new").iterdir():  # from a process that was killed
            left.unlink(missing_ok=True)

    def path(self, sha256: str) -> Path:
        """Where a file lies, if it is there. Raises FormatError for what is no hash."""
        if not _NAME.fullmatch(sha256):
            raise FormatError(f"{sha256[:80]!r} is no SHA-256 in hex")
        return self.folder / sha256[:2] / sha256

    def has(self, sha256: str) -> bool:
        """Whether a file is there."""
        return self.path(sha256).is_file()

    def put(self, source: bytes | Path | BinaryIO) -> tuple[str, int]:
        """Takes a file in; returns its hash and size. It is on the disk when this returns.

        Raises OutputError where the disk is full, and leaves nothing behind.
        """
        if isinstance(source, Path):
            with source.open("rb") as f:
                return self.put(f)
        digest, size = hashlib.sha256(), 0
        number, name = tempfile.mkstemp(dir=self.folder / "new")
        temporary = Path(name)
        try:
            with os.fdopen(number, "wb") as out:
                if isinstance(source, bytes):
                    digest.update(source)
                    size = len(source)
                    out.write(source)
                else:
                    while piece := source.read(_PIECE):
                        digest.update(piece)
                        size += len(piece)
                        out.write(piece)
                out.flush()
                os.fsync(out.fileno())
            sha256 = digest.hexdigest()
            target = self.path(sha256)
            if not target.exists():
                target.parent.mkdir(exist_ok=True)
                temporary.chmod(0o440)
                temporary.replace(target)
                _sync(target.parent)
        except OSError as e:
            full = e.errno in (errno.ENOSPC, errno.EDQUOT)
            raise OutputError(
                f"{self.folder}: {'the disk is full' if full else e.strerror}; nothing was kept of the file"
            ) from e
        finally:
            temporary.unlink(missing_ok=True)
        return sha256, size

    def remove(self, sha256: str) -> None:
        """Takes a file out, for an erasure. Nothing happens if it is not there."""
        self.path(sha256).unlink(missing_ok=True)

    def free_bytes(self) -> int:
        """Room on the disk."""
        return shutil.disk_usage(self.folder).free


def _sync(folder: Path) -> None:
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
