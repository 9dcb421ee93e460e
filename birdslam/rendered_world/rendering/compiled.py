"""How the functions that run for each pixel are compiled by numba.

They take arrays by the dozen and allocate none. So no references are counted in them (`_nrt=False`): at that size numba
no longer sees which counts cancel out, and counting took four fifths of the time of a frame's shading.
"""

from __future__ import annotations

from numba import njit

per_pixel = njit(cache=True, nogil=True, fastmath=True, error_model="numpy", _nrt=False)
inlined = njit(cache=True, nogil=True, fastmath=True, error_model="numpy", _nrt=False, forceinline=True)
