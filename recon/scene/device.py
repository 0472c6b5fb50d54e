"""The device that a fit's tensors live on: the CPU, or a GPU where one is asked for and present."""

from __future__ import annotations

import importlib.util

import torch


def device_of(name: torch.device | str) -> torch.device:
    """The device of this name: "cpu", "cuda", or "cuda:1" for the second GPU.

    ValueError for any other name, for a device that is not there, and for a GPU without a renderer.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None
    # torch takes "cpu:3" for a name, yet tensors put there say that they are on "cpu"
    if device is None or device.type not in ("cpu", "cuda") or (device.type == "cpu" and device.index is not None):
        raise ValueError(f"device: expected 'cpu', 'cuda' or 'cuda:N'; found {str(name)!r}.")
    if device.type == "cpu":
        return device
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) >= count:
        there = ", ".join(["cpu", *(f"cuda:{n}" for n in range(count))])
        remedy = (
            "This build of torch has no CUDA: install one that has, or use 'cpu'."
            if torch.version.cuda is None and torch.version.hip is None
            else "Check the driver and CUDA_VISIBLE_DEVICES, or use 'cpu'."
        )
        raise ValueError(f"device: expected one of {there}; found {str(name)!r}. {remedy}")
    if importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device: expected gsplat, which renders on {str(name)!r}; found none. pip install 'otsync[cuda]', or "
            "use 'cpu'."
        )
    return device
