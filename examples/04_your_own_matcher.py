"""Your own matcher in the slot: any callable (a, b) -> Matches, here nearest neighbours by how much a track moves.

A frozen dataclass is the house's form: its fields are the parameters, and it works in Python and on executors alike.

python examples/04_your_own_matcher.py
"""

from dataclasses import dataclass

import numpy as np
import tyro

from otsync import Matches, OptimalTransport, TrackSet, match, synchronize
from otsync.simulate import simulate


@dataclass(frozen=True)
class SameTravel:
    """Mutual nearest neighbours by path length and extent: time-free, feature-free, and rather naive."""

    keep: int = 60

    def describe(self, tracks: TrackSet) -> np.ndarray:
        xyz = tracks.positions()
        steps = np.linalg.norm(np.diff(xyz, axis=1), axis=-1)
        return np.stack([np.nanmean(steps, 1), *np.nanstd(xyz, axis=1).T, *np.nanmean(xyz, axis=1).T], 1)

    def __call__(self, a: TrackSet, b: TrackSet) -> Matches:
        x, y = self.describe(a), self.describe(b)
        spread = np.nanstd(np.concatenate([x, y]), axis=0) + 1e-12
        cost = np.nan_to_num(np.abs((x[:, None] - y[None]) / spread).sum(-1), nan=1e9)
        nearest_b, nearest_a = cost.argmin(1), cost.argmin(0)
        i = np.flatnonzero(nearest_a[nearest_b] == np.arange(len(a)))
        return Matches(np.stack([i, nearest_b[i]], 1), score=-cost[i, nearest_b[i]]).best(self.keep)


def main(videos: int = 3, seed: int = 0) -> None:
    tracks, truth = simulate("tennis", preset="mid", videos=videos, seed=seed)
    print(len(match(tracks[0], tracks[1], SameTravel())), "matches of the first pair")

    for matcher in (SameTravel(), OptimalTransport()):
        offsets = synchronize(tracks, matcher=matcher)
        error = np.abs(offsets.seconds - truth.offsets)[1:] * 30
        print(f"{matcher}: errors {np.round(error, 2)} frames, {[s.code for s in offsets.status[1:]]}")

    # or skip matching altogether: bring pairs of your own
    given = {(0, v): truth.matches(0, v) for v in range(1, videos)}
    offsets = synchronize(tracks, matches=given)
    print(f"given matches: errors {np.round(np.abs(offsets.seconds - truth.offsets)[1:] * 30, 2)} frames")


if __name__ == "__main__":
    tyro.cli(main)
