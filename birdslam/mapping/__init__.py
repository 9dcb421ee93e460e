"""The static map: landmarks of the road, amodal lanes, and the atlas of a whole drive; the CP edges of the pose graph.

Read `landmark_edges` first (road features as landmarks, Eq. 3), then `lane_mapper` (lanes over many frames).
`atlas` keeps what the graph's window has left behind.
"""
