"""What the commands share: key=value arguments, errors in one sentence, help."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from multilift_marl._jit import compiled
from multilift_marl.config.load import check_names, explain, parse_overrides
from multilift_marl.errors import CheckpointError, ConfigError, RenderingError, pip_install
from multilift_marl.plugins import import_modules
from multilift_marl.tasks import find_task, list_tasks

_EXTRAS = {"onnx": "export", "onnxscript": "export", "onnxruntime": "export"}  # of all other packages: train


def run_command(
    main: Callable[[dict[str, Any]], int], usage: str, own: Iterable[str], arguments: Sequence[str] | None,
    configurable: bool = True,
) -> int:  # fmt: skip
    """Run a command on key=value arguments and return its exit status; a user's error is one sentence on stderr.

    Args:
        main: the command, called with the values by key.
        usage: the head of its help.
        own: its keys beside those of a configuration.
        arguments: None for those of this process.
        configurable: whether its help lists the keys of a configuration.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        if any(argument in ("-h", "--help") for argument in arguments):
            import_modules(parse_overrides(a for a in arguments if a.startswith("import=")).get("import"))
            print(usage)
            if configurable:
                _explain_configuration()
            status = 0
        else:
            values = parse_overrides(arguments)
            check_names(values, own)
            import_modules(values.get("import"))  # first of all: checkpoints, too, may need them
            status = main(values)
        sys.stdout.flush()
        return status
    except (ConfigError, CheckpointError, RenderingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package == "multilift_marl":
            raise
        print(f"error: {error.name} is missing; {pip_install(_EXTRAS.get(package, 'train'))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # head, say, has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what the interpreter flushes at its end
        return 141


def title(values: Mapping[str, Any]) -> str:
    """Return what the folder of a run is named by: the configuration, and the task where another one is given."""
    parts = [Path(str(values[key])).stem for key in ("config", "task") if values.get(key) is not None]
    return "-".join(dict.fromkeys(parts)) or "hover"


def announce_compiling() -> None:
    """Say why nothing seems to happen, where nothing has been compiled before."""
    if not compiled():
        print("compiling the simulation, which takes about a minute the first time", flush=True)


def _explain_configuration() -> None:
    print(f"\nConfiguration keys (default, meaning; - stands for none):\n{explain()}")
    for name in list_tasks():
        task = find_task(name)
        print(f"\nTask {name}:\n{explain(task.Options, 'task_options.')}")
        print("\n".join(f"  {f'reward.{term}':<32} {weight:<14} weight" for term, weight in task.REWARD.items()))
