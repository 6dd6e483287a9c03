"""The photograph of a view that a scan keeps: for previews of guidance, and to see later whether something moved."""

from __future__ import annotations

import numpy as np

from fringescope import memory, phase
from fringescope.kernels import colour
from fringescope.kernels.views import constant
from fringescope.types import Decoded, Picture, PixelFormat, ViewInput


def taken(view: ViewInput, decoded: Decoded) -> Picture:
    """The ring-light frame of a view as the camera gave it; where there is none, the background A of its fringes.

    A in codes of the view's format, rounded; of RGB8, whose fringes are the sum of the channels, their mean as Mono8.
    Raises CaptureError for a frame that does not fit the format.
    """
    fmt, camera = view.plan.pixel_format, view.plan.camera
    if view.color is not None:
        return Picture(camera, phase.unpacked(view.color, fmt), fmt)
    kept = PixelFormat.MONO8 if fmt is PixelFormat.RGB8 else fmt
    codes = memory.empty(decoded.shape, np.uint16)
    scale = np.float32(1.0 / 65535.0 / (fmt.full_scale / fmt.max_value))
    unused = np.empty(decoded.shape, np.bool_)
    colour.share_codes(constant(decoded.background), scale, np.float32(np.inf), codes, unused)
    np.minimum(codes, kept.max_value, out=codes)
    return Picture(camera, codes.astype(kept.dtype, copy=False), kept, "projector")
