"""Maps that are kept: places found again, poses in a map, loops closed."""
