"""Features on Gaussians, lifted from feature maps, and feature tracks of one video."""
