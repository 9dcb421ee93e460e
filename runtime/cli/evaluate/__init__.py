"""Commands that compare with ground truth: `birdslam evaluate WHAT`."""
