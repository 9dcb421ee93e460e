"""Networks by name: installed ones, the catalogue, download and installation."""
