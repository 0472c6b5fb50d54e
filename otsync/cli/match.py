"""``otsync match``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..costs import COSTS
from ..costs.linear import Cost
from ..match import MATCHERS, match
from ..plugins import named
from ..progress import tell
from ..sync.method import with_costs
from ..types import TrackSet
from .slots import slot
from .tables import finite, print_json, refusal

HEADER = "a,b,score\n"


@dataclass
class Match:
    """Match the tracks of two videos.

    Example: otsync match a.npz b.npz --out matches.csv matcher:partial-fgw --matcher.mass 0.65
    """

    a: tyro.conf.Positional[Path]
    b: tyro.conf.Positional[Path]
    out: Path | None = None
    """CSV file for the pairs (index in a, index in b, score)."""
    budget: float | None = None
    """Seconds: takes the most accurate matcher that is predicted to fit."""
    json: bool = False
    """Print the pairs (index in a, index in b, score), flags, statistics and weights, where there are some, as JSON."""
    costs: Annotated[tuple[Cost, ...], named("costs", COSTS, "--costs")] = ()
    """What the named matcher minimises, for example: --costs cosine:weight=3,center=False curve-distance."""
    matcher: slot("matchers", MATCHERS, optional=True) = None
    """Default: by size, fused Gromov-Wasserstein below 200 tracks and its anchored form above."""

    def run(self) -> int:
        if self.out is not None:
            refuse_what_is_no_table_of_pairs(self.out)
        a, b = TrackSet.load(self.a), TrackSet.load(self.b)
        matcher = with_costs(self.matcher, self.costs) if self.costs else self.matcher
        if sys.stderr.isatty():  # one solve has no steps to count
            tell(f"matching {len(a)} x {len(b)} tracks ...")
        matches = match(a, b, matcher, budget=self.budget, throw=False)
        assert matches.score is not None
        if self.json:
            pairs = [[*pair, score] for pair, score in zip(matches.pairs.tolist(), matches.score.tolist(), strict=True)]
            document = {"pairs": pairs, "flags": [f.code for f in matches.flags], "stats": finite(matches.stats)}
            if matches.weight is not None:
                document["weights"] = matches.weight.tolist()
            print_json(document)
        else:
            print(f"{len(matches)} matches between {len(a)} and {len(b)} tracks")
            print("  ".join(f"{name} {value:.6g}" for name, value in matches.stats.items()))
        if self.out is not None:
            from ..files.arrays import atomic_write

            with atomic_write(self.out, "w") as stream:
                stream.write(HEADER)
                stream.writelines(f"{i},{j},{s:.9g}\n" for (i, j), s in zip(matches.pairs, matches.score, strict=True))
            tell(f"wrote {self.out}")
        return refusal("match", matches.status, matches.flags)


def refuse_what_is_no_table_of_pairs(out: Path) -> None:
    """ValueError for a file that is there and was not written by this command."""
    if not out.exists():
        return
    if out.is_file():
        with out.open("rb") as stream:
            if stream.read(len(HEADER)) in (HEADER.encode(), b""):
                return
    raise ValueError(
        f"--out: expected a new file, or a table that otsync match wrote; {out} is something else. Choose another name."
    )
