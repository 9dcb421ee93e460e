"""Pages that commands write: `birdslam interface`, `birdslam configuration`."""
