"""The interface of a factor: one kind of edge, and its term of the cost F (Eq. 8).

A factor reads the frame's `Measurements`, or records of its own type that the caller passes to `PoseGraph.optimise`.
To add a factor, derive from `Factor` and append it to `standard_factors(...)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.costs import Triple
from birdslam.graph.edges import PoseEdges
from birdslam.graph.vehicles import Associations, VehicleNodes
from birdslam.graph.window import Window
from birdslam.types import Measurements

_NONE = SE2()


@dataclass(slots=True)
class GraphFrame:
    """The input of all factors for one frame, and the results that they pass to later factors."""

    measurements: Measurements  # with the covariances of Eq. 4
    edges: PoseEdges  # the valid CC, CV and VV edges
    records: Sequence[object]  # the caller's, beside the measurements
    vehicles: VehicleNodes  # by their row in the window
    associations: Associations  # the edges to vehicles of the window
    zero_velocity: bool  # the ego is stationary and keeps its pose
    passed_s: float = 0.0  # since the newest pose of the window
    twist_growth: Triple = (0.0, 0.0, 0.0)  # of the variances of vehicles' twists in a second
    fixed: Sequence[int] = ()  # rows of stationary vehicles, whose position in world is not propagated
    kept: Floats | None = None  # (M, 2) fractions of the vehicles' lasting errors that last; None: all
    motion: SE2 = _NONE  # of the ego since the previous frame
    settled: Sequence[tuple[float, float]] = ()  # landmarks to be added to the map, metres in world


@dataclass(slots=True)
class Linearised:
    """k edges of dimension d, linearised at the window's mean: residual = J dx + noise, dx the error of the state.

    The state is the window's (state_layout.py): ego in world, then all other poses in ego. Errors are in metres and
    radians, in the axes of the frame that the pose refers to; the ego's error is in its own axes.
    """

    residual: Sequence[float] | Floats  # k d numbers: measured minus predicted
    # (k d, E) with respect to the ego poses, or (k d, n) to the whole state; a list of k d indices: row i is that unit
    # vector. For edges to single `vehicles`: (k, d, 8) with respect to each one's state, or a list of d indices
    jacobian: list[int] | Floats
    covs: Floats  # (k, d, d) positive definite: inverses of the edges' information matrices
    # Gate on the squared Mahalanobis distance: beyond it the covariance is multiplied by the square of the excess,
    # beyond four times the gate the edge is an outlier and left out. None: no gate
    gate: float | None = None
    vehicles: list[int] | None = None  # (k,) distinct rows of the window: the vehicle of each edge
    outliers: Sequence[int] = ()  # of the k edges, set after optimization


class Factor:
    """One kind of edge of the graph; every method is optional.

    In each frame `PoseGraph` calls `predict` of all factors in order, if odometry connects the frame to the window;
    then `linearise` of all, and minimizes the sum; then `conclude` of all. A frame without an image calls nothing. An
    instance belongs to one graph. Factors raise no exception for the content of a record: they skip invalid edges.
    """

    name: str  # unique in the graph: "CV"
    equation: str  # of the paper, or a description
    # Its edges measure single vehicles and by default do not correct the ego: see `GraphConfig.vehicles_move_ego`
    of_vehicles: ClassVar[bool] = False
    # It correlates vehicles with each other or with the ego: the window then keeps them in one covariance block
    ties_vehicles: ClassVar[bool] = False
    state_type: ClassVar[type | None] = None  # of `state`, for msgspec; None: stateless

    def begin(self) -> None:
        """Starts a new epoch: clears the state."""

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Contributes to the prediction of the window to this frame. May change the window."""

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """The linearised edges of this frame; None without edges. Does not change the window."""
        return None

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """Updates the state after optimization, when vehicles have been added and removed."""

    def state(self) -> Any:
        """The state of type `state_type`, for a checkpoint; arrays need not be copies."""
        return None

    def resume(self, state: Any) -> None:
        """Restores this state. Raises ValueError if it is inconsistent."""
