"""Persistent maps: their files, and localisation and mapping of a drive, during it or afterwards."""
