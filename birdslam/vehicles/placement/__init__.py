"""Where one frame puts a vehicle: its box by Eq. 1, its depth, its body; read `localisation` first."""
