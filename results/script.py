"""How the scripts of this folder take their arguments, and end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NoReturn

from multilift_marl.errors import CheckpointError, ConfigError, nearest


def read_options(arguments: Iterable[str], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options key=value of a script, each of the type of its default.

    Raises:
        ConfigError: an argument of another form, a key that there is not, or no whole number of at least 0.
    """
    options = dict(defaults)
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals:
            raise ConfigError(f"'{argument}' is not of the form key=value; keys: {', '.join(defaults) or 'none'}")
        check_known("key", [key], defaults)
        if isinstance(defaults[key], int) and not text.isdecimal():
            raise ConfigError(f"{key} must be a whole number, but is '{text}'")
        options[key] = type(defaults[key])(text)
    return options


def check_known(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuse, by a ConfigError, names that are not known."""
    known = list(known)
    for name in names:
        if name not in known:
            listed = f"; known: {', '.join(known)}" if len(known) <= 20 else ""
            raise ConfigError(f"unknown {what} '{name}'{nearest(name, known) or listed}")


def run_script(main: Callable[[list[str]], object]) -> NoReturn:
    """Run a script on the arguments of this process and end it; a user's error is one sentence and status 2."""
    try:
        main(sys.argv[1:])
    except (ConfigError, CheckpointError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit()
