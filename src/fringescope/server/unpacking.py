"""Other people's zip files: looked at before anything is unpacked, and unpacked inside one folder, within limits."""

from __future__ import annotations

import hashlib
import json
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from fringescope.errors import FormatError, OutputError
from fringescope.store.files import check_relative

MOST_FILES = 20_000
_PIECE = 1 << 20
_BROKEN = (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, OSError, EOFError, ValueError, RuntimeError)


class Unpacked:
    """A zip file whose contents were checked: their names stay inside, and they are not longer than `most` together.

    Use as a context manager. Raises FormatError for a file that is none, is damaged, or is made to do harm.
    """

    def __init__(self, path: Path, most: int, what: str, most_files: int = MOST_FILES) -> None:
        self.what, self._most_files = what, most_files
        try:
            self._zip = zipfile.ZipFile(path)
        except _BROKEN as e:
            raise FormatError(f"{what}: no zip file, or a damaged one ({e}); needed one as it was exported") from e
        try:
            self.entries = self._checked(most)
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> Unpacked:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def _checked(self, most: int) -> Mapping[str, zipfile.ZipInfo]:
        infos = self._zip.infolist()
        if len(infos) > self._most_files:
            raise FormatError(f"{self.what}: {len(infos)} files; at most {self._most_files} are taken")
        total = sum(i.file_size for i in infos)
        if total > most:
            raise FormatError(f"{self.what}: {total} bytes when it is unpacked; at most {most} are taken")
        seen: set[str] = set()
        out = {}
        for i in infos:
            name = i.filename
            if (bad := check_relative(name.rstrip("/"))) or "\x00" in i.orig_filename:
                raise FormatError(f"{self.what}: a file of the name {name[:80]!r}: {bad or 'holds control characters'}")
            if stat.S_IFMT(i.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise FormatError(f"{self.what}: {name[:80]!r} is a link or a device; needed files alone")
            if i.flag_bits & 1:
                raise FormatError(f"{self.what}: {name[:80]!r} is encrypted; export it without a password")
            if name.casefold().rstrip("/") in seen:
                raise FormatError(f"{self.what}: there are two files of the name {name[:80]!r}")
            seen.add(name.casefold().rstrip("/"))
            if not i.is_dir():
                out[name] = i
        return out

    def open(self, name: str) -> IO[bytes]:
        """A file of it. Raises FormatError where there is none."""
        if name not in self.entries:
            raise FormatError(f"{self.what}: {name[:80]!r} is missing; export it anew")
        try:
            return self._zip.open(self.entries[name])
        except _BROKEN as e:
            raise FormatError(f"{self.what}: {name[:80]!r} cannot be read: {e}") from e

    def pieces(self, name: str) -> Iterator[bytes]:
        """Its content, a piece at a time."""
        left = self.entries[name].file_size if name in self.entries else 0
        with self.open(name) as f:
            while True:
                try:
                    piece = f.read(_PIECE)
                except (*_BROKEN, zlib.error) as e:
                    raise FormatError(f"{self.what}: {name[:80]!r} is damaged: {e}") from e
                if not piece:
                    return
                left -= len(piece)
                if left < 0:
                    raise FormatError(f"{self.what}: {name[:80]!r} is longer than it says")
                yield piece

    def read(self, name: str, most: int) -> bytes:
        """A short file of it. Raises FormatError where it is longer than `most`."""
        if name in self.entries and self.entries[name].file_size > most:
            raise FormatError(f"{self.what}: {name[:80]!r} is longer than {most} bytes")
        return b"".join(self.pieces(name))

    def json(self, name: str, most: int) -> dict[str, Any]:
        """A JSON object of it. Raises FormatError."""
        return parsed(self.read(name, most), f"{self.what}: {name[:80]!r}")

    def sha256(self, name: str) -> tuple[str, int]:
        """Hash and length of a file of it."""
        digest, size = hashlib.sha256(), 0
        for piece in self.pieces(name):
            digest.update(piece)
            size += len(piece)
        return digest.hexdigest(), size

    def extract(self, name: str, to: Path) -> str:
        """Writes a file of it; returns its hash. Raises OutputError where the disk is full."""
        digest = hashlib.sha256()
        to.parent.mkdir(parents=True, exist_ok=True)
        try:
            with to.open("xb") as out:
                for piece in self.pieces(name):
                    digest.update(piece)
                    out.write(piece)
        except OSError as e:
            raise OutputError(f"{to}: {e.strerror}; nothing was kept of {self.what}") from e
        return digest.hexdigest()


def parsed(data: bytes, what: str) -> dict[str, Any]:
    """A JSON object. Raises FormatError."""
    try:
        doc = json.loads(data, parse_constant=_no_number)
    except (ValueError, RecursionError) as e:
        raise FormatError(f"{what} is no JSON: {str(e)[:100]}") from None
    if not isinstance(doc, dict):
        raise FormatError(f"{what} is no JSON object")
    return doc


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number")
