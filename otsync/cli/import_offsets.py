"""``otsync import-offsets``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from ..io.imports import IMPORTERS


@dataclass
class ImportOffsets:
    """Take offsets from elsewhere: a table, timecodes, flashes or claps, polysync, Pose2Sim. Set them against pictures.

    Example: otsync import-offsets claps.csv recording/ --out imported

    Beside what the pictures say: otsync import-offsets claps.csv recording/ --offsets result/offsets.json --out both
    """

    source: tyro.conf.Positional[Path]
    """The file or folder with the offsets; of timecodes that video files carry the recording itself."""
    recording: tyro.conf.Positional[Path]
    """A scene.json, a folder that holds one, or a folder that a reader knows; calibration is not needed."""
    kind: Literal[tuple(each.name for each in IMPORTERS)] | None = None
    """What the source is; default: the first that claims it."""
    sigma: float | None = None
    """Standard deviation of what is told, in seconds; default: what the source tells, or what its kind is worth."""
    offsets: Path | None = None
    """offsets.json of otsync sync: the answer is one of both, and contradictions are listed."""
    out: Path = Path("imported")
    """Folder for offsets.json."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from ..files.claim import claimed, refuse_others
        from ..io.imports import filmed
        from ..io.scene import read_document
        from ..sync.prior import from_told, with_told
        from ..types import Offsets
        from .tables import table

        if self.sigma is not None and not 0 < self.sigma < 1e6:
            raise ValueError(f"--sigma: expected seconds above 0; found {self.sigma:g}.")
        if not self.source.exists():
            raise ValueError(f"{self.source}: expected a file or folder with offsets; found none. Check the path.")
        refuse_others(self.out, "otsync import-offsets")
        claiming = [i for i in IMPORTERS if (i.claims(self.source) if self.kind is None else i.name == self.kind)]
        if not claiming:
            kinds = "; ".join(f"{each.name}: {each.looks_for}" for each in IMPORTERS)
            raise ValueError(f"{self.source}: expected one of {kinds}; found none of them. Give --kind, or mend it.")
        document, root = read_document(self.recording)
        videos = filmed(document, root, allow_outside=self.allow_outside)
        told = claiming[0].edges(self.source, videos)
        if self.sigma is not None:
            told = [replace(k, sigma=self.sigma) for k in told]
        if self.offsets is None:
            for v in {v for k in told for v in (k.a, k.b)}:
                videos.rate(v, str(self.recording))  # offsets.json tells frames, too
            answer, contradictions = from_told(videos.names, videos.fps, told)
        else:
            found = Offsets.load(self.offsets)
            if set(found.names) - set(videos.names):
                raise ValueError(
                    f"{self.offsets}: expected videos of the recording, {', '.join(videos.names)}; found "
                    f"{', '.join(found.names)}. Bring the offsets of this recording."
                )
            place = {videos.names.index(name): v for v, name in enumerate(found.names)}
            kept = [replace(k, a=place[k.a], b=place[k.b]) for k in told if k.a in place and k.b in place]
            if len(kept) < len(told):
                print(f"note: {len(told) - len(kept)} of {len(told)} edges are of videos that {self.offsets} lacks")
            answer, contradictions = with_told(found, kept)
        with claimed(self.out, "otsync import-offsets"):
            answer.save(self.out / "offsets.json")
        print(table(answer, None))
        for each in contradictions:
            print(f"contradiction: {each}")
        print(
            f"{claiming[0].name}: {len(told)} edges, {len(contradictions)} contradictions; wrote "
            f"{self.out / 'offsets.json'}"
        )
        return 1 if contradictions or not answer.ok else 0
