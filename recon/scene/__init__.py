"""The scene: 3D Gaussians, 4D Gaussians, their files, and seeding them."""

from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

__all__ = ["Gaussians", "Gaussians4D"]
