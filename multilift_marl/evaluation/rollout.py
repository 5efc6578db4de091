"""Simulate whole episodes with a policy and measure them: the raw numbers of every report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.evaluation.metrics import derived_names, join_episodes
from multilift_marl.evaluation.outline import obstacle_corners, payload_surface
from multilift_marl.evaluation.shortfalls import ShortfallMeter, is_shortfall
from multilift_marl.mdp.failures import MAX_DISTANCE
from multilift_marl.policies.policy import Policy
from multilift_marl.sim.parameters import Parameters

SETTLED = 0.05  # [m] settling time counts until the payload stays within this
PRECISE = (0.01, 1.0)  # [m], [deg] mean errors of an episode that counts as precise
_BATCH = 256


class Trace(NamedTuple):
    """One episode over time, T steps."""

    time: np.ndarray
    """(T,) [s]."""
    payload_position: np.ndarray
    """(T, 3) [m]."""
    target_position: np.ndarray
    """(T, 3) [m]."""
    drone_position: np.ndarray
    """(T, N, 3) [m]."""
    distance: np.ndarray
    """(T,) payload from its target [m]."""
    angle: np.ndarray
    """(T,) payload from its target attitude [deg]."""
    tension: np.ndarray
    """(T, N) [N]."""
    cables: tuple[np.ndarray, ...] = ()
    """Of each cable its points from anchor to hook at the end (P, 3), of a broken one without the hook [m]."""
    surface: np.ndarray = np.zeros((0, 3, 3))
    """(F, 3, 3) triangles of the payload's surface at the end, world frame [m]."""
    obstacles: tuple[np.ndarray, ...] = ()
    """Corners (V, 3) of each at the end, see `obstacle_corners` [m]."""


def run_episodes(
    config: Config, make_policy: Callable[[MultiliftVec], Policy], episodes: int, seed: int,
    purpose: int = EVALUATION, progress: Callable[[int], Any] | None = None, first: int = 0,
    factors: Mapping[str, Any] | None = None,
    record: Callable[[int], Callable[[MultiliftVec], None]] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Fly episodes `first` to `first` + `episodes` - 1 of an evaluation seed, the same at any batch size.

    Args:
        config: the environment.
        make_policy: returns the policy for given environments.
        episodes: how many; episode i is environment i's first.
        seed: evaluation seed.
        purpose: of the seeds.
        progress: called with the number of episodes finished.
        first: number of the first episode.
        factors: hidden parameters that are the same in all episodes, by their names in `Parameters` (all but the centre
            of mass), as factors of the nominal values: one for all drones or (N,).
        record: called with the number of each batch's first episode, counted from `first`; what it returns is called
            with the environments at the start and after every step.

    Returns:
        Metrics of each episode by name, (episodes,) each, units in their names; see docs/evaluation.md. Errors of a
        failed episode stand at the failure bound. "failure_cause" holds indices into `Task.causes()`. Entries that are
        `shortfalls.is_shortfall` are for `shortfalls.explain`.

    Raises:
        ConfigError: see `MultiliftVec`; or there is no factor of a name.
        ValueError: the policy's actions do not fit the environment.
    """
    parts = []
    for done in range(0, episodes, _BATCH):
        count = min(_BATCH, episodes - done)
        part = build_config(config.model_dump(), {"env.num_envs": count})
        # Numbered through all batches: episode i is the first of environment i, however many are simulated at once.
        vec = MultiliftVec(part, purpose, first_env=first + done)
        observation, _ = vec.reset(seed=seed, options=_fix_parameters(vec, factors) if factors else None)
        policy, on_step = make_policy(vec), None if record is None else record(done)
        if on_step is not None:
            on_step(vec)
        parts.append(measure_episodes(vec, policy, observation, on_step))
        if progress is not None:
            progress(done + count)
    return join_episodes(parts)


def _fix_parameters(vec: MultiliftVec, factors: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of a reset that fix hidden parameters."""
    fixed, known = {}, [name for name in Parameters._fields if name != "payload_center_of_mass"]
    for name, factor in factors.items():
        if name not in known:
            raise ConfigError(f"factors has no '{name}'{nearest(name, known)}")
        # Before a reset the parameters of all environments are the nominal ones; those that are factors are 1.
        whole = getattr(vec.world.parameters, name)
        fixed[name] = np.broadcast_to(np.asarray(factor) * whole[:1], whole.shape)
    return {"randomization": fixed}


def measure_episodes(
    vec: MultiliftVec, policy: Policy, observation: np.ndarray, on_step: Callable[[MultiliftVec], None] | None = None
) -> dict[str, np.ndarray]:
    """Fly the episodes that have begun to their ends, and return what `run_episodes` does of them.

    Args:
        vec: environments after a reset.
        policy: of these environments.
        observation: that the reset returned.
        on_step: called with the environments after every step.

    Raises:
        ConfigError: see `own_metrics`; or its names change.
        ValueError: the policy's actions do not fit the environment.
    """
    e, dt = vec.num_envs, vec.task.dt
    policy.reset()
    running = np.ones(e, bool)
    total, length, settling, counted, change = np.zeros((5, e))
    square = np.zeros((6, e))
    final_distance, final_angle, final_tilt, final_steps = np.zeros((4, e))
    result = {name: np.zeros(e) for name in _AT_END}
    result |= {"success_rate": np.zeros(e, bool), "failure_cause": np.zeros(e, int)}
    previous = np.zeros((e, vec.num_drones, vec.action_size))
    meter = ShortfallMeter(vec)
    own = own_metrics(vec, policy)
    result |= {name: np.zeros(e) for name in own}
    for step in range(vec.max_steps):
        action = policy.act(observation)
        observation, reward, terminated, truncated, info = vec.step(action)
        if on_step is not None:
            on_step(vec)
        meter.measure(step + 1)
        errors = vec.task.errors
        total += running * reward.mean(axis=1, dtype=np.float64)
        length += running
        change += running * ((np.clip(action, -1, 1) - previous) ** 2).mean(axis=(1, 2))
        if (step + 1) * dt > vec.task.rmse_after:
            square += running * _along_axes(vec) ** 2
            counted += running
        # The last time at which it was farther away.
        settling = np.where(running & (errors.distance > SETTLED), (step + 1) * dt, settling)
        if vec.task.in_error_window((step + 1) * dt, vec.max_steps * dt):
            final_distance += running * errors.distance
            final_angle += running * np.rad2deg(errors.angle)
            final_tilt += running * _tilt(vec)
            final_steps += running
        previous = np.clip(action, -1, 1)
        ended = running & (terminated | truncated)
        if ended.any():
            result["success_rate"][ended] = info["success"][ended]
            result["failure_cause"][ended] = info["failure_cause"][ended]
            now = own_metrics(vec, policy)
            for name in now.keys() ^ own.keys():
                raise ConfigError(
                    f"metrics() must report the same names at all times, NaN where there is no number, but not '{name}'"
                )
            for name, source in (_at_end(vec) | now).items():
                result[name][ended] = source[ended]
            running &= ~ended
        if not running.any():
            break
        if (over := terminated | truncated).any():  # their later episodes do not count
            observation, _ = vec.reset(mask=over)
            policy.reset(over)
            previous[over] = 0.0
    failed = result["failure_cause"] > 0
    # Episodes that fail before the window have no steps in it, and their means are not used below.
    steps = np.maximum(final_steps, 1)
    limit = vec.max_steps * dt
    rms = np.sqrt(square / np.maximum(counted, 1))
    # One drone has no distance from others.
    if vec.num_drones == 1:
        del result["min_separation_m"]
    distance = final_distance / steps
    angle = final_angle / steps
    return result | {
        **meter.result(np.logical_not(failed | result["success_rate"].astype(bool))),
        "precise_rate": ~failed & (distance <= PRECISE[0]) & (angle <= PRECISE[1]),
        # Failed episodes stand at the bound: means over the little that they flew would flatter them.
        "payload_position_error_m": np.where(failed, MAX_DISTANCE, distance),
        "payload_attitude_error_deg": np.where(failed, 180.0, angle),
        "payload_tilt_deg": np.where(failed, 180.0, final_tilt / steps),
        "payload_rmse_m": np.where(failed, MAX_DISTANCE, np.sqrt((rms[:3] ** 2).sum(axis=0))),
        **{name: np.where(failed, bound, part) for (name, bound), part in zip(_AXES.items(), rms, strict=True)},
        "settling_time_s": np.where(failed, limit, settling),
        "return": total,
        "action_rate": np.sqrt(change / np.maximum(length, 1)),
    }


def own_metrics(vec: MultiliftVec, policy: Policy) -> dict[str, np.ndarray]:
    """Return what task, planner of actions and policy report of the episodes so far, numbers (E,) by name.

    Raises:
        ConfigError: a name that evaluation has itself, or two of them.
    """
    found: dict[str, np.ndarray] = {}
    known = {*MEASURED, *derived_names(vec.failure_causes)}
    for who, what in (
        (f"task {vec.task.name}", vec.task),
        (f"control.action={vec.config.control.action}", vec.commander),
        ("the policy", policy),
    ):
        reported: dict[str, np.ndarray] = getattr(what, "metrics", dict)()
        for name in reported:
            if name in known or name in found or is_shortfall(name):
                raise ConfigError(
                    f"metrics() of {who} reports '{name}', which evaluation has itself; give it another name"
                )
        found |= reported
    return found


def _tilt(vec: MultiliftVec) -> np.ndarray:
    """Return the angle between the payload's vertical axis and that of the world (E,) [deg]."""
    return np.rad2deg(np.arccos(np.clip(vec.world.state.payload_rotation[:, 2, 2], -1, 1)))


_AXES = {  # metric: what a failed episode counts
    "payload_rmse_x_m": MAX_DISTANCE,
    "payload_rmse_y_m": MAX_DISTANCE,
    "payload_rmse_z_m": MAX_DISTANCE,
    "payload_rmse_roll_deg": 180.0,
    "payload_rmse_pitch_deg": 180.0,
    "payload_rmse_yaw_deg": 180.0,
}


def _along_axes(vec: MultiliftVec) -> np.ndarray:
    """Return position error [m] and rotation vector [deg] along the axes of the target's heading frame, (6, E).

    The last, the yaw error, is the turn about the vertical; where payload and target tilt little it is the difference
    of their ψ = atan2(-R01, R11).
    """
    errors, yaw = vec.task.errors, vec.task.goal.yaw
    # Turned by -ψ about the vertical, which leaves z and the turn about it as they are.
    c, s = np.cos(yaw), np.sin(yaw)
    (x, y, z), (roll, pitch, turn) = errors.position.T, np.rad2deg(errors.rotation.T)
    return np.stack([c * x + s * y, c * y - s * x, z, c * roll + s * pitch, c * pitch - s * roll, turn])


_AT_END = ("cable_tension_min_n", "cable_tension_max_n", "slack_time_s", "min_separation_m", "energy_j")


MEASURED = (
    "success_rate", "failure_cause", "precise_rate", "payload_position_error_m", "payload_attitude_error_deg",
    "payload_tilt_deg", "payload_rmse_m", "settling_time_s", "return", "action_rate", *_AXES, *_AT_END,
)  # fmt: skip
"""What is measured of all episodes, beside shortfalls; of one drone no separation."""


def _at_end(vec: MultiliftVec) -> dict[str, np.ndarray]:
    """Return what has accumulated over the episodes, (E,) each, in the order of `_AT_END`."""
    stats = vec.world.stats
    values = (stats.tension_min, stats.tension_peak, stats.slack_time, vec.task.min_separation, stats.energy)
    return dict(zip(_AT_END, values, strict=True))


def trace_episode(
    config: Config, make_policy: Callable[[MultiliftVec], Policy], episode: int, seed: int,
    on_step: Callable[[MultiliftVec], None] | None = None,
) -> Trace:  # fmt: skip
    """Fly one evaluation episode and return its trace.

    Args:
        config: the environment.
        make_policy: returns the policy for given environments.
        episode: which one of `run_episodes`.
        seed: evaluation seed.
        on_step: called with the environment at the start and after every step.

    Raises:
        ConfigError, ValueError: see `run_episodes`.
    """
    vec = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}), EVALUATION, first_env=episode)
    policy = make_policy(vec)
    observation, _ = vec.reset(seed=seed)
    policy.reset()
    tracer = Tracer()
    if on_step is not None:
        on_step(vec)
    for _ in range(vec.max_steps):
        observation, _, terminated, truncated, _ = vec.step(policy.act(observation))
        tracer(vec)
        if on_step is not None:
            on_step(vec)
        if terminated[0] or truncated[0]:
            break
    return tracer.trace()


class Tracer:
    """Records the first environment of what it is called with after every step."""

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []
        self._end: tuple[tuple[np.ndarray, ...], np.ndarray, tuple[np.ndarray, ...]] = (), np.zeros((0, 3, 3)), ()
        self._surface: np.ndarray | None = None  # in the payload's frame

    def __call__(self, vec: MultiliftVec) -> None:
        """Record the step that has just been made."""
        state, task = vec.world.state, vec.task
        if self._surface is None:
            self._surface = payload_surface(vec.world.system)
        surface = self._surface @ state.payload_rotation[0].T + state.payload_position[0]
        obstacles = obstacle_corners(task.scenery(0), vec.world.obstacles.vertices)
        self._end = tuple(vec.world.cable_points(0, n) for n in range(vec.num_drones)), surface, obstacles
        self._rows.append(
            (
                (len(self._rows) + 1) * task.dt, state.payload_position[0].copy(), task.goal.position[0].copy(),
                state.drone_position[0].copy(), task.errors.distance[0], np.rad2deg(task.errors.angle[0]),
                state.cable_tension[0].copy(),
            )
        )  # fmt: skip

    def trace(self) -> Trace:
        """Return what was recorded, at least one step."""
        columns = (np.array(column) for column in zip(*self._rows, strict=True))
        fields = dict(zip(Trace._fields, columns, strict=False))
        return Trace(**fields, cables=self._end[0], surface=self._end[1], obstacles=self._end[2])
