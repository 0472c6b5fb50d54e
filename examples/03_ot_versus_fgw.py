"""The paper's ablation: transport on features alone against fused Gromov-Wasserstein.

Features say "a hand"; only structure says which one. Feature transport mixes left and right and its matches cross;
FGW keeps neighbours together.

python examples/03_ot_versus_fgw.py --n 1000 --seeds 0 1 2 --out out/ablation.png
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from otsync.metrics import match_quality

from otsync import FusedGromovWasserstein, OptimalTransport, match
from otsync.simulate import matching_world

MATCHERS = {"features only (EMD)": OptimalTransport(), "fused (FGW)": FusedGromovWasserstein()}


def main(n: int = 1000, seeds: tuple[int, ...] = (0, 1, 2), out: Path = Path("out/ablation.png")) -> None:
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in MATCHERS}
    found = {}
    for seed in seeds:
        a, b, truth = matching_world(n, seed=seed)
        for name, matcher in MATCHERS.items():
            found[name] = match(a, b, matcher)
            rows[name].append(match_quality(found[name], truth, a, b))

    print(f"{n} tracks a video, mean of {len(seeds)} worlds")
    print(f"{'':22}" + "".join(f"{key:>11}" for key in rows["fused (FGW)"][0]))
    for name, qualities in rows.items():
        print(f"{name:22}" + "".join(f"{np.mean([q[key] for q in qualities]):11.3f}" for key in qualities[0]))

    # the last world: both videos side by side, the best tenth of the matches coloured by where they start in a
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    for ax, (name, matches) in zip(figure.subplots(1, 2), found.items(), strict=True):
        best = matches.best(n // 10).pairs
        xy = [t.xyz[:, t.n_frames // 2, [0, 2]] - np.median(t.xyz[:, t.n_frames // 2, [0, 2]], 0) for t in (a, b)]
        shift = np.array([1.2 * np.ptp(np.quantile(xy[0], (0.02, 0.98), axis=0)[:, 0]), 0])
        for points, at in ((xy[0], 0), (xy[1], shift)):
            ax.plot(*(points + at).T, ".", ms=1.5, color="0.75")
        order = np.argsort(np.argsort(xy[0][best[:, 0], 1]))
        for rank, (i, j) in zip(order, best, strict=True):
            start, end = xy[0][i], xy[1][j] + shift
            ax.plot(
                [start[0], end[0]],
                [start[1], end[1]],
                lw=0.5,
                alpha=0.7,
                color=(rank / len(best), 0.3, 1 - rank / len(best)),
            )
        low, high = np.quantile(np.concatenate([xy[0], xy[1] + shift]), (0.01, 0.99), axis=0)
        ax.set(title=name, xlim=(low[0] - 0.2, high[0] + 0.2), ylim=(low[1] - 0.2, high[1] + 0.2), aspect="equal")
        ax.set_axis_off()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)
    print(f"wrote {out}")


if __name__ == "__main__":
    tyro.cli(main)
