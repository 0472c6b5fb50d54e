"""Where a fit's tensors live: on the CPU, or on a GPU that is asked for and there."""

from __future__ import annotations

import importlib.util

import torch


def device_of(name: torch.device | str) -> torch.device:
    """The device of this name: "cpu", "cuda", or "cuda:1" for the second GPU.

    ValueError when it is none of those, is not there, or has nothing to render with.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None
    # "cpu:3" is a name to torch, but no tensor is there: they say that they are on "cpu"
    if device is None or device.type not in ("cpu", "cuda") or (device.type == "cpu" and device.index is not None):
        raise ValueError(f"device: expected 'cpu', 'cuda' or 'cuda:N'; found {str(name)!r}.")
    if device.type == "cpu":
        return device
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) >= count:
        there = ", ".join(["cpu", *(f"cuda:{n}" for n in range(count))])
        remedy = (
            "This build of torch is for the CPU alone: install one for CUDA, or take 'cpu'."
            if torch.version.cuda is None and torch.version.hip is None
            else "Check the driver and CUDA_VISIBLE_DEVICES, or take 'cpu'."
        )
        raise ValueError(f"device: expected one that is there ({there}); found {str(name)!r}. {remedy}")
    if importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device: {str(name)!r} needs gsplat to render there; it is not installed: pip install 'otsync[cuda]', or "
            "take 'cpu'."
        )
    return device
