"""Compiled functions of a step that call a task's own kernels: the plan, and the measurement of errors and failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.control.formation import place_formation
from multilift_marl.kernels.jit import compose, kernel
from multilift_marl.math3d import matrow, put, putmat, row, scale, sub
from multilift_marl.mdp.env_data import Call, View, bind_kernel, in_turn, update_errors
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


@kernel
def measure_errors(lo, hi, v, dt, passed):
    """Advance the time of environments lo to hi by `passed`, measure their errors, integrate these over `dt` [s]."""
    for e in range(lo, hi):
        v.time[e] += passed
        update_errors(e, 0, v.payload, v.true_errors, v, dt)


@kernel
def find_failures(lo, hi, v):
    """Find the failures that all tasks share in environments lo to hi; a cause that is there stays."""
    for e in range(lo, hi):
        cause = find_cause(e, v)  # in any case, for it also keeps the least separation
        v.cause[e] = cause if v.cause[e] == 0 else v.cause[e]


@kernel
def find_touches(lo, hi, v):
    """Find out in which environments lo to hi something touches an obstacle; a cause that is there stays."""
    for e in range(lo, hi):
        touched = find_obstacle(e, v)
        v.cause[e] = touched if v.cause[e] == 0 else v.cause[e]


def compose_check(check: Callable[..., Any]) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View) that calls `check` of (e, View), which finds a task's own failures."""
    source = """def check(lo, hi, v):
    for e in range(lo, hi):
        find_own(e, v)
"""
    return compose("check", source, {"find_own": check})


def compose_failures(own: Mapping[int, Callable[..., Any]]) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View) that finds a task's own failures; a cause that is there stays.

    Args:
        own: inlined kernels of (e, View), whether the failures with these numbers have happened.
    """
    lines = ["def find_own_failures(lo, hi, v):", "    for e in range(lo, hi):"]
    for number in own:
        lines.append(f"        if v.cause[e] == 0 and failure_{number}(e, v):")
        lines.append(f"            v.cause[e] = {number}")
    functions = {f"failure_{number}": has_failed for number, has_failed in own.items()}
    return compose("find_own_failures", "\n".join(lines) + "\n", functions)


def bind_check(
    view: View,
    dt: float,
    check: Callable[..., Any] | None,
    own: Mapping[int, Callable[..., Any]],
    obstacles: bool,
    passed: float,
) -> Call:
    """Return the call of (lo, hi) that measures errors, integrates them over `dt` [s] and finds failures.

    A failure that the task has found by itself, here or earlier in the step, stays the cause. What tasks have in common
    are kernels of their own, compiled once.

    Args:
        view: what they read and write.
        dt: [s].
        check: inlined kernel of (e, View) that finds the task's own failures; None for none.
        own: see `compose_failures`; they count after all others.
        obstacles: whether there are any.
        passed: by which time advances [s].
    """
    calls = [bind_kernel(measure_errors, view, dt, passed)]
    calls += [bind_kernel(compose_check(check), view)] if check else []
    calls.append(bind_kernel(find_failures, view))
    calls += [bind_kernel(find_touches, view)] if obstacles else []
    calls += [bind_kernel(compose_failures(own), view)] if own else []
    return in_turn(*calls)
