"""Hashes of what objects hold, the same in every process: no addresses, no order of hashing.

Arrays and tensors count by dtype, shape and bytes, wherever they are; dataclasses by type and fields; other objects by
what a copy of them is made from (Python's copy protocol), which for most is type and attributes. What a module defines
counts by its name; a lambda or an inner function by its code, defaults and what it closes over.
"""

from __future__ import annotations

import copyreg
import dataclasses
import hashlib
import sys
import types
from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np

PLAIN = (type(None), bool, int, float, complex, str, bytes)  # their repr is all there is to them


def content_key(*items: Any) -> str:
    """A hash of the items' contents; lists and tuples are one, as are mappings of any order.

    ValueError names an object whose content cannot be read.
    """
    return _hash(items, ()).hexdigest()


def sequence_key(images: Sequence[Any]) -> str:
    """A hash of a sequence of images: its own ``digest()`` where it has one (lazy frames), else of all their values."""
    digest = getattr(images, "digest", None)
    return digest() if digest is not None else content_key(*[None if f is None else np.asarray(f) for f in images])


def _hash(x: Any, inside: tuple[int, ...]) -> hashlib.blake2b:
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest, x, inside)
    return digest


def _feed(digest: hashlib.blake2b, x: Any, inside: tuple[int, ...]) -> None:
    """Add ``x``; inside: ids of the objects that hold it, from the outermost on."""
    if type(x) in PLAIN:
        return _say(digest, x)
    torch = sys.modules.get("torch")  # whoever has a tensor has loaded it; another thread may be loading it just now
    if torch is not None and hasattr(torch, "Tensor") and isinstance(x, torch.Tensor):
        _say(digest, "tensor", str(x.dtype), tuple(x.shape))
        x = x.detach().cpu().reshape(-1).view(torch.uint8).numpy()  # numpy does not know all of torch's numbers
    if isinstance(x, np.ndarray) and not x.dtype.hasobject:
        _say(digest, "array", x.dtype.str, x.shape)
        return digest.update(np.ascontiguousarray(x).reshape(-1).view(np.uint8).data if x.size else b"")
    if id(x) in inside:
        return _say(digest, "again", inside.index(id(x)))
    inside = (*inside, id(x))
    if isinstance(x, Mapping):
        _say(digest, "mapping", sorted(_hash(pair, inside).hexdigest() for pair in x.items()))
    elif isinstance(x, Set):
        _say(digest, "set", sorted(_hash(item, inside).hexdigest() for item in x))
    elif type(x) in (list, tuple):
        _say(digest, "sequence", len(x))
        for item in x:
            _feed(digest, item, inside)
    else:
        name, *parts = _parts(x)
        _say(digest, "object", name)
        _feed(digest, parts, inside)


def _say(digest: hashlib.blake2b, *words: Any) -> None:
    text = repr(words).encode()
    digest.update(b"%d:" % len(text) + text)


def _parts(x: Any) -> list[Any]:
    """The name of what ``x`` is, and all that tells it from others of that name."""
    if isinstance(x, types.CodeType):
        return ["code", x.co_code, x.co_names, *x.co_consts]
    if isinstance(x, type | types.FunctionType):
        name = f"{x.__module__}.{x.__qualname__}"
        if isinstance(x, type) or _defined_as(name, x):
            return [name]
        return [name, x.__code__, x.__defaults__, x.__kwdefaults__, *(c.cell_contents for c in x.__closure__ or ())]
    name = f"{type(x).__module__}.{type(x).__qualname__}"
    if dataclasses.is_dataclass(x):
        return [name, {f.name: getattr(x, f.name) for f in dataclasses.fields(x)}]
    try:
        reduce = copyreg.dispatch_table.get(type(x))
        made: Any = x.__reduce_ex__(4) if reduce is None else reduce(x)
    except Exception as error:  # whatever a stranger's class raises
        raise ValueError(
            f"{name}: expected an object whose content can be read, to know it again in another process; found "
            f"{type(error).__name__}: {error}. Make it a dataclass, or fit without a checkpoint."
        ) from None
    return [name, made] if isinstance(made, str) else [name, *made[:3], *(list(p) for p in made[3:5] if p is not None)]


def _defined_as(name: str, x: types.FunctionType) -> bool:
    thing: Any = sys.modules.get(x.__module__)
    for part in x.__qualname__.split("."):
        thing = getattr(thing, part, None)
    return thing is x
