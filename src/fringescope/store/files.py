"""Outputs that appear whole or not at all: folders and files are written beside their place and renamed into it.

A folder that we write holds a *marker*, the JSON file that says what it is (`capture.json`, `scan.json`, ...). `force`
replaces a folder only if it holds the marker of what is being written: a scan never replaces a capture.

A run that is killed leaves its hidden work behind. Whoever writes holds a lock on its work, which ends with the process
however that ends: the next run for the same target takes away what nobody holds any more.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # no such locks here: nothing is swept
    fcntl = None  # type: ignore[assignment]

from fringescope.errors import FormatError, OutputError

CAPTURE, SCAN, DECODED, PLAN, BOARD = "capture.json", "scan.json", "decoded.json", "plan.json", "board.json"
COMPARISON = "compare.json"

#: files that stand beside the cameras' folders in a capture, a scan, a decoded capture or patterns
BESIDE = frozenset((CAPTURE, SCAN, DECODED, PLAN, "cloud.ply", "surface.glb", "preview.glb", "view.html"))

_REASONS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "the file would be larger than the system allows",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "no permission to write there",
    errno.EPERM: "no permission to write there",
    errno.ENAMETOOLONG: "the name is too long",
    errno.EEXIST: "a part of the path is a file, not a folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
}


def _why(e: OSError) -> str:
    return _REASONS.get(e.errno or 0, (e.strerror or str(e) or type(e).__name__).splitlines()[0])


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _sync_folder(path: Path) -> None:
    if os.name == "posix":  # a folder cannot be opened elsewhere
        _sync(path)


def _make_parents(parent: Path) -> list[Path]:
    """Creates missing parents; returns those made, deepest first, so that a failure can take them away again."""
    made: list[Path] = []
    p = parent
    while not p.exists():
        made.append(p)
        p = p.parent
    parent.mkdir(parents=True, exist_ok=True)
    return made


def _umask_mode(mode: int) -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mode & ~mask


def _check_target_folder(path: Path, marker: str, force: bool) -> None:
    if not os.path.lexists(path):
        return
    if not path.is_dir():
        raise OutputError(f"{path}: is a file; needed a new folder")
    if not any(path.iterdir()):
        return
    if not (path / marker).is_file():
        raise OutputError(f"{path}: holds other files (no {marker}); choose a new or empty folder")
    if not force:
        raise OutputError(f"{path}: already holds a {Path(marker).stem}; choose another folder, or add --force")


def _hold(work: Path) -> int | None:
    """Locks a file or folder for as long as this process lives or until `_let_go`; None where another holds it."""
    if fcntl is None:
        return None
    try:
        fd = os.open(work, os.O_RDONLY)
    except OSError:
        return None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(fd)
        return None
    return fd


def _let_go(fd: int | None) -> None:
    if fd is not None:
        os.close(fd)


SYNCS = 8  #: files that are written out at once
FRESH_S = 5.0  #: work this young may not have its lock yet


def _sweep(target: Path, stem: str, suffix: str) -> None:
    """Takes away what killed runs left of `target`: work that is not fresh, ours, and held by nobody.

    Killed between the two renames of `_swap`, the former folder still lies aside: it is put back.
    """
    if fcntl is None:
        return
    ours = re.compile(rf"\.{re.escape(stem[:80])}\.[A-Za-z0-9_]{{8}}(\.part{re.escape(suffix)}|\.old)")
    for left in sorted(target.parent.glob(".*")):
        if not ours.fullmatch(left.name) or left.is_symlink():
            continue
        with suppress(OSError):
            told = left.stat()
            if told.st_uid != os.getuid() or time.time() - told.st_mtime < FRESH_S:
                continue
            fd = _hold(left)
            if fd is None:
                continue
            try:
                if left.is_file():
                    left.unlink()
                    continue
                if left.suffix == ".old" and (left / "was").is_dir() and not os.path.lexists(target):
                    (left / "was").replace(target)
                shutil.rmtree(left, ignore_errors=True)
            finally:
                _let_go(fd)


@contextmanager
def new_folder(path: Path | str, *, marker: str, force: bool = False) -> Iterator[Path]:
    """A folder that appears whole at the end of the block, or not at all.

    Yields a temporary sibling to write into. `marker` names the file that says what the folder holds; with `force` a
    folder that holds that marker is replaced, and stays as it was until the new one is whole. Raises OutputError where
    `path` is a file, holds other files, or holds the marker without `force`; and for any OSError in the block (disk
    full, no permission).
    """
    path = Path(path)
    try:
        target = path.resolve()  # a link to a folder stays a link
        if target.parent.is_dir():
            _sweep(target, target.name, "")
        _check_target_folder(path, marker, force)
        made = _make_parents(target.parent)
    except OSError as e:
        raise OutputError(f"{path}: cannot write: {_why(e)}") from e
    work: Path | None = None
    held: int | None = None
    try:
        try:
            work = Path(tempfile.mkdtemp(prefix=f".{target.name[:80]}.", suffix=".part", dir=target.parent))
            held = _hold(work)
            yield work
            with ThreadPoolExecutor(SYNCS) as pool:  # a disk is waited for once, not file by file
                list(pool.map(_sync, (f for f in sorted(work.rglob("*")) if f.is_file())))
            work.chmod(_umask_mode(0o777))
            _sync_folder(work)
            _check_target_folder(path, marker, force)  # somebody may have written there meanwhile
            _swap(work, target)
        except OSError as e:
            raise OutputError(f"{path}: cannot write: {_why(e)}") from e
    except BaseException:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
        for p in made:
            with suppress(OSError):
                p.rmdir()
        raise
    finally:
        _let_go(held)


def _swap(work: Path, target: Path) -> None:
    old: Path | None = None
    held: int | None = None
    try:
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name[:80]}.", suffix=".old", dir=target.parent))
            held = _hold(old)
            target.replace(old / "was")
        try:
            work.replace(target)
        except BaseException:
            if old is not None:
                (old / "was").replace(target)
                old.rmdir()
            raise
        _sync_folder(target.parent)
        if old is not None:
            shutil.rmtree(old, ignore_errors=True)
    finally:
        _let_go(held)


def check_new(path: Path, force: bool) -> None:
    """Raises OutputError where a file may not be written: it is there, and `force` is not given, or it is a folder."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; needed the name of a file")
    if os.path.lexists(path) and not force:
        raise OutputError(f"{path}: exists; choose another name, or add --force to replace it")


@contextmanager
def new_file(path: Path | str, *, force: bool = False) -> Iterator[Path]:
    """A file that appears whole at the end of the block, or not at all.

    Yields a temporary sibling path with the same suffix, to be written. Raises OutputError where `path` exists (a
    file is replaced with `force`, a folder never), and for any OSError in the block.
    """
    path = Path(path)
    check_new(path, force)
    try:
        target = path.resolve()
        if target.parent.is_dir():
            _sweep(target, target.stem, target.suffix)
        made = _make_parents(target.parent)
    except OSError as e:
        raise OutputError(f"{path}: cannot write: {_why(e)}") from e
    work: Path | None = None
    held: int | None = None
    try:
        try:
            prefix, suffix = f".{target.stem[:80]}.", f".part{target.suffix}"
            fd, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=target.parent)
            os.close(fd)
            work = Path(name)
            held = _hold(work)
            yield work
            work.chmod(_umask_mode(0o666))
            _sync(work)
            work.replace(target)
            _sync_folder(target.parent)
        except OSError as e:
            raise OutputError(f"{path}: cannot write: {_why(e)}") from e
    except BaseException:
        if work is not None:
            work.unlink(missing_ok=True)
        for p in made:
            with suppress(OSError):
                p.rmdir()
        raise
    finally:
        _let_go(held)


# --------------------------------------------------------------------------------------------------------------- JSON


def read_json(path: Path, what: str) -> dict[str, Any]:
    """The JSON object in a file; `what` names it in errors ("a rig"). Raises FormatError, also for a missing file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise FormatError(f"{path}: not found; needed {what}") from None
    except IsADirectoryError:
        raise FormatError(f"{path}: is a folder; needed {what}") from None
    except (OSError, ValueError) as e:
        raise FormatError(f"{path}: cannot read {what}: {_why(e) if isinstance(e, OSError) else e}") from e
    try:
        out = json.loads(data.decode("utf-8-sig"), parse_int=_whole)
    except RecursionError:
        raise FormatError(f"{path}: not {what}: nested too deeply") from None
    except ValueError as e:
        raise FormatError(f"{path}: not {what}: not JSON: {str(e).splitlines()[0][:120]}") from None
    if not isinstance(out, dict):
        raise FormatError(f"{path}: not {what}: needed a JSON object, came {type(out).__name__}")
    return out


def _whole(text: str) -> int | float:
    """A whole number of JSON; one of thousands of digits is infinite, which who needs it refuses."""
    return int(text) if len(text) <= 4000 else float(text)


def check_format(doc: Mapping[str, Any], path: Path, format_: str, version: int) -> None:
    """Refuses another `format` and a higher `version`, and a file without them. Raises FormatError."""
    for key, needed in (("format", f'"{format_}"'), ("version", f"a whole number from 1 to {version}")):
        if key not in doc:
            raise FormatError(f'{path}: "{key}" is missing; needed {needed}: add it, or give another file')
    if doc["format"] != format_:
        raise FormatError(f'{path}: "format" is {shown(doc["format"])}; needed "{format_}"')
    v = doc["version"]
    if isinstance(v, bool) or not isinstance(v, int) or v < 1:
        raise FormatError(f'{path}: "version" is {shown(v)}; needed a whole number from 1 to {version}')
    if v > version:
        raise FormatError(f"{path}: version {shown(v)} is higher than this program reads ({version}); update it")


def shown(value: object, length: int = 60) -> str:
    """A value of somebody's file as one short line for an error."""
    try:
        text = json.dumps(value, ensure_ascii=True)
    except (TypeError, ValueError, RecursionError):
        text = f"a {type(value).__name__}"
    return text if len(text) <= length else text[: length - 3] + "..."


def write_json(path: Path, doc: Mapping[str, Any] | list[Any]) -> None:
    """A JSON object or array as text, into a folder that is being made. Numbers must be finite."""
    path.write_text(json.dumps(doc, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _numbers(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _numbers(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_numbers(v) for v in value]
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1 << 53:
        return float(value)
    return value


def canonical_hash(doc: Mapping[str, Any]) -> str:
    """ "sha256:..." of a JSON object, whatever its white space, order of keys and spelling of numbers."""
    text = json.dumps(_numbers(doc), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return "sha256:" + hashlib.sha256(text.encode("ascii")).hexdigest()


def check_name(name: str) -> str | None:
    """What is wrong with a camera's name, which also names a folder; None if nothing is."""
    if not name or len(name) > 100:
        return "needed 1 to 100 characters"
    if name in (".", "..") or name != name.strip() or name.endswith("."):
        return "needed a name that a folder can have"
    if name.casefold() in BESIDE:
        return "is the name of a file that we write beside the camera's folder; needed another, as in camera1"
    if any(c in '/\\:*?"<>|#' or ord(c) < 32 or 0xD800 <= ord(c) <= 0xDFFF for c in name):
        return "needed letters, digits, - and _ (it names a folder)"
    return None


def check_relative(name: str) -> str | None:
    """What is wrong with a frame's file name in `capture.json`; None if it stays inside the capture's folder."""
    if not name or len(name) > 1000:
        return "needed a file name"
    if any(ord(c) < 32 or 0xD800 <= ord(c) <= 0xDFFF for c in name):
        return "holds control characters"
    if "\\" in name:
        return "needed forward slashes"
    if name.startswith(("/", "~")) or (len(name) > 1 and name[1] == ":"):
        return "is absolute; needed a path inside the capture's folder"
    if ".." in name.split("/"):
        return "leaves the capture's folder; needed a path inside it"
    return None
