"""Reward terms: a name, a weight, a function and its margins in one entry; the functions that tasks share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import radians
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.kernels.jit import compose, inlined, is_plain
from multilift_marl.math3d import norm, row, sub, vec
from multilift_marl.schema.sections import RewardTerm

HARMLESS = 0.75  # tensions up to this share of the limit are no snatch


class Term(NamedTuple):
    """One term of a task's reward: `weight` times `value`."""

    weight: float
    """`reward.<name>.weight` overrides it."""
    value: Callable[..., Any]
    """Inlined kernel of (environment, View, *margins) that returns a number, or a NumPy function of (View, *margins)
    that returns an array (E,)."""
    margin: float | tuple[float, ...] = ()
    """Errors at which a tolerance is half its value; `reward.<name>.margin` overrides them."""
    unit: str = ""
    """Of the margins; with "deg" the function gets radians."""

    @property
    def margins(self) -> tuple[float, ...]:
        """The margins, none to several."""
        return self.margin if isinstance(self.margin, tuple) else (self.margin,)


class RestBounds(NamedTuple):
    """What counts as a payload at rest at its target."""

    distance: float
    """[m]."""
    angle: float = np.inf
    """Of the rotation from the target attitude [rad]."""
    speed: float = np.inf
    """[m/s]."""
    body_rate: float = np.inf
    """[rad/s]."""

    @classmethod
    def of(cls, options: Any) -> RestBounds:
        """Return `success_distance`, `success_angle`, `success_speed` and `success_body_rate` of a task's options.

        Raises:
            ConfigError: one of the first two is no field of theirs.
        """
        for name in ("success_distance", "success_angle"):
            if not hasattr(options, name):
                raise ConfigError(
                    f"the task's Options have no {name}; add the field, or override prepare() to set `settings`"
                )
        # Bounds of motion that the options do not have are infinite: every motion keeps to them.
        speed, body_rate = (getattr(options, f"success_{name}", np.inf) for name in ("speed", "body_rate"))
        return cls(options.success_distance, radians(options.success_angle), speed, body_rate)


def describe(value: Callable[..., Any]) -> str:
    """Return what a reward term's function says that it pays."""
    return (value.__doc__ or "").strip().rstrip(".")


def resolve_reward(
    task: str, terms: Mapping[str, Term], values: Mapping[str, RewardTerm]
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (T,) and margins (T, M) of a task's terms, angles in radians, with configured `values` in place.

    Raises:
        ConfigError: an unknown term, or another number of margins than it has.
    """
    for name, given in values.items():
        if name not in terms:
            hint = nearest(name, terms, lambda near: f"reward.{near}")
            raise ConfigError(f"unknown key 'reward.{name}' of task {task}{hint}")
        count = len(terms[name].margins)
        if given.margin is not None and len(given.margin) != count:
            raise ConfigError(f"reward.{name}.margin lists {len(given.margin)} numbers, but the term has {count}")
    weights = np.array([term.weight for term in terms.values()], float)
    # As wide as the term with most margins needs; what the others leave over is never read.
    margins = np.ones((len(terms), max((len(term.margins) for term in terms.values()), default=0)))
    for i, (name, term) in enumerate(terms.items()):
        given = values.get(name, RewardTerm())
        weights[i] = term.weight if given.weight is None else given.weight
        chosen = term.margins if given.margin is None else given.margin
        margins[i, : len(chosen)] = [radians(margin) if term.unit == "deg" else margin for margin in chosen]
    return weights, margins


def compose_reward(terms: Mapping[str, Term], is_good: Callable[..., Any], update: Callable[..., Any] | None) -> Any:
    """Return the kernel of (lo, hi, View, weights (T,), margins (T, M)) that writes `good_time` and terms by kernels.

    Args:
        terms: of the reward.
        is_good: inlined kernel of (e, View): whether the payload is within the success region.
        update: inlined kernel of (e, View) called last, None for none.
    """
    functions = {"is_good": is_good} | ({"update": update} if update else {})
    lines = ["def reward(lo, hi, v, weights, margins):", "    for e in range(lo, hi):"]
    for i, (name, term) in enumerate(terms.items()):
        # A NumPy function writes column i itself, see `NumpyFunctions.judge`.
        if is_plain(term.value):
            continue
        functions[f"{name}_value"] = term.value
        margins = "".join(f", margins[{i}, {k}]" for k in range(len(term.margins)))
        lines.append(f"        v.terms[e, {i}] = weights[{i}] * {name}_value(e, v{margins})")
    # After the terms, which see the time before this step, and before the task's own `update`, which sees it with it.
    lines.append("        v.good_time[e] = v.good_time[e] + v.dt if is_good(e, v) else 0.0")
    if update:
        lines.append("        update(e, v)")
    return compose("reward", "\n".join(lines) + "\n", functions)


@inlined
def tolerance(value, margin):
    """Return 1 at value 0, falling with a long tail: 1/2 at `margin`, 1/10 at three times the margin."""
    return 1.0 / (1.0 + (value / margin) ** 2)


@inlined
def distance(e, v, margin):
    """Payload close to its target."""
    return tolerance(v.errors.distance[e], margin)


@inlined
def attitude(e, v, margin):
    """Payload close to its target's attitude."""
    return tolerance(v.errors.angle[e], margin)


@inlined
def failure(e, v):
    """1 in the step in which the team fails."""
    return 1.0 if v.cause[e] != 0 else 0.0


@inlined
def stillness(e, v, speed, body_rate):
    """Payload slow, and turning slowly."""
    velocity, rates = norm(row(v.state.payload_velocity, e)), norm(row(v.state.payload_body_rates, e))
    # A product pays for both at once; a sum would pay half for a payload that spins on the spot.
    return tolerance(velocity, speed) * tolerance(rates, body_rate)


@inlined
def velocity(e, v, margin):
    """Payload as fast as its target, in the same direction."""
    return tolerance(norm(sub(row(v.state.payload_velocity, e), row(v.goal.velocity, e))), margin)


@inlined
def body_rate(e, v, margin):
    """Payload turning slowly."""
    return tolerance(norm(row(v.state.payload_body_rates, e)), margin)


@inlined
def spin(e, v, limit):
    """Payload turning faster than the margin: the square of the excess over it, in margins."""
    return max(0.0, norm(row(v.state.payload_body_rates, e)) / limit - 1.0) ** 2


@inlined
def steadiness(e, v, speed, rate):
    """Payload as fast as its target, and turning slowly."""
    return velocity(e, v, speed) * body_rate(e, v, rate)


@inlined
def closeness(e, v, apart, above):
    """Drones near each other, or too low above the payload: each from 0 at its margin to 1 where the episode fails."""
    total = 0.0
    for n in range(v.state.drone_position.shape[1]):
        if v.mask.lost[e, n]:
            continue
        drone = vec(v.state.drone_position, e, n)
        total += max(0.0, 1.0 - (drone[2] - v.state.payload_position[e, 2]) / above) ** 2
        for m in range(n):
            if not v.mask.lost[e, m]:
                # 0 where the episode would end, so that the term reaches 1 just there.
                gap = norm(sub(drone, vec(v.state.drone_position, e, m))) - v.limits.separation[n, m]
                total += max(0.0, 1.0 - gap / apart) ** 2
    return total


@inlined
def formation(e, v, margin):
    """Drones close to their slots, the mean over those that are left."""
    total, count = 0.0, 0
    for n in range(v.state.drone_position.shape[1]):
        if not v.mask.lost[e, n]:
            off = norm(sub(vec(v.state.drone_position, e, n), vec(v.goal.slots, e, n)))
            total, count = total + tolerance(off, margin), count + 1
    return total / max(count, 1)


@inlined
def action_rate(e, v):
    """Mean square of how the action differs from the last one."""
    change, count = 0.0, v.action.shape[1] * v.action.shape[2]
    for n in range(v.action.shape[1]):
        for k in range(v.action.shape[2]):
            change += (v.action[e, n, k] - v.previous[e, n, k]) ** 2
    return change / count


@inlined
def is_at_rest(e, v, bounds):
    """Return whether the payload of environment e is at its target, in its attitude, and does not move."""
    placed = v.errors.distance[e] <= bounds.distance and v.errors.angle[e] <= bounds.angle
    speed, rate = norm(row(v.state.payload_velocity, e)), norm(row(v.state.payload_body_rates, e))
    return placed and speed <= bounds.speed and rate <= bounds.body_rate


@inlined
def snatch(e, v):
    """Rise of the episode's largest tension in this step above 75 % of the limit, over that limit."""
    # For tasks whose `own` has `peak_tension` and `counted_tension` (E,), which `Kernels.update` brings into line, and
    # whose `settings` have the limit `tension`.
    # Rises alone add up to the episode's peak, whatever the steps: an old snatch does not count again.
    counted = max(v.own.counted_tension[e], HARMLESS * v.settings.tension)
    return max(v.own.peak_tension[e] - counted, 0.0) / v.settings.tension


@inlined
def update_peak_tension(e, v, peak):
    """Raise `peak` (E,) to the largest tension of environment e over the resting tension of its cable [-].

    The tension is `state.cable_tension`, the mean over the last physics step. The cables of lost drones do not count.
    """
    for n in range(v.resting_tension.shape[0]):
        if not v.mask.lost[e, n]:
            peak[e] = max(peak[e], v.state.cable_tension[e, n] / v.resting_tension[n])
