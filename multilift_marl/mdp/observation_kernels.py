"""Compiled functions that write observations and the global state, composed of the tables of their components."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, sin
from typing import Any

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import compose, is_plain
from multilift_marl.math3d import turn
from multilift_marl.mdp.env_data import Call, View, bind_kernel, in_turn
from multilift_marl.mdp.global_state import StateComponents
from multilift_marl.mdp.observations import Component, count_numbers, list_components, previous_action

_TO_TARGET = "c, s = cos(v.goal.yaw[e]), -sin(v.goal.yaw[e])"  # from the world to the target's heading frame


def compose_observation(extra: tuple[Component, ...], action: str) -> Any:
    """Return the kernel of (lo, hi, View, observation (E, N, D)) that writes what drones observe.

    Args:
        extra: what the task adds.
        action: the action interface.
    """
    functions: dict[str, Any] = {"turn": turn}
    lines = ["def observe(lo, hi, v, observation):", "    for e in range(lo, hi):"]
    lines += ["        for n in range(observation.shape[1]):", "            own = observation[e, n]"]
    lines.append("            c, s = v.goal.slot_frame[e, n, 0], -v.goal.slot_frame[e, n, 1]")  # world to slot frame
    lines += [f"            {line}" for line in _write("own", "0", "n", list_components(action, extra), functions)]
    return compose("observe", "\n".join(lines) + "\n", functions)


def bind_state(
    parts: StateComponents, preview: Callable[..., Any] | None, view: View, critic: np.ndarray, action_size: int
) -> Call:
    """Return the call of (lo, hi) that writes the global state (E, S), in the target's heading frame.

    What is hidden has a kernel of its own, so that teams from which other quantities are hidden share the rest.

    Args:
        parts: what it holds.
        preview: inlined kernel of (e, View), called first; None for none.
        view: of the true states.
        critic: (E, S) what is written.
        action_size: numbers of an action.
    """
    hidden = count_numbers(parts.hidden_drone)
    known = bind_kernel(compose_state(parts, preview), view, critic, hidden)
    if not parts.hidden_drone and not parts.hidden:
        return known
    first, rows, width = parts.drone_numbers(view.action.shape[1], action_size)
    written = count_numbers([part for part in parts.extra if not is_plain(part.value)])
    at = np.array([first + width - action_size - hidden, width, first + rows * width + written])
    return in_turn(known, bind_kernel(compose_hidden(parts), view, critic, at))


def compose_state(parts: StateComponents, preview: Callable[..., Any] | None) -> Any:
    """Return the kernel of (lo, hi, View, critic (E, S), hidden) that writes what is not hidden of the global state.

    Args:
        parts: what it holds.
        preview: see `bind_state`.

    `hidden` is the number of hidden quantities of each drone, for which it leaves room.
    """
    functions: dict[str, Any] = {"turn": turn, "cos": cos, "sin": sin} | ({"preview": preview} if preview else {})
    lines = ["def observe_state(lo, hi, v, critic, hidden):", "    for e in range(lo, hi):", "        out = critic[e]"]
    lines += ["        preview(e, v)"] if preview else []
    lines.append(f"        {_TO_TARGET}")
    lines += [f"        {line}" for line in _write("out", "0", "0", parts.team, functions)]
    lines.append("        for n in range(v.action.shape[1]):")
    lines += [f"            {line}" for line in _write("out", "at", "n", parts.drone, functions)]
    lines.append("            at += hidden")
    lines += [f"            {line}" for line in _write("out", "at", "n", (previous_action(0),), functions)]
    lines += [f"        {line}" for line in _write("out", "at", "0", parts.extra, functions)]
    return compose("observe_state", "\n".join(lines) + "\n", functions)


def compose_hidden(parts: StateComponents) -> Any:
    """Return the kernel of (lo, hi, View, critic (E, S), places (3,)) that writes what is hidden.

    `places` are that of the first number of the first drone, how far apart those of drones are, and that of the team's.
    """
    functions: dict[str, Any] = {"turn": turn, "cos": cos, "sin": sin}
    lines = ["def observe_hidden(lo, hi, v, critic, places):", "    for e in range(lo, hi):", "        out = critic[e]"]
    lines.append(f"        {_TO_TARGET}")
    if parts.hidden_drone:
        lines += ["        for n in range(v.action.shape[1]):", "            at = places[0] + n * places[1]"]
        lines += [f"            {line}" for line in _write("out", "at", "n", parts.hidden_drone, functions)]
    lines.append("        at = places[2]")
    lines += [f"        {line}" for line in _write("out", "at", "0", parts.hidden, functions)]
    return compose("observe_hidden", "\n".join(lines) + "\n", functions)


def _write(out: str, at: str, drone: str, parts: Sequence[Component], functions: dict[str, Any]) -> list[str]:
    """Return statements that write components one after the other, vectors turned by `c` and `s`.

    They leave in `at` where the next number goes. How many numbers a field has they read from its array, so that teams
    with other actions or sensors share a kernel.

    Args:
        out: what is written to.
        at: where, the number of the first or the variable `at`.
        drone: number of the drone.
        parts: the components.
        functions: what the statements call, by name; written.
    """
    lines, size = [], 0  # numbers after `at`
    for part in parts:
        if is_plain(part.value):
            continue  # these come last
        if part.field is not None:
            lines += [f"at = {at} + {size}", f"for k in range(v.{part.field}.shape[2]):"]
            lines += [f"    {out}[at + k] = v.{part.field}[e, {drone}, k]", f"at += v.{part.field}.shape[2]"]
            at, size = "at", 0
            continue
        name = f"{part.name}_{len(functions)}"
        functions[name] = part.value
        call = f"{name}(e, {drone}, v)"
        target = ", ".join(f"{out}[{at} + {size + k}]" for k in range(part.size))
        lines.append(f"{target} = {f'turn(c, s, {call})' if part.is_turned else call}{'[:2]' if part.is_cut else ''}")
        size += part.size
    return [*lines, f"at = {at} + {size}"]


def check_written(written: np.ndarray, parts: Sequence[Component], what: str) -> None:
    """Refuse components of which a number (..., D) is not finite, by a ConfigError that names the first."""
    names = [f"{part.name}_{i}" for part in parts for i in range(part.size)]
    bad = ~np.isfinite(written.reshape(-1, len(names))).all(axis=0)
    if bad.any():
        raise ConfigError(f"{names[int(bad.argmax())]} of the {what} is not finite; mend what computes it")
