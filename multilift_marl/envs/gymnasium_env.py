"""The Gymnasium APIs: a team as one agent, alone or E of them on the batched core."""

from __future__ import annotations

import re
from copy import copy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from multilift_marl.config.config import Config
from multilift_marl.config.load import list_configs, resolve_config
from multilift_marl.envs.core import MultiliftVec, make_vec
from multilift_marl.envs.options import check_mask
from multilift_marl.envs.wrapper_utils import (
    BATCH_RENDER_MODES,
    RENDER_MODES,
    FrameRenderer,
    check_open,
    limit_steps,
    mean_reward,
    possible_modes,
    row_spaces,
    seed_afresh,
    solo_info,
)
from multilift_marl.errors import nearest


class MultiliftGymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A team of N drones as one agent: observations (N·D,) float32, actions (N·A,) in [-1, 1], the drones' mean reward.

    Drone n has the n-th D numbers of an observation and the n-th A numbers of an action. Info holds `success`,
    `failure`, `diverged` (bool), `failure_cause`, an index into `vec.failure_causes` (0: none), `reward_terms`
    {name: float} and `randomization` {name: array}, the hidden draw. Copies, also by pickle, go on bit for bit.

    Where neither the configuration nor the first reset states a seed, that reset draws one (`vec.seeds`).

    The time limit is `env.episode_seconds`; `max_episode_steps` of `gymnasium.make` can only shorten it.

    Args:
        task: a configuration's name, the path of one, or a Config.
        render_mode: None, "rgb_array" for `render`, or "human" for a window that shows every step.
        num_drones: N; None for the configured value, as for the next.
        seed: of the first reset; None draws one, unless the configuration states it.
        **overrides: configuration values by dotted name, `**{"payload.mass": 2.0}`.

    Attributes:
        vec: the batched core underneath, of one environment.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
        ValueError: an unknown render mode.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 (as Gymnasium has it)
    _spec: EnvSpec | None = None

    def __init__(
        self, task: str | Config = "hover", render_mode: str | None = None, *,
        num_drones: int | None = None, seed: int | None = None, **overrides: Any,
    ):  # fmt: skip
        # Over what the user says: a configuration may be of a batch, but this API is of one environment.
        single = {"env.num_envs": 1, "env.num_threads": 1}
        self.vec = make_vec(task, num_drones=num_drones, seed=seed, **overrides | single)
        modes = possible_modes(render_mode)
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": self.vec.config.env.policy_hz}
        self.render_mode = render_mode
        self.observation_space, self.action_space = row_spaces(self.vec, self.vec.num_drones)
        self._pictures = FrameRenderer(self.vec, render_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: start at episode 0 of this seed; None goes to the next episode, at first of a seed of its own.
            options: see `MultiliftVec.reset`.

        Returns:
            Observation (N·D,) float32 and info.

        Raises:
            ValueError: a negative seed, an unknown option or one that cannot be.
        """
        # Before the first reset only; a `seed` that is given goes over it.
        seed_afresh(self.vec)
        observation, _ = self.vec.reset(seed, options=options)
        self._pictures.show()
        super().reset(seed=seed)  # for wrappers that draw from np_random; nothing here does
        return observation.reshape(-1), solo_info(self.vec)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance the episode by one policy step.

        Args:
            action: (N·A,) floating point; values beyond [-1, 1] are clipped.

        Returns:
            observation (N·D,) float32, reward, terminated, truncated, info.

        Raises:
            ValueError: an action of wrong shape or type, or not finite.
            RuntimeError: the episode has ended or none was started.
        """
        if self.vec.ended[0]:
            raise RuntimeError("the episode has ended or none was started: call reset() before step()")
        joint = _split(self.vec, action, self.action_space)
        outcome = self.vec.step_live(joint)
        self._pictures.show()
        mean = float(mean_reward(outcome.reward)[0])
        terminated, truncated = outcome.flags[:2, 0].tolist()
        # `flatten` copies, unlike `reshape`: the live array is overwritten by the next step.
        return outcome.observation.flatten(), mean, terminated, truncated, solo_info(self.vec)

    def render(self) -> np.ndarray | None:
        """Return a picture (H, W, 3) uint8 of the team and its target; None with "human", which shows every step.

        Raises:
            RuntimeError: there is no `render_mode`, or no episode was ever started.
            RenderingError: there is no OpenGL that draws off-screen.
        """
        return self._pictures.frame()

    def close(self) -> None:
        """Free renderer and window; the environment itself holds nothing that must be closed."""
        self._pictures.close()

    @property
    def spec(self) -> EnvSpec | None:
        """What `gymnasium.make` made it of, with `max_episode_steps`; None where it was made without that."""
        return _with_limit(self._spec, self.vec)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec


class MultiliftVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """E teams of N drones on the batched core, each as one agent: observations (E, N·D), actions (E, N·A).

    An environment that ends is reset as in Gymnasium's own vector environments: in the same step (`SAME_STEP`), where
    observation and info returned are the new episode's and the last ones of the old stand in `info["final_obs"]` and
    `info["final_info"]`; in the next step (`NEXT_STEP`), whose action does not count and whose reward is 0; or by the
    caller (`DISABLED`), with `options={"reset_mask": ...}`. Each entry `key` of an info has its mask `_key` (E,).
    Copies, also by pickle, go on bit for bit.

    Args:
        task: a configuration's name, the path of one, or a Config.
        num_envs: E; None for the configured value, as for the next three.
        num_threads: threads that step them; 0 for one on each CPU. Results do not depend on it.
        num_drones: N.
        seed: of the first reset; None draws one, unless the configuration states it.
        first_env: number of the first environment, for replaying one of a larger batch.
        render_mode: None, or "rgb_array" for `render`.
        autoreset_mode: see above; also "SameStep", "NextStep" or "Disabled".
        max_episode_steps: time limit in policy steps, in place of `env.episode_seconds`.
        **overrides: configuration values by dotted name, `**{"payload.mass": 2.0}`.

    Attributes:
        vec: the batched core underneath.
        autoreset_mode: as given; `metadata` has it, too.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
        ValueError: an unknown render mode or autoreset mode.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium has it)
        "render_modes": list(BATCH_RENDER_MODES),
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    _spec: EnvSpec | None = None
    closed = True  # until there is something to close: Gymnasium 1.1 closes what was refused, too

    def __init__(
        self, task: str | Config = "hover", *, num_envs: int | None = None, num_threads: int | None = None,
        num_drones: int | None = None, seed: int | None = None, first_env: int = 0, render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP, max_episode_steps: int | None = None,
        **overrides: Any,
    ):  # fmt: skip
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        config = resolve_config(
            task, num_envs=num_envs, num_threads=num_threads, num_drones=num_drones, seed=seed, **overrides
        )
        config = limit_steps(config, max_episode_steps, "max_episode_steps", overrides)
        self.vec = MultiliftVec(config, first_env=first_env)
        self.num_envs = self.vec.num_envs
        own = {"autoreset_mode": self.autoreset_mode, "render_fps": self.vec.config.env.policy_hz}
        self.metadata = {**self.metadata, **own}
        self.render_mode = render_mode
        self.single_observation_space, self.single_action_space = row_spaces(self.vec, self.vec.num_drones)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._pictures = FrameRenderer(self.vec, render_mode, BATCH_RENDER_MODES)
        self.closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: start at episode 0 of this seed, environment e of it differing from all others; None goes to each
                environment's next episode.
            options: `reset_mask` (E,) bool chooses the environments; others see `MultiliftVec.reset`.

        Returns:
            Observations (E, N·D) float32 of all environments, and info of those that were reset.

        Raises:
            ValueError: a negative seed, a mask of wrong shape or type, an unknown option or one that cannot be.
        """
        check_open(self.closed)
        seed_afresh(self.vec)
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        mask = None if mask is None else check_mask(mask, self.num_envs)
        observation, info = self.vec.reset(seed, mask, options)
        super().reset(seed=seed)  # for wrappers that draw from np_random; nothing here does
        return self._joint(observation), self._masked(info, np.ones(self.num_envs, bool) if mask is None else mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all environments by one policy step and reset those that have ended, as `autoreset_mode` says.

        Args:
            actions: (E, N·A) floating point; values beyond [-1, 1] are clipped.

        Returns:
            observations (E, N·D) float32, rewards (E,) float64, terminated (E,), truncated (E,), info.

        Raises:
            ValueError: actions of wrong shape or type, or not finite.
            RuntimeError: environments were never reset, or are closed, or have ended and nobody resets them.
        """
        check_open(self.closed)
        joint, mode = _split(self.vec, actions, self.action_space), self.autoreset_mode
        # The core then starts those anew that ended in the step before, in place of stepping them.
        restart = mode is AutoresetMode.NEXT_STEP
        observation, reward, terminated, truncated, info = self.vec.step(joint, restart)
        over, infos = terminated | truncated, {}
        if mode is AutoresetMode.SAME_STEP and over.any():
            # Before the reset, or the last observations, from which a value is bootstrapped, would be lost. The form is
            # Gymnasium's: an array of objects, None where no episode ended.
            final = np.full(self.num_envs, None, dtype=object)
            for e in np.flatnonzero(over):
                final[e] = observation[e].reshape(-1)
            infos = {"final_obs": final, "final_info": self._masked(info, over)}
            infos |= {f"_{key}": over.copy() for key in infos}
            observation, info = self.vec.reset(mask=over)
        infos |= self._masked(info, np.ones(self.num_envs, bool))
        return self._joint(observation), mean_reward(reward), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...]:
        """Return a picture (H, W, 3) uint8 of each environment.

        Raises:
            RuntimeError: there is no `render_mode`, or no episode was ever started.
            RenderingError: there is no OpenGL that draws off-screen.
        """
        frames = (self._pictures.frame(e) for e in range(self.num_envs))
        return tuple(frame for frame in frames if frame is not None)  # all: there is no mode "human"

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderer; later steps and resets raise a RuntimeError."""
        self._pictures.close()

    @property
    def spec(self) -> EnvSpec | None:
        """What `gymnasium.make_vec` made it of, with `max_episode_steps`; None where it was made without that."""
        return _with_limit(self._spec, self.vec)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec

    def _joint(self, observation: np.ndarray) -> np.ndarray:
        return observation.reshape(self.num_envs, -1)

    def _masked(self, info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
        """Return the core's info in Gymnasium's form: a mask beside every entry, and nothing outside the mask."""
        values: dict[str, Any] = {key: info[key] & mask for key in ("success", "failure", "diverged")}
        values["failure_cause"] = np.where(mask, info["failure_cause"], 0)
        terms = {name: np.where(mask, value, 0.0) for name, value in info["reward_terms"].items()}
        values["reward_terms"] = terms | {f"_{name}": mask.copy() for name in terms}
        drawn = {}
        for name, value in info["randomization"].items():
            drawn[name] = np.where(mask.reshape(-1, *(1,) * (value.ndim - 1)), value, np.zeros_like(value))
        values["randomization"] = drawn | {f"_{name}": mask.copy() for name in drawn}
        return values | {f"_{key}": mask.copy() for key in values}


def _with_limit(spec: EnvSpec | None, vec: MultiliftVec) -> EnvSpec | None:
    """Return a spec that states the time limit of the environments, whatever configured it."""
    if spec is not None:
        # The one given is left alone: it belongs to whoever made it.
        spec = copy(spec)
        spec.max_episode_steps = vec.max_steps
    return spec


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return a mode given as such or by its value."""
    names = [each.value for each in AutoresetMode]
    if isinstance(mode, str) and mode not in names:
        raise ValueError(f"unknown autoreset_mode '{mode}'{nearest(mode, names)}")
    return AutoresetMode(mode)


def _split(vec: MultiliftVec, action: np.ndarray, space: gymnasium.Space[Any]) -> np.ndarray:
    """Return a joint action as the core takes it (E, N, A)."""
    action = np.asarray(action)
    if action.shape != space.shape:
        raise ValueError(
            f"action has shape {action.shape}, expected {space.shape}: {vec.action_size} numbers for each of "
            f"{vec.num_drones} drones in a row"
        )
    return action.reshape(vec.num_envs, vec.num_drones, vec.action_size)


def register() -> None:
    """Enter every shipped configuration in Gymnasium's registry, `multilift_marl/Hover-v0`; twice does nothing more.

    `pose_easy` is entered as `multilift_marl/PoseEasy-v0`, `rigs/falcon3` as `multilift_marl/RigsFalcon3-v0`.
    """
    for config in list_configs():
        name = f"multilift_marl/{''.join(word.capitalize() for word in re.split('[_/]', config))}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:{MultiliftGymnasiumEnv.__name__}",
                vector_entry_point=f"{__name__}:{MultiliftVectorEnv.__name__}",
                kwargs={"task": config},
            )
