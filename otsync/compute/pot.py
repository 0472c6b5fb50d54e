"""POT, loaded with as little beside it as it was told to."""

from __future__ import annotations

import os
import sys
from typing import Any

ALONE = "POT_BACKEND_DISABLE_PYTORCH"
"""Set where POT is to load no tensor library: the commands set it."""


def pot() -> Any:
    """The module ``ot``. Told to load no tensor library, it loads no scikit-learn either, which only its clusterings
    ask for: 60 MB, and a third of a second.
    """
    if "ot" in sys.modules or "sklearn" in sys.modules or not os.environ.get(ALONE):
        import ot

        return ot
    sys.modules["sklearn"] = None  # type: ignore[assignment]  # what Python takes for a package that is not installed
    try:
        import ot
    finally:
        del sys.modules["sklearn"]
    return ot
