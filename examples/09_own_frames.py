"""Synchronise videos that share neither a clock nor a frame of reference, and see where their cameras stood.

python examples/09_own_frames.py --motion basketball --videos 4 --out out/own --picture out/own/frames.png
"""

from pathlib import Path

import numpy as np
import tyro

from otsync import Offsets, TrackSet, synchronize
from otsync.simulate import simulate
from otsync.types.similarity import IDENTITY


def main(
    motion: str = "basketball",
    videos: int = 4,
    preset: str = "mid",
    seed: int = 5,
    out: Path = Path("out/own"),
    picture: Path | None = None,
) -> None:
    # Every video reports positions in a rotation, translation and scale of its own, as a phone with depth would.
    tracks, truth = simulate(motion, preset=preset, videos=videos, own_frames=True, seed=seed)

    # Positions cannot be compared, but distances among a video's own tracks can: Gromov-Wasserstein matches by them.
    offsets = synchronize(tracks, frames="own")

    print("video    offset (frames)  error   turn error   scale error   status")
    for v, name in enumerate(offsets.names):
        found, true = offsets.transforms[v], truth.transform(0, v)
        if found is None:
            print(f"{name}: no pair leads to its frame ({offsets.status[v].code})")
            continue
        error = offsets.frames[v] - truth.offsets[v] * offsets.fps[0]
        turn, scale = found.degrees_from(true), 100 * (found.scale / true.scale - 1)
        sigmas = f"{found.rotation_sigma:.2f}, {100 * found.scale_sigma:.2f}%"
        print(
            f"{name}   {offsets.frames[v]:12.3f}   {error:+.3f}   {turn:8.2f}°   {scale:+9.2f}%   "
            f"{offsets.status[v].code}   (sigma {sigmas})"
        )

    # A transform maps a video's own positions to the reference's frame, and its camera with them.
    for t, transform in zip(tracks, offsets.transforms, strict=True):
        if transform is not None and t.camera is not None:
            print(f"{t.name}'s camera stands at {np.round(transform.camera(t.camera).center, 2)}")

    offsets.save(out / "offsets.json")
    again = Offsets.load(out / "offsets.json")
    assert again.transforms[0] is not None and again.transforms[0].degrees_from(IDENTITY) == 0
    print(f"wrote {out / 'offsets.json'}")
    if picture is not None:
        draw(tracks, offsets, picture)


def draw(tracks: list[TrackSet], offsets: Offsets, picture: Path) -> None:
    """Paths as the videos report them, and the same in the frame of the first video, with the cameras."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 3.9), layout="constrained")
    for ax, own in zip(figure.subplots(1, 2), (True, False), strict=True):
        ax.set_title("as each video reports them" if own else "in the frame that was found")
        for v, (t, S) in enumerate(zip(tracks, offsets.transforms, strict=True)):
            if S is None or t.camera is None:
                continue
            x = t.positions() if own else S(t.positions())
            ax.plot(*x[::3, :, :2].T, color=f"C{v}", lw=0.4, alpha=0.6)
            centre = t.camera.center if own else S.camera(t.camera).center
            ax.plot(*centre[:2], "o", color=f"C{v}", ms=7, label=t.name)
        ax.set_aspect("equal", "datalim")
    ax.legend(fontsize=8)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
