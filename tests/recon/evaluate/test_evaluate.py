"""Figures of images, offsets and tracks against independent definitions and worlds with known answers."""

from __future__ import annotations

import importlib.util
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from recon.bench import paper_table
from recon.evaluate import figures as evaluate
from recon.evaluate.figures import acceleration, coherence, coherence_of, following_error, psnr, score_image, ssim
from recon.evaluate.lpips import Lpips


def pair(h=40, w=50, seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.normal(size=(h, w, 3)), (2, 2, 0)) * 2 + 0.5
    return smooth.clip(0, 1), (smooth + noise * rng.normal(size=smooth.shape)).clip(0, 1)


def test_psnr_of_a_flat_difference():
    x = np.full((20, 30, 3), 0.5)
    assert psnr(x, x + 0.1) == pytest.approx(20)
    assert psnr(x, x) == math.inf
    assert psnr(x - 1.5, np.zeros_like(x)) == math.inf  # clipped as in a file
    assert psnr((255 * np.ones((20, 30, 3))).astype(np.uint8), np.full((20, 30, 3), 0.9)) == pytest.approx(20)
    assert psnr(torch.from_numpy(x).float(), x + 0.1) == pytest.approx(20, abs=1e-4)


def test_mask_psnr_knows_only_the_mask():
    x, y = pair()
    mask = np.zeros((40, 50), bool)
    mask[10:30, 5:20] = True
    inside = -10 * np.log10(((x - y)[mask] ** 2).mean())
    assert psnr(x, y, mask) == pytest.approx(inside)
    z = np.where(mask[..., None], y, 1 - y)
    assert psnr(x, z, mask) == pytest.approx(inside) and psnr(x, z) < inside
    soft = np.where(mask, 0.5, 0.0)
    assert psnr(x, y, soft) == pytest.approx(inside)
    assert math.isnan(psnr(x, y, np.zeros_like(mask)))


def scikit_ssim(x, y):
    """scikit-image: structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)."""

    def mean(a):
        return np.stack([gaussian_filter(a[..., c], 1.5, truncate=3.5) for c in range(3)], -1)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    s = ((2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)) / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))
    return s[5:-5, 5:-5]


def test_ssim_is_scikit_images():
    x, y = pair()
    assert ssim(x, y) == pytest.approx(scikit_ssim(x, y).mean(), abs=1e-12)
    assert 0.3 < ssim(x, y) < 0.95 and ssim(x, x) == pytest.approx(1) and ssim(x, y) == pytest.approx(ssim(y, x))
    mask = np.zeros((40, 50), bool)
    mask[10:30, 5:20] = True
    assert ssim(x, y, mask) == pytest.approx(scikit_ssim(x, y)[mask[5:-5, 5:-5]].mean(), abs=1e-12)
    with pytest.raises(ValueError, match="image"):
        ssim(x[:10], y[:10])


def test_scores_of_a_frame_and_their_mean():
    x, y = pair()
    mask = np.zeros((40, 50))
    mask[10:30, 5:20] = 1
    full = score_image(x, y, mask)
    assert full["mask_psnr"] == psnr(x, y, mask) and full["mask_ssim"] == ssim(x, y, mask)
    assert math.isnan(full["lpips"])
    tiny = np.zeros((40, 50))
    tiny[12:15, 12:15] = 1
    rest = score_image(x, y, tiny)
    assert math.isnan(rest["mask_psnr"]) and rest["psnr"] == full["psnr"]
    mean = evaluate.mean_scores([full, {**rest, "psnr": full["psnr"] + 2}])
    assert mean["psnr"] == pytest.approx(full["psnr"] + 1) and mean["mask_psnr"] == full["mask_psnr"]
    assert math.isnan(mean["lpips"])
    for wrong in ((x[..., 0], y[..., 0]), (x, y[:-1]), (x, y, mask[:-1])):
        with pytest.raises(ValueError, match=r"image|mask"):
            psnr(*wrong)


def rigid(n=30, frames=41, seed=0):
    """A cloud that turns and travels as one: (N,T,3)."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.linspace(0, 2, frames)[:, None] * [0.3, 1.0, -0.5]).as_matrix()
    return np.einsum("tij,nj->nti", turn, rng.normal(size=(n, 3))) + np.linspace(0, 5, frames)[:, None] * [1, 0.2, 0]


def test_coherence_is_zero_for_rigid_motion_and_measures_growth():
    tracks = rigid()
    assert coherence(tracks) == pytest.approx(0, abs=1e-12)
    # a line of points, 1 apart, that grows steadily by a fifth until the end: |change| is mean |t - middle| = 1/20
    points = np.arange(50.0)[:, None] * [1, 0, 0]
    growth = 1 + 0.2 * np.linspace(-0.5, 0.5, 41)
    line = points[:, None] * growth[:, None]
    expected = 0.2 * np.abs(np.linspace(-0.5, 0.5, 41)).mean()
    assert coherence(line, neighbours=2) == pytest.approx(expected)
    assert coherence(1000 * line, neighbours=2) == pytest.approx(1000 * expected)
    assert coherence(line, neighbours=2, moment=0) > 1.5 * expected
    with pytest.raises(ValueError, match="tracks"):
        coherence(tracks[:3])


def test_coherence_of_a_scene_is_that_of_its_windows_in_pixels_without_what_is_faint():
    points = np.random.default_rng(0).normal(size=(30, 1, 3))
    faint = np.arange(30) >= 20

    def tracks(times):
        grown = points * (1 + 0.1 * np.asarray(times)[None, :, None])
        return np.where(faint[:, None, None], 50 * grown, grown)

    opacities = torch.tensor(np.where(faint, 0.05, 0.9), requires_grad=True)
    dynamic = SimpleNamespace(opacities=opacities)
    scene = SimpleNamespace(span=(0.0, 95 / 30), frame_step=1 / 30, footprint=0.02, dynamic=dynamic, tracks=tracks)
    times = np.arange(95) / 30
    windows = [coherence(tracks(times[k : k + 48])[~faint]) for k in (0,)]  # what is left is shorter than a window
    assert coherence_of(scene) == pytest.approx(windows[0] / 0.02)
    halves = [coherence(tracks(times[k : k + 24])[~faint]) for k in (0, 24, 48)]
    assert coherence_of(scene, 24 / 30) == pytest.approx(np.mean(halves) / 0.02)
    assert coherence_of(SimpleNamespace(**{**vars(scene), "span": (0.0, 1 / 30)})) is None
    nothing = SimpleNamespace(opacities=torch.full((30,), 0.01))
    assert coherence_of(SimpleNamespace(**{**vars(scene), "dynamic": nothing})) is None


def test_following_error_is_what_the_tracks_drift_by():
    tracks = np.random.default_rng(0).normal(size=(200, 1, 3)) + np.linspace(0, 3, 41)[:, None] * [1, 0, 0]
    held = tracks[::10] + 0.01
    exact = following_error(held, tracks, reach=1.0)
    assert all(f.median == pytest.approx(0, abs=1e-12) and f.count > 0 for f in exact.values())
    # held-out points that run away by 0.01 a frame
    drift = held + 0.01 * np.arange(41)[:, None] * [0, 1, 0]
    found = following_error(drift, tracks, reach=1.0, every=1, horizons=(5, 10))
    assert found[10].median == pytest.approx(0.1) and found[5].p90 == pytest.approx(0.05)
    gaps = held.copy()
    gaps[:, 20:] = np.nan
    assert following_error(gaps, tracks, 1.0)[10].count < exact[10].count
    none = following_error(held + 100, tracks, reach=1.0)
    assert none[20].count == 0 and math.isnan(none[20].median)
    assert following_error(held[:, :8], tracks[:, :8], 1.0)[10].count == 0
    with pytest.raises(ValueError, match="held_out"):
        following_error(held, tracks[:, :5], 1.0)


def test_acceleration_of_a_parabola():
    t = np.arange(30.0)[:, None]
    tracks = np.zeros((4, 1, 3)) + t * [1, 2, 3] + 0.5 * t**2 * [0.3, 0, 0.4]
    assert acceleration(tracks) == pytest.approx(0.5)
    assert math.isnan(acceleration(tracks[:, :2]))


def test_without_weights_there_is_no_lpips_and_the_table_says_why():
    absent = Lpips.load(None)
    x, y = (torch.from_numpy(a) for a in pair(64, 64))
    assert math.isnan(absent(x, y)) and absent.reason == "no weights given"
    rows = [{"scene": "tennis", "setting": "unsynchronised", "psnr": 28.126, "lpips": absent(x, y), "mask_psnr": 25.0}]
    text = paper_table.view_table(rows, lpips_reason=absent.reason)
    lines = [line.split() for line in text.splitlines()]
    assert ["tennis", "PSNR", "26.41", "27.30", "–", "23.14", "26.32", "28.13"] in lines
    assert ["tennis", "LPIPS", "0.173", "0.142", "–", "0.161", "0.163", "–"] in lines
    assert text.endswith("LPIPS: no weights given.")


def test_lpips_refuses_what_are_no_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "torchvision" else True)
    assert Lpips.load("somewhere").reason == "no torchvision"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    with pytest.raises(ValueError, match="none"):
        Lpips.load(tmp_path / "absent.pth")
    (tmp_path / "text.pth").write_text("hello")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({"a": print}, tmp_path / "code.pth")
    for name in ("text.pth", "list.pth", "code.pth"):
        with pytest.raises(ValueError, match=f"{name}.*state dict"):
            Lpips.load(tmp_path / name)


def test_lpips_is_its_definition(tmp_path, monkeypatch):
    try:
        import torchmetrics.functional.image.lpips  # noqa: F401
        import torchvision.models as models
    except (ImportError, RuntimeError, OSError):
        pytest.skip("needs torchmetrics and a torchvision that fits the torch that is there")
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", None)  # nothing may be fetched
    torch.manual_seed(0)
    backbone = models.alexnet(weights=None)
    torch.save(backbone.state_dict(), tmp_path / "alexnet.pth")
    lpips = Lpips.load(tmp_path / "alexnet.pth")
    x, y = (torch.from_numpy(a).float() for a in pair(80, 96))
    heads = [dict(lpips.network.named_parameters())[f"lin{i}.model.1.weight"] for i in range(5)]
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    expected = 0.0
    a, b = ((((2 * t - 1) - shift) / scale).movedim(-1, 0)[None] for t in (x, y))
    with torch.no_grad():
        for i, layer in enumerate(backbone.eval().features):
            a, b = layer(a), layer(b)
            if i in (1, 4, 7, 9, 11):
                f, g = (t / (t.square().sum(1, keepdim=True) + 1e-8).sqrt() for t in (a, b))
                expected += float((heads[(1, 4, 7, 9, 11).index(i)] * (f - g) ** 2).sum(1).mean())
    assert lpips(x, y) == pytest.approx(expected, rel=1e-4) and lpips.reason == ""
    assert lpips(x, x) == 0 and math.isnan(lpips(x[:40], y[:40]))
    with pytest.raises(ValueError, match="vgg"):
        Lpips.load(tmp_path / "alexnet.pth", "vgg")


def test_the_papers_figures_are_whole():
    refined = [row[3] for scene, row in paper_table.OFFSETS.items() if scene != "average"]
    coarse = [row[2] for scene, row in paper_table.OFFSETS.items() if scene != "average"]
    assert np.mean(refined) == pytest.approx(paper_table.OFFSETS["average"][3], abs=5e-4)
    assert np.mean(coarse) == pytest.approx(paper_table.OFFSETS["average"][2], abs=2e-3)
    panoptic = ("boxes", "juggle", "softball", "tennis", "basketball", "football")
    assert np.mean([paper_table.VIEWS[s]["PSNR"][3] for s in panoptic]) == pytest.approx(26.3, abs=0.05)  # the abstract
    assert paper_table.ABLATION["full"] == tuple(paper_table.VIEWS["tennis"][k][1] for k in ("PSNR", "SSIM", "LPIPS"))


def test_tables_have_the_papers_layout():
    offsets = paper_table.offset_table(
        [{"scene": "basketball", "initial": 0.563, "refined": 0.01, "refined_max": 0.035}]
    )
    assert offsets.splitlines()[1].split() == [
        "basketball",
        "13.355",
        "13.416",
        "9.689",
        "0.260",
        "0.563",
        "–",
        "0.010",
        "0.035",
    ]
    ours = {"variant": "w/o scaffold", "psnr": 29.84, "coherence": 3.19}
    ablation = paper_table.ablation_table([ours, {"variant": "2 cameras"}], "markdown").splitlines()
    assert len({line.count("|") for line in ablation}) == 1
    assert [c.strip() for c in ablation[2].split("|")[1:6]] == ["w/o scaffold", "23.21", "0.724", "0.198", "29.84"]
    assert set(ablation[1]) <= set("|-: ") and len({len(line) for line in ablation}) == 1
    own = paper_table.view_table([{"scene": "kitchen", "setting": "true time", "psnr": 30.0}])
    assert own.splitlines()[1].split() == ["kitchen", "PSNR", "–", "–", "30.00", "–", "–", "–"]
    with pytest.raises(ValueError, match="style"):
        paper_table.layout(["a"], [["b"]], "html")
