"""The proof that loose images are in the right order, in figures, and the options that would mend a wrong one.

Four independent signs: the N-step residual (N >= 4: a wrong order of steps is no sinusoid), the density of the fringes
(sets in the wrong order), the sense in which each phase grows (steps reversed in one set; in all, where a Gray code
tells), and coarse-to-fine consistency (a wrong first step; all sets reversed). N = 3 has no residual: any order of
three samples fits a sinusoid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from fringescope.importing.evidence import SetEvidence, gray_slope, look_at_set, residual_of, wrap
from fringescope.importing.loose import LooseFrames, Recipe
from fringescope.types import Bool, FringeSet, plane_size

CLEARLY = 0.5  #: another order is clearly better if its misfit is less than this share of the one given
NEGLIGIBLE = 0.03  #: a residual below this share of the modulation needs no other order
LARGE = 0.25  #: a residual above this share is no sinusoid at all
AGREE = 0.2  #: cycles (1.48 median) within which a coarse and a fine phase agree (0.37: nothing to do with each other)


@dataclass(frozen=True)
class PairEvidence:
    """How well a fine phase follows from a coarse one: 1.48 times the median disagreement, in cycles."""

    coarse: int
    fine: int
    misfit_cycles: float


@dataclass(eq=False)
class Evidence:
    """All signs. `verdict`: "right", "doubtful" (something speaks against it) or "open" (nothing here can tell)."""

    sets: tuple[SetEvidence, ...]
    pairs: list[PairEvidence] = field(default_factory=list)
    proved: list[str] = field(default_factory=list)  #: what speaks for the order given
    against: list[str] = field(default_factory=list)  #: what speaks against it
    notes: list[str] = field(default_factory=list)  #: what cannot be told from the images
    options: list[str] = field(default_factory=list)  #: of `fringescope import`, that would mend it

    @property
    def verdict(self) -> str:
        """In a word."""
        return "doubtful" if self.against else "right" if self.proved else "open"

    def figures(self) -> dict[str, object]:
        """As plain numbers and words, for JSON."""
        return {
            "order": self.verdict,
            "proved": self.proved,
            "against": self.against,
            "notes": self.notes,
            "use": self.options,
            "sets": [
                {
                    "set": s.index,
                    "steps": s.set.steps,
                    "period": s.set.period,
                    "residual": s.residual,
                    "best_order": list(s.best_order),
                    "best_residual": s.best_residual,
                    "slope_rad_per_px": list(s.slope),
                }
                for s in self.sets
            ],
            "pairs": [{"coarse": p.coarse, "fine": p.fine, "misfit_cycles": p.misfit_cycles} for p in self.pairs],
        }


def look(images: LooseFrames, recipe: Recipe) -> Evidence:
    """Weighs the order that `recipe` gives to `images`. Raises CaptureError while images are read."""
    ev = Evidence(tuple(look_at_set(images, recipe, i) for i in range(len(recipe.sets))))
    for s in ev.sets:
        if not s.lit.any():
            name = f"set {s.index} (period {s.set.period:g})"
            ev.against.append(f"{name} has no modulated pixel: dark, saturated or no fringes")
    if not ev.against:
        _steps(ev, images, recipe)
    if ev.against:
        return ev  # phases mean nothing yet
    code = gray_slope(images, recipe)
    for family in families(recipe.sets):
        _density(ev, family)
        if not ev.against:
            along = recipe.gray is not None and _is_along(recipe.sets[family[0]], recipe.gray.axis)
            _sense(ev, family, recipe, code if along else None)
        if not ev.against:
            _chain(ev, family, recipe, code is not None)
    ev.proved[:] = dict.fromkeys(ev.proved)
    if ev.verdict == "open":
        ev.notes.append("three steps of one period fit in any order: compare the preview with what was projected")
    return ev


def families(sets: Sequence[FringeSet]) -> list[list[int]]:
    """Indices of the sets of each direction, coarse to fine."""
    out: list[list[int]] = []
    for i, s in enumerate(sets):
        for f in out:
            (ax, ay), (bx, by) = s.cycles_per_pixel, sets[f[0]].cycles_per_pixel
            if abs(ax * by - ay * bx) <= 1e-4 * s.frequency * sets[f[0]].frequency:
                f.append(i)
                break
        else:
            out.append([i])
    return [sorted(f, key=lambda i: -sets[i].period) for f in out]


def _steps(ev: Evidence, images: LooseFrames, recipe: Recipe) -> None:
    told = [s for s in ev.sets if not math.isnan(s.residual)]
    if not told:
        return
    worst = max(told, key=lambda s: s.residual)
    miss = f"the {worst.set.steps} images of set {worst.index} (period {worst.set.period:g}) miss a sinusoid by "
    miss += f"{100 * worst.residual:.0f} % of their swing"
    if worst.residual > NEGLIGIBLE and worst.best_residual < CLEARLY * worst.residual and worst.best_residual < LARGE:
        given = list(recipe.step_order) or list(range(worst.set.steps))
        order = ",".join(str(given[k]) for k in worst.best_order)
        ev.against.append(f"{miss}, in the order {order} by {100 * worst.best_residual:.0f} %")
        ev.options.append(f"--step-order {order}")
        return
    if worst.residual < LARGE:
        ev.proved.append(f"each set is a sinusoid within {100 * worst.residual:.1f} % of its swing")
        return
    if len({s.steps for s in recipe.sets}) == 1 and len(recipe.sets) > 1:
        other = replace(recipe, interleaved=not recipe.interleaved, step_order=())
        if residual_of(images, other, worst.index) < CLEARLY * worst.residual:
            name = "interleaved" if other.interleaved else "sets"
            ev.against.append(f"{miss}, as --order {name} much less")
            ev.options.append(f"--order {name}")
            return
    ev.against.append(
        f"{miss}, and in no order less: not {worst.set.steps} equal steps of one set; "
        "look at the preview, and mend --steps or the choice of files"
    )


def _density(ev: Evidence, family: list[int]) -> None:
    if len(family) < 2:
        return
    by_density = sorted(family, key=lambda i: ev.sets[i].density)
    if by_density == family:
        ratios = [ev.sets[f].density / max(ev.sets[c].density, 1e-12) for c, f in pairwise(family)]
        needed = [ev.sets[c].set.period / ev.sets[f].set.period for c, f in pairwise(family)]
        told = ", ".join(f"{r:.1f} times (needed {n:.1f})" for r, n in zip(ratios, needed, strict=True))
        ev.proved.append(f"from coarse to fine the fringes are denser {told}")
        return
    for a, b in zip(by_density, family, strict=True):
        da, db = ev.sets[a].density, ev.sets[b].density
        if a != b and abs(da - db) < 0.2 * max(da, db):
            ev.notes.append(f"sets {a} and {b} have about the same density of fringes")
            return
    period = {i: ev.sets[family[k]].set.period for k, i in enumerate(by_density)}
    listed = ",".join(f"{period[i]:g}" for i in sorted(family))
    ev.against.append(f"the fringes are denser or sparser than --periods says; the sets come in the order {listed}")
    ev.options.append(f"--periods {listed}")


def _sense(ev: Evidence, family: list[int], recipe: Recipe, code: tuple[float, float] | None) -> None:
    """All sets of a direction must grow the same way in the picture, and as the Gray code does."""
    finest = ev.sets[family[-1]]
    for i in family[:-1]:
        if _dot(ev.sets[i].slope, finest.slope) * _sign(ev.sets[i].set, finest.set) < 0:
            ev.against.append(f"the phases of sets {i} and {finest.index} grow against each other: one runs backwards")
            ev.options.append(f"--reverse-sets {i}")
    if code is not None and not ev.against:
        along_axis = 1.0 if sum(finest.set.cycles_per_pixel) > 0 else -1.0
        if _dot(code, finest.slope) * along_axis < 0:
            ev.against.append("the phase grows against the Gray code: the steps run backwards")
            ev.options.append("without --reverse-steps" if recipe.reverse else "--reverse-steps")
        else:
            ev.proved.append("the phase grows as the Gray code does")


def _chain(ev: Evidence, family: list[int], recipe: Recipe, sense_known: bool) -> None:
    """Fine phases must follow from coarse ones; a wrong first step or a reversal of all sets shows as a constant."""
    if len(family) < 2:
        return
    sets = [ev.sets[i] for i in family]
    lit = np.logical_and.reduce([s.lit for s in sets])
    if lit.sum() < 100:
        ev.notes.append("coarse and fine sets share too few lit pixels to compare them")
        return
    common = math.gcd(*(s.set.steps for s in sets))
    fits: dict[tuple[bool, int], float] = {}
    for reverse in (False,) if sense_known else (False, True):
        for m in range(common):
            fits[reverse, m] = max(_misfits(sets, lit, recipe, reverse, 2 * math.pi * m / common), default=math.nan)
    given = fits[False, 0]
    if math.isnan(given):
        ev.notes.append("the coarsest period wraps in the field and no other is a multiple of it: not compared")
        return
    misfits = _misfits(sets, lit, recipe, False, 0.0)
    ev.pairs += [PairEvidence(c.index, f.index, x) for (c, f), x in zip(pairwise(sets), misfits, strict=False)]
    best = min(fits.values())

    def option(h: tuple[bool, int]) -> str:
        first = ((-1 if h[0] else 1) * recipe.first_phase_deg + 360 * h[1] / common) % 360
        shift = f"--first-phase {first:g}" if first or recipe.first_phase_deg else ""
        turned = ("without --reverse-steps" if recipe.reverse else "--reverse-steps") if h[0] else ""
        return " ".join(filter(None, (turned, shift)))

    if best < CLEARLY * given and best < AGREE and given > AGREE / 2:
        ways = " or ".join(option(h) for h, x in fits.items() if x < 1.3 * best + 0.01)
        ev.against.append(
            f"fine phases miss what the coarse ones foretell by {given:.2f} cycles; they agree within "
            f"{best:.2f} with {ways}"
        )
        ev.options.append(ways)
        return
    if given > AGREE:
        ev.notes.append(f"fine phases follow from coarse ones within {given:.2f} cycles only, in no other order better")
        return
    ev.proved.append(f"fine phases follow from coarse ones within {given:.2f} cycles")
    same = [option(h) for h, x in fits.items() if h != (False, 0) and x < 1.3 * given + 0.01]
    if same:
        x, y = ev.sets[family[-1]].slope
        way = ("right" if x > 0 else "left") if abs(x) > abs(y) else ("down" if y > 0 else "up")
        ev.notes.append(
            f"the images fit {' or '.join(same)} as well; as given, the projector's coordinate grows "
            f"{way} in the picture: see that it did"
        )


def _misfits(sets: list[SetEvidence], lit: Bool, recipe: Recipe, reverse: bool, turn: float) -> list[float]:
    """Disagreement of each set with the one before, in cycles, were the true phases `turn` +- the measured ones.

    Where the coarsest period spans the field, its phase is absolute and predicts each finer one in turn. Where it
    wraps, only whole-number relations q fine = p coarse hold for every order; pairs without one are left out.
    """
    sign = -1.0 if reverse else 1.0
    phases = [sign * s.phase[lit] + turn for s in sets]
    out: list[float] = []
    absolute = None
    if _span(sets[0].set, recipe) < 1.02:
        low = _lowest(sets[0].set, recipe)
        absolute = low + np.mod(phases[0] - low, 2 * np.pi)
    for (c, f), (coarse, fine) in zip(pairwise(sets), pairwise(phases), strict=True):
        ratio = math.copysign(f.set.frequency / c.set.frequency, _sign(c.set, f.set))
        if absolute is not None:
            r = wrap(fine - ratio * absolute)
            absolute = ratio * absolute + r
        else:
            q = next((q for q in range(1, 7) if abs(q * ratio - round(q * ratio)) < 0.02), 0)
            if not q:
                continue
            r = wrap(q * fine - round(q * ratio) * coarse)
        out.append(1.4826 * float(np.median(np.abs(r))) / (2 * np.pi))
    return out


def _corners(s: FringeSet, recipe: Recipe) -> list[float]:
    w, h = plane_size(*recipe.projector, recipe.layout)
    gx, gy = s.cycles_per_pixel
    return [gx * u + gy * v for u in (-0.5, w - 0.5) for v in (-0.5, h - 0.5)]


def _span(s: FringeSet, recipe: Recipe) -> float:
    """Cycles of a set in the projector's field."""
    x = _corners(s, recipe)
    return max(x) - min(x)


def _lowest(s: FringeSet, recipe: Recipe) -> float:
    """Least phase in the field, radians, less half of what the period leaves free."""
    return 2 * math.pi * (min(_corners(s, recipe)) - max(0.0, 1 - _span(s, recipe)) / 2)


def _dot(a: tuple[float, float], b: tuple[float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1]


def _sign(a: FringeSet, b: FringeSet) -> float:
    return math.copysign(1.0, _dot(a.cycles_per_pixel, b.cycles_per_pixel))


def _is_along(s: FringeSet, axis: str) -> bool:
    gx, gy = s.cycles_per_pixel
    return abs(gy if axis == "u" else gx) < 0.1 * s.frequency
