"""How the functions that run for each pixel are compiled by numba.

They take arrays by the dozen and allocate none. So no references are counted in them (`_nrt=False`): at that size numba
no longer sees which counts cancel out, and counting took four fifths of the time of a frame's shading.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy", "_nrt": False}
per_pixel = njit(**_OPTIONS)
inlined = njit(**_OPTIONS, forceinline=True)
