"""How figures are kept, compared, drawn and written to pages; `all` runs everything in turn."""
