"""Board captures to a rig: what each camera sees of the board, one joint adjustment, the evidence (III-B)."""

from fringescope.calibrate.evidence import evidence
from fringescope.calibrate.holdout import fit_board, leave_one_out, sizes_of
from fringescope.calibrate.numbering import agree
from fringescope.calibrate.problem import Sizes
from fringescope.calibrate.see import see
from fringescope.calibrate.solve import check, solve

__all__ = ["Sizes", "agree", "check", "evidence", "fit_board", "leave_one_out", "see", "sizes_of", "solve"]
