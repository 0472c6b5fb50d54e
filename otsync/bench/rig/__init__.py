"""Benchmarks on synchronised rigs.

audit.py       one camera moved: which one, and by how much
shifts.py      every video begun at another frame
their_sync.py  the same by Pose2Sim's own synchronisation
"""
