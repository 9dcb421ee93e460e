"""`birdslam evaluate`: runs the method on recordings and compares it with ground truth."""
