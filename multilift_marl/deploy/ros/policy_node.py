"""The other half of a live flight: a node that hears odometry, flies a policy and publishes set-points, for hardware.

Nothing is simulated: observations, targets and references are those of the task, of what is measured.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.deploy.ros.bodies import Bodies, Source
from multilift_marl.deploy.ros.checks import PX4, check_flyable
from multilift_marl.deploy.ros.crazyswarm import ServerOdometry, full_state
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, LAND_AFTER, sink
from multilift_marl.deploy.ros.messages import (
    BOOL,
    INT32,
    NAMES,
    ODOMETRY,
    PATH,
    POSE,
    Topic,
    control_topics,
    path,
    pose_stamped,
    setpoint_topics,
)
from multilift_marl.deploy.ros.stages import Stage
from multilift_marl.deploy.ros.types import (
    FULL_STATE,
    VEHICLE_ODOMETRY,
    Motion,
    PX4Setpoint,
    control_mode,
    level,
    px4_namespace,
    read_measurement,
    read_odometry,
    read_place,
    read_vehicle_odometry,
    trajectory_setpoint,
)
from multilift_marl.envs.measured import APART, MeasuredTeam
from multilift_marl.mdp.failures import MAX_DISTANCE
from multilift_marl.policies.policy import Policy

AT_ONCE, TOPIC, STAGE = "at_once", "topic", "stage"
WAITING, READY, FLYING, HOLDING, LANDING = "waiting", "ready", "flying", "holding", "landing"
_LEAP, _LEAP_ACCELERATION = 0.1, 20.0  # [m], [m/s²]: what is farther off than these was put elsewhere
_LEAPS = 5  # steps in a row of that, after which the task begins anew
_SAME = 1e-9  # [m], and of a rotation's numbers, by which targets differ only in rounding
_REMIND = 2.0  # [s] between words about what is waited for
_REMEMBERED = 1_000_000  # steps of which the latency is known
Say = Callable[[str], None]
_Result = TypeVar("_Result")


class PolicyNode:
    """Flies a team that others measure.

    A policy step begins when all bodies have been measured a period after the last one, each by its own clock. Where
    no step can be made for 0.25 s, whatever the reason, the last set-points are held; after 2 s they sink to the
    ground, for good. They also sink when the task or the policy fails, or when it is asked to land.

    Args:
        config: the task, its rig and control.
        make_policy: returns the policy for its environment.
        node: publishes and subscribes.
        names: of the topics, a key of `messages.NAMES`; the report's drones are PX4s, Crazyswarm2's are
            Crazyflies.
        seed: of the episode, which a task that plans its target draws it from.
        start: AT_ONCE, as soon as all is heard; TOPIC, when `true` comes on /fly; STAGE, while all drones are in stage
            5 of the report's state machine.
        say: called with what happens.
        receiver: of set-points with the report's names, PX4 itself or a geometric-control node.

    Attributes:
        team: the task as measured.
        mode: waiting, ready, flying, holding or landing.
        steps: that it has flown.
        latency: of each, from waking up for its last measurement to its last set-point [s].

    Raises:
        ConfigError: a task or an action interface that it cannot fly.
    """

    def __init__(
        self, config: Config, make_policy: Callable[[MeasuredTeam], Policy], node: Node, names: str = "multilift",
        seed: int = 1000, start: str = AT_ONCE, say: Say = print, receiver: str = PX4,
    ):  # fmt: skip
        check_flyable(config, names, receiver)
        self.team = MeasuredTeam(config)
        self._policy, self._seed, self._say = make_policy(self.team), seed, say
        self._node, self._names, self._wanted, self._start = node, NAMES[names], start == AT_ONCE, start
        self.mode, self.steps, self.latency = WAITING, 0, deque[float](maxlen=_REMEMBERED)
        self._plans = self.team.task.KERNELS.plan is not None
        self._target: tuple[np.ndarray, np.ndarray] | None = None
        self._heard: np.ndarray | None = None  # the last target of others [m], where this task plans its own
        self._before: tuple[np.ndarray, np.ndarray, int] | None = None  # positions, velocities, stamp of the last step
        self._woken = self._flown = self._sent = self._reminded = self._refused = 0.0  # [s]
        self._leaps, self._why = 0, ""
        drones = self.team.num_drones
        self._setpoints = np.zeros((drones, 3)), np.zeros(drones)  # the last places [m] and headings [rad]
        self._feedforward, self._receiver = LoadFeedforward(config.system), receiver
        self._subscribe()
        self._warm_up()

    def _subscribe(self) -> None:
        names, drones, node = self._names, range(self.team.num_drones), self._node
        topics: list[Topic] = []

        def read(topic: Topic) -> Callable[[Any], Motion]:
            if names.setpoints == FULL_STATE:
                return ServerOdometry()
            return read_vehicle_odometry if topic.kind == VEHICLE_ODOMETRY else read_odometry

        for drone in drones:
            if names.is_report:
                topics.append(Topic(f"{px4_namespace(drone)}/out/vehicle_odometry", VEHICLE_ODOMETRY, False))
            else:
                topics.append(Topic(names.drone.format(names.first + drone), ODOMETRY, False))
        topics.append(Topic(names.payload, ODOMETRY, False))
        sources: list[Source] = [node.subscription(topic, partial(read_measurement, read(topic))) for topic in topics]
        self._topics = [topic.name for topic in topics]  # of each body
        self._bodies = Bodies(sources, self.team.task.dt)
        self._take_target = node.subscription(Topic("/target", POSE, False), read_place)
        self._take_wish = node.subscription(Topic("/fly", BOOL, False))
        states = drones if self._start == STAGE else []
        self._take_stages = [node.subscription(Topic(f"/state/state_drone_{i}", INT32, False)) for i in states]
        self._stages = np.zeros(len(states), int)
        asked = [
            setpoint_topics(names, drone) if self._receiver == PX4 else control_topics(names, drone)[:1]
            for drone in drones
        ]
        self._publishers = [[node.publisher(topic) for topic in topics] for topics in asked]
        self._publish_path = node.publisher(Topic("/path", PATH, latched=True))

    def _warm_up(self) -> None:
        """Make a step in the task's own start, so that no step in flight is the first."""
        self.team.command(self._policy.act(self.team.begin({}, self._seed)))
        self.team.advance()
        self.team.observe({})
        self._policy.reset()

    @property
    def _awaited(self) -> str:
        """What lets it fly, in words."""
        return "stage 5 of all drones" if self._start == STAGE else "true on /fly"

    @property
    def landed(self) -> bool:
        """Whether it has let all drones sink to the ground, or never flew."""
        return self.mode in (WAITING, READY) or (self.mode == LANDING and bool((self._setpoints[0][:, 2] <= 0).all()))

    def land(self, why: str) -> None:
        """Let the drones sink, for good."""
        if self.mode not in (WAITING, READY):
            self._change(LANDING, why)

    def spin(self, seconds: float) -> None:
        """Hear and fly for some seconds of real time."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            self.spin_once(left)

    def spin_once(self, seconds: float) -> None:
        """Wait for something new, for some seconds or a policy step at most, and do what is due."""
        self._node.wait(min(seconds, self.team.task.dt))
        self._woken = now = time.perf_counter()
        self._node.check_publishers()
        self._bodies.poll(now)
        self._hear_wishes()
        # Landing is for good: whatever is heard then, no step is made any more.
        if self.mode != LANDING and self._bodies.are_due() and not self._bodies.missing(now, HOLD_AFTER):
            self._bodies.take_step()
            self._step()
        if self.mode in (FLYING, HOLDING, LANDING):
            self._check_age(now)
        elif now > self._reminded + _REMIND:
            self._remind(now)

    def _check_age(self, now: float) -> None:
        """Hold or land where no step was made for too long."""
        since = now - self._flown
        if self.mode != LANDING and since > HOLD_AFTER:
            silent = " and ".join(self._bodies.missing(now, HOLD_AFTER))
            why = f"nothing new is heard of {silent}" if silent else self._why or "measurements are too far apart"
            self._change(LANDING if since > LAND_AFTER else HOLDING, why)
        if self.mode in (HOLDING, LANDING):
            self._hold(now)

    def _remind(self, now: float) -> None:
        """Say what is waited for."""
        self._reminded = now
        silent = self._bodies.missing(now, HOLD_AFTER)
        if silent:
            left_out, bodies = self._node.reader.left_out, self._bodies.silent(now, HOLD_AFTER)
            came = any(self._bodies.refused[body] or left_out[self._topics[body]] for body in bodies)
            refused = " (messages came, but none was finite and newer than the last)" if came else ""
            self._say(f"{self.mode}: nothing is heard of {', '.join(silent)}{refused}")
        elif self._target is None and not self._plans:
            self._say(f"{self.mode}: no /target is heard")
        else:
            self._say(f"{self.mode}: {self._why or f'{self._awaited} lets it fly'}")

    def _hear_wishes(self) -> None:
        """Take in targets, unless the task plans its own, and whether to fly."""
        for position, rotation in self._take_target():
            if self._plans:
                self._compare(position)
                continue
            away = float(np.linalg.norm(position - self._bodies.measured["payload_position"]))
            # In the air the task would fail by such a target, and the team land; before, it is but a reason to wait.
            if self.mode in (FLYING, HOLDING) and away > MAX_DISTANCE:
                self._refuse_target(away)
            else:
                self._target = position, rotation
        for message in self._take_wish():
            self._wanted = bool(message.data)
            if not self._wanted:
                self.land("false on /fly")
        self._hear_stages()

    def _hear_stages(self) -> None:
        """Take in the stages of the drones' flights, and begin and end with the trajectory."""
        for i, take in enumerate(self._take_stages):
            for message in take():
                self._stages[i] = message.data
        if self._start != STAGE:
            return
        self._wanted = bool((self._stages == Stage.TRAJECTORY).all())
        if not self._wanted and self.mode in (FLYING, HOLDING):
            self._change(READY, f"the stages of the drones are {self._stages.tolist()}")
            self._before = None

    def _compare(self, target: np.ndarray) -> None:
        """Say, where this task plans its target, that others have another one."""
        self._heard, off = target, float(np.linalg.norm(target - self.team.task.goal.position[0]))
        if self.mode == FLYING and off > APART and self._woken > self._refused + _REMIND:
            self._refused = self._woken
            self._say(f"/target is {off:.1f} m from the target planned here: give both the same seed and task")

    def _refuse_target(self, away: float) -> None:
        """Say that a target is too far away [m], not for every one that comes."""
        if self._woken > self._refused + _REMIND:
            self._refused = self._woken
            self._say(f"a target {away:.1f} m away is not taken: {MAX_DISTANCE:g} m is the most")

    def _step(self) -> None:
        """Make a policy step with what is measured, if one can be made."""
        positions, velocities = self._bodies.positions()
        # By the payload's clock, which is the last: each body may have one of its own.
        stamp = int(self._bodies.stamps[-1])
        if self._before is not None:
            # A clock that was set back would give a negative time.
            elapsed = max(1e-9 * (stamp - self._before[2]), 0.0)
            off = np.linalg.norm(positions - self._before[0] - elapsed * self._before[1], axis=1).max()
            # Farther than the last velocity and the largest acceleration lead.
            self._leaps = self._leaps + 1 if off > _LEAP + 0.5 * _LEAP_ACCELERATION * elapsed**2 else 0
            self._why = "the team has been put elsewhere" if self._leaps else ""
            # A few may be wrong measurements, which no step is made of; after more in a row the team really is
            # elsewhere.
            if 0 < self._leaps < _LEAPS:
                return
        observation = self._attempt("task", self._begin if self._before is None or self._leaps else self._observe)
        if observation is not None and self._fly(observation):
            self._before, self._flown = (positions, velocities, stamp), self._woken
            self._leaps, self._why = 0, ""
            self._change(FLYING, "all is heard")
            self.latency.append(time.perf_counter() - self._woken)
            self.steps += 1

    def _begin(self) -> np.ndarray | None:
        """Return the first observation; None where the task cannot begin, or is not to."""
        if self._target is None and not self._plans:
            self._why = "no /target is heard"
            return None
        heard = None if self._before is None else self._heard
        observation = self.team.begin(self._bodies.measured, self._seed, self._target, heard)
        self._why = f"the task has failed where the team is, {self.team.failure}" if self.team.failure else ""
        if not self._wanted and not self._why:
            self._change(READY, f"{self._awaited} lets it fly")
            # Drones are asked to stay where they are, so that who follows set-points has some before the flight.
            if self._names.setpoints != FULL_STATE:  # which would start a Crazyflie's motors
                self._publish(self.team.reference.position[0], self.team.reference.yaw[0])  # where the drones are
        if self._why or not self._wanted:
            return None
        self._policy.reset()
        self._publish_path(path(self._node.store, int(self._bodies.stamps[-1]), self._planned_path()))
        return observation

    def _planned_path(self) -> np.ndarray:
        """Return the places (P, 3) [m] on the payload's way, the target alone where it stays."""
        points = self.team.task.target_path(0)
        return points if len(points) else self.team.task.goal.position.copy()

    def _observe(self) -> np.ndarray | None:
        """Return the observation; None where the task has failed."""
        goal = self.team.task.goal
        if self._target is not None:
            position, rotation = self._target
            if max(np.abs(goal.position[0] - position).max(), np.abs(goal.rotation[0] - rotation).max()) > _SAME:
                self.team.task.place_goal(0, position, rotation)
        # Targets that move are where they are by now, also where measurements were missed.
        assert self._before is not None
        missed = 1e-9 * (int(self._bodies.stamps[-1]) - self._before[2]) / self.team.task.dt
        steps = int(np.clip(round(missed), 1, HOLD_AFTER / self.team.task.dt))
        observation = self.team.observe(self._bodies.measured, steps)
        if self.team.failure:
            self.land(f"the task has failed, {self.team.failure}")
            return None
        return observation

    def _fly(self, observation: np.ndarray) -> bool:
        """Let the policy act, and publish what it wants; return whether it could."""
        reference = self._attempt("policy", lambda: self.team.command(self._policy.act(observation)))
        if reference is None:
            return False
        # Receivers of poses smooth them and get the command; others get our smoothed reference with its derivatives.
        if self._names.setpoints == POSE:
            self._publish(reference.command[0], reference.command_yaw[0])
            return True
        if self._attempt("task", self.team.advance) is None:
            return False
        motion = reference.velocity[0], reference.acceleration[0], reference.yaw_rate[0], reference.jerk[0]
        self._publish(reference.position[0], reference.yaw[0], *motion)
        return True

    def _attempt(self, what: str, call: Callable[[], _Result]) -> _Result | None:
        """Return what code of others does; where it fails, in whatever way, None, and drones in the air land."""
        try:
            return call()
        except Exception as error:
            self._why = f"the {what} has failed ({type(error).__name__}: {error})"
            self.land(self._why)
            return None

    def _hold(self, now: float) -> None:
        """Publish the last places once more, a policy step after the last time; lower ones while it lands."""
        elapsed = now - self._sent
        if elapsed > 0.9 * self.team.task.dt:
            places, yaws = self._setpoints
            # Bounded, so that a pause of this process does not become one deep step.
            sink(places, self.mode == LANDING, min(elapsed, HOLD_AFTER))
            self._publish(places, yaws)

    def _publish(
        self, places: np.ndarray, yaws: np.ndarray, velocities: np.ndarray | None = None,
        accelerations: np.ndarray | None = None, yaw_rates: np.ndarray | None = None, jerks: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Publish set-points; those with accelerations have what the drones carry added to them."""
        still, store = np.zeros_like(places), self._node.store
        # A plan knows the force on each cable, with the drag in it unless controllers are to add that; else it is the
        # formation's.
        planned = velocities is not None and self.team.controller.interface.commands_force
        force = (self.team.controller.commanded_force if planned else self.team.task.planned.cable_force)[0]
        velocities, accelerations, jerks = (
            still if each is None else each for each in (velocities, accelerations, jerks)
        )
        yaw_rates = np.zeros(len(places)) if yaw_rates is None else yaw_rates
        newest = int(self._bodies.arrivals.argmax())
        # By the clock of the measurements, carried on by this machine's since the newest came.
        now = int(self._bodies.stamps[newest] + 1e9 * (self._woken - self._bodies.arrivals[newest]))
        for i, publishers in enumerate(self._publishers):
            if self._names.setpoints == POSE:
                messages = [pose_stamped(store, now, places[i], level(yaws[i]))]
            else:
                through = velocities[i] if not planned or self.team.config.control.drag_feedforward else still[i]
                rise = self._feedforward.acceleration(i, through, accelerations[i], force[i], yaws[i])
                jerk = self._feedforward.jerk(i, jerks[i])
                setpoint = PX4Setpoint(places[i], velocities[i], rise, yaws[i], yaw_rates[i], jerk=jerk)
                make_message = trajectory_setpoint if self._names.is_report else full_state
                messages = [make_message(store, now, setpoint)]
                if self._names.is_report and self._receiver == PX4:
                    messages.insert(0, control_mode(store, now))
            for publish, message in zip(publishers, messages, strict=True):
                publish(message)
        self._setpoints, self._sent = (places.copy(), yaws.copy()), self._woken

    def _change(self, mode: str, why: str) -> None:
        if mode != self.mode:
            self._say(f"{mode}: {why}")
            self.mode = mode
