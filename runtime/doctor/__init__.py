"""`birdslam doctor`: checks whether this machine meets the needs of a vehicle, and measures its settings."""
