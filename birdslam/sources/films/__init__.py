"""Films: their frames, and what their containers say beside them."""
