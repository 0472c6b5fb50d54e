"""Hard cases of matching."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...costs.linear import Labels
from ...types import TrackSet
from .case import FLAGGED, REFUSED, RIGHT, SOUND, Case, changed, cloud, few_right, mostly_identity, pair

DENSE = ("FusedGromovWasserstein", "EntropicFGW", "PartialFGW", "GromovWasserstein", "UnbalancedFGW", "SemirelaxedFGW")
FEATURES_ONLY = ("NearestNeighbor", "OptimalTransport", "Sinkhorn")
BY_FEATURES = (
    *FEATURES_ONLY,
    "Candidates",
    "UnbalancedOT",
    "FusedGromovWasserstein",
    "EntropicFGW",
    "PartialFGW",
    "UnbalancedFGW",
    "SemirelaxedFGW",
    "AnchoredFGW",
)
BLIND = {name: "looks at features alone" for name in FEATURES_ONLY} | {
    "GromovWasserstein": "no features: what structure cannot tell it cannot know"
}
identity = mostly_identity()


def put(array: np.ndarray, where, value) -> np.ndarray:
    out = np.array(array)
    out[where] = value
    return out


def two_copies() -> tuple[TrackSet, TrackSet]:
    """An object and its copy turned by half a turn about the middle: exchanging them is an isometry."""
    rng = np.random.default_rng(5)
    half = 0.3 * cloud(60, 30, 5) + [1.0, 0, 0]
    xyz, features = np.concatenate([half, half * [-1, -1, 1]]), np.tile(rng.normal(size=(60, 16)), (2, 1))

    def video() -> TrackSet:
        return TrackSet(
            xyz + 0.01 * rng.normal(size=xyz.shape), features=features + 0.1 * rng.normal(size=features.shape), fps=30
        )

    return video(), video()


def one_of_two_copies() -> tuple[TrackSet, TrackSet]:
    """The first video shows both, the second one of them."""
    a, b = two_copies()
    return a, b.take(np.arange(60))


def gaps(share: float):
    def make() -> tuple[TrackSet, TrackSet]:
        rng = np.random.default_rng(3)
        return tuple(replace(x, visible=rng.random(x.seen.shape) > share) for x in pair(120))

    return make


def outliers(share: float):
    def make() -> tuple[TrackSet, TrackSet]:
        a, b = pair(160)
        k = round(share * 160)
        far = cloud(k, 40, 77, 2.0), np.random.default_rng(9).normal(size=(k, 24))
        return a, replace(
            b, xyz=put(b.xyz, slice(160 - k, None), far[0]), features=put(b.features, slice(160 - k, None), far[1])
        )

    return make


def far_track(times: float):
    def make() -> tuple[TrackSet, TrackSet]:
        a, b = pair()
        return a, replace(b, xyz=put(b.xyz, 0, b.xyz[0] + times))

    return make


def with_positions(of):
    """The pair with positions from a function of the first cloud's, the same in both videos up to a little noise."""

    def make() -> tuple[TrackSet, TrackSet]:
        rng = np.random.default_rng(11)
        return tuple(replace(x, xyz=of(cloud(80, 40)) + 1e-3 * rng.normal(size=(80, 40, 3))) for x in pair())

    return make


def huge() -> tuple[TrackSet, TrackSet]:
    xyz = np.broadcast_to(np.float32(0), (300_000, 1, 3))
    one = TrackSet(xyz, features=np.broadcast_to(np.float32(1), (300_000, 2)), fps=30)
    return one, one


def unrelated() -> tuple[TrackSet, TrackSet]:
    return pair(120, seed=1, dims=128)[0], pair(120, seed=2, dims=128)[1]


def sized(n_a: int, n_b: int):
    def make() -> tuple[TrackSet, TrackSet]:
        a, b = pair(max(n_a, n_b))
        return a.take(slice(0, n_a)), b.take(slice(0, n_b))

    return make


def never_together() -> tuple[TrackSet, TrackSet]:
    """Every track lives in a frame of its own."""
    return tuple(replace(x, visible=np.eye(40, dtype=bool)) for x in pair(40))


def refused(name: str, why: str, message: str, make) -> Case:
    return Case(name, why, "ValueError that names the argument, the tracks and the remedy", make, (REFUSED,), message)


CASES: tuple[Case, ...] = (
    # units and magnitudes
    *(
        Case(
            f"unit of length x {u:g}",
            "alpha weighs structure against features in that unit",
            "one common median normalises; same matches",
            changed(pair, xyz=lambda x, u=u: x * u),
            (RIGHT,),
            check=identity,
        )
        for u in (1e-30, 1e-6, 1e-4, 1e-3, 1e3, 1e6, 1e30)
    ),
    *(
        Case(
            f"features x {u:g}",
            "their squares leave the range of floats",
            "rows are scaled before they are normalised; same matches",
            changed(pair, features=lambda f, u=u: f * u),
            (RIGHT,),
            check=identity,
        )
        for u in (1e-310, 1e-200, 1e-30, 1e30, 1e200)
    ),
    Case(
        "origin 1e6 sizes away",
        "distances of large numbers cancel in single precision",
        "differences, in double precision before centring",
        changed(pair, xyz=lambda x: x + 1e6),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "one track 50 x away",
        "dividing by the maximum wipes the structure out",
        "the median normalises",
        far_track(50.0),
        (RIGHT,),
        check=identity,
        limits={
            "GromovWasserstein": "the outlier's squared distances are the objective",
            "SemirelaxedFGW": "the outlier's squared distances are the objective",
            "UnbalancedFGW": "the outlier overflows POT's kernel",
        },
    ),
    Case(
        "one track 1e6 x away",
        "its squared distances dwarf all others",
        "partial mass or truncation leaves it out, or the answer is flagged",
        far_track(1e6),
        SOUND,
        check=identity,
    ),
    # array types
    *(
        Case(
            f"{'big-endian ' if d == '>f4' else ''}{np.dtype(d).name} arrays",
            "solvers compute in the input's type",
            "positions become float32 or float64, plans are float64",
            changed(
                lambda: pair(noise=0.1),
                xyz=lambda x, d=d: (x * (100 if np.dtype(d).kind == "i" else 1)).astype(d),
                features=lambda f, d=d: (f * (50 if np.dtype(d).kind == "i" else 1)).astype(d),
            ),
            (RIGHT,),
            check=identity,
        )
        for d in (np.float16, np.float32, np.float64, np.int16, np.int64, ">f4")
    ),
    Case(
        "Fortran order and strides",
        "kernels assume contiguous rows",
        "copied where needed",
        changed(pair, xyz=np.asfortranarray, features=lambda f: np.repeat(f, 2, 1)[:, ::2]),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "read-only arrays",
        "in-place work on the caller's data",
        "inputs are never written",
        changed(pair, xyz=lambda x: np.broadcast_to(x, x.shape), features=lambda f: np.broadcast_to(f, f.shape)),
        (RIGHT,),
        check=identity,
    ),
    # contents that are refused
    refused(
        "nan in a visible sample",
        "comparisons with nan are false",
        "finite values in visible",
        lambda: (replace(pair()[0], xyz=put(pair()[0].xyz, (3, 4, 0), np.nan)), pair()[1]),
    ),
    refused(
        "infinity in a visible sample",
        "inf - inf is nan",
        "finite values in visible",
        lambda: (pair()[0], replace(pair()[1], xyz=put(pair()[1].xyz, (3, 4, 0), np.inf))),
    ),
    Case(
        "nan features",
        "they spread to every cost",
        "ValueError that names the tracks",
        changed(pair, features=lambda f: put(f, (2, 1), np.nan)),
        (REFUSED,),
        "expected finite values; tracks 2",
        solvers=BY_FEATURES,
    ),
    Case(
        "infinite features",
        "normalising gives nan",
        "ValueError that names the tracks",
        changed(pair, features=lambda f: put(f, (2, 1), np.inf)),
        (REFUSED,),
        "expected finite values; tracks 2",
        solvers=BY_FEATURES,
    ),
    Case(
        "a feature of zeros",
        "it has no direction",
        "ValueError that names the tracks",
        changed(pair, features=lambda f: put(f, 5, 0)),
        (REFUSED,),
        "tracks 5 are all zero",
        solvers=BY_FEATURES,
    ),
    Case(
        "no features",
        "nothing for the linear term",
        "ValueError with the remedy",
        changed(pair, features=lambda f: None),
        (REFUSED, RIGHT),
        "features: expected",
        check=identity,
    ),
    Case(
        "other feature dimensions",
        "the product does not exist",
        "ValueError that names both",
        lambda: (pair()[0], replace(pair()[1], features=np.ones((80, 5)))),
        (REFUSED, RIGHT),
        "expected 24 dimensions as a has; found 5",
        check=identity,
    ),
    Case(
        "pixels only",
        "D_track needs 3D",
        "ValueError with the remedy, or features alone",
        lambda: tuple(TrackSet(None, features=x.features, uv=x.xyz[..., :2], fps=30) for x in pair()),
        (REFUSED, RIGHT),
        "found pixels only",
        check=identity,
    ),
    refused(
        "no tracks",
        "empty sums",
        "expected at least one track",
        lambda: (pair()[0].take(slice(0, 0)), pair()[1]),
    ),
    refused(
        "no frames",
        "empty maxima",
        "expected at least one track and one frame",
        lambda: (TrackSet(np.zeros((5, 0, 3)), features=np.ones((5, 2)), fps=30), pair()[1]),
    ),
    Case(
        "300,000 tracks",
        "a dense matrix has 720 GB",
        "ValueError with the size, before anything is allocated",
        huge,
        (REFUSED, FLAGGED),
        "GiB for 300000 x 300000 tracks",
        solvers=(*FEATURES_ONLY, *DENSE),
    ),
    Case(
        "labels of other classes",
        "memberships do not meet",
        "ValueError that names the argument",
        lambda: tuple(replace(x, labels=np.ones((80, k))) for x, k in zip(pair(), (2, 3), strict=True)),
        (REFUSED,),
        "labels: expected the classes",
        solvers=("AnchoredFGW, labels",),
    ),
    # sizes
    Case("one track each", "one answer, no evidence", "flagged: no information", sized(1, 1), (FLAGGED,)),
    Case(
        "two tracks each",
        "one distance: exchanging them costs nothing",
        "features decide, or flagged",
        sized(2, 2),
        check=few_right(2),
    ),
    Case(
        "three tracks each",
        "no handedness, hardly any structure",
        "features decide",
        sized(3, 3),
        check=few_right(3),
    ),
    Case(
        "one track against 80",
        "a plan must spread over all",
        "one match at most",
        sized(1, 80),
        check=few_right(1),
    ),
    Case(
        "a is a subset of b",
        "balanced marginals force the rest of b onto something",
        "one-to-one; the better half is right",
        sized(60, 120),
        (RIGHT,),
        check=mostly_identity(0.85),
        limits={"GromovWasserstein": "structure of a part differs from that of the whole"},
    ),
    Case(
        "b is a subset of a",
        "as before, the other way",
        "one-to-one; the better half is right",
        sized(120, 60),
        (RIGHT,),
        check=mostly_identity(0.85),
        limits={"GromovWasserstein": "structure of a part differs from that of the whole"},
    ),
    Case(
        "400 against 20",
        "20 times as much mass on one side",
        "at most 20 matches",
        sized(400, 20),
        check=identity,
    ),
    Case(
        "600 tracks, partial mass",
        "POT hands its outer iteration limit on as LP pivots",
        "LP limit raised",
        lambda: pair(600, 20),
        (RIGHT,),
        check=identity,
        solvers=("PartialFGW",),
    ),
    Case(
        "grouped cells in another order",
        "quantised solvers answer in the order of their partition",
        "indices of the caller",
        lambda: pair(400, 20),
        (RIGHT,),
        check=identity,
        solvers=("AnchoredFGW, grouped",),
    ),
    Case(
        "T_a much larger than T_b",
        "maxima over 12 frames and over 400 differ",
        "normalised by one median; truncation",
        lambda: (pair(frames=400)[0], replace(pair(frames=400)[1], xyz=pair(frames=400)[1].xyz[:, :100], visible=None)),
        (RIGHT, FLAGGED),
        check=mostly_identity(0.7),
    ),
    Case(
        "one frame",
        "no motion, one pose",
        "a pose is structure enough",
        lambda: pair(frames=1),
        (RIGHT,),
        check=identity,
    ),
    # visibility
    Case(
        "every track seen in one frame only",
        "hardly any pair is ever seen together",
        "unknown distances get the median; features decide, or flagged",
        changed(pair, visible=lambda v: np.arange(40)[None] == np.random.default_rng(1).integers(0, 40, (80, 1))),
        check=identity,
    ),
    Case(
        "tracks that never co-occur",
        "no distance is known",
        "features decide, or flagged",
        never_together,
        check=identity,
    ),
    Case(
        "half of the samples missing",
        "maxima over other frames",
        "co-visible frames only",
        gaps(0.5),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "90 % of the samples missing",
        "four frames a track",
        "co-visible frames only; features decide",
        gaps(0.9),
        (RIGHT, FLAGGED),
        check=mostly_identity(0.8),
    ),
    Case(
        "a track that is never seen",
        "no position at all",
        "never matched by position",
        lambda: (replace(pair()[0], visible=put(pair()[0].seen, 7, False)), pair()[1]),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "nothing is seen at all",
        "no structure, features alone",
        "flagged by structure; features alone may answer",
        changed(pair, visible=lambda v: np.zeros_like(v)),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    # geometry
    Case(
        "collinear tracks",
        "no plane, no handedness",
        "structure of a line; features tell its ends apart",
        with_positions(lambda x: x[..., :1] * [1.0, 2, 3]),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    Case(
        "coplanar tracks",
        "handedness is undefined",
        "chirality abstains",
        with_positions(lambda x: x * [1.0, 1, 0]),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "static scene",
        "no motion to compare",
        "shape is structure",
        with_positions(lambda x: x[:, :1].repeat(40, 1)),
        (RIGHT,),
        check=identity,
    ),
    Case(
        "all tracks at one place",
        "no structure: features decide",
        "unit 1; features decide",
        changed(pair, xyz=lambda x: np.zeros_like(x)),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    Case(
        "all features equal",
        "structure decides",
        "structure decides; chirality looks for mirrors",
        changed(pair, features=lambda f: np.ones_like(f)),
        (RIGHT, FLAGGED),
        check=identity,
    ),
    Case(
        "features and places all equal",
        "C = M = 0: every plan is optimal",
        "flagged: no information",
        changed(pair, features=lambda f: np.ones_like(f), xyz=lambda x: np.zeros_like(x)),
        (FLAGGED,),
    ),
    Case(
        "every track twice",
        "equal rows",
        "deterministic; twins may be exchanged",
        lambda: tuple(x.take(np.repeat(np.arange(60), 2)) for x in pair(60)),
        (RIGHT,),
        check=mostly_identity(0.9, of=lambda k: k // 2),
    ),
    Case(
        "one-dimensional features",
        "a cosine of ±1",
        "structure decides, or flagged",
        changed(pair, features=lambda f: np.sign(f[:, :1])),
        check=identity,
    ),
    Case(
        "features that cancel",
        "their mean, or a cell's, is zero",
        "a cell takes a member's feature",
        lambda: tuple(replace(x, features=np.concatenate([x.features[:40], -x.features[:40]])) for x in pair()),
        (RIGHT,),
        check=mostly_identity(0.85),
    ),
    Case(
        "features that a camera shifts",
        "a common offset hides the differences",
        "each video's mean is subtracted",
        lambda: (pair()[0], replace(pair()[1], features=pair()[1].features + 30)),
        (RIGHT,),
        check=identity,
        limits={
            "UnbalancedOT": "features as given, not centred, by default",
            "Candidates": "features as given, not centred, by default",
        },
    ),
    Case(
        "a mirrored scene",
        "distances cannot see it",
        "chirality: flagged ambiguous",
        lambda: (pair()[0], replace(pair()[1], xyz=pair()[1].xyz * [1, 1, -1])),
        (FLAGGED,),
    ),
    Case(
        "mirror image, features equal",
        "any isometry will do",
        "chirality: flagged",
        lambda: tuple(
            replace(x, features=np.ones_like(x.features), xyz=x.xyz * [1, 1, s])
            for x, s in zip(pair(), (1, -1), strict=True)
        ),
        (FLAGGED,),
    ),
    Case(
        "two identical objects exchanged",
        "the swap costs the same",
        "AnchoredFGW: a challenger finds the other answer: ambiguous",
        two_copies,
        (FLAGGED, RIGHT),
        check=lambda m: False,
    ),
    Case(
        "two identical objects, of which the other video shows one",
        "each of the two explains it as well; nothing is exchanged, so no swap tells",
        "what is left over is asked for a second answer: ambiguous",
        one_of_two_copies,
        (FLAGGED,),
    ),
    Case(
        "two identical objects, labelled",
        "labels break the symmetry",
        "the Labels cost settles it",
        lambda: tuple(replace(x, labels=np.repeat([0, 1], 60)) for x in two_copies()),
        (RIGHT,),
        check=identity,
        solvers=("AnchoredFGW, labels",),
    ),
    # trust
    Case(
        "unrelated videos",
        "there is always a cheapest plan",
        "features of the better half hardly beat chance: no match",
        unrelated,
        (FLAGGED,),
    ),
    Case(
        "noise for features",
        "only structure can tell",
        "features that do not beat chance: flagged, or structure decides",
        lambda: tuple(
            replace(x, features=np.random.default_rng(k).normal(size=(120, 128))) for k, x in enumerate(pair(120))
        ),
        (FLAGGED, RIGHT),
        check=identity,
    ),
    Case(
        "a third outliers in b",
        "marginals force them onto something",
        "scores rank them last",
        outliers(0.33),
        (RIGHT,),
        check=identity,
        limits={
            "GromovWasserstein": "no features",
            "FusedGromovWasserstein": "balanced: outliers are forced onto something",
            "EntropicFGW": "balanced: outliers are forced onto something",
            "SemirelaxedFGW": "one marginal is balanced",
        },
    ),
    Case(
        "two thirds outliers in b",
        "most of the mass is wrong",
        "the better half is right, or flagged",
        outliers(0.66),
        (RIGHT, FLAGGED),
        check=mostly_identity(0.8, 25),
    ),
    # solver parameters
    *(
        Case(
            f"{solver}, ε = {reg:g}",
            "exp(-C/ε) underflows",
            "stabilised; the plan is rounded to its marginals",
            pair,
            (RIGHT, FLAGGED),
            check=identity,
            solvers=(f"{solver} {reg:g}",),
        )
        for solver, reg in (("Sinkhorn", 1e-3), ("Sinkhorn", 1e-6), ("EntropicFGW", 1e-3), ("EntropicFGW", 1e-5))
    ),
    Case(
        "POT's torch back end",
        "tensors in, tensors out",
        "same plan as numpy",
        pair,
        (RIGHT,),
        check=identity,
        solvers=("FusedGromovWasserstein, torch",),
    ),
)

LABELS = Labels()
