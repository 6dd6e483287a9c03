"""Is the specimen still where it was scanned? By one picture of each camera, or by three fringe images of each."""

from fringescope.watch.phases import Remeasured, compare_fringes
from fringescope.watch.pictures import View, compare

__all__ = ["Remeasured", "View", "compare", "compare_fringes"]
