"""The audit of a rig: its sigma by the pairs that it is made of, and its verdicts on graphs whose answers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync.recordings.audit import FAR, OF_NORMAL, audit_offsets, scale_of
from otsync.sync.graph import Edge, solve
from otsync.types import Alignment, Offsets, Status

FPS = 30.0


def curve(peak: float, height: float = 100.0, rival: float | None = None) -> np.ndarray:
    """A score curve, s, with a peak there, and another one of nine tenths of it at ``rival``."""
    t = np.arange(-60, 61) / FPS
    score = height * np.exp(-0.5 * ((t - peak) * FPS) ** 2)
    if rival is not None:
        score += 0.97 * height * np.exp(-0.5 * ((t - rival) * FPS) ** 2)
    return np.stack([t, score], 1)


def rig(
    true: list[float],
    sigma: float | dict[int, float] = 0.1,
    *,
    seed: int | None = None,
    own: float = 0.0,
    flags: dict[int, tuple[Status, ...]] | None = None,
    of_pairs: dict[int, tuple[Status, ...]] | None = None,
    rivals: dict[int, float] | None = None,
    reference: int = 0,
) -> Offsets:
    """Offsets, frames, from all pairs, as the graph solves them.

    Args:
        sigma: frames, of the pairs of a video; the larger one of two counts. seed: draws errors of pairs, independent,
            and ``own`` ones of videos; None: there are none. flags: of videos. of_pairs: of all pairs of a video.
        rivals: frames from the true one to a second peak in all pairs of a video.
    """
    V, rng = len(true), np.random.default_rng(seed)
    told = {v: sigma if isinstance(sigma, float) else sigma.get(v, 0.1) for v in range(V)}
    errs = rng.normal(0, own, V) if seed is not None else np.zeros(V)
    pairs, edges = {}, []
    for a in range(V):
        for b in range(a + 1, V):
            s = max(told[a], told[b])
            offset = true[b] - true[a] + errs[b] - errs[a] + (rng.normal(0, s) if seed is not None else 0.0)
            rival = next(((r if v == b else -r) for v, r in (rivals or {}).items() if v in (a, b)), None)
            doubt = next((f for v, f in (of_pairs or {}).items() if v in (a, b)), ())
            shape = curve(offset / FPS, rival=None if rival is None else (offset + rival) / FPS)
            pairs[a, b] = Alignment(offset / FPS, sigma=s / FPS, fps=FPS, curve=shape, flags=doubt)
            edges.append(Edge(a, b, offset / FPS, s / FPS, True))
    found = solve(V, edges, reference, shared=0.35)
    names = tuple(f"cam{v}" for v in range(V))
    known = Offsets.known(names, found.x, FPS)
    doubts = tuple((flags or {}).get(v, ()) for v in range(V))
    return replace(known, alignments=pairs, flags=doubts, sigma=found.sigma, reference=reference)


def findings(offsets: Offsets) -> list[str]:
    return [c.finding for c in audit_offsets(offsets).cameras]


@pytest.mark.parametrize("move", [1.0, -2.0, 5.0])
@pytest.mark.parametrize("v", [0, 3])
@pytest.mark.parametrize("reference", [0, 2])
def test_the_camera_that_is_off_is_named_whichever_is_the_reference(move, v, reference):
    true = [0.0] * 5
    true[v] = move
    told = audit_offsets(rig(true, seed=1, reference=reference))
    assert told.alarms == (f"cam{v}",) and not told.unsure
    assert told.cameras[v].frames == pytest.approx(move, abs=0.3)


def test_answers_do_not_depend_on_the_reference():
    """One camera with poor pairs: it alone is less sure, be it the reference or not."""
    told = [audit_offsets(rig([0.0] * 6, {0: 0.8}, reference=r)) for r in (0, 1)]
    sigmas = [np.array([c.sigma for c in t.cameras]) for t in told]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-6)
    assert sigmas[0][0] > 3 * sigmas[0][1:].max() and sigmas[0][1:].max() < 0.15


def test_one_poor_pair_among_good_ones_hardly_adds_to_sigma():
    sound = rig([0.0] * 6)
    pairs = dict(sound.alignments)
    pairs[0, 1] = replace(pairs[0, 1], sigma=1.0 / FPS, stats={"common_error": 0.9 / FPS})
    poor = [audit_offsets(replace(sound, alignments=p)).cameras[1].sigma for p in (sound.alignments, pairs)]
    assert poor[0] < poor[1] < 1.2 * poor[0]


def test_common_errors_are_not_averaged_out():
    """Half of a pair's common variance is each video's own, however many pairs it has."""

    def sigma(cameras: int) -> float:
        sound = rig([0.0] * cameras)
        pairs = {k: replace(p, stats={"common_error": 0.1 / FPS}) for k, p in sound.alignments.items()}
        return audit_offsets(replace(sound, alignments=pairs)).cameras[1].sigma

    # against the mean of all: its own error, less its share in that
    assert [sigma(n) for n in (5, 20)] == pytest.approx([np.sqrt(0.005 * (1 - 1 / n)) for n in (5, 20)], rel=1e-6)


def test_sigma_holds_where_the_pairs_tell_the_truth_about_themselves():
    z = []
    for seed in range(60):
        told = audit_offsets(rig([0.0] * 6, 0.2, seed=seed, own=0.2 * np.sqrt(0.35 / 2)))
        frames = np.array([c.frames for c in told.cameras])
        z += list((frames - frames.mean()) / np.array([c.sigma for c in told.cameras]))
        assert not told.alarms
    assert 0.68 < np.mean(np.abs(z) < 1) < 0.95 and np.mean(np.abs(z) < 2) > 0.95


def test_cameras_that_are_far_apart_say_that_the_pairs_are_less_sure_than_they_tell():
    """Errors of half a frame that every video has in all its pairs alike: no cycle shows them, and no pair tells."""
    alarms = sum(len(audit_offsets(rig([0.0] * 6, 0.05, seed=seed, own=0.5)).alarms) for seed in range(100, 150))
    assert alarms <= 3  # of 300 cameras; by the pairs' own sigmas it would be most of them


@pytest.mark.parametrize("cameras", [3, 4, 5, 6, 8])
@pytest.mark.parametrize("move", [1.0, 5.0])
def test_one_camera_that_is_off_makes_few_others_unsure(cameras, move):
    told = [audit_offsets(rig([move] + [0.0] * (cameras - 1), 0.1, seed=seed, own=0.05)) for seed in range(30)]
    found = np.array([[c.finding for c in t.cameras] for t in told])
    assert (found[:, 0] == "off").mean() > (0.7 if cameras == 3 else 0.85) and (found[:, 1:] != "off").all()
    assert (found[:, 1:] == "in_sync").mean() > (0.75 if cameras == 3 else 0.9)


@given(
    st.lists(st.just(0.0) | st.floats(1e-3, 1e3), min_size=4, max_size=30).filter(
        lambda d: np.mean(np.array(d) > 0) > 0.4
    ),
    st.floats(1e-3, 1e3),
)
def test_the_scale_of_distances_is_hubers(apart, unit):
    """What it solves, before the correction for few; and its unit is that of the distances."""
    d, n = np.array(apart), len(apart)
    scale = scale_of(d)
    raw = scale / (np.sqrt(n / (n - 1)) * (4 * n - 3) / (4 * n - 4))
    assert np.minimum((d / raw) ** 2, FAR**2).mean() == pytest.approx(OF_NORMAL)
    assert scale_of(unit * d) == pytest.approx(unit * scale)


def test_one_of_eight_that_is_far_away_hardly_moves_the_scale():
    rng = np.random.default_rng(0)
    clean, with_one = np.array(
        [(scale_of(d), scale_of(np.append(d, 1e6))) for d in np.abs(rng.normal(size=(200, 7)))]
    ).T
    assert np.median(with_one) < 1.4 * np.median(clean)


def test_a_clock_in_doubt_is_its_own_cameras_affair():
    broken = {2: (Status.BROKEN_CLOCK,)}
    assert findings(rig([0.0] * 5, flags=broken, of_pairs=broken)) == ["in_sync"] * 2 + ["unsure"] + ["in_sync"] * 2
    # of the reference, which has no flags by definition, its pairs say it
    assert findings(rig([0.0] * 5, of_pairs={0: (Status.BROKEN_CLOCK,)})) == ["unsure"] + ["in_sync"] * 4


@pytest.mark.parametrize("beside", [0.0, 7.0])
def test_cameras_in_doubt_that_agree_with_the_sure_ones_make_a_majority(beside):
    """Three sure ones of six are none by themselves; two that are elsewhere add nothing."""
    broken = {4: (Status.BROKEN_CLOCK,), 5: (Status.BROKEN_CLOCK,)}
    told = findings(rig([0.0, 2.0, 0, 0, beside, -beside], flags=broken, of_pairs=broken))
    assert told[1] == ("unsure" if beside else "off")


def test_a_doubt_about_peaks_is_settled_by_the_sum_of_curves_or_stays():
    flags = {1: (Status.AMBIGUOUS,)}
    settled = rig([0.0, 5.0, 0, 0, 0], flags=flags, of_pairs=flags)
    assert findings(settled)[1] == "off" and findings(rig([0.0] * 5, flags=flags, of_pairs=flags))[1] == "in_sync"
    rivalled = rig([0.0, 20.0, 0, 0, 0], flags=flags, of_pairs=flags, rivals={1: -20.0})
    told = audit_offsets(rivalled).cameras[1]
    assert told.finding == "unsure" and "seems late by 20.00 frames" in told.why


def test_what_is_known_to_half_a_frame_is_no_verdict():
    told = audit_offsets(rig([0.0] * 5, {3: 1.0}))
    assert [c.finding for c in told.cameras] == ["in_sync"] * 3 + ["unsure"] + ["in_sync"]
    assert "at one sigma" in told.cameras[3].why


def test_two_cameras_and_strangers_are_no_majority():
    assert findings(rig([0.0, 0.0])) == ["unsure"] * 2
    assert findings(rig([0.0, 8.0, -13.0, 30.0], seed=2)) == ["unsure"] * 4


def test_tolerance_is_above_nothing():
    with pytest.raises(ValueError, match="tolerance: expected frames above 0"):
        audit_offsets(rig([0.0] * 3), tolerance=0.0)
