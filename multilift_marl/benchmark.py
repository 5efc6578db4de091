"""Compare a policy on fixed tasks: `python -m multilift_marl.benchmark policy=hover`; `--help` explains its keys."""

import sys

from multilift_marl.cli.benchmark import main

if __name__ == "__main__":
    sys.exit(main())
