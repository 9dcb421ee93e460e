"""Evaluation of networks on rendered and real frames."""
