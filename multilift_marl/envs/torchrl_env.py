"""The TorchRL API: a natively batched EnvBase with masked resets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from multilift_marl.config.config import Config
from multilift_marl.config.load import resolve_config
from multilift_marl.envs.core import TRAINING, MultiliftVec
from multilift_marl.envs.wrapper_utils import check_open, seed_afresh
from multilift_marl.errors import UnknownKeywordError, nearest

_CPU = torch.device("cpu")


class MultiliftEnv(EnvBase):
    """E environments of N drones as one TorchRL environment of batch size [E], on the CPU.

    Keys: ("agents", "observation") (E, N, D), ("agents", "action") (E, N, A), ("agents", "reward") (E, N, 1), root
    `state` (E, S) for critics, root `done`, `terminated`, `truncated` (E, 1), and `info` with `success`, `failure`,
    `diverged` (E, 1) and `reward_terms` (E, T).

    Where neither the configuration nor `set_seed` states a seed, the first reset draws one (`vec.seeds`), so that
    workers simulate different episodes. After `close()`, steps and resets raise a RuntimeError.

    Args:
        config: what to build.
        purpose: see MultiliftVec.
        first_env: see MultiliftVec.
        memory: H, of a policy that writes its memory ("next", "agents", "memory") (E, N, H) in each step and reads it
            as ("agents", "memory") in the next one; 0 where an episode starts.

    Attributes:
        vec: the batched core underneath.
        group_map: {"agents": names of the drones}, as TorchRL's own multi-agent environments have it.

    Raises:
        ConfigError: see `MultiliftVec`.
    """

    def __init__(self, config: Config, purpose: int = TRAINING, first_env: int = 0, memory: int = 0):
        self.vec = vec = MultiliftVec(config, purpose, first_env)
        super().__init__(device="cpu", batch_size=[vec.num_envs])
        self.is_closed = False
        self.group_map = {"agents": [f"drone_{n}" for n in range(vec.num_drones)]}
        e, n, flag = vec.num_envs, vec.num_drones, Binary(1, (vec.num_envs, 1), dtype=torch.bool)
        agents = {"observation": Unbounded((e, n, vec.observation_size))}
        self._memory: torch.Tensor | None = None  # before the next step
        if memory:
            agents["memory"], self._memory = Unbounded((e, n, memory)), torch.zeros(e, n, memory)
        self.observation_spec = Composite(
            agents=Composite(agents, shape=(e, n)),
            state=Unbounded((e, vec.state_size)),
            info=Composite(
                success=flag.clone(), failure=flag.clone(), diverged=flag.clone(),
                reward_terms=Unbounded((e, len(vec.reward_terms))), shape=(e,),
            ),
            shape=(e,),
        )  # fmt: skip
        self.action_spec = Composite(
            agents=Composite(action=Bounded(-1.0, 1.0, (e, n, vec.action_size)), shape=(e, n)), shape=(e,)
        )
        self.reward_spec = Composite(agents=Composite(reward=Unbounded((e, n, 1)), shape=(e, n)), shape=(e,))
        self.done_spec = Composite({key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=(e,))
        self._seed: int | None = None
        self._resumed = False
        self._terminated = torch.zeros(e, 1, dtype=torch.bool)

    def _reset(
        self, tensordict: TensorDictBase | None = None, seed: int | None = None,
        options: dict[str, Any] | None = None, **others: Any,
    ) -> TensorDict:  # fmt: skip
        """Start episodes; `seed` and `options` as the core's `reset` takes them."""
        check_open(self.is_closed)
        for name in others:
            raise UnknownKeywordError(f"reset takes no '{name}'{nearest(name, ('seed', 'options'))}")
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        if mask is None and self._resumed and seed is None and options is None:
            self._resumed = False  # the restored episodes go on
            observation, info = self.vec.current()
        else:
            if mask is None and self._memory is not None:
                self._memory = torch.zeros_like(self._memory)
            seed, self._seed, self._resumed = self._seed if seed is None else seed, None, False
            seed_afresh(self.vec)
            observation, info = self.vec.reset(seed, None if mask is None else mask.reshape(-1).numpy(), options)
        ended = torch.from_numpy(self.vec.ended).unsqueeze(-1)  # of environments that this reset leaves alone
        flags = [torch.from_numpy(info[key]).unsqueeze(-1) for key in ("success", "failure", "diverged")]
        package = self._package(observation, [ended & self._terminated, ended & ~self._terminated, *flags])
        if mask is None and self._memory is not None:
            package["agents", "memory"] = self._memory
        return package

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        check_open(self.is_closed)
        action = tensordict["agents", "action"].detach().numpy()
        outcome = self.vec.step_live(action)
        self._resumed = False
        # Copied, since the core overwrites them in its next step.
        flags = torch.from_numpy(outcome.flags.copy()).unsqueeze(-1).unbind()
        self._terminated = flags[0]
        return self._package(outcome.observation.copy(), flags, outcome.reward.copy())

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Skip what EnvBase completes and reshapes after a step: `_package` gives all of it."""
        return super()._step_proc_data(next_tensordict_out) if self.run_type_checks else next_tensordict_out

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Start new episodes where `tensordict`, the root of a next step, is done.

        As `EnvBase.maybe_reset` does, but without its merging: all rows of what the environment tells are the core's,
        those of episodes that go on, too. What a policy has added, such as its memory, is 0 where an episode starts.
        """
        done = tensordict["done"]
        if done.any():
            tensordict = self._start_where(done, tensordict)
        if self._memory is not None:
            self._memory = tensordict["agents", "memory"]
        return tensordict

    def _start_where(self, done: torch.Tensor, tensordict: TensorDictBase) -> TensorDictBase:
        fresh = self._reset(TensorDict({"_reset": done}, self.batch_size))
        known = set(fresh.keys(True, True))
        for key, value in tensordict.items(True, True):
            if key not in known:
                fresh.set(key, value.masked_fill(done.reshape(-1, *(1,) * (value.dim() - 1)), 0))
        return fresh

    def _package(
        self, observation: np.ndarray, flags: Sequence[torch.Tensor], reward: np.ndarray | None = None
    ) -> TensorDict:
        """Return what the core tells, of which nothing changes later; `flags` (E, 1) as `Outcome` lists them."""
        e, n = self.vec.num_envs, self.vec.num_drones
        terminated, truncated, success, failure, diverged = flags
        agents = {"observation": torch.from_numpy(observation)}
        if reward is not None:
            agents["reward"] = torch.from_numpy(reward).unsqueeze(-1)
        terms = torch.from_numpy(self.vec.outcome.terms.astype(np.float32))
        info = {"success": success, "failure": failure, "diverged": diverged, "reward_terms": terms}
        return _unchecked(
            {
                "agents": _unchecked(agents, e, n),
                "state": torch.from_numpy(self.vec.state()),
                "info": _unchecked(info, e),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            e,
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed, self._resumed = seed, False

    def get_state(self) -> dict[str, torch.Tensor]:
        """Return everything that later steps depend on, as tensors."""
        state = {key: torch.from_numpy(array) for key, array in self.vec.state_dict().items()}
        return state if self._memory is None else state | {"memory": self._memory}

    def set_state(self, saved: dict[str, torch.Tensor]) -> None:
        """Continue bit for bit from what `get_state` returned: the next full reset returns the restored episodes.

        Raises:
            ValueError: see `MultiliftVec.load_state_dict`.
        """
        saved = dict(saved)
        memory = None if self._memory is None else _checked_memory(saved.pop("memory", None), self._memory)
        self.vec.load_state_dict({key: np.asarray(tensor) for key, tensor in saved.items()})
        self._memory = memory
        self._resumed = True


def _checked_memory(found: Any, expected: torch.Tensor) -> torch.Tensor:
    """Return a copy of a saved memory, or raise a ValueError."""
    fits = isinstance(found, torch.Tensor) and found.shape == expected.shape and found.dtype == expected.dtype
    if not fits or not found.isfinite().all():
        raise ValueError(f"'memory' must be a finite {expected.dtype} tensor {tuple(expected.shape)}")
    return found.clone()


def _unchecked(source: dict[str, Any], *batch_size: int) -> TensorDict:
    """Return a TensorDict of what is known to fit, without the checks that take longer than all else of a step."""
    return TensorDict._new_unsafe(source, torch.Size(batch_size), device=_CPU)


def torchrl_env(
    task: str | Config = "hover", *, num_envs: int | None = None, num_threads: int | None = None,
    num_drones: int | None = None, seed: int | None = None, first_env: int = 0, **overrides: Any,
) -> MultiliftEnv:  # fmt: skip
    """Return E environments of a task as a TorchRL environment of batch size [E]; arguments as for `make_vec`.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
    """
    config = resolve_config(
        task, num_envs=num_envs, num_threads=num_threads, num_drones=num_drones, seed=seed, **overrides
    )
    return MultiliftEnv(config, first_env=first_env)
