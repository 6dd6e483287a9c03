"""The fused way on a GPU, for who asks for it: the same result as the processor's, within float32's rounding.

Imported only then: nothing else of the program knows of CUDA.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fringescope import gpu
from fringescope.errors import UsageError
from fringescope.kernels import gpu as k
from fringescope.kernels.depths import Depths
from fringescope.kernels.fused import Limits, Sets
from fringescope.types import F64, AnyArray

#: what comes out, in the order of `fused.decode`: phase, sigma, A, B, reasons, xyz, sigma in mm
FIELDS = (
    *(gpu.Field(0, np.float32) for _ in range(4)), gpu.Field(0, np.uint16), gpu.Field(3, np.float32),
    gpu.Field(0, np.float32),
)  # fmt: skip


def require() -> None:
    """Raise UsageError if work on a GPU cannot be had here."""
    if lack := gpu.missing():
        raise UsageError(f"device 'gpu': {lack}, or take device 'cpu'")


def takes(sets: Sets) -> bool:
    """Whether a thread has room for these sets."""
    return len(sets.frequency) <= k.MAX_SETS and int(sets.start[-1]) <= k.MAX_FRAMES


def by_slabs(
    frames: Sequence[AnyArray],
    sets: Sets,
    limits: Limits,
    bounds: F64,
    usual: F64,
    depths: Depths,
    out: Sequence[AnyArray | None],
) -> None:
    """All frames (H, W) of a view through `kernels.gpu.decode` into the arrays `out`: see FIELDS; None: not wanted."""
    lanes, launch = prepared(frames, sets, limits, bounds, usual, depths)
    lanes.run(frames, launch, out)


def prepared(
    frames: Sequence[AnyArray], sets: Sets, limits: Limits, bounds: F64, usual: F64, depths: Depths
) -> tuple[gpu.Slabs, Callable[[gpu.Slab], None]]:  # fmt: skip
    """Buffers for these frames, and what to launch on each slab; the view's tables are on the device."""
    H, W = frames[0].shape
    lanes = gpu.slabs(len(frames), H, W, frames[0].dtype.str, FIELDS, gpu.SLAB)
    sets, limits, depths = _sent(sets), _sent(limits), _sent(depths)
    rows = k.Rows(
        gpu.room((H, depths.table.shape[1]), np.float32), gpu.room((4, H, bounds.shape[2]), np.float64),
        gpu.room((H, usual.shape[1]), np.float64),
    )  # fmt: skip
    k.rows(H, depths, _sent(k.Nodes(bounds, usual)), rows)

    def launch(slab: gpu.Slab) -> None:
        k.decode(k.Band(slab.frames, slab.first, *slab.out), sets, limits, rows, depths, slab.stream)

    gpu.wait()
    return lanes, launch


def _sent(values: Any) -> Any:
    """A tuple of the kernels with its arrays on the device."""
    return type(values)(*(gpu.sent(v) if isinstance(v, np.ndarray) else v for v in values))
