"""Is what was scanned still where it was: what `watch` finds, by tiles of each camera's picture, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from fringescope.types.names import F64


class Standing(Enum):
    """Whether guidance on a scan may still be shown."""

    VALID = "VALID"  #: nothing moved by more than the limits, and enough could be seen to say so
    SUSPECT = "SUSPECT"  #: something changed a little, or too little could be judged: shown dashed, with a warning
    STALE = "STALE"  #: it moved: dark, scan again


class TileState(IntEnum):
    """What one tile of a picture says."""

    NO_VOTE = 0  #: no surface, no texture, masked, or saturated: it cannot say anything
    STILL = 1
    SHIFTED = 2  #: by more than the limit of SUSPECT
    MOVED = 3  #: by more than the limit of STALE
    CHANGED = 4  #: what is seen there is no longer what was scanned: covered, cut, or much brighter or darker


@dataclass(frozen=True, eq=False)
class WatchTiles:
    """Tiles of one camera's picture, all arrays (n,) or (n, 2): the finest level first, coarser ones after it."""

    centre: F64  #: (n, 2) camera pixels (u, v)
    size: F64  #: (n,) side in camera pixels
    width_mm: F64  #: (n,) side across the line of sight, mm
    shift_mm: F64  #: (n, 2) motion across the line of sight along u and v (a re-measurement: along it, and 0); NaN
    sigma_mm: F64  #: (n,) its standard deviation, along the direction that is known best
    p: F64  #: (n,) probability of such a shift by noise alone
    state: NDArray[np.int8]  #: (n,) `TileState`


@dataclass(frozen=True, eq=False)
class CameraWatch:
    """What one camera says."""

    camera: str
    shift_mm: float  #: largest shift that noise does not explain, 0 where there is none
    at: tuple[float, float] | None  #: camera pixel (u, v) of its tile
    judged: float  #: share of what could be judged in the scan's picture that can be judged now
    changed: float  #: share of its view of the surface that is covered, cut or otherwise not what was scanned
    gain: tuple[float, ...]  #: brightness now over then, per channel
    tiles: WatchTiles
    note: str = ""


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion that all cameras' shifts agree on: p becomes about + move + (I + turn x)(p - about).

    `move_mm` (3,) and `turn_rad` (3,) in the world, `sigma_move_mm`, `sigma_turn_rad` their standard deviations;
    `largest_mm`: the farthest that a point of the surface went; `p`: probability of such a motion by noise alone.
    """

    about: F64
    move_mm: F64
    turn_rad: F64
    sigma_move_mm: F64
    sigma_turn_rad: F64
    largest_mm: float
    sigma_largest_mm: float
    p: float
    tiles: int  #: that it rests on
    share: float  #: of the tiles that it explains


@dataclass(frozen=True, eq=False)
class Watched:
    """The verdict, in one line `why`, with what it rests on."""

    verdict: Standing
    why: str
    cameras: tuple[CameraWatch, ...]
    motion: Motion | None
    p: float  #: least probability, over all tests together, that noise alone made the shifts
    judged: float  #: share of what the scan's pictures could tell that could be judged, all cameras
    by: str = "picture"  #: or "fringes": the re-measurement

    @property
    def shift_mm(self) -> float:
        """Largest shift of any camera that noise does not explain."""
        return max((c.shift_mm for c in self.cameras), default=0.0)


