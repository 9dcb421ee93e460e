"""Commands on the computer of a vehicle and for a fleet."""
