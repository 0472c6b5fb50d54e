"""POT is loaded with as little beside it as it was told to, and nothing that others need is lost."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from otsync.compute.pot import ALONE
from tests.docs.pages import ROOT

LOADS = """
import sys
from otsync.compute.pot import pot
assert pot() is pot() and pot().__name__ == "ot"
print("sklearn" in sys.modules)
import sklearn.cluster  # whoever needs it finds it
"""


@pytest.mark.parametrize("alone", [True, False])
def test_pot_without_scikit_learn(alone):
    pytest.importorskip("sklearn")
    environment = {name: value for name, value in os.environ.items() if name != ALONE} | ({ALONE: "1"} if alone else {})
    run = subprocess.run(
        [sys.executable, "-c", LOADS], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == str(not alone)
