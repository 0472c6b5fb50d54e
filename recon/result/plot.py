"""A result as a notebook shows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from otsync.types.drawing import plain


def moments_figure(name: str, times: Sequence[float], images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> Any:
    """Pictures of one camera at world seconds ``times``, side by side; the matplotlib figure."""
    from matplotlib import pyplot

    size = 2.6 * len(images), 2.1
    figure, axes = pyplot.subplots(1, len(images), figsize=size, layout="constrained", squeeze=False)
    for ax, t, image in zip(axes[0], times, images, strict=True):
        ax.imshow(image)
        ax.set_title(f"{t:.3f} s", fontsize=8)
        ax.set_axis_off()
    figure.suptitle(name, fontsize=9)
    plain(figure)
    return figure
