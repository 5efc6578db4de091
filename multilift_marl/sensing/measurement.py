"""Sensing: what stands between the true state and an observation, and delay of actions.

By `env.sensing` drones observe, and their controllers use, the truth (`ideal`) or estimates from simulated sensors
(docs/sensing.md). With `ideal`, `randomization` can add noise and bias to observations alone: each drone measures its
own state, and all observe one measurement of the payload's. Delays are whole policy steps. Success, reward and the
critic's global state are computed from the true state. docs/randomization.md says the same in a table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel, prebind
from multilift_marl.math3d import add, mat, matrow, put, putmat, row, scale, turn_by, vec
from multilift_marl.mdp.env_data import Errors, View, reduce_view, true_load, update_errors
from multilift_marl.mdp.observations import OBSERVATION_SIZE
from multilift_marl.rng import normal_vector
from multilift_marl.sensing.communication import check_links, make_links
from multilift_marl.sensing.estimator import StateEstimator
from multilift_marl.sensing.load_sensing import LoadSensing
from multilift_marl.sensing.obstacle_sensing import ObstacleSensing
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World

Call = Callable[[int, int], None]  # of environments lo to hi

STANDARD = np.array([0.005, 0.05, 0.01, 0.1])  # position [m], velocity [m/s], rotation [rad], angular velocity [rad/s]


EXACT = ("rotor_speed", "cable_tension", "cable_broken")  # of a state, which has no noise


class DelayBuffers(NamedTuple):
    """What sensors and links remember; environment first."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    bias: np.ndarray
    """(E, N + 1, 4, 3) of each drone's measurements, then of the payload's, as `STANDARD` lists them."""
    sent: np.ndarray
    """(E,) actions since the reset."""
    seen: np.ndarray
    """(E,) observations since the reset."""
    action_delay: np.ndarray
    """(E,) [policy steps]."""
    observation_delay: np.ndarray
    """(E,) [policy steps]."""
    actions: np.ndarray
    """(E, K, N, commands) the last ones, at their number modulo K."""
    observations: np.ndarray
    """(E, K, N, D) as the array before."""


class Sensing:
    """Sensors, noise, bias and delays of E teams.

    Args:
        config: `env.sensing` and `randomization` say which and how large.
        world: the teams.
        estimator: of the drones' own states, None where they know the truth.
        sizes: A, D.
        commands: numbers of what reaches a drone, A unless a planner makes it from the actions.

    Attributes:
        memory: DelayBuffers.
        state: what drones know of themselves (SystemState; its payload, where that is measured, is in `load`).
        load: what they know of the payload.
        obstacles: sensors of obstacles, or None.
        errors: the payload's errors as known, with their own integrals, (E, L, ...) as in `Load`; None: the true ones.
        measures, delays_observation, delays_action: whether what drones know is not the truth, whether there is a delay
            of observations, one of actions.
        enabled: whether there is any of these.
        applied: what reaches the drones (E, N, commands).
        action_size, observation_size: A, D.
    """

    def __init__(
        self, config: Config, world: World, estimator: StateEstimator | None, sizes: tuple[int, int],
        commands: int | None = None,
    ):  # fmt: skip
        ranges, level = config.randomization, config.env.sensing
        e, n, (a, d) = world.num_envs, world.num_drones, sizes
        sent_size = a if commands is None else commands
        self.action_size, self.observation_size = a, d
        self.noise = STANDARD * ranges.observation_noise
        self.bias = STANDARD * ranges.observation_bias
        (_, slowest), (_, latest) = ranges.action_delay, ranges.observation_delay
        has_noise = bool(self.noise.any() or self.bias.any())
        if has_noise and estimator is not None:
            raise ConfigError(
                f"env.sensing={level} has noise of its own; set randomization.observation_noise and observation_bias "
                "to none, or env.sensing=ideal"
            )
        if config.env.communication != "none":
            check_links(config.env)
        self.delays_observation, self.delays_action = latest > 0, slowest > 0
        acted, observed = (slowest + 1) * self.delays_action, (latest + 1) * self.delays_observation
        sent, seen, action_delay, observation_delay = (np.zeros(e, np.int64) for _ in range(4))
        self.memory = DelayBuffers(
            np.zeros(e, np.uint64), np.zeros((e, n + 1, 4, 3)), sent, seen, action_delay, observation_delay,
            np.zeros((e, acted, n, sent_size)), np.zeros((e, observed, n, d), np.float32),
        )  # fmt: skip
        self.applied = np.zeros((e, n, sent_size))
        self._true, self._estimator, self._attitude = world.state, estimator, config.system.payload_shape != "point"
        self._load_sensing: LoadSensing | None = None
        self.state = world.state
        if estimator is not None:
            dt, length = 1 / config.env.policy_hz, float(np.mean(world.system.cable_length))
            talks = config.env.communication != "none"
            links = make_links(config.env, world.system.slot_azimuth) if talks else None
            self._load_sensing = LoadSensing(level, world.state, estimator.state, dt, length, links)
            # None in place of the payload: a kernel that read the truth of it would not compile.
            unknown: Any = dict.fromkeys(name for name in SystemState._fields if name.startswith("payload_"))
            self.state = estimator.state._replace(**unknown)
        elif has_noise:
            exact = {name: getattr(world.state, name) for name in EXACT}
            self.state = SystemState.zeros(e, n)._replace(**exact)
        self.load = self._load_sensing.load if self._load_sensing else true_load(self.state)
        self.measures = has_noise or estimator is not None
        self.errors = Errors.zeros(e, self.load.position.shape[1]) if self.measures else None
        self.obstacles: ObstacleSensing | None = None
        if config.env.obstacle_sensing != "none":
            self.obstacles = ObstacleSensing(config, world, self.state if estimator is None else estimator.state)
        self.enabled = self.measures or self.delays_observation or self.delays_action or self.obstacles is not None

    def start(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode of one environment: draw its biases, forget what was sent and seen."""
        memory = self.memory
        memory.generator[env] = seed.generate_state(1, np.uint64)[0]
        draw_bias(env, memory, self.bias)
        memory.sent[env] = memory.seen[env] = 0
        memory.actions[env] = 0.0
        if self.obstacles is not None:
            # A third stream beside the two of `start_sensors`.
            self.obstacles.start(env, np.random.SeedSequence(int(memory.generator[env])).spawn(3)[2])
        if self.errors is not None:
            self.errors.position_integral[env] = self.errors.rotation_integral[env] = 0.0

    def start_sensors(self, env: int) -> None:
        """Let the sensors of an environment start from its team as it is; after `start`."""
        if self._estimator is not None and self._load_sensing is not None:
            # Streams of their own, so that a sensor more does not move the draws of others.
            own, load = np.random.SeedSequence(int(self.memory.generator[env])).spawn(2)
            self._estimator.start(env, own)
            self._load_sensing.start(env, load)

    def bind_first(self, view: View) -> Call:
        """Return the call of (lo, hi) that measures for the first time in an episode, after `start_sensors`."""
        measure = self.bind_sense(view, first=True) if self.measures else None

        def call(lo: int, hi: int) -> None:
            if measure is not None:
                measure(lo, hi)
            # By where the drones now know themselves to be.
            if self.obstacles is not None:
                self.obstacles.begin(lo, hi)

        return call

    def bind_sense(self, view: View, first: bool = False) -> Call:
        """Return the call of (lo, hi) that measures what drones know; `first` of an episode, not to be integrated."""
        if self._load_sensing is not None:
            measure = self._load_sensing.bind(view.planned, view.rig, view.resting_tension, first)
        else:
            measure = prebind(sense, view.state, self.state, self.memory, self.noise, self._attitude)
        # The first measurement of an episode is of no step: errors are found, not integrated.
        dt = 0.0 if first else view.dt
        update = prebind(update_seen_errors, reduce_view(view, update_seen_errors), dt)

        def call(lo: int, hi: int) -> None:
            measure(lo, hi)
            update(lo, hi)

        return call

    def bind_delay(self, observation: np.ndarray) -> Call:
        """Return the call of (lo, hi) that holds observations (E, N, D) back, but for the drones' own last action."""
        first = OBSERVATION_SIZE
        return prebind(delay_observations, observation, self.memory, first, first + self.action_size)

    def bind_send(self, action: np.ndarray) -> Call:
        """Return the call of (lo, hi) that holds actions (E, N, A) back; `applied` is what arrives."""
        return prebind(delay_actions, action, self.memory, self.applied)

    def drawn(self) -> dict[str, np.ndarray]:
        """Return the live arrays of what an episode draws of it, by the names of `randomization`."""
        memory = self.memory
        drawn = {"action_delay": memory.action_delay} if self.delays_action else {}
        drawn |= {"observation_delay": memory.observation_delay} if self.delays_observation else {}
        return drawn | ({"observation_bias": memory.bias} if self.bias.any() else {})

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays that outlive a step."""
        if not self.enabled:
            return {}
        arrays = self.memory._asdict()
        if self.obstacles is not None:
            arrays |= {f"obstacle_{name}": array for name, array in self.obstacles.readings._asdict().items()}
        if self.errors is not None:
            arrays |= {f"errors_{name}": array for name, array in self.errors._asdict().items()}
        if self._estimator is not None and self._load_sensing is not None:
            arrays |= self._estimator.arrays() | self._load_sensing.arrays()
        elif self.measures:
            noisy = set(SystemState._fields) - set(EXACT)
            arrays |= {f"measured_{name}": getattr(self.state, name) for name in sorted(noisy)}
        return arrays


@kernel
def draw_bias(e, memory, size):
    """Draw the biases of environment e, normal with standard deviations `size` (4,)."""
    for i in range(memory.bias.shape[1]):
        for kind in range(4):
            put(memory.bias[e, i, kind], scale(size[kind], normal_vector(e, memory)))


@kernel
def _off(e, i, kind, memory, noise):
    """Return how far a measurement is off: its bias and, drawn anew, its noise."""
    return add(vec(memory.bias[e], i, kind), scale(noise[kind], normal_vector(e, memory)))


@kernel
def sense(lo, hi, state, seen, memory, noise, attitude):
    """Measure the state of environments lo to hi.

    Args:
        lo, hi: the environments.
        state: true.
        seen: written, what is measured.
        memory: DelayBuffers; its generators advance.
        noise: standard deviations (4,), as `STANDARD` lists them.
        attitude: whether the payload has one.
    """
    count = state.drone_position.shape[1]
    for e in range(lo, hi):
        for n in range(count):
            put(seen.drone_position[e, n], add(vec(state.drone_position, e, n), _off(e, n, 0, memory, noise)))
            put(seen.drone_velocity[e, n], add(vec(state.drone_velocity, e, n), _off(e, n, 1, memory, noise)))
            turned = turn_by(_off(e, n, 2, memory, noise), mat(state.drone_rotation, e, n))
            putmat(seen.drone_rotation[e, n], turned)
            put(seen.drone_body_rates[e, n], add(vec(state.drone_body_rates, e, n), _off(e, n, 3, memory, noise)))
        put(seen.payload_position[e], add(row(state.payload_position, e), _off(e, count, 0, memory, noise)))
        put(seen.payload_velocity[e], add(row(state.payload_velocity, e), _off(e, count, 1, memory, noise)))
        putmat(seen.payload_rotation[e], matrow(state.payload_rotation, e))
        put(seen.payload_body_rates[e], row(state.payload_body_rates, e))
        if attitude:
            turned = turn_by(_off(e, count, 2, memory, noise), matrow(state.payload_rotation, e))
            putmat(seen.payload_rotation[e], turned)
            put(seen.payload_body_rates[e], add(row(state.payload_body_rates, e), _off(e, count, 3, memory, noise)))


@kernel
def update_seen_errors(lo, hi, v, dt):
    """Update the errors of environments lo to hi as the drones know them, integrated over `dt` [s]."""
    for e in range(lo, hi):
        for k in range(v.payload_estimate.position.shape[1]):
            update_errors(e, k, v.payload_estimate, v.estimated_errors, v, dt)


@kernel
def delay_observations(lo, hi, observation, memory, first, last):
    """Replace observations of environments lo to hi by those of `observation_delay` steps ago, at first by the first.

    Numbers first to last, the own last action, are a drone's own and stay.
    """
    held = memory.observations
    for e in range(lo, hi):
        now = memory.seen[e]
        # Held before it is read: without delay it is the present itself.
        then = now - min(memory.observation_delay[e], now)
        for n in range(observation.shape[1]):
            for k in range(observation.shape[2]):
                held[e, now % held.shape[1], n, k] = observation[e, n, k]
                if not first <= k < last:
                    observation[e, n, k] = held[e, then % held.shape[1], n, k]
        memory.seen[e] = now + 1


@kernel
def delay_actions(lo, hi, action, memory, applied):
    """Write the actions of `action_delay` steps ago to `applied`, zeros before the first."""
    held = memory.actions
    for e in range(lo, hi):
        now = memory.sent[e]
        then = now - memory.action_delay[e]
        for n in range(action.shape[1]):
            for k in range(action.shape[2]):
                held[e, now % held.shape[1], n, k] = action[e, n, k]
                applied[e, n, k] = held[e, then % held.shape[1], n, k] if then >= 0 else 0.0
        memory.sent[e] = now + 1
