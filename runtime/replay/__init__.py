"""Replays recorded measurements through the back end and compares the estimates (`replay`, `verdict`, `report`)."""
