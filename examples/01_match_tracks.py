"""Match the 4D tracks of two videos and see how good the matches are.

python examples/01_match_tracks.py --n 500
"""

import tyro

from otsync import FusedGromovWasserstein, PartialFGW, match
from otsync.metrics import match_quality
from otsync.simulate import matching_world


def main(n: int = 500, seed: int = 0) -> None:
    # Two half-views of one articulated figure, 50 degrees apart, each in a rigid frame of its own. Features nearly
    # repeat left and right; a fifth of the tracks are outliers. In your own work: a = TrackSet(xyz, visible, features,
    # fps=30).
    a, b, truth = matching_world(n, seed=seed)
    print(a, b, sep="\n")

    for matcher in (FusedGromovWasserstein(), PartialFGW(mass=0.65)):
        matches = match(a, b, matcher)
        quality = match_quality(matches, truth)
        print(f"\n{matcher}")
        print(f"  {len(matches)} matches, objective {matches.stats['objective']:.4f}, {matches.stats['seconds']:.1f} s")
        print("  " + "  ".join(f"{name} {value:.2f}" for name, value in quality.items()))

    # pairs are indices into a and b, best first; score is minus the linearised cost
    print("\nbest three:", [(int(i), int(j)) for i, j in matches.best(3).pairs])


if __name__ == "__main__":
    tyro.cli(main)
