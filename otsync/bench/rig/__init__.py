"""Benchmarks on synchronised rigs: audit.py, with one camera moved."""
