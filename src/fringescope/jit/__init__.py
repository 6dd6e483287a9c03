"""`njit(cache=True)` of Numba, whose kernels are back from the cache in a tenth of the time.

Before Numba looks into its cache it makes ready to compile: it imports all of its library, and SciPy's linear algebra;
then it parses the intermediate code of each kernel that it finds. `linked.py` leaves that out, by what it knows of
Numba's insides; a version of Numba that was not tried goes its own way (docs/decisions/0010-cold-start.md).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba

TRIED = ("0.68.",)  #: how versions of Numba begin whose insides are as `linked.py` takes them


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorate a kernel, as `numba.njit(cache=True, **options)` does."""
    if function is None:
        return functools.partial(njit, **options)
    options.pop("cache", None)
    if not numba.__version__.startswith(TRIED):
        return numba.njit(cache=True, **options)(function)
    from fringescope.jit.linked import linked

    return linked(function, **options)
