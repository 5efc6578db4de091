"""How the scripts of this folder take their arguments, and end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NoReturn

from multilift_marl.errors import CheckpointError, ConfigError, nearest


def read_options(arguments: Iterable[str], defaults: Mapping[str, Any], zero: Collection[str] = ()) -> dict[str, Any]:
    """Return the options key=value of a script, each of the type of its default: text or a whole number.

    Args:
        arguments: of the script.
        defaults: by key.
        zero: keys of numbers that may be 0.

    Raises:
        ConfigError: an argument of another form, a key that there is not, or no such number.
    """
    options = dict(defaults)
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals:
            raise ConfigError(f"'{argument}' is not of the form key=value; keys: {', '.join(defaults) or 'none'}")
        check_known("key", [key], defaults)
        if isinstance(defaults[key], int) and not (text.isdecimal() and (int(text) or key in zero)):
            least = 0 if key in zero else 1
            raise ConfigError(f"{key} must be a whole number of at least {least}, but is '{text}'")
        options[key] = type(defaults[key])(text)
    return options


def check_known(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuse, by a ConfigError, names that are not known."""
    known = list(known)
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown {what} '{name}'{nearest(name, known)}")


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
