"""Synchronise videos of one moving scene by optimal transport between 4D tracks."""
