"""Judge a team: `python evaluate.py run=latest episodes=200`; `python evaluate.py --help` explains every key."""

import sys

from multilift_marl.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
