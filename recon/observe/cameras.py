"""What each video's camera sees of a scene: moving Gaussians over a cached background, or everything together.

A fixed camera whose background is known is rendered without the static Gaussians: only what moves is drawn, in the box
where it may be, and blended over the background. That is exact where nothing static stands in front of what moves, and
saves most of the work. A camera that moves renders static and moving Gaussians together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from recon.footage.footage import Footage
from recon.observe.effects import ImageCircle, Observe, Rendered, Shot
from recon.raster import Rendering, render, sh
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D, join

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Clip:
    """One video's footage, ready for torch: the pixels stay uint8 and are converted box by box."""

    footage: Footage
    images: Tensor
    masks: Tensor | None
    background: Tensor | None
    K: Tensor
    w2c: Tensor

    @classmethod
    def of(cls, footage: Footage, device: torch.device | str = "cpu") -> Clip:
        def put(array: np.ndarray | None, dtype: torch.dtype | None = None) -> Tensor | None:
            return None if array is None else torch.as_tensor(array, dtype=dtype).to(device)

        images, K = put(footage.images), put(footage.K, torch.float32)
        w2c = put(footage.w2c, torch.float32)
        assert images is not None and K is not None and w2c is not None
        background = None if footage.background is None else put(footage.background, torch.float32)
        return cls(
            footage,
            images,
            put(footage.masks),
            None if background is None else background / 255,
            K,
            w2c.reshape(-1, 4, 4),
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in working pixels."""
        return int(self.images.shape[2]), int(self.images.shape[1])

    @cached_property
    def circle(self) -> ImageCircle:
        """Where the middle of its images is."""
        return ImageCircle.of(self.footage.K, self.size)

    def box(self, frame: int) -> Box:
        """(x0, y0, x1, y1) of the part of a frame where something may move."""
        x0, y0, x1, y1 = (int(x) for x in self.footage.boxes[frame])
        return x0, y0, x1, y1

    def image(self, frame: int, box: Box) -> Tensor:
        """The frame's pixels [h,w,3] in ``box``, 0..1."""
        x0, y0, x1, y1 = box
        return self.images[frame, y0:y1, x0:x1].to(torch.float32) / 255

    def mask(self, frame: int, box: Box) -> Tensor | None:
        """The foreground [h,w] in ``box``, 0..1; None where no masks are known."""
        if self.masks is None:
            return None
        x0, y0, x1, y1 = box
        return self.masks[frame, y0:y1, x0:x1].to(torch.float32) / 255

    def behind(self, box: Box) -> Tensor | None:
        """The cached background [h,w,3] in ``box``; None for a camera that renders everything together."""
        if self.background is None:
            return None
        x0, y0, x1, y1 = box
        return self.background[y0:y1, x0:x1]

    def pose(self, frame: int, later: float = 0.0) -> Tensor:
        """w2c [4,4] of a frame, or ``later`` seconds after it on the own clock."""
        if len(self.w2c) > 1 and later != 0:
            return torch.as_tensor(self.footage.pose_after(frame, later)).to(self.w2c)
        return self.w2c[frame if len(self.w2c) > 1 else 0]

    def view(self, frame: int, box: Box, later: float = 0.0) -> tuple[Tensor, Tensor]:
        """(w2c [1,4,4], K [1,3,3]) of a frame, for an image that begins at the box's corner."""
        K = self.K.clone()
        K[0, 2] -= box[0]
        K[1, 2] -= box[1]
        return self.pose(frame, later)[None], K[None]


def observer(
    scene: Gaussians4D,
    clips: Sequence[Clip],
    clocks: Tensor | None = None,
    *,
    depth: bool = False,
    probes: list[tuple[Tensor, Tensor]] | None = None,
) -> Observe:
    """How the clips' cameras see ``scene``, before any effect.

    Args:
        clocks: (V,) offsets in seconds, for a scaffold per video.
        depth: whether losses ask for depth.
        probes: receives (2-D means, radii) of the dynamic Gaussians of every rendering, for densification.
    """

    def observe(shot: Shot) -> Rendered:
        clip = clips[shot.video]
        moving = scene.moving(shot.t, clocks)
        w2c, K = clip.view(shot.frame, shot.box, shot.later)
        together = clip.background is None and scene.static is not None
        n = len(moving)
        drawn = join(moving, scene.static) if together and scene.static is not None else moving
        colors = colours(drawn, w2c)
        if together:  # a fourth channel tells how much of a pixel is covered by what moves
            share = torch.zeros(len(drawn), 1, dtype=colors.dtype, device=colors.device)
            share[:n] = 1
            colors = torch.cat([colors, share.expand(*colors.shape[:-1], 1)], -1)
        x0, y0, x1, y1 = shot.box
        near = scene.near if together else scene.moving_near
        out = draw(drawn, w2c, K, (x1 - x0, y1 - y0), near, colors=colors, depth="expected" if depth else None)
        if probes is not None:
            probes.append((out.means2d, out.radii))
        rgb = out.colors[0]
        z = None if out.depths is None else out.depths[0]
        if together:
            return Rendered(rgb[..., :3], rgb[..., 3:], z)
        return Rendered(rgb, out.alphas[0], z)

    return observe


def observer_at_once(
    scene: Gaussians4D,
    clips: Sequence[Clip],
    shots: Sequence[Shot],
    clocks: Tensor | None = None,
    *,
    depth: bool = False,
    probes: list[tuple[Tensor, Tensor]] | None = None,
) -> Observe:
    """As :func:`observer`, for these shots alone: one rendering of all keeps a GPU busy.

    Moving Gaussians only: for clips with a background, or scenes without a static part. The images are as large as the
    largest box and are cut; a splat that begins beyond its own box, where the projection stops following it, may be
    shaped a little differently.
    """
    g, views = scene.dynamic, [clips[s.video].view(s.frame, s.box, s.later) for s in shots]
    w2c, K = torch.cat([w for w, _ in views]), torch.cat([k for _, k in views])
    means, quats = scene.motion.warp(g.means, g.quats, torch.stack([s.t for s in shots]), clocks)
    means, quats = means.expand(len(shots), -1, -1), quats.expand(len(shots), -1, -1)
    sizes = [(s.box[2] - s.box[0], s.box[3] - s.box[1]) for s in shots]
    out = render(
        means,
        quats,
        g.scales,
        g.opacities,
        colours(g, w2c, means),
        w2c,
        K,
        max(w for w, _ in sizes),
        max(h for _, h in sizes),
        near_plane=scene.moving_near,
        depth="expected" if depth else None,
    )
    if probes is not None:
        probes.append((out.means2d, out.radii))
    parts = (out.colors, out.alphas, *([] if out.depths is None else [out.depths]))
    cut = {s: Rendered(*(x[i, :h, :w] for x in parts)) for i, (s, (w, h)) in enumerate(zip(shots, sizes, strict=True))}
    return cut.__getitem__


def feature_image(scene: Gaussians4D, clip: Clip, frame: int, t: Tensor, box: Box, clocks: Tensor | None) -> Tensor:
    """The moving Gaussians' features [h,w,C] as a frame shows them, weighted by alpha; no effect touches them."""
    assert scene.features is not None
    moving = scene.moving(t, clocks)
    w2c, K = clip.view(frame, box)
    parts = (moving.means, moving.quats, moving.scales, moving.opacities, scene.features)
    size = (box[2] - box[0], box[3] - box[1])
    return render(*parts, w2c, K, *size, near_plane=scene.moving_near, depth=None).colors[0]


def draw(
    gaussians: Gaussians,
    w2c: Tensor,
    K: Tensor,
    size: tuple[int, int],
    near: float,
    *,
    colors: Tensor | None = None,
    depth: Literal["expected", "accumulated"] | None = None,
) -> Rendering:
    """Gaussians as cameras w2c [C,4,4], K [C,3,3] see them, images of ``size`` (width, height).

    Args:
        near: near plane, world units.
        colors: channels to draw instead of the Gaussians' own colours.
    """
    colors = colours(gaussians, w2c) if colors is None else colors
    splats = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
    return render(*splats, w2c, K, *size, near_plane=near, depth=depth)


def colours(gaussians: Gaussians, w2c: Tensor, means: Tensor | None = None) -> Tensor:
    """Colours [N,3], or [C,N,3] where they depend on the view; means [C,N,3]: where each of the C cameras sees them."""
    if gaussians.sh_degree == 0:
        return (sh.C0 * gaussians.sh[:, 0] + 0.5).clamp_min(0)
    return sh.view_colors(gaussians.sh_degree, gaussians.means if means is None else means, gaussians.sh, w2c)


def compose_over(rendered: Rendered, background: Tensor | None) -> Tensor:
    """The image [h,w,3]: what was rendered over the cached background, where there is one."""
    return rendered.rgb if background is None else rendered.rgb + (1 - rendered.alpha) * background
