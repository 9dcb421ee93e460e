"""`birdslam doctor`: whether this machine can keep what a vehicle needs, and what its settings cost."""
