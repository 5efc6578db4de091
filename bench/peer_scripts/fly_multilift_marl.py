"""Teams of multilift_marl in its task `hover`, flown by their scripted formation: drones=<n> seconds=<s> threads=<t>.

One environment of four drones, or drones / 4 of them. The error is the payload's: it is a payload that has a set-point
here, drawn anew with every episode. Episodes end after their time or with a failure, and are reset then.
"""

from __future__ import annotations

import numpy as np
from flight import arguments, measure

import multilift_marl as ml

TEAM = 4


def main() -> None:
    drones, seconds, threads = arguments()
    config = ml.load_config("hover", {"env.num_drones": TEAM, "env.num_threads": threads})
    vec = ml.make_vec(config, num_envs=drones // TEAM)
    vec.reset(seed=0)
    hold = np.zeros((vec.num_envs, TEAM, vec.action_size), np.float32)  # of the formation: no offset of any slot

    def step(leap: float) -> tuple[float, int]:
        _, _, terminated, truncated, _ = vec.step(hold)
        distance = float(vec.task.errors.distance.mean())
        over = terminated | truncated
        if over.any():
            vec.reset(mask=over)
        return distance, int(terminated.sum())

    system = vec.world.system
    control_dt = system.control_interval * system.timestep
    facts = {"worlds": vec.num_envs, "physics_hz": round(1 / system.timestep), "control_hz": round(1 / control_dt)}
    measure(step, vec.control_ticks * control_dt, drones, seconds, ("multilift_marl", "mujoco", "numba"), **facts)


if __name__ == "__main__":
    main()
