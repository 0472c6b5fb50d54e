"""Synchronise several videos of one scene from their tracks, and write offsets.json and a report page.

python examples/02_synchronize.py --motion tennis --videos 5 --out out/sync
"""

from pathlib import Path

import tyro

from otsync import Offsets, synchronize
from otsync.metrics import offset_error
from otsync.report import write_report
from otsync.simulate import simulate


def main(
    motion: str = "tennis", videos: int = 4, preset: str = "mid", seed: int = 0, out: Path = Path("out/sync")
) -> None:
    tracks, truth = simulate(motion, preset=preset, videos=videos, seed=seed)

    # Everything has a default; each stage is a slot: synchronize(tracks, matcher=..., aligner=..., refiner=...)
    offsets = synchronize(tracks)

    errors = offset_error(offsets.seconds, truth.offsets, fps=offsets.fps[0]).errors
    for v, name in enumerate(offsets.names):
        print(
            f"{name}: {offsets.frames[v]:8.3f} frames (true {truth.offsets[v] * offsets.fps[0]:8.3f}, "
            f"error {errors[v]:+.3f})  {offsets.status[v].code}"
        )

    # A positive offset means "started later": frame k of video v shows the reference's second k / fps + offset.
    offsets.save(out / "offsets.json")
    write_report(out / "report.html", offsets, tracks, truth=truth.offsets)
    print(f"wrote {out / 'offsets.json'} and {out / 'report.html'}")
    assert Offsets.load(out / "offsets.json").names == offsets.names


if __name__ == "__main__":
    tyro.cli(main)
