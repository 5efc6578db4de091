"""Crazyflies of crazyflow towards position set-points by its Mellinger controller: drones=<n> seconds=<s>.

Worlds of four drones, or drones / 4 of them, with its default dynamics (first principles) and integrator. A world is
reset where a drone touches the ground.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.sim import Sim
from flight import arguments, grid, measure

TEAM = 4
POLICY_HZ = 50


def main() -> None:
    drones, seconds, _ = arguments()  # XLA has its own threads
    worlds = drones // TEAM
    sim = Sim(n_worlds=worlds, n_drones=TEAM, control=Control.state, device="cpu")
    home = np.broadcast_to(np.array(grid(TEAM), np.float32), (worlds, TEAM, 3))
    start = sim.data.replace(states=sim.data.states.replace(pos=jnp.array(home)))
    sim.data = start
    sim.build_default_data()
    sim.default_data = start
    sim.reset()
    command = np.zeros((worlds, TEAM, 16), np.float32)
    command[..., 12] = 1.0  # w of the attitude's quaternion
    substeps = sim.freq // POLICY_HZ

    def step(leap: float) -> tuple[float, int]:
        command[..., :3] = home
        command[..., 0] += leap
        sim.state_control(command)
        sim.step(substeps)
        position = np.asarray(sim.data.states.pos)
        distance = float(np.linalg.norm(position - command[..., :3], axis=-1).mean())
        crashed = (position[..., 2] < 0).any(axis=1)
        if crashed.any():
            sim.reset(jnp.array(crashed))
        return distance, int(crashed.sum())

    sim.reset(jnp.zeros(worlds, bool))  # compiles it
    before = float(sim.time.max())
    step(0.0)
    period = substeps / sim.freq
    assert abs(float(sim.time.max()) - before - period) < 1e-6
    facts = {
        "worlds": worlds,
        "physics_hz": sim.freq,
        "control_hz": sim.control_freq,
        "attitude_hz": sim.data.controls.attitude.freq,
        "device": jax.devices()[0].platform,
        "dynamics": f"{sim.dynamics}, {sim.integrator}",
    }
    measure(step, period, drones, seconds, ("crazyflow", "jax"), **facts)


if __name__ == "__main__":
    main()
