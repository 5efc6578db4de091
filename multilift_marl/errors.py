"""The package's exceptions: one sentence that names the culprit and the cure."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Iterable
from functools import cache

_ELSEWHERE = {
    "steps": "frames", "timesteps": "frames", "total_timesteps": "frames", "num_steps": "frames", "lr": "learning_rate",
    "max_steps": "episode_seconds", "episode_steps": "episode_seconds", "agents": "num_drones",
    "num_agents": "num_drones", "n_agents": "num_drones", "std": "initial_std", "hidden_sizes": "hidden",
    "rollout_length": "horizon", "n_drones": "num_drones", "num_quadrotors": "num_drones", "nr_drones": "num_drones",
    "max_cycles": "episode_seconds", "max_episode_steps": "episode_seconds", "episode_len_sec": "episode_seconds",
    "max_episode_length": "episode_seconds", "max_duration_seconds": "episode_seconds", "time_limit": "episode_seconds",
    "episode_length": "episode_seconds", "agent_hz": "policy_hz", "ctrl_freq": "policy_hz", "control_freq": "policy_hz",
    "decimation": "policy_hz", "frame_skip": "policy_hz", "pyb_freq": "timestep", "physics_hz": "timestep",
    "sim_freq": "timestep", "dt": "timestep", "time_step": "timestep", "drone_model": "preset", "drone_type": "preset",
    "n_envs": "num_envs", "n_worlds": "num_envs", "num_worlds": "num_envs", "num_environments": "num_envs",
    "flight_mode": "action", "action_type": "action", "act": "action", "frame_stack": "history",
    "n_steps": "horizon", "n_epochs": "epochs", "clip_range": "clip", "clip_coef": "clip", "ent_coef": "entropy",
    "vf_coef": "value_weight", "anneal_lr": "final_learning_rate", "total_frames": "frames",
}  # fmt: skip
"""What other libraries call a key, and what it is called here."""


class ConfigError(ValueError):
    """A configuration, an override or a physical system that cannot be."""


class RigError(ConfigError):
    """A rig that cannot be because of some of its parts.

    Args:
        message: one sentence.
        drones, anchors: numbers of the parts that conflict.
    """

    def __init__(self, message: str, drones: Iterable[int] = (), anchors: Iterable[int] = ()):
        super().__init__(message)
        self.drones = tuple(int(i) for i in drones)
        self.anchors = tuple(int(i) for i in anchors)


class UnknownKeywordError(ConfigError, TypeError):
    """A keyword argument that is none: a TypeError, too, since libraries try out keywords and drop those refused."""


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, truncated or foreign."""


class RenderingError(RuntimeError):
    """Pictures were asked for and cannot be made."""


class FlightError(RuntimeError):
    """Flight software that does not start, answer or do as it is told."""


def called_elsewhere(name: str) -> str | None:
    """Return what a key of another library is called here; None if it is none that is known."""
    return _ELSEWHERE.get(name)


def nearest(name: str, names: Iterable[str], full: Callable[[str], str] = str, otherwise: str = "") -> str:
    """Return "; did you mean 'x'?" for the closest of `names`, or the list of them where none is close.

    A key's name in other libraries is close to ours.

    Args:
        name: what was given.
        names: what is known.
        full: turns the closest into what is to be written in its place.
        otherwise: the cure where none is close.
    """
    names = sorted(names)
    known = _ELSEWHERE.get(name)
    close = [known] if known in names else difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return f"; did you mean '{full(close[0])}'?" if close else f"; known: {', '.join(names)}{otherwise}"


def shorten(value: object, most: int = 80) -> str:
    """Return a value as text of one line, cut where it is long."""
    text = "".join(char if char.isprintable() else repr(char)[1:-1] for char in str(value)[: 2 * most])
    return text if len(text) <= most else f"{text[: most - 1]}…"


@cache
def warn_once(part: str, message: str) -> None:
    """Log a warning of a part of the package, to the logger multilift_marl.<part>, the same one once in a process.

    Where nobody has set up logging, Python shows it on stderr.
    """
    logging.getLogger(f"multilift_marl.{part}").warning(message)


def pip_install(extra: str) -> str:
    """Return how to install an extra of this package, which is on no package index."""
    return f'pip install -e ".[{extra}]" in a clone of its repository'


def reason(error: BaseException) -> str:
    """Return what went wrong in few words, such as "No space left on device"."""
    message = error.strerror if isinstance(error, OSError) else None
    return message or str(error).partition("\n")[0] or type(error).__name__
