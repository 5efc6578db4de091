"""`python -m multilift_marl.sitl file=sitl.yaml`: a whole pipeline in software, started and ended by one command."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from multilift_marl._interrupt import interrupted_by_signals
from multilift_marl.command import run_command
from multilift_marl.deploy.sitl.pipeline import Options, prepare_commands
from multilift_marl.errors import ConfigError

EXAMPLE = """\
flight:                      # keys of python -m multilift_marl.px4, which finds PX4 by PX4_DIR
  config: track_circle
  seed: 2000                 # also of the nodes
  sync: false                # the clock below does
nodes:                       # keys of python -m multilift_marl.ros; names are free
  planner: {role: trajectory_planner, config: track_circle, receiver: geometric_control}
  control: {role: geometric_control, config: track_circle, patience: 0.2}
  clock: {role: clock, patience: 60}
# view: {port: 8012}         # in the browser
common: {domain: 7, env.num_drones: 4}
"""
_USAGE = f"""Start a flight of PX4s, or a simulation, and the nodes that fly it; end all when it has ended.

  python -m multilift_marl.sitl file=sitl.yaml [key=value ...]
  python -m multilift_marl.sitl file=sitl.yaml flight.seed=2001 common.domain=9 nodes.control.config=hover

What processes print is shown with their names, and kept in logs. Paths are seen from the current folder. A file:

{EXAMPLE}"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly a pipeline; return the exit status: the flight's, or 1 if a node ended before it."""
    return run_command(_run, _USAGE, Options, arguments, configuration=None)


def _run(values: dict[str, Any]) -> int:
    if not hasattr(os, "wait4"):
        raise ConfigError("pipelines run on Linux and macOS alone; use one of them, or WSL on Windows")
    from multilift_marl.deploy.sitl.running import Pipeline

    commands, out = prepare_commands(values)
    with interrupted_by_signals():
        pipeline = Pipeline(commands, out)
        try:
            with pipeline:
                status = pipeline.wait()
        finally:
            print(f"\n{pipeline.describe()}\nlogs are in {out}")
    return status


if __name__ == "__main__":
    sys.exit(main())
