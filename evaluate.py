"""Evaluate a team: `python evaluate.py run=latest episodes=200`; `python evaluate.py --help` explains every key."""

import sys

if __name__ == "__main__":
    try:
        from multilift_marl.cli.evaluate import main  # takes a while, in which Ctrl-C may come
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(main())
