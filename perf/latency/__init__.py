"""Where time goes: the whole system, its processes, and each part beside its peers."""
