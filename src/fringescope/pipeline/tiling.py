"""Frames that would not fit into memory all at once: a few rows of all of them at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fringescope import denoise, phase
from fringescope.errors import CaptureError
from fringescope.types import AnyArray, FrameKey, RowFrames, ViewPlan

LEAST = 16  #: rows that are worth the trouble


@dataclass(frozen=True, eq=False)
class ByRows:
    """The frames of a view, of which `rows` rows are to be held at a time."""

    frames: RowFrames
    rows: int

    def __iter__(self) -> Iterator[tuple[FrameKey, AnyArray]]:
        return iter(self.frames)

    def looked_over(
        self, plan: ViewPlan, height: int
    ) -> tuple[list[tuple[FrameKey, AnyArray]], list[tuple[FrameKey, AnyArray]]]:
        """Each frame once, whole: arrays of its shape and type that hold nothing, and every n-th row and column of it,
        as statistics want them. Raises what the frames raise.
        """
        hollow, few = [], []
        for key, frame in self.frames.rows(0, height + 1):  # one row too many tells
            hollow.append((key, np.broadcast_to(np.zeros((), frame.dtype), frame.shape)))
            if frame.ndim == 2 or plan.pixel_format.packs(frame):
                columns = frame.shape[1] * (1 if frame.ndim == 2 else 2)
                every = denoise.odd_stride(frame.shape[0] * columns)
                few.append((key, phase.thinned(frame, plan.pixel_format, every).copy()))
        return hollow, few

    def in_bands(
        self, keys: Sequence[FrameKey], like: AnyArray, work: Callable[[int, int, list[AnyArray]], None]
    ) -> None:
        """Call `work(first, last, rows)` with rows first to last - 1 of the frames of these keys, which are all `like`
        this one, until all rows have been worked on; the rows of one band are gone before those of the next come.

        Raises CaptureError if the frames are no longer what they were.
        """
        height = like.shape[0]
        for first in range(0, height, self.rows):
            last = min(first + self.rows, height)
            there = {key: np.ascontiguousarray(rows) for key, rows in self.frames.rows(first, last)}
            shape = (last - first, *like.shape[1:])
            fits = all(rows.shape == shape and rows.dtype == like.dtype for rows in there.values())
            if there.keys() != set(keys) or not fits:
                raise CaptureError(
                    f"rows {first} to {last - 1} of the frames are not what they were at first; "
                    "needed files that stay as they are"
                )
            work(first, last, [there.pop(key) for key in keys])
