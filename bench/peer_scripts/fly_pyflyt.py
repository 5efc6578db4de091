"""Quadrotors of PyFlyt towards position set-points, in one aviary, by its own controllers: drones=<n> seconds=<s>.

The aviary is reset, which loads all its bodies anew, when a drone collides.
"""

from __future__ import annotations

import numpy as np
from flight import arguments, grid, measure
from PyFlyt.core import Aviary

POSITION_MODE = 7  # x, y, yaw, z
POLICY_HZ = 40


def main() -> None:
    drones, seconds, _ = arguments()  # it has one thread
    home = np.array(grid(drones))
    aviary = Aviary(start_pos=home, start_orn=np.zeros((drones, 3)), drone_type="quadx", seed=1)
    aviary.set_mode(POSITION_MODE)
    ticks = round(1 / (POLICY_HZ * aviary.step_period))
    setpoints = np.zeros((drones, 4))

    def step(leap: float) -> tuple[float, int]:
        setpoints[:, 0] = home[:, 0] + leap
        setpoints[:, 1] = home[:, 1]
        setpoints[:, 3] = home[:, 2]
        aviary.set_all_setpoints(setpoints)
        crashed = False
        for _ in range(ticks):
            aviary.step()
            crashed |= bool(aviary.contact_array.any())
        position = np.array([aviary.state(i)[3] for i in range(drones)])
        distance = float(np.linalg.norm(position - setpoints[:, [0, 1, 3]], axis=1).mean())
        if crashed:
            aviary.reset()
            aviary.set_mode(POSITION_MODE)
        return distance, int(crashed)

    before = aviary.elapsed_time
    step(0.0)
    period = ticks * aviary.step_period
    assert abs(aviary.elapsed_time - before - period) < 1e-9
    facts = {"worlds": 1, "physics_hz": aviary.physics_hz, "control_hz": round(1 / aviary.step_period)}
    measure(step, period, drones, seconds, ("PyFlyt", "pybullet"), **facts)


if __name__ == "__main__":
    main()
