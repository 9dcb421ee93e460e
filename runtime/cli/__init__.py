"""The command `birdslam`: modules here parse and print; what a command does lies with its subject."""
