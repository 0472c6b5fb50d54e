"""The cost of an effect that is ignored, and of one that is modelled: a scene pays for those that it calls for.

    python examples/08_effects.py --effect rolling --seeds 201 202 203 --steps 800

Five cameras film a simulated scene through one effect, with unknown clocks; the fit begins at offsets of zero, once
with the effect's model in its tuple and once without. An effect that is not in the tuple is not computed.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from otsync.metrics import offset_error
from otsync.types import Clock, Offsets
from recon.evaluate.views import view
from recon.fit.verb import fit
from recon.observe.effects import MotionBlur
from recon.observe.recorded import optics, with_declared
from recon.observe.vignetting import Vignetting
from recon.scene.seed import Seeding
from recon.simulate.capture import Capture, synthetic
from recon.simulate.effects import Blur, DarkCorners, Rolling, Sheen
from recon.simulate.recording import initial_scene

FILMED = {
    "none": (),
    "rolling": (Rolling(0.025),),
    "blur": (Blur(0.025),),
    "sheen": (Sheen(0.4),),
    "corners": (DarkCorners(0.3),),
}


def modelled(effect: str, capture: Capture) -> tuple[tuple, Seeding]:
    """The fit's model: effects of cameras in its tuple, colours that depend on the view as room for harmonics."""
    if effect == "rolling":  # the cameras declare it
        return with_declared((), [f.readout for f in capture.footage]), Seeding()
    if effect == "blur":
        return (MotionBlur(0.025),), Seeding()
    if effect == "corners":  # as a static part tells it
        return (Vignetting(math.log(0.7)),), Seeding()
    return (), Seeding(sh_degree=1) if effect == "sheen" else Seeding()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effect", choices=list(FILMED), default="rolling")
    parser.add_argument("--seeds", type=int, nargs="+", default=[201])
    parser.add_argument("--steps", type=int, default=800)
    args = parser.parse_args()
    print("seed  model     offsets: mean, largest (frames)   held out: image, what moves (dB)   CPU seconds")
    for seed in args.seeds:
        capture = synthetic(seed, effects=FILMED[args.effect])
        believed = Offsets.known([f.name for f in capture.footage], np.zeros(len(capture.footage)), 30.0)
        for name, (effects, seeding) in {"with": modelled(args.effect, capture), "without": ((), Seeding())}.items():
            scene = initial_scene(capture, believed, seeding=seeding)
            started = time.process_time()
            fitted = fit(scene, capture.footage, believed, effects=effects, steps=args.steps)
            seconds = time.process_time() - started
            error = offset_error(fitted.offsets.seconds, capture.offsets, 1 / capture.frame_step)
            held = capture.held_out[0]  # what is ignored in the fit is ignored in the view
            through = optics(effects, held.readout) if effects else ()
            looking = view(fitted.scene, held, Clock(0.0), gain=np.ones(3), optics=through)
            score = looking.score(most=24, pictures=0).mean
            print(
                f"{seed:4}  {name:8}  {error.mean:14.4f} {error.max:9.4f} {score['psnr']:22.2f} "
                f"{score['mask_psnr']:10.2f} {seconds:26.0f}"
            )


if __name__ == "__main__":
    main()
