"""What a factor of the graph is: one kind of edge, and its term of the cost F (Eq. 8).

A factor reads the frame's `Measurements`, or records of its own that the caller hands to `PoseGraph.optimise` beside
them, of which it takes those of its type. So one from elsewhere needs nothing here: a class that derives from `Factor`,
handed to `PoseGraph` at the end of `standard_factors(...)`.
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
    """One frame as its factors are given it, and what they leave there for the factors after them."""

    measurements: Measurements  # with covariances as Eq. 4 weighs them
    edges: PoseEdges  # the CC, CV and VV edges that can be measurements
    records: Sequence[object]  # the caller's own, beside the measurements
    vehicles: VehicleNodes  # whose row is a vehicle's in the window
    associations: Associations  # the edges to vehicles of the window
    zero_velocity: bool  # the ego stands, and keeps its pose
    twist_growth: Triple = (0.0, 0.0, 0.0)  # of the variances of vehicles' twists in a second
    motion: SE2 = _NONE  # of the ego since the frame before
    settled: Sequence[tuple[float, float]] = ()  # landmarks that go on the map, metres in world


@dataclass(slots=True)
class Linearised:
    """k edges of d numbers each, linearised at the window's mean: residual = J dx + noise, dx the error of the state.

    The state is the window's (state_layout.py): ego in world, then all other poses in ego, each error in metres and
    radians in the axes that the pose is in. The ego's own is in its own axes.
    """

    residual: Sequence[float] | Floats  # k d numbers: measured minus predicted
    # (k d, E) by the ego's poses, or (k d, n) by all of the state; as a list of k d numbers: row i is the unit vector
    # of the i-th of them. Of edges to single `vehicles` (k, d, 6) by each one's own numbers; as a list of d: the same
    jacobian: list[int] | Floats
    covs: Floats  # (k, d, d) positive definite: inverses of the edges' information matrices
    # On the squared Mahalanobis distance of an edge: past it the covariance is multiplied by the square of the excess,
    # past four times it the edge is an outlier and left out. None: there are no outliers
    gate: float | None = None
    vehicles: list[int] | None = None  # (k,) rows of the window, each once: whom each edge is to
    outliers: Sequence[int] = ()  # of the k edges, once the minimum is found


class Factor:
    """One kind of edge of the graph. What it does not override, it has no part in.

    In each frame `PoseGraph` calls `predict` of all its factors in their order, if an odometry ties the frame to the
    window; then `linearise` of all, and finds the minimum of the sum; then `conclude` of all. A frame without a picture
    calls nothing. An instance belongs to one graph. Raises nothing for what a record may say: an edge that can't be a
    measurement is left out.
    """

    name: str  # unique in the graph: "CV"
    equation: str  # of the paper, or what it is
    # Its edges say where single vehicles are, and by default leave the ego: see `GraphConfig.vehicles_move_ego`
    of_vehicles: ClassVar[bool] = False
    # It ties vehicles to each other, or the ego to where they are: the window then holds them in one block
    ties_vehicles: ClassVar[bool] = False
    state_type: ClassVar[type | None] = None  # of `state`, for msgspec; None: it keeps nothing from frame to frame

    def begin(self) -> None:
        """A new epoch begins: nothing is kept of the one before."""

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Its part in moving the window on to the frame. May change the window."""

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Its edges in this frame; None where there are none. Changes nothing in the window."""
        return None

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """After the minimum is found, and vehicles have come and gone: what it keeps for the next frame."""

    def state(self) -> Any:
        """All that it keeps from frame to frame, of `state_type`, for a checkpoint; arrays may be its own."""
        return None

    def resume(self, state: Any) -> None:
        """Goes on from this state. Raises ValueError where its parts do not belong together."""
