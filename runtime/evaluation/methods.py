"""The methods of `birdslam evaluate tracking`, by name. As light as the parser, which offers them."""

METHODS = (
    *("birdslam", "birdslam_live", "paper", "paper_final", "batch_se3", "nair", "batch_se3_shape", "nair_shape"),
    *("namdev", "cubeslam"),
)
