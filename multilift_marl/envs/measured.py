"""A team that flies elsewhere: an environment that observes what is measured of it, and simulates nothing."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.control.formation import Reference
from multilift_marl.envs.commander import COMMANDERS
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.sim.world import Shard, World

Measured = dict[str, np.ndarray]
"""Fields of `SystemState` by name, of one environment."""
APART = 0.2  # [m] of two plans of one target, in which a step or two pass
_PERFECT = {"env.sensing": "ideal", "env.communication": "none"} | {
    f"randomization.{name}": value
    for name, value in (
        ("observation_noise", 0.0), ("observation_bias", 0.0), ("observation_delay", 0), ("action_delay", 0)
    )
}  # fmt: skip


class _StillWorld(World):
    """A world in which nothing moves but what is put elsewhere."""

    def advance(self, shard: Shard, nstep: int) -> None:
        """Do nothing."""


class MeasuredTeam(MultiliftVec):
    """One environment whose state is measured; `command`, `advance` and `observe` in turn are a policy step.

    Observations, references and targets are those of the task in the simulation; noise and delays that it may simulate
    are left to what is measured. Rotor speeds follow from the thrusts that the geometric controller would command.

    Args:
        config: the task and its rig.

    Raises:
        ConfigError: see `MultiliftVec`; actions that are for a planner, see `envs/commander.py`.
    """

    world_type = _StillWorld

    def __init__(self, config: Config):
        if (action := config.control.action) in COMMANDERS:
            raise ConfigError(
                f"control.action={action} commands simulated teams alone, not one that is measured; take another "
                "control.action, such as full_state with policy=mpc"
            )
        super().__init__(
            build_config(config.model_dump(), _PERFECT | {"env.num_envs": 1, "env.num_threads": 1}), EVALUATION
        )
        self._ticks_left = 0
        vehicles, dt = self.world.system.vehicles, self.task.control_dt
        self._lift = np.array([vehicle.thrust_coefficient for vehicle in vehicles])[:, None]
        times = ([v.rotor_time_constant_up for v in vehicles], [v.rotor_time_constant_down for v in vehicles])
        self._closing = 1.0 - np.exp(-dt / np.array(times))[..., None]  # of the gap in a tick, (2, N, 1)

    def begin(
        self, measured: Measured, seed: int | None = None, target: tuple[np.ndarray, np.ndarray] | None = None,
        heard: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Begin an episode where the team is, and return its first observation; see `failure`.

        Args:
            measured: the state.
            seed: of the episode, whose target the task draws; None for the next one.
            target: position (3,) [m] and rotation (3, 3) of the payload in place of those drawn.
            heard: position (3,) [m] of a target that another, such as a simulation that may have gone on, plans by the
                same seed: where the next episode's is there, that one begins.
        """
        if heard is None or not self._goes_on(heard):
            self.reset(seed=seed)
        if target is not None:
            self.task.place_goal(0, *target)
        self._put(measured)
        self.task.begin(0)
        self.controller.start(0)
        self._observe(0)
        self._history.begin(0)
        return self._stacked.copy()

    def _goes_on(self, heard: np.ndarray) -> bool:
        """Draw the next episode, and return whether its target begins where one is heard."""
        self.reset()
        return bool(np.linalg.norm(heard - self.task.goal.position[0]) < APART)

    def command(self, action: np.ndarray) -> Reference:
        """Take actions (1, N, A) in [-1, 1]; return the references, whose commands are those of the actions.

        Raises:
            ValueError: see `MultiliftVec.step`.
        """
        self._set_action(action, self.ended)
        self.task.cause[0] = 0  # what fails here does not end what flies elsewhere
        for call in self._pipelines[0].before:
            call()
        self._ticks_left = self.control_ticks
        return self.reference

    def advance(self) -> Reference:
        """Move references and targets on by a control step; return the references."""
        if self._ticks_left:
            self._ticks_left -= 1
            for call in self._pipelines[0].tick:
                call()
            self._turn_rotors()
        return self.reference

    def _turn_rotors(self) -> None:
        """Let rotor speeds, which nobody measures, follow the controller's thrusts as those of the motors would."""
        speed, limits = self.world.state.rotor_speed[0], self.controller.gains
        within = np.clip(self.world.thrust[0], limits.thrust_min[:, None], limits.thrust_max[:, None])
        gap = np.sqrt(within / self._lift) - speed
        speed += np.where(gap > 0.0, *self._closing) * gap

    def observe(self, measured: Measured, steps: int = 1) -> np.ndarray:
        """Take what has been measured some policy steps after the last command; return the observation (1, N, D)."""
        self._ticks_left += (steps - 1) * self.control_ticks
        while self._ticks_left:
            self.advance()
        self._put(measured)
        for call in self._pipelines[0].after:
            call()
        self.steps += steps
        return self._stacked.copy()

    def _put(self, measured: Measured) -> None:
        """Take what has been measured for the state."""
        self._ticks_left = 0
        for name, value in measured.items():
            getattr(self.world.state, name)[0] = value

    @property
    def failure(self) -> str:
        """What has failed, in words; empty if nothing has."""
        cause = int(self.task.cause[0])
        return self.failure_causes[cause] if cause else ""
