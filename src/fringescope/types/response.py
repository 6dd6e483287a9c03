"""What projector and camera together make of a level that is asked for: the response, as harmonics of a fringe."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fringescope.errors import FormatError


@dataclass(frozen=True)
class Response:
    """The light seen for a level asked, but for each pixel's gain and offset: the harmonics that it gives a fringe.

    Where `x = (1 + cos theta) / 2` is asked (0..1 spans the drawn `levels`), what is seen is proportional to
    `cos theta + h_2 cos 2 theta + h_3 cos 3 theta + ..`; so the h are the Chebyshev coefficients of the response curve.
    Sharp fringes of frequency f keep them; the projector's blur (`blur`, standard deviation in projector-plane units)
    weakens h_k by `exp(-2 pi^2 blur^2 f^2 (k^2 - 1))`.
    """

    source: str  #: "staircase", "fringes", "sets", "exponents"
    gamma: float  #: exponent of the power law that comes closest
    gamma_sigma: float
    harmonics: tuple[float, ...]  #: h_2, h_3 ..
    sigmas: tuple[float, ...]  #: their standard deviations
    blur: float = 0.0
    levels: tuple[float, float] = (0.0, 1.0)  #: darkest and brightest level drawn, as shares of the device's full scale
    error_rad: Mapping[int, float] = field(default_factory=dict)  #: greatest phase error of N-step fringes, by N
    error_sigma: Mapping[int, float] = field(default_factory=dict)
    pixels: int = 0
    saturated: float = 0.0  #: share of the lit pixels that saturate in at least one frame
    needed: bool = False  #: whether phases should be corrected
    words: tuple[str, ...] = ()  #: the verdict, for people
    figures: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.harmonics) != len(self.sigmas) or not self.harmonics:
            raise FormatError(
                f"a response of {len(self.harmonics)} harmonics and {len(self.sigmas)} sigmas; needed one sigma each"
            )
        numbers = (self.gamma, self.blur, *self.harmonics, *self.levels)
        if not all(math.isfinite(x) for x in numbers) or self.gamma <= 0 or self.blur < 0:
            raise FormatError(f"a response with gamma {self.gamma}, blur {self.blur}; needed finite, positive numbers")
        if not 0 <= self.levels[0] < self.levels[1] <= 1:
            raise FormatError(f"response levels {self.levels}; needed two shares of full scale, the lower first")
