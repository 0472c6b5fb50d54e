"""Features of Gaussians, lifted from feature maps, and dense feature tracks of one video."""
