"""Tables and messages that commands print."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..compute.processes import Processes
from ..compute.threads import pool_of
from ..progress import counted
from ..sync.verb import synchronize
from ..types import Offsets, Status, TrackSet
from ..types.drawing import HEARD, span
from ..types.similarity import IDENTITY

if TYPE_CHECKING:
    import numpy as np


def true_offsets(path: Path, names: tuple[str, ...]) -> np.ndarray:
    """True offsets of the named videos; ValueError names what the file lacks."""
    import numpy as np

    known = Offsets.load(path)
    missing = [name for name in names if name not in known.names]
    if missing:
        raise ValueError(f"{path}: expected offsets of {', '.join(names)}; {', '.join(missing)} are not in it.")
    return np.array([known.seconds[known.names.index(name)] for name in names])


def with_progress(tracks: list[TrackSet], what: str, workers: int = 1, **options: Any) -> Offsets:
    """:func:`otsync.synchronize` on some processes, with a progress bar on a terminal."""
    if workers < 1:
        raise ValueError(f"--workers: expected at least 1; found {workers}.")

    def progress(run: Callable[..., Iterable[Any]]) -> Callable[..., Iterable[Any]]:
        def mapped(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
            items = list(items)
            return counted(run(function, items), what, "pair", len(items))

        return mapped

    if workers == 1:
        return synchronize(tracks, map=progress(map), **options)
    with Processes(workers) as call, pool_of(workers) as pool:
        return synchronize(tracks, map=progress(lambda f, items: pool.map(partial(call, f), items)), **options)


@contextmanager
def naming_files(paths: Sequence[Path]) -> Iterator[None]:
    """An error about ``tracks[1]`` names the file that these were read from."""
    try:
        yield
    except ValueError as error:
        said = re.match(r"tracks\[(\d+)\][.:]? *", str(error))
        if said is None:
            raise
        raise ValueError(f"{paths[int(said[1])]}: {str(error)[said.end() :]}") from None


def refuse_unused(options: Any, names: Iterable[str], why: str) -> None:
    """ValueError when one of a command's options is set although this way of the command does not use it.

    Args:
        options: the command's dataclass. names: of its fields that are not used. why: "a recording", in the error.
    """
    for field in dataclasses.fields(options):
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        if field.name in names and getattr(options, field.name) != default:
            raise ValueError(
                f"--{field.name.replace('_', '-')}: {why} does not use it; found {getattr(options, field.name)}. "
                "Leave it out."
            )


def print_json(document: dict[str, Any]) -> None:
    """One line on standard output; numbers that are none become null."""
    print(json.dumps(document, allow_nan=False))


def finite(stats: dict[str, float]) -> dict[str, float | None]:
    """Statistics as JSON has them: null for what is no number."""
    return {name: value if math.isfinite(value) else None for name, value in stats.items()}


def with_errors(offsets: Offsets, truth: Any = None) -> dict[str, Any]:
    """The content of offsets.json, and each video's error in frames where the truth is known."""
    import numpy as np

    document = offsets.to_dict()
    if truth is not None:
        errors = offsets.frames - np.asarray(truth) * offsets.fps[offsets.component]
        for video, error in zip(document["videos"], errors, strict=True):
            video["error_frames"] = float(error) if np.isfinite(error) else None
    return document


def report(
    offsets: Offsets, tracks: list[TrackSet], truth: Any, out: Path, title: str, *, as_json: bool = False
) -> int:
    """Print the table (or JSON), write offsets.json and report.html; exit code 1 when an answer was refused."""
    from ..report import write_report

    offsets.save(out / "offsets.json")
    write_report(out / "report.html", offsets, tracks, truth=truth, title=title)
    if as_json:
        print_json(with_errors(offsets, truth))
    else:
        print(table(offsets, truth))
        print(f"wrote {out / 'offsets.json'} and {out / 'report.html'}")
    return flagged(offsets)


def flagged(offsets: Offsets) -> int:
    """Say what is flagged, with its remedy, on stderr; 1 when anything is, else 0."""
    for name, flags in zip(offsets.names, offsets.flags, strict=True):
        for flag in flags:
            print(f"{name}: {flag.code}: {flag}", file=sys.stderr)
    return 0 if offsets.ok else 1


def table(offsets: Offsets, truth: Any = None) -> str:
    """The answer as text, in frames of the reference."""
    import numpy as np

    fps = offsets.fps[offsets.component]
    columns = [("offset", 9, offsets.frames), ("sigma", 8, offsets.sigma * fps)]
    if truth is not None:
        true = np.asarray(truth) * fps
        columns += [("true", 9, true), ("error", 8, offsets.frames - true)]
    width = max(5, *map(len, offsets.names))
    head = " ".join(name.rjust(w) for name, w, _ in columns)
    heard = [span(*ends) for ends in offsets.steps_heard.tolist()]
    told = any(h != "–" for h in heard)
    wide = max(len("steps heard"), *map(len, heard))
    between = f"  {'steps heard':{wide}}" if told else ""
    lines = [f"{'video':{width}}  {head}{between}  status   (frames of the reference)"]
    for v, name in enumerate(offsets.names):
        cells = [f"{x[v]:{w}.3f}" if np.isfinite(x[v]) else "–".rjust(w) for _, w, x in columns]
        status = "reference" if v == offsets.reference else offsets.status[v].code
        between = f"  {heard[v]:{wide}}" if told else ""
        lines.append(f"{name:{width}}  {' '.join(cells)}{between}  {status}")
    if told:
        lines.append(HEARD)
    return "\n".join([*lines, *offsets.clock_notes(), *frame_lines(offsets, width)])


def frame_lines(offsets: Offsets, width: int) -> list[str]:
    """Where each video's frame of reference lies, for videos that have one of their own."""
    if not offsets.transforms:
        return []
    lines = [
        "",
        f"{'video':{width}}  {'scale':>8} {'sigma':>7} {'turn':>7} {'sigma':>7}  origin   (in the reference's frame)",
    ]
    for name, S in zip(offsets.names, offsets.transforms, strict=True):
        if S is None:
            lines.append(f"{name:{width}}  {'–':>8} {'–':>7} {'–':>7} {'–':>7}  –")
            continue
        origin = " ".join(f"{x:.3g}" for x in S.t)
        turn = S.degrees_from(IDENTITY)
        lines.append(
            f"{name:{width}}  {S.scale:8.4f} {100 * S.scale_sigma:6.2f}% "
            f"{turn:6.1f}° {S.rotation_sigma:6.2f}°  {origin}"
        )
    return lines


def refusal(verb: str, status: Status, flags: tuple[Status, ...]) -> int:
    if status.ok:
        return 0
    for flag in flags or (status,):
        print(f"{verb} refused: {flag.code}: {flag}", file=sys.stderr)
    return 1
