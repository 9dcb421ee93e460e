"""CP edges of vehicles: where a frame's landmarks say that the vehicles stand which it sees (Eqs. 3 and 7).

Eq. 7 has a unary edge between "an agent A (ego-camera or vehicle in scene)" and each point. A camera sees the point and
the vehicle, so that the edge's measurement is the difference of the two sights: what the CV edge told of the vehicle is
told once more, by CP's weight, and from landmarks instead of the ego. It is one on the vehicle's place in the world,
which the window has as the ego's pose and the vehicle's place in ego: both are corrected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from birdslam.graph.factors import Complexes
from birdslam.graph.state_layout import EGO
from birdslam.graph.window import Window


def correct(window: Window, rows: Sequence[int], residuals: Complexes, variance_m2: float, hold: bool) -> None:
    """Adds edges that each say how much further on, in ego, a vehicle of `rows` (k,) stands: `residuals` (k,), metres.

    `variance_m2` is each edge's, in either axis; `hold` keeps the ego where it is.
    """
    k, states = len(rows), window.layout.poses[rows]
    at = np.array([window.at[window.nodes + row] for row in rows])
    H = np.zeros((2 * k, len(window.P)))  # how the place in the world goes with the state
    H[0::2, EGO.start] = H[1::2, EGO.start + 1] = 1.0
    H[0::2, EGO.start + 2], H[1::2, EGO.start + 2] = -at.imag, at.real
    H[2 * np.arange(k), states[:, 0]] = H[2 * np.arange(k) + 1, states[:, 1]] = 1.0
    PHt = window.P @ H.T
    K = np.linalg.solve(H @ PHt + variance_m2 * np.eye(2 * k), PHt.T).T
    residual = np.column_stack([residuals.real, residuals.imag]).ravel()
    dx, held = K @ residual, window.ego_cov.copy()
    window.P -= K @ PHt.T
    window.P = 0.5 * (window.P + window.P.T)
    if hold:
        dx[EGO] = 0.0
        window.P[EGO, EGO] = held
    window.shift(dx.tolist())
