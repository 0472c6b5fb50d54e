"""``otsync demo``: the whole job on a small world whose truth is known."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from otsync.types import Camera
    from recon.simulate.phones import PhoneFilms

MOMENTS = 5
"""At which the scene is held against the truth; each lies between two frames of the first phone."""


@dataclass
class Demo:
    """Film a small moving world with five phones that nobody started together, and do the whole job on their videos:
    clocks, a 4D scene, and a page that plays it.

    Example: otsync demo --out demo
    """

    out: Path = Path("demo")
    """Folder for recording/ (the videos), result/ (what otsync run makes of them) and demo.json."""
    seed: int = 1
    """Of the world, the phones and their clocks."""
    steps: int = 1200
    """Steps of the fit: more give a sharper scene. The clocks stay as the geometry found them."""

    def run(self) -> int:
        from otsync.files.claim import claimed

        with claimed(self.out, "otsync demo"):
            return self._run()

    def _run(self) -> int:
        from otsync.files.arrays import write_json
        from otsync.progress import tell
        from recon.cli.run import Run
        from recon.fit.options import FitOptions
        from recon.pipeline.plan import Plan
        from recon.simulate.phones import film_phones

        recording, result = self.out / "recording", self.out / "result"
        tell("filming a small world with five phones ...")
        films = film_phones(recording, self.seed)
        # so short a fit would rather spoil the clocks than refine them
        short = FitOptions(steps=self.steps, freeze=("offsets",))
        plan = Plan(width=200, backdrop_steps=400, views=8, fit=short)
        with redirect_stdout(io.StringIO()):  # its tables stand in the report
            code = Run(recording, result, plan=plan, truth=recording / "truth.json").run()
        if not (result / "run.json").is_file():
            return code
        figures = held_against_the_truth(films, result)
        write_json(self.out / "demo.json", figures)
        for line in told(figures, self.out):
            print(line)
        return code


def held_against_the_truth(films: PhoneFilms, folder: Path) -> dict[str, Any]:
    """How far the clocks are off (s), and what the scene is worth where and when nobody filmed (dB)."""
    import numpy as np

    from otsync.types import Offsets
    from recon.result.folder import load_result
    from recon.result.images import seen_by

    result, truth = load_result(folder), films.offsets
    offsets, coarse = result.offsets, Offsets.load(folder / "offsets_coarse.json")
    others = [v for v in range(len(offsets)) if v != offsets.reference]
    began = truth.seconds[[truth.names.index(name) for name in offsets.names]]
    errors = np.abs(offsets.seconds - began)[others]
    first, second = (result.video(offsets.names[v]).camera for v in (len(offsets) // 2, len(offsets) // 2 + 1))
    between = _between(first, second)
    low, high = (float(x) for x in result.video(offsets.names[offsets.reference]).times[[0, -1]])
    step = result.scene.frame_step
    times = low + step * (np.round(np.linspace(0.15, 0.85, MOMENTS) * (high - low) / step) + 0.5)
    true, moving = films.seen(between, times)
    seen = np.stack([seen_by(result, between, float(t)).numpy().clip(0, 1) for t in times])
    apart = (255 * seen - true) ** 2
    return {
        "phones": len(films.cameras),
        "apart_seconds": float(np.ptp([video.clock.world(video.times[0]) for video in result.videos])),
        "trusted": sum(coarse.status[v].ok for v in others),
        "judged": len(others),
        "error_seconds": {"mean": float(errors.mean()), "max": float(errors.max())},
        "error_frames": {"mean": float(errors.mean() / step), "max": float(errors.max() / step)},
        "moving_gaussians": len(result.scene),
        "psnr": float(10 * np.log10(255**2 / apart.mean())),
        "psnr_moving": float(10 * np.log10(255**2 / apart[moving].mean())),
    }


def _between(a: Camera, b: Camera) -> Camera:
    """A camera half-way between two that look at the middle of the room."""
    from dataclasses import replace

    from otsync.simulate.room import MIDDLE, look_at

    return replace(a, w2c=look_at((a.center + b.center) / 2, MIDDLE))


def told(figures: dict[str, Any], out: Path) -> tuple[str, str, str]:
    """What matters, in three lines."""
    error, apart = figures["error_frames"], figures["apart_seconds"]
    return (
        f"clocks: {figures['phones']} phones began up to {apart:.2f} s apart; {figures['trusted']} of "
        f"{figures['judged']} offsets to be trusted, off by {error['mean']:.3f} frames, {error['max']:.3f} at most",
        f"scene: {figures['moving_gaussians']} moving Gaussians; {figures['psnr']:.1f} dB against the truth where no "
        f"phone stood, between two frames; {figures['psnr_moving']:.1f} where it moves",
        f"look: {out / 'result' / 'scene.html'} plays the scene, {out / 'result' / 'report.html'} says how sure it is",
    )
