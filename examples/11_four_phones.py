"""Four phones that nobody calibrated, and a walk past them: from videos alone to cameras and clocks, against the truth.

python examples/11_four_phones.py --out out/phones
"""

from pathlib import Path

import numpy as np
import tyro

from otsync.calibrate import CalibrateOptions, calibrate
from otsync.calibrate.clips import uncalibrated
from otsync.calibrate.document import calibrated_document
from otsync.calibrate.world import centres, degrees, laid_over
from otsync.files.arrays import write_json
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.recordings import synchronize_scene
from otsync.report.cameras import write_cameras
from otsync.simulate.phones import Hand, Tripod, film


def main(
    out: Path = Path("out/phones"), handheld: bool = False, frames: int = 120, walk: int = 400, seed: int = 3
) -> None:
    """Args:
    handheld: six phones in hands instead of four on tripods. frames: of each video. walk: of the walk, which hands
    need not.
    """
    if handheld:
        truth = film(out / "videos", seed, held=Hand(), phones=6, gap=40, frames=frames, walk=0)
    else:
        truth = film(out / "videos", seed, held=Tripod(), frames=frames, walk=walk)

    found = calibrate(out / "videos", CalibrateOptions(), cache=Cache(out / "stages"), tell=print)
    write_cameras(out / "cameras.html", found)
    for camera in found.cameras:
        print(f"{camera.name}: {camera.doubt or 'to be trusted'}")
    if not found.ok:
        raise SystemExit(found.cameras[0].remedy)

    every = [np.broadcast_to(camera.w2c, (frames, 4, 4)) for camera in found.cameras]
    true = [np.broadcast_to(camera.w2c, (frames, 4, 4)) for camera in truth.cameras]
    a, b = np.concatenate(every), np.concatenate(true)
    moved = laid_over(a[::10], b[::10]).camera(a)  # a world that nobody measured has a frame and a unit of its own
    turn = degrees(moved[:, :3, :3] @ np.swapaxes(b[:, :3, :3], 1, 2))
    off = np.linalg.norm(centres(moved) - centres(b), axis=1)
    print(f"cameras: off by {turn.max():.2f} degrees and {100 * off.max():.1f} cm at most")

    write_json(out / "videos" / "scene.json", calibrated_document(uncalibrated(out / "videos"), found))
    answer = synchronize_scene(open_scene(out / "videos"), cache=Cache(out / "stages"), tell=print)
    late = np.abs(answer.offsets.frames - truth.offsets * truth.fps)[1:]
    print(f"offsets: off by {late.mean():.3f} frames on average, {late.max():.3f} at most")


if __name__ == "__main__":
    tyro.cli(main)
