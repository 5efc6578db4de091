"""Statistics of the rollouts: reward terms, and of whole episodes that ended: return, success, failure."""

from __future__ import annotations

import numpy as np

from multilift_marl.agents.rollouts import Batches
from multilift_marl.envs.core import MultiliftVec


class EpisodeStatistics:
    """Follows the returns of the episodes in flight from batch to batch.

    Nothing counts before the length of the longest episodes has passed: until then those end that the staggered start
    cut short, and of the whole ones that follow only the failures. Of rigs with shorter episodes more of them count.

    Args:
        vecs: environments like those of the rollouts, of each rig.
        num_envs: environments of all rigs together.
        began: iteration in which their first episodes begin.

    Attributes:
        began: as given.
        returns: of the episodes in flight (E,).
    """

    def __init__(self, vecs: list[MultiliftVec], num_envs: int, began: int = 0):
        self.began = began
        self._length, self._terms = max(vec.max_steps for vec in vecs), vecs[0].reward_terms
        self.returns = np.zeros(num_envs)

    def read(self, batches: Batches, iteration: int) -> dict[str, float]:
        """Return the statistics of the batches of one iteration, by name."""
        rewards = np.concatenate([b["next", "agents", "reward"].mean(dim=(-2, -1)).double().numpy() for b in batches])
        done = np.concatenate([batch["next", "done"].squeeze(-1).numpy() for batch in batches])
        elapsed = (iteration - self.began) * done.shape[1] + np.arange(done.shape[1])
        counted = done & (elapsed >= self._length)
        finished = []
        for t in range(rewards.shape[1]):
            self.returns += rewards[:, t]
            finished += self.returns[counted[:, t]].tolist()
            self.returns[done[:, t]] = 0.0
        infos = [batch["next", "info"] for batch in batches]
        terms = np.mean([info["reward_terms"].mean(dim=(0, 1)).tolist() for info in infos], axis=0)
        values = {f"reward/{name}": float(term) for name, term in zip(self._terms, terms, strict=True)}
        values["reward/total"] = float(rewards.mean())
        if finished:
            values["return"] = float(np.mean(finished))
            for name in ("success", "failure"):
                flags = np.concatenate([info[name].squeeze(-1).numpy() for info in infos])
                values[name] = float(flags[counted].mean())
        values["diverged"] = float(sum(info["diverged"].sum().item() for info in infos))
        return values
