"""Tiny random checkpoints of transformers' depth estimators, as ``save_pretrained`` leaves them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

SMALL = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2}
NECK = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 16}


def depth_anything(T: Any, kind: str = "relative") -> Any:
    backbone = T.Dinov2Config(
        **SMALL, image_size=56, patch_size=14, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )
    config = T.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=32,
        head_hidden_size=8,
        patch_size=14,
        depth_estimation_type=kind,
        max_depth=20 if kind == "metric" else 1,
        **NECK,
    )
    return T.DepthAnythingForDepthEstimation(config)


def dpt(T: Any) -> Any:
    config = T.DPTConfig(
        **SMALL, intermediate_size=48, image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3], **NECK
    )
    config.is_hybrid = False
    return T.DPTForDepthEstimation(config)


def dpt_on_dinov2(T: Any) -> Any:
    backbone = T.Dinov2Config(
        **SMALL, image_size=56, patch_size=14, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )
    return T.DPTForDepthEstimation(T.DPTConfig(backbone_config=backbone, hidden_size=32, patch_size=14, **NECK))


def glpn(T: Any) -> Any:
    config = T.GLPNConfig(
        hidden_sizes=[8, 16, 16, 24], depths=[1, 1, 1, 1], num_attention_heads=[1, 2, 2, 2], decoder_hidden_size=16
    )
    return T.GLPNForDepthEstimation(config)


def zoedepth(T: Any) -> Any:
    backbone = T.BeitConfig(
        **SMALL,
        intermediate_size=48,
        image_size=64,
        patch_size=16,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    bins = [{"n_bins": 8, "min_depth": 0.1, "max_depth": 10.0, "name": "room"}]
    config = T.ZoeDepthConfig(
        backbone_config=backbone,
        bottleneck_features=16,
        bin_embedding_dim=8,
        num_relative_features=8,
        bin_configurations=bins,
        num_attractors=[4, 2, 2, 1],
        **NECK,
    )
    return T.ZoeDepthForDepthEstimation(config)


def depth_pro(T: Any) -> Any:
    part = {"model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2}
    part |= {"patch_size": 8, "image_size": 32}
    config = T.DepthProConfig(
        fusion_hidden_size=16,
        patch_size=32,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.25, 0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.5, 0.25],
        scaled_images_feature_dims=[16, 16, 8],
        merge_padding_value=1,
        use_fov_model=False,
        image_model_config=part,
        patch_model_config=part,
        fov_model_config=part,
    )
    return T.DepthProForDepthEstimation(config)


KINDS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "depth_anything": (depth_anything, "relative"),
    "depth_anything_metric": (lambda T: depth_anything(T, "metric"), "depth"),
    "dpt": (dpt, "relative"),
    "dpt_on_dinov2": (dpt_on_dinov2, "relative"),
    "glpn": (glpn, "depth"),
    "zoedepth": (zoedepth, "depth"),
    "depth_pro": (depth_pro, "inverse"),
}
"""What makes a model of a kind, and what its values are."""


def saved(kind: str, home: Path) -> Path:
    """A folder with a checkpoint whose answers depend on the picture; skips without transformers."""
    transformers, torch = pytest.importorskip("transformers"), pytest.importorskip("torch")
    torch.manual_seed(0)
    model = KINDS[kind][0](transformers)
    with torch.no_grad():
        for name, p in model.named_parameters():
            # as drawn, a picture moves the answer by a millionth; the last steps must not be cut off below 0 either
            if p.ndim > 1:
                p.normal_(0, 1.2 * p[0].numel() ** -0.5)
            if name.startswith("head") and name.endswith("bias"):
                p.fill_(0.3)
    model.save_pretrained(home / kind, safe_serialization=True)
    (home / kind / "preprocessor_config.json").write_text(
        json.dumps({"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5], "do_normalize": True})
    )
    return home / kind
