"""The worth of each part: the same fit with and without spline, scaffold and refinement, on one simulated capture.

    python examples/07_ablations.py --rows ours fixed "w/o scaffold" --out ablations

A row is another object in a slot (recon/bench/configurations.py), never another code path. On real recordings:
recon bench recording/ --held-out NAME --rows ours fixed "w/o spline" "w/o scaffold".
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from otsync.io import open_scene
from otsync.types import Offsets
from recon.bench.configurations import configurations
from recon.bench.fits import Protocol, run
from recon.pipeline.plan import Plan
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rows", nargs="+", default=["ours", "fixed", "w/o spline", "w/o scaffold"], choices=list(configurations())
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[700], help="several: what accuracy costs, in recon.svg"
    )
    parser.add_argument("--width", type=int, default=160, help="of the images, pixels")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--backdrop-steps", type=int, default=800, help="of the fit of the static part")
    parser.add_argument("--out", type=Path, default=Path("ablations"))
    args = parser.parse_args()

    # the cameras' clocks are right here: the protocol puts the errors in, so that every row begins with the same ones
    size = (args.width, args.width * 3 // 5)
    capture = synthetic(args.seed, frames=args.frames, size=size, offsets=[0.0] * 5)
    held_out = tuple(f.name for f in capture.held_out)
    with tempfile.TemporaryDirectory() as folder:
        write_capture(capture, folder)
        protocol = Protocol(
            Plan(width=args.width, backdrop_steps=args.backdrop_steps, views=16),
            held_out=held_out,
            seeds=(args.seed,),
            lengths=tuple(args.steps),
        )
        truth = Offsets.load(Path(folder) / "truth.json")
        run(open_scene(folder), truth, args.out, protocol=protocol, rows=args.rows)
    print(f"wrote {args.out / 'recon.csv'} and {args.out / 'recon.json'}")


if __name__ == "__main__":
    main()
