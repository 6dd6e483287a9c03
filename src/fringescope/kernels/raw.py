"""Samples by their address: a kernel reads the frames of a view where they lie, however many there are."""

from typing import Any

from numba import carray, njit, types
from numba.extending import intrinsic


@intrinsic
def _pointer(_typing: Any, _address: Any) -> Any:
    """An address (int64) as a pointer to nothing in particular."""

    def build(_context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], _context.get_value_type(signature.return_type))

    return types.voidptr(_address), build


@njit(cache=True, inline="always", error_model="numpy")
def samples_at(address, n, like):
    """`n` samples at an address, of the type of the array `like`. The caller holds the memory."""
    return carray(_pointer(address), n, like.dtype)
