"""Compiled code: the process that compiles it and those that load it compute the same."""

from __future__ import annotations

import os
import subprocess
import sys

FLOW = """
import hashlib
import cv2
import numpy as np
from otsync.priors.patch_flow import PatchFlow

noise = np.random.default_rng(0).uniform(0, 255, (90, 120)).astype(np.float32)
first = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
second = cv2.warpAffine(first, np.float32([[1, 0.02, 1.3], [-0.01, 1, 0.7]]), (120, 90))
there, back = PatchFlow().pair(first, second)
print(hashlib.sha256(there.tobytes() + back.tobytes()).hexdigest())
"""


def test_a_first_run_computes_what_later_ones_do(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    told = [
        subprocess.run([sys.executable, "-c", FLOW], env=environment, check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    ]
    assert list(tmp_path.rglob("*.nbc"))
    assert told[0] == told[1]
