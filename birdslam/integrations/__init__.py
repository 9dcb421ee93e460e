"""Other libraries' detections and tracks, to and from `BirdSLAM.step`; none of these libraries is imported."""
