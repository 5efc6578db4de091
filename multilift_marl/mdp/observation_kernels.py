"""Compiled functions that write observations and the global state, composed of the tables of their components."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, sin
from typing import Any

import numpy as np

from multilift_marl.control.actions import ACTIONS
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import compose, is_plain
from multilift_marl.math3d import turn
from multilift_marl.mdp.global_state import StateComponents
from multilift_marl.mdp.observations import OBSERVATION_SIZE, Component, list_components


def compose_observation(extra: tuple[Component, ...], action: str) -> Any:
    """Return the kernel of (lo, hi, View, observation (E, N, D)) that writes what drones observe.

    Args:
        extra: what the task adds.
        action: the action interface.
    """
    functions: dict[str, Any] = {"turn": turn}
    size, action_size = OBSERVATION_SIZE, len(ACTIONS[action].numbers)
    own = _write("own", "", "n", list_components(action)[:-1], functions)
    own += [f"own[{size + k}] = v.action[e, n, {k}]" for k in range(action_size)]
    own += _write("own", f"{size + action_size} + ", "n", extra, functions)
    lines = ["def observe(lo, hi, v, observation):", "    for e in range(lo, hi):"]
    lines += ["        for n in range(observation.shape[1]):", "            own = observation[e, n]"]
    lines.append("            c, s = v.goal.slot_frame[e, n, 0], -v.goal.slot_frame[e, n, 1]")  # world to slot frame
    lines += [f"            {line}" for line in own]
    return compose("observe", "\n".join(lines) + "\n", functions)


def compose_state(parts: StateComponents, preview: Callable[..., Any] | None, action_size: int) -> Any:
    """Return the kernel of (lo, hi, View, critic (E, S)) that writes the global state, in the target's heading frame.

    Args:
        parts: what it holds.
        preview: inlined kernel of (e, View), called first; None for none.
        action_size: numbers of an action.
    """
    functions: dict[str, Any] = {"turn": turn, "cos": cos, "sin": sin} | ({"preview": preview} if preview else {})
    first, _, size = parts.drone_numbers(0, action_size)
    drone = _write("out", "at + ", "n", parts.drone, functions)
    drone += [f"out[at + {size - action_size + k}] = v.action[e, n, {k}]" for k in range(action_size)]
    lines = ["def observe_state(lo, hi, v, critic):", "    for e in range(lo, hi):", "        out = critic[e]"]
    lines += ["        preview(e, v)"] if preview else []
    lines.append("        c, s = cos(v.goal.yaw[e]), -sin(v.goal.yaw[e])")  # world to the target's heading frame
    lines += [f"        {line}" for line in _write("out", "", "0", parts.team, functions)]
    lines += ["        for n in range(v.action.shape[1]):", f"            at = {first} + n * {size}"]
    lines += [f"            {line}" for line in drone]
    lines.append(f"        at = {first} + v.action.shape[1] * {size}")
    lines += [f"        {line}" for line in _write("out", "at + ", "0", parts.rest, functions)]
    return compose("observe_state", "\n".join(lines) + "\n", functions)


def _write(out: str, at: str, drone: str, parts: Sequence[Component], functions: dict[str, Any]) -> list[str]:
    """Return statements that write components one after the other, vectors turned by `c` and `s`.

    Args:
        out: what is written to.
        at: position of the first number, such as "3 + ".
        drone: number of the drone.
        parts: the components.
        functions: what the statements call, by name; written.
    """
    lines, size = [], 0
    for part in parts:
        if is_plain(part.value):
            continue  # these come last
        if part.field is not None:
            lines.append(f"for k in range({part.size}):")
            lines.append(f"    {out}[{at}{size} + k] = v.{part.field}[e, {drone}, k]")
            size += part.size
            continue
        name = f"{part.name}_{len(functions)}"
        functions[name] = part.value
        call = f"{name}(e, {drone}, v)"
        target = ", ".join(f"{out}[{at}{size + k}]" for k in range(part.size))
        lines.append(f"{target} = {f'turn(c, s, {call})' if part.is_turned else call}{'[:2]' if part.is_cut else ''}")
        size += part.size
    return lines


def check_written(written: np.ndarray, parts: Sequence[Component], what: str) -> None:
    """Refuse components of which a number (..., D) is not finite, by a ConfigError that names the first."""
    names = [f"{part.name}_{i}" for part in parts for i in range(part.size)]
    bad = ~np.isfinite(written.reshape(-1, len(names))).all(axis=0)
    if bad.any():
        raise ConfigError(f"{names[int(bad.argmax())]} of the {what} is not finite; mend what computes it")
