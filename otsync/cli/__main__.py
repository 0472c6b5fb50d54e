"""``python -m otsync.cli``."""

import sys

from otsync.cli import main

sys.exit(main())
