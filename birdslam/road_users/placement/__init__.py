"""Place of a vehicle from one frame: box with Eq. 1, depth, body. Read `localisation` first."""
