"""The interface `full_state`: all that a planner knows of a drone's motion, for the geometric controller to follow.

Position, velocity, acceleration, jerk and the force on the cable are given beside those of the drone's slot in the
formation, which may move. Between actions the set-point moves on by its own velocity, acceleration and jerk. Unlike
that of `reference` it is not smoothed: what leaps is followed at once.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from multilift_marl.control.action_interface import (
    ActionComponent,
    Call,
    ControlContext,
    Interface,
    vector_components,
)
from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import add, norm, put, row, scale, turn, vec
from multilift_marl.schema.control import ControlConfig


class FullStateAction(Interface):
    """Position, velocity, acceleration and jerk beside the slot's, force on the cable beside the nominal one, and yaw.

    Body rates follow from jerk (Mellinger and Kumar, ICRA 2011), thrust from acceleration and the force on the cable.
    """

    numbers = (
        *vector_components("m", "max_offset", "position beside the own slot"),
        *vector_components("m/s", "max_velocity", "velocity beside the slot's", "velocity_"),
        *vector_components("m/s²", "max_acceleration", "acceleration beside the slot's", "acceleration_"),
        *vector_components("m/s³", "max_jerk", "jerk beside the slot's", "jerk_"),
        *vector_components(
            "-", "max_cable_force", "force on the own cable beside the nominal one, over that one's size", "force_"
        ),
        ActionComponent("yaw", "target", "rad", "max_yaw", "own heading relative to the one at rest"),
    )
    commands_force: ClassVar[bool] = True
    supports = ("integral", "indi")

    def __init__(self, settings: ControlConfig, dt: float):
        super().__init__(settings, dt)
        self._scales = np.array([getattr(settings, number.limit) for number in self.numbers])

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        return bind(command_full_state, lo, hi, action, team.setpoint.full_state, self._scales)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        return bind(follow_full_state, lo, hi, team, self.dt), *super().control_step(lo, hi, team)


@kernel
def command_full_state(lo, hi, action, full_state, scales):
    """Write the numbers of actions in their units."""
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            for k in range(action.shape[2]):
                full_state[e, n, k] = scales[k] * action[e, n, k]


@kernel
def follow_full_state(lo, hi, team, dt):
    """Write references and cable forces of the present set-points, and move these on by a control step `dt` [s]."""
    goal, reference, setpoint = team.goal, team.reference, team.setpoint
    for e in range(lo, hi):
        velocity, acceleration, jerk = row(goal.velocity, e), row(goal.acceleration, e), row(goal.jerk, e)
        for n in range(reference.yaw.shape[1]):
            x, c, s = setpoint.full_state[e, n], goal.slot_frame[e, n, 0], goal.slot_frame[e, n, 1]

            # the slot's own motion, and what is asked for beside it, from the slot frame
            put(reference.position[e, n], add(vec(goal.slots, e, n), turn(c, s, (x[0], x[1], x[2]))))
            slot_velocity = add(velocity, vec(goal.slot_velocity, e, n))
            put(reference.velocity[e, n], add(slot_velocity, turn(c, s, (x[3], x[4], x[5]))))
            slot_acceleration = add(acceleration, vec(goal.slot_acceleration, e, n))
            put(reference.acceleration[e, n], add(slot_acceleration, turn(c, s, (x[6], x[7], x[8]))))
            slot_jerk = add(jerk, vec(goal.slot_jerk, e, n))
            put(reference.jerk[e, n], add(slot_jerk, turn(c, s, (x[9], x[10], x[11]))))
            nominal = vec(goal.cable_force, e, n)
            force = scale(norm(nominal), turn(c, s, (x[12], x[13], x[14])))
            put(setpoint.cable_force[e, n], add(nominal, force))
            reference.yaw[e, n] = goal.drone_yaw[e] + team.gains.heading[n] + x[15]
            reference.yaw_rate[e, n] = goal.drone_yaw_rate[e]

            # Taylor's formula until the next control step
            for i in range(3):
                x[i] += dt * (x[3 + i] + dt * (x[6 + i] / 2.0 + dt * x[9 + i] / 6.0))
                x[3 + i] += dt * (x[6 + i] + dt * x[9 + i] / 2.0)
                x[6 + i] += dt * x[9 + i]
