"""Samples as a camera delivers them: by their address, so that a kernel reads the frames of a view where they lie,
however many there are; and packed, 12 bits each (GenICam's 12p: the lowest bits first).
"""

from typing import Any

import numpy as np
from numba import carray, errors, types
from numba.extending import intrinsic

from fringescope.jit import njit
from fringescope.threads import by_rows


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


@intrinsic
def unowned(_typing: Any, array: Any) -> Any:
    """The same array without a share in its ownership, and so all slices of it: counting the owners of each slice
    costs, most where threads count in one place. The caller holds the array.
    """

    if not isinstance(array, types.Array):
        raise errors.TypingError(f"{array} is no array")

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        nobody = context.get_constant_null(types.MemInfoPointer(signature.return_type.dtype))
        return builder.insert_value(args[0], nobody, 0)  # the first field of an array tells of its memory

    return array(array), build


@njit(cache=True, nogil=True, error_model="numpy")
def unpack(octets, n, out):
    """n samples (an even number) of 12 bits from 3 n / 2 octets."""
    for p in range(n // 2):
        a, b, c = np.uint16(octets[3 * p]), np.uint16(octets[3 * p + 1]), np.uint16(octets[3 * p + 2])
        out[2 * p] = a | ((b & 15) << 8)
        out[2 * p + 1] = (b >> 4) | (c << 4)


@by_rows(lambda _packed, out: out.shape[0])
def unpack_frame(first, last, packed, out):
    """Packed samples (H, W / 2, 3) uint8 to (H, W) uint16."""
    for i in range(first, last):
        unpack(packed[i].reshape(-1), out.shape[1], out[i])
