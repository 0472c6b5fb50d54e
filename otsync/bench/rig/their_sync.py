"""Pose2Sim's own synchronisation on keypoints whose first frames are left out, run by its own code.

Its ``synchronize_cams_all`` correlates the vertical speeds of one person's keypoints, and writes whole frames to its
log, which :mod:`otsync.io.imports.pose2sim` reads. It runs in a process of its own: importing it changes how numpy
prints and what matplotlib draws on. ``python -m otsync.bench.rig.their_sync PROJECT ...`` is that process.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...files.arrays import read_json, write_json
from ...io.imports.pose2sim import Pose2Sim
from ...io.imports.slot import Filmed

NEEDS = ("Pose2Sim", "anytree", "c3d", "cv2", "matplotlib", "pandas", "rtoml", "scipy")
"""Modules that their synchronisation imports."""

MODELS = {17: "COCO_17", 25: "BODY_25", 26: "HALPE_26", 33: "BLAZEPOSE", 133: "COCO_133"}
"""Pose2Sim's skeletons by how many keypoints a person has."""

CONFIG = "otsync-config.json"


def lacking() -> str:
    """Which modules their code misses here, in words; empty where it can run."""
    gone = [name for name in NEEDS if importlib.util.find_spec(name) is None]
    return f"Pose2Sim's own synchronisation is left out: {', '.join(gone)} not installed" if gone else ""


def keypoint_files(recording: Path, names: Sequence[str]) -> list[list[Path]]:
    """The files of every video, a frame each, as Pose2Sim keeps them; none where one video has none."""
    found = [sorted((recording / "pose" / f"{name}_json").glob("*.json")) for name in names]
    return found if all(found) else []


def their_frames(
    files: Sequence[Sequence[Path]], names: Sequence[str], fps: float, draws: Sequence[Sequence[int]], out: Path
) -> list[np.ndarray]:
    """Offsets (V,) in frames, positive where a video started later than the first one; a draw each.

    Args:
        files: per video a file a frame. draws: frames that every video loses at its start.
        out: a folder for the projects that their code reads; RuntimeError tells how it failed.
    """
    projects = []
    for n, starts in enumerate(draws):
        project = out / f"draw{n}"
        if project.exists():
            shutil.rmtree(project)
        for own, name, start in zip(files, names, starts, strict=True):
            home = project / "pose" / f"{name}_json"
            home.mkdir(parents=True)
            for k, file in enumerate(own[start:]):
                shutil.copyfile(file, home / f"{name}_{k:06d}.json")
        write_json(project / CONFIG, _config(project, files[0], fps))
        projects.append(project)
    done = subprocess.run(
        [sys.executable, "-m", __name__, *map(str, projects)],
        capture_output=True,
        text=True,
        env={**os.environ, "MPLBACKEND": "Agg", "QT_QPA_PLATFORM": "offscreen"},
    )
    if done.returncode:
        raise RuntimeError(f"Pose2Sim's synchronisation failed: {done.stderr.strip().splitlines()[-1:]}")
    filmed = Filmed(tuple(names), (fps,) * len(names), (None,) * len(names))
    answers = []
    for project in projects:
        edges = Pose2Sim().edges(project, filmed)
        late = np.zeros(len(names))
        for edge in edges:  # all from the camera with the fewest frames
            late[edge.b] = edge.seconds * fps
        answers.append(late - late[0])
    return answers


def _config(project: Path, files: Sequence[Path], fps: float) -> dict[str, object]:
    """Pose2Sim's own defaults, without windows and plots."""
    people = next((p for p in (read_json(f)["people"] for f in files) if p), None)
    count = len(people[0]["pose_keypoints_2d"]) // 3 if people else 0
    if count not in MODELS:
        known = ", ".join(map(str, MODELS))
        raise ValueError(
            f"{files[0].parent}: expected people of {known} keypoints; found {count}. Estimate the poses anew."
        )
    return {
        "project": {"project_dir": str(project.resolve()), "frame_rate": round(fps), "frame_range": "auto"},
        "pose": {"pose_model": MODELS[count]},
        "synchronization": {
            "synchronization_gui": False,
            "display_sync_plots": False,
            "save_sync_plots": False,
            "keypoints_to_consider": "all",
            "approx_time_maxspeed": "auto",
            "time_range_around_maxspeed": 2.0,
            "likelihood_threshold_synchronization": 0.4,
            "filter_cutoff": 6,
            "filter_order": 4,
        },
    }


def main(projects: Sequence[str]) -> None:
    """Synchronise each project with their code; what it says goes to the project's ``logs.txt``."""
    import logging

    from Pose2Sim.synchronization import synchronize_cams_all

    root = logging.getLogger()
    root.setLevel(logging.INFO)
    for project in projects:
        handler = logging.FileHandler(Path(project) / "logs.txt", mode="w")
        handler.setFormatter(logging.Formatter("%(message)s"))
        root.addHandler(handler)
        try:
            synchronize_cams_all(json.loads((Path(project) / CONFIG).read_text()))
        finally:
            root.removeHandler(handler)
            handler.close()


if __name__ == "__main__":
    main(sys.argv[1:])
