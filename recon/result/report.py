"""The report of a reconstruction: results, convergence of the fit, and rendered pictures beside filmed ones.

One self-contained HTML file without a script, in the style of the synchronisation report.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from otsync.report.clock import inline_image, measured, stills, timeline
from otsync.report.figures import CHOSEN, GREY, axes_of, effort, svg
from otsync.report.page import (
    TRUSTED,
    cards,
    extent,
    footer,
    late_starts,
    number,
    remedies,
    stage_bars,
    status_words,
    told_truth,
    verdict,
    write_page,
)
from otsync.types import Offsets, Video
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
    sync_page: str | None = None,
    filmed: Sequence[Video] = (),
) -> None:
    """Write the page, atomically.

    Args:
        coarse: the offsets that the fit began with, of the same videos as ``reconstruction.offsets``.
        videos: names of those that took part in the fit, in its order.
        views: of held-out cameras, and of training ones to compare with.
        seconds: wall time of every stage. notes: in words, what was missing or assumed.
        truth: (V,) true offsets in seconds relative to the reference, where they are known.
        lpips_reason: why there is no LPIPS; "" where there is.
        scene_page, sync_page: addresses of the page that plays the scene and of that of the clocks, relative to the
            report; None: no link.
        filmed: the videos of ``reconstruction.offsets``, in its order, to show; without them there are no pictures of
            the common clock.
    """
    offsets, seconds = reconstruction.offsets, seconds or {}
    own = [np.asarray(video.times, float) for video in filmed]
    figure = effort(seconds, _answers(reconstruction, coarse, seconds), truth)
    parts = [
        "<p class=kind>Reconstruction of a recording</p>",
        f"<h1>{verdict(offsets)}</h1>",
        f"<p class=lead>{extent(offsets, own) if filmed else ''} {_size(reconstruction)} {_worth(views)}</p>",
        _links(scene_page, sync_page),
        "".join(f"<p class=note><i>⚠</i> {escape(note)}</p>" for note in notes),
        *([stills(offsets, filmed), "<h2>On the common clock</h2>", timeline(offsets, own, filmed)] if filmed else []),
        "<h2>How sure</h2>",
        _offset_rows(reconstruction, coarse, truth),
        "<p class=s>Frames are those of the reference. A positive offset means that the video's clock started later: "
        "t<sub>world</sub> = rate · t<sub>video</sub> + offset. ± is one standard deviation; after the fit, of what "
        f"tracks and pictures say together: it grows where the two disagree. {_left(reconstruction)} {TRUSTED}"
        f"{told_truth(truth)}</p>",
        late_starts(offsets, own) if filmed else "",
        remedies(offsets),
        "<h2>What accuracy cost</h2>",
        f"<div class=figs><div>{stage_bars(seconds)}</div><div>{figure}</div></div>",
        "<h2>Views</h2>",
        _view_rows(views, lpips_reason, len(videos)),
        *_pictures(views),
        f"<div class=figs>{views_over_time(views)}</div>" if any(len(v.frames) > 1 for v in views) else "",
        f"<h2>Convergence</h2><p class=s>{_pace(reconstruction)}</p>",
        convergence(reconstruction, coarse, videos, truth),
        _numbers(reconstruction),
        footer({}),
    ]
    write_page(path, "Reconstruction", parts)


def _links(scene_page: str | None, sync_page: str | None) -> str:
    """What else there is to look at."""
    links = []
    if scene_page:
        links.append(f'<a class=go href="{escape(scene_page, quote=True)}">Fly round the scene, in slow motion</a>')
    if sync_page:
        links.append(f'<a class="go second" href="{escape(sync_page, quote=True)}">How the clocks were found</a>')
    return f"<p>{''.join(links)}</p>" if links else ""


def _answers(reconstruction: Reconstruction, coarse: Offsets, seconds: Mapping[str, float]) -> dict[str, Offsets]:
    """The offsets that there were after a stage: at once where the run began with them."""
    synchronised = [stage for stage in seconds if stage.startswith("synchronise")]
    last = synchronised[-1] if synchronised else ""
    return {last: coarse, "fit": reconstruction.offsets}


def _size(reconstruction: Reconstruction) -> str:
    """Of the scene, in words."""
    moving, static = len(reconstruction.scene), reconstruction.scene.static
    still = "" if static is None else f" and {len(static):,} that stand still"
    return f"The scene has {moving:,} moving Gaussians{still}."


def _left(reconstruction: Reconstruction) -> str:
    """What the fit left of a known error of its clocks, in words; nothing where none was put in."""
    share = reconstruction.stats.get("start_kept")
    if share is None:
        return ""
    sigma = reconstruction.stats["start_kept_sigma"]
    return (
        f"Before the fit, clocks were bent on purpose: it left {share:.0%} (± {sigma:.0%}) of that. So much of the "
        "error that the clocks began with is left as well, and sigma counts it."
    )


def _worth(views: Sequence[ViewScore]) -> str:
    """What cameras that the fit did not see say of the scene."""
    held = [v for v in views if v.held_out]
    if not held:
        return "No camera was held out: the figures of views are of cameras that took part in the fit."
    mean = {
        k: float(np.nanmean([v.mean[k] for v in held]))
        for k in ("psnr", "mask_psnr")
        if not all(np.isnan(v.mean[k]) for v in held)
    }
    text = f"Held-out cameras: {number(mean.get('psnr', np.nan), 2)} dB"
    return text + (f", {number(mean['mask_psnr'], 2)} dB where things move." if "mask_psnr" in mean else ".")


def _offset_rows(reconstruction: Reconstruction, coarse: Offsets, truth: np.ndarray | None) -> str:
    offsets = reconstruction.offsets
    titles = ["before the fit, frames", "after, frames", "moved, frames"]
    titles += ["true, frames", "error, frames"] if truth is not None else []
    head = [("video", False), ("status", True), *((title, False) for title in titles)]
    rows = []
    for v, name in enumerate(offsets.names):
        fps = float(offsets.fps[offsets.component[v]])
        after = float(offsets.frames[v])
        cells = [
            escape(name),
            "reference" if v == offsets.reference else status_words(offsets.status[v], offsets.flags[v]),
            measured(float(coarse.frames[v]), float(coarse.sigma[v]) * fps),
            measured(after, float(offsets.sigma[v]) * fps),
            _moved(after - float(coarse.frames[v]), v == offsets.reference),
        ]
        if truth is not None:
            cells += [number(float(truth[v]) * fps, 3), number(after - float(truth[v]) * fps, 3)]
        rows.append(cells)
    return cards(head, rows)


def _moved(frames: float, reference: bool) -> str:
    """How far a fit moved a clock, in words where it had no part in it."""
    return "reference" if reference else "not fitted" if frames == 0 else number(frames, 3)


def convergence(
    reconstruction: Reconstruction, coarse: Offsets, videos: Sequence[str], truth: np.ndarray | None = None
) -> str:
    """Left: every camera's offset against steps, relative to the reference. Right: PSNR of the training boxes."""
    history, step = reconstruction.history, reconstruction.scene.frame_step
    if not len(history.step):
        return ""
    moved, left = axes_of()
    for name, curve, is_reference in offset_curves(history, coarse, videos, truth):
        left.plot(history.step, curve / step, lw=1, color=GREY if is_reference else None, label=name)
    left.axhline(0, color="black", lw=0.5)
    left.set(xlabel="step", ylabel="error, frames" if truth is not None else "moved, frames")
    if len(history.offsets.T) <= 12:
        legend_above(left)
    better, right = axes_of()
    known = np.isfinite(history.psnr)
    right.plot(history.step[known], history.psnr[known], color=CHOSEN, lw=1)
    right.set(xlabel="step", ylabel="PSNR of training boxes, dB")
    figures = (svg(moved, "offsets over the fit"), svg(better, "PSNR over the fit"))
    return f"<div class=figs>{''.join(f'<div>{figure}</div>' for figure in figures)}</div>"


def legend_above(ax: Any) -> None:
    """A legend above the axes, where it covers nothing."""
    ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False, borderaxespad=0)


def _pace(reconstruction: Reconstruction) -> str:
    # a continued fit has a time for each of its sessions: the longest is about what it took
    seconds = max([reconstruction.stats.get("seconds", 0.0), *reconstruction.history.seconds.tolist()])
    text = f"{reconstruction.stats.get('steps', 0.0):.0f} steps" + (f", {seconds:.1f} s" if seconds >= 0.1 else "")
    return text + (
        ". Left: the fit's own path, relative to the reference; the answer above weighs the clocks of the tracks, too. "
        "Right: mean over the images since the last point."
    )


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


def _view_rows(views: Sequence[ViewScore], lpips_reason: str, fitted: int) -> str:
    """The scores, as HTML; ``fitted``: how many videos took part in the fit, of which some are compared."""
    if not views:
        return "<p class=s>No view was scored.</p>"
    names = {
        "psnr": ("PSNR", 2),
        "ssim": ("SSIM", 4),
        "lpips": ("LPIPS", 4),
        "mask_psnr": ("PSNR, moving", 2),
        "mask_ssim": ("SSIM, moving", 4),
    }
    head = [("camera", False), ("role", True), *((title, False) for title, _ in names.values())]
    head += [("frames", False), ("gain R G B", False), ("clock", True)]
    rows = []
    for v in views:
        cells = [number(v.mean.get(key, np.nan), digits) for key, (_, digits) in names.items()]
        gain = " ".join(f"{g:.3f}" for g in v.gain)
        role = "held out" if v.held_out else "training"
        rows.append([escape(v.name), role, *cells, str(len(v.frames)), gain, HOW[v.clock.how]])
    compared = sum(not v.held_out for v in views)
    some = f" Of the {fitted} cameras of the fit {compared} are compared." if compared < fitted else ""
    missing = some + (f" LPIPS: {escape(lpips_reason)}." if lpips_reason else "")
    return (
        f"{cards(head, rows)}<p class=s>Renderings use none of the cameras' own pictures: they are static "
        f"Gaussians, and over them what moves. The gain is fitted to what is static.{missing}</p>"
    )


def views_over_time(views: Sequence[ViewScore]) -> str:
    """PSNR of every compared frame: the whole image, and where things move (dashed); held-out cameras in bold."""
    figure, ax = axes_of()
    for n, v in enumerate(views):
        color, width = f"C{n % 10}", 1.8 if v.held_out else 1.0
        for key, style in (("psnr", "-"), ("mask_psnr", "--")):
            values = np.array([frame[key] for frame in v.frames])
            if np.isfinite(values).any():
                ax.plot(v.times, values, style, lw=width, color=color, label=v.name if style == "-" else None)
    ax.set(xlabel="world seconds (dashed: what moves)", ylabel="PSNR, dB")
    if len(views) <= 10:
        legend_above(ax)
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
        words = f"{escape(v.name)}: rendered, filmed, four times their difference"
        picture = inline_image(np.concatenate(rows), f"{v.name} rendered and filmed")
        parts.append(f"<figure>{picture}<figcaption>{words}</figcaption></figure>")
    return parts


def _numbers(reconstruction: Reconstruction) -> str:
    stats = "".join(f"<tr><td>{escape(k)}<td>{v:.5g}" for k, v in reconstruction.stats.items())
    knots = reconstruction.scene.motion.parameters().get("knots")
    nodes = "" if knots is None else f"<tr><td>scaffold nodes<td>{knots.shape[1]}<tr><td>knots<td>{knots.shape[0]}"
    table = f"<table class=numbers>{stats}{nodes}</table>"
    return f"<details><summary>Numbers</summary><div class=inside>{table}</div></details>"
