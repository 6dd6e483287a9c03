"""Frames of large pictures, decoded once and kept raw on disk, so that any rows of all of them can be had."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from typing import IO

import numpy as np

from fringescope.errors import OutputError
from fringescope.types import AnyArray, FrameKey

LARGE = 1 << 28  #: bytes; what is smaller stays in memory


class Spool:
    """The frames of a view, written to a temporary file as they come: (key, array), whole or some rows of each.

    The file has no name and goes with the object. Raises OutputError where the disk is full, and what `frames` raises.
    """

    def __init__(self, frames: Iterable[tuple[FrameKey, AnyArray]]) -> None:
        self._keys: list[tuple[FrameKey, tuple[int, ...], np.dtype[np.generic]]] = []
        self._file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the object
        try:
            for key, frame in frames:
                self._keys.append((key, frame.shape, frame.dtype))
                self._file.write(np.ascontiguousarray(frame).data)
            self._file.flush()
        except OSError as e:
            self._file.close()
            raise OutputError(
                f"{tempfile.gettempdir()}: cannot keep the frames of a large picture there ({e.strerror}); "
                "make room, or name another folder by TMPDIR"
            ) from e

    def __del__(self) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[tuple[FrameKey, AnyArray]]:
        return self.rows(0, max((shape[0] for _, shape, _ in self._keys), default=0))

    def rows(self, first: int, last: int) -> Iterator[tuple[FrameKey, AnyArray]]:
        """Rows first to last - 1 of each frame."""
        start = 0
        for key, shape, dtype in self._keys:
            row = int(np.prod(shape[1:], dtype=np.int64)) * dtype.itemsize
            n = max(min(last, shape[0]) - first, 0)
            self._file.seek(start + first * row)
            yield key, np.frombuffer(self._file.read(n * row), dtype).reshape(n, *shape[1:])
            start += shape[0] * row


def spooled(frames: Iterable[tuple[FrameKey, AnyArray]], size: int) -> Iterable[tuple[FrameKey, AnyArray]]:
    """The same frames, on disk if their `size` in bytes is large."""
    return Spool(frames) if size > LARGE else frames
