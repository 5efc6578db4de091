"""What both commands share: key=value arguments, errors in one sentence, help."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from multilift_marl.config.load import explain, parse_overrides
from multilift_marl.errors import CheckpointError, ConfigError, RenderingError
from multilift_marl.tasks import TASKS


def run_command(main: Callable[[dict[str, Any]], int], usage: str, arguments: Sequence[str] | None) -> int:
    """Run a command on key=value arguments and return its exit status; a user's error is one sentence on stderr."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if any(argument in ("-h", "--help") for argument in arguments):
        print(f"{usage}\n\nConfiguration keys (default, meaning; - stands for none):\n{explain()}")
        for name, task in TASKS.items():
            print(f"\nTask {name}:\n{explain(task.Options, 'task_options.')}")
            print("\n".join(f"  {f'reward.{term}':<32} {weight:<14} weight" for term, weight in task.REWARD.items()))
        return 0
    try:
        return main(parse_overrides(arguments))
    except (ConfigError, CheckpointError, RenderingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] == "multilift_marl":
            raise
        print(f"error: {error.name} is missing; pip install 'multilift_marl[train]'", file=sys.stderr)
        return 2
