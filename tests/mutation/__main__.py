"""``python -m tests.mutation [--only NAME ...] [--workers N] [--whole]``: the mutation run from the shell."""

from __future__ import annotations

import argparse
import signal
import sys
from functools import partial

from tests.mutation.run import PROMISED, chosen, mutate, share, table


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description="Break the code, and ask the tests.")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="breaks to try; default: all of them")
    parser.add_argument("--workers", type=int, default=1, help="breaks that are tried at once")
    parser.add_argument("--whole", action="store_true", help="ask all fast tests of the package about what survives")
    options = parser.parse_args()
    try:
        slips = chosen(options.only)
    except ValueError as error:
        parser.error(str(error))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the copies are removed then, too
    outcomes = mutate(slips, workers=options.workers, whole=options.whole, tell=partial(print, flush=True))
    print(table(outcomes))
    return 0 if share(outcomes) >= PROMISED else 1


if __name__ == "__main__":
    sys.exit(main())
