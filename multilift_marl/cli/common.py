"""What the commands share: key=value arguments, errors in one sentence, help."""

from __future__ import annotations

import io
import os
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from multilift_marl._interrupt import end_quiet_import
from multilift_marl.config.config import Config
from multilift_marl.config.load import check_names, explain, load_config, parse_overrides
from multilift_marl.config.validate import validate
from multilift_marl.errors import CheckpointError, ConfigError, RenderingError, pip_install, reason, shorten
from multilift_marl.plugins import import_modules
from multilift_marl.tasks import find_task, list_tasks

_EXTRAS = {"onnx": "export", "onnxscript": "export", "onnxruntime": "export"}  # of all other packages: train


def run_command(
    main: Callable[[dict[str, Any]], int], usage: str, own: Iterable[str], arguments: Sequence[str] | None,
    configuration: str | None = "config", names: Collection[str] = (),
) -> int:  # fmt: skip
    """Run a command on key=value arguments and return its exit status; a user's error is one sentence on stderr.

    Args:
        main: the command, called with the values by key.
        usage: the head of its help.
        own: its keys beside those of a configuration.
        arguments: None for those of this process.
        configuration: its key that names a configuration, whose keys and values its help lists; None: it has none.
        names: those of its keys that name files and the like, taken as they are.
    """
    end_quiet_import()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    _open_streams()
    try:
        if any(argument in ("-h", "--help") for argument in arguments):
            values = parse_overrides((each for each in arguments if each not in ("-h", "--help")), names)
            check_names(values, own)
            import_modules(values.get("import"))
            explained = "" if configuration is None else _explain_configuration(values, own, configuration)
            print(f"{usage}{explained}")
            status = 0
        else:
            values = parse_overrides(arguments, names)
            check_names(values, own)
            import_modules(values.get("import"))  # first of all: checkpoints, too, may need them
            status = main(values)
        sys.stdout.flush()
        return status
    except (ConfigError, CheckpointError, RenderingError) as error:
        return _refuse(str(error))
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package == "multilift_marl":
            raise
        return _refuse(f"{error.name} is missing; {pip_install(_EXTRAS.get(package, 'train'))}")
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # head, say, has read enough
        _give_up_output()
        return 141
    except MemoryError:
        return _refuse("this needs more memory than there is; lower env.num_envs or train.horizon")
    except OSError as error:
        if error.filename is None:  # the output, on a full disk or a terminal that is gone
            _give_up_output()
        place = "the output" if error.filename is None else str(error.filename)
        return _refuse(f"cannot read or write {place} ({reason(error)}); make room, or use another folder")


def _refuse(message: str) -> int:
    """Print a user's error as one line, and return its exit status."""
    with suppress(OSError):
        print(f"error: {shorten(message, 2000)}", file=sys.stderr, flush=True)
    return 2


def _open_streams() -> None:
    """Have output that can be written to: none where it is closed, and escapes for what its encoding does not know."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _give_up_output() -> None:
    """Send to nowhere what the interpreter flushes at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def whole_number(key: str, value: Any, least: int, most: int = 2**63 - 1) -> int:
    """Return the value of a command's own key; a ConfigError if it is no whole number from `least` to `most`."""
    whole = isinstance(value, int | float) and not isinstance(value, bool) and value == value // 1
    if not whole or not least <= value <= most:
        raise ConfigError(f"{key} must be a whole number from {least} to {most}, but is {shorten(repr(value))}")
    return int(value)


def make_folder(folder: Path) -> Path:
    """Return a folder that can be written to, made where there is none; a ConfigError if that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot write into {shorten(folder)} ({reason(error)}); give another folder by out=<folder>"
        ) from error
    return folder


def _explain_configuration(values: dict[str, Any], own: Iterable[str], key: str) -> str:
    """Return the keys of a configuration: with their values where arguments say which, else with their defaults."""
    given = {name: value for name, value in values.items() if name not in own}
    config = load_config(str(values.get(key) or "hover"), given) if given or values.get(key) else None
    what = "default" if config is None else "value"
    lines = [f"\n\nConfiguration keys ({what}, meaning; - stands for none):\n{explain(config or Config)}"]
    for name in list_tasks() if config is None else [config.task]:
        task = find_task(name)
        options = task.Options if config is None else validate(task.Options, config.task_options, "task_options")
        weights = task.REWARD | ({} if config is None else config.reward)
        lines.append(f"\nTask {name}:\n{explain(options, 'task_options.')}")
        lines += [f"  {f'reward.{term}':<32} {weight:<14} weight" for term, weight in weights.items()]
    return "\n".join(lines)


def title(values: Mapping[str, Any]) -> str:
    """Return what the folder of a run is named by: the configuration, and the task where another one is given."""
    parts = [Path(str(values[key])).stem for key in ("config", "task") if values.get(key) is not None]
    return "-".join(dict.fromkeys(parts)) or "hover"
