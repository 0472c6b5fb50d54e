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
    parser.add_argument("--out", type=Path, default=Path("ablations"))
    args = parser.parse_args()

    # the cameras' clocks are right here: the protocol puts the errors in, so that every row begins with the same ones
    capture = synthetic(args.seed, offsets=[0.0] * 5)
    held_out = tuple(f.name for f in capture.held_out)
    with tempfile.TemporaryDirectory() as folder:
        write_capture(capture, folder)
        protocol = Protocol(
            Plan(width=capture.footage[0].size[0], backdrop_steps=800, views=16),
            held_out=held_out,
            seeds=(args.seed,),
            lengths=tuple(args.steps),
        )
        truth = Offsets.load(Path(folder) / "truth.json")
        run(open_scene(folder), truth, args.out, protocol=protocol, rows=args.rows)
    print(f"wrote {args.out / 'recon.csv'} and {args.out / 'recon.json'}")


if __name__ == "__main__":
    main()
