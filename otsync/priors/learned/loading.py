"""Weights and packages of learned priors: found here, or refused with what to install and where to put the file.

Nothing is downloaded. Weights are data: safetensors, ONNX, and PyTorch's files without pickled objects.
"""

from __future__ import annotations

import importlib
import os
from functools import cache
from pathlib import Path
from typing import Any

from ...files.digest import content_key

FOLDER = "OTSYNC_WEIGHTS"
"""Variable of the environment with the folder of weights."""

HOME = Path("~/.cache/otsync/weights")
"""The folder where there is no such variable."""


class Missing(ModuleNotFoundError):
    """A package that no extra brings is not there. remedy: what to do, as a sentence."""

    def __init__(self, text: str, name: str, remedy: str):
        super().__init__(f"{text} {remedy}", name=name)
        self.remedy = remedy


def package(name: str, extra: str = "", remedy: str = "") -> Any:
    """The imported package. ModuleNotFoundError says which extra brings it, and its name what is not there.

    ``remedy``: how to install it, where no extra of ours brings it (:class:`Missing`).
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or name).partition(".")[0]
        if remedy:
            raise Missing(f"{name}: expected the package {missing}; not installed.", missing, remedy) from None
        raise ModuleNotFoundError(
            f"{name}: expected the package {missing}; not installed. pip install 'otsync[{extra}]'.", name=missing
        ) from None
    except (RuntimeError, OSError, AttributeError) as error:
        said = " ".join(str(error).split())[:160]
        raise ValueError(
            f"{name}: expected builds of torch and torchvision that fit each other; {said}. Install both "
            "from one index."
        ) from None


def weights(text: str, what: str, where_from: str) -> Path:
    """The file or folder of weights that ``text`` names: a path, or a name in the folder of weights.

    FileNotFoundError says where it was looked for and where the weights come from.
    """
    own = Path(text).expanduser()
    home = Path(os.environ.get(FOLDER) or HOME).expanduser()
    for path in (own, home / text):
        if text and path.exists():
            return path
    raise FileNotFoundError(
        f"{what}: expected weights at {own if own.is_absolute() else home / text}; found none. {where_from} Put them "
        f"there, or name another place (model=PATH), or set {FOLDER}. Nothing is downloaded."
    )


def device_of(text: str) -> str:
    """``auto``: the graphics card where torch sees one, else the processor. ValueError for one that is not there."""
    torch = package("torch", "learned")
    if text == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(text).type
    except RuntimeError:
        kind = ""
    if kind not in ("cpu", "cuda", "mps") or (kind == "cuda" and not torch.cuda.is_available()):
        raise ValueError(f"device: expected auto, cpu or a device that torch sees; found {text!r}. Use auto.")
    return text


def dtype_of(text: str) -> Any:
    """torch's numbers by name. ValueError for others."""
    torch = package("torch", "learned")
    known = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
    if text not in known:
        raise ValueError(f"dtype: expected one of {', '.join(known)}; found {text!r}.")
    return known[text]


def pretrained(kind: str, path: Path, device: str, dtype: str, what: str) -> Any:
    """A model of ``transformers`` from a local folder, of the class ``kind``, ready to answer.

    what: it is, for errors: ValueError names the file and what was expected in it.
    """
    transformers = package("transformers", "learned")
    try:
        model = getattr(transformers, kind).from_pretrained(
            str(path), local_files_only=True, use_safetensors=True, dtype=dtype_of(dtype)
        )
    except (OSError, ValueError, KeyError) as error:
        said = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path}: expected {what} of transformers (config.json and model.safetensors); {said}. Save it with "
            "save_pretrained."
        ) from None
    return model.eval().to(device)


def digest_of(path: Path) -> str:
    """A hash of the content of a file, or of all files of a folder: results are kept by it, not by a name."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return content_key(*(_digest(str(p.resolve()), p.stat().st_size, p.stat().st_mtime_ns) for p in files))


@cache
def _digest(path: str, size: int, changed: int) -> str:
    import hashlib

    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
