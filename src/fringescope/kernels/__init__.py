"""Arrays and scalars in, arrays out: the loops over pixels, compiled by Numba. They trust; their callers validate."""
