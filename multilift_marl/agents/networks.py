"""Policy and critics: plain torch modules, the normaliser inside, parameters shared by all drones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import nn

if TYPE_CHECKING:  # policies need torch only
    from torchrl.modules import ValueNorm


class Normalizer(nn.Module):
    """Standardises each number by running statistics that are part of the network (Chan et al. 1979)."""

    mean: torch.Tensor
    square: torch.Tensor
    count: torch.Tensor
    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, size: int, clip: float = 8.0):
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def update(self, batch: torch.Tensor) -> None:
        """Include a batch (..., size) in the statistics."""
        flat = batch.reshape(-1, batch.shape[-1]).double()
        added, mean = flat.shape[0], flat.mean(0)
        delta, total = mean - self.mean, self.count + added
        self.square += ((flat - mean) ** 2).sum(0) + delta**2 * self.count * added / total
        self.mean += delta * added / total
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.scale.copy_(1.0 / (self.square / total).sqrt().clamp(min=1e-2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (..., size) with zero mean and unit variance, clipped."""
        return ((x - self.shift) * self.scale).clamp(-self.clip, self.clip)


def mlp(inputs: int, hidden: Sequence[int], outputs: int, gain: float) -> nn.Sequential:
    """Return a perceptron with tanh layers, initialised orthogonally, its last layer with `gain`."""
    widths, layers = [inputs, *hidden], []
    for fan_in, fan_out in zip(widths[:-1], widths[1:], strict=True):
        layers += [_orthogonal(nn.Linear(fan_in, fan_out), math.sqrt(2)), nn.Tanh()]
    return nn.Sequential(*layers, _orthogonal(nn.Linear(widths[-1], outputs), gain))


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Actor(nn.Module):
    """Gaussian policy of one drone, the same for all: observation (..., N, D) to mean and deviation (..., N, A).

    Its mean is that of a linear script, `base` (A, D), plus a network whose last layer starts near zero: an untrained
    team flies the script.
    """

    base: torch.Tensor

    def __init__(
        self, observation_size: int, action_size: int, hidden: Sequence[int], initial_std: float, base: torch.Tensor
    ):
        super().__init__()
        self.normalizer = Normalizer(observation_size)
        self.net = mlp(observation_size, hidden, action_size, gain=0.01)
        self.register_buffer("base", base)
        self.log_std = nn.Parameter(torch.full((action_size,), math.log(initial_std)))

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and standard deviation of the action."""
        mean = self.net(self.normalizer(observation)) + observation @ self.base.T
        return mean, self.log_std.exp().expand_as(mean)


class CentralCritic(nn.Module):
    """Value of the team from the global state: (..., S) to (..., N, 1), the same for every drone (MAPPO).

    The network's output is in units of the value normaliser, which the loss keeps up to date.
    """

    def __init__(self, state_size: int, num_drones: int, hidden: Sequence[int], value_norm: ValueNorm):
        super().__init__()
        self.normalizer, self.value_norm = Normalizer(state_size), value_norm
        self.net = mlp(state_size, hidden, 1, gain=0.1)
        self.num_drones = num_drones

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Return the value for each drone."""
        value = self.value_norm.denormalize(self.net(self.normalizer(state)))
        return value.unsqueeze(-2).expand(*value.shape[:-1], self.num_drones, 1)


class LocalCritic(nn.Module):
    """Value of each drone from its own observation: (..., N, D) to (..., N, 1) (IPPO)."""

    def __init__(self, observation_size: int, hidden: Sequence[int], value_norm: ValueNorm):
        super().__init__()
        self.normalizer, self.value_norm = Normalizer(observation_size), value_norm
        self.net = mlp(observation_size, hidden, 1, gain=0.1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the value for each drone."""
        return self.value_norm.denormalize(self.net(self.normalizer(observation)))
