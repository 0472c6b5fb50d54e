"""The scene: 3-D Gaussians, 4-D Gaussians, their files, and where they begin."""

from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

__all__ = ["Gaussians", "Gaussians4D"]
