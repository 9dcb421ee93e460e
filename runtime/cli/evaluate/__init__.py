"""Commands that compare estimates with ground truth: `birdslam evaluate WHAT`."""
