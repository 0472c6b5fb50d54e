"""CoTracker: what is ours (seeds, windows, coordinates, visibility) with a small network that is called as it is; its
own code where a clone is on the path."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otsync.cli.shell import missing_package
from otsync.priors import TRACKERS, WorkingFrames
from otsync.priors.learned import CoTracker
from otsync.priors.learned.cotracker import on, seeds_at, state_of
from otsync.priors.slots import cache_key
from otsync.recordings.stages import stages_from

torch = pytest.importorskip("torch")

W, H, T = 160, 90, 50
COLOURS = np.array([[250, 40, 40], [40, 250, 40], [40, 40, 250]])
RADIUS = 9


def centres(t: np.ndarray) -> np.ndarray:
    """(3,T,2) paths of three discs."""
    k = np.asarray(t, float)
    return np.stack(
        [
            np.stack([25 + 2.0 * k, 20 + 6 * np.sin(k / 6)], -1),
            np.stack([130 - 1.8 * k, 45 + 4 * np.cos(k / 5)], -1),
            np.stack([80 + 30 * np.sin(k / 9), 70 + 0 * k], -1),
        ]
    )


def film(scale: int = 1) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Images and masks; the first disc is behind a bar for a while."""
    y, x = np.mgrid[: H * scale, : W * scale]
    images, masks = [], []
    for k in range(T):
        image = np.zeros((H * scale, W * scale, 3), np.uint8)
        for centre, colour in zip(centres(np.array(k)), COLOURS, strict=True):
            image[
                np.hypot(x + 0.5 - scale * (centre[0] + 0.5), y + 0.5 - scale * (centre[1] + 0.5)) <= RADIUS * scale
            ] = colour
        image[: 40 * scale, 60 * scale : 80 * scale] = 90
        images.append(image)
        masks.append(image[::scale, ::scale].max(-1) > 200)
    return images, masks


class Colours(torch.nn.Module):
    """Follows what has the colour of the query: its middle moves as the middle of that colour does.

    Called as facebookresearch/co-tracker's CoTrackerPredictor is: forward(video, queries, backward_tracking) ->
    (tracks (B,T,N,2), visibility (B,T,N)), in pixel indices of the video.
    """

    def __init__(self, least: int = 150, wrong_from: int = 0):
        super().__init__()
        self.least, self.wrong_from, self.calls, self.most = least, wrong_from, 0, 0

    def forward(self, video: Any, queries: Any = None, backward_tracking: bool = False) -> Any:
        assert backward_tracking and video.shape[:1] == (1,) and video.shape[2] == 3 and video.dtype == torch.float32
        assert float(video.max()) > 200  # 0 to 255
        self.calls, self.most = self.calls + 1, max(self.most, queries.shape[1])
        frames, n = video[0], queries.shape[1]
        y, x = torch.meshgrid(torch.arange(video.shape[3]), torch.arange(video.shape[4]), indexing="ij")
        places, seen = torch.zeros(len(frames), n, 2), torch.zeros(len(frames), n, dtype=torch.bool)
        for i, (t, u, v) in enumerate(queries[0]):
            colour = frames[int(t), :, int(v.round()), int(u.round())]
            like = (frames - colour[None, :, None, None]).abs().amax(1) < 60
            count = like.sum((1, 2))
            middle = torch.stack([(like * c).sum((1, 2)) / count.clamp(min=1) for c in (x, y)], -1)
            places[:, i] = middle - middle[int(t)] + torch.stack([u, v])
            seen[:, i] = count >= self.least
        if self.wrong_from and self.calls >= self.wrong_from:
            places[:, :, 0] += 5
        return places[None], seen[None]


@dataclass(frozen=True)
class Small(CoTracker):
    """The adapter with a small network behind it."""

    net: Any = field(default_factory=Colours, compare=False)

    def predictor(self) -> Any:
        return self.net


FIELDS: dict[str, Any] = {"grid": 30, "every": 10, "window": 16, "overlap": 5, "device": "cpu"}


def tracked(scale: int = 1, **fields: Any) -> np.ndarray:
    images, masks = film(scale)
    frames = WorkingFrames(images, (W * scale, H * scale), W)
    return Small(**{**FIELDS, **fields})(frames, masks, 30.0)


def disc_of(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which disc every track is on, and how far its distance to the middle varies (pixels)."""
    apart = uv[:, None] - centres(np.arange(T))[None]
    steady = np.nanstd(apart, axis=2).max(-1)
    return steady.argmin(1), steady.min(1)


@pytest.mark.parametrize("scale", [1, 2])
def test_points_are_followed_through_all_windows(scale):
    uv = tracked(scale)
    disc, off = disc_of(uv)
    assert set(disc) == {0, 1, 2} and off.max() < 1
    life = np.isfinite(uv[..., 0]).sum(1)
    for d in (1, 2):  # nothing hides them: some track lives from the first frame to the last
        assert life[disc == d].max() == T


def test_what_is_hidden_is_nan_and_found_again():
    uv = tracked()
    disc, _ = disc_of(uv)
    own = uv[disc == 0]
    at = centres(np.arange(T))[0, :, 0]
    behind = (at > 65) & (at < 75)
    assert not np.isfinite(own[:, behind]).any()
    assert np.isfinite(own[:, at < 45, 0]).any(0).all() and np.isfinite(own[:, (at > 95) & (at < 120), 0]).any(0).all()


def test_so_many_points_at_once_change_nothing_and_bound_memory():
    many, few = Colours(), Colours()
    np.testing.assert_array_equal(tracked(net=many), tracked(net=few, points=1))
    assert few.most == 1 and many.most > 1 and few.calls > many.calls


def test_windows_change_nothing_where_a_point_stays_in_sight():
    whole, parts = tracked(window=T), tracked()
    for d in (1, 2):
        longest = [uv[disc_of(uv)[0] == d][0] for uv in (whole, parts)]
        np.testing.assert_allclose(longest[0], longest[1], atol=0.6)


def test_a_track_ends_where_the_next_window_says_another_place():
    uv = tracked(net=Colours(wrong_from=2), every=50)  # seeds of the first frame alone; later windows contradict
    seen = np.isfinite(uv[..., 0])
    assert seen[:, :16].any() and not seen[:, 16:].any()


def test_tracks_are_bounded_in_number_and_long_enough():
    everything, some = tracked(grid=8), tracked(grid=8, most=4)
    assert len(some) == 4 < len(everything)
    assert np.isfinite(everything[..., 0]).sum(1).min() >= 8
    longer = tracked(grid=8, min_life=30)
    assert 0 < len(longer) < len(everything) and np.isfinite(longer[..., 0]).sum(1).min() >= 30


def test_nothing_that_moves_gives_no_tracks():
    images, masks = film()
    prior = Small(**FIELDS)
    frames = WorkingFrames(images, (W, H))
    assert prior(frames, [np.zeros_like(m) for m in masks], 30.0).shape == (0, T, 2)
    assert prior(WorkingFrames(images[:1], (W, H)), masks[:1], 30.0).shape == (0, 1, 2)


def test_seeds_lie_inside_and_away_from_tracks():
    mask = np.zeros((60, 80), bool)
    mask[10:50, 10:70] = True
    seeds = seeds_at(mask, np.array([[40.0, 30.0], [np.nan, np.nan]]), 8)
    x, y = seeds.astype(int).T
    assert len(seeds) > 10 and mask[y, x].all() and mask[y - 2, x - 2].all()
    assert np.abs(seeds - [40, 30]).max(1).min() > 4
    assert len(seeds_at(mask, np.zeros((0, 2)), 8)) > len(seeds)
    inside = on(np.stack([mask, ~mask]), np.array([[[40.0, 30.0], [40.0, 30.0]], [[-3.0, 5.0], [np.nan, 1.0]]]))
    np.testing.assert_array_equal(inside, [[True, False], [False, False]])


def test_missing_weights_and_code_say_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"points: co-tracker: expected weights at .*scaled_offline.pth"):
        CoTracker().predictor()
    torch.save({"w": torch.zeros(2)}, tmp_path / "scaled_offline.pth")
    monkeypatch.setitem(sys.modules, "cotracker", None)
    monkeypatch.setitem(sys.modules, "cotracker.predictor", None)
    with pytest.raises(ModuleNotFoundError, match=r"Clone github.com/facebookresearch/co-tracker") as missing:
        CoTracker(device="cpu").predictor()
    assert "PYTHONPATH" in missing_package(missing.value) and "pip install" not in missing_package(missing.value)


def test_weights_are_numbers_and_nothing_else(tmp_path):
    torch.save({"model": {"w": torch.ones(3)}}, tmp_path / "whole.pth")
    assert state_of(tmp_path / "whole.pth")["w"].sum() == 3
    torch.save({"w": torch.ones(3), "code": Path("x")}, tmp_path / "code.pth")
    (tmp_path / "text.pth").write_text("nothing")
    for name in ("code", "text"):
        with pytest.raises(ValueError, match=rf"{name}.pth: expected a state dict without pickled objects"):
            state_of(tmp_path / f"{name}.pth")
    a, b = CoTracker(model=str(tmp_path / "whole.pth")), CoTracker(model=str(tmp_path / "whole.pth"), device="cpu")
    assert cache_key(a) == cache_key(b) != cache_key(CoTracker(model=str(tmp_path / "whole.pth"), grid=8))


@pytest.mark.parametrize("wrong", [{"window": 1}, {"overlap": 60}, {"grid": 0}, {"network": "cotracker9"}])
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CoTracker(**wrong)


def test_the_shell_offers_it_by_name():
    assert CoTracker in TRACKERS
    stages = stages_from(points="co-tracker:grid=10,network=cotracker2")
    assert stages.tracking.points == CoTracker(grid=10, network="cotracker2") and not stages.tracking.given


@pytest.mark.parametrize("network", ["cotracker3", "cotracker2"])
def test_the_clones_own_network_with_random_weights(network, tmp_path):
    predictor = pytest.importorskip("cotracker.predictor", reason="needs a clone of facebookresearch/co-tracker")
    from otsync.priors.learned.cotracker import NETWORKS

    torch.manual_seed(0)
    torch.save(
        predictor.CoTrackerPredictor(checkpoint=None, **NETWORKS[network]).model.state_dict(), tmp_path / "w.pth"
    )
    images, masks = film()
    frames = WorkingFrames(images[:12], (W, H))
    prior = CoTracker(model=str(tmp_path / "w.pth"), network=network, window=8, overlap=3, grid=40, device="cpu")
    uv = prior(frames, masks[:12], 30.0)
    assert uv.shape[1:] == (12, 2)
    other = "cotracker2" if network == "cotracker3" else "cotracker3"
    with pytest.raises(ValueError, match="expected the weights of"):
        CoTracker(model=str(tmp_path / "w.pth"), network=other, device="cpu").predictor()
