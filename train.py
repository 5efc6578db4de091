"""Train a team: `python train.py config=hover`; `python train.py --help` explains every key."""

import sys

if __name__ == "__main__":
    try:
        from multilift_marl.cli.train import main  # takes a while, in which Ctrl-C may come
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(main())
