"""A pretended second device: tensors that compute on the CPU, but must not meet the CPU's own.

torch's "meta" device stands in for a GPU. Every operation there runs on real numbers, so that a whole fit can be held
against the same fit on the CPU, and raises where tensors of two devices meet: stricter than CUDA, which lets a scalar
of the CPU pass. What only a GPU can tell (its kernels, their rounding, races) is not seen here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")
MOVES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class Far(Tensor):
    """A tensor elsewhere; ``near`` holds its numbers."""

    near: Tensor

    @staticmethod
    def __new__(cls, near: Tensor) -> Far:
        layout = {"strides": near.stride(), "storage_offset": near.storage_offset(), "dtype": near.dtype}
        far = Tensor._make_wrapper_subclass(cls, near.shape, device=ELSEWHERE, **layout)
        far.near = near
        return far

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    leaves = tree_leaves((args, kwargs))
    far = [x for x in leaves if isinstance(x, Far)]
    here = [x for x in leaves if isinstance(x, Tensor) and not isinstance(x, Far)]
    if far and here and func not in MOVES:
        raise RuntimeError(
            f"{func}: tensors on two devices, those on the CPU of shapes {[list(x.shape) for x in here]}"
        )
    device = kwargs.get("device")
    stays = bool(far) if device is None else torch.device(device) == ELSEWHERE
    args, kwargs = tree_map(lambda x: x.near if isinstance(x, Far) else x, (args, kwargs))
    out = func(*args, **(kwargs if device is None else {**kwargs, "device": torch.device("cpu")}))
    known = {id(x.near): x for x in far}  # what an operation in place gives back is what it was given

    def named(x: Any) -> Any:
        return x if not isinstance(x, Tensor) else known[id(x)] if id(x) in known else Far(x)

    return tree_map(named, out) if stays else out


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


class _Makers(TorchFunctionMode):
    """What torch makes of Python's numbers without asking a dispatch mode."""

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is Tensor.tolist and isinstance(args[0], Far):
            return args[0].near.tolist()
        if func is Tensor.new_tensor and isinstance(args[0], Far):
            return torch.tensor(args[1], dtype=args[0].dtype).to(ELSEWHERE)
        if (
            func in (torch.tensor, torch.as_tensor)
            and kwargs.get("device") is not None
            and not isinstance(args[0], Far)
        ):
            return func(*args, **{**kwargs, "device": "cpu"}).to(kwargs["device"])
        return func(*args, **kwargs)


@contextmanager
def elsewhere() -> Iterator[torch.device]:
    """Within the block, in its thread, there is a second device."""
    with _Makers(), _Operations():
        yield ELSEWHERE
