"""Hashes of contents: equal for equal contents, in every process; other for every change."""

from __future__ import annotations

import enum
import functools
import math
import os
import subprocess
import sys
import threading
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from otsync.files.digest import content_key
from recon.losses.image import Photometric

ROOT = Path(__file__).parents[3]


class Plain:
    """An object whose repr is its address."""

    def __init__(self, **what):
        self.__dict__ |= what


class Other(Plain):
    pass


class Slotted:
    __slots__ = ("x",)

    def __init__(self, x):
        self.x = x


@dataclass(frozen=True, eq=False, repr=False)
class Fields:
    x: object = 1


class Kind(enum.Enum):
    A = 1
    B = 2


def weighted(factor):
    return lambda x: factor * x


def everything():
    """One of each kind; no two are the same."""
    a = np.arange(6.0).reshape(2, 3)
    layer = torch.nn.Linear(2, 2)
    with torch.no_grad():
        layer.weight.fill_(0.5), layer.bias.zero_()
    return [
        None,
        False,
        0,
        0.0,
        -0.0,
        "0",
        b"0",
        [],
        [0],
        [[0]],
        [0, 0],
        {},
        {0: 1},
        {1: 0},
        {0},
        range(3),
        Path("a"),
        Path("b"),
        a,
        a.T,
        a.astype(np.float32),
        a.reshape(3, 2),
        a + 1,
        a[:0],
        np.float64(1),
        np.array([a, None], object),
        torch.zeros(2),
        torch.zeros(2, dtype=torch.bfloat16),
        torch.zeros(2, 1),
        torch.ones(2),
        torch.float64,
        layer,
        Plain(),
        Plain(x=1),
        Plain(x=a),
        Plain(x=a + 1),
        Plain(x=Plain()),
        Other(x=1),
        Plain(y=1),
        Slotted(1),
        Slotted(2),
        Fields(),
        Fields(2),
        Fields(Plain(x=2)),
        Photometric(),
        Photometric(weight=2.0),
        Kind.A,
        Kind.B,
        Plain,
        Other,
        math.sqrt,
        math.exp,
        np.sin,
        weighted,
        weighted(2.0),
        weighted(3.0),
        lambda x: x,
        lambda x: x + 1,
        functools.partial(weighted, 2.0),
        functools.partial(weighted, 3.0),
        Plain(x=1).__init__,
        np.random.default_rng(3),
        np.random.default_rng(4),
    ]


def test_every_change_is_seen_and_nothing_else():
    keys = [content_key(x) for x in everything()]
    twins = [(i, j) for i in range(len(keys)) for j in range(i) if keys[i] == keys[j]]
    assert not twins
    assert [content_key(x) for x in everything()] == keys


def test_the_order_of_a_mapping_and_the_kind_of_a_sequence_do_not_matter():
    assert content_key({"a": 1, "b": 2}) == content_key({"b": 2, "a": 1})
    assert content_key((1, [2])) == content_key([1, (2,)]) != content_key([1, 2])
    assert content_key(1, 2) != content_key([1, 2])
    a = np.arange(12.0).reshape(3, 4)
    assert content_key(a[:, ::2]) == content_key(a[:, ::2].copy()) == content_key(np.asfortranarray(a[:, ::2]))
    assert content_key(torch.from_numpy(a).requires_grad_()) == content_key(torch.from_numpy(a.copy()))


def test_what_holds_itself_ends():
    ring, longer = Plain(), Plain()
    ring.next, longer.next = ring, Plain()
    longer.next.next = longer
    assert content_key(ring) != content_key(longer) and content_key(ring) == content_key(ring.next)


def test_other_processes_find_the_same():
    code = "from tests.otsync.files.test_digest import *; print(*map(content_key, everything()))"

    def keys(seed: str) -> list[str]:
        env = {**os.environ, "PYTHONHASHSEED": seed}
        return subprocess.run(
            [sys.executable, "-c", code], env=env, cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split()

    assert keys("1") == keys("2") == [content_key(x) for x in everything()]


@pytest.mark.parametrize("x", [threading.Lock(), (i for i in ())], ids=["lock", "generator"])
def test_what_cannot_be_read_is_named(x):
    with pytest.raises(ValueError, match=r"expected an object whose content can be read.*Make it a dataclass"):
        content_key(Plain(inside=[x]))


def test_a_torch_that_another_thread_is_loading_is_no_hindrance(monkeypatch):
    value = {"a": np.arange(3), "b": [1.5, None]}
    expected = content_key(value)
    monkeypatch.setitem(sys.modules, "torch", types.ModuleType("torch"))  # as it is at the beginning of its import
    assert content_key(value) == expected
