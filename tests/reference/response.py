"""The slow, obvious twin of `kernels.response`: the table is read at one pixel after the other."""

from __future__ import annotations

import math

import numpy as np


def correct(phase, sigma, steps, table, slope):  # type: ignore[no-untyped-def]
    """See the kernel."""
    out, out_sigma = np.array(phase), np.array(sigma)
    n = len(table)
    for index, p in np.ndenumerate(np.asarray(phase, np.float64)):
        if not math.isfinite(p):
            continue
        x = math.fmod(p * steps / (2 * math.pi) + 1000.0, 1.0) * n
        at = np.arange(n + 1)
        shift = np.interp(x, at, np.append(table, table[0]))
        grow = np.interp(x, at, np.append(slope, slope[0]))
        turned = complex(math.cos(p + shift), math.sin(p + shift))
        out[index] = math.atan2(turned.imag, turned.real)
        out_sigma[index] = sigma[index] * grow
    return out, out_sigma
