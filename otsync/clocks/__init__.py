"""Continuous time: two videos on one clock, splines through tracks, rolling shutters undone."""
