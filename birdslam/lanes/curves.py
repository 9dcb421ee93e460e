"""A line as a cubic in the ego's frame, y(x) = a + h x + c x^2 / 2 + d x^3 / 6, and its change with the ego's motion.

To third order it is a clothoid: offset a (m), heading h (tangent), curvature c (1/m), its rate d (1/m^2) (Dickmanns and
Mysliwetz 1992). A curve has shape (..., 4).
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2


def basis(x_m: Floats) -> Floats:
    """(N, 4) coefficients of y at x (N,)."""
    x = np.asarray(x_m, dtype=np.float64)
    out: Floats = np.empty((*x.shape, 4))
    out[..., 0], out[..., 1], out[..., 2] = 1.0, x, x * x / 2.0
    out[..., 3] = out[..., 2] * x / 3.0
    return out


def slope_basis(x_m: Floats) -> Floats:
    """(N, 4) coefficients of dy/dx at x (N,)."""
    x = np.asarray(x_m, dtype=np.float64)
    out: Floats = np.empty((*x.shape, 4))
    out[..., 0], out[..., 1], out[..., 2], out[..., 3] = 0.0, 1.0, x, x * x / 2.0
    return out


def across_sigma_m(at: Floats, cov: Floats) -> Floats:
    """(..., n) 1-sigma of y from `basis` (..., n, 4) and the covariances (n, 4, 4) of n curves."""
    variance = ((at[..., None, :] @ cov)[..., 0, :] * at).sum(axis=-1)
    out: Floats = np.sqrt(np.maximum(variance, 0.0))
    return out


def transform_curves(curves: Floats, T_old_new: SE2) -> tuple[Floats, Floats]:
    """Transforms curves (..., 4) to the ego's new frame; also returns the derivatives (..., 4, 4) of new by old.

    Newton's method finds the intersection of a curve with the new y axis; tangent and curvature rotate with the axes.
    The rate of curvature stays.
    """
    sin, cos = math.sin(T_old_new.yaw_rad), math.cos(T_old_new.yaw_rad)
    a, h, c, d = curves[..., 0], curves[..., 1], curves[..., 2], curves[..., 3]
    x = np.full(a.shape, T_old_new.x_m)
    for _ in range(3):  # (x - x_m) cos + (y - y_m) sin = 0
        y = a + x * (h + x * (c / 2.0 + x * d / 6.0))
        slope = h + x * (c + x * d / 2.0)
        x = x - ((x - T_old_new.x_m) * cos + (y - T_old_new.y_m) * sin) / np.maximum(cos + slope * sin, 0.2)
    y = a + x * (h + x * (c / 2.0 + x * d / 6.0))
    slope = h + x * (c + x * d / 2.0)
    along = np.maximum(cos + slope * sin, 0.2)  # dx in the new frame per dx in the old one
    cubed = along * along * along
    out = np.empty(curves.shape)
    out[..., 0] = -(x - T_old_new.x_m) * sin + (y - T_old_new.y_m) * cos
    out[..., 1] = (slope * cos - sin) / along
    out[..., 2] = (c + d * x) / cubed
    out[..., 3] = d
    J = np.zeros((*curves.shape, 4))
    J[..., 0, :] = basis(x) / along[..., None]
    J[..., 1, :] = slope_basis(x) / along[..., None] ** 2
    J[..., 2, 2], J[..., 2, 3] = 1.0 / cubed, x / cubed
    J[..., 3, 3] = 1.0
    return out, J
