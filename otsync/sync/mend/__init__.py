"""Breaks of clocks: where they are, how far the clock jumps, and whether it holds when it is mended."""
