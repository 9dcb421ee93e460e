"""A place on Earth: fixes read, and drives and maps tied to WGS 84 by them."""
