"""The paper's ablation and its DTW by class and band, the time of `import otsync`, and the cost of absent effects."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import numpy as np

from ..align.slot import AlignerLike
from ..align.verb import align
from ..align.warping import DTW, ConstantShift
from ..match.dense import FusedGromovWasserstein, OptimalTransport
from ..match.slot import MatcherLike
from ..match.verb import match
from ..metrics import match_quality
from ..progress import counted
from ..simulate import matching_world, simulate
from . import record
from .effects import effect_costs
from .record import run_python, table, write_rows

CLASSES = ("boxes", "juggle", "softball", "tennis", "basketball", "football")
BANDS = ((0, 10), (10, 30), (30, 50))
MATCHERS: dict[str, MatcherLike] = {"EMD on features": OptimalTransport(), "FGW (CG)": FusedGromovWasserstein()}
ALIGNERS: dict[str, AlignerLike] = {
    "paper (DTW, mode)": DTW(),
    "open-end DTW": DTW(open_ends=True),
    "DTW on velocities": DTW(cost="velocity"),
    "constant shift of D_geo": ConstantShift(),
}


def run(
    out: Path,
    *,
    n: int = 2000,
    worlds: int = 3,
    seeds: int = 5,
    first_seed: int = 7000,
    gate: bool = False,
    rebase: bool = False,
) -> int:
    """Measure everything, print the tables, write CSV and JSON. 0, or 1 when the gate is missed.

    Args:
        n: tracks per video in the ablation, over ``worlds`` worlds. seeds: per class and band of the aligners' table.
        first_seed: where seeds begin; nothing is tuned on them.
        gate: compare with the committed baseline. rebase: make this run the baseline.
    """
    ablation = matching_ablation(n, range(first_seed, first_seed + worlds))
    print(f"Features alone against fused, N = {n}, mean of {worlds} fresh worlds:\n{table(ablation)}\n")
    write_rows(out, "core_matching", ablation, {"n": n, "seeds": worlds, "first_seed": first_seed})
    errors = offset_table(seeds, first_seed)
    summary = summarise(errors)
    print(f"Frame-level offsets, {seeds} fresh seeds per class and band, true matches of the preset, frames:")
    print(f"{table(summary)}\n")
    write_rows(out, "core_offsets", errors, {"seeds": seeds, "first_seed": first_seed})
    imported = import_time()
    print(table([imported]), table(effects := effect_costs()), sep="\n\n")
    write_rows(out, "core_import", [imported])
    write_rows(out, "core_effects", effects)
    figures = {
        "p50_gain": ablation[1]["p50"] - ablation[0]["p50"],
        "flips_ratio": ablation[1]["flips"] / ablation[0]["flips"],
        "dtw_clean_median": next(r for r in summary if r["preset"] == "clean")["median"],
    }
    if rebase:
        record.save_baseline("core", figures)
    return record.gate("core", figures, worse) if gate else 0


def worse(key: str, measured: float, baseline: float) -> bool:
    """Accuracy may vary by .03 with the rounding of platforms, ratios and medians by a fifth."""
    return measured < baseline - 0.03 if key == "p50_gain" else measured > 1.2 * baseline


def matching_ablation(n: int, seeds: range) -> list[dict]:
    """Mean quality of each matcher over the same worlds, in the feature model of the design."""
    rows = []
    worlds = [matching_world(n, seed=seed) for seed in counted(seeds, "worlds to match", "world")]
    for name, matcher in MATCHERS.items():
        started, qualities = time.process_time(), []
        for a, b, truth in counted(worlds, name, "world"):
            qualities.append(match_quality(match(a, b, matcher), truth))
        spent = (time.process_time() - started) / len(worlds)
        means = {key: float(np.mean([q[key] for q in qualities])) for key in qualities[0]}
        rows.append({"matcher": name, **means, "cpu_seconds": spent})
    return rows


def offset_table(
    seeds: int, first_seed: int, presets: tuple[str, ...] = ("clean", "mid", "hard", "brutal")
) -> list[dict]:
    """One row per aligner, preset, class and band: mean, median, share over two frames."""
    rows = []
    for preset, motion, (low, high) in counted(list(itertools.product(presets, CLASSES, BANDS)), "aligners", "cell"):
        errors: dict[str, list[float]] = {name: [] for name in ALIGNERS}
        for seed in range(first_seed, first_seed + seeds):
            rng = np.random.default_rng([seed, CLASSES.index(motion), low])
            frames = float(rng.uniform(low, high) * rng.choice([-1, 1]))
            (a, b), truth = simulate(motion, preset=preset, offsets=[0.0, frames / 30], seed=seed)
            matches = truth.matches(0, 1)
            for name, aligner in ALIGNERS.items():
                errors[name].append(abs(align(a, b, matches, aligner, throw=False).frames - frames))
        rows += [_row(name, preset, motion, f"{low}-{high}", e) for name, e in errors.items()]
    return rows


def _row(aligner: str, preset: str, motion: str, band: str, errors: list[float]) -> dict:
    e = np.asarray(errors)
    return {
        "aligner": aligner,
        "preset": preset,
        "motion": motion,
        "band": band,
        "mean": float(e.mean()),
        "median": float(np.median(e)),
        "within_1": float((e <= 1).mean()),
        "over_2": float((e > 2).mean()),
        "n": len(e),
    }


def summarise(rows: list[dict]) -> list[dict]:
    """Mean error of the paper's DTW by class and band; then of every aligner over all."""
    summary = []
    for preset in dict.fromkeys(r["preset"] for r in rows):
        for aligner in dict.fromkeys(r["aligner"] for r in rows):
            chosen = [r for r in rows if (r["preset"], r["aligner"]) == (preset, aligner)]
            groups = {c: [r for r in chosen if r["motion"] == c] for c in CLASSES}
            groups |= {f"{low}-{high}": [r for r in chosen if r["band"] == f"{low}-{high}"] for low, high in BANDS}
            cells = {key: float(np.mean([r["mean"] for r in group])) for key, group in groups.items()}
            low = [r for r in chosen if r["band"] != "30-50"]
            summary.append(
                {
                    "preset": preset,
                    "aligner": aligner,
                    **cells,
                    "all": float(np.mean([r["mean"] for r in chosen])),
                    "median": float(np.median([r["median"] for r in low])),
                    "within_1 (<= 30)": float(np.mean([r["within_1"] for r in low])),
                }
            )
    return summary


def import_time() -> dict:
    """Median seconds of `import otsync` in five fresh interpreters."""
    code = "import time; t = time.perf_counter(); import otsync; print(time.perf_counter() - t)"
    return {"what": "import otsync", "seconds": float(np.median([float(run_python(code)) for _ in range(5)]))}
