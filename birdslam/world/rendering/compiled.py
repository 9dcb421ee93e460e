"""Compiler settings of numba for functions that run per pixel.

They have many array arguments and allocate nothing, so reference counting is off (`_nrt=False`): it would dominate the
time of shading.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy", "_nrt": False}
per_pixel = njit(**_OPTIONS)
inlined = njit(**_OPTIONS, forceinline=True)
