"""The PettingZoo API: one environment, one agent for each drone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pettingzoo
from gymnasium.spaces import Box
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from multilift_marl.config.config import Config
from multilift_marl.config.load import list_configs, resolve_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.wrapper_utils import RENDER_MODES, FrameRenderer, limit_steps, possible_modes, seed_afresh
from multilift_marl.errors import nearest


class MultiliftParallelEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    """A team of N drones as a PettingZoo environment; agents `drone_0` ... act at once and end together.

    Observations are (D,) float32, actions (A,) in [-1, 1], rewards are the team's. Each agent's info holds numbers and
    arrays alone, as wrappers that make tensors of it ask: `success`, `failure`, `diverged` (bool), `failure_cause`, an
    index into `vec.failure_causes` (0: none), `reward_terms.<name>` (float) and `randomization.<name>`, the hidden
    draw. Copies, also by pickle, go on bit for bit.

    Where neither the configuration nor the first reset states a seed, that reset draws one (`vec.seeds`).

    Args:
        config: what to build; it is stepped alone, whatever `env.num_envs` says.
        render_mode: None, "rgb_array" for `render`, or "human" for a window that shows every step.

    Attributes:
        vec: the batched core underneath, of one environment.
        possible_agents: the names of all drones; `agents` is empty before the first episode and between two.
        observation_spaces, action_spaces: by agent, (D,) and (A,) float32.
        state_space: of `state`, (S,) float32.

    Raises:
        ConfigError: see `MultiliftVec`.
        ValueError: an unknown render mode.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as PettingZoo has it)
        "name": "multilift_v0",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
    }

    def __init__(self, config: Config, render_mode: str | None = None):
        config = resolve_config(config, num_envs=1, num_threads=1)
        self.vec = vec = MultiliftVec(config)
        modes = possible_modes(render_mode)
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": config.env.policy_hz}
        self.render_mode = render_mode
        self.possible_agents = [f"drone_{n}" for n in range(vec.num_drones)]
        self.agents: list[str] = []
        names, unbounded = self.possible_agents, (-np.inf, np.inf)
        self.observation_spaces = {name: Box(*unbounded, (vec.observation_size,), np.float32) for name in names}
        self.action_spaces = {name: Box(-1.0, 1.0, (vec.action_size,), np.float32) for name in names}
        self.state_space = Box(*unbounded, (vec.state_size,), np.float32)
        self._joint = np.zeros((1, vec.num_drones, vec.action_size))
        # In the order in which `_infos` reads flags, cause and terms.
        flags = ("success", "failure", "diverged", "failure_cause")
        self._info_names = (*flags, *(f"reward_terms.{name}" for name in vec.reward_terms))
        self._drawn: dict[str, np.ndarray] | None = None  # of the episode of which `_draw` is the draw
        self._pictures = FrameRenderer(vec, render_mode)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start a new episode.

        Args:
            seed: start at episode 0 of this seed; None goes to the next episode, at first of a seed of its own.
            options: `randomization` and `state`, values by name to start from; see docs/randomization.md.

        Returns:
            Observation {agent: (D,) float32} and info of each agent.

        Raises:
            ValueError: a negative seed, an unknown option or one that cannot be.
        """
        options = {name: value for name, value in (options or {}).items() if name != "options"}  # of PettingZoo's test
        seed_afresh(self.vec)
        observation, _ = self.vec.reset(seed, options=options)
        self.agents = self.possible_agents.copy()
        self._pictures.show()
        return dict(zip(self.agents, observation[0], strict=True)), self._infos()

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Advance by one policy step.

        Args:
            actions: {agent: (A,) floating point} of every agent; values beyond [-1, 1] are clipped.

        Returns:
            Observations (D,) float32, rewards, terminations, truncations and infos by agent.

        Raises:
            ValueError: an agent without an action, an action without an agent, or one of wrong shape or type or not
                finite; the message names the drone.
            RuntimeError: the episode has ended or none was started.
        """
        agents = self.agents
        if not agents:
            raise RuntimeError("the episode has ended or none was started: call reset() before step()")
        # As many as there are agents: where none is missing, as is seen below, none is unknown either.
        if len(actions) != len(agents):
            raise self._mismatch(actions)
        joint = self._joint[0]
        shape = joint.shape[1:]
        for n, name in enumerate(self.possible_agents):
            if name not in actions:
                raise self._mismatch(actions)
            action = np.asarray(actions[name])
            if action.shape != shape or action.dtype.kind != "f":
                raise ValueError(
                    f"action of {name} has shape {action.shape} and dtype {action.dtype}, expected {shape} "
                    "floating point numbers in [-1, 1]"
                )
            joint[n] = action
        outcome = self.vec.step_live(self._joint)
        over, out_of_time = outcome.flags[:2, 0].tolist()
        # As PettingZoo asks, agents leave when they are done; the dicts below are of all who acted.
        if over or out_of_time:
            self.agents = []
        self._pictures.show()
        # Copies, for the arrays of `outcome` are live: the next step overwrites them.
        return (
            dict(zip(agents, outcome.observation[0].copy(), strict=True)),
            dict(zip(agents, outcome.reward[0].tolist(), strict=True)),
            dict.fromkeys(agents, over),
            dict.fromkeys(agents, out_of_time),
            self._infos(),
        )

    def state(self) -> np.ndarray:
        """Return the global state (S,) float32, which holds what is hidden from the drones."""
        return self.vec.state()[0]

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations, the same object on every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions, the same object on every call."""
        return self.action_spaces[agent]

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

    def _infos(self) -> dict[str, dict[str, Any]]:
        """Return a dict for each agent; nothing in it is shared, so that wrappers may write into theirs."""
        vec = self.vec
        # `drawn` is another dict whenever an episode has started: names are made once for each.
        if self._drawn is not vec.drawn:
            self._drawn, self._draw = vec.drawn, self._name_draw(vec.drawn)
        draw, arrays = self._draw
        outcome = vec.outcome
        values = [*outcome.flags[2:, 0].tolist(), int(outcome.cause[0]), *outcome.terms[0].tolist()]
        common = dict(zip(self._info_names, values, strict=True)) | draw
        own = zip(*(array.copy() for array in arrays.values()), strict=True)  # can be written into
        return {
            name: common | dict(zip(arrays, rows, strict=True))
            for name, rows in zip(self.possible_agents, own, strict=True)
        }

    def _name_draw(self, drawn: dict[str, np.ndarray]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return an episode's draw as infos name it, and those of it that are arrays, with a row for each agent."""
        draw = {f"randomization.{name}": array[0] for name, array in drawn.items()}
        arrays = {name: value for name, value in draw.items() if isinstance(value, np.ndarray)}
        return draw, {name: np.stack([value] * len(self.possible_agents)) for name, value in arrays.items()}

    def _mismatch(self, actions: dict[str, Any]) -> ValueError:
        for name in self.possible_agents:
            if name not in actions:
                return ValueError(f"no action for {name}: give one for each of env.agents")
        stranger = next(name for name in actions if name not in self.possible_agents)
        return ValueError(f"action for unknown agent '{stranger}'{nearest(str(stranger), self.possible_agents)}")


def parallel_env(
    task: str | Config = "hover", *, num_drones: int | None = None, seed: int | None = None,
    render_mode: str | None = None, max_cycles: int | None = None, **overrides: Any,
) -> MultiliftParallelEnv:  # fmt: skip
    """Return one environment of a task as a PettingZoo parallel environment.

    Args:
        task: a configuration's name, the path of one, or a Config.
        num_drones: N; None for the configured value, as for the next.
        seed: of the first reset; None draws one, unless the configuration states it.
        render_mode: None, "rgb_array" or "human".
        max_cycles: time limit in policy steps, in place of `env.episode_seconds`.
        **overrides: configuration values by dotted name, `**{"payload.mass": 2.0}`.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
        ValueError: an unknown render mode.
    """
    config = resolve_config(task, num_drones=num_drones, seed=seed, **overrides)
    return MultiliftParallelEnv(limit_steps(config, max_cycles, "max_cycles", overrides), render_mode)


def env(task: str | Config = "hover", **keywords: Any) -> AECEnv[str, np.ndarray, np.ndarray]:
    """Return the same as an AEC environment, whose drones act one after the other; arguments as for `parallel_env`.

    The physics goes on once all drones have acted.
    """
    return parallel_to_aec(parallel_env(task, **keywords))


def register() -> None:
    """Enter every shipped configuration in both of PettingZoo's registries, `multilift_marl/hover-v0`.

    `rigs/falcon3` is entered as `multilift_marl/rigs_falcon3-v0`. Does nothing where PettingZoo has no registry (before
    1.27), and nothing the second time.
    """
    if not hasattr(pettingzoo, "parallel_registry"):
        return
    for config in list_configs():
        name = f"multilift_marl/{config.replace('/', '_')}-v0"
        for kind, function, known in (
            ("parallel", parallel_env, pettingzoo.parallel_registry), ("aec", env, pettingzoo.aec_registry)
        ):  # fmt: skip
            if name not in known:
                pettingzoo.register(kind, name, f"{__name__}:{function.__name__}", kwargs={"task": config})
