"""What an episode draws anew: always from the nominal values, never from the last episode's."""

from __future__ import annotations

import numpy as np

from multilift_marl.schema.sections import RandomizationConfig
from multilift_marl.sim.parameters import CONFIGURED, Parameters, nominal_parameters
from multilift_marl.sim.world import World

_OWN_STREAM = frozenset((*Parameters._fields[1:], "wind", "action_delay", "observation_delay"))


class Draw:
    """The hidden parameters of each environment's episode.

    Args:
        world: `hidden_loads.payload_force` and `hidden_loads.wind` are written.
        ranges: widths of the distributions.
        sensing: live arrays of delays (E,) [policy steps] and biases, by name, where there are any.

    Attributes:
        parameters: drawn, for `World.set_parameters`.
        values: all that is drawn or may be fixed, by name, environment first; live arrays.
        changing: names of parameters that are not what they are configured to be in every episode.
    """

    def __init__(self, world: World, ranges: RandomizationConfig, sensing: dict[str, np.ndarray]):
        self.system = world.system
        self.ranges = ranges
        self._nominal = nominal_parameters(world.system, 1)
        self.parameters = nominal_parameters(world.system, world.num_envs)
        self.values = self.parameters._asdict() | {
            "payload_force": world.hidden_loads.payload_force,
            "wind": world.hidden_loads.wind,
        }
        self.values |= sensing
        point = world.system.payload_shape == "point"
        for name in (*CONFIGURED, *(("payload_inertia",) if point else ())):
            if name not in world.system.varied:
                del self.values[name]
        self.changing = {"payload_mass", *world.system.varied.intersection(Parameters._fields)}
        self._more = bool(_OWN_STREAM & world.system.varied)

    def draw(self, env: int, rng: np.random.Generator, seed: int, key: tuple[int, ...]) -> None:
        """Draw everything for one environment.

        Args:
            env: the environment.
            rng: generator of this episode, for the payload's mass and force.
            seed, key: of a stream for what else there is, so that the episode stays what it is without.
        """
        # From the nominal values, or factors would multiply up from episode to episode.
        for name in self.changing:
            getattr(self.parameters, name)[env] = getattr(self._nominal, name)[0]
        # In this order for good, and drawn whether or not they are used: the episodes of all seeds depend on it.
        factor = rng.uniform(-1.0, 1.0)
        magnitude = rng.uniform()
        direction = rng.uniform(-np.pi, np.pi)
        self.parameters.payload_mass[env] = self.system.payload_mass * (1.0 + self.ranges.payload_mass * factor)
        force = self.ranges.payload_force * magnitude
        self.values["payload_force"][env] = force * np.cos(direction), force * np.sin(direction), 0.0
        self.values["wind"][env] = self.system.wind
        if self._more:
            self._draw_more(env, np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key))))

    def fix(self, env: int, name: str, value: np.ndarray) -> None:
        """Replace what was drawn for one environment by `value`, a row of `values[name]`."""
        self.values[name][env] = value
        if name in Parameters._fields:
            self.changing.add(name)

    def restore(self, parameters: Parameters) -> None:
        """Take over the parameters of a world, drawn and fixed before."""
        for name, nominal in self._nominal._asdict().items():
            array = getattr(self.parameters, name)
            array[:] = getattr(parameters, name)
            if (array != nominal).any():
                self.changing.add(name)

    def changed(self) -> dict[str, np.ndarray]:
        """Return those parameters that change, for `World.set_parameters`."""
        return {name: getattr(self.parameters, name) for name in self.changing}

    def _draw_more(self, env: int, rng: np.random.Generator) -> None:
        """Draw what has a stream of its own; all of it, so that no part depends on which others are switched on.

        What is new is drawn last: elsewhere it would change the episodes of all seeds.
        """
        *first, last = Parameters._fields[1:]
        for name in first:
            self._draw_parameter(name, env, rng)
        speed = self.ranges.wind * rng.uniform()
        direction = rng.uniform(-np.pi, np.pi)
        self.values["wind"][env] += speed * np.cos(direction), speed * np.sin(direction), 0.0
        for name in ("action_delay", "observation_delay"):
            low, high = getattr(self.ranges, name)
            # Drawn even where there is no such delay: what comes after it stays the same.
            delay = rng.integers(low, high + 1)
            if name in self.values:
                self.values[name][env] = delay
        self._draw_parameter(last, env, rng)

    def _draw_parameter(self, name: str, env: int, rng: np.random.Generator) -> None:
        """Draw one of the parameters that scale, or are moved, by a uniform share."""
        array = getattr(self.parameters, name)
        change = np.asarray(getattr(self.ranges, name)) * rng.uniform(-1.0, 1.0, array.shape[1:])
        array[env] = change if name == "payload_center_of_mass" else array[env] * (1.0 + change)
