"""From a capture or a staircase to a response, and whether phases need its correction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import EmptyResultError, UsageError
from fringescope.response import model
from fringescope.response.estimate import Fit, disagreement, fit
from fringescope.response.observe import Observed, Pixels, observe, read_bins
from fringescope.settings import ResponseSettings
from fringescope.types import F64, AnyArray, Decoded, FrameKey, FringeSet, Response, ViewPlan

STEPS = (3, 4, 5, 8)  #: what errors are predicted for
LEVELS = (0.0, 1.0)
BINS = 48  #: of the phase, in curves
BLOWN = 0.5  #: share of saturated pixels beyond which the rest proves nothing
FLAT = 0.3  #: slope of the bright end over that of the middle, relative to the power law's, below which it saturates


def from_sets(
    decoded: Decoded, s: ResponseSettings, levels: tuple[float, float] = LEVELS, *, source: str = "sets"
) -> Response:
    """The response from a view's own phases: sets of one direction must agree; a lone set is taken to be of something
    smooth.

    `decoded` with settled orders (without them only sets of one frequency are compared). `levels`: darkest and
    brightest level drawn, shares of full scale. Raises EmptyResultError where too few pixels have usable fringes.
    """
    return _conclude(observe(decoded, s), s, levels, source)


def from_fringes(
    decoded: Decoded,
    frames: Iterable[tuple[FrameKey, AnyArray]],
    plan: ViewPlan,
    s: ResponseSettings,
    levels: tuple[float, float] = LEVELS,
) -> Response:
    """As `from_sets`, and from what the samples of sets of more than three steps leave beside the fringe.

    `frames` once more, as `measure` had them; they are thinned as they come. Raises as `from_sets`.
    """
    bins = read_bins(frames, plan, s.max_pixels)
    usable = bins if bins and len(decoded.sets) == len(_fringe_sets(plan)) else None
    return _conclude(observe(decoded, s, bins=usable), s, levels, "fringes" if usable else "sets")


def from_exponents(
    decoded: Decoded, exponents: Sequence[float], s: ResponseSettings, levels: tuple[float, float] = LEVELS
) -> Response:
    """The response from sets of one frequency whose fringes were drawn to known powers.

    They are `((1 + cos) / 2) ** exponent` and shown on something white and smooth.

    One exponent per set of `decoded`. Raises UsageError for another number of exponents, or if they do not differ
    within any direction; EmptyResultError as `from_sets`.
    """
    if len(exponents) != len(decoded.sets) or any(not 0.05 <= e <= 20 for e in exponents):
        raise UsageError(f"exponents {list(exponents)}; needed one of 0.05 to 20 for each of {len(decoded.sets)} sets")
    if len(set(exponents)) < 2:
        raise UsageError(f"exponents {list(exponents)} are all the same; needed two drawings that differ")
    return _conclude(observe(decoded, s, exponents, smooth=True), s, levels, "exponents")


def _fringe_sets(plan: ViewPlan) -> list[FringeSet]:
    return [x for x in plan.sets if isinstance(x, FringeSet)]


# ------------------------------------------------------------------------------------------------------------- verdict


def _conclude(pixels: Pixels, s: ResponseSettings, levels: tuple[float, float], source: str) -> Response:
    if not pixels.pairs and not pixels.triples and not any(len(o.bins) for o in pixels.sets):
        raise EmptyResultError(
            "one set of three steps tells nothing of the response here: show it on a smooth surface, add a second "
            "period, or take five steps or more"
        )
    found = fit(pixels, levels, s)
    errors = {n: _error(found, n, 0.0) for n in STEPS}
    sets = {o.steps: _error(found, o.steps, o.frequency) for o in sorted(pixels.sets, key=lambda o: o.frequency)}
    response = Response(
        source,
        found.gamma,
        found.gamma_sigma,
        tuple(float(x) for x in found.h),
        tuple(math.sqrt(max(float(x), 0.0)) for x in np.diag(found.h_cov)),
        found.blur,
        levels,
        {n: e for n, (e, _) in errors.items()},
        {n: e for n, (_, e) in errors.items()},
        len(pixels) or int(sum(t.block.size for t in pixels.triples)),
        pixels.saturated,
    )
    verdict = _judge(found, pixels, s)
    figures: dict[str, Any] = {
        "verdict": verdict,
        "explained": found.explained,
        "sets": {str(n): {"error_rad": e, "sigma_rad": d} for n, (e, d) in sets.items()},
        "pairs": list(_pairs_figures(pixels, replace(response, needed=True))),
        "smooth_surface_assumed": bool(pixels.triples),
    }
    response = replace(response, needed=verdict == "needed", figures=figures)
    return replace(response, words=tuple(words(response, sets, s)))


def _measures(o: Observed, sets: Sequence[Observed]) -> bool:
    """Whether a set is the finest of its direction."""
    return not any(
        x.frequency > 1.0001 * o.frequency
        and abs(x.g[0] * o.g[1] - x.g[1] * o.g[0]) < 1e-4 * x.frequency * o.frequency
        for x in sets
    )


def _error(found: Fit, steps: int, frequency: float) -> tuple[float, float]:
    """Greatest phase error of N steps at a frequency, and its standard deviation, rad."""

    def greatest(h: F64) -> float:
        return model.greatest_error(model.attenuated(h, found.blur, frequency), steps)

    size = len(found.h)
    grad = np.array([(greatest(found.h + 1e-4 * e) - greatest(found.h - 1e-4 * e)) / 2e-4 for e in np.eye(size)])
    return greatest(found.h), math.sqrt(max(float(grad @ found.h_cov @ grad), 0.0))


def _judge(found: Fit, pixels: Pixels, s: ResponseSettings) -> str:
    """ "needed" where a set's error is too large and proved, "unproved" where it is not proved, else "fine"."""
    verdict = "fine"
    for o in pixels.sets:
        error, sigma = _error(found, o.steps, o.frequency)
        if error <= (s.negligible_rad if _measures(o, pixels.sets) else s.harmful_rad):
            continue
        proved = error > s.significance * sigma and found.explained > s.min_explained and pixels.saturated <= BLOWN
        verdict = "needed" if proved else "unproved" if verdict == "fine" else verdict
    return verdict


def _pairs_figures(pixels: Pixels, response: Response) -> Iterable[Mapping[str, Any]]:
    """By how much sets that must agree disagree, before and after: median in plane units, mean over the phase in rad.
    """
    sharp = np.asarray(response.harmonics)
    for p in pixels.pairs:
        o, f = pixels.sets[p.other], pixels.sets[p.fine]
        h = [model.attenuated(model.redrawn(sharp, x.exponent), response.blur, x.frequency) for x in (o, f)]
        before = disagreement(p, pixels.sets, None, None)
        after = disagreement(p, pixels.sets, *h)
        bins = np.minimum(((o.phase + math.pi) / (2 * math.pi) * BINS).astype(np.int64), BINS - 1)
        unit = 1 / (2 * math.pi * o.frequency)
        yield {
            "periods": [1 / o.frequency, 1 / f.frequency],
            "steps": [o.steps, f.steps],
            "median_before": float(np.median(np.abs(before))) * unit,
            "median_after": float(np.median(np.abs(after))) * unit,
            "phase": ((np.arange(BINS) + 0.5) * 2 * math.pi / BINS - math.pi).tolist(),
            "before": _binned(bins, before),
            "after": _binned(bins, after),
        }


def _binned(bins: NDArray[np.int64], value: F64) -> list[float | None]:
    """Median per bin; None where a bin is empty."""
    return [float(np.median(value[bins == b])) if (bins == b).any() else None for b in range(BINS)]


def words(r: Response, sets: Mapping[int, tuple[float, float]], s: ResponseSettings) -> Iterable[str]:
    """The verdict in plain words; `sets`: phase error and its sigma by number of steps, the finest last."""
    yield (
        f"gamma {r.gamma:.3f} +- {r.gamma_sigma:.3f}; the second harmonic is {100 * r.harmonics[0]:.2f} +- "
        f"{100 * r.sigmas[0]:.2f} % of the fringe"
    )
    told = ", ".join(f"{e:.4f} +- {d:.4f} rad at N = {n}" for n, (e, d) in sets.items())
    fair = [n for n, e in r.error_rad.items() if e < s.negligible_rad]
    if r.needed:
        yield f"needs correction: {told}; give this file to reconstruct and decode (--response)"
        more = f", or take {min(fair)} steps ({r.error_rad[min(fair)]:.4f} rad)" if fair else ""
        yield f"or do without: draw the patterns through the table 'predistortion'{more}"
    elif r.saturated > BLOWN:
        yield f"nothing is proved: most of what is lit saturates; the rest says {told}"
    elif r.figures.get("verdict") == "unproved":
        yield f"nothing is proved: {told}; more light, or a larger and plainer surface, would tell"
    else:
        yield f"needs no correction: {told}"
    if r.saturated > s.max_saturated:
        yield f"{100 * r.saturated:.0f} % of what is lit saturates: halve the exposure"
    if flat_end(r) < FLAT and r.needed:
        yield "the bright end is flat: projector or camera saturates: halve the exposure, or draw less bright"


def as_drawn(r: Response, exponent: float, s: ResponseSettings) -> Response:
    """The response as fringes show it that are drawn to a power (`drawn_to_power`), with the verdict and the words of
    these fringes; what was not proved of the response is not proved of them.
    """
    out = model.drawn_to_power(r, exponent)
    steps = [int(n) for n in r.figures.get("sets", {}) if int(n) in out.error_rad] or [min(out.error_rad)]
    sets = {n: (out.error_rad[n], out.error_sigma[n]) for n in steps}
    great = any(e > max(s.negligible_rad, s.significance * d) for e, d in sets.values())
    unproved = r.figures.get("verdict") == "unproved" or r.saturated > BLOWN
    verdict = "unproved" if unproved else "needed" if great else "fine"
    told = {str(n): {"error_rad": e, "sigma_rad": d} for n, (e, d) in sets.items()}
    out = replace(out, needed=verdict == "needed", figures={**r.figures, "verdict": verdict, "sets": told})
    first, *rest = words(out, sets, s)
    return replace(out, words=(f"as fringes drawn to the power {exponent:.4g} show it: {first}", *rest))


def flat_end(r: Response) -> float:
    """Slope of the curve at 95 % of the drawn range over that at half of it, relative to the power law's."""
    x = np.array([0.45, 0.55, 0.9, 1.0])
    low, high = r.levels
    seen, law = model.series(np.asarray(r.harmonics), x), (low + (high - low) * x) ** r.gamma
    ratio = [(y[3] - y[2]) / max(y[1] - y[0], 1e-9) for y in (seen, law)]
    return float(ratio[0] / max(ratio[1], 1e-9))
