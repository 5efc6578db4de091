"""Cameras beside, above or behind the team, at a distance that follows from its size."""

from __future__ import annotations

from typing import Protocol

import mujoco
import numpy as np

from multilift_marl.errors import RenderingError, nearest
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task

CAMERAS = ("side", "top", "chase")
_ROOM = 0.35  # [m] of the payload from its target that the picture holds; beyond it the camera follows
_CHASE_ELEVATION = -22.0  # [deg]
_CHASE_TURN = 1.5  # [m] of flight in which a chasing camera turns most of the way to the direction of flight


class Environments(Protocol):
    """What can be drawn: environments, such as those of `envs.core.MultiliftVec`."""

    num_envs: int
    num_drones: int
    world: World
    task: Task
    steps: np.ndarray
    seeds: np.ndarray
    episodes: np.ndarray


class Camera:
    """A camera in a fixed direction from the team, "side" or "top", or behind it, "chase".

    "side" points at the target, and follows a payload that is farther away. "top" does the same, but shows the whole
    path of a target that has one. "chase" points at the payload, along its direction of flight.

    Args:
        vec: the environments.
        model: with `visuals`.
        name: one of CAMERAS.
        aspect: width over height of the picture.

    Attributes:
        view: MuJoCo's camera.

    Raises:
        RenderingError: an unknown name.
    """

    def __init__(self, vec: Environments, model: mujoco.MjModel, name: str, aspect: float):
        if name not in CAMERAS:
            raise RenderingError(f"unknown camera '{name}'{nearest(name, CAMERAS)}")
        self._vec = vec
        self._name = name
        self._aspect = aspect
        self._fov = np.deg2rad(model.vis.global_.fovy)
        self.view = mujoco.MjvCamera()
        self.view.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.view.azimuth, self.view.elevation = _direction(model, name)
        self._heading = np.array([1.0, 0.0])
        self._last = np.zeros(3)
        self._frame(np.zeros((0, 3)))

    def start(self, env: int) -> None:
        """Point at a new episode."""
        yaw = self._vec.task.goal.yaw[env]
        self._last = self._vec.world.state.payload_position[env].copy()
        self._heading = np.array([np.cos(yaw), np.sin(yaw)])

    def aim(self, env: int, path: np.ndarray) -> None:
        """Point at the team of an environment; `path` (P, 3) is its target's, P = 0 for none."""
        target = self._vec.task.goal.position[env]
        payload = self._vec.world.state.payload_position[env]
        if self._name == "chase":
            self._turn(payload)
            self.view.lookat[:] = payload
        elif self._name == "top" and len(path):
            self._frame(path)
            self.view.lookat[:] = (path.min(axis=0) + path.max(axis=0)) / 2
        else:
            away = payload - target
            distance = float(np.linalg.norm(away))
            # The target, or as much nearer to the payload as that is farther away than `_ROOM`.
            self.view.lookat[:] = target + max(0.0, 1.0 - _ROOM / max(distance, _ROOM)) * away
        self.view.lookat[2] += self._lift

    def _turn(self, payload: np.ndarray) -> None:
        """Turn towards the direction of flight, by the distance covered since the last picture."""
        step = (payload - self._last)[:2]
        distance = float(np.hypot(*step))
        if distance > 0.0:
            self._heading += (1.0 - np.exp(-distance / _CHASE_TURN)) * (step / distance - self._heading)
        self._last = payload.copy()
        self.view.azimuth = np.rad2deg(np.arctan2(self._heading[1], self._heading[0]))

    def _frame(self, path: np.ndarray) -> None:
        """Set the distance, and how far above the target to point, so that the picture holds a team there.

        For the camera above, a team anywhere on `path` (P, 3).
        """
        system = self._vec.world.system
        tilt = np.deg2rad(self.view.elevation)
        drone = 2 * max(vehicle.arm for vehicle in system.vehicles)
        half_payload = system.payload_size / 2 + np.abs(system.payload_center)
        reach = max(np.hypot(*system.slots[:, :2].T).max() + drone, np.hypot(*half_payload[:2]))
        top = max(system.slots[:, 2].max() + drone, half_payload[2])
        bottom = -half_payload[2]
        self._lift = (top + bottom) / 2
        height = (top - bottom) / 2
        # shares of the height and of the floor in the direction of the picture's vertical
        across = abs(np.cos(tilt))
        along = abs(np.sin(tilt))
        vertical = height * across + reach * along
        depth = height * along + reach * across
        wide, high = np.ptp(path[:, :2], axis=0) / 2 if len(path) else (0.0, 0.0)
        view = max(vertical + high + _ROOM, (reach + wide + _ROOM) / self._aspect)
        self.view.distance = depth + view / np.tan(self._fov / 2)


def _direction(model: mujoco.MjModel, name: str) -> tuple[float, float]:
    """Return azimuth and elevation [deg] of a camera of the model, or of one that chases along x."""
    if name == "chase":
        return 0.0, _CHASE_ELEVATION
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    forward = -data.camera(name).xmat.reshape(3, 3)[:, 2]
    return float(np.rad2deg(np.arctan2(forward[1], forward[0]))), float(np.rad2deg(np.arcsin(forward[2])))
