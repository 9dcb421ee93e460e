"""`birdslam evaluate`: the jobs that run the method over recordings and hold it to their truth."""
