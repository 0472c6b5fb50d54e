"""``otsync sync RECORDING --frames own``: clocks and camera poses of a recording with depth and without poses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..progress import tell
from .tables import flagged, print_json, refuse_unused, table, true_offsets, with_errors

if TYPE_CHECKING:
    from ..sync.method import Method
    from .recordings import RecordingOptions


def sync_own_recording(
    path: Path,
    out: Path,
    options: RecordingOptions,
    *,
    method: Method | None = None,
    reference: str | None = None,
    truth: Path | None = None,
    as_json: bool = False,
) -> int:
    """offsets.json, sync.json, report.html, and scene.json with the cameras that were found, in ``out``.

    Exit code 1 when an answer is flagged.
    """
    from ..files.arrays import write_json
    from ..files.cache import Cache
    from ..recordings.own_frames import found_document, open_without_poses, synchronize_own_scene
    from ..report.frames import write_recording_report

    refuse_unused(options, ("route",), "a recording with --frames own, which has one route,")
    stages, threads = options.stages(), options.threads()  # before the work, not after it
    scene, document = open_without_poses(path, allow_outside=options.allow_outside)
    if options.cameras:
        scene = scene.take(options.cameras)
    chosen: int | Literal["auto"] = 0
    if reference is not None:
        if reference not in (*scene.names, "auto"):
            raise ValueError(f"--reference: expected auto or one of {', '.join(scene.names)}; found {reference!r}.")
        chosen = "auto" if reference == "auto" else scene.names.index(reference)
    known = None if truth is None else true_offsets(truth, scene.names)
    for note in scene.notes:
        tell(f"note: {note}")
    with ThreadPoolExecutor(threads) as pool:
        found = synchronize_own_scene(
            scene,
            reference=chosen,
            method=method,
            stages=stages,
            cache=Cache(options.cache or out / "stages"),
            map=pool.map,
            tell=tell,
        )
    if known is not None:
        known = known - known[found.offsets.component]
    found.offsets.save(out / "offsets.json")
    write_json(out / "sync.json", {"route": found.route, "why": list(found.why), "seconds": found.seconds})
    write_json(out / "scene.json", found_document(document, found.offsets))
    write_recording_report(out / "report.html", scene, found, truth=None if known is None else list(known))
    if as_json:
        print_json({"route": found.route, "why": list(found.why), **with_errors(found.offsets, known)})
    else:
        print(table(found.offsets, known))
        print(f"route {found.route}; wrote offsets.json, sync.json, scene.json and report.html to {out}")
        print(f"scene.json has the cameras that were found; its paths are relative to {scene.root}: copy it there")
    return flagged(found.offsets)
