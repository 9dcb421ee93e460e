"""BirdSLAM: monocular multibody SLAM in bird's-eye view.

The records that everything exchanges stand in `types`, with their frames and units: read that first. Then
`frontend` (one image to the edges of the pose graph: Fig. 2 of the paper) and `graph.pose_graph` (the back end:
Eqs. 2-8); `slam` runs both in one process. CONTRIBUTING.md has the table of packages and what each may import.
"""
