"""`birdslam models`: networks by name, where they are kept, and how they are had from their authors."""
