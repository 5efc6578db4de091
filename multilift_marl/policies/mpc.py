"""Model-predictive control of a whole team, `policy=mpc`: central, it knows all drones' states and the path ahead.

At each policy step a plan of the team's motion (`planning/team_planner.py`) gives every drone its thrust vector and how
that changes; the drone's controller gets them as an acceleration and the rates of its tilt (`acc_rates`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.approach import Approach, begin_approaches, write_approaches
from multilift_marl.planning.hard_planner import HardPlanner
from multilift_marl.planning.load_estimator import LoadEstimator
from multilift_marl.planning.team_observer import TeamObserver
from multilift_marl.planning.team_planner import TeamPlanner
from multilift_marl.sensing.load_sensing import CAMERA_DELAY

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


SHARE = 0.4  # of what sensors say beside the prediction, by which states are corrected
ENOUGH = 10.0, 8.0  # [m/s²], [rad/s] full scales of actions that limit no usual flight


class TeamMpc:
    """Central: it reads of `vec` what the drones know of themselves and of the payload, and where the target will be.

    Args:
        vec: environments with the interface `acc_rates`; read at every `act`.

    Class attributes:
        INTERFACE: by which it acts.

    Attributes:
        planner: TeamPlanner.

    Raises:
        ConfigError: a task that it cannot fly, see `Task.CAN_PLAN`; a team that flies elsewhere; a payload on one point
            or one cable, which has no attitude to plan.
    """

    INTERFACE: ClassVar[str] = "acc_rates"

    def __init__(self, vec: MultiliftVec):
        system, config, n = vec.world.system, vec.config, vec.num_drones
        if not vec.task.CAN_PLAN:
            raise ConfigError(
                f"policy=mpc cannot fly task {config.task}: it plans for taut cables, all drones and free air; take "
                "another policy"
            )
        if isinstance(vec, MeasuredTeam):
            raise ConfigError("policy=mpc reads rotor speeds, which are not measured of this team; take another policy")
        if vec.task.rig.is_point or n < 2:
            raise ConfigError("policy=mpc plans for payloads on two cables or more; take another policy for this rig")
        self._vec, settings = vec, config.planner
        self.planner = (HardPlanner if settings.limits == "hard" else TeamPlanner)(system, settings, vec.num_envs)
        self._dt = vec.task.dt
        noise = settings.estimate_noise or (0.2 if config.env.sensing == "ideal" else 1.0)
        self._estimator = LoadEstimator(self.planner.model, vec.num_envs, noise) if settings.estimate else None
        self._observer = None
        if config.env.sensing != "ideal":
            late = CAMERA_DELAY if config.env.sensing == "mocap" else 0.0
            self._observer = TeamObserver(self.planner.model, vec.num_envs, SHARE, late)
        lag = max(vehicle.rotor_time_constant for vehicle in system.vehicles)
        self._lead = lag + 0.5 * self._dt if settings.lead is None else settings.lead
        self._drag = np.array([vehicle.drag for vehicle in system.vehicles], float)
        self._lift = np.array([vehicle.thrust_coefficient for vehicle in system.vehicles], float)
        under_way = round(settings.delay / self._dt)
        self._sent = np.zeros((under_way + 1, vec.num_envs, 3 * n))
        self._fresh = np.ones(vec.num_envs, bool)
        self._approach = Approach.zeros(vec.num_envs)
        self._offsets = np.zeros((vec.num_envs, settings.steps + 1, 12))
        if config.acting.max_acceleration < ENOUGH[0] or config.acting.max_tilt_rate < ENOUGH[1]:
            warn_once(
                "mpc",
                "actions of these full scales limit what policy=mpc can command; set control.max_acceleration=25 and "
                "control.max_tilt_rate=15",
            )
        self._limits = config.acting.max_acceleration, config.acting.max_tilt_rate

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the plans of the environments in the mask (E,) (None: all)."""
        self._fresh[... if mask is None else mask] = True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 5) in [-1, 1] for the present state of the environments, whose observations these are.

        Raises:
            ValueError: observations of another number of environments.
        """
        vec, planner, shape = self._vec, self.planner, (self._vec.num_envs, self._vec.num_drones)
        if np.shape(observation)[:2] != shape:
            raise ValueError(
                f"mpc reads the state of its {shape[0]} environments of {shape[1]} drones, but the observation has "
                f"shape {np.shape(observation)}; give the observations of all of them"
            )
        ahead = (len(self._sent) - 1) * self._dt
        states, payload_rotation, drag = self._measure()
        if self._observer is not None:
            self._observer.fresh[self._fresh] = True
            known = np.zeros((len(states), 7)) if self._estimator is None else self._estimator.estimate.loads
            states = self._observer.update(states, self._dt, known).copy()
        now = vec.task.time[:, None]
        last = np.maximum(now - self._dt, 0.0)
        preview = vec.task.preview_targets
        targets = _arrays(preview(now + [0.0, self._dt])), _arrays(preview(last))
        begin_approaches(vec.task.time, self._dt, states, payload_rotation, targets, self._fresh, self._approach)
        times = now + ahead + planner.times.ravel()
        positions, rotations = _arrays(preview(times))
        poses = (len(times), *planner.times.shape)
        rotations = rotations.reshape(*poses, 3, 3)
        middle = planner.times.shape[1] // 2
        at = np.ascontiguousarray(times.reshape(poses)[:, :, middle])
        write_approaches(at, np.ascontiguousarray(rotations[:, :, middle]), self._approach, self._offsets)
        planner.plans.fresh[self._fresh] = True
        self._sent[:, self._fresh] = states[self._fresh, -3 * shape[1] :]
        self._fresh[:] = False
        loads = None
        if self._estimator is not None:
            self._estimator.estimate.fresh[planner.plans.fresh] = True
            loads = self._estimator.update(states, self._dt)
        planner.predict(states, self._sent, self._dt, loads)
        plans = planner.plan(states, positions.reshape(*poses, 3), rotations, self._dt, self._offsets, loads)
        rate = plans.inputs[:, 0].reshape(*shape, 3)
        thrust = plans.states[:, 0, -3 * shape[1] :].reshape(*shape, 3) + self._lead * rate
        self._sent[:-1] = self._sent[1:]
        self._sent[-1] = thrust.reshape(shape[0], -1)
        return self._command(thrust, rate, drag)

    def _measure(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the states (E, 12 + 7 N) of the reduced model, the payload's attitudes, and drag (E, N, 3) [N]."""
        view, n = self._vec.task.view, self._vec.num_drones
        own, load, model = view.estimated, view.payload_estimate, self.planner.model
        position, velocity = load.position.mean(axis=1), load.velocity.mean(axis=1)
        rotation, rates = load.rotation[:, 0], load.body_rates.mean(axis=1)
        arm = np.einsum("eij,nj->eni", rotation, model.anchors)
        turning = np.einsum("eij,ej->ei", rotation, rates)
        hook = own.drone_position + np.einsum("enij,nj->eni", own.drone_rotation, self._vec.world.system.hooks)
        cable = hook - position[:, None] - arm
        length = np.linalg.norm(cable, axis=-1, keepdims=True)
        direction = cable / length
        moved = own.drone_velocity - velocity[:, None] - np.cross(turning[:, None], arm)
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

    def _command(self, thrust: np.ndarray, rate: np.ndarray, drag: np.ndarray) -> np.ndarray:
        """Return the actions that ask for thrust vectors (E, N, 3) [N] which change at a rate [N/s]."""
        vec, goal, gains = self._vec, self._vec.task.goal, self._vec.controller.gains
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
        left = np.cross(up, forward)
        left /= np.linalg.norm(left, axis=-1, keepdims=True)
        front = np.cross(left, up)
        roll, pitch = -(left * change).sum(-1), (front * change).sum(-1)
        c, s = np.cos(yaw), np.sin(yaw)
        cosine, sine = c * along + s * across, s * along - c * across
        action[..., 3] = (cosine * roll - sine * pitch) / fastest
        action[..., 4] = (sine * roll + cosine * pitch) / fastest
        return np.clip(action, -1.0, 1.0)


def _arrays(preview: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return what `Task.preview_targets` returned as arrays that can be written."""
    position, rotation = preview
    return np.array(position), np.array(rotation)
