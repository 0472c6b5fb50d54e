"""Writing videos: H.264 with a timestamp of its own for every frame, and AAC sound."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

TICKS = 90_000
"""Steps of a second in which timestamps are written: exact for all common rates, 6 microseconds off at most."""

CRF = "18"
"""Constant quality of H.264, at which the eye sees no loss."""

CHUNK = 1024
"""Samples of a frame of AAC."""

CONTAINERS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""Of files that are written, by their suffix."""

REPEATABLE = "threads=1:lookahead-threads=1:sliced-threads=0:rc-lookahead=0:mbtree=0"
"""x264 on one thread, without a look ahead: the same images make the same bytes."""


@contextlib.contextmanager
def whole_file(out: Path) -> Iterator[Path]:
    """A temporary file beside ``out`` that takes its name once it is complete, and goes where it is not."""
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, out)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:  # FFmpeg's own, which name the temporary file
            said = f"cannot be written ({os.strerror(error.errno)}); nothing is half written"
            raise OSError(error.errno, said, str(out)) from None
        raise


def write_video(
    out: Path,
    frames: Iterable[tuple[float, UInt8[np.ndarray, "h w 3"]]],
    fps: float,
    sound: Float[np.ndarray, "C N"] | None = None,
    rate: int = 48_000,
    *,
    x264: str = "",
) -> int:
    """Write RGB frames (seconds, pixels) of rising seconds from 0 on, and how many there were.

    An odd last row or column is left out. The file appears under its name once it is complete.

    Args:
        out: a file of a kind in ``CONTAINERS``.
        fps: about how many frames a second there are; the timestamps alone say when each is shown.
        sound: samples -1..1 of one or two channels, from second 0 on, ``rate`` a second.
        x264: parameters of the encoder, as x264 spells them.
    """
    import av

    kind = CONTAINERS[out.suffix.lower()]
    count = 0
    # a clip's first frame may be shown after second 0; a movie's own ticks, 1000 a second, would round when
    ticks = {} if kind == "matroska" else {"movie_timescale": str(TICKS)}
    with whole_file(out) as part, av.open(str(part), "w", format=kind, options=ticks) as container:
        options = {"crf": CRF} | ({"x264-params": x264} if x264 else {})
        video = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(60_000), options=options)
        video.pix_fmt = "yuv420p"
        video.time_base = video.codec_context.time_base = Fraction(1, TICKS)
        audio = None if sound is None else container.add_stream("aac", rate=rate, layout=_layout(sound))
        for seconds, pixels in frames:
            even = pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]
            if count == 0:
                video.height, video.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            frame.pts, frame.time_base = round(seconds * TICKS), Fraction(1, TICKS)
            container.mux(video.encode(frame))
            count += 1
        if count == 0:
            raise ValueError(f"{out}: expected at least one frame to write; found none.")
        container.mux(video.encode())
        if audio is not None and sound is not None:
            _mux_sound(container, audio, sound, rate)
    return count


def _layout(sound: np.ndarray) -> str:
    return ("mono", "stereo")[len(sound) - 1]


def _mux_sound(container: Any, stream: Any, sound: Float[np.ndarray, "C N"], rate: int) -> None:
    import av

    for n in range(0, sound.shape[1], CHUNK):
        piece = np.ascontiguousarray(sound[:, n : n + CHUNK], np.float32)
        frame = av.AudioFrame.from_ndarray(piece, format="fltp", layout=_layout(sound))
        frame.sample_rate, frame.pts, frame.time_base = rate, n, Fraction(1, rate)
        container.mux(stream.encode(frame))
    container.mux(stream.encode())
