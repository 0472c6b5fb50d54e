"""``fit()``: a scene, videos and their clocks, refined together from the images."""

from recon.fit.verb import LOSSES, RATES, Diverged, History, Reconstruction, fit

__all__ = ["LOSSES", "RATES", "Diverged", "History", "Reconstruction", "fit"]
