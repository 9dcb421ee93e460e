"""Each class of road user by itself: its tracks, and the places and speeds of people."""
