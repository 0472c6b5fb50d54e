"""The four levels of quality that accuracy is promised at, from ideal to worse than any real tracker."""

from __future__ import annotations

from dataclasses import dataclass

from . import effects as e
from .features import FeatureModel


@dataclass(frozen=True)
class Preset:
    """One level of quality.

    Args:
        effects: applied in order. Depth errors are relative standard deviations, lengths metres, times seconds.
        features: the feature model.
        wrong: share of wrong matches (another limb) that ``Truth.matches`` mixes in.
        matches: how many matches it gives a pair.
    """

    name: str
    effects: tuple[e.Effect, ...]
    features: FeatureModel | None
    wrong: float
    matches: int

    def tracks(self, figures: int) -> int:
        """Tracks a video: enough that ``matches`` of them have a partner on the same limb, seen from the other side."""
        return round((1.6 if figures < 2 else 2.4) * self.matches)


def _tracker(bias: float, drift: float, jitter: float, lateral: float, slide: float) -> tuple[e.Effect, ...]:
    return (
        e.SlowDrift(slide, correlation=1.2),
        e.DepthBias(bias),
        e.DepthDrift(drift, correlation=1.0),
        e.DepthJitter(jitter),
        e.LateralJitter(lateral),
    )


PRESETS: dict[str, Preset] = {
    p.name: p
    for p in (
        Preset(
            "clean",
            effects=_tracker(0.005, 0.002, 0.001, 0.001, 0.002),
            features=FeatureModel(noise=0.15),
            wrong=0.0,
            matches=120,
        ),
        Preset(
            "mid",
            effects=(
                *_tracker(0.02, 0.008, 0.005, 0.003, 0.008),
                e.CameraDepthDrift(0.004, correlation=1.2),
                e.Gaps(0.20),
                e.CameraFrame(0.01, 1.0, 0.03),
            ),
            features=FeatureModel(noise=0.35),
            wrong=0.15,
            matches=100,
        ),
        Preset(
            "hard",
            effects=(
                *_tracker(0.04, 0.02, 0.012, 0.006, 0.015),
                e.CameraDepthDrift(0.01, correlation=1.2),
                e.Gaps(0.35),
                e.CameraFrame(0.02, 1.5, 0.06),
            ),
            features=FeatureModel(noise=0.6),
            wrong=0.4,
            matches=60,
        ),
        Preset(
            "brutal",
            effects=(
                e.RayCompression(0.5, 1.0),
                e.LimbDrift(0.05, correlation=0.8),
                e.IdentitySwitch(0.3),
                # the tracker smooths its paths; the errors of depth, which is estimated frame by frame, come on top
                e.Smoothing(2.5 / 30, 0.6, 1.4),
                *_tracker(0.05, 0.025, 0.015, 0.008, 0.02),
                e.CameraDepthDrift(0.012, correlation=1.2),
                # 45 % of the samples are lost, but two thirds of those are invented instead of missing
                e.Hallucination(0.3),
                e.Gaps(0.15),
                e.CameraFrame(0.03, 2.0, 0.09),
            ),
            features=FeatureModel(noise=0.6),
            wrong=0.4,
            matches=60,
        ),
    )
}
