"""Benchmarks of the reconstruction: fits, the renderer, feature lifting, and the tables of the paper."""
