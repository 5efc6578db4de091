"""How episodes start: their random streams, hidden parameters, starts, and what `reset(options=...)` fixes of these."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.envs.options import Rows, check_delays, check_draw, check_state, check_stretch, read_options
from multilift_marl.errors import ConfigError
from multilift_marl.rig.feasibility import check_fixed
from multilift_marl.sensing.measurement import Sensing
from multilift_marl.sim.parameters import Parameters, check_parameters, nominal_parameters
from multilift_marl.sim.randomization import Draw
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task

TURBULENCE, PARAMETERS, SENSORS, PUSHES = 1, 2, 3, 4  # streams of their own, so that none moves what the others draw
_MAX_REDRAWS = 1000


class Episodes:
    """The starts of the episodes of E environments.

    Args:
        config: of the environments.
        world, task, sensing: theirs.

    Attributes:
        drawn: hidden parameters of the episodes in progress, by name, environment first; read-only.
    """

    def __init__(self, config: Config, world: World, task: Task, sensing: Sensing):
        self._world, self._task, self._sensing, ranges = world, task, sensing, config.randomization
        self._draw = Draw(world, ranges, self._sensing.drawn())
        self._nominal = {name: array[0] for name, array in nominal_parameters(world.system, 1)._asdict().items()}
        self._longest = {"action_delay": ranges.action_delay[1], "observation_delay": ranges.observation_delay[1]}
        self._update_drawn()

    def read(self, options: Mapping[str, Any] | None, mask: np.ndarray) -> dict[str, Rows]:
        """Return what `options` fix, with a row for each environment in `mask`; see `read_options`."""
        if not options:
            return {"randomization": {}, "state": {}}
        fixed = read_options(options, mask, self._draw.values, self._world.state)
        check_delays(fixed["randomization"], self._longest)
        for name, rows in fixed["randomization"].items():
            if name in Parameters._fields:
                value = self._draw.values[name].copy()
                value[mask] = rows
                check_parameters(self._world.system, self._draw.parameters, mask, {name: value})
        check_fixed(self._world.system, self._draw.ranges, fixed["randomization"])
        check_draw(fixed["randomization"], self._nominal, self._world.system)
        check_state(fixed["state"], self._world.system)
        return fixed

    def draw(self, e: int, seed: int, key: tuple[int, int, int], fixed: dict[str, Rows], row: int) -> None:
        """Draw hidden parameters and a sound start of one environment, less what a row of `fixed` says.

        Args:
            e: the environment.
            seed, key: purpose, number of the environment and of the episode; all that the draw depends on.
            fixed: see `read`.
            row: of this environment.

        Raises:
            ConfigError: no start is sound.
            ValueError: the state that is given is not.
        """
        if self._world.system.air.turbulence:
            self._world.seed_turbulence(e, np.random.SeedSequence(seed, spawn_key=(*key, TURBULENCE)))
        if self._world.pushes is not None:
            self._world.seed_pushes(e, np.random.SeedSequence(seed, spawn_key=(*key, PUSHES)))
        if self._sensing.enabled:
            self._sensing.start(e, np.random.SeedSequence(seed, spawn_key=(*key, SENSORS)))
        # By name: NumPy may change what `default_rng` gives.
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
        self._draw.draw(e, rng, seed, (*key, PARAMETERS))
        for name, rows in fixed["randomization"].items():
            self._draw.fix(e, name, rows[row])
        self._world.state.cable_broken[e] = False
        self._place(e, rng)
        if fixed["state"]:
            self._give(e, {name: rows[row] for name, rows in fixed["state"].items()})

    def _place(self, e: int, rng: np.random.Generator) -> None:
        for _ in range(_MAX_REDRAWS):
            if self._task.draw_start(e, rng, self._draw.parameters):
                return
        cure = "move scene.obstacles, " if self._cause(e) == "obstacle_collision" else ""
        raise ConfigError(
            f"no start of task {self._task.name} is free of failure ({self._cause(e)}) in {_MAX_REDRAWS} "
            f"draws; {cure}narrow the start ranges in task_options or change the rig"
        )

    def _give(self, e: int, given: Rows) -> None:
        """Replace what is given of the state of one environment, which must be sound."""
        for name, value in given.items():
            getattr(self._world.state, name)[e] = value
        parameters = self._draw.parameters
        check_stretch(self._world, e, parameters.cable_length[e], parameters.cable_stiffness[e])
        if not self._task.begin(e):
            cause = self._cause(e)
            raise ValueError(f"the given state of environment {e} is a failure from the start ({cause}); change it")

    def _cause(self, e: int) -> str:
        """Return why the start of an environment is a failure."""
        number, names = int(self._task.cause[e]), self._task.causes()
        return names[number] if 0 <= number < len(names) else f"cause {number}, which is none"

    def load(self, mask: np.ndarray) -> None:
        """Make draw and start of the environments in `mask` the world's own."""
        world = self._world
        world.set_parameters(mask, **self._draw.changed())
        broken = world.state.cable_broken & mask[:, None]
        world.load(mask)
        if broken.any():
            world.break_cables(broken)
        self._update_drawn()

    def load_state_dict(self, saved: Rows) -> None:
        """Restore sensing from copies of its arrays, and the draw from what the world has restored."""
        for name, array in self._sensing.arrays().items():
            array[:] = saved[name]
        self._draw.restore(self._world.parameters)
        self._update_drawn()

    def _update_drawn(self) -> None:
        self.drawn = {name: array.copy() for name, array in self._draw.values.items()}
        for array in self.drawn.values():
            array.flags.writeable = False
