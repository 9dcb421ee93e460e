"""Accuracy on further roads, drives and networks, beyond `birdslam evaluate`."""
