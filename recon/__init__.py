"""Motion-spline-scaffold 4D Gaussian Splatting that consumes the offsets of :mod:`otsync` and refines them."""
