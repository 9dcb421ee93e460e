"""GNSS fixes: reading, and georeferencing of drives and maps in WGS 84."""
