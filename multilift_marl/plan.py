"""Plan a path through way-points: `python -m multilift_marl.plan waypoints=<list>`; `--help` explains its keys."""

import sys

from multilift_marl.cli.plan import main

if __name__ == "__main__":
    sys.exit(main())
