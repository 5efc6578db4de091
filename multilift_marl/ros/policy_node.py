"""The other half of a live flight: a node that hears odometry, flies a policy and publishes set-points, for hardware.

Nothing is simulated: observations, targets and references are those of the task, of what is measured.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.control.policy import Policy
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError
from multilift_marl.ros.dds import Node
from multilift_marl.ros.failsafe import HOLD_AFTER, LAND_AFTER, sink
from multilift_marl.ros.messages import NAMES, ODOMETRY, Topic, level, pose_stamped, setpoint_topics
from multilift_marl.ros.types import (
    VEHICLE_ODOMETRY,
    Motion,
    control_mode,
    px4_namespace,
    read_odometry,
    read_pose,
    read_vehicle_odometry,
    stamp_ns,
    trajectory_setpoint,
)

WAITING, FLYING, HOLDING, LANDING = "waiting", "flying", "holding", "landing"
_TOGETHER = 5_000_000  # [ns] between stamps of one moment
_LEAP, _LEAP_ACCELERATION = 0.1, 20.0  # [m], [m/s²] what is farther off than these was put elsewhere
_LEAPS = 5  # measurements in a row after which a team has been put elsewhere
_SAME = 1e-9  # [m], and of a rotation's numbers, by which targets differ only in rounding
_REMEMBERED = 1_000_000  # steps of which the latency is known
_FIELDS = ("position", "rotation", "velocity", "body_rates")
Say = Callable[[str], None]


class PolicyNode:
    """Flies a team that others measure.

    A policy step begins when all bodies have been measured at its time, by their stamps. What comes late is waited
    for; without news of a body for 0.25 s the last set-points are held, after 2 s they sink to the ground, and stay
    there. So they do when the task has failed.

    Args:
        config: the task, its rig and control.
        make_policy: returns the policy for its environment.
        node: publishes and subscribes.
        names: of the topics, a key of `messages.NAMES`; the report's drones are PX4s.
        seed: of the episode, which a task that plans its target draws it from.
        say: called with what happens.

    Attributes:
        team: the task as measured.
        mode: waiting, flying, holding or landing.
        steps: that it has flown.
        latency: of each, from the last measurement that it waited for to its last set-point [s].

    Raises:
        ConfigError: a task or an action interface that it cannot fly.
    """

    def __init__(
        self, config: Config, make_policy: Callable[[MeasuredTeam], Policy], node: Node, names: str = "multilift",
        seed: int = 1000, say: Say = print,
    ):  # fmt: skip
        check_flyable(config)
        self.team = MeasuredTeam(config)
        self._policy, self._seed, self._say = make_policy(self.team), seed, say
        self._node, self._names = node, NAMES[names]
        self.mode, self.steps, self.latency = WAITING, 0, deque[float](maxlen=_REMEMBERED)
        state, drones = self.team.world.state, self.team.num_drones
        self._measured = {
            f"{body}_{field}": getattr(state, f"{body}_{field}")[0].copy()
            for body in ("drone", "payload")
            for field in _FIELDS
        }
        self._stamps = np.full(drones + 1, -1, np.int64)  # [ns] of each drone's last measurement, then the payload's
        self._arrivals = np.zeros(drones + 1)  # [s] of the same
        self._due = self._flown = 0  # [ns] by the stamps: the next step, the last one
        self._before, self._moving = np.zeros((2, drones + 1, 3))  # [m], [m/s] where the bodies were then, how fast
        self._woken = self._sent = 0.0  # [s]
        self._leaps, self._said = 0, ""
        self._target: tuple[np.ndarray, np.ndarray] | None = None
        self._setpoints = np.zeros((drones, 3)), np.zeros(drones)  # the last places [m] and headings [rad]
        self._feedforward = LoadFeedforward(config.system)
        self._dt_ns = round(self.team.task.dt * 1e9)
        self._begun = False
        self._subscribe()
        self._warm_up()

    def _warm_up(self) -> None:
        """Make a step in the task's own start, so that no step in flight is the first."""
        self.team.command(self._policy.act(self.team.begin({}, self._seed)))
        self.team.advance()
        self.team.observe({})
        self._policy.reset()

    def _subscribe(self) -> None:
        names, drones = self._names, range(self.team.num_drones)
        sources: list[tuple[Topic, Callable[[Any], Motion]]] = []
        for drone in drones:
            if names.is_report:
                topic = Topic(f"{px4_namespace(drone)}/out/vehicle_odometry", VEHICLE_ODOMETRY, False)
                sources.append((topic, read_vehicle_odometry))
            else:
                sources.append((Topic(names.drone.format(drone), ODOMETRY, False), read_odometry))
        sources.append((Topic(names.payload, ODOMETRY, False), read_odometry))
        self._bodies = [(self._node.subscription(topic), read) for topic, read in sources]
        self._take_target = self._node.subscription(Topic("/target", "geometry_msgs/msg/PoseStamped", False))
        self._publishers = [
            [self._node.publisher(topic) for topic in setpoint_topics(names, drone)] for drone in drones
        ]

    def spin(self, seconds: float) -> None:
        """Hear and fly for some seconds of real time."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            self.spin_once(left)

    def spin_once(self, seconds: float) -> None:
        """Wait for something new, for some seconds or a policy step at most, and do what is due."""
        self._node.wait(min(seconds, self.team.task.dt))
        self._woken = time.perf_counter()
        self._hear()
        age = self._woken - self._arrivals.min()
        if self.mode == LANDING:
            self._hold(True)
        elif self._is_due():
            self._step()
        elif self.mode != WAITING and age > HOLD_AFTER:
            silent = self._name(int(self._arrivals.argmin()))
            self._change(LANDING if age > LAND_AFTER else HOLDING, f"nothing is heard of {silent}")
            self._hold(self.mode == LANDING)

    def _hear(self) -> None:
        """Take in what has arrived; what is not finite, or older than what is known, does not count."""
        for body, (take, read) in enumerate(self._bodies):
            for message in take():
                time_ns = stamp_ns(message.header.stamp) if hasattr(message, "header") else 1000 * message.timestamp
                motion = read(message)
                if time_ns <= self._stamps[body] or not all(np.isfinite(part).all() for part in motion):
                    continue
                self._stamps[body], self._arrivals[body] = time_ns, self._woken
                for field, part in zip(_FIELDS, motion, strict=True):
                    if body < self.team.num_drones:
                        self._measured[f"drone_{field}"][body] = part
                    else:
                        self._measured[f"payload_{field}"][:] = part
        for message in self._take_target():
            self._aim(message)

    def _aim(self, message: Any) -> None:
        """Take the target that others publish, unless the task plans its own."""
        position, rotation = read_pose(message.pose)
        if self.team.task.KERNELS.plan is None and np.isfinite(position).all() and np.isfinite(rotation).all():
            self._target = position, rotation

    def _is_due(self) -> bool:
        """Whether all bodies have been measured at the time of the next step."""
        if self.mode == WAITING or self._stamps.min() > self._due + HOLD_AFTER * 1e9:  # at first, or after a gap
            self._due = int(self._stamps.max())
        return bool(self._stamps.min() >= max(self._due - _TOGETHER, 0))

    def _step(self) -> None:
        """Make a policy step with what has been measured."""
        now, self._due = int(self._stamps.max()), self._due + self._dt_ns
        places = np.concatenate([self._measured["drone_position"], self._measured["payload_position"][None]])
        if self.mode != WAITING:
            elapsed = 1e-9 * (now - self._flown)
            off = np.linalg.norm(places - self._before - elapsed * self._moving, axis=1).max()
            self._leaps = self._leaps + 1 if off > _LEAP + 0.5 * _LEAP_ACCELERATION * elapsed**2 else 0
            if 0 < self._leaps < _LEAPS:
                return
            if self._leaps:
                self._change(WAITING, "the team has been put elsewhere")
        self._before, self._flown = places, now
        self._moving = np.concatenate([self._measured["drone_velocity"], self._measured["payload_velocity"][None]])
        observation = self._begin() if self.mode == WAITING else self._observe()
        if observation is not None:
            self._fly(observation, now)
            self.latency.append(time.perf_counter() - self._woken)
            self.steps += 1

    def _begin(self) -> np.ndarray | None:
        """Return the first observation; None where the task cannot begin."""
        observation = self.team.begin(self._measured, None if self._begun else self._seed)
        self._begun = True
        if self._aim_anew():
            observation = self.team.observe(self._measured)
        if self.team.failure:
            if self.team.failure != self._said:
                self._said = self.team.failure
                self._say(f"waiting, for the task has failed where the team is: {self._said}")
            return None
        self._policy.reset()
        self._change(FLYING, "all bodies are heard")
        return observation

    def _observe(self) -> np.ndarray | None:
        """Return the observation; None where the task has failed."""
        self._aim_anew()
        observation = self.team.observe(self._measured)
        if self.team.failure:
            self._change(LANDING, f"the task has failed, {self.team.failure}; start this node again to fly on")
            return None
        self._change(FLYING, "all bodies are heard again")
        return observation

    def _aim_anew(self) -> bool:
        """Put the target where others want it; return whether it was elsewhere."""
        goal = self.team.task.goal
        if self._target is None:
            return False
        position, rotation = self._target
        off = max(np.abs(goal.position[0] - position).max(), np.abs(goal.rotation[0] - rotation).max())
        if off > _SAME:
            self.team.task.place_goal(0, position, rotation)
        return bool(off > _SAME)

    def _fly(self, observation: np.ndarray, now: int) -> None:
        """Let the policy act, and publish what it wants at a time [ns]."""
        reference = self.team.command(self._policy.act(observation))
        if self._names.is_report:
            self.team.advance()
            force = self.team.task.goal.cable_force[0]
            places, velocities, yaws = reference.position[0], reference.velocity[0], reference.yaw[0]
            accelerations = np.stack([
                self._feedforward.acceleration(i, velocities[i], reference.acceleration[0, i], force[i], yaws[i])
                for i in range(len(places))
            ])  # fmt: skip
        else:
            places, yaws = reference.command[0], reference.command_yaw[0]
            velocities = accelerations = np.zeros_like(places)
        self._send(now, places, yaws, velocities, accelerations)

    def _hold(self, sinking: bool) -> None:
        """Publish the last places once more, a policy step after the last time; those of drones that land are lower."""
        elapsed = time.perf_counter() - self._sent
        if elapsed < 0.9 * self.team.task.dt:
            return
        places, yaws = self._setpoints
        sink(places, sinking, min(elapsed, HOLD_AFTER))
        force, still = self.team.task.goal.cable_force[0], np.zeros_like(places)
        held = np.stack([
            self._feedforward.acceleration(i, still[i], still[i], force[i], yaws[i]) for i in range(len(places))
        ])  # fmt: skip
        self._send(int(self._stamps.max()), places, yaws, still, held)

    def _send(
        self, now: int, places: np.ndarray, yaws: np.ndarray, velocities: np.ndarray, accelerations: np.ndarray
    ) -> None:
        store = self._node.store
        for i, publishers in enumerate(self._publishers):
            if self._names.is_report:
                messages = [
                    control_mode(store, now),
                    trajectory_setpoint(store, now, places[i], velocities[i], accelerations[i], yaws[i]),
                ]
            else:
                messages = [pose_stamped(store, now, places[i], level(yaws[i]))]
            for publish, message in zip(publishers, messages, strict=True):
                publish(message)
        self._setpoints = places.copy(), yaws.copy()
        self._sent = time.perf_counter()

    def _change(self, mode: str, why: str) -> None:
        if mode != self.mode:
            self._say(f"{mode}: {why}")
            self.mode = mode

    def _name(self, body: int) -> str:
        return f"drone {body}" if body < self.team.num_drones else "the payload"


def check_flyable(config: Config) -> None:
    """Refuse, by a ConfigError, what the node cannot fly."""
    if config.control.action != "reference":
        raise ConfigError(
            f"set-points are places, of control.action=reference, not of {config.control.action}; take a policy of that"
        )
    if config.task == "loss":
        raise ConfigError("role=policy cannot fly config=loss: nobody measures whose motors have stopped")
