"""The static map: landmarks on the road, amodal lanes, and the atlas of a whole drive; the CP edges of the pose graph.

Read `landmark_edges` first (feature tracks as landmarks, Eq. 3), then `lane_mapper` (lanes over many frames). `atlas`
stores what has left the graph's window.
"""
