"""Loss: one drone's motors stop for good, and the others hold the payload."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, radians, sin
from typing import ClassVar

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Section
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.redistribution import RAMP, WAIT, plan_offset, redistributed_slots
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import norm, put, row, scale
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.rewards import RestBounds, action_rate, is_at_rest, tolerance, update_peak_tension
from multilift_marl.tasks.starts import StartOptions, make_ranges, start_near_target


class LossOptions(StartOptions):
    """When a drone is lost, where the team starts, and what counts as success."""

    loss_time: tuple[Float, Float] = Field((2.0, 4.0), description="[s] earliest and latest stop of the motors")
    snap: bool = Field(False, description="whether the lost drone's cable breaks, so that it is gone")
    success_distance: Float = Field(0.10, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(10.0, gt=0, description="[deg] ... and of its attitude, as level as can be held ...")
    success_speed: Float = Field(0.2, gt=0, description="[m/s] ... no faster than this ...")
    success_body_rate: Float = Field(0.5, gt=0, description="[rad/s] ... and turning no faster than this ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds, and ...")
    success_tension: Float = Field(
        20.0, gt=1,
        description="[-] no cable's tension at any time, mean of a physics step, over its resting tension; the lost "
        "drone's does not count",
    )  # fmt: skip


class Loss(Task):
    """Hold the payload with one drone less; see docs/loss.md."""

    name: ClassVar[str] = "loss"
    Options: ClassVar[type[Section]] = LossOptions
    options: LossOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.45,
        "precision": 0.25,
        "attitude": 0.15,
        "stillness": 0.15,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("lost", 1, "-", "-", "1 if the own motors have stopped"),
        Component("team_lost", 1, "-", "-", "1 if those of any drone have"),
        Component("lost_direction", 2, "slot", "-", "cosine and sine of its azimuth from the own one; 0 before"),
        Component("planned_offset", 3, "slot", "m", "by how much the own slot is to move after a loss, by a plan"),
    )
    EXTRA_STATE: ClassVar[int] = 4
    MIN_DRONES: ClassVar[int] = 2
    SAVED: ClassVar[tuple[str, ...]] = ("when", "who", "peak_tension")

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        early, late = self.options.loss_time
        if not 0 <= early <= late:
            raise ConfigError(f"task_options.loss_time={self.options.loss_time} must list the earlier one first")
        self._ranges = make_ranges(self.options)
        self.when, self.who = np.zeros(world.num_envs), np.zeros(world.num_envs, np.int64)
        world.breakable = world.breakable or self.options.snap
        self.peak_tension = np.zeros(world.num_envs)
        self._held = redistributed_slots(
            world.system, make_gains(config.control, world.system), not self.options.snap, config.control.max_offset
        )

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, start, drone and time; see `Task.start`."""
        start_near_target(env, rng, self.world.state, self.goal, self.rig, self._ranges, self.hanging, mass)
        self.who[env], self.when[env] = rng.integers(self.world.num_drones), rng.uniform(*self.options.loss_time)
        self.watch.lost[env], self.peak_tension[env] = False, 0.0

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Stop the motors when their time has come; see `Task.planner`."""
        state, hidden_loads = self.world.state, self.world.hidden_loads
        tensions = (self.world.system.resting_tension, self.peak_tension)
        return bind(
            _lose, lo, hi, self.time, self.control_dt, self.when, self.who, self.options.snap, state, hidden_loads,
            self.watch, tensions,
        )  # fmt: skip

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell who is lost; see `Task.observer`."""
        told = (self.time, self.when, self.who, self._held)
        return bind(_write_observation, lo, hi, told, not self.options.snap, self.watch, self.rig, observation, critic)

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for closeness, attitude and stillness; see `Task.scorer`."""
        option = self.options
        bounds = RestBounds(
            option.success_distance, radians(option.success_angle), option.success_speed, option.success_body_rate
        )
        return bind(
            _score, lo, hi, self.world.state, self.errors, action, previous, self.weights, bounds, self.dt,
            self.terms, self.good_time,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """At rest throughout the last seconds, with a drone less, and never too large a tension."""
        rested = (self.good_time >= self.options.success_seconds - 1e-9) & self.watch.lost.any(axis=1)
        return rested & (self.peak_tension <= self.options.success_tension)


@kernel
def _lose(lo, hi, time, dt, when, who, snap, state, hidden_loads, watch, tensions):
    resting, peak = tensions
    for e in range(lo, hi):
        time[e] += dt
        if time[e] >= when[e] and not watch.lost[e, who[e]]:
            watch.lost[e, who[e]] = True
            hidden_loads.motors_off[e, who[e]] = True
            if snap:
                state.cable_broken[e, who[e]] = True
        update_peak_tension(e, state, watch, resting, peak)


@kernel
def _write_observation(lo, hi, told, hangs, watch, rig, observation, critic):
    time, when, who, held = told
    for e in range(lo, hi):
        lost, seconds = who[e], time[e] - when[e]
        any_lost, azimuth = 1.0 if watch.lost[e, lost] else 0.0, rig.azimuth[lost]
        out = critic[e, critic.shape[1] - 4 :]
        out[0], out[1], out[2] = any_lost, any_lost * cos(azimuth), any_lost * sin(azimuth)
        out[3] = any_lost * min(seconds / (WAIT + RAMP), 1.0)
        for n in range(observation.shape[1]):
            own = observation[e, n, observation.shape[2] - 7 :]
            own[0], own[1] = 1.0 if watch.lost[e, n] else 0.0, any_lost
            own[2] = any_lost * cos(azimuth - rig.azimuth[n])
            own[3] = any_lost * sin(azimuth - rig.azimuth[n])
            put(own[4:], scale(any_lost, plan_offset(seconds, held[lost, n], cos(azimuth - rig.azimuth[n]), hangs)))


@kernel
def _score(lo, hi, state, errors, action, previous, weights, bounds, dt, terms, good_time):
    for e in range(lo, hi):
        distance, angle = errors.distance[e], errors.angle[e]
        speed, spin = norm(row(state.payload_velocity, e)), norm(row(state.payload_body_rates, e))
        terms[e, 0] = weights[0] * tolerance(distance, 0.25)
        terms[e, 1] = weights[1] * tolerance(distance, 0.03)
        terms[e, 2] = weights[2] * tolerance(angle, radians(20.0))
        terms[e, 3] = weights[3] * tolerance(speed, 0.2) * tolerance(spin, 0.3)
        terms[e, 4] = weights[4] * action_rate(e, action, previous)
        good_time[e] = good_time[e] + dt if is_at_rest(e, state, errors, bounds) else 0.0
