"""Lanes against truth: single images with masks of the ego's lane, and masks of paint."""
