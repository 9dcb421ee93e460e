"""Commands on recorded drives."""
