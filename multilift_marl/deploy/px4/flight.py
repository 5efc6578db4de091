"""A flight of autopilots: start, take-off with slack cables, the way to the task, the task, the way back, landing.

Take-off and landing are the tasks of these names, the drones' set-points those of the action interface. In between the
formation flies along a smooth line. Every part has a world of its own, which begins in the state that the last one
left; the autopilots notice nothing of that.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.deploy.px4.team import ACTIONS, AutopilotController, AutopilotTeam
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, FlightError
from multilift_marl.evaluation.rollout import Trace, Tracer, measure_episodes
from multilift_marl.math3d import ease
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import Policy
from multilift_marl.sim.world import World

SCRIPT = "formation_integral"  # of take-off and landing
SPEED = 0.8  # [m/s] on the way to and from the task, on average
_HOLD = 2.0  # [s] at the end of the way
_OWN = ("task", "task_options", "reward")  # what take-off and landing have of their own
Maker = Callable[[MultiliftVec], Policy]
Say = Callable[[str], None]
OnStep = Callable[[MultiliftVec], None]


class FlightResult(NamedTuple):
    """The task of a flight, as measured."""

    metrics: dict[str, np.ndarray]
    """Of one episode, see `run_episodes`."""
    trace: Trace
    drone_error: float
    """[m] RMS of the drones' distance from their references."""
    estimate_error: float
    """[m] RMS of the autopilots' estimates of their places; NaN with our controller."""


class Goal(NamedTuple):
    """Where a formation is to be, N drones."""

    slots: np.ndarray
    """(N, 3) [m]."""
    cable_force: np.ndarray
    """(N, 3) [N]."""
    yaw: float
    """Of the team [rad]."""
    height: float
    """Of the payload [m]."""


class Flight:
    """Flies one episode of a task by autopilots, from the ground and back.

    Args:
        config: the task, its rig and its control.
        team: the autopilots.
        seed: evaluation seed; the episode is the first of `evaluate.py`.
        say: called with what goes on.

    Attributes:
        start: state in which the task began; empty for `takeoff`, which begins as ever.

    Raises:
        ConfigError: what autopilots cannot fly.
    """

    def __init__(self, config: Config, team: AutopilotTeam, seed: int, say: Say = print):
        self.config, self.team, self.seed, self._say = check_config(config), team, seed, say
        self._task = self._make(config)
        self._task.reset(seed=seed)
        self._landing = self._make(self._part("land", {"pad_xy": 0.0, "pad_yaw": 0.0}))
        self._landing.reset(seed=seed)
        self.start: dict[str, np.ndarray] = {}
        self._begun: dict[str, np.ndarray] = {}

    @property
    def vec(self) -> MultiliftVec:
        """The environment of the task."""
        return self._task

    def fly(self, make_policy: Maker, on_step: OnStep | None = None) -> FlightResult:
        """Fly, and return the task as measured.

        Args:
            make_policy: returns the policy of the task for its environment.
            on_step: called with that environment at the start of the task and after every step.

        Raises:
            FlightError: an autopilot that does not do its part, or a failure before the task.
        """
        if self.config.task == "takeoff":
            observation = self._arm(self._task)
            result = self._measure_task(make_policy, observation, on_step)
        else:
            first = _goal(self._task)
            rise = {"place_xy": 0.0, "target_yaw": 0.0, "target_height": first.height}
            takeoff = self._make(self._part("takeoff", rise))
            self._run(takeoff, self._arm(takeoff), "take-off")
            self._say("to the task")
            self._go(takeoff.world, _goal(takeoff), first)
            observation = self._take_over(self._task, takeoff.world)
            self.start = self._begun
            result = self._measure_task(make_policy, observation, on_step)
        world = self._task.world
        if self.config.task != "land" and result.metrics["failure_cause"][0] == 0:
            self._say("back, and landing")
            self._go(self._task.world, _goal(self._task), _goal(self._landing))
            self._run(self._landing, self._take_over(self._landing, self._task.world), "landing")
            world = self._landing.world
        for autopilot in self.team.offboard:
            # By force: PX4 itself may not have noticed yet that it has landed.
            autopilot.arm(False, force=True)
        self.team.settle(world)  # so that they do, and close their logs
        return result

    def _arm(self, vec: MultiliftVec) -> np.ndarray:
        """Begin a take-off, arm the autopilots there, and return its first observation."""
        observation, _ = vec.reset(seed=self.seed, options={"randomization": self._drawn()})
        self.team.board(vec.world)
        self._say("waiting for the autopilots")
        self.team.prepare(vec.world)
        self._say(f"armed after {self.team.time:.0f} s; take-off")
        # While they armed, drones may have moved a little: references begin where they are now.
        vec.controller.start(0)
        return observation

    def _measure_task(self, make_policy: Maker, observation: np.ndarray, on_step: OnStep | None) -> FlightResult:
        self._say(f"{self.config.task}, {self._task.max_steps * self._task.task.dt:g} s")
        return _measure(self._task, make_policy(self._task), observation, self.team, on_step)

    def fly_ours(self, make_policy: Maker) -> FlightResult:
        """Fly the same task from the same state with the geometric controller in place of autopilots."""
        vec = MultiliftVec(self.config, EVALUATION)
        observation, _ = vec.reset(seed=self.seed, options={"state": self.start, "randomization": self._drawn()})
        return _measure(vec, make_policy(vec), observation)

    def _part(self, task: str, options: dict[str, Any]) -> Config:
        """Return the configuration of take-off or landing by the same rig."""
        values = {key: value for key, value in self.config.model_dump().items() if key not in _OWN}
        lasting = {"takeoff": 10.0, "land": 12.0}[task]
        overrides = {f"task_options.{key}": value for key, value in options.items()}
        overrides |= {"task": task, "env.episode_seconds": lasting, "control.action": "reference"}
        return build_config(values, overrides)

    def _make(self, config: Config) -> MultiliftVec:
        vec = MultiliftVec(config, EVALUATION)
        vec.use_controller(AutopilotController(config, vec.world, self.team))
        return vec

    def _drawn(self) -> dict[str, np.ndarray]:
        """Return what is hidden in the task, which is the same all along."""
        # Not the bias: it is one of the numbers observed, and other tasks observe others.
        drawn = self._task.current()[1]["randomization"]
        return {name: array[0] for name, array in drawn.items() if name != "observation_bias"}

    def _run(self, vec: MultiliftVec, observation: np.ndarray, what: str) -> None:
        policy = make_scripted(SCRIPT, vec)
        for _ in range(vec.max_steps):
            observation, _, terminated, _, info = vec.step(policy.act(observation))
            if terminated[0]:
                cause = vec.failure_causes[info["failure_cause"][0]]
                raise FlightError(f"{what} failed after {vec.steps[0] * vec.task.dt:.1f} s: {cause}")

    def _go(self, world: World, begin: Goal, end: Goal) -> None:
        """Move the formation along a line, at rest at both ends."""
        # Wrapped to [-π, π): the team turns the shorter way round.
        way, turn = end.slots - begin.slots, np.remainder(end.yaw - begin.yaw + np.pi, 2 * np.pi) - np.pi
        # As long as the farthest drone takes at SPEED and the turn at 0.5 rad/s, a second at least.
        seconds = max(float(np.linalg.norm(way, axis=1).max()) / SPEED, abs(turn) / 0.5, 1.0)
        ticks = round((seconds + _HOLD) * self.config.sim.control_hz)
        for tick in range(ticks):
            share, rate, change, _ = ease(tick / self.config.sim.control_hz, 0.0, seconds)
            force = begin.cable_force + share * (end.cable_force - begin.cable_force)
            motion = np.stack([begin.slots + share * way, rate * way, change * way], axis=1)
            self.team.tick(world, partial(self._send, motion, force, begin.yaw + share * turn))
            world.step(world.thrust, world.system.control_interval)

    def _send(self, motion: np.ndarray, cable_force: np.ndarray, yaw: float, drone: int) -> None:
        self.team.send(drone, motion[drone], cable_force[drone], yaw + self.team.heading[drone])

    def _take_over(self, vec: MultiliftVec, world: World) -> np.ndarray:
        """Begin an episode in the state of another world, and return its first observation."""
        self._begun = {name: array.copy() for name, array in world.state._asdict().items() if name not in _FOLLOWING}
        options = {"state": self._begun, "randomization": self._drawn()}
        try:
            observation, _ = vec.reset(seed=self.seed, options=options)
        except ValueError as error:  # a failure from the start, or cables that would be torn
            raise FlightError(f"{vec.config.task} cannot begin where the team is: {error}") from None
        self.team.board(vec.world)
        return observation


_FOLLOWING = ("cable_tension", "cable_broken")  # from the places


def _goal(vec: MultiliftVec) -> Goal:
    goal = vec.task.goal
    return Goal(goal.slots[0].copy(), goal.cable_force[0].copy(), float(goal.drone_yaw[0]), float(goal.position[0, 2]))


def _measure(
    vec: MultiliftVec, policy: Policy, observation: np.ndarray, team: AutopilotTeam | None = None,
    on_step: OnStep | None = None,
) -> FlightResult:  # fmt: skip
    tracer, drones, estimates = Tracer(), [], []

    def record(vec: MultiliftVec) -> None:
        tracer(vec)
        drones.append(((vec.world.state.drone_position - vec.reference.position) ** 2).sum(axis=-1).mean())
        if on_step is not None:
            on_step(vec)
        if team is not None:
            estimates.append((team.error() ** 2).mean())

    if on_step is not None:
        on_step(vec)
    metrics = measure_episodes(vec, policy, observation, record)
    estimate = float(np.sqrt(np.mean(estimates))) if estimates else float("nan")
    return FlightResult(metrics, tracer.trace(), float(np.sqrt(np.mean(drones))), estimate)


def check_config(config: Config) -> Config:
    """Return the configuration, of one environment, with which autopilots can fly.

    Raises:
        ConfigError: naming what they cannot.
    """
    if config.control.action not in ACTIONS:
        raise ConfigError(
            f"PX4 has set-points for control.action={' and '.join(ACTIONS)}, not for {config.control.action}; take a "
            "policy of one of these interfaces"
        )
    if config.task == "loss":
        raise ConfigError("PX4 cannot fly config=loss: a team that has lost a drone cannot be brought back")
    if config.cable.model != "massless":
        raise ConfigError("flights by PX4 go on from state to state, which chains cannot; set cable.model=massless")
    return build_config(config.model_dump(), {"env.num_envs": 1, "env.num_threads": 1})
