"""How a camera sees the scene: effects on the light, and views with their backgrounds.

To add an effect: one class in one file, and its name in :data:`EFFECTS`; or ``@register("effects")`` in a file of your
own.
"""

from recon.observe.effects import Effect, Gain, MotionBlur, RollingShutter
from recon.observe.vignetting import Vignetting

EFFECTS: tuple[type[Effect], ...] = (MotionBlur, RollingShutter, Gain, Vignetting)
"""Our own effects, the one nearest to the scene first."""

__all__ = ["EFFECTS", "Effect", "Gain", "MotionBlur", "RollingShutter", "Vignetting"]
