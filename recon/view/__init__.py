"""The live viewer: a scene or a recording in a browser on this machine, with the clocks of its videos as sliders.

window.py     a server on loopback only, its sliders, and the end
shown.py      what there is to look at: a slot with a scene, and tracks with their matches
drawing.py    what is drawn of it

viser is imported when a window opens; it comes with the extra ``view``.
"""

from recon.view.shown import OfScene, OfTracks, Shown
from recon.view.window import Window

__all__ = ["OfScene", "OfTracks", "Shown", "Window"]
