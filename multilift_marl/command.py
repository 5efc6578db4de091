"""What the commands share: key=value arguments, their options, errors in one sentence, help."""

from __future__ import annotations

import io
import json
import os
import shlex
import subprocess
import sys
import time
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import Field

from multilift_marl._files import check_writable, make_run_folder
from multilift_marl._interrupt import end_quiet_import
from multilift_marl.config.config import Config
from multilift_marl.config.keys import check_names, explain
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.errors import (
    CheckpointError,
    ConfigError,
    FlightError,
    RenderingError,
    pip_install,
    reason,
    shorten,
)
from multilift_marl.mdp.rewards import describe, resolve_reward
from multilift_marl.plugins import import_modules
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Section
from multilift_marl.tasks import find_task, list_tasks
from multilift_marl.trust import trusting

Options = TypeVar("Options", bound="CommandOptions")
UNTRAINED = "the best policy of this run is the one that training began with; checkpoint=last evaluates the last one"
_EXTRAS = {
    "onnx": "export",
    "onnxscript": "export",
    "onnxruntime": "export",
    "pymavlink": "px4",
    "rosbags": "ros",
    "cyclonedds": "ros",
    "ray": "ray",
    "scipy": "plan",
}  # of all other packages: train


class CommandOptions(Section):
    """Keys that every command has."""

    trust: bool = Field(
        False, description="whether runs, policies and YAML files may run the modules that they name (docs/plugins.md)"
    )


def run_command(
    main: Callable[[dict[str, Any]], int], usage: str, options: type[CommandOptions], arguments: Sequence[str] | None,
    configuration: str | None = "config",
) -> int:  # fmt: skip
    """Run a command on key=value arguments and return its exit status; a user's error is one sentence on stderr.

    Args:
        main: the command, called with the values by key; see `split_options`.
        usage: the head of its help.
        options: its keys beside those of a configuration. Text is taken as it stands, all else read as YAML.
        arguments: None for those of this process.
        configuration: its key that names a configuration, whose keys and values its help lists; None: it has none.
    """
    end_quiet_import()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    own = options.model_fields
    _open_streams()
    try:
        wanted = [argument for argument in arguments if argument not in ("-h", "--help")]
        values = parse_arguments(options, wanted)
        check_names(values, own)
        import_modules(values.get("import"))  # first of all: checkpoints, too, may need them
        with trusting(values.get("trust") is True):
            if len(wanted) < len(arguments):
                explained = "" if configuration is None else _explain_configuration(values, own, configuration)
                print(f"{usage}\n\nKeys of this command (default, meaning):\n{explain(options)}{explained}")
                status = 0
            else:
                status = main(values)
        sys.stdout.flush()
        return status
    except (ConfigError, CheckpointError, FlightError, RenderingError) as error:
        return _refuse(str(error))
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package == "multilift_marl":
            raise
        return _refuse(f"{package} is missing; {pip_install(_EXTRAS.get(package, 'train'))}")
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


def parse_arguments(options: type[CommandOptions], arguments: Iterable[str]) -> dict[str, Any]:
    """Return the values by dotted name of arguments key=value, the reverse of `spell_arguments`.

    Raises:
        ConfigError: see `parse_overrides`.
    """
    return parse_overrides(
        arguments, [key for key, field in options.model_fields.items() if _is_text(field.annotation)]
    )


def spell_command(name: str, *arguments: str) -> str:
    """Return how a command is called as this process was, a script of a clone or installed, for a shell to run.

    Args:
        name: "train" or "evaluate".
        arguments: of the command; those that a shell would take apart are quoted.
    """
    installed = Path(sys.argv[0]).name.startswith("multilift-")
    return join_command(*([f"multilift-{name}"] if installed else ["python", f"{name}.py"]), *arguments)


def join_command(*words: str) -> str:
    """Return the words of a command as this system's shell takes them apart again."""
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)


def spell_arguments(options: type[CommandOptions], values: Mapping[str, Any]) -> list[str]:
    """Return values by key as arguments key=value, from which a command of such options reads the same again."""
    own, arguments = options.model_fields, []
    for key, value in values.items():
        if key not in own or not _is_text(own[key].annotation):
            value = json.dumps(value, ensure_ascii=False)
        elif value is None:  # text cannot say so, and no argument does
            continue
        arguments.append(f"{key}={value}")
    return arguments


def spell_modules(config: Config) -> list[str]:
    """Return the modules of one's own of a run as an argument of a command; none if it has none."""
    names = [*getattr(config, "import")]
    if ":" in config.train.residual:
        names.append(config.train.residual.rpartition(":")[0])
    if not names:
        return []
    return [f"import={names[0]}" if len(names) == 1 else f"import=[{', '.join(names)}]"]


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


def _is_text(annotation: Any) -> bool:
    """Return whether a key holds text: str, one of some words, or none."""
    parts = typing.get_args(annotation) or (annotation,)
    return all(part in (str, type(None)) or isinstance(part, str) for part in parts)


def split_options(options: type[Options], values: Mapping[str, Any]) -> tuple[Options, dict[str, Any]]:
    """Return a command's options, validated as a configuration is, and the other values by key.

    Raises:
        ConfigError: a wrong type or a value out of range.
    """
    own = {key: value for key, value in values.items() if key in options.model_fields}
    return validate(options, own), {key: value for key, value in values.items() if key not in own}


def check_needs(options: CommandOptions, needs: Mapping[str, str]) -> None:
    """Refuse, by a ConfigError, keys that are given without what they mean something with.

    Args:
        options: of a command.
        needs: by key what it needs, as arguments: "video=true", "bag=<folder> or live=true".
    """
    for key in sorted(options.model_fields_set & needs.keys()):
        if not any(_is_given(options, need) for need in needs[key].split(" or ")):
            raise ConfigError(f"{key} means nothing without {needs[key]}; leave {key} out, or add that")


def _is_given(options: CommandOptions, need: str) -> bool:
    key, _, wanted = need.partition("=")
    value = getattr(options, key)
    if wanted.startswith("<"):  # also if it is given as none: workers=0
        return key in options.model_fields_set or bool(value)
    return str(value).lower() == wanted


def limit_torch_threads() -> None:
    """Let torch, where it has been imported, use one thread: for networks this small, more only wait for each other."""
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)


def make_folder(folder: Path, option: str = "out=<folder>") -> Path:
    """Return a folder that can be written to, made where there is none; a ConfigError, with the option, if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot write into {shorten(folder)} ({reason(error)}); give another folder by {option}"
        ) from error
    return folder


def make_out(out: str | None, parent: Path, stem: str = "") -> Path:
    """Return the folder `out`; where that is None, a new one of this process in `parent`, by stem and time."""
    if out is not None:
        return make_folder(Path(out))
    return make_run_folder(make_folder(parent), stem + time.strftime("%Y%m%d-%H%M%S"))


def _explain_configuration(values: dict[str, Any], own: Iterable[str], key: str) -> str:
    """Return the keys of a configuration: with their values where arguments say which, else with their defaults."""
    given = {name: value for name, value in values.items() if name not in own}
    config = load_config(str(values.get(key) or "hover"), given) if given or values.get(key) else None
    what = "default" if config is None else "value"
    lines = [f"\n\nConfiguration keys ({what}, meaning; - stands for none):\n{explain(config or Config)}"]
    for name in list_tasks() if config is None else [config.task]:
        task = find_task(name)
        options = task.Options if config is None else validate(task.Options, config.task_options, "task_options")
        lines.append(f"\nTask {name}:\n{explain(options, 'task_options.')}")
        weights, margins = resolve_reward(name, task.REWARD, {} if config is None else config.reward)
        for (term, entry), weight, margin in zip(task.REWARD.items(), weights, margins, strict=True):
            lines.append(f"  {f'reward.{term}.weight':<32} {weight:<14g} [-] {describe(entry.value)}")
            if count := len(entry.margins):
                chosen = np.degrees(margin[:count]) if entry.unit == "deg" else margin[:count]
                lines.append(f"  {f'reward.{term}.margin':<32} {_plain(chosen):<14} [{entry.unit}] at which it is half")
    return "\n".join(lines)


def _plain(numbers: np.ndarray) -> str:
    return str([float(f"{number:.6g}") for number in numbers])


def title(values: Mapping[str, Any]) -> str:
    """Return what the folder of a run is named by: the configuration, and the task where another one is given."""
    parts = [Path(str(values[key])).stem for key in ("config", "task") if values.get(key) is not None]
    return "-".join(dict.fromkeys(parts)) or "hover"
