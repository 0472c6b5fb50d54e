"""The report of a reconstruction: results, convergence of the fit, and rendered pictures beside filmed ones.

One self-contained HTML file without a script, in the style of the synchronisation report.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from otsync.report.figures import CHOSEN, GREY, axes_of, effort, svg
from otsync.report.frames import inline_image
from otsync.report.page import number, status_words, write_page
from otsync.types import Offsets
from recon.evaluate.views import ViewScore
from recon.fit.verb import History, Reconstruction

SHOWN_VIEWS = 2
"""Cameras with pictures; the table has all."""

PICTURE = 240
"""Width of a picture in pixels: nine of them are about 60 kB."""

HOW = {"given": "as given", "found": "found on the frozen scene", "fitted": "fitted with the scene"}


def write_reconstruction_report(
    path: str | os.PathLike[str],
    reconstruction: Reconstruction,
    coarse: Offsets,
    videos: Sequence[str],
    views: Sequence[ViewScore],
    *,
    seconds: Mapping[str, float] | None = None,
    notes: Sequence[str] = (),
    truth: np.ndarray | None = None,
    lpips_reason: str = "",
    scene_page: str | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        coarse: the offsets that the fit began with, of the same videos as ``reconstruction.offsets``.
        videos: names of those that took part in the fit, in its order.
        views: of held-out cameras, and of training ones to compare with.
        seconds: wall time of every stage. notes: in words, what was missing or assumed.
        truth: (V,) true offsets in seconds relative to the reference, where they are known.
        lpips_reason: why there is no LPIPS; "" where there is.
        scene_page: address of the page that plays the scene, relative to the report; None: no link.
    """
    parts = [
        "<h1>Reconstruction</h1>",
        f"<p>{_verdict(reconstruction, views)}</p>",
        f'<p><a href="{escape(scene_page, quote=True)}">Fly round the scene, in slow motion</a></p>'
        if scene_page
        else "",
        "".join(f"<p class=no>{escape(note)}</p>" for note in notes),
        "<h2>Offsets</h2>",
        _offset_rows(reconstruction, coarse, truth),
        "<p class=s>In frames of the reference. Before: what the fit began with. Moved: without the common shift "
        "of all videos, which images cannot tell. t<sub>world</sub> = rate · t<sub>video</sub> + offset.</p>",
        f"<h2>Convergence</h2><p class=s>{_pace(reconstruction)}</p>",
        convergence(reconstruction, coarse, videos, truth),
        "<h2>Views</h2>",
        _view_rows(views, lpips_reason),
        views_over_time(views) if any(len(v.frames) > 1 for v in views) else "",
        *_pictures(views),
        "<h2>What accuracy cost</h2>",
        "<p class=s>Estimated error of the offsets. The fit's own estimate is a lower bound.</p>",
        effort(seconds or {}, _answers(reconstruction, coarse, seconds or {}), truth),
        "<h2>Numbers</h2>",
        _numbers(reconstruction, seconds or {}),
    ]
    write_page(path, "Reconstruction", parts)


def _answers(reconstruction: Reconstruction, coarse: Offsets, seconds: Mapping[str, float]) -> dict[str, Offsets]:
    """The offsets that there were after a stage: at once where the run began with them."""
    synchronised = [stage for stage in seconds if stage.startswith("synchronise")]
    last = synchronised[-1] if synchronised else ""
    return {last: coarse, "fit": reconstruction.offsets}


def _verdict(reconstruction: Reconstruction, views: Sequence[ViewScore]) -> str:
    held = [v for v in views if v.held_out]
    text = f"<b>{len(reconstruction.offsets)} videos, {len(reconstruction.scene)} moving Gaussians"
    if reconstruction.scene.static is not None:
        text += f", {len(reconstruction.scene.static)} static"
    text += ".</b> "
    if held:
        mean = {
            k: float(np.nanmean([v.mean[k] for v in held]))
            for k in ("psnr", "mask_psnr")
            if not all(np.isnan(v.mean[k]) for v in held)
        }
        text += f"Held-out cameras: {number(mean.get('psnr', np.nan), 2)} dB"
        text += f", {number(mean['mask_psnr'], 2)} dB where things move." if "mask_psnr" in mean else "."
    else:
        text += "No camera was held out: the figures below are of cameras that took part in the fit."
    return text


def _offset_rows(reconstruction: Reconstruction, coarse: Offsets, truth: np.ndarray | None) -> str:
    offsets = reconstruction.offsets
    head = "<th>video<th>before<th>after<th>± sigma<th>moved" + ("<th>true<th>error" if truth is not None else "")
    rows = []
    for v, name in enumerate(offsets.names):
        fps = offsets.fps[offsets.component[v]]
        cells = [coarse.frames[v], offsets.frames[v], offsets.sigma[v] * fps, offsets.frames[v] - coarse.frames[v]]
        if truth is not None:
            cells += [truth[v] * fps, offsets.frames[v] - truth[v] * fps]
        tail = "reference" if v == offsets.reference else status_words(offsets.status[v], offsets.flags[v])
        rows.append(
            f"<tr><td>{escape(name)}" + "".join(f"<td>{number(float(x), 3)}" for x in cells) + f"<td class=t>{tail}"
        )
    return f"<div class=scroll><table><tr>{head}<th class=t>status before the fit{''.join(rows)}</table></div>"


def convergence(
    reconstruction: Reconstruction, coarse: Offsets, videos: Sequence[str], truth: np.ndarray | None = None
) -> str:
    """Left: every camera's offset against steps, relative to the reference. Right: PSNR of the training boxes."""
    history, step = reconstruction.history, reconstruction.scene.frame_step
    figure, (left, right) = axes_of(7.2, 2.7, 2)
    if len(history.step):
        for name, curve, is_reference in offset_curves(history, coarse, videos, truth):
            color = GREY if is_reference else None
            left.plot(history.step, curve / step, lw=1, color=color, label=name)
        left.axhline(0, color="black", lw=0.5)
        left.set(xlabel="step", ylabel="error, frames" if truth is not None else "moved, frames")
        if len(history.offsets.T) <= 12:
            left.legend(fontsize=5, ncols=2)
        known = np.isfinite(history.psnr)
        right.plot(history.step[known], history.psnr[known], color=CHOSEN, lw=1)
        right.set(xlabel="step", ylabel="PSNR of training boxes, dB")
    return svg(figure, "offsets and PSNR over the fit")


def _pace(reconstruction: Reconstruction) -> str:
    # a continued fit has a time for each of its sessions: the longest is about what it took
    seconds = max([reconstruction.stats.get("seconds", 0.0), *reconstruction.history.seconds.tolist()])
    text = f"{reconstruction.stats.get('steps', 0.0):.0f} steps" + (f", {seconds:.1f} s" if seconds >= 0.1 else "")
    return text + ". Left: relative to the reference. Right: mean over the images since the last point."


def offset_curves(
    history: History, coarse: Offsets, videos: Sequence[str], truth: np.ndarray | None
) -> list[tuple[str, np.ndarray, bool]]:
    """(name, (R,) seconds relative to the reference, whether it is the reference) of every fitted video.

    Differences from the truth where it is known, else from where the fit began.
    """
    index = [coarse.names.index(name) for name in videos]
    zero = coarse.seconds if truth is None else truth
    reference = videos.index(coarse.names[coarse.reference]) if coarse.names[coarse.reference] in videos else 0
    moved = history.offsets - zero[index]
    moved = moved - moved[:, [reference]]
    return [(name, moved[:, v], v == reference) for v, name in enumerate(videos)]


def _view_rows(views: Sequence[ViewScore], lpips_reason: str) -> str:
    if not views:
        return "<p class=s>No view was scored.</p>"
    names = {
        "psnr": ("PSNR", 2),
        "ssim": ("SSIM", 4),
        "lpips": ("LPIPS", 4),
        "mask_psnr": ("PSNR, moving", 2),
        "mask_ssim": ("SSIM, moving", 4),
    }
    rows = []
    for v in views:
        cells = "".join(f"<td>{number(v.mean.get(key, np.nan), digits)}" for key, (_, digits) in names.items())
        gain = " ".join(f"{g:.3f}" for g in v.gain)
        role = "held out" if v.held_out else "training"
        rows.append(
            f"<tr><td>{escape(v.name)}<td class=t>{role}{cells}<td>{len(v.frames)}"
            f"<td style='white-space:nowrap'>{gain}<td class=t>{HOW[v.clock.how]}"
        )
    head = "".join(f"<th>{title}" for title, _ in names.values())
    missing = f" LPIPS: {escape(lpips_reason)}." if lpips_reason else ""
    return (
        f"<div class=scroll><table><tr><th>camera<th class=t>role{head}<th>frames<th>gain R G B<th class=t>clock"
        f"{''.join(rows)}</table></div><p class=s>Renderings use none of the cameras' own pictures: they are static "
        f"Gaussians, and over them what moves. The gain is fitted to what is static.{missing}</p>"
    )


def views_over_time(views: Sequence[ViewScore]) -> str:
    """PSNR of every compared frame: the whole image, and where things move (dashed)."""
    figure, ax = axes_of(7.2, 2.3)
    for n, v in enumerate(views):
        color = f"C{n % 10}" if v.held_out else GREY
        for key, style in (("psnr", "-"), ("mask_psnr", "--")):
            values = np.array([frame[key] for frame in v.frames])
            if np.isfinite(values).any():
                ax.plot(v.times, values, style, lw=1, color=color, label=v.name if style == "-" else None)
    ax.set(xlabel="world seconds (dashed: what moves)", ylabel="PSNR, dB")
    if len(views) <= 10:
        ax.legend(fontsize=6, ncols=2)
    return svg(figure, "PSNR over time")


def _pictures(views: Sequence[ViewScore]) -> list[str]:
    """Rendered, filmed, and four times their difference, of the first cameras; or what they need that is missing."""
    try:
        from PIL import Image
    except ModuleNotFoundError:  # a report without pictures is better than none
        return ["<p class=s>No pictures: they need pillow; pip install 'otsync[video]'.</p>"]
    parts = []
    for v in [v for v in views if v.pictures][:SHOWN_VIEWS]:
        rows = []
        for rendered, filmed in v.pictures:
            apart = np.clip(4 * np.abs(rendered.astype(int) - filmed), 0, 255).astype(np.uint8)
            height = max(1, round(PICTURE * filmed.shape[0] / filmed.shape[1]))
            size, box = (PICTURE, height), Image.Resampling.BOX
            cells = [np.asarray(Image.fromarray(x).resize(size, box)) for x in (rendered, filmed, apart)]
            rows.append(np.concatenate(cells, 1))
        parts.append(f"<p>{escape(v.name)}: rendered, filmed, four times their difference</p>")
        parts.append(inline_image(np.concatenate(rows), f"{v.name} rendered and filmed"))
    return parts


def _numbers(reconstruction: Reconstruction, seconds: Mapping[str, float]) -> str:
    from otsync import __version__

    stages = "".join(f"<tr><td>{escape(k)}<td>{v:.1f} s" for k, v in seconds.items())
    stats = "".join(f"<tr><td>{escape(k)}<td>{v:.5g}" for k, v in reconstruction.stats.items())
    knots = reconstruction.scene.motion.parameters().get("knots")
    nodes = "" if knots is None else f"<tr><td>scaffold nodes<td>{knots.shape[1]}<tr><td>knots<td>{knots.shape[0]}"
    return (
        f"<table>{stages}</table><table>{stats}{nodes}</table>"
        f"<p class=s>otsync {__version__}, Python {platform.python_version()}, {platform.machine()}.</p>"
    )
