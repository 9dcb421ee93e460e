"""The command `birdslam`: argument parsing and output. The logic of a command is in the package of its subject."""
