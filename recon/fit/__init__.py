"""``fit()``: a scene, videos and their clocks, refined together from the images."""

from recon.fit.optimize import RATES
from recon.fit.options import DEFAULT_LOSSES, FitOptions
from recon.fit.verb import Diverged, History, Reconstruction, fit

__all__ = ["DEFAULT_LOSSES", "RATES", "Diverged", "FitOptions", "History", "Reconstruction", "fit"]
