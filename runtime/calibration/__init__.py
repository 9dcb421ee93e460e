"""`birdslam calibrate`: a camera file from a drive. Read `drive` first."""
