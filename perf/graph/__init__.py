"""What the edges of the graph are worth, on images and on simulated drives."""
