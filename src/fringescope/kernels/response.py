"""The correction of wrapped phases by a table that is periodic in the phase."""

import math

from fringescope.threads import by_rows

TWO_PI = 2.0 * math.pi


@by_rows(lambda phase, *_: phase.shape[0])
def correct(first, last, phase, sigma, steps, table, slope, out_phase, out_sigma):
    """Wrapped phase (H, W) plus the table's entry at it, wrapped again to (-pi, pi]; sigma times the slope there.

    `table` and `slope` (n,) hold one ripple, 2 pi / steps of phase from 0 on, and are read linearly between entries.
    """
    n = table.shape[0]
    for i in range(first, last):
        for j in range(phase.shape[1]):
            p = phase[i, j]
            if not -10.0 < p < 10.0:
                out_phase[i, j] = p
                out_sigma[i, j] = sigma[i, j]
                continue
            x = p * steps / TWO_PI
            x = (x - math.floor(x)) * n
            k = min(int(x), n - 1)
            f = x - k
            nxt = k + 1 if k + 1 < n else 0
            q = p + (1.0 - f) * table[k] + f * table[nxt]
            if q > math.pi:
                q -= TWO_PI
            elif q <= -math.pi:
                q += TWO_PI
            out_phase[i, j] = q
            out_sigma[i, j] = sigma[i, j] * ((1.0 - f) * slope[k] + f * slope[nxt])
