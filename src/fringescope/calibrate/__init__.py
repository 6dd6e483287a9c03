"""Board captures to a rig: what each camera sees of the board, one joint adjustment, the evidence (III-B)."""

from fringescope.calibrate.numbering import agree
from fringescope.calibrate.see import see

__all__ = ["agree", "see"]
