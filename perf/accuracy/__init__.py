"""How good the method is on roads, drives and networks beyond the evaluations of `birdslam evaluate`."""
