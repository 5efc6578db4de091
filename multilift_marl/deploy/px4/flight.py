"""A flight of autopilots: start, take-off with slack cables, the way to the task, the task, the way back, landing.

Take-off and landing are the tasks of these names, the ways between are task `track` with two way-points, the drones'
set-points those of the action interface. Every part has a world of its own, which begins in the state that the last one
left; the autopilots notice nothing of that. Around them are the obstacles of the task, which ways between parts do not
avoid: task `navigate` is flown from the ground below its start to that below its goal.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.deploy.px4.phases import Phase, find_failure
from multilift_marl.deploy.px4.team import ACTIONS, AutopilotController, AutopilotTeam
from multilift_marl.deploy.px4.ways import HOLD, Goal, plan_way, read_goal, wrapped
from multilift_marl.deploy.ros.stages import Orders, Stage
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, FlightError
from multilift_marl.evaluation.rollout import Trace, Tracer, measure_episodes
from multilift_marl.math3d import ease, heading
from multilift_marl.mdp.ground import MAX_MARGIN, pace_of
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import Policy
from multilift_marl.sim.world import World
from multilift_marl.tasks.navigate import Navigate

SCRIPT = "formation_integral"  # of all parts but the task
_TURNING = 0.5  # [rad/s] of drones about themselves there, on average
_TAKEOFF, _LANDING = 33.0, 30.0  # [s]
_PACE, _MARGIN = 0.5, 0.05  # of these; [m] which PX4's estimates are off by
LANDING_PACE = 0.5  # at most, of task `land`: at 1 drones are 8 cm late, and payloads have hit the ground
_BY_AUTOPILOTS = {"randomization.action_delay": 0, "control.disturbance": "none"}  # they are late, and reject forces
_OWN = ("task", "task_options", "reward")  # what take-off and landing have of their own
Maker = Callable[[MultiliftVec], Policy]
Say = Callable[[str], None]
OnStep = Callable[[MultiliftVec], None]
Watch = Callable[[MultiliftVec, Stage], None]


class FlightResult(NamedTuple):
    """The task of a flight, as measured."""

    metrics: dict[str, np.ndarray]
    """Of one episode, see `run_episodes`."""
    trace: Trace
    drone_error: float
    """[m] RMS of the drones' distance from their references."""
    estimate_error: float
    """[m] RMS of the autopilots' estimates of their places; NaN with our controller."""
    phases: tuple[Phase, ...] = ()
    """From take-off to landing."""
    ended: str = ""
    """How the flight ended before it was over; empty if it did not."""


class _LandNow(Exception):
    """The task is to end, and the team to land, for the reason given."""


class Flight:
    """Flies one episode of a task by autopilots, from the ground and back.

    Args:
        config: the task, its rig and its control.
        team: the autopilots.
        seed: evaluation seed; the episode is the first of `evaluate.py`.
        say: called with what goes on.
        watch: called with the environment of the part that is flown, after each of its policy steps, and the stage.
        orders: may hold the flight back, or end its task.

    Attributes:
        start: state in which the task began; empty for `takeoff`, which begins as ever.
        phases: of the flight so far.
        stage: in which it is.

    Raises:
        ConfigError: what autopilots cannot fly.
    """

    def __init__(
        self, config: Config, team: AutopilotTeam, seed: int, say: Say = print,
        watch: Watch = lambda vec, stage: None, orders: Orders | None = None,
    ):  # fmt: skip
        self.config, self.team, self.seed, self._say, self._watch = check_config(config), team, seed, say, watch
        self._orders, self.stage = orders or Orders(), Stage.INIT
        self._flown = build_config(self.config.model_dump(), _BY_AUTOPILOTS)
        self._task = self._make(self._flown)
        self._task.reset(seed=seed)
        self._landing = self._make_landing()
        self.start: dict[str, np.ndarray] = {}
        self.phases: list[Phase] = []
        self._known_peak = 0.0
        self._begun: dict[str, np.ndarray] = {}

    @property
    def vec(self) -> MultiliftVec:
        """The environment of the task."""
        return self._task

    @property
    def margin(self) -> float:
        """Of its own take-off and landing, see the tasks of these names [m]."""
        return min(_MARGIN, MAX_MARGIN * float(self.config.system.cable_length.min()))

    def fly(self, make_policy: Maker, on_step: OnStep | None = None) -> FlightResult:
        """Fly, and return the task as measured.

        Args:
            make_policy: returns the policy of the task for its environment.
            on_step: called with that environment at the start of the task and after every step.

        Raises:
            FlightError: an autopilot that does not do its part, a failure before the task, or an end by order, after
                landing.
        """
        self.phases, begin = [], read_goal(self._task)
        way = self._task
        try:
            if self.config.task == "takeoff":
                observation = self._arm(self._task)
            else:
                rise: dict[str, Any] = {"place_xy": 0.0, "target_yaw": 0.0, "target_height": begin.pose[2]}
                if self.config.task == "navigate":
                    rise["origin"] = begin.pose[:2]
                takeoff = self._make_part("takeoff", _TAKEOFF, rise)
                self._run(takeoff, self._arm(takeoff), "take-off", Stage.TAKE_OFF)
                self._say("to the task")
                way = self._go(takeoff, read_goal(takeoff), begin, "the way to the task")
                self._hover(way, begin)
                observation = self._take_over(self._task, way.world, self.config.task)
                self.start, way = self._begun, self._task
            result = self._measure_task(make_policy, observation, on_step)
        except _LandNow as why:
            self._say(f"{why}: back, and landing")
            if way is self._task:
                begin, self.stage = self._here(), Stage.HOVER
                if self.config.task == "navigate":  # it lands where it is
                    self._landing = self._make_landing(begin.pose)
                self._begin("stop", way)
                self._rest(way, begin, 0.0, HOLD, "stop")
            self._end(self._return(way, begin))
            raise FlightError(f"the task was not flown to its end: {why}") from None
        ended, vec = "", self._task
        if (cause := int(result.metrics["failure_cause"][0])) != 0:
            ended = f"task {self.config.task} failed: {self._task.failure_causes[cause]}"
        elif self.config.task != "land":
            self._say("back, and landing")
            try:  # the task has been measured, whatever happens now
                vec = self._return(self._task, read_goal(self._task))
            except (FlightError, ConfigError) as error:
                return result._replace(phases=tuple(self.phases), ended=str(error))
        self._end(vec)
        return result._replace(phases=tuple(self.phases), ended=ended)

    def _hover(self, vec: MultiliftVec, goal: Goal) -> None:
        """Rest until the task may begin."""
        self.stage = Stage.HOVER
        while not self._orders.may_begin(Stage.TRAJECTORY):
            if self.phases[-1].name != "hover until ordered":
                self._begin("hover until ordered", vec)
                self._say("in hover, until it may begin")
            self._rest(vec, goal, 0.0, vec.task.dt, "hover")
            if why := self._orders.why_to_land():
                raise _LandNow(why)

    def _here(self) -> Goal:
        """Return where the team of the task rests if its payload stays where it is."""
        vec, state = self._make_part("hover", HOLD, {}), self._task.world.state
        vec.reset(seed=self.seed)
        yaw = heading(tuple(state.payload_rotation[0].ravel()))
        c, s = np.cos(yaw), np.sin(yaw)
        vec.task.place_goal(0, state.payload_position[0], np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        return read_goal(vec)

    def _return(self, vec: MultiliftVec, begin: Goal) -> MultiliftVec:
        """Fly back and land; return the environment in which."""
        way = self._go(vec, begin, read_goal(self._landing), "the way back")
        observation = self._take_over(self._landing, way.world, "landing")
        self._run(self._landing, observation, "landing", Stage.LAND)
        return self._landing

    def _end(self, vec: MultiliftVec) -> None:
        for autopilot in self.team.offboard:
            # By force: PX4 itself may not have noticed yet that it has landed.
            autopilot.arm(False, force=True)
        self.team.settle(vec.world)  # so that they do, and close their logs
        self.stage = Stage.END
        self._watch(vec, self.stage)

    def _arm(self, vec: MultiliftVec) -> np.ndarray:
        """Begin a take-off, arm the autopilots there, and return its first observation."""
        observation, _ = vec.reset(seed=self.seed, options={"randomization": self._drawn()})
        self.team.board(vec.world)
        self._say("waiting for the autopilots")
        self.stage, every, ticks = Stage.INIT, round(vec.task.dt * self.config.sim.control_hz), itertools.count(1)

        def watch() -> None:
            if next(ticks) % every == 0:
                self.stage = Stage.ARMING if self.team.settled else Stage.INIT
                self._watch(vec, self.stage)

        self.team.prepare(vec.world, watch, partial(self._orders.may_begin, Stage.TAKE_OFF))
        self._say(f"armed after {self.team.time:.0f} s; take-off")
        # While they armed, drones may have moved a little: references begin where they are now.
        vec.controller.start(0)
        return observation

    def _measure_task(self, make_policy: Maker, observation: np.ndarray, on_step: OnStep | None) -> FlightResult:
        self._say(f"{self.config.task}, {self._task.max_steps * self._task.task.dt:g} s")
        self._begin(self.config.task)
        self.stage = Stage.TRAJECTORY

        def note(vec: MultiliftVec) -> None:
            self._note(vec, vec.task.dt)
            if why := self._orders.why_to_land():
                raise _LandNow(why)
            if on_step is not None:
                on_step(vec)

        self._watch(self._task, self.stage)  # others are asked for their first set-points
        if on_step is not None:
            on_step(self._task)
        return _measure(self._task, make_policy(self._task), observation, self.team, note)

    def fly_ours(self, make_policy: Maker) -> FlightResult:
        """Fly the same task from the same state with the geometric controller in place of autopilots."""
        vec = MultiliftVec(self.config, EVALUATION)
        observation, _ = vec.reset(seed=self.seed, options={"state": self.start, "randomization": self._drawn()})
        return _measure(vec, make_policy(vec), observation)

    def _part(self, task: str, seconds: float, options: dict[str, Any]) -> Config:
        """Return the configuration of another task by the same rig; it leaves the ground and comes to it gently."""
        if task in ("takeoff", "land"):
            options = {**options, "pace": _PACE, "margin": self.margin}
            seconds /= pace_of(1.0, self.config.system)
        values = {key: value for key, value in self._flown.model_dump().items() if key not in _OWN}
        overrides = {f"task_options.{key}": value for key, value in options.items()}
        overrides |= {"task": task, "env.episode_seconds": seconds, "control.action": "reference"}
        return build_config(values, overrides)

    def _make(self, config: Config) -> MultiliftVec:
        vec = MultiliftVec(config, EVALUATION)
        vec.use_controller(AutopilotController(config, vec.world, self.team), self.team.report)
        return vec

    def _make_part(self, task: str, seconds: float, options: dict[str, Any]) -> MultiliftVec:
        """Return the environment of another part, among the obstacles of the task."""
        vec = self._make(self._part(task, seconds, options))
        for own, given in zip(vec.world.obstacles, self._task.world.obstacles, strict=True):
            own[:] = given
        return vec

    def _make_landing(self, pose: tuple[float, float, float, float] | None = None) -> MultiliftVec:
        """Return the environment of the landing: of task `navigate` below a pose, None for its goal."""
        options: dict[str, Any] = {"pad_xy": 0.0, "pad_yaw": 0.0}
        if isinstance(self._task.task, Navigate):
            x, y, z = self._task.task.own.goal[0].tolist() if pose is None else pose[:3]
            options |= {"origin": (x, y), "start_height": z}
        vec = self._make_part("land", _LANDING, options)
        vec.reset(seed=self.seed)
        return vec

    def _drawn(self) -> dict[str, np.ndarray]:
        """Return what is hidden in the task, which is the same all along."""
        # Not the bias: it is one of the numbers observed, and other tasks observe others.
        drawn = self._task.current()[1]["randomization"]
        return {name: array[0] for name, array in drawn.items() if name != "observation_bias"}

    def _run(self, vec: MultiliftVec, observation: np.ndarray, what: str, stage: Stage) -> None:
        self.stage = stage
        self._begin(what)
        self._fly_part(vec, observation, what)

    def _fly_part(self, vec: MultiliftVec, observation: np.ndarray, what: str) -> None:
        policy, self._known_peak = make_scripted(SCRIPT, vec), 0.0
        for _ in range(vec.max_steps):
            observation, _, terminated, _, info = vec.step(policy.act(observation))
            self._note(vec, vec.task.dt)
            if terminated[0]:
                cause = vec.failure_causes[info["failure_cause"][0]]
                raise FlightError(f"{what} failed after {vec.steps[0] * vec.task.dt:.1f} s: {cause}")

    def _go(self, vec: MultiliftVec, begin: Goal, end: Goal, what: str) -> MultiliftVec:
        """Fly to where the team rests at `end`, its formation turned as a body; return the environment in which."""
        self.stage = Stage.GO_TO
        self._begin(what, vec)
        if (way := plan_way(self.config, begin, end)) is not None:
            seconds, options = way
            # Task `track` lets drones face as the payload does.
            self._rest(vec, begin, wrapped(begin.pose[3] - begin.yaw), 0.0, what)
            before, vec = vec, self._make_part("track", seconds, options)
            self._fly_part(vec, self._take_over(vec, before.world, what), what)
            begin = read_goal(vec)
        self._rest(vec, end._replace(yaw=begin.yaw), wrapped(end.yaw - begin.yaw), HOLD, what)
        return vec

    def _rest(self, vec: MultiliftVec, goal: Goal, turn: float, hold: float, what: str) -> None:
        """Let the drones rest in their slots while they turn about themselves by `turn` [rad], then for `hold` [s]."""
        world, seconds, dt = vec.world, abs(turn) / _TURNING, 1.0 / self.config.sim.control_hz
        still = np.zeros_like(goal.slots)
        motion = np.stack([goal.slots, still, still], axis=1)
        for tick in range(round((seconds + hold) / dt)):
            share = ease(tick * dt, 0.0, max(seconds, dt))[0]
            self.team.tick(world, partial(self._send, motion, goal.cable_force, goal.yaw + share * turn))
            world.step(world.thrust, world.system.control_interval)
            if (tick + 1) % round(vec.task.dt / dt) == 0:
                self._note(vec, vec.task.dt)
                if cause := find_failure(world):
                    raise FlightError(f"{what} failed: {cause}")

    def _send(self, motion: np.ndarray, cable_force: np.ndarray, yaw: float, drone: int) -> None:
        self.team.send(drone, motion[drone], cable_force[drone], yaw + self.team.heading[drone])

    def _take_over(self, vec: MultiliftVec, world: World, what: str) -> np.ndarray:
        """Begin an episode in the state of another world, and return its first observation."""
        self._begun = {name: array.copy() for name, array in world.state._asdict().items() if name not in _FOLLOWING}
        options = {"state": self._begun, "randomization": self._drawn()}
        try:
            observation, _ = vec.reset(seed=self.seed, options=options)
        except ValueError as error:  # a failure from the start, or cables that would be torn
            last = self.phases[-1].name
            raise FlightError(f"after {last}, {what} cannot begin where the team is: {error}") from None
        self.team.board(vec.world)
        return observation

    def _begin(self, name: str, vec: MultiliftVec | None = None) -> None:
        """Begin a phase, in an environment that has flown another one before, or one that begins."""
        self.phases.append(Phase(name, 0.0, np.inf, 0.0, 0.0))
        self._known_peak = 0.0 if vec is None else float(vec.world.stats.tension_peak[0])

    def _note(self, vec: MultiliftVec, seconds: float) -> None:
        peak = float(vec.world.stats.tension_peak[0])
        own = peak if peak > self._known_peak else 0.0  # else it is an earlier phase's
        self.phases[-1] = self.phases[-1].joined(vec.world.state, own, seconds)
        self._watch(vec, self.stage)


_FOLLOWING = ("cable_tension", "cable_broken")  # from the places


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
    if config.task in ("loss", "regroup"):
        raise ConfigError(f"PX4 cannot fly config={config.task}: a team that has lost a drone cannot be brought back")
    if config.task == "land" and (pace := config.task_options.get("pace", 1.0)) > LANDING_PACE:
        raise ConfigError(
            f"drones under PX4 follow config=land too late at task_options.pace={pace:g}, and the "
            f"payload hits the ground; set task_options.pace={LANDING_PACE:g} and env.episode_seconds=24"
        )
    if config.scene.obstacles and config.task != "navigate":
        raise ConfigError(
            "a flight's own ways to and from its task do not avoid obstacles; take task navigate, or leave "
            "scene.obstacles out"
        )
    if any(any(each.travel) for each in config.scene.obstacles):
        raise ConfigError("PX4 flies among obstacles that stand still; set scene.obstacles.travel to 0, 0, 0")
    if config.cable.model != "massless":
        raise ConfigError("flights by PX4 go on from state to state, which chains cannot; set cable.model=massless")
    return build_config(config.model_dump(), {"env.num_envs": 1, "env.num_threads": 1})
