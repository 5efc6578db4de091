"""What the commands share: key=value arguments, errors in one sentence, help."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from multilift_marl.config.load import check_names, explain, load_config, parse_overrides
from multilift_marl.config.schema import Config
from multilift_marl.config.validate import validate
from multilift_marl.errors import CheckpointError, ConfigError, RenderingError, pip_install
from multilift_marl.tasks import TASKS, find_task

_EXTRAS = {"onnx": "export", "onnxscript": "export", "onnxruntime": "export"}  # of all other packages: train


def run_command(
    main: Callable[[dict[str, Any]], int], usage: str, own: Iterable[str], arguments: Sequence[str] | None,
    configuration: str | None = "config",
) -> int:  # fmt: skip
    """Run a command on key=value arguments and return its exit status; a user's error is one sentence on stderr.

    Args:
        main: the command, called with the values by key.
        usage: the head of its help.
        own: its keys beside those of a configuration.
        arguments: None for those of this process.
        configuration: its key that names a configuration, whose keys and values its help lists; None: it has none.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        if any(argument in ("-h", "--help") for argument in arguments):
            values = parse_overrides(argument for argument in arguments if argument not in ("-h", "--help"))
            check_names(values, own)
            explained = "" if configuration is None else _explain_configuration(values, own, configuration)
            print(f"{usage}{explained}")
            status = 0
        else:
            values = parse_overrides(arguments)
            check_names(values, own)
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


def _explain_configuration(values: dict[str, Any], own: Iterable[str], key: str) -> str:
    """Return the keys of a configuration: with their values where arguments say which, else with their defaults."""
    given = {name: value for name, value in values.items() if name not in own}
    config = load_config(str(values.get(key) or "hover"), given) if given or values.get(key) else None
    what = "default" if config is None else "value"
    lines = [f"\n\nConfiguration keys ({what}, meaning; - stands for none):\n{explain(config or Config)}"]
    for name, task in TASKS.items() if config is None else [(config.task, find_task(config.task))]:
        options = task.Options if config is None else validate(task.Options, config.task_options, "task_options")
        weights = task.REWARD | ({} if config is None else config.reward)
        lines.append(f"\nTask {name}:\n{explain(options, 'task_options.')}")
        lines += [f"  {f'reward.{term}':<32} {weight:<14} weight" for term, weight in weights.items()]
    return "\n".join(lines)
