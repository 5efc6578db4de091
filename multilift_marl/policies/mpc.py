"""Model-predictive control of a whole team, `policy=mpc`: central, it knows all drones' states and the path ahead.

At each policy step a plan of the team's motion (`planning/team_planner.py`) gives every drone its thrust vector and how
that changes; the drone's controller gets them as an acceleration and the rates of its tilt (`acc_rates`). A team whose
plan is late or not finite flies on by its last one, and after `planner.patience` by the interface's linear baseline.
"""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.approach import Approach, begin_approaches, write_approaches
from multilift_marl.planning.flatness import SAMPLES, SHAPES, STEP
from multilift_marl.planning.force_estimator import ForceEstimator
from multilift_marl.planning.hard_planner import HardPlanner
from multilift_marl.planning.team_observer import TeamObserver
from multilift_marl.planning.team_planner import TeamPlanner
from multilift_marl.policies.full_state_command import FullStateCommand, rotations
from multilift_marl.policies.hold import HoldAccRates, HoldFullState
from multilift_marl.policies.last_plan import LastPlan
from multilift_marl.policies.mpc_checks import check_team
from multilift_marl.sensing.load_sensing import CAMERA_DELAY, CAMERAS

if TYPE_CHECKING:
    from collections.abc import Callable

    from multilift_marl.envs.core import MultiliftVec
    from multilift_marl.policies.policy import Policy

    Preview = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray | None]]

# By which share of what sensors say beside the prediction states are corrected: of cameras, after their filters; of
# `randomization.observation_noise`, which no filter has smoothed; and of drones' own cables.
SHARE, UNFILTERED, ONBOARD = 0.6, 0.35, 0.1
ENOUGH = {  # full scales of actions that limit no usual flight, and those to set
    "acc_rates": {"max_acceleration": (10.0, 25.0), "max_tilt_rate": (8.0, 15.0)},
    "full_state": {
        "max_offset": (1.0, 2.0), "max_velocity": (3.0, 5.0), "max_acceleration": (10.0, 25.0),
        "max_jerk": (100.0, 300.0), "max_cable_force": (1.5, 5.0),
    },
}  # fmt: skip


class TeamMpc:
    """Central: it reads of `vec` what the drones know of themselves and of the payload, and where the target will be.

    Args:
        vec: environments with one of the interfaces; read at every `act`.
        preview: where targets come from, see the attribute.

    Class attributes:
        NAME: of the policy.
        INTERFACE, INTERFACES: by which it acts, and those by which it can.

    Attributes:
        planner: TeamPlanner.
        preview: function of times (E, M) since the start of the episode [s] that returns the payload's places
            (E, M, 3) [m] and attitudes (E, M, 3, 3), and the formation's shape there: nominal cable forces
            (E, M, N, 3) [N], see `flatness.set_flat_state`, or None for that at rest. None: `Task.preview_targets`.

    Raises:
        ConfigError: a task that it cannot fly, see `Task.CAN_PLAN`; a body that hangs on one point (see
            `team_model.has_model`); drones that reject the forces that it estimates.
    """

    NAME: ClassVar[str] = "mpc"
    INTERFACE: ClassVar[str] = "acc_rates"
    INTERFACES: ClassVar[tuple[str, ...]] = ("acc_rates", "full_state")
    _vec: MultiliftVec

    def __init__(self, vec: MultiliftVec, preview: Preview | None = None):
        system, config, n = vec.world.system, vec.config, vec.num_drones
        asked = self._asked(vec)
        check_team(vec, asked)
        self._is_point = vec.task.rig.is_point
        self._vec, settings, self.preview = vec, config.planner, preview
        self._exact = exact = config.env.sensing == "ideal" and not config.randomization.observation_noise
        self.planner = self._make_planner()
        teams = len(self.planner.plans.states)
        self._dt = vec.task.dt
        cameras, onboard = config.env.sensing in CAMERAS, config.env.sensing in ("onboard", "blind")
        noise = settings.estimate_noise or (0.5 if exact else 2.0 if onboard else 1.0)
        self._estimator = None
        if settings.estimate:
            self._estimator = ForceEstimator(self.planner.model, teams, noise, apart=teams > vec.num_envs)
        self._observer = None
        if not exact:
            late = CAMERA_DELAY if cameras else 0.0
            share = SHARE if cameras else ONBOARD if onboard else UNFILTERED
            self._observer = TeamObserver(self.planner.model, teams, share, late)
        self._full_state, self._feedback = None, settings.feedback
        interface = self._interface(vec)
        if self._feedback < 1.0 and interface != "full_state":
            raise ConfigError(
                f"planner.feedback={self._feedback:g} gives drones plans to follow, which control.action="
                f"{config.control.action} does not; set control.action=full_state, or planner.feedback=1"
            )
        if interface == "full_state":
            self._full_state = FullStateCommand(vec, self.planner.model, settings.delay, self._feedback == 1.0)
        lag = np.array([vehicle.rotor_time_constant for vehicle in system.vehicles]).repeat(3)
        self._lead = lag + 0.5 * self._dt if settings.lead is None else settings.lead
        self._drag = np.array([vehicle.drag for vehicle in system.vehicles], float)
        self._lift = np.array([vehicle.thrust_coefficient for vehicle in system.vehicles], float)
        under_way = _whole_steps(settings.delay, self._dt)
        self._sent = np.zeros((under_way + 1, teams, 3 * n))
        self._starts = np.zeros((under_way + 1, teams, 12 + 7 * n))  # of the plans for now and later
        self._fresh, self._acted = np.ones(teams, bool), np.zeros(teams)
        self._last = LastPlan(self.planner.plans, settings.step, self._dt, under_way)
        self._without_plan = self._make_fallback()
        self._approach = Approach.zeros(teams)
        self._offsets = np.zeros((teams, settings.steps + 1, 12))
        enough = ENOUGH[interface]
        if any(getattr(config.acting, key) < least for key, (least, _) in enough.items()):
            cure = " ".join(f"control.{key}={wide:g}" for key, (_, wide) in enough.items())
            warn_once("mpc", f"actions of these full scales limit what {asked} can command; set {cure}")
        self._deadline = np.inf if settings.deadline is None else settings.deadline
        self._patience = settings.patience
        self._limits = config.acting.max_acceleration, config.acting.max_tilt_rate

    def _make_planner(self) -> TeamPlanner | HardPlanner:
        vec, settings = self._vec, self._vec.config.planner
        team = vec.world.system, settings, vec.num_envs
        return HardPlanner(*team) if settings.limits == "hard" else TeamPlanner(*team, vec.world.obstacles)

    def _asked(self, vec: MultiliftVec) -> str:
        """Return key=value by which its plans are asked for."""
        return f"policy={self.NAME}"

    def _interface(self, vec: MultiliftVec) -> str:
        """Return by which interface it acts."""
        return vec.config.control.action

    def _make_fallback(self) -> Policy:
        """Return what flies teams that have had no plan for a while."""
        return HoldAccRates(self._vec) if self._full_state is None else HoldFullState(self._vec)

    def _time(self) -> np.ndarray:
        """Return the time of each plan (E,) [s]."""
        return self._vec.task.time

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the plans of the environments in the mask (E,) (None: all)."""
        chosen = np.ones(len(self._fresh), bool) if mask is None else mask
        self._fresh[chosen] = True
        self._last.reset(chosen)

    def metrics(self) -> dict[str, np.ndarray]:
        """Return the shares of the episodes' steps (E,) with a plan that came late, or failed: was not finite."""
        return self._last.metrics()

    def arrays(self) -> dict[str, np.ndarray]:
        """Return live arrays of all that later actions depend on, environment first, by name."""
        groups: list[NamedTuple] = [self.planner.plans, self._approach]
        if self._estimator is not None:
            groups.append(self._estimator.estimate)
        if isinstance(self.planner, HardPlanner):
            groups.append(self.planner.hard.multipliers)
        found = {f"{type(group).__name__}.{name}": array for group in groups for name, array in group._asdict().items()}
        found |= {f"last.{name}": array for name, array in self._last.arrays().items()}
        if self._observer is not None:
            found |= {"observer.states": self._observer.states, "observer.fresh": self._observer.fresh}
        found |= {"sent": np.moveaxis(self._sent, 1, 0), "starts": np.moveaxis(self._starts, 1, 0)}
        return found | {"fresh": self._fresh, "acted": self._acted}

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, A) in [-1, 1] for the present state of the environments, whose observations these are.

        Raises:
            ValueError: observations of another number of environments.
        """
        planner, shape = self.planner, (self._vec.num_envs, self._vec.num_drones)
        if np.shape(observation)[:2] != shape:
            raise ValueError(
                f"mpc reads the state of its {shape[0]} environments of {shape[1]} drones, but the observation has "
                f"shape {np.shape(observation)}; give the observations of all of them"
            )
        ahead, begin = (len(self._sent) - 1) * self._dt, perf_counter()
        states, payload_rotation, drag = self._measure()
        unknown = ~np.isfinite(states).all(axis=1)
        if unknown.any():
            states[unknown] = self._last.next()[unknown]
            payload_rotation[unknown] = np.eye(3)
            drag[~np.isfinite(drag).all(axis=(1, 2))] = 0.0
        loads, forces = self._unknown(self._fresh)
        states[:, -3 * shape[1] :] += np.where(unknown[:, None], 0.0, forces)  # planned ones hold them
        if self._observer is not None:
            self._observer.fresh[self._fresh] = True
            states = self._observer.update(states, self._dt, loads).copy()
        if self._estimator is not None:
            seen, known = self._for_estimator(states, ~unknown)
            self._estimator.update(seen, self._dt, known)
        unknown |= self._forget_unsound(states, loads, forces)
        following = ~(self._fresh | unknown) if self._feedback < 1.0 else np.zeros(len(states), bool)
        if following.any():
            planned = self._correct_plans(states, payload_rotation, following)
        now = self._time()[:, None]
        last = np.maximum(now - self._dt, 0.0)
        targets = self._look_ahead(now + [0.0, self._dt])[:2], self._look_ahead(last)[:2]
        begin_approaches(self._time(), self._dt, states, payload_rotation, targets, self._fresh, self._approach)
        times = now + ahead + planner.times.ravel()
        positions, rotations, shapes = self._look_ahead(times)
        poses = (len(times), *planner.times.shape)
        rotations = rotations.reshape(*poses, 3, 3)
        middle = SAMPLES // 2
        at = np.ascontiguousarray(times.reshape(poses)[:, :, middle])
        write_approaches(at, np.ascontiguousarray(rotations[:, :, middle]), self._approach, self._offsets)
        planner.plans.fresh[self._fresh] = True
        self._sent[:, self._fresh] = states[self._fresh, -3 * shape[1] :]
        self._fresh &= unknown
        present = states.copy()
        planner.predict(states, self._sent, self._dt, loads)
        if following.any():
            states[following] = planned[following]
        self._starts[:, ~following] = states[~following]  # they begin
        self._starts[:-1] = self._starts[1:]
        self._starts[-1] = states
        self._acted[:] = self._time()
        if shapes is not None:
            shapes = np.ascontiguousarray(shapes.reshape(*poses, -1, 3)[:, :, SHAPES])
        plans = planner.plan(states, positions.reshape(*poses, 3), rotations, self._dt, self._offsets, loads, shapes)
        late = (perf_counter() - begin) / len(states) > self._deadline
        self._last.keep(plans, late, plans.failed | unknown)
        rate = self._last.inputs()
        thrust = self._last.states()[:, -3 * shape[1] :] + self._lead * rate
        self._sent[:-1] = self._sent[1:]
        self._sent[-1] = thrust
        # of the rotors: what else acts is part of the planned ones
        own, rate = self._of_drones(thrust - forces), self._of_drones(rate)
        if self._full_state is not None:
            action = self._full_state.act(present, states, loads, own, rate, drag)
        else:
            action = self._command(own, rate, drag)
        lost = self._last.without > self._patience
        if lost.any():
            without = lost.reshape(shape[0], -1)
            action = np.where(without[..., None], self._without_plan.act(observation), action)
            self._fresh |= lost  # its next plan begins where the team is then
        return action

    def _for_estimator(self, states: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (E, 12 + 7 N) that forces are estimated by, in turn, and which are known (E,)."""
        return states, known

    def _of_drones(self, vectors: np.ndarray) -> np.ndarray:
        """Return what plans (E, 3 N) have for each drone (E, N, 3)."""
        return vectors.reshape(self._vec.num_envs, self._vec.num_drones, 3)

    def _look_ahead(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return places, attitudes and shapes at times (E, M), see `preview`, as arrays that can be written."""
        preview = self._vec.task.preview_targets if self.preview is None else self.preview
        position, rotation, *shape = preview(times)
        forces = shape[0] if shape else None
        return np.array(position), np.array(rotation), None if forces is None else np.array(forces)

    def _unknown(self, fresh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimates of loads (E, 7) and of forces on drones (E, 3 N), live; zero for fresh teams (E,)."""
        if self._estimator is None:
            return np.zeros((len(fresh), 7)), np.zeros((len(fresh), 3 * self._vec.num_drones))
        self._estimator.estimate.fresh[fresh] = True
        self._estimator.estimate.unknowns[fresh] = 0.0
        return self._estimator.loads, self._estimator.forces

    def _correct_plans(self, states: np.ndarray, payload_rotation: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Let states (E, 12 + 7 N) of the teams in the mask (E,) be those that were planned, corrected by a share.

        Return where the next plans begin, `planner.delay` later, corrected alike.
        """
        # Where the last plans are by now, also where steps were missed.
        later = self._last.states(np.maximum(self._time() - self._acted, self._dt))
        # Of the plan that began with the present, if plans are ahead of it.
        planned = (self._starts[1] if len(self._starts) > 1 else later).copy()
        off = states - planned
        off[:, 3:6] = np.remainder(off[:, 3:6] + np.pi, 2 * np.pi) - np.pi
        states[mask] = (planned + self._feedback * off)[mask]
        payload_rotation[mask] = rotations(states[mask, 3:6])
        return later + self._feedback * off

    def _forget_unsound(self, states: np.ndarray, loads: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Let estimates that are not finite begin anew from planned states; return whose they were (E,)."""
        lost = ~np.isfinite(np.hstack([states, loads, forces])).all(axis=1)
        if lost.any():
            states[lost] = self._last.next()[lost]
            loads[lost], forces[lost] = 0.0, 0.0
            if self._estimator is not None:
                self._estimator.estimate.fresh[lost] = True
            if self._observer is not None:
                self._observer.fresh[lost] = True
        return lost

    def _measure(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the states (E, 12 + 7 N) of the reduced model, the payload's attitudes, and drag (E, N, 3) [N]."""
        return self._measure_by(None)

    def _measure_by(self, drone: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `_measure`: the payload as a drone knows it; None: the mean of what all know."""
        view, n = self._vec.task.view, self._vec.num_drones
        own, load, model = view.estimated, view.payload_estimate, self.planner.model
        one = 0 if drone is None else min(drone, load.position.shape[1] - 1)  # where all know the same there is one
        chosen = slice(None) if drone is None else slice(one, one + 1)
        position, velocity, rates = (
            each[:, chosen].mean(axis=1) for each in (load.position, load.velocity, load.body_rates)
        )
        rotation = load.rotation[:, one]
        if self._is_point:  # nothing turns it: as its target, which the formation's heading follows
            rotation, rates = self._target_attitude()
        arm = np.einsum("eij,nj->eni", rotation, model.anchors)
        turning = np.einsum("eij,ej->ei", rotation, rates)
        hook = own.drone_position + np.einsum("enij,nj->eni", own.drone_rotation, self._vec.world.system.hooks)
        cable = hook - position[:, None] - arm
        length = np.linalg.norm(cable, axis=-1, keepdims=True)
        direction = cable / length
        # By the drone's centre, not its hook: feedback of how fast a drone tilts would be unstable.
        moved = own.drone_velocity - velocity[:, None] - _cross(turning[:, None], arm)
        swing = (moved - direction * (direction * moved).sum(-1, keepdims=True)) / length
        air = np.einsum("enji,enj->eni", own.drone_rotation, own.drone_velocity)
        drag = np.einsum("enij,enj->eni", own.drone_rotation, self._drag * air)
        lift = (self._lift[:, None] * own.rotor_speed**2).sum(-1)
        thrust = own.drone_rotation[..., 2] * lift[..., None] - drag
        count = len(position)
        euler = np.stack(
            [
                np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]),
                -np.arcsin(np.clip(rotation[:, 2, 0], -1, 1)),
                np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
            ],
            axis=1,
        )
        level, turned = direction[..., :2].reshape(count, -1), swing[..., :2].reshape(count, -1)
        parts = [position, euler, level, velocity, rates, turned, thrust.reshape(count, 3 * n)]
        return np.concatenate(parts, axis=1), np.ascontiguousarray(rotation), drag

    def _target_attitude(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the attitude (E, 3, 3) of the payload's target now, and its body rates (E, 3) [rad/s]."""
        turned = TeamMpc._look_ahead(self, self._vec.task.time[:, None] + STEP * np.arange(-1, 2))[1]
        change = np.swapaxes(turned[:, 1], 1, 2) @ (turned[:, 2] - turned[:, 0]) / (2 * STEP)
        return turned[:, 1], np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)

    def _command(self, thrust: np.ndarray, rate: np.ndarray, drag: np.ndarray) -> np.ndarray:
        """Return the actions that ask for thrust vectors (E, N, 3) [N] which change at a rate [N/s]."""
        vec, goal, gains = self._vec, self._vec.task.planned, self._vec.controller.gains
        mass, load = gains.mass[:, None], gains.load_share[:, None]
        # the controller feeds the cable's force, weight and its share of the load forward, and drag where it is told to
        rotors = thrust + drag
        fed = thrust if vec.config.control.drag_feedforward else rotors
        acceleration = (fed - goal.cable_force - mass * [0, 0, GRAVITY]) / (mass + load)
        along, across = goal.slot_frame[..., 0], goal.slot_frame[..., 1]
        most, fastest = self._limits
        action = np.zeros((*thrust.shape[:2], 5))
        action[..., 0] = (along * acceleration[..., 0] + across * acceleration[..., 1]) / most
        action[..., 1] = (along * acceleration[..., 1] - across * acceleration[..., 0]) / most
        action[..., 2] = acceleration[..., 2] / most
        # rates of the attitude whose z axis is along the rotors' thrust, drag included
        size = np.linalg.norm(rotors, axis=-1, keepdims=True)
        up = rotors / size
        change = (rate - up * (up * rate).sum(-1, keepdims=True)) / size
        yaw = vec.reference.yaw
        forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
        left = _cross(up, forward)
        left /= np.linalg.norm(left, axis=-1, keepdims=True)
        front = _cross(left, up)
        roll, pitch = -(left * change).sum(-1), (front * change).sum(-1)
        c, s = np.cos(yaw), np.sin(yaw)
        cosine, sine = c * along + s * across, s * along - c * across
        action[..., 3] = (cosine * roll - sine * pitch) / fastest
        action[..., 4] = (sine * roll + cosine * pitch) / fastest
        return np.clip(action, -1.0, 1.0)


def _whole_steps(delay: float, dt: float) -> int:
    """Return how many policy steps a delay [s] is."""
    steps = round(delay / dt)
    if abs(delay - steps * dt) > 1e-6:
        raise ConfigError(
            f"planner.delay={delay:g} is no whole number of policy steps of {dt:g} s, in which plans are made; set "
            f"planner.delay={int(delay / dt) * dt:g} or {(int(delay / dt) + 1) * dt:g}"
        )
    return steps


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a × b (..., 3), several times as fast as np.cross for few rows."""
    a0, a1, a2, b0, b1, b2 = (each[..., i] for each in (a, b) for i in range(3))
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)
