"""Hummingbirds of rotorpy towards position set-points by its SE(3) controller: drones=<n> seconds=<s> threads=<t>.

They are one batch, integrated by the method (RK4) and at the rate of rotorpy's own vectorised environment; four single
vehicles are no faster. A drone is put back to its start below the ground or 5 m off: the batch has no ground.
"""

from __future__ import annotations

import numpy as np
import torch
from flight import arguments, grid, measure
from rotorpy.controllers.quadrotor_control import BatchedSE3Control
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams

RATE = 100  # [Hz] `sim_rate` of its vectorised environment, one physics step each
LOST = 5.0  # [m]
HOVER_SPEED = 1788.53  # [rad/s] of the rotors, that of its own initial states


def start(home: np.ndarray) -> dict[str, np.ndarray]:
    """Return states at rest (drones, ...)."""
    n = len(home)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    rotors = np.full((n, 4), HOVER_SPEED)
    zero = np.zeros((n, 3))
    return {"x": home.copy(), "v": zero, "q": level, "w": zero.copy(), "wind": zero.copy(), "rotor_speeds": rotors}


def goal(target: np.ndarray) -> dict[str, np.ndarray]:
    """Return what the controllers are asked for: rest at positions (..., 3)."""
    zero = np.zeros_like(target)
    wanted = {key: zero for key in ("x_dot", "x_ddot", "x_dddot", "x_ddddot")}
    return wanted | {"x": target, "yaw": np.zeros(target.shape[:-1]), "yaw_dot": np.zeros(target.shape[:-1])}


def is_lost(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return which drones (drones,) are below the ground or far off."""
    return (position[:, 2] < 0) | (np.linalg.norm(position - target, axis=1) > LOST)


def batched(home: np.ndarray):
    """Return the step of drones that are simulated as one batch."""
    n = len(home)
    device = torch.device("cpu")
    fresh = {key: torch.from_numpy(value).double() for key, value in start(home).items()}
    params = BatchedMultirotorParams([quad_params] * n, n, device)
    vehicle = BatchedMultirotor(params, n, fresh, device, integrator="rk4")
    controller = BatchedSE3Control(params, n, device)
    everyone = np.arange(n)
    state = {key: value.clone() for key, value in fresh.items()}

    def step(leap: float) -> tuple[float, int]:
        nonlocal state
        target = home + [leap, 0, 0]
        wanted = {key: torch.from_numpy(value) for key, value in goal(target).items()}
        control = controller.update(0.0, state, wanted, everyone)
        state = vehicle.step(state, control, 1 / RATE, everyone)
        position = state["x"].numpy()
        lost = is_lost(position, target)
        distance = float(np.linalg.norm(position - target, axis=1).mean())
        if lost.any():
            for key, value in fresh.items():
                state[key][lost] = value[lost]
        return distance, int(lost.sum())

    return step


@torch.no_grad()
def main() -> None:
    drones, seconds, threads = arguments()
    torch.set_num_threads(threads)
    facts = {"worlds": drones, "physics_hz": RATE, "control_hz": RATE}
    measure(batched(np.array(grid(drones))), 1 / RATE, drones, seconds, ("rotorpy", "torch"), **facts)


if __name__ == "__main__":
    main()
