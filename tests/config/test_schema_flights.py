"""What validation lets through flies: a second of the script `formation` without a number that is not finite.

Configurations are drawn from the schema itself: one or two keys, each as far from its usual value as validation lets it
go, or part of that way. `FLIGHT_DRAWS=2000 pytest tests/config/test_schema_flights.py` draws more of them.
"""

from __future__ import annotations

import math
import os
import typing
from functools import cache
from typing import Any

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.errors import ConfigError
from multilift_marl.schema.values import Between, Section

pytest.importorskip("hypothesis")  # of the dev extra
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

DRAWS = int(os.environ.get("FLIGHT_DRAWS", "40"))
SECTIONS = ("env", "sim", "vehicle", "payload", "cable", "control", "randomization", "wind")
SIZES = ("env.num_envs", "env.num_threads")  # cost memory and threads, and change nothing else
FILES = ("payload.mesh",)
NESTED = ("env.obstacles",)  # a section of its own: tests/sensing/test_obstacle_sensing.py
CHAIN = {"cable.model": "chain", "cable.segments": 3, "cable.bending_stiffness": 1e-3}
BASES = {
    "massless": ("hover", {}),
    "chain": ("hover", {"env.num_drones": 3, **CHAIN}),
    "point": ("rigs/crazyflie2", {}),
    "mixed": ("hover", {"env.num_drones": 3, "vehicle.preset": ["falcon", "hummingbird", "falcon"]}),
}
USUAL: dict[str, Any] = {  # of keys that are None, zero or lists by default
    "vehicle.mass": 0.6, "vehicle.inertia": 2e-3, "vehicle.arm": 0.1, "vehicle.thrust_coefficient": 2e-6,
    "vehicle.torque_ratio": 0.02, "vehicle.rotor_time_constant_up": 0.03, "vehicle.rotor_time_constant_down": 0.03,
    "vehicle.rotor_speed_min": 100.0, "vehicle.rotor_thrust_max": 5.0, "vehicle.drag": 0.2,
    "vehicle.rotor_radius": 0.06, "vehicle.rolling_moment": 1e-7, "vehicle.rotor_inertia": 1e-5, "payload.mass": 1.0,
    "vehicle.rotor_solidity": 0.1,
    "payload.size": 0.5, "payload.inertia": 0.03, "payload.center_of_mass": 1e-3, "payload.anchors": 0.2,
    "cable.length": 1.0, "cable.breaking_load": 500.0, "cable.bending_damping": 1e-3, "cable.hook": 1e-3,
}  # fmt: skip
POINT = {
    "payload.mass": 0.01, "cable.length": 0.3, "vehicle.mass": 0.034, "vehicle.inertia": 2e-5, "vehicle.arm": 0.046,
    "vehicle.thrust_coefficient": 1.3e-8, "vehicle.rotor_speed_min": 1.0, "vehicle.rotor_thrust_max": 0.14,
    "vehicle.rotor_inertia": 2e-8, "vehicle.rolling_moment": 1e-10, "vehicle.drag": 1e-3,
}  # fmt: skip
DELAYS = ("randomization.action_delay", "randomization.observation_delay")


def leaves() -> dict[str, Any]:
    """Return the fields of all keys that shape a flight, by dotted name."""
    return {
        f"{section}.{key}": field
        for section in SECTIONS
        for key, field in typing.cast(type[Section], Config.model_fields[section].annotation).model_fields.items()
        if f"{section}.{key}" not in (*SIZES, *FILES, *NESTED)
    }


FIELDS = leaves()


@cache
def base(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values of a base, by section and by dotted name."""
    config, overrides = BASES[name]
    values = ml.load_config(config, overrides).model_dump()
    flat = {key: values[key.split(".")[0]][key.split(".")[1]] for key in FIELDS}
    return values, flat


def choices(key: str) -> list[Any]:
    """Return the values of a key that has only a few; none of one that is a number."""
    if key == "vehicle.preset":
        return ["falcon", "crazyflie", "crazyflie_id", "hummingbird", "iris", "x500"]
    if key == "vehicle.rotor_spin":
        return [[-1, 1, -1, 1], [1, -1, 1, -1]]
    if key == "vehicle.rotor_azimuth":
        return [[0, 90, 180, 270], [10, 170, 190, 350], [80, 100, 260, 280], [-315, -225, -135, -45]]
    annotation = FIELDS[key].annotation
    return [True, False] if annotation is bool else list(typing.get_args(annotation)) if is_literal(annotation) else []


def is_literal(annotation: Any) -> bool:
    return typing.get_origin(annotation) is typing.Literal


def spread(key: str, size: float, n: int) -> Any:
    """Return a value of a key whose numbers are as large as `size`."""
    if key in ("vehicle.inertia", "vehicle.drag", "payload.size", "payload.inertia"):
        return [abs(size)] * 3
    if key in ("wind.velocity", "wind.gust"):
        return [size, 0.3 * size, 0.1 * size]
    if key in ("payload.center_of_mass", "cable.hook", "randomization.payload_center_of_mass"):
        return [0.5 * size, 0.3 * size, size]
    if key == "payload.anchors":
        turn = 2 * np.pi * np.arange(n) / n
        return np.stack([size * np.cos(turn), size * np.sin(turn), 0.05 + 0 * turn], axis=1).tolist()
    if FIELDS[key].annotation is int or key in ("cable.segments", *DELAYS):
        return round(size)
    return size


def bounds(key: str) -> tuple[float, float]:
    """Return the least and the largest number that the schema lets through for a key."""
    special = {"cable.segments": (2.0, 100.0), **dict.fromkeys(DELAYS, (0.0, 50.0))}
    if key in special:
        return special[key]
    low, high = 0.0, 1 - 1e-6  # of a share
    for part in FIELDS[key].metadata:
        if isinstance(part, Between):
            return part.low, part.high
        low = getattr(part, "ge", getattr(part, "gt", low))
        high = getattr(part, "le", getattr(part, "lt", high))
    return low, high


def accepted(values: dict[str, Any], overrides: dict[str, Any]) -> bool:
    """Return whether validation lets these values through."""
    try:
        build_config(values, overrides).system  # noqa: B018 (refused or not)
    except ConfigError:
        return False
    return True


def reach(values: dict[str, Any], overrides: dict[str, Any], key: str, usual: float, upward: bool, n: int) -> float:
    """Return how far `key` may go from its usual value, upward or downward, until validation refuses it."""
    low, high = bounds(key)
    whole = isinstance(spread(key, 2.0, n), int)
    ends = (max(usual, low), high) if upward else (usual, low)
    if accepted(values, overrides | {key: spread(key, ends[1], n)}):
        return ends[1]
    floor = 1e-12 * max(high, 1.0)
    good, bad = (max(abs(end), floor) for end in ends)
    for _ in range(4 if whole else 12):
        middle = math.sqrt(good * bad)
        if accepted(values, overrides | {key: spread(key, middle, n)}):
            good = middle
        else:
            bad = middle
    return good


@st.composite
def drawn(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """Return a base and what differs from it."""
    name = draw(st.sampled_from(sorted(BASES)))
    values, flat = base(name)
    overrides: dict[str, Any] = {}
    for key in draw(st.lists(st.sampled_from(sorted(FIELDS)), min_size=1, max_size=2, unique=True)):
        n = overrides.get("env.num_drones", flat["env.num_drones"])
        if few := choices(key):
            change = {key: draw(st.sampled_from(few))}
        else:
            own = flat[key][0] if isinstance(flat[key], tuple) and key != "payload.anchors" else flat[key]
            own = own[0] if isinstance(own, tuple) else own
            usual = float(own or (POINT if name == "point" else {}).get(key, USUAL.get(key, 0.0)))
            end = reach(values, overrides, key, usual, draw(st.booleans()), n)
            share = draw(st.sampled_from([1.0, 1.0, 0.9, 0.5]))
            size = usual * (end / usual) ** share if usual > 0 and end > 0 else share * end + (1 - share) * usual
            change = {key: spread(key, size, n)}
        if key == "sim.timestep":  # rates must divide each other
            step = 1 / (250 * max(1, math.floor(1 / (250 * change[key])))) if change[key] < 0.004 else 0.02
            change = {key: step, "sim.control_hz": 50.0 if step == 0.02 else 250.0, "control.attitude_frequency": 20.0}
        elif key in ("sim.control_hz", "env.policy_hz"):
            whole = [hz for hz in (1, 2, 5, 10, 25, 50, 125, 250) if hz <= max(change[key], 1)]
            change = {key: float(whole[-1]), **({"env.policy_hz": 1.0} if key == "sim.control_hz" else {})}
        if key == "control.disturbance" and change[key] != "none":
            change["control.action"] = "reference"
        if accepted(values, overrides | change):
            overrides |= change
    return name, overrides


def fly(config: Config, seconds: float = 1.0, longest: int = 2000) -> str:
    """Fly the script `formation`, and return what is wrong with the numbers; nothing if all are sound.

    Args:
        config: of the environment.
        seconds: to fly.
        longest: physics steps, at most.
    """
    try:
        vec = ml.make_vec(config, num_envs=1, num_threads=1)
        vec.reset(seed=0)
    except ConfigError:  # no start is free of failure: said in one sentence
        return ""
    steps = round(seconds * config.env.policy_hz)
    steps = max(1, min(steps, int(longest * config.sim.timestep * config.env.policy_hz)))
    for step in range(steps):
        observation, reward, terminated, truncated, info = vec.step(np.zeros((1, vec.num_drones, vec.action_size)))
        arrays = {"observation": observation, "reward": reward, "state": vec.state(), **vec.world.state._asdict()}
        wrong = [name for name, array in arrays.items() if not np.isfinite(array).all()]
        if wrong or info["diverged"].any():
            return f"step {step}: {wrong or 'diverged'}"
        if (terminated | truncated).any():
            vec.reset()
    return ""


@pytest.mark.slow
@settings(max_examples=DRAWS, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(drawn())
def test_what_validation_lets_through_flies(draw: tuple[str, dict[str, Any]]) -> None:
    name, overrides = draw
    assert not fly(build_config(base(name)[0], overrides))
