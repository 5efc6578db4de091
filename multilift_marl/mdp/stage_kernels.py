"""Compiled functions of a step that call a task's own kernels: the plan, and the measurement of errors and failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.control.formation import place_formation
from multilift_marl.kernels.jit import compose, kernel
from multilift_marl.math3d import matrow, put, putmat, row, scale, sub
from multilift_marl.mdp.env_data import update_errors
from multilift_marl.mdp.failures import find_cause, find_obstacle


class Ahead(NamedTuple):
    """Where functions have put the goals of a policy step, at its end."""

    position: np.ndarray
    """(E, 3) [m]."""
    rotation: np.ndarray
    """(E, 3, 3)."""
    velocity: np.ndarray
    """(E, 3) [m/s]."""
    acceleration: np.ndarray
    """(E, 3) [m/s²]."""
    time: np.ndarray
    """(E,) of that end [s]."""


@kernel
def approach(lo, hi, v, ahead):
    """Advance time by a control step, and move the goals of environments lo to hi on towards where they are `ahead`."""
    goal = v.goal
    for e in range(lo, hi):
        v.time[e] += v.control_dt
        left = ahead.time[e] - v.time[e]
        velocity, acceleration = row(ahead.velocity, e), row(ahead.acceleration, e)
        # Back from the end of the step at its constant acceleration: p(t) = p - v s + ½ a s² with s the time left.
        way = sub(scale(left, velocity), scale(0.5 * left * left, acceleration))
        put(goal.position[e], sub(row(ahead.position, e), way))
        putmat(goal.rotation[e], matrow(ahead.rotation, e))
        put(goal.velocity[e], sub(velocity, scale(left, acceleration)))
        put(goal.acceleration[e], acceleration)
        place_formation(e, goal, v.rig)


def compose_plan(plan: Callable[..., Any]) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View) that advances time by a control step, then calls `plan` of (e, View)."""
    source = """def advance_plan(lo, hi, v):
    for e in range(lo, hi):
        v.time[e] += v.control_dt
        plan(e, v)
"""
    return compose("advance_plan", source, {"plan": plan})


def compose_check(
    check: Callable[..., Any] | None,
    advances: bool,
    own: Mapping[int, Callable[..., Any]] | None = None,
    obstacles: bool = False,
) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View, dt) that measures errors, integrates them over `dt` [s], finds failures.

    A failure that the task has found by itself, here or earlier in the step, stays the cause.

    Args:
        check: inlined kernel of (e, View) that finds the task's own failures; None for none.
        advances: whether time advances here, because no plan does that.
        own: inlined kernels of (e, View), whether the task's own failures with these numbers have happened, which count
            after all others.
        obstacles: whether there are any, which cost some compilation.
    """
    lines = ["def check(lo, hi, v, dt):", "    for e in range(lo, hi):"]
    lines += ["        v.time[e] += dt"] if advances else []
    lines.append("        update_errors(e, 0, v.payload, v.true_errors, v, dt)")
    lines += ["        find_own(e, v)"] if check else []
    # In any case, for it also keeps the least separation.
    lines.append("        cause = find_cause(e, v)")
    lines.append("        v.cause[e] = cause if v.cause[e] == 0 else v.cause[e]")
    if obstacles:
        lines.append("        touched = find_obstacle(e, v)")
        lines.append("        v.cause[e] = touched if v.cause[e] == 0 else v.cause[e]")
    functions: dict[str, Callable[..., Any]] = {"update_errors": update_errors, "find_cause": find_cause}
    functions |= {"find_obstacle": find_obstacle} if obstacles else {}
    functions |= {"find_own": check} if check else {}
    for number, has_failed in (own or {}).items():
        lines.append(f"        if v.cause[e] == 0 and failure_{number}(e, v):")
        lines.append(f"            v.cause[e] = {number}")
        functions[f"failure_{number}"] = has_failed
    return compose("check", "\n".join(lines) + "\n", functions)


def in_turn(first: Callable[[int, int], None], then: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Return a call of (lo, hi) that makes both, one after the other."""

    def call(lo: int, hi: int) -> None:
        first(lo, hi)
        then(lo, hi)

    return call
