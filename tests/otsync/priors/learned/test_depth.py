"""Depth estimators of transformers on tiny random checkpoints: shapes, batches, tiles, devices, and what is missing."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otsync.priors import DEPTHS
from otsync.priors.learned import DepthAnything2, TransformersDepth
from otsync.priors.learned.depth import Estimator, agreeing
from otsync.priors.learned.tiles import positions
from otsync.priors.slots import cache_key
from otsync.recordings.stages import Stages, stages_from

from .checkpoints import KINDS, saved
from .test_learned import picture

SQUARE = {"dpt": 64, "depth_pro": 128}
"""Kinds that see images of one size alone, and its side."""

STRIDES = {"depth_anything": 14, "depth_anything_metric": 14, "dpt_on_dinov2": 14, "glpn": 32, "zoedepth": 16}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Any) -> Any:
    """The folder of a kind's checkpoint, made when it is asked for."""
    home, made = tmp_path_factory.mktemp("estimators"), {}

    def of(kind: str) -> str:
        if kind not in made:
            made[kind] = str(saved(kind, home))
        return made[kind]

    return of


def prior(folder: Any, kind: str, **fields: Any) -> TransformersDepth:
    size = {} if kind in SQUARE else {"tile": 112}
    return TransformersDepth(model=folder(kind), device="cpu", **{**size, **fields})


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_gives_maps_of_the_seen_size_and_says_what_they_are(kind, folder):
    estimator = prior(folder, kind)
    maps = estimator([picture(), picture(seed=1), picture()])
    if kind in SQUARE:
        assert maps.shape == (3, SQUARE[kind], SQUARE[kind])
    else:
        assert maps.shape == (3, *(round(n / STRIDES[kind]) * STRIDES[kind] for n in (63, 112)))
    assert maps.dtype == np.float32 and np.isfinite(maps).all()
    assert estimator.gives == KINDS[kind][1]
    assert np.abs(maps[0] - maps[1]).max() > 1e-4  # it depends on the picture
    np.testing.assert_allclose(maps[0], maps[2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("detail", [1.0, 2.0])
def test_batches_give_what_single_images_give(kind, detail, folder):
    images = [picture(seed=k) for k in range(3)]
    one, many = (prior(folder, kind, detail=detail, batch=n)(images) for n in (1, 3))
    # tiles of a random network are hardly alike: what brings one to the whole repeats the last bits magnified
    last = 1e-3 if detail == 1 else 0.02
    np.testing.assert_allclose(one, many, rtol=last, atol=last * np.abs(one).max())
    alone = prior(folder, kind, detail=detail)([images[2]])[0]
    np.testing.assert_allclose(one[2], alone, rtol=1e-4, atol=1e-4 * np.abs(one).max())


@dataclass(frozen=True)
class Moody(TransformersDepth):
    """An estimator that looks at single pixels; what it says of each image, and of each tile, has a scale (and a shift)
    of its own."""

    def loaded(self) -> Estimator:
        count = iter(range(100_000))

        def run(batch: np.ndarray) -> np.ndarray:
            moods = np.random.default_rng([next(count)]).uniform(0.5, 2, (2, len(batch), 1, 1))
            d = 3 + batch.mean(-1)
            return (moods[0] * d + (10 * moods[1] if self.output == "relative" else 0)).astype(np.float32)

        return Estimator(Path(), run, None, 8, None, (0.5,) * 3, (0.5,) * 3, "moody")


@pytest.mark.parametrize("output", ["relative", "inverse", "depth"])
@pytest.mark.parametrize("batch", [1, 4])
def test_a_tiles_border_shows_no_seam_though_every_tile_has_a_scale_of_its_own(output, batch):
    image = picture(180, 320)
    whole = Moody(output=output, tile=320)([image])[0]
    parts = Moody(output=output, tile=160, detail=2, batch=batch)([image])[0]
    assert parts.shape == whole.shape
    # both up to a scale (and shift) of their own
    A = np.stack([whole.ravel(), np.ones(whole.size)], 1)
    left = parts.ravel() - A @ np.linalg.lstsq(A, parts.ravel(), rcond=None)[0]
    assert np.abs(left).max() < 0.05 * np.ptp(parts)
    steps = np.abs(np.diff(left.reshape(parts.shape), axis=1))
    assert steps.max() < 0.01 * np.ptp(parts)  # tiles as they come would step by half of it and more


@pytest.mark.parametrize("kind", ["depth_anything", "zoedepth"])
def test_tiles_of_a_network_show_no_seam(kind, folder):
    found = prior(folder, kind, detail=3.0)([picture(90, 160)])[0]
    assert max(found.shape) == 336
    steps = np.abs(np.diff(found, axis=1)).mean(0)
    begins = positions(336, 112, 28, 1)
    borders = np.unique([b - 1 for begin in begins for b in (begin, begin + 112) if 0 < b < 336])
    assert len(borders) == 2 * len(begins) - 2
    # a seam would be a step at a border that the picture has nowhere else
    assert steps[borders].max() <= np.delete(steps, borders).max()


def test_a_tile_that_contradicts_the_whole_is_not_used():
    like = np.linspace(1, 2, 400).reshape(20, 20).astype(np.float32)
    np.testing.assert_allclose(agreeing(5 * like + 3, like, True), like, rtol=1e-4)
    np.testing.assert_allclose(agreeing(5 * like, like, False), like, rtol=1e-4)
    np.testing.assert_array_equal(agreeing(-like, like, True), like)
    np.testing.assert_array_equal(agreeing(np.full_like(like, np.nan), like, True), like)


def test_devices_and_numbers_are_chosen_and_wrong_ones_refused(folder):
    exact = prior(folder, "depth_anything")([picture()])
    coarse = prior(folder, "depth_anything", dtype="bfloat16")([picture()])
    assert coarse.dtype == np.float32 and 0 < np.abs(exact - coarse).mean() < 0.1 * np.ptp(exact)
    with pytest.raises(ValueError, match="dtype: expected one of float32"):
        prior(folder, "depth_anything", dtype="float8")([picture()])
    with pytest.raises(ValueError, match="device: expected auto"):
        TransformersDepth(model=folder("depth_anything"), device="gpu7")([picture()])


def test_a_graphics_card_gives_what_the_processor_gives(folder):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no graphics card")
    here, there = (
        TransformersDepth(model=folder("depth_anything"), tile=112, device=d)([picture()]) for d in ("cpu", "cuda")
    )
    np.testing.assert_allclose(here, there, atol=0.02 * np.ptp(here))


def test_results_are_kept_by_the_content_of_the_weights(folder, tmp_path, monkeypatch):
    import shutil

    shutil.copytree(folder("dpt"), tmp_path / "elsewhere")
    a, b = TransformersDepth(model=folder("dpt")), TransformersDepth(model=str(tmp_path / "elsewhere"), batch=3)
    assert cache_key(a) == cache_key(b) != cache_key(TransformersDepth(model=folder("glpn")))
    assert cache_key(a) != cache_key(TransformersDepth(model=folder("dpt"), detail=2.0))
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(Path(folder("dpt")).parent))
    assert cache_key(TransformersDepth(model="dpt")) == cache_key(a)


def test_what_a_model_does_not_tell_is_asked_for(folder, tmp_path):
    transformers = pytest.importorskip("transformers")
    config = transformers.PromptDepthAnythingConfig(
        backbone_config=transformers.Dinov2Config(
            hidden_size=32,
            num_hidden_layers=4,
            num_attention_heads=2,
            image_size=56,
            patch_size=14,
            out_indices=[1, 2, 3, 4],
            reshape_hidden_states=False,
        ),
        reassemble_hidden_size=32,
        neck_hidden_sizes=[8, 8, 16, 16],
        fusion_hidden_size=16,
        head_hidden_size=8,
        patch_size=14,
    )
    transformers.PromptDepthAnythingForDepthEstimation(config).save_pretrained(tmp_path / "prompted")
    with pytest.raises(ValueError, match=r"output: expected relative, inverse or depth.*prompt_depth_anything"):
        _ = TransformersDepth(model=str(tmp_path / "prompted")).gives
    named = TransformersDepth(model=str(tmp_path / "prompted"), output="relative", tile=112)
    assert named.gives == "relative" and named([picture()]).shape == (1, 56, 112)


def test_a_model_of_one_size_refuses_another(folder):
    with pytest.raises(ValueError, match=r"tile: expected none for .*which sees 64 x 64 pixels; found 112"):
        TransformersDepth(model=folder("dpt"), tile=112)([picture()])


@pytest.mark.parametrize("wrong", [{"tile": 8}, {"batch": 0}, {"detail": 0.5}, {"overlap": 1.0}, {"output": "metres"}])
def test_sizes_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TransformersDepth(**wrong)


def test_missing_and_foreign_weights_say_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(tmp_path))
    pytest.importorskip("torch")
    with pytest.raises(
        FileNotFoundError, match=r"depth: DepthAnything2: expected weights at .*depth-anything-v2-small"
    ):
        DepthAnything2().loaded()
    pytest.importorskip("transformers")
    (tmp_path / "depth-anything-v2-small").mkdir()
    (tmp_path / "depth-anything-v2-small/config.json").write_text('{"model_type": "vit"}')
    with pytest.raises(ValueError, match=r"expected a depth estimator of transformers.*save_pretrained"):
        DepthAnything2().loaded()


def test_missing_packages_name_the_extra(monkeypatch, tmp_path):
    pytest.importorskip("torch")
    (tmp_path / "weights").mkdir()
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'otsync\[learned\]'"):
        TransformersDepth(model=str(tmp_path / "weights")).loaded()


def test_the_shell_runs_them_and_says_what_nothing_ties(folder, tmp_path, capsys):
    """A random network tells no depth that the poses agree with: it is named, and the other route answers."""
    from otsync.cli import main
    from tests.recording_world import write_recording

    write_recording(tmp_path / "recording", [0.0, 3.0], frames=40)
    command = ["sync", str(tmp_path / "recording"), "--out", str(tmp_path / "out"), "--recording.depth"]
    estimator = f"transformers-depth:model={folder('depth_anything')},tile=112,batch=8,device=cpu"
    assert main([*command, estimator]) in (0, 1)
    written = json.loads((tmp_path / "out/sync.json").read_text())
    assert written["route"] == "epipolar" and "depth" in written["seconds"]
    assert any("is not tied to the poses" in line for line in written["why"])
    capsys.readouterr()
    assert main([*command, estimator, "--recording.route", "tracks", "--out", str(tmp_path / "o")]) == 2
    assert "route tracks: estimated depth of" in capsys.readouterr().err


def test_the_shell_refuses_what_would_not_be_read(tmp_path, capsys, monkeypatch):
    from otsync.cli import main
    from tests.recording_world import write_recording

    monkeypatch.setenv("OTSYNC_WEIGHTS", str(tmp_path / "nowhere"))
    write_recording(tmp_path / "recording", [0.0, 3.0], frames=6)
    command = ["sync", str(tmp_path / "recording"), "--out", str(tmp_path / "out"), "--recording.depth"]
    for more, says in (
        (["depth-anything2", "--recording.route", "epipolar"], "--recording.depth: expected a route that reads it"),
        (["depth-anything2", "--frames", "own"], "--depth: a recording with --frames own, without poses"),
        (["depth-anything9"], "--depth: expected some of"),
        (["depth-anything2:tile=few"], "tile"),
        (["depth-anything2"], "nowhere"),
    ):
        assert main([*command, *more]) == 2, more
        assert says in capsys.readouterr().err.replace("\n", " "), more


def test_the_shell_offers_them_by_name():
    assert {TransformersDepth, DepthAnything2} <= set(DEPTHS)
    assert Stages().depth is None
    chosen = stages_from(depth="transformers-depth:model=mine,output=depth,detail=2").depth
    assert chosen == TransformersDepth(model="mine", output="depth", detail=2)
    with pytest.raises(ValueError, match=r"--depth: expected some of .*transformers-depth"):
        stages_from(depth="nothing")
