"""From actions to rotor thrusts: the action interface, the references and the rejection of disturbances together."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import Call, ControlContext
from multilift_marl.control.actions import ACTIONS, AccRatesAction, PlannerWeightsAction
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, make_rejection, reset_estimate
from multilift_marl.control.formation import Goal, Reference, start_reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.obstacle_margin import Surroundings, check_margins
from multilift_marl.control.setpoints import Setpoint
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import bind
from multilift_marl.rig.linearised import warn_of_instability
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World


class Controller:
    """From the actions of E teams to their rotor thrusts.

    Args:
        config: `control` says how.
        world: whose thrusts are written.
        state: what the drones know of themselves; None: the world's, the truth.

    Attributes:
        world, state: as given.
        action_names: names of the numbers of an action.
        command_size: numbers of what the interface takes: A, unless a planner makes it from the actions.
        reference: what the drones follow; live arrays.
        gains: of the controller, for the nominal drones.
        disturbance: what `control.disturbance` remembers, None without.

    Raises:
        ConfigError: an interface and a rejection, or a margin, that do not go together.
    """

    def __init__(self, config: Config, world: World, state: SystemState | None = None):
        settings, dt = config.control, 1.0 / config.sim.control_hz
        e, n = world.num_envs, world.num_drones
        self.world, self.state = world, world.state if state is None else state
        self.interface = ACTIONS[settings.action](config.acting, dt)
        self.action_names = tuple(number.name for number in self.interface.numbers)
        self.command_size = len(self.action_names)
        if isinstance(self.interface, PlannerWeightsAction):
            self.command_size = len(AccRatesAction.numbers)
        check_margins(config)
        self.reference = Reference.zeros(e, n)
        self.disturbance: Disturbance | None = None
        self._setpoint = Setpoint.zeros(e, n)
        self.gains = make_gains(settings, world.system)
        warn_of_instability(world.system, np.sqrt(self.gains.k_p), config.randomization)
        self._kind = settings.disturbance
        if self._kind != "none":
            if self._kind not in self.interface.supports:
                able = [name for name, interface in ACTIONS.items() if self._kind in interface.supports]
                raise ConfigError(
                    f"control.disturbance={self._kind} has nothing to correct with control.action={settings.action}; "
                    f"use it with {' or '.join(able)}, or set control.disturbance=none"
                )
            self.disturbance = Disturbance.zeros(e, n)
            self._rejection = make_rejection(settings, world.system, self.gains, dt)

    def bind(
        self, lo: int, hi: int, action: np.ndarray, goal: Goal, plan: Call | None = None,
        around: Surroundings | None = None,
    ) -> tuple[Call, tuple[Call, ...]]:  # fmt: skip
        """Return what environments lo to hi call once for each policy step, and in turn at each control step.

        Args:
            lo, hi: the environments.
            action: (E, N, A), live array.
            goal: of the task.
            plan: moves the goals on by one control step; None if they stay.
            around: see `ControlContext`.
        """
        state, thrust, g = self.state, self.world.thrust, self.gains
        rejection = self.disturbance
        # The same arrays in every step: kernels are bound to them.
        nominal = self._setpoint.cable_force if self.interface.commands_force else goal.cable_force
        cable_force = nominal if rejection is None else rejection.cable_force
        team = ControlContext(state, goal, self.reference, self._setpoint, cable_force, thrust, g, around)
        set_action = self.interface.set_action(lo, hi, action, team)
        control_step = (
            self.interface.control_step(lo, hi, team)
            if plan is None
            else self.interface.control_step_moving_goal(lo, hi, plan, set_action, team)
        )
        if rejection is None:
            return set_action, control_step
        known = (state, self.reference, nominal)
        estimate = bind(REJECTIONS[self._kind], lo, hi, *known, rejection, self._rejection)
        return set_action, (*control_step[:-1], estimate, control_step[-1])

    @property
    def commanded_force(self) -> np.ndarray:
        """(E, N, 3) force on each cable, where the interface commands it, world frame [N]."""
        return self._setpoint.cable_force

    def start(self, e: int) -> None:
        """Let references and estimates of environment e start from the state of its drones."""
        start_reference(e, self.state, self.reference)
        if self.disturbance is not None:
            reset_estimate(e, self.state, self.disturbance)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that outlive a step."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def load_state_dict(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `state_dict` returned; other keys do not count."""
        for name, array in self._arrays().items():
            array[:] = saved[name]

    def _arrays(self) -> dict[str, np.ndarray]:
        arrays = {f"reference.{name}": array for name, array in self.reference._asdict().items()}
        if self.disturbance is not None:
            arrays |= {f"disturbance.{name}": array for name, array in self.disturbance._asdict().items()}
        return arrays
