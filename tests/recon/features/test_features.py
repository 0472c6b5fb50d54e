"""Feature lifting against dense weights, isolated splats and a world filmed by two cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from otsync.types import Camera
from recon.features.lift import FeatureFrame, Lifted, as_tracks, lift_features
from recon.raster import render
from recon.scene.gaussians import Gaussians

WIDTH, HEIGHT = 48, 36


def camera(angle: float = 0.0, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    c, s = np.cos(angle), np.sin(angle)
    w2c = np.array([[c, 0, s, 0.0], [0, 1, 0, 0], [-s, 0, c, 5], [0, 0, 0, 1]])
    return Camera(np.array([[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1]]), w2c, width, height)


def cloud(n: int, seed: int = 0, scale: float = 0.15, spread: float = 0.8) -> Gaussians:
    g = torch.Generator().manual_seed(seed)

    def numbers(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    return Gaussians.from_colors(
        (numbers(n, 3) * 2 - 1) * spread,
        numbers(n, 4) - 0.5,
        scale * (0.5 + numbers(n, 3)),
        0.4 + 0.5 * numbers(n),
        numbers(n, 3),
    )


def dense_weights(g: Gaussians, cam: Camera) -> torch.Tensor:
    """Compositing weights [h,w,N]: what each Gaussian alone adds when it alone is white."""
    splats = (g.means, g.quats, g.scales, g.opacities, torch.eye(len(g), dtype=torch.float64))
    views, Ks = torch.as_tensor(cam.w2c)[None], torch.as_tensor(cam.K)[None]
    return render(*splats, views, Ks, cam.width, cam.height, backend="torch", depth=None).colors[0]


def maps(c: int, seed: int = 0, cam: Camera | None = None) -> torch.Tensor:
    size = (cam.height, cam.width) if cam else (HEIGHT, WIDTH)
    return torch.randn(*size, c, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_lifting_is_the_weighted_mean_over_pixels_frames_and_cameras():
    g = cloud(7)

    def at(t):
        return replace(g, means=g.means + t * torch.tensor([0.3, 0, 0.1], dtype=torch.float64))

    frames = [
        FeatureFrame(t, camera(angle), maps(5, i)) for i, (t, angle) in enumerate([(0.0, 0.0), (0.5, 0.3), (1.0, -0.4)])
    ]
    sums, total = 0, 0
    for frame in frames:
        w = dense_weights(at(frame.t), frame.camera)
        sums, total = sums + torch.einsum("hwn,hwc->nc", w, frame.features), total + w.sum((0, 1))
    lifted = lift_features(at, frames, backend="torch")
    torch.testing.assert_close(lifted.features, sums / total[:, None])
    torch.testing.assert_close(lifted.weight, total)
    # the kernels say the same, for any number of channels
    fast = lift_features(at, frames, backend="cpu")
    torch.testing.assert_close(fast.features, lifted.features, rtol=0, atol=1e-5)


@pytest.mark.parametrize("c", [1, 15, 33, 64])
def test_a_constant_map_gives_its_constant_to_all_that_is_seen(c):
    g = cloud(40)
    hidden = torch.tensor([[0.0, 0, 50]], dtype=torch.float64)  # beyond the far plane
    g = replace(g, means=torch.cat([g.means[:-1], hidden]))
    value = torch.linspace(-2, 3, c, dtype=torch.float64)
    frame = FeatureFrame(0.0, camera(), value.expand(HEIGHT, WIDTH, c).numpy())
    lifted = lift_features(lambda t: g, [frame], far_plane=20.0)
    seen = lifted.weight > 1e-6
    assert 30 < seen.sum() < 40 and not seen[-1]
    torch.testing.assert_close(lifted.features[seen], value.expand(int(seen.sum()), c), rtol=1e-5, atol=1e-5)
    assert not lifted.features[-1].any() and lifted.features.isfinite().all()


def test_what_stands_apart_gets_back_what_it_showed():
    means = torch.tensor([[-1.2, 0, 0], [0, 0, 0], [1.2, 0, 0.0]], dtype=torch.float64)
    g = replace(cloud(3, scale=0.08), means=means)
    features = torch.randn(3, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights = dense_weights(g, camera())
    shown = (weights @ features) / weights.sum(-1, keepdim=True).clamp_min(1e-9)
    lifted = lift_features(lambda t: g, [FeatureFrame(0.0, camera(), shown)])
    torch.testing.assert_close(lifted.features, features, rtol=1e-4, atol=1e-4)


def test_pixels_without_weight_do_not_count_and_what_is_in_front_hides():
    g = cloud(20)
    left = torch.zeros(HEIGHT, WIDTH)
    left[:, : WIDTH // 2] = 1
    map_ = maps(4)
    spoiled = torch.where(left[..., None] > 0, map_, 1e3)
    a, b = (lift_features(lambda t: g, [FeatureFrame(0.0, camera(), m, left)]) for m in (map_, spoiled))
    torch.testing.assert_close(a.features, b.features)
    wall = Gaussians.from_colors(
        torch.tensor([[0.0, 0, -2]]).double(),
        torch.tensor([[1.0, 0, 0, 0]]).double(),
        torch.tensor([[9.0, 9, 0.01]]).double(),
        torch.tensor([0.999]).double(),
        torch.ones(1, 3).double(),
    )
    both = Gaussians(
        *(
            torch.cat([getattr(x, f) for x in (g, wall)])
            for f in ("means", "quats", "log_scales", "opacity_logits", "sh")
        )
    )
    hidden = lift_features(lambda t: both, [FeatureFrame(0.0, camera(), map_)], count=20)
    assert hidden.weight.shape == (20,)
    assert float(hidden.weight.sum()) < 0.01 * float(
        lift_features(lambda t: g, [FeatureFrame(0.0, camera(), map_)]).weight.sum()
    )


def test_maps_are_made_one_at_a_time():
    g, alive = cloud(5), []

    def make(i):
        def extract():
            alive.append(i)
            return maps(3, i)

        return extract

    frames = (FeatureFrame(0.0, camera(), make(i)) for i in range(3))
    lazy = lift_features(lambda t: g, frames)
    given = lift_features(lambda t: g, [FeatureFrame(0.0, camera(), maps(3, i)) for i in range(3)])
    assert alive == [0, 1, 2] and torch.equal(lazy.features, given.features)


def colour_descriptor(image: np.ndarray) -> np.ndarray:
    """Colours around a pixel at three scales, [h,w,9]: a stand-in for a dense descriptor."""
    return np.concatenate([gaussian_filter(image, (s, s, 0)) for s in (0.7, 1.5, 3.0)], -1) - 0.4


def test_lifted_features_of_two_cameras_find_each_other():
    n = 150
    g = cloud(n, scale=0.1, spread=1.0)
    g = replace(g, opacity_logits=torch.full((n,), 3.0, dtype=torch.float64))
    motion = torch.tensor([0.4, 0.1, 0.0], dtype=torch.float64)

    def at(t):
        return replace(g, means=g.means + t * motion)

    tracks = []
    for angle in (0.0, 0.35):
        cam = camera(angle, 128, 96)
        frames = []
        for t in (0.0, 0.5, 1.0):
            image = at(t).render(cam).colors[0].clamp(0, 1).numpy()
            frames.append(FeatureFrame(t, cam, colour_descriptor(image)))
        lifted = lift_features(at, frames)
        times = np.linspace(0, 1, 4)
        xyz = np.stack([at(t).means.numpy() for t in times], 1)
        tracks.append(
            (as_tracks(xyz, lifted, timestamps=times, least_weight=30.0, frame="world"), lifted.weight >= 30.0)
        )
    (a, kept_a), (b, kept_b) = tracks
    a.check("a", features=True)
    assert a.n_frames == 4 and a.frame == "world" and len(a) == int(kept_a.sum()) > n / 2
    np.testing.assert_allclose(np.linalg.norm(a.features, axis=1), 1)
    shared = kept_a & kept_b
    f, h = a.features[shared[kept_a].numpy()], b.features[shared[kept_b].numpy()]
    found = (f @ h.T).argmax(1)
    share = (found == np.arange(len(f))).mean()
    assert share > 0.25, share  # of some 80: by chance it is 1 %
    np.testing.assert_allclose(a.xyz[shared[kept_a].numpy()], b.xyz[shared[kept_b].numpy()])


def test_tracks_are_those_that_were_seen():
    lifted = Lifted(torch.tensor([[3.0, 4], [0, 0], [1, 0], [0, 2]]), torch.tensor([5.0, 5, 0.5, 2]))
    xyz = np.arange(24.0).reshape(4, 2, 3)
    visible = np.array([[True, False]] * 4)
    tracks = as_tracks(xyz, lifted, fps=25.0, visible=visible, name="left")
    assert tracks.name == "left" and tracks.fps == 25 and tracks.seen.tolist() == [[True, False]] * 2
    np.testing.assert_allclose(tracks.features, [[0.6, 0.8], [0, 1]])
    np.testing.assert_allclose(tracks.xyz, xyz[[0, 3]])


def test_bad_maps_are_refused():
    g = cloud(3)

    def lift(*frames, **options):
        return lift_features(lambda t: g, list(frames), **options)

    good = FeatureFrame(0.0, camera(), maps(3))
    moving = Camera(good.camera.K, np.stack([good.camera.w2c] * 2), WIDTH, HEIGHT)
    bent = replace(good.camera, distortion=np.array([0.1, 0, 0, 0]))
    for says, frames in {
        "at least one frame": [],
        "like the camera": [replace(good, features=maps(3)[:-1])],
        "one extractor": [good, replace(good, features=maps(4))],
        "one pose": [replace(good, camera=moving)],
        "without distortion; found": [replace(good, camera=bent)],
    }.items():
        with pytest.raises(ValueError, match=says):
            lift(*frames)
    with pytest.raises(ValueError, match="positions"):
        as_tracks(np.zeros((2, 4, 3)), lift(good), fps=30)
