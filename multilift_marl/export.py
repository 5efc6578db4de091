"""Export a policy: `python -m multilift_marl.export run=latest`; `--help` explains its keys."""

import sys

from multilift_marl.cli.export import main

if __name__ == "__main__":
    sys.exit(main())
