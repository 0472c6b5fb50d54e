"""From a folder of videos that nobody calibrated to cameras. Needs the extra ``calibrate``.

clips.py      which videos there are, and what is known of their lenses
boards.py     lenses from clips of a checkerboard or a ChArUco board
board_rests.py where a clip shows a board at rest
board_solve.py poses of cameras that see a board at the same places, adjusted together
board_adjust.py where corners are seen, and how that changes with cameras, places and lenses
board_poses.py cameras from a board, and which of them are to be trusted
stills.py     backgrounds of static cameras, masked key frames of moving ones
mapping.py    structure from motion by two mappers that check each other (pycolmap)
poses.py      every frame of a moving camera (poselib)
world.py      an upright world, in metres where a distance is known
verdict.py    which cameras are to be trusted, and what to film where not
found.py      the result
verb.py       calibrate(): all of it
document.py   the result in scene.json
"""

from .found import Calibration, FoundCamera
from .verb import CalibrateOptions, calibrate

__all__ = ["CalibrateOptions", "Calibration", "FoundCamera", "calibrate"]
