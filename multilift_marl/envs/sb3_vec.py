"""The batched core as a vector environment of Stable-Baselines3 (extra `sb3`), its rows drones or teams."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.envs.core import make_vec
from multilift_marl.envs.wrapper_utils import (
    BATCH_RENDER_MODES,
    FrameRenderer,
    check_open,
    mean_reward,
    row_spaces,
    seed_afresh,
)
from multilift_marl.errors import ConfigError, pip_install

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"multilift_marl.envs.sb3_vec needs {error.name}: {pip_install('sb3')}") from error

Indices = int | Iterable[int] | None


class MultiliftSB3VecEnv(VecEnv):
    """E environments of N drones as rows of Stable-Baselines3's `VecEnv`, stepped together on the batched core.

    With `shared`, each drone is a row, so that one policy flies them all: E·N rows, row e·N + n drone n of environment
    e; observations (D,), actions (A,), the drone's reward. Without, each team is one: E rows, observations (N·D,) and
    actions (N·A,) drone after drone, the drones' mean reward.

    What counts episodes by rows, as SB3's `evaluate_policy` does, counts those of each drone with `shared`. To count
    teams, evaluate `TeamPolicy(model, N)` in environments that are not `shared`.

    An environment that ends is reset in the same step. Its rows' infos then hold `terminal_observation`,
    `TimeLimit.truncated`, `is_success` and `failure_cause` (its name, "none" without one); those of other rows are
    empty. Copies, also by pickle, go on bit for bit.

    Args:
        task: a configuration's name, the path of one, or a Config.
        num_envs: E; None for the configured value, as for the next two.
        num_threads: threads that step them; 0 for one on each CPU. Results do not depend on it.
        num_drones: N.
        seed: of the first reset; None draws one, unless the configuration states it.
        first_env: number of the first environment, for replaying one of a larger batch.
        render_mode: None, or "rgb_array" for `render`.
        shared: whether a row is a drone; else it is a team.
        **overrides: configuration values by dotted name, `**{"payload.mass": 2.0}`.

    Attributes:
        vec: the batched core underneath.
        shared: as given.
        num_envs: rows, E·N or E.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
        ValueError: an unknown render mode.
    """

    def __init__(
        self, task: str | Config = "hover", *, num_envs: int | None = None, num_threads: int | None = None,
        num_drones: int | None = None, seed: int | None = None, first_env: int = 0, render_mode: str | None = None,
        shared: bool = True, **overrides: Any,
    ):  # fmt: skip
        self.vec = vec = make_vec(
            task, num_envs=num_envs, num_threads=num_threads, num_drones=num_drones, seed=seed, first_env=first_env,
            **overrides,
        )  # fmt: skip
        self.shared, self.render_mode = shared, render_mode
        self._rows = vec.num_drones if shared else 1  # of an environment
        self._pictures = FrameRenderer(vec, render_mode, BATCH_RENDER_MODES)
        super().__init__(vec.num_envs * self._rows, *row_spaces(vec, vec.num_drones // self._rows))
        cast(dict[str, Any], self.metadata)["render_fps"] = vec.config.env.policy_hz
        self.closed = False
        self._actions = np.zeros((self.num_envs, vec.num_drones // self._rows * vec.action_size), np.float32)
        self._shape = self._actions.shape

    def reset(self) -> np.ndarray:
        """Start new episodes: at episode 0 of the seed that `seed` was given, else each environment's next.

        Returns:
            Observations of the rows, float32.

        Raises:
            ValueError: a negative seed, an option that is unknown or cannot be, or options that differ between rows.
        """
        if any(options != self._options[0] for options in self._options):
            raise ValueError("options of reset must be the same for all rows: give set_options one dict")
        check_open(self.closed)
        seed_afresh(self.vec)
        observation, _ = self.vec.reset(self._seeds[0], options=self._options[0])  # the core tells environments apart
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self._by_row(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the rows' actions, floating point in [-1, 1]; `step_wait` flies them."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all environments by one policy step and reset those that have ended.

        Returns:
            Observations, rewards (float32) and ends (bool) of the rows, and a dict for each.

        Raises:
            ValueError: actions of wrong shape or type, or not finite.
            RuntimeError: the environments were never reset, or are closed.
        """
        check_open(self.closed)
        vec = self.vec
        if self._actions.shape != self._shape:
            raise ValueError(f"actions have shape {self._actions.shape}, expected {self._shape} (rows, numbers)")
        joint = self._actions.reshape(vec.num_envs, vec.num_drones, vec.action_size)
        outcome = vec.step_live(joint)
        observation, reward = outcome.observation.copy(), outcome.reward.copy()
        reward = reward.reshape(-1) if self.shared else mean_reward(reward).astype(np.float32)
        _, truncated, success, *_ = outcome.flags
        over = vec.ended
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over.any():
            last = self._by_row(observation)
            for row in np.flatnonzero(over.repeat(self._rows)).tolist():
                e = row // self._rows
                infos[row] = {
                    "terminal_observation": last[row],
                    "TimeLimit.truncated": bool(truncated[e]),
                    "is_success": bool(success[e]),
                    "failure_cause": vec.failure_causes[outcome.cause[e]],
                }
            observation, _ = vec.reset(mask=over)
        return self._by_row(observation), reward, over.repeat(self._rows), infos

    def close(self) -> None:
        """Free the renderer; later steps and resets raise a RuntimeError."""
        self._pictures.close()
        self.closed = True

    def get_images(self) -> list[np.ndarray | None]:
        """Return a picture (H, W, 3) uint8 of each environment, for `render`."""
        return [self._pictures.frame(e) for e in range(self.vec.num_envs)]

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the core for each row, of arrays (E, ...) its environment's part; or of this wrapper.

        That is `render_mode`, `metadata`, `spec` (None) or a space.

        Raises:
            AttributeError: the core has none such.
        """
        if attr_name in ("render_mode", "metadata", "observation_space", "action_space"):
            return [getattr(self, attr_name) for _ in self._get_indices(indices)]
        if attr_name == "spec":
            return [None for _ in self._get_indices(indices)]
        return self._share(getattr(self.vec, attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the core, which all rows share.

        Raises:
            ValueError: only some rows are chosen.
        """
        if indices is not None:
            raise ValueError(f"'{attr_name}' belongs to all rows, which one core flies: leave out indices")
        setattr(self.vec, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Indices = None, **keywords: Any) -> list[Any]:
        """Call a method of the core once, and return what it returns for each row as `get_attr` does."""
        return self._share(getattr(self.vec, method_name)(*arguments, **keywords), indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Return False for each row: nothing is wrapped on the way to the core."""
        return [False for _ in self._get_indices(indices)]

    def _by_row(self, observation: np.ndarray) -> np.ndarray:
        return observation.reshape(self.num_envs, -1)

    def _share(self, value: Any, indices: Indices) -> list[Any]:
        """Return what each of the chosen rows has of a value of the core."""
        split = isinstance(value, np.ndarray) and value.shape[:1] == (self.vec.num_envs,)
        return [value[row // self._rows] if split else value for row in self._get_indices(indices)]


class TeamPolicy:
    """A policy that was trained with a row for each drone (`shared`), for environments in which a row is a team.

    `evaluate_policy(TeamPolicy(model, 4), MultiliftSB3VecEnv(shared=False), n_eval_episodes=100)` evaluates 100
    episodes of the team.

    Args:
        model: a model of SB3; its observation space is (D,).
        num_drones: N.

    Raises:
        ConfigError: the model observes anything else than one drone's numbers in a row.
    """

    def __init__(self, model: Any, num_drones: int):
        if len(model.observation_space.shape) != 1 or num_drones < 1:
            raise ConfigError(
                f"a model for one drone observes (D,) numbers, but this one has {model.observation_space.shape}, and "
                f"num_drones is {num_drones}; give the model and the size of the team that it flies"
            )
        self._model, self._num_drones = model, num_drones

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:  # fmt: skip
        """Return actions (E, N·A) for observations (E, N·D), as SB3's models do for their rows.

        Raises:
            ConfigError: the observations are of another team.
        """
        size = self._model.observation_space.shape[0]
        if observation.shape[-1] != size * self._num_drones:
            raise ConfigError(
                f"a team of {self._num_drones} observes {self._num_drones} x {size} numbers, but these are "
                f"{observation.shape[-1]}; use MultiliftSB3VecEnv(shared=False) with num_drones={self._num_drones}"
            )
        starts = None if episode_start is None else np.repeat(episode_start, self._num_drones)
        action, state = self._model.predict(observation.reshape(-1, size), state, starts, deterministic)
        return action.reshape(len(observation), -1), state
