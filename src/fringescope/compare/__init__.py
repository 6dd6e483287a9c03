"""Two scans of one specimen: what was removed, where, how surely, and how far a cut ran from its guideline."""

from fringescope.compare.change import Change, Region, Side, compare, depth_at, figures
from fringescope.compare.guideline import FromGuideline, from_guideline

__all__ = ["Change", "FromGuideline", "Region", "Side", "compare", "depth_at", "figures", "from_guideline"]
