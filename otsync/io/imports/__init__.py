"""Offsets that others found: of tables, timecodes, flashes and claps, polysync and Pose2Sim, one file each.

slot.py      what an importer is; edges between videos
tables.py    CSV of offsets
events.py    CSV of when each video shows one and the same event
timecode.py  CSV of timecodes, and those that video files carry
polysync.py  polysync's sidecars
pose2sim.py  the log of Pose2Sim's synchronisation
"""

from .events import Events
from .polysync import Polysync
from .pose2sim import Pose2Sim
from .slot import Filmed, Importer, Known, filmed
from .tables import Table
from .timecode import Timecode

IMPORTERS: tuple[Importer, ...] = (Polysync(), Pose2Sim(), Timecode(), Events(), Table())
"""In the order in which they are asked."""

__all__ = ["IMPORTERS", "Filmed", "Importer", "Known", "filmed"]
