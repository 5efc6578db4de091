"""Train a team: `python train.py config=hover`; `python train.py --help` explains every key."""

import sys

from multilift_marl.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
