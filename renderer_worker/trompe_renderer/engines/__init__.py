"""Engines turn a snapshot of the world into images."""
