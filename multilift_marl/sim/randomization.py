"""What an episode draws anew: always from the nominal values, never from the last episode's."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.schema import RandomizationConfig
from multilift_marl.sim.world import World


def randomize(world: World, env: int, rng: np.random.Generator, ranges: RandomizationConfig, mass: np.ndarray) -> None:
    """Draw the hidden parameters of one environment.

    Args:
        world: `plant.payload_force` is written.
        env: the environment.
        rng: generator of this episode.
        ranges: widths of the distributions.
        mass: (E,) written with the drawn payload mass [kg], for `World.set_payload_mass`.
    """
    factor, magnitude, direction = rng.uniform(-1.0, 1.0), rng.uniform(), rng.uniform(-np.pi, np.pi)
    mass[env] = world.system.payload_mass * (1.0 + ranges.payload_mass * factor)
    force = ranges.payload_force * magnitude
    world.plant.payload_force[env] = force * np.cos(direction), force * np.sin(direction), 0.0
