"""From the plan of a team to actions of `full_state`: each drone's motion and cable force beside those of its slot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import mul, put, row, thrust_frame, vec
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.team_model import ModelWork, TeamModel, accelerations

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


class FullStateCommand:
    """Commands of E teams, where plans begin: position, velocity, acceleration and, by the thrust's rate, jerk.

    The force on the cable is what makes the controller's thrust the planned one: (m + m_L) a + P + m g = F, see
    `geometric.desired_force`. Until the next action the set-point moves on with a and j, and F with its rate.

    Args:
        vec: environments with the interface `full_state`.
        model: of their teams.
        ahead: time from an observation to when actions are applied [s].
        anchored: whether set-points begin where drones know themselves to be, rather than where plans do.
    """

    def __init__(self, vec: MultiliftVec, model: TeamModel, ahead: float, anchored: bool = True):
        self._vec, self._model, self._anchored = vec, model, anchored
        # A goal that moves is a control step further on when the controllers read it.
        self._ahead = ahead + (vec.task.control_dt if vec.task.KERNELS.plan else 0.0)
        self._work = ModelWork.of(vec.num_drones)
        self._tension = np.zeros((vec.num_envs, vec.num_drones))
        numbers = vec.controller.interface.numbers
        self._scales = np.array([getattr(vec.config.acting, number.limit) for number in numbers])

    def act(
        self, present: np.ndarray, states: np.ndarray, loads: np.ndarray, thrust: np.ndarray, rate: np.ndarray,
        drag: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return actions (E, N, 16) in [-1, 1].

        Args:
            present: (E, 12 + 7 N) the states when the environments were observed.
            states: (E, 12 + 7 N) where plans begin.
            loads: (E, 7) on the payload, see `team_model.accelerations`.
            thrust, rate: (E, N, 3) to be exerted beside the drag [N], and how it changes [N/s].
            drag: (E, N, 3) of the drones [N].
        """
        vec, goal, gains = self._vec, self._vec.task.planned, self._vec.controller.gains
        own = vec.task.view.estimated
        position, velocity, acceleration = self._drone_motion(states, loads)
        if self._anchored:
            # Set-points are for what drones know of themselves, which states that fit the whole team may not agree
            # with.
            was, moved, _ = self._drone_motion(present, loads)
            off, faster = own.drone_position - was, own.drone_velocity - moved
            position += np.where(np.isfinite(off), off, 0.0)  # a drone may know nothing for a moment
            velocity += np.where(np.isfinite(faster), faster, 0.0)
        total = (gains.mass + gains.load_share)[:, None]
        rotors = thrust if vec.config.control.drag_feedforward else thrust + drag
        force = rotors - total * acceleration - gains.mass[:, None] * [0.0, 0.0, GRAVITY]

        # the slots when actions are applied
        t = self._ahead
        speed = goal.velocity[:, None] + goal.slot_velocity
        change = goal.acceleration[:, None] + goal.slot_acceleration
        jerk = goal.jerk[:, None] + goal.slot_jerk
        slot = goal.slots + t * speed + t**2 / 2 * change + t**3 / 6 * jerk
        beside = [
            position - slot,
            velocity - speed - t * change - t**2 / 2 * jerk,
            acceleration - change - t * jerk,
            rate / total - jerk,
            (force - goal.cable_force) / np.linalg.norm(goal.cable_force, axis=-1, keepdims=True),
        ]
        c, s = goal.slot_frame[..., 0], goal.slot_frame[..., 1]
        action = np.zeros((*thrust.shape[:2], 16))
        for k, vector in enumerate(beside):
            action[..., 3 * k] = c * vector[..., 0] + s * vector[..., 1]
            action[..., 3 * k + 1] = c * vector[..., 1] - s * vector[..., 0]
            action[..., 3 * k + 2] = vector[..., 2]
        return np.clip(action / self._scales, -1.0, 1.0)

    def _drone_motion(self, states: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions of drones, velocities and accelerations of their hooks (E, N, 3) in states (E, 12 + 7 N)."""
        model, n = self._model, self._vec.num_drones
        count, q = len(states), 6 + 2 * n
        write_tensions(states, model, np.ascontiguousarray(loads), self._work, self._tension)
        rotation = rotations(states[:, 3:6])
        arm = np.einsum("eij,nj->eni", rotation, model.anchors)
        rates = np.einsum("eij,ej->ei", rotation, states[:, q + 3 : q + 6])
        level, swing = states[:, 6:q].reshape(count, n, 2), states[:, q + 6 : 2 * q].reshape(count, n, 2)
        up = np.sqrt(np.maximum(1.0 - (level**2).sum(axis=-1, keepdims=True), 1e-2))
        cable = np.concatenate([level, up], axis=-1)
        turning = np.concatenate([swing, -(level * swing).sum(axis=-1, keepdims=True) / up], axis=-1)
        length = model.length[:, None]
        thrust = states[:, 2 * q :].reshape(count, n, 3)
        position = states[:, None, :3] + arm + length * cable - self._hook_arms(thrust)
        velocity = states[:, None, q : q + 3] + np.cross(rates[:, None], arm) + length * turning
        acceleration = (thrust - self._tension[..., None] * cable) / model.drone_mass[:, None] - [0.0, 0.0, GRAVITY]
        return position, velocity, acceleration

    def _hook_arms(self, thrust: np.ndarray) -> np.ndarray:
        """Return the hooks of drones from their centres (E, N, 3) [m], by thrust vectors (E, N, 3)."""
        arms = np.zeros(thrust.shape)
        write_hook_arms(thrust, self._vec.task.planned.drone_yaw, self._vec.task.rig, arms)
        return arms


@kernel
def write_hook_arms(thrust, yaw, rig, arms):
    """Write the hooks of drones from their centres (E, N, 3) [m], by thrust vectors and the teams' headings (E,)."""
    if rig.hooked:
        for e in range(thrust.shape[0]):
            for n in range(thrust.shape[1]):
                frame = thrust_frame(vec(thrust, e, n), yaw[e] + rig.heading[n])
                put(arms[e, n], mul(frame, row(rig.hooks, n)))


@kernel
def write_tensions(states, model, loads, work, tension):
    """Write the tensions (E, N) of the cables [N] in states (E, 12 + 7 N)."""
    for e in range(states.shape[0]):
        accelerations(states[e], model, loads[e], work)
        for n in range(tension.shape[1]):
            tension[e, n] = work.tension[n]


def rotations(angles: np.ndarray) -> np.ndarray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) (E, 3, 3) of roll, pitch and yaw (E, 3)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
